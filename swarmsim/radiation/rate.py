"""Count rate of one detector from one point source, dead time, and drawn counts (device side).

    rate = sum over lines of  A y A_eff(E, theta) G / (4 pi (r^2 + S^2)) (exp(-t) + scattered(t)) (1 + g)

with activity A, effective area A_eff (the integral of the detection probability over the silhouette), near-field ratio
G (`swarmsim.radiation.cylinder`), depth t = sum mu_k x_k, the scattered counts of `swarmsim.radiation.walls`, and the
share g that the ground adds (`swarmsim.radiation.ground`).
"""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from swarmsim.radiation.cylinder import NEAR_TABLES, direction_basis, near_ratio
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.lines import SPECTRUM_DEPTHS
from swarmsim.radiation.poisson import poisson
from swarmsim.radiation.walls import Scattered, scattered_counts
from swarmsim.site.rays import Crossed

Floats = NDArray[np.floating]

INDOORS = 0.1
"""Sine of the elevation at which, in the open, as much comes from the ground as out of a building with thick walls."""
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
    seen = unattenuated(detector, source, position_m, axis)
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
    return ground_and_slope(detector, nuclide, way, layers)[0]


def ground_and_slope(
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
    found = scattered_on(detector, nuclide, way)
    return jnp.exp(-found.slant), found.counts


def scattered_on(detector: Detector, nuclide: jax.Array, way: Crossed) -> Scattered:
    """What matter on a way does to each line [..., L] of a nuclide []: `swarmsim.radiation.walls.scattered_counts`."""
    tables = (detector.attenuation_1_m[nuclide], detector.scatter_1_m[nuclide], detector.line_energy_kev[nuclide])
    return scattered_counts(*tables, detector.surrounds, way)


def unattenuated(detector: Detector, source: Source, position_m: jax.Array, axis: jax.Array) -> jax.Array:
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
    activity, the crystal's position and the lengths. What `swarmsim.site.rays.crossed` says of the shape of a wall is
    constant to derivatives: behind thick walls a gradient by place through it lacks what scatters otherwise from
    elsewhere, up to two thirds of it; differences have all of it.
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


def shown(rate_cps: Floats | float, paralyzable_s: float, non_paralyzable_s: float) -> Floats:
    """Rate that is registered of true ones [...], by the law of `registered_share`, in float64 (host)."""
    rate = np.asarray(rate_cps, float)
    return np.asarray(rate * np.exp(-rate * paralyzable_s) / (1.0 + rate * non_paralyzable_s))


def highest_rate(detector: Detector) -> float:
    """Largest rate that the detector can show; inf without dead time (host)."""
    return most_shown(float(detector.paralyzable_s), float(detector.non_paralyzable_s))


def most_shown(paralyzable_s: float, non_paralyzable_s: float) -> float:
    """`highest_rate` of a detector with these dead times."""
    if paralyzable_s <= 0.0:
        return np.inf if non_paralyzable_s <= 0.0 else 1.0 / non_paralyzable_s
    return float(shown(saturating_rate(paralyzable_s, non_paralyzable_s), paralyzable_s, non_paralyzable_s))


def saturating_rate(paralyzable_s: float, non_paralyzable_s: float) -> float:
    """True rate at which a detector with these dead times shows most; inf where more always shows as more (host)."""
    if paralyzable_s <= 0.0:
        return np.inf
    # the derivative of log m vanishes where n t_p (1 + n t_n) = 1
    a, b = paralyzable_s * non_paralyzable_s, paralyzable_s
    return float(1.0 / b if a == 0.0 else (-b + np.sqrt(b * b + 4.0 * a)) / (2.0 * a))


def rate_showing(detector: Detector, share: float) -> float:
    """Lowest true rate at which a detector shows ``share`` (0..1) of its `highest_rate`; inf without dead time (host).

    Beyond it a change of the rate hardly shows.
    """
    paralyzable, non_paralyzable = float(detector.paralyzable_s), float(detector.non_paralyzable_s)
    if paralyzable <= 0.0 and non_paralyzable <= 0.0:
        return np.inf
    wanted = share * highest_rate(detector)
    if paralyzable <= 0.0:
        return wanted / (1.0 - wanted * non_paralyzable)

    most = saturating_rate(paralyzable, non_paralyzable)
    return float(brentq(lambda rate: shown(rate, paralyzable, non_paralyzable) - wanted, 0.0, most))


def exposure_of(detector: Detector, period_s: jax.Array | float) -> jax.Array:
    """Exposure [] in s that the counts of a measurement over ``period_s`` [] stand for: real time, dead time included.

    ``physical``: the period. ``paper_ideal``: as of the Gazebo plugin, whose every message represents one second
    whatever the message rate.
    """
    return jnp.asarray(period_s if detector.kind == "physical" else 1.0, jnp.float32)


def draw_counts(
    detector: Detector, key: jax.Array, mean_observed_cps: jax.Array, period_s: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Counts [...] of one measurement and the exposure [] in s that they represent: Poisson(rate x exposure).

    Dead time is in the rate and not in the scatter: counts after it scatter less than Poisson's, by (1 + rate tau)^-2
    of the variance for a counter that it does not paralyse (Mueller, Nucl. Instrum. Methods 117, 1974, 401), which is
    half of it at three tenths of the highest rate.
    """
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
