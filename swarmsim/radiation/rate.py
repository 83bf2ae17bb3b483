"""Count rate of one detector from one point source, dead time, and drawn counts (device side).

    rate = sum over lines of  A y A_eff(E, theta) G / (4 pi (r^2 + S^2)) (exp(-t) + scattered(t)) (1 + g)

with activity A, effective area A_eff (the integral of the detection probability over the silhouette), near-field ratio
G (`swarmsim.radiation.cylinder`), depth t = sum mu_k x_k, the scattered counts of `swarmsim.radiation.walls`, and the
share g that the ground adds (`swarmsim.radiation.ground`).
"""

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.device import at_most, on_processor, thread_by_thread
from swarmsim.pytree import pytree, static
from swarmsim.radiation.cylinder import NEAR_TABLES, direction_basis, near_ratio
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.lines import SPECTRUM_DEPTHS
from swarmsim.radiation.poisson import poisson
from swarmsim.radiation.walls import Scattered, scattered_counts
from swarmsim.site.rays import Crossed

INDOORS = 0.1
"""Sine of the elevation at which, in the open, as much comes from the ground as out of a building with thick walls."""
LINES_TOGETHER = 2
"""Of a nuclide, which an accelerator computes at a time."""
HELD_BACK = 3.0
"""Depth of walls for the photons that the ground scatters, over that for those of the source."""


