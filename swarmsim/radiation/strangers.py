"""Spectra of nuclides that are not looked for: what else a measured spectrum may be of (host side).

``configs/elements/others.csv`` lists the lines of gamma emitters beyond the library. Spectra behind walls are put
together from those of single lines on the grid of energies, so that a hundred nuclides take no longer than ten.
"""

import csv
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.files import packaged_dir
from swarmsim.config.radiation import Line, Material, Nuclide
from swarmsim.radiation import scattering
from swarmsim.radiation.attenuation import linear_attenuation
from swarmsim.radiation.ground import from_ground
from swarmsim.radiation.lines import (
    DEPTHS,
    GAINS,
    GROUND,
    SHIELDS,
    identification_bins,
    in_spectrum_bins,
    line_grid,
    rebinned,
    spectrum_edges,
)
from swarmsim.radiation.response import Response, line_spectra, normalised

Floats = NDArray[np.float64]

_SEARCH_STEPS = 30


class Spectra(NamedTuple):
    """Spectra of K nuclides behind S shields: bare, above the ground, and `SHIELDS` of all `DEPTHS`."""

    total: Floats  # [K S, GAINS, bins] sum to 1 over all channels
    scattered: Floats  # [K S, bins] the part of scattered photons, at the nominal gain


@lru_cache(maxsize=1)
def other_nuclides() -> tuple[Nuclide, ...]:
    """The nuclides of ``configs/elements/others.csv``, sorted by name."""
    file = packaged_dir() / "elements" / "others.csv"
    lines = [line for line in file.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    half_life, found = dict[str, float](), dict[str, list[Line]]()
    for row in csv.DictReader(lines):
        half_life[row["nuclide"]] = float(row["half_life_s"])
        line = Line(energy_kev=float(row["energy_kev"]), yield_percent=float(row["yield_percent"]))
        found.setdefault(row["nuclide"], []).append(line)
    return tuple(
        Nuclide(name=name, half_life_s=half_life[name], lines=tuple(found[name]), source=file.name)
        for name in sorted(found)
    )


def others_than(names: Sequence[str]) -> tuple[Nuclide, ...]:
    """The nuclides of the list but those of ``names``."""
    return tuple(nuclide for nuclide in other_nuclides() if nuclide.name not in names)


def shield_count(materials: Sequence[str]) -> int:
    """How many shields there are where ``materials`` are known."""
    return 2 + len(DEPTHS) * len([name for name in SHIELDS if name in materials])


def spectra_of(
    response: Response,
    nuclides: Sequence[Nuclide],
    materials: Sequence[Material],
    counted: Callable[[Floats], Floats] | None,
) -> Spectra:
    """Spectra of ``nuclides`` behind every shield.

    ``counted`` gives the counts per photon that comes from around, up to a factor; with None no scattered photon does.
    """
    grid, lines = _finer(line_grid(response)), _lines(nuclides, counted)
    walls = [material for name in SHIELDS for material in materials if material.name == name]
    depth = _depths(lines, walls)  # [lines, S]
    direct = lines.counts[:, None] * np.exp(-depth)
    scattered = _scattered(lines, depth, walls, counted)  # [K, S, SPECTRUM_BINS]
    whole = lines.of_nuclide(direct) + scattered.sum(axis=-1)  # [K, S]
    in_bins = (scattered / whole[..., None]).reshape(-1, scattered.shape[-1])
    edges, energy = np.asarray(identification_bins(response)), spectrum_edges()
    bare = rebinned(response, normalised(line_spectra(response, grid)), 1.0, edges)
    of_bins = normalised(line_spectra(response, np.sqrt(energy[1:] * energy[:-1])))

    def at(gain: float) -> Floats:
        # a change of gain moves a line along the grid
        share = _shares(lines.energy_kev * gain, grid)
        peaks = lines.of_nuclide(direct[..., None] * share[:, None]) / whole[..., None]
        return np.asarray(peaks.reshape(len(in_bins), -1) @ bare + in_bins @ rebinned(response, of_bins, gain, edges))

    return Spectra(np.stack([at(gain) for gain in GAINS], axis=1), in_bins @ rebinned(response, of_bins, 1.0, edges))


class _Lines(NamedTuple):
    """All lines of K nuclides, one nuclide after the other."""

    energy_kev: Floats  # [lines]
    counts: Floats  # [lines] bare, those of a nuclide sum to 1
    first: NDArray[np.intp]  # [K]

    def of_nuclide(self, values: Floats) -> Floats:
        """Sums [K, ...] of ``values`` [lines, ...] over the lines of each nuclide."""
        return np.asarray(np.add.reduceat(values, self.first, axis=0))


def _lines(nuclides: Sequence[Nuclide], counted: Callable[[Floats], Floats] | None) -> _Lines:
    number = np.array([len(nuclide.lines) for nuclide in nuclides])
    energy = np.array([line.energy_kev for nuclide in nuclides for line in nuclide.lines])
    counts = np.array([line.yield_percent for nuclide in nuclides for line in nuclide.lines])
    counts = counts * (1.0 if counted is None else np.maximum(counted(energy), 1e-12))
    lines = _Lines(energy, counts, np.cumsum(number) - number)
    return lines._replace(counts=counts / np.repeat(lines.of_nuclide(counts), number))


def _finer(grid: Floats) -> Floats:
    """A grid with a point between each two of ``grid``: half a FWHM apart, two lines for one would be 16 % wider."""
    root = np.sqrt(grid)
    return np.asarray(np.interp(np.arange(2 * len(root) - 1) / 2.0, np.arange(len(root)), root) ** 2)


def _shares(energy: Floats, grid: Floats) -> Floats:
    """Weights [n, grid] of the two neighbours of each energy; the grid is even in the root of the energy."""
    place = np.interp(np.sqrt(energy), np.sqrt(grid), np.arange(len(grid), dtype=float))
    return np.asarray(np.maximum(1.0 - np.abs(place[:, None] - np.arange(len(grid))), 0.0))


def _depths(lines: _Lines, walls: Sequence[Material]) -> Floats:
    """Optical depths [lines, S] of the shields: 0 without a wall, or what leaves exp(-`DEPTHS`) of all counts."""
    number = np.diff(np.append(lines.first, len(lines.counts)))
    wanted, found = np.exp(-np.array(DEPTHS)), [np.zeros((len(lines.counts), 2))]
    for wall in walls:
        attenuation = linear_attenuation(wall, lines.energy_kev)[:, None]
        low = np.zeros((len(number), len(DEPTHS)))
        high = np.array(DEPTHS) / np.minimum.reduceat(attenuation, lines.first)
        for _ in range(_SEARCH_STEPS):
            middle = 0.5 * (low + high)
            left = lines.counts[:, None] * np.exp(-attenuation * np.repeat(middle, number, axis=0))
            more = lines.of_nuclide(left) > wanted
            low, high = np.where(more, middle, low), np.where(more, high, middle)
        found.append(attenuation * np.repeat(low, number, axis=0))
    return np.concatenate(found, axis=1)


def _scattered(
    lines: _Lines, depth: Floats, walls: Sequence[Material], counted: Callable[[Floats], Floats] | None
) -> Floats:
    """Counts of scattered photons [K, S, SPECTRUM_BINS] of nuclides that count 1 without a shield."""
    found = np.zeros((len(lines.first), depth.shape[1], len(spectrum_edges()) - 1))
    if counted is None:
        return found
    energies = scattering.bin_energies(lines.energy_kev)
    views, of_ground = from_ground(lines.energy_kev, counted)
    most = lines.counts * GROUND * views.sum(axis=1)
    found[:, 1] = lines.of_nuclide(most[:, None] * normalised(in_spectrum_bins(of_ground, energies)))
    weight = counted(energies) / counted(lines.energy_kev)[:, None]
    nodes, rows = np.append(0.0, scattering.depths()), np.arange(len(lines.counts))
    for wall, material in enumerate(walls):
        half_way = scattering.scattered_photons(material, lines.energy_kev)[:, :, scattering.POSITIONS.index(0.5)]
        # over what is not scattered they grow slowly: linear in the depth between the nodes
        per_direct = half_way * weight[:, None] * np.exp(scattering.depths())[:, None]
        per_direct = np.pad(per_direct, ((0, 0), (1, 0), (0, 0)))
        for row in range(2 + wall * len(DEPTHS), 2 + (wall + 1) * len(DEPTHS)):
            place = np.interp(depth[:, row], nodes, np.arange(len(nodes), dtype=float))
            low = np.minimum(place.astype(int), len(nodes) - 2)
            part = (place - low)[:, None]
            each = (1.0 - part) * per_direct[rows, low] + part * per_direct[rows, low + 1]
            each = each * (lines.counts * np.exp(-depth[:, row]))[:, None]
            found[:, row] = lines.of_nuclide(in_spectrum_bins(each, energies))
    return found
