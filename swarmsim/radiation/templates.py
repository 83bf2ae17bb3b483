"""Template spectra for identification: background, shielded nuclides and single lines, at any gain and resolution.

A gain g records the pulses of channel e in channel g e. The resolution changes as by heat conduction: a peak of
variance v(E) is the pulse heights after diffusion, and dS/dv is half the second derivative, so that a relative width
rho adds t A S + t^2 A^2 S / 2 with A S = d2(v S)/dE2 and t = (rho^2 - 1) / 2. This narrows as well as it broadens.
Spectra of lines and of scattered photons are tabulated by bins at some gains with these changes when a detector is
built (host side); what is left for the device is to add them up behind each shield.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim.radiation.detector import AIR, Detector
from swarmsim.radiation.lines import DEPTHS, GROUND, SHIELDS
from swarmsim.radiation.rate import end_on, from_ground, scattered_shares, transmission
from swarmsim.radiation.strangers import shield_count
from swarmsim.site.rays import Crossed, wide

AIR_M = (60.0,)
"""Lengths of the ways in air of the templates."""
_BARE_SHARE, _GROUND_SHARE, _AIR_SHARE = 0.2, 0.2, 0.1  # of the prior of the shields; all walls share the rest
_SEARCH_STEPS = 30


class Tables(NamedTuple):
    """Spectra in the bins of identification, by order of `swarmsim.radiation.lines.orders`: gain, and width."""

    background: jax.Array  # [gains, 2, orders, bins] as it is, sums to 1, and times `tilt`
    sources: jax.Array  # [N shields, gains, orders, bins] sum to 1
    scattered: jax.Array  # [N shields, gains, orders, bins] the part of scattered photons
    beside: jax.Array  # [N shields] int32, whose scattered photons another matter than that of each adds (`_beside`)
    lines: jax.Array  # [shields, grid, bins]


def shields(detector: Detector) -> list[tuple[int, float, float, float]]:
    """Material, optical depth, length of air and ground of every shield of the templates, bare first."""
    names = detector.material_names
    walls = [names.index(name) for name in SHIELDS if name in names] or [0]
    ground = [(walls[0], 0.0, 0.0, GROUND)] if detector.kind == "physical" else []
    air = [(walls[0], 0.0, length, 0.0) for length in AIR_M if AIR in names]
    return [(walls[0], 0.0, 0.0, 0.0), *ground, *air, *((wall, depth, 0.0, 0.0) for wall in walls for depth in DEPTHS)]


def shield_shares(detector: Detector) -> NDArray[np.float64]:
    """Prior [shields] of each shield."""
    wall, air, ground = (np.array(column) > 0.0 for column in list(zip(*shields(detector), strict=True))[1:])
    walls = 1.0 - _BARE_SHARE - _GROUND_SHARE - _AIR_SHARE
    share = walls * wall / wall.sum() + _AIR_SHARE * air / max(air.sum(), 1) + _GROUND_SHARE * ground
    share[0] = _BARE_SHARE
    return np.asarray(share / share.sum())


def stranger_shares(detector: Detector) -> NDArray[np.float64]:
    """Prior [shields] of each shield of `swarmsim.radiation.strangers`, which has no shield of air alone."""
    share = np.full(shield_count(detector.material_names), 1.0)
    share[2:] *= (1.0 - _BARE_SHARE - _GROUND_SHARE) / max(len(share) - 2, 1)
    share[:2] = _BARE_SHARE, _GROUND_SHARE
    return np.asarray(share / share.sum())


def tables(detector: Detector, view: jax.Array | None = None) -> Tables:
    """Spectra of every nuclide of a detector with energy resolution behind every shield, in a `mean_view`."""
    names, n = detector.material_names, len(detector.nuclide_names)
    is_air = jnp.array([name == AIR for name in names])

    def behind(number: jax.Array, layer: jax.Array) -> tuple[jax.Array, jax.Array]:
        wall = layer[0].astype(jnp.int32)
        thickness = thickness_m(detector, number, wall, layer[1], view)
        length_m = thickness * (jnp.arange(len(names)) == wall) + layer[2] * is_air
        return _counts(detector, number, length_m, 0.5, layer[3], view)

    layers = jnp.asarray(shields(detector), jnp.float32)
    direct, bins = jax.vmap(lambda k: jax.vmap(lambda layer: behind(k, layer))(layers))(jnp.arange(n))
    total = jnp.maximum(jnp.sum(direct, axis=-1) + jnp.sum(bins, axis=-1), 1e-30)[..., None]
    direct, bins = direct / total, bins / total
    size = detector.peak_orders.shape[2:]
    peaks = detector.peak_orders.reshape(*direct.shape[::2], -1)
    scattered = bins.reshape(n * len(layers), -1) @ detector.bin_orders.reshape(bins.shape[-1], -1)
    unscattered = jnp.einsum("nsl,nlx->nsx", direct, peaks).reshape(scattered.shape)

    return Tables(
        background=detector.natural_orders,
        sources=(unscattered + scattered).reshape(-1, *size),
        scattered=scattered.reshape(-1, *size),
        beside=(len(layers) * jnp.arange(n)[:, None] + _beside(detector)).reshape(-1),
        lines=detector.grid_spectrum,
    )


def _beside(detector: Detector) -> NDArray[np.intp]:
    """Which shield [shields] has what scatters besides: air where there is no wall, the ground elsewhere; or itself."""
    depth, air, ground = (np.array(column) for column in list(zip(*shields(detector), strict=True))[1:])
    own = np.arange(len(depth))
    of_air = np.argmax(air > 0.0) if np.any(air > 0.0) else own
    of_ground = np.argmax(ground > 0.0) if np.any(ground > 0.0) else own
    return np.where((depth > 0.0) | (air > 0.0), of_ground, of_air)


def _counts(
    detector: Detector,
    nuclide: jax.Array,
    length_m: jax.Array,
    place: jax.Array | float,
    above: jax.Array | float,
    view: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Counts of unscattered photons by line [L] and of scattered ones by bin, of a nuclide, up to one factor.

    The way crosses ``length_m`` [M] of each material, whose middle is at ``place`` [] between source (0) and detector.
    ``above`` [] is 1 where the ground shines as much as it can, 0 without a ground. ``view`` [5, NEAR_TABLES] is the
    `mean_view` of the crystal, by default end on.
    """
    places, ground = jnp.full(len(detector.material_names), place), jnp.full(2, above)
    way = Crossed(length_m=length_m, place=places, shape=wide(length_m, ground))
    lines = _bare_lines(detector, nuclide, view)
    direct, scattered = transmission(detector, nuclide, way)
    of_ground = (lines * (direct + scattered) * from_ground(detector, nuclide, way)) @ detector.ground_bins[nuclide]
    return lines * direct, (lines * scattered) @ scattered_shares(detector, nuclide, way) + of_ground


