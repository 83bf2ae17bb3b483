"""Spectra of shielded nuclides as a detector whose gain, resolution and background have drifted would count them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.load import load_named
from swarmsim.config.radiation import Detector as DetectorSpec
from swarmsim.config.radiation import DetectorMount
from swarmsim.radiation import Detector, Library, build_detector
from swarmsim.radiation.detector import AIR
from swarmsim.radiation.lines import tilt
from swarmsim.radiation.templates import shielded, thickness_m

Floats = NDArray[np.float64]

MOUNT = DetectorMount(model="any", position_m=(0.0, 0.0, -0.1), axis=(0.0, 0.0, 2.0))
WALLS = ("aluminium", "brick", "concrete", "glass", "lead", "soil", "steel", "water", "wood")
PLACE = (0.1, 0.9)
"""Range of the place of a wall between source (0) and detector (1)."""
AIR_M = 30.0  # longest way in air
WIDTHS = (0.85, 0.92, 1.0, 1.08, 1.15)
GAIN = 0.03
TILTED = 0.1
BACKGROUND = 0.2  # half range of the background's amplitude
NET_SHARE = 0.5  # net rate over background rate


@dataclass(frozen=True)
class Cases:
    """Spectra and what they were drawn from; n cases."""

    counts: NDArray[np.float32]  # [n, channels]
    live_s: NDArray[np.float32]  # [n]
    nuclide: NDArray[np.int64]  # [n] index into the detector's names; -1 for background only


class Instrument:
    """A detector model with the versions of it that count: the same crystal at other resolutions."""

    def __init__(self, name: str, library: Library, walls: Sequence[str] = WALLS, ground: float = 0.0) -> None:
        spec = load_named("detectors", name)
        assert isinstance(spec, DetectorSpec)
        assert spec.spectrometer is not None
        self.detector = build_detector(spec, MOUNT, library, "physical")
        self._versions = []
        self._walls, self._ground = walls, ground
        for width in WIDTHS:
            percent = spec.spectrometer.resolution_percent_at_662_kev * width
            analyser = spec.spectrometer.model_copy(update={"resolution_percent_at_662_kev": percent})
            changed = spec.model_copy(update={"spectrometer": analyser})
            self._versions.append(build_detector(changed, MOUNT, library, "physical"))

    def draw(
        self, rng: np.random.Generator, nuclide: NDArray[np.int64], net: Floats, depth_max: float, drift: float = 1.0
    ) -> Cases:
        """Poisson spectra of ``nuclide`` [n] with ``net`` [n] counts on a background of twice the rate.

        Each is behind up to `AIR_M` of air and one of the walls anywhere on the way, of 0 to ``depth_max`` mean free
        paths, above a ground that shines between nothing and ``ground`` of the most that it can; ``drift`` scales the
        ranges of gain, resolution, and amplitude and tilt of the background.
        """
        mean = self.means(rng, nuclide, net, depth_max, drift)
        live = net / (NET_SHARE * float(self.detector.background_cps))
        return Cases(rng.poisson(mean).astype(np.float32), live.astype(np.float32), nuclide)

    def means(
        self, rng: np.random.Generator, nuclide: NDArray[np.int64], net: Floats, depth_max: float, drift: float = 1.0
    ) -> Floats:
        """Expected counts [n, channels] of such spectra."""
        n = len(nuclide)
        version = rng.integers(len(WIDTHS), size=n) if drift > 0.0 else np.full(n, WIDTHS.index(1.0))
        walls = np.array([self.detector.material_names.index(s) for s in self._walls])
        way = np.stack(
            [
                walls[rng.integers(len(walls), size=n)],
                rng.uniform(0.0, depth_max, n),
                rng.uniform(*PLACE, n),
                rng.uniform(0.0, AIR_M, n),
                rng.uniform(0.0, self._ground, n),
            ],
            axis=1,
        )
        gain = 1.0 + drift * GAIN * rng.uniform(-1.0, 1.0, n)
        slope = drift * TILTED * rng.uniform(-1.0, 1.0, n)
        amplitude = 1.0 + drift * BACKGROUND * rng.uniform(-1.0, 1.0, n)
        live = net / (NET_SHARE * float(self.detector.background_cps))
        mean = np.zeros((n, len(self.detector.energy_kev)))
        for number, detector in enumerate(self._versions):
            rows = version == number
            source = _sources(detector, nuclide[rows], way[rows]) * (nuclide[rows] >= 0)[:, None]
            natural = np.asarray(detector.background_spectrum, np.float64)
            tilted = natural * (1.0 + slope[rows, None] * np.asarray(tilt(np.asarray(detector.energy_kev, np.float64))))
            mean[rows] = net[rows, None] * source + (live * amplitude)[rows, None] * tilted
        moved = np.stack([_moved(row, g) for row, g in zip(mean, gain, strict=True)])
        moved[:, : self.detector.identification_bins[0]] = 0.0
        return moved


def _moved(mean: Floats, gain: float) -> Floats:
    """Counts per channel after a change of gain."""
    below = np.concatenate([[0.0], np.cumsum(mean)])
    channel = np.arange(len(below))
    return np.diff(np.interp(channel / gain, channel, below))


def _sources(detector: Detector, nuclide: NDArray[np.int64], way: Floats) -> Floats:
    """Spectra [n, channels] that sum to 1, in batches of one size so that one program does for all.

    ``way`` [n, 5]: number of the wall's material, its mean free paths, its place, metres of air, and the ground.
    """
    size = 256
    padded = -(-max(len(nuclide), 1) // size) * size
    numbers = np.resize(np.maximum(nuclide, 0), padded).reshape(-1, size)
    ways = np.resize(way, (padded, 5)).astype(np.float32).reshape(-1, size, 5)
    parts = [_shielded(detector, jnp.asarray(n), jnp.asarray(w)) for n, w in zip(numbers, ways, strict=True)]
    found = np.concatenate(parts)[: len(nuclide)].astype(np.float64)
    return np.asarray(found / found.sum(axis=1, keepdims=True))


@jax.jit
def _shielded(detector: Detector, nuclide: jax.Array, way: jax.Array) -> jax.Array:
    names = detector.material_names

    def one(nuclide: jax.Array, way: jax.Array) -> jax.Array:
        wall = way[0].astype(jnp.int32)
        lengths = thickness_m(detector, nuclide, wall, way[1]) * (jnp.arange(len(names)) == wall)
        lengths += way[3] * (jnp.arange(len(names)) == names.index(AIR))
        return shielded(detector, nuclide, lengths, way[2], way[4])

    return jax.lax.map(lambda row: one(*row), (nuclide, way))


def without(detector: Detector, nuclide: int) -> Detector:
    """The detector without the tables of one nuclide; one compiled program does for all that are left out.

    As `restrict`, but lines keep their padding and the names are those of the first ones, whatever is left out.
    """
    tables = [
        *("yields", "effective_area_m2", "near_share", "attenuation_1_m"),
        *("scatter_1_m", "peak_spectrum", "scattered_bins", "line_energy_kev", "peak_orders"),
        *("ground", "ground_bins", "ground_rois"),
    ]
    stranger = jnp.asarray(detector.stranger).at[nuclide].set(1.0)
    left: dict[str, Any] = {name: jnp.delete(getattr(detector, name), nuclide, axis=0) for name in tables}
    return replace(detector, nuclide_names=detector.nuclide_names[:-1], stranger=stranger, **left)
