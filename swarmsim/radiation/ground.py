"""Photons that the ground scatters to a detector: the table of a Monte Carlo, and its fit for the device (host side).

``configs/elements/ground.csv`` holds the scattered photons above an even half space of soil over those of the bare
source, in bins of energy, for photons of 35 to 2600 keV (``experiments/transport/ground.py``). The free path in soil is
short against the heights, so that only ratios matter. The ground shines like the source's mirror image below it: with
the distance r of source and detector, r' that of the image and the sine u of its elevation, scattered over bare counts
are within a few per cent of the total

    (r / r')^2 (a sqrt(u) + b u)

with a and b for each line and detector. As (r / r')^2 and u, the ratio is symmetric in source and detector. In a
building it is another (`swarmsim.radiation.rate.from_ground`).
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.files import packaged_dir
from swarmsim.radiation.scattering import BINS, bin_energies

Floats = NDArray[np.float64]

SOURCE_M = 1.0
"""Height of the source of the table above the ground."""


@lru_cache(maxsize=1)
def _table() -> tuple[Floats, Floats, Floats]:
    """Energies [e], the basis [views, 2], photons [e, views, BINS]."""
    text = (packaged_dir() / "elements" / "ground.csv").read_text(encoding="utf-8")
    rows = np.array([[float(x) for x in line.split(",")] for line in text.splitlines() if line[:1].isdigit()])
    energy = np.unique(rows[:, 0])
    photons = rows[:, 3:].reshape(len(energy), -1, BINS)
    height, apart = rows[: photons.shape[1], 1], rows[: photons.shape[1], 2]
    return energy, basis(SOURCE_M, height, apart), photons


def basis(source_m: float, height_m: Floats, apart_m: Floats) -> Floats:
    """(r / r')^2 (sqrt(u), u) [..., 2] for heights above the ground and level distances [...]; see `crossed`."""
    image2 = np.square(apart_m) + np.square(height_m + source_m)
    u = (height_m + source_m) / np.sqrt(image2)
    ratio = (np.square(apart_m) + np.square(height_m - source_m)) / image2
    return np.stack([ratio * np.sqrt(u), ratio * u], axis=-1)


def from_ground(energy_kev: Floats, counted: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
    """Coefficients [k, 2] of the counts for lines ``energy_kev`` [k], and those counts by energy [k, BINS].

    ``counted`` gives counts per photon, up to a factor, for energies [...]. The latter are for all views together.
    """
    energies, views, photons = _table()
    place = np.interp(np.log(energy_kev), np.log(energies), np.arange(len(energies)))
    row = np.minimum(place.astype(int), len(energies) - 2)
    part = (place - row)[:, None, None]
    between = (1.0 - part) * photons[row] + part * photons[row + 1]  # [k, views, BINS]
    counts = between * (counted(bin_energies(energy_kev)) / counted(energy_kev)[:, None])[:, None]
    total = counts.sum(axis=-1)
    found = np.zeros((len(energy_kev), views.shape[1]))
    for k, each in enumerate(total):
        weight = 1.0 / (1.0 + each)  # errors matter as far as the ground's photons make up the total
        found[k] = np.linalg.lstsq(views * weight[:, None], each * weight, rcond=None)[0]
    return found, counts.sum(axis=1)