def line_rates(
    detector: Detector, source: Source, way: Crossed, position_m: jax.Array, axis: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Counts per second [L] of each line from unscattered photons, and [L] from scattered ones.

    ``way`` is what the line from the source to the crystal crosses, ``position_m`` [3] the crystal's centre and
    ``axis`` [3] its unit axis, world ENU. Scattered photons (`swarmsim.radiation.walls`) come from the direction of the
    source.
    """
    direct, scattered, ground = _parts(detector, source, way, position_m, axis)
    return direct, scattered + ground


def _parts(
    detector: Detector, source: Source, way: Crossed, position_m: jax.Array, axis: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Counts per second [L] of photons that did not scatter, that scattered on the way, and that came by the ground."""
    seen = _seen(detector, source, position_m, axis)
    direct, scattered = transmission(detector, source.nuclide, way)
    return seen * direct, seen * scattered, seen * (direct + scattered) * from_ground(detector, source.nuclide, way)


def from_ground(detector: Detector, nuclide: jax.Array, way: Crossed) -> jax.Array:
    """Counts [..., L] of photons that the ground scatters over those of the photons from the source.

    Walls hold back the former as the latter. A building does so more the thicker its walls are, for the former are
    softer, and diffuses them: of what the ground below a source in it scatters, as much comes to every place around as
    in the open to one that looks on it at an elevation with the sine `INDOORS`. So it is in the Monte Carlo of
    buildings (``experiments/transport/enclosures.py``), where the open air's would be up to 1.8 times too much.
    """
    if way.shape is None or detector.kind == "paper_ideal":
        return jnp.zeros((*way.length_m.shape[:-1], detector.yields.shape[1]))
    layers = way.shape.thin_m[..., None, :] * detector.attenuation_1_m[nuclide]
    return _from_ground(detector, nuclide, way, layers)[0]


def _from_ground(
    detector: Detector, nuclide: jax.Array, way: Crossed, layers: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """`from_ground` of a way with a shape, and its derivative [..., L] by the depth of walls.

    ``layers`` [..., L, M] are the optical depths of the materials the short way.
    """
    assert way.shape is not None
    a, b = detector.ground[nuclide, :, 0], detector.ground[nuclide, :, 1]
    kept = jnp.exp(-HELD_BACK * jnp.sum(layers * (1.0 - detector.surrounds), axis=-1))
    outdoors = way.shape.ground[..., None, 0] * a + way.shape.ground[..., None, 1] * b
    indoors = way.shape.low[..., None] * (a * INDOORS**0.5 + b * INDOORS)
    change = way.shape.closed[..., None] * (indoors - outdoors)
    return outdoors + (1.0 - kept) * change, HELD_BACK * kept * change


def transmission(detector: Detector, nuclide: jax.Array, way: Crossed) -> tuple[jax.Array, jax.Array]:
    """Unscattered counts [L] behind matter and those that it scatters, relative to the counts without it."""
    if detector.kind == "paper_ideal":
        direct = jnp.exp(-detector.attenuation_1_m[nuclide] @ way.length_m)
        return direct, jnp.zeros_like(direct)
    found = _scattered(detector, nuclide, way)
    return jnp.exp(-found.slant), found.counts


def _scattered(detector: Detector, nuclide: jax.Array, way: Crossed) -> Scattered:
    tables = (detector.attenuation_1_m[nuclide], detector.scatter_1_m[nuclide], detector.line_energy_kev[nuclide])
    return scattered_counts(*tables, detector.surrounds, way)


def _seen(detector: Detector, source: Source, position_m: jax.Array, axis: jax.Array) -> jax.Array:
    """Counts per second of each line [L] without attenuation."""
    basis, near, squared = _view(detector, source.position_m - position_m, axis)
    area = detector.effective_area_m2[source.nuclide] @ basis
    geometry = (detector.near_share[source.nuclide] @ near) / (4.0 * jnp.pi * squared)
    return source.activity_bq * geometry * detector.yields[source.nuclide] * area


def _view(detector: Detector, offset_m: jax.Array, axis: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """How a crystal sees a source ``offset_m`` [3] away: direction [5], near-field ratios [NEAR_TABLES], r^2 + S^2."""
    squared = jnp.sum(offset_m * offset_m)
    distance = jnp.sqrt(squared + 1e-12)
    u = jnp.abs(jnp.dot(offset_m, axis)) / distance
    across = jnp.cross(offset_m, axis) / distance
    # the gradient is finite on the axis, and in the crystal's centre it is seen from the side
    s = jnp.sqrt(jnp.sum(across * across) + 1e-10 + 1e-12 / (squared + 1e-12))
    reach2 = detector.radius_m**2 + 0.25 * detector.length_m**2
    return direction_basis(u, s), near_ratio(detector.near, distance / jnp.sqrt(reach2), u, s), squared + reach2


def mean_view(detector: Detector, offset_m: jax.Array, axis: jax.Array, weight: jax.Array) -> jax.Array:
    """How a crystal sees a source on its way [5, NEAR_TABLES]: by direction and nearness, for `identify`.

    Args:
        detector: the crystal.
        offset_m: [n, 3] from the places on the way to the source.
        axis: [n, 3] of the crystal there.
        weight: [n] how long it was there; rows without any may hold anything. With none at all it is seen `end_on`.
            Those below zero, or that are no numbers, are none.
    """
    weight = jnp.where(jnp.isfinite(weight), jnp.maximum(weight, 0.0), 0.0)
    weight = weight / jnp.maximum(jnp.max(weight), 1e-30)
    offset_m, axis = (jnp.where(weight[:, None] > 0.0, x, 1.0) for x in (offset_m, axis))
    basis, near, squared = jax.vmap(lambda offset, along: _view(detector, offset, along))(offset_m, axis)
    share = weight / squared
    total = jnp.sum(share)
    seen = jnp.einsum("n,nb,nk->bk", share / jnp.maximum(total, 1e-30), basis, near)
    return jnp.where(total > 0.0, seen, end_on())


def end_on() -> jax.Array:
    """The `mean_view` of a distant source on the crystal's axis."""
    return direction_basis(jnp.float32(1.0), jnp.float32(0.0))[:, None] * jnp.ones(NEAR_TABLES)


def net_rate(
    detector: Detector,
    source: Source,
    way: Crossed,
    position_m: jax.Array,
    axis: jax.Array,
    *,
    uncollided: bool = False,
) -> jax.Array:
    """Counts per second [] that ``source`` adds, before dead time; see `line_rates` for the arguments.

    ``uncollided`` excludes photons that scattered before the crystal. Differentiable in the source's position and
    activity, the crystal's position and the lengths.
    """
    direct, scattered = line_rates(detector, source, way, position_m, axis)
    return jnp.sum(direct if uncollided else direct + scattered)


def observed_rate(detector: Detector, net_cps: jax.Array) -> jax.Array:
    """Counts per second [...] after dead time, of source and background together (`registered_share`)."""
    rate = net_cps + detector.background_cps
    return rate * registered_share(detector, rate)


def registered_share(detector: Detector, rate_cps: jax.Array) -> jax.Array:
    """Share [...] of a true rate [...] of counts per second that is registered.

    Hybrid law m / n = exp(-n t_p) / (1 + n t_n) of Lee and Gardner (Applied Radiation and Isotopes 53, 2000, 731),
    which is the paralyzable law for t_n = 0, the non-paralyzable one for t_p = 0, and 1 when both are 0.
    """
    return share_registered(rate_cps, detector.paralyzable_s, detector.non_paralyzable_s)


def share_registered(rate_cps: jax.Array, paralyzable_s: jax.Array, non_paralyzable_s: jax.Array) -> jax.Array:
    """`registered_share` [...] of detectors with these dead times [...]."""
    return jnp.exp(-rate_cps * paralyzable_s) / (1.0 + rate_cps * non_paralyzable_s)


def highest_rate(detector: Detector) -> float:
    """Largest rate that the detector can show; inf without dead time (host)."""
    paralyzable, non_paralyzable = float(detector.paralyzable_s), float(detector.non_paralyzable_s)
    if paralyzable <= 0.0:
        return np.inf if non_paralyzable <= 0.0 else 1.0 / non_paralyzable
    n = saturating_rate(paralyzable, non_paralyzable)
    return float(n * np.exp(-n * paralyzable) / (1.0 + n * non_paralyzable))


def saturating_rate(paralyzable_s: float, non_paralyzable_s: float) -> float:
    """True rate at which a detector with these dead times shows most; inf where more always shows as more (host)."""
    if paralyzable_s <= 0.0:
        return np.inf
    # the derivative of log m vanishes where n t_p (1 + n t_n) = 1
    a, b = paralyzable_s * non_paralyzable_s, paralyzable_s
    return float(1.0 / b if a == 0.0 else (-b + np.sqrt(b * b + 4.0 * a)) / (2.0 * a))


def exposure_of(detector: Detector, period_s: jax.Array | float) -> jax.Array:
    """Exposure [] in s that the counts of a measurement over ``period_s`` [] stand for: real time, dead time included.

    ``physical``: the period. ``paper_ideal``: as of the Gazebo plugin, whose every message represents one second
    whatever the message rate.
    """
    return jnp.asarray(period_s if detector.kind == "physical" else 1.0, jnp.float32)


def draw_counts(
    detector: Detector, key: jax.Array, mean_observed_cps: jax.Array, period_s: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Counts [...] of one measurement and the exposure [] in s that they represent: Poisson(rate x exposure)."""
    exposure, mean = exposure_of(detector, period_s), jnp.asarray(mean_observed_cps)
    if mean.ndim == 0:
        return poisson(key, mean * exposure), exposure
    keys = jax.random.split(key, mean.shape[0])
    return jax.vmap(poisson)(keys, mean * exposure), exposure


def spectrum_rate(
    detector: Detector, source: Source, way: Crossed, position_m: jax.Array, axis: jax.Array
) -> jax.Array:
    """Counts per second in each channel [channels] that ``source`` adds; they sum to `net_rate`."""
    direct, scattered, ground = _parts(detector, source, way, position_m, axis)
    shares = scattered_shares(detector, source.nuclide, way)
    bins = jnp.einsum("l,lb->b", scattered, shares) + ground @ detector.ground_bins[source.nuclide]
    return direct @ detector.peak_spectrum[source.nuclide] + bins @ detector.bin_spectrum


def roi_rates(detector: Detector, source: Source, way: Crossed, position_m: jax.Array, axis: jax.Array) -> jax.Array:
    """Counts per second in each region of interest [R] that ``source`` adds; they sum to `net_rate`."""
    direct, scattered, ground = _parts(detector, source, way, position_m, axis)
    shares = _shares(detector, source.nuclide, way, detector.scattered_rois)
    of_ground = ground @ detector.ground_rois[source.nuclide]
    return direct @ detector.peak_rois[source.nuclide] + jnp.einsum("l,lr->r", scattered, shares) + of_ground


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
    packed, shapes = packed_lines(detector, nuclide)
    # of many, all go on as long as any: a line without photons adds nothing, and to leave it out costs more
    return Lines(
        packed=packed, count=at_most(jnp.where(asked, lines_with_photons(detector, nuclide), 0)), shapes=shapes
    )


def lines_with_photons(detector: Detector, nuclide: jax.Array) -> jax.Array:
    """Number [] of lines of a nuclide []: most have fewer than the tables have rows."""
    return jnp.max(jnp.where(detector.yields[nuclide] > 0.0, jnp.arange(1, detector.yields.shape[1] + 1), 0))


def packed_lines(
    detector: Detector, nuclide: jax.Array | None = None
) -> tuple[jax.Array, tuple[tuple[str, tuple[int, ...]], ...]]:
    """Tables of all lines [N, L, entries], or of a nuclide's [L, entries]; and the shapes of `Lines`."""
    rows, shapes = [], []
    for name, axis in _LINES.items():
        table = jnp.asarray(getattr(detector, name))
        lead = 1 if nuclide is None else 0
        row = jnp.moveaxis(table if nuclide is None else table[nuclide], lead + axis, lead)
        front, own = row.shape[: lead + 1], row.shape[lead + 1 :]
        rows.append(row.reshape(*front, -1))
        shapes.append((name, (1, *own[:axis], 1, *own[axis:])))
    return jnp.concatenate(rows, axis=-1), tuple(shapes)


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
    seen = jax.vmap(lambda place, along: _seen(detector, source, place, along))(position_m, axis)[:, 0]  # [n]
    peaks = detector.peak_rois[0, 0]  # [R]
    if detector.kind == "paper_ideal":
        lengths = way.length_m * detector.attenuation_1_m[0, 0]
        direct = seen * jnp.exp(-jnp.sum(lengths, axis=-1))
        falling = summed(lengths[:, chosen] * direct[:, None])
        return RoiRates(summed(direct)[:, None] * peaks, -falling[..., None] * peaks, direct)
    found = _scattered(detector, source.nuclide, way)
    layers, depth, slants = found.layers[:, 0], found.depth[:, 0], found.slant_layers[:, 0, chosen]
    direct, scattered = seen * jnp.exp(-found.slant[:, 0]), seen * found.counts[:, 0]
    both, of_walls = direct + scattered, 1.0 - detector.surrounds[chosen]
    by_ground, rise = jnp.zeros_like(depth), jnp.zeros_like(depth)
    if way.shape is not None:
        by_ground, rise = (x[:, 0] for x in _from_ground(detector, source.nuclide, way, found.layers))
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


def observed_rois(detector: Detector, net_cps: jax.Array, background: jax.Array | float = 1.0) -> jax.Array:
    """Counts per second [..., R] after dead time of net rates [..., R], with the background (`observed_rate`).

    ``background`` [...] is the background over the detector's nominal one.
    """
    true = net_cps + jnp.asarray(background)[..., None] * detector.background_rois
    total = jnp.sum(true, axis=-1)
    shown = observed_rate(detector, total - detector.background_cps)
    return true * (shown / jnp.maximum(total, 1e-30))[..., None]


def scattered_shares(detector: Detector, nuclide: jax.Array, way: Crossed) -> jax.Array:
    """Shares [L, bins] of the scattered counts by energy: means over the layers, between the tabulated depths."""
    return _shares(detector, nuclide, way, detector.scattered_bins)


def _shares(detector: Detector, nuclide: jax.Array, way: Crossed, tables: jax.Array) -> jax.Array:
    thin_m = way.length_m if way.shape is None else way.shape.thin_m
    layers = detector.attenuation_1_m[nuclide] * thin_m  # [L, M]
    depth = jnp.sum(layers, axis=1)
    first, last = SPECTRUM_DEPTHS
    deep = jnp.clip((depth - first) / (last - first), 0.0, 1.0)
    weight = jnp.where(depth[:, None] > 1e-6, layers / jnp.maximum(depth, 1e-6)[:, None], 1.0 / layers.shape[1])
    table = tables[nuclide]  # [depths, M, L, bins]
    mean = jnp.einsum("lm,dmlb->dlb", weight, table)
    shares = (1.0 - deep)[:, None] * mean[0] + deep[:, None] * mean[1]
    return shares / jnp.maximum(jnp.sum(shares, axis=1, keepdims=True), 1e-12)