def shielded(
    detector: Detector,
    nuclide: jax.Array,
    length_m: jax.Array,
    place: jax.Array | float = 0.5,
    above: jax.Array | float = 0.0,
) -> jax.Array:
    """Spectrum [channels] of a nuclide end on behind ``length_m`` [M] of each material at ``place``, up to a factor.

    ``above`` [] is 1 where the ground shines as much as it can, 0 without a ground.
    """
    direct, bins = _counts(detector, nuclide, length_m, place, above)
    return direct @ detector.peak_spectrum[nuclide] + bins @ detector.bin_spectrum


def thickness_m(
    detector: Detector, nuclide: jax.Array, material: jax.Array, depth: jax.Array, view: jax.Array | None = None
) -> jax.Array:
    """Thickness [] of a material that reduces the counts of unscattered photons of a nuclide to exp(-depth)."""
    lines = _bare_lines(detector, nuclide, view)
    attenuation = detector.attenuation_1_m[nuclide, :, material]
    share = lines / jnp.maximum(jnp.sum(lines), 1e-30)

    def step(between: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], None]:
        low, high = between
        middle = 0.5 * (low + high)
        more = jnp.sum(share * jnp.exp(-attenuation * middle)) > jnp.exp(-depth)
        return (jnp.where(more, middle, low), jnp.where(more, high, middle)), None

    emitted = share > 0.0
    high = depth / jnp.maximum(jnp.min(jnp.where(emitted, attenuation, jnp.inf)), 1e-9)
    return jax.lax.scan(step, (jnp.zeros(()), high), None, length=_SEARCH_STEPS)[0][0]


def _bare_lines(detector: Detector, nuclide: jax.Array, view: jax.Array | None = None) -> jax.Array:
    """Counts [L] of each line without attenuation, up to a factor."""
    seen = detector.effective_area_m2[nuclide] @ (end_on() if view is None else view)  # [L, NEAR_TABLES]
    return detector.yields[nuclide] * jnp.sum(seen * detector.near_share[nuclide], axis=1)
