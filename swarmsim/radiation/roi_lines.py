"""Counts by region of interest line by line, and how they change with the lengths of matter on the way.

The same rates as `swarmsim.radiation.rate.roi_rates`, for the estimate of sources, which asks for those of thousands of
places. Most nuclides have few lines, and a line's tables are few enough to stay where they are computed with.
"""

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.device import at_most, on_processor, thread_by_thread
from swarmsim.pytree import pytree, static
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.lines import SPECTRUM_DEPTHS
from swarmsim.radiation.rate import ground_and_slope, scattered_on, unattenuated
from swarmsim.site.rays import Crossed

LINES_TOGETHER = 2
"""Of a nuclide, which an accelerator computes at a time."""


@pytree
class Lines:
    """The lines of one nuclide: what of a detector's tables is theirs."""

    packed: jax.Array  # [L, entries] a row for each: then a thread of an accelerator reads the entries of one alone
    count: jax.Array  # [] int32 of those that have photons
    shapes: tuple[tuple[str, tuple[int, ...]], ...] = static()  # of each table, of one line of one nuclide

    def tables(self, row: jax.Array) -> dict[str, Any]:
        """The tables of the line of a row, as if it were the only one of the only nuclide."""
        found, first = {}, 0
        for name, shape in self.shapes:
            last = first + int(np.prod(shape))
            found[name], first = row[first:last].reshape(shape), last
        return found


class RoiRates(NamedTuple):
    """Rates by region of interest on m ways, of n places on them in all."""

    rates: jax.Array  # [m, R] counts per second
    slopes: jax.Array  # [m, U, R] their derivatives by ln(length in each of U materials)
    net: jax.Array  # [n] net rate at each place


