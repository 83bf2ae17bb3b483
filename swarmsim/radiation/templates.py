"""Template spectra for identification: background, shielded nuclides and single lines, at any gain and resolution.

A gain g records the pulses of channel e in channel g e. The resolution changes as by heat conduction: a peak of
variance v(E) is the pulse heights after diffusion, and dS/dv is half the second derivative, so that a relative width
rho adds t A S + t^2 A^2 S / 2 with A S = d2(v S)/dE2 and t = (rho^2 - 1) / 2. This narrows as well as it broadens.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.radiation.cylinder import direction_basis
from swarmsim.radiation.detector import AIR, Detector
from swarmsim.radiation.rate import from_ground, scattered_shares, transmission
from swarmsim.site.rays import Crossed, Shape

SHIELDS = ("concrete", "steel", "lead")
DEPTHS = (0.3, 1.3, 4.0)
"""Optical depths of the shields of the templates; sums of them and of the bare spectrum cover 0 to 4. The least stops
the X-rays and little else."""
AIR_M = (30.0, 100.0)
"""Lengths of the ways in air of the templates; the longest is also that of templates behind the deepest shields."""
TILT = 0.2
"""Relative change of the background's shape at both ends of the energies in its two templates."""
NATURAL = 2
"""Templates of the background."""
_TILT_KEV = (30.0, 3000.0)
_SEARCH_STEPS = 40


class Templates(NamedTuple):
    """Templates by channel; each sums to 1 above the threshold."""

    background: jax.Array  # [2, channels] tilted down and up
    nuclides: jax.Array  # [N, shields, channels] bare first
    lines: jax.Array  # [grid, channels] free lines


def templates(detector: Detector) -> Templates:
    """Templates of every nuclide of a detector with energy resolution."""
    names = detector.material_names
    walls = [names.index(name) for name in SHIELDS if name in names] or [0]
    layers = [(wall, depth, 0.0, 0.0) for wall in walls for depth in DEPTHS] + [(walls[0], 0.0, 0.0, 1.0)]
    if AIR in names:
        layers += [(walls[0], 0.0, length, 0.0) for length in AIR_M]
        layers += [(wall, DEPTHS[-1], AIR_M[-1], 0.0) for wall in walls]
    is_air = jnp.array([name == AIR for name in names])

    def of_nuclide(number: jax.Array) -> jax.Array:
        def behind(layer: jax.Array) -> jax.Array:
            wall = layer[0].astype(jnp.int32)
            thickness = thickness_m(detector, number, wall, layer[1])
            length_m = thickness * (jnp.arange(len(names)) == wall) + layer[2] * is_air
            return shielded(detector, number, length_m, layer[3])

        return jax.lax.map(behind, jnp.asarray([(walls[0], 0.0, 0.0, 0.0), *layers], jnp.float32))

    slope = TILT * tilt(detector.energy_kev)
    background = detector.background_spectrum * jnp.stack([1.0 - slope, 1.0 + slope])
    nuclides = jax.lax.map(of_nuclide, jnp.arange(len(detector.nuclide_names)))
    return Templates(*map(_normalised, (background, nuclides, detector.grid_spectrum)))


def tilt(energy_kev: jax.Array) -> jax.Array:
    """A slope over energies [...]: linear in their logarithm, -1 at 30 keV, 1 at 3 MeV."""
    low, high = np.log(_TILT_KEV)
    return jnp.clip((2.0 * jnp.log(energy_kev) - low - high) / (high - low), -1.0, 1.0)


def shielded(detector: Detector, nuclide: jax.Array, length_m: jax.Array, above: jax.Array) -> jax.Array:
    """Spectrum [channels] of a nuclide end on behind ``length_m`` [M] of each material half way, up to a factor.

    ``above`` [] is 1 for a source on the ground that is seen from above, 0 without a ground.
    """
    shape = Shape(thin_m=length_m, spread=jnp.ones(()), closed=jnp.zeros(()), ground=jnp.stack([above, above]))
    way = Crossed(length_m=length_m, place=jnp.full(len(detector.material_names), 0.5), shape=shape)
    lines = _bare_lines(detector, nuclide)
    direct, scattered = transmission(detector, nuclide, way)
    of_ground = (lines * (direct + scattered) * from_ground(detector, nuclide, way)) @ detector.ground_bins[nuclide]
    bins = (lines * scattered) @ scattered_shares(detector, nuclide, way) + of_ground
    return (lines * direct) @ detector.peak_spectrum[nuclide] + bins @ detector.bin_spectrum


def thickness_m(detector: Detector, nuclide: jax.Array, material: jax.Array, depth: jax.Array) -> jax.Array:
    """Thickness [] of a material that reduces the counts of unscattered photons of a nuclide to exp(-depth)."""
    lines = _bare_lines(detector, nuclide)
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


def _bare_lines(detector: Detector, nuclide: jax.Array) -> jax.Array:
    """Counts [L] of each line without attenuation, end on, up to a factor."""
    end_on = direction_basis(jnp.float32(1.0), jnp.float32(0.0))
    return detector.yields[nuclide] * (detector.effective_area_m2[nuclide] @ end_on)


def _normalised(spectra: jax.Array) -> jax.Array:
    return spectra / jnp.maximum(jnp.sum(spectra, axis=-1, keepdims=True), 1e-30)


def widened(detector: Detector, spectra: jax.Array, width: jax.Array) -> jax.Array:
    """Spectra [..., channels] with the resolution's width times ``width`` []."""
    first = detector.identification_bins[0]
    variance = (detector.sigma_kev / (detector.energy_kev[1] - detector.energy_kev[0])) ** 2

    def conduct(values: jax.Array) -> jax.Array:
        flow = jnp.diff((variance * values)[..., first:], axis=-1)
        # nothing flows over the threshold or the end
        change = jnp.diff(jnp.pad(flow, [(0, 0)] * (flow.ndim - 1) + [(1, 1)]), axis=-1)
        return jnp.pad(change, [(0, 0)] * (flow.ndim - 1) + [(first, 0)])

    time = 0.5 * (width**2 - 1.0)
    once = conduct(spectra)
    return jnp.maximum(spectra + time * once + 0.5 * time**2 * conduct(once), 0.0)


def rebinned(detector: Detector, spectra: jax.Array, gain: jax.Array, edges: np.ndarray) -> jax.Array:
    """Counts [..., bins] of spectra [..., channels] between ``edges`` [bins + 1] (channels) at a gain [].

    Below the threshold, where the tables hold nothing, they go on as in the first channel above it.
    """
    first = detector.identification_bins[0]
    filled = jnp.where(jnp.arange(spectra.shape[-1]) < first, spectra[..., first : first + 1], spectra)
    below = jnp.pad(jnp.cumsum(filled, axis=-1), [(0, 0)] * (spectra.ndim - 1) + [(1, 0)])
    place = jnp.clip(edges / gain, 0.0, spectra.shape[-1])
    left = jnp.minimum(place.astype(jnp.int32), spectra.shape[-1] - 1)
    at_edges = below[..., left] + (place - left) * filled[..., left]
    return jnp.diff(at_edges, axis=-1)
