"""Photons scattered between source and detector: tables of a Monte Carlo, and their fit for the device (host side).

``configs/elements/scattering.csv`` holds, for five materials from water to lead and for photons of 35 to 2600 keV, the
scattered photons behind a slab over those of the bare source, in bins of energy, for slabs of 0.05 to 15 mean free
paths near the source and half way to the detector; and the same in an infinite medium of air
(``experiments/transport``). Any other material lies between two of them by its photoelectric absorption: the idea of
the equivalent atomic number of ANSI/ANS-6.4.3.

The device evaluates, for each line, log(scattered counts / counts of the bare source) = log t - t + c0 + c1 t +
c2 log(1 + t / 0.2) + c3 log(1 + t / 3), t the optical depth: within 3 % of the table's total up to 8 mean free paths.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.files import packaged_dir
from swarmsim.config.radiation import Material
from swarmsim.radiation.attenuation import coefficients, linear_attenuation
from swarmsim.radiation.elements import CUT_KEV
from swarmsim.site.model import SURROUNDING_KG_M3

Floats = NDArray[np.float64]

BINS = 8
"""Bins of the scattered photons, of equal width in ln(energy) from `CUT_KEV` to the line."""
POSITIONS = (0.1, 0.5)
"""Places of a wall between source and detector with coefficients of their own: near the source, half way and beyond."""
COEFFICIENTS = 4
DEPTH_SCALES = (0.2, 3.0)
DEPTH_MAX = 15.0
"""Mean free paths up to which the tables reach; deeper, the build-up stays as it is there."""
_AIR = "air"
_WALLS = ("water", "concrete", "steel", "tin", "lead")
_REFERENCE_KEV = 100.0


@dataclass(frozen=True)
class _Table:
    absorption: float  # photoelectric over incoherent cross section at `_REFERENCE_KEV`
    energy_kev: Floats  # [e]
    depth: Floats  # [d]
    photons: Floats  # [e, d, positions, BINS]


@dataclass(frozen=True)
class Transport:
    """What a counter's lines meet in each material (M), for the k energies that differ among the lines."""

    energy_kev: Floats  # [k]
    row: NDArray[np.intp]  # [N, L] of each line
    attenuation_1_m: Floats  # [k, M]
    scatter_1_m: Floats  # [k, positions, COEFFICIENTS, M] attenuation times coefficients of scattered counts
    counts: Floats  # [k, M, d, positions, BINS] scattered counts over those of the bare source


@lru_cache(maxsize=1)
def _tables() -> dict[str, _Table]:
    file = packaged_dir() / "elements" / "scattering.csv"
    rows = [line.split(",") for line in file.read_text(encoding="utf-8").splitlines() if not line.startswith("#")][1:]
    found = {}
    for name, group in groupby(rows, key=lambda row: row[0]):
        values = np.array([[float(x) for x in row[1:]] for row in group])
        energy, depth = np.unique(values[:, 1]), np.unique(values[:, 2])
        photons = values[:, 4:].reshape(len(energy), len(depth), -1, BINS)
        found[name] = _Table(values[0, 0], energy, depth, photons)
    return found


def absorption(material: Material) -> float:
    """Photoelectric over incoherent cross section at 100 keV, by which materials are compared."""
    parts = coefficients(material, np.array([_REFERENCE_KEV]))
    return float(parts.photoelectric[0] / parts.incoherent[0])


def _neighbours(material: Material) -> list[tuple[str, float]]:
    """The tables that a material lies between, and their weights."""
    if material.density_kg_m3 < SURROUNDING_KG_M3:
        return [(_AIR, 1.0)]
    places = np.log([_tables()[name].absorption for name in _WALLS])
    own = np.clip(np.log(absorption(material)), places[0], places[-1])
    upper = int(np.clip(np.searchsorted(places, own), 1, len(places) - 1))
    part = float((own - places[upper - 1]) / (places[upper] - places[upper - 1]))
    return [(_WALLS[upper - 1], 1.0 - part), (_WALLS[upper], part)]


