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

from swarmsim.device import at_most, on_processor
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.lines import SPECTRUM_DEPTHS
from swarmsim.radiation.rate import ground_and_slope, scattered_on, unattenuated
from swarmsim.site.rays import Crossed

LINES_TOGETHER = 2
"""Of a nuclide, which an accelerator computes at a time."""


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
    asked: jax.Array | bool = True,
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
        asked: [] bool; where it is False rates mean nothing, and cost next to nothing if none of a batch are asked for.
    """
    given = jnp.ones(axis.shape[0]) if weight is None else weight
    lines, one = _lines_of(detector, source.nuclide), replace(source, nuclide=jnp.int32(0))
    n, regions = axis.shape[0], detector.peak_rois.shape[-1]
    m, together = n // places, 1 if on_processor() else LINES_TOGETHER
    nothing = RoiRates(jnp.zeros((m, regions)), jnp.zeros((m, len(by), regions)), jnp.zeros(n))
    # most nuclides have fewer lines than the tables have rows
    count = jnp.max(jnp.where(detector.yields[source.nuclide] > 0.0, jnp.arange(1, detector.yields.shape[1] + 1), 0))
    # of many, all go on as long as any: a line without photons adds nothing, and to leave it out costs more
    count = at_most(-(-jnp.where(asked, count, 0) // together))

    def of(line: dict[str, Any]) -> RoiRates:
        return _of_line(replace(detector, **line), one, way, position_m, axis, by, given, places)

    def add(number: jax.Array, sums: RoiRates) -> RoiRates:
        if together == 1:
            return jax.tree.map(jnp.add, sums, of({name: x[number] for name, x in lines.items()}))
        own = {name: _rows(x, number * together, together) for name, x in lines.items()}
        return jax.tree.map(lambda old, new: old + jnp.sum(new, axis=0), sums, jax.vmap(of)(own))

    return jax.lax.fori_loop(0, count, add, nothing)


def _rows(x: jax.Array, first: jax.Array, count: int) -> jax.Array:
    """Rows [count, ...] from the ``first`` on; zeros beyond the last one."""
    padded = jnp.pad(x, [(0, -x.shape[0] % count)] + [(0, 0)] * (x.ndim - 1))
    return jax.lax.dynamic_slice_in_dim(padded, first, count)


_LINES = {
    "yields": 0, "effective_area_m2": 0, "near_share": 0, "attenuation_1_m": 0, "scatter_1_m": 2, "ground": 0,
    "peak_rois": 0, "scattered_rois": 2, "ground_rois": 0, "line_energy_kev": 0,
}  # fmt: skip
"""Tables that rates by region take from a detector, and the axis of the lines in those of a nuclide."""


def _lines_of(detector: Detector, nuclide: jax.Array) -> dict[str, jax.Array]:
    """Those tables of each line [L, 1, ...], as if it were the only one of the only nuclide."""
    of = {name: jnp.moveaxis(jnp.asarray(getattr(detector, name))[nuclide], axis, 0) for name, axis in _LINES.items()}
    return {name: jnp.expand_dims(of[name], (1, 2 + axis)) for name, axis in _LINES.items()}


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
