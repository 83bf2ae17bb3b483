"""The elements' photon cross sections and K shells, read from ``configs/elements`` (host side)."""

import csv
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from swarmsim.config.files import packaged_dir

Floats = NDArray[np.float64]

ELECTRON_KEV = 510.99895
"""Rest energy of the electron, CODATA 2018."""
AVOGADRO_PER_BARN = 0.602214076
"""Avogadro's number times one barn [cm2/mol]."""
CUT_KEV = 30.0
"""Photons of less energy are not followed."""
ENERGY_RANGE_KEV = (20.0, 10_000.0)
"""Range of the table of cross sections."""


@dataclass(frozen=True)
class KShell:
    """The K shell of an element: fluorescence after photoelectric absorption above the edge."""

    edge_kev: float
    share: float  # of the photoelectric absorption above the edge
    fluorescence_yield: float
    alpha_kev: float
    beta_kev: float
    alpha_share: float  # of the K photons

    @property
    def photons(self) -> float:
        """K photons per photoelectric absorption above the edge."""
        return self.share * self.fluorescence_yield


@dataclass(frozen=True)
class Element:
    """Cross sections of one element, in barn per atom, at the energies of its table."""

    number: int
    symbol: str
    atomic_weight: float  # g/mol
    energy_kev: Floats  # [e]; an energy given twice is an absorption edge
    coherent_b: Floats  # [e]
    incoherent_b: Floats  # [e]
    photoelectric_b: Floats  # [e]
    pair_b: Floats  # [e] in the field of the nucleus and of the electrons
    k_shell: KShell | None  # None where the edge lies below the table

    def at(self, energy_kev: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Coherent, incoherent, photoelectric and pair cross sections [e] in barn at energies [e] within the table.

        Scattering and pair production by cubic splines as XCOM has them (Berger and Hubbell, NBSIR 87-3597),
        photoelectric absorption log-log between the points, on the right side of its edges.
        """
        x = np.log(energy_kev)
        smooth, first = np.unique(self.energy_kev, return_index=True)
        log_smooth = np.log(smooth)
        coherent, incoherent = (
            np.exp(CubicSpline(log_smooth, np.log(values[first]))(x)) for values in (self.coherent_b, self.incoherent_b)
        )
        photoelectric = np.exp(np.interp(x, np.log(self.energy_kev), np.log(self.photoelectric_b)))
        threshold = 2.0 * ELECTRON_KEV
        above = (smooth > threshold + 1.0) & (self.pair_b[first] > 0.0)
        excess = np.clip(1.0 - threshold / np.maximum(energy_kev, 1.0), 0.0, None)
        scaled = np.log(self.pair_b[first][above] / (1.0 - threshold / smooth[above]) ** 3)
        inside = np.clip(x, log_smooth[above][0], log_smooth[above][-1])
        pair = np.exp(CubicSpline(log_smooth[above], scaled)(inside)) * excess**3
        return coherent, incoherent, photoelectric, pair


@lru_cache(maxsize=1)
def elements() -> dict[str, Element]:
    """Every element by its symbol, in the order of the atomic numbers."""
    folder = packaged_dir() / "elements"
    rows = np.loadtxt(folder / "cross_sections.csv", delimiter=",", skiprows=3, comments="#")
    tables = {int(z): np.array(list(group)) for z, group in groupby(rows, key=lambda row: row[0])}
    lines = [line for line in (folder / "elements.csv").read_text().splitlines() if not line.startswith("#")]
    return {row["symbol"]: _element(row, tables[int(row["z"])]) for row in csv.DictReader(lines)}


def _element(row: dict[str, Any], table: Floats) -> Element:
    shell = None
    if row["k_edge_kev"]:
        names = ("k_edge_kev", "k_share", "k_yield", "k_alpha_kev", "k_beta_kev", "k_alpha_share")
        shell = KShell(*(float(row[name]) for name in names))
    energy, coherent, incoherent, photoelectric, pair = table[:, 1:].T
    return Element(
        number=int(row["z"]),
        symbol=row["symbol"],
        atomic_weight=float(row["atomic_weight"]),
        energy_kev=energy,
        coherent_b=coherent,
        incoherent_b=incoherent,
        photoelectric_b=photoelectric,
        pair_b=pair,
        k_shell=shell,
    )