def bin_energies(energy_kev: Floats) -> Floats:
    """Middles [..., BINS] in keV of the bins of photons of ``energy_kev`` [...], geometric."""
    middle = (np.arange(BINS) + 0.5) / BINS
    ratio = np.maximum(np.asarray(energy_kev)[..., None], 1.001 * CUT_KEV) / CUT_KEV
    return np.asarray(CUT_KEV * ratio**middle)


def depths() -> Floats:
    """Depths [d] of the tables in mean free paths."""
    return _tables()[_AIR].depth


def scattered_photons(material: Material, energy_kev: Floats) -> Floats:
    """Scattered photons over those of the bare source [k, d, positions, BINS] for lines ``energy_kev`` [k].

    Linear in ln(energy) between the tables' energies, constant beyond them; d are `depths`, positions `POSITIONS`.
    """
    energy = np.asarray(energy_kev, np.float64)
    total = np.zeros((len(energy), len(depths()), len(POSITIONS), BINS))
    for name, weight in _neighbours(material):
        table = _tables()[name]
        place = np.interp(np.log(energy), np.log(table.energy_kev), np.arange(len(table.energy_kev)))
        row = np.minimum(place.astype(int), len(table.energy_kev) - 2)
        part = (place - row)[:, None, None, None]
        # the third position of the walls' tables, near the detector, equals the second within its statistics
        photons = table.photons[:, :, : len(POSITIONS)]
        total += weight * ((1 - part) * photons[row] + part * photons[row + 1])
    return total


def transport(
    materials: Sequence[Material], energy_kev: Floats, counted: Callable[[Floats], Floats] | None
) -> Transport:
    """Tables of the lines ``energy_kev`` [N, L] behind each of ``materials``.

    ``counted`` gives counts per photon, up to a factor, for energies [...]; with None no scattered photon counts.
    Raises `InputError` for a line outside the table of cross sections.
    """
    flat, row = np.unique(energy_kev, return_inverse=True)
    attenuation = np.stack([linear_attenuation(material, flat) for material in materials], axis=1)
    shape = (len(flat), len(POSITIONS), COEFFICIENTS, len(materials))
    scatter, counts = np.zeros(shape), np.zeros((len(flat), len(materials), len(depths()), len(POSITIONS), BINS))
    if counted is not None:
        weight = counted(bin_energies(flat)) / counted(flat)[:, None]
        for m, material in enumerate(materials):
            counts[:, m] = scattered_photons(material, flat) * weight[:, None, None, :]
            scatter[..., m] = fitted(counts[:, m].sum(axis=-1)) * attenuation[:, m, None, None]
    return Transport(flat, row.reshape(energy_kev.shape), attenuation, scatter, counts)


def fitted(scattered: Floats) -> Floats:
    """Coefficients [k, positions, COEFFICIENTS] of the scattered counts ``scattered`` [k, d, positions]."""
    t = depths()
    design = np.stack([np.ones_like(t), t, *(np.log1p(t / scale) for scale in DEPTH_SCALES)], axis=1)
    found = np.zeros((scattered.shape[0], scattered.shape[2], COEFFICIENTS))
    for k, p in np.ndindex(found.shape[:2]):
        counts = np.maximum(scattered[k, :, p], 1e-30)
        # errors matter as far as scattered photons make up the total; the deepest slabs are known least well
        weight = np.maximum(counts / (counts + np.exp(-t)), 0.05) * np.where(t > 8.0, 0.4, 1.0)
        target = np.log(counts / t) + t
        found[k, p] = np.linalg.lstsq(design * weight[:, None], target * weight, rcond=None)[0]
    return found


def evaluated(coefficient: Floats, depth: Floats) -> Floats:
    """Scattered counts over those of the bare source [...] for ``coefficient`` [..., COEFFICIENTS] and depth [...]."""
    t = np.minimum(depth, DEPTH_MAX)
    c = np.moveaxis(coefficient, -1, 0)
    growth = c[0] + c[1] * t + c[2] * np.log1p(t / DEPTH_SCALES[0]) + c[3] * np.log1p(t / DEPTH_SCALES[1])
    return np.asarray(depth * np.exp(growth - depth))