def roi_rates_and_slopes(
    detector: Detector,
    source: Source,
    way: Crossed,
    position_m: jax.Array,
    axis: jax.Array,
    by: tuple[int, ...] = (),
    weight: jax.Array | None = None,
    places: int = 1,
    lines: Lines | None = None,
) -> RoiRates:
    """`roi_rates` with their derivatives at n places, or sums of them over some places at a time.

    The derivatives leave out that the spectrum of the scattered photons softens with depth, and take it to be the mean
    one at all places of a sum.

    Args:
        detector: of all places.
        source: one.
        way: fields [n, M], from the source to each place.
        position_m, axis: [n, 3] of the crystal.
        by: numbers of U materials (static).
        weight: [n] of the places in the sums; 1 by default.
        places: in a sum, neighbours (static).
        lines: of the source's nuclide, if they are known already (`lines_of`).
    """
    given = jnp.ones(axis.shape[0]) if weight is None else weight
    own = lines_of(detector, source.nuclide) if lines is None else lines
    one = replace(source, nuclide=jnp.int32(0))
    n, regions = axis.shape[0], dict(own.shapes)["peak_rois"][-1]
    m = n // places
    nothing = RoiRates(jnp.zeros((m, regions)), jnp.zeros((m, len(by), regions)), jnp.zeros(n))

    def of(row: jax.Array) -> RoiRates:
        return _of_line(replace(detector, **own.tables(row)), one, way, position_m, axis, by, given, places)

    together = 1 if on_processor() or thread_by_thread() else LINES_TOGETHER
    if together == 1:
        return jax.lax.fori_loop(
            0, own.count, lambda number, sums: jax.tree.map(jnp.add, sums, of(own.packed[number])), nothing
        )
    # a line without photons adds nothing
    rows = jnp.pad(own.packed, [(0, -own.packed.shape[0] % together), (0, 0)])

    def add(number: jax.Array, sums: RoiRates) -> RoiRates:
        some = jax.vmap(of)(jax.lax.dynamic_slice_in_dim(rows, number * together, together))
        return jax.tree.map(lambda old, new: old + jnp.sum(new, axis=0), sums, some)

    return jax.lax.fori_loop(0, -(-own.count // together), add, nothing)


_LINES = {
    "yields": 0, "effective_area_m2": 0, "near_share": 0, "attenuation_1_m": 0, "scatter_1_m": 2, "ground": 0,
    "peak_rois": 0, "scattered_rois": 2, "ground_rois": 0, "line_energy_kev": 0,
}  # fmt: skip
"""Tables that rates by region take from a detector, and the axis of the lines in those of a nuclide."""


def lines_of(detector: Detector, nuclide: jax.Array, asked: jax.Array | bool = True) -> Lines:
    """The lines of a nuclide [] as `roi_rates_and_slopes` takes them; none unless it is ``asked`` [] for them."""
    # of many, all go on as long as any: a line without photons adds nothing, and to leave it out costs more
    count = at_most(jnp.where(asked, lines_with_photons(detector, nuclide), 0))
    return Lines(packed=packed_lines(detector, nuclide), count=count, shapes=line_shapes(detector))


def lines_with_photons(detector: Detector, nuclide: jax.Array) -> jax.Array:
    """Number [] of lines of a nuclide []: most have fewer than the tables have rows."""
    return jnp.max(jnp.where(detector.yields[nuclide] > 0.0, jnp.arange(1, detector.yields.shape[1] + 1), 0))


Shapes = tuple[tuple[str, tuple[int, ...]], ...]


def line_shapes(detector: Detector) -> Shapes:
    """Name and shape of each table that `Lines` cuts a row up into."""
    found = []
    for name, axis in _LINES.items():
        own = np.delete(np.shape(getattr(detector, name)), [0, 1 + axis]).tolist()
        found.append((name, (1, *own[:axis], 1, *own[axis:])))
    return tuple(found)


def packed_lines(detector: Detector, nuclide: jax.Array | None = None) -> jax.Array:
    """Tables of all lines, a row for each [N, L, entries]; or those of a ``nuclide`` [] alone [L, entries]."""
    rows, lead = [], 1 if nuclide is None else 0
    for name, axis in _LINES.items():
        table = jnp.asarray(getattr(detector, name))
        row = jnp.moveaxis(table if nuclide is None else table[nuclide], lead + axis, lead)
        rows.append(row.reshape(*row.shape[: lead + 1], -1))
    return jnp.concatenate(rows, axis=-1)


def _of_line(
    detector: Detector,
    source: Source,
    way: Crossed,
    position_m: jax.Array,
    axis: jax.Array,
    by: tuple[int, ...],
    weight: jax.Array,
    places: int,
) -> RoiRates:
    """`roi_rates_and_slopes` of a detector and a nuclide with one line."""

    def summed(x: jax.Array) -> jax.Array:
        """Sums [m, ...] of [n, ...]; written out, as the arguments are not computed again for it."""
        x = x * weight.reshape(-1, *[1] * (x.ndim - 1))
        x = x.reshape(x.shape[0] // places, places, *x.shape[1:])
        return functools.reduce(jnp.add, (x[:, k] for k in range(places)))

    chosen = np.array(by, np.int32)
    seen = jax.vmap(lambda place, along: unattenuated(detector, source, place, along))(position_m, axis)[:, 0]  # [n]
    peaks = detector.peak_rois[0, 0]  # [R]
    if detector.kind == "paper_ideal":
        lengths = way.length_m * detector.attenuation_1_m[0, 0]
        direct = seen * jnp.exp(-jnp.sum(lengths, axis=-1))
        falling = summed(lengths[:, chosen] * direct[:, None])
        return RoiRates(summed(direct)[:, None] * peaks, -falling[..., None] * peaks, direct)
    found = scattered_on(detector, source.nuclide, way)
    layers, depth, slants = found.layers[:, 0], found.depth[:, 0], found.slant_layers[:, 0, chosen]
    direct, scattered = seen * jnp.exp(-found.slant[:, 0]), seen * found.counts[:, 0]
    both, of_walls = direct + scattered, 1.0 - detector.surrounds[chosen]
    by_ground, rise = jnp.zeros_like(depth), jnp.zeros_like(depth)
    if way.shape is not None:
        by_ground, rise = (x[:, 0] for x in ground_and_slope(detector, source.nuclide, way, found.layers))
    low, high = SPECTRUM_DEPTHS
    deep = jnp.clip((depth - low) / (high - low), 0.0, 1.0)
    # where nothing lies between, nothing is scattered
    per_depth = scattered / jnp.maximum(depth, 1e-6)
    spectrum = sum(
        summed((per_depth * share)[:, None] * layers) @ table
        for share, table in zip((1.0 - deep, deep), detector.scattered_rois[0, :, :, 0], strict=True)
    )
    ground = detector.ground_rois[0, 0]
    rates = summed(direct)[:, None] * peaks + spectrum + summed(by_ground * both)[:, None] * ground
    chosen_layers = layers[:, chosen]
    changes = chosen_layers * (seen * found.by_depth[:, 0])[:, None]
    changes -= (1.0 - of_walls) * chosen_layers * (seen * found.by_walls[:, 0])[:, None]
    falls = slants * direct[:, None]
    of_ground = by_ground[:, None] * (changes - falls) + (rise * both)[:, None] * chosen_layers * of_walls
    shape = spectrum / jnp.maximum(summed(scattered), 1e-30)[:, None]
    slopes = (
        summed(changes)[..., None] * shape[:, None]
        - summed(falls)[..., None] * peaks
        + summed(of_ground)[..., None] * ground
    )
    return RoiRates(rates, slopes, both * (1.0 + by_ground))
