"""Grids of energies of a spectrometer, and spectra of single lines on them, bare and behind walls (host side)."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.radiation import Material
from swarmsim.radiation import scattering
from swarmsim.radiation.crystal import ENERGIES_KEV
from swarmsim.radiation.ground import from_ground
from swarmsim.radiation.response import SIGMA_PER_FWHM, Response, line_spectra, normalised

Floats = NDArray[np.float64]

SPECTRUM_BINS = 28
"""Bins of scattered photons, of equal width in ln(energy), in which spectra behind walls are put together."""
SPECTRUM_DEPTHS = (1.0, 5.0)
"""Mean free paths for which the energies of scattered photons are tabulated."""
SHIELDS = ("water", "concrete", "steel", "lead")
"""Walls of the templates of identification: what others let through lies between."""
DEPTHS = (0.4, 1.1, 1.9, 2.9, 4.1)
"""Optical depths of these walls, for all photons of a nuclide together. The least stops X-rays and little else."""
LINE_DEPTHS = (1.0, 3.0)
"""Mean free paths behind which single lines are tabulated."""
GROUND = 0.7
"""Photons that the ground scatters in the templates of identification, over the most that it can (`Shape.ground`)."""
GAINS = (0.97, 0.985, 1.0, 1.015, 1.03)
"""Gains of the tables."""
ORDERS = 5
"""Coefficients of a table about a gain: 1, gain, gain squared, width, width squared (`orders`)."""
_GAIN_STEP = 0.0075  # of the differences by which the tables change with the gain
_TILT_KEV = (30.0, 3000.0)


def spectrum_edges() -> Floats:
    """Edges [SPECTRUM_BINS + 1] in keV of the bins of scattered photons."""
    return np.geomspace(scattering.CUT_KEV, 3000.0, SPECTRUM_BINS + 1)


def energy_shares(counts: Floats, energies: Floats, depths: Sequence[float] = SPECTRUM_DEPTHS) -> Floats:
    """Shares [depths, k, SPECTRUM_BINS] of the scattered counts [k, d, BINS] by energy, at ``depths``.

    ``energies`` [k, BINS] are the middles of the bins of the counts.
    """
    return normalised(np.stack([in_spectrum_bins(counts[:, row], energies) for row in _rows(depths)]))


def in_spectrum_bins(counts: Floats, energies: Floats) -> Floats:
    """Counts [k, BINS] in bins with the middles ``energies`` [k, BINS] in those of the spectrum [k, SPECTRUM_BINS]."""
    relative = np.log(energies / scattering.CUT_KEV)
    width = 2.0 * relative[:, :1]
    low, high = relative - 0.5 * width, relative + 0.5 * width
    log_edges = np.log(spectrum_edges() / scattering.CUT_KEV)
    below = np.clip((log_edges - low[..., None]) / (high - low)[..., None], 0.0, 1.0)
    return np.einsum("kb,kbs->ks", counts, np.diff(below, axis=-1))


def line_grid(response: Response) -> Floats:
    """Energies half a resolution (FWHM) apart, from the threshold to the end of the response and the channels."""
    low, high = response.threshold_kev, min(response.channel_edge_kev[-1], ENERGIES_KEV[-1])
    # FWHM grows as the root of the energy, so that the roots of the energies lie at equal distances
    step = 0.25 * float(response.sigma_kev(np.asarray(low))) / SIGMA_PER_FWHM / np.sqrt(low)
    return np.linspace(np.sqrt(low), np.sqrt(high), round((np.sqrt(high) - np.sqrt(low)) / step) + 1) ** 2


def shielded_lines(
    response: Response, materials: Sequence[Material], counted: Callable[[Floats], Floats] | None
) -> Floats:
    """Spectra [shields, grid, bins] of lines, bare, above the ground and behind walls half way; each sums to 1.

    ``counted`` gives the counts per photon that comes from around, up to a factor; with None none that scattered does,
    and there is no ground.
    """
    energy = line_grid(response)
    bare = normalised(line_spectra(response, energy))
    walls = [material for material in materials if material.name in SHIELDS]
    edges = spectrum_edges()
    of_bins = normalised(line_spectra(response, np.sqrt(edges[1:] * edges[:-1])))
    found = [bare]
    if counted is not None:
        ground, counts = from_ground(energy, counted)
        shares = normalised(in_spectrum_bins(counts, scattering.bin_energies(energy)))
        found.append(normalised(bare + GROUND * ground.sum(axis=-1, keepdims=True) * shares @ of_bins))
    tables = scattering.transport(walls, energy, counted)
    half_way = tables.counts[:, :, :, scattering.POSITIONS.index(0.5)]  # [k, walls, d, BINS]
    for wall in range(len(walls)):
        shares = energy_shares(half_way[:, wall], scattering.bin_energies(energy), LINE_DEPTHS)
        for row, share in zip(_rows(LINE_DEPTHS), shares, strict=True):
            scattered = half_way[:, wall, row].sum(axis=-1)[:, None] * share
            found.append(normalised(np.exp(-scattering.depths()[row]) * bare + scattered @ of_bins))
    return rebinned(response, np.stack(found), 1.0, np.asarray(identification_bins(response)))


def identification_bins(response: Response) -> tuple[int, ...]:
    """First channels of bins a third of the resolution (FWHM) wide, from the threshold, and the end of the last bin."""
    starts = [int(np.searchsorted(response.channel_edge_kev, response.threshold_kev))]
    end = len(response.channel_centre_kev)
    while starts[-1] < end:
        energy = response.channel_edge_kev[starts[-1]]
        fwhm = response.sigma_kev(np.asarray(energy)) / SIGMA_PER_FWHM
        starts.append(min(end, starts[-1] + max(1, round(float(fwhm) / 3 / response.channel_width_kev))))
    return tuple(starts)


def _rows(depths: Sequence[float]) -> list[int]:
    """Rows of the tables of scattered photons that are nearest to ``depths``."""
    return [int(np.argmin(np.abs(scattering.depths() - depth))) for depth in depths]


def tilt(energy_kev: Floats) -> Floats:
    """A slope over energies [...]: linear in their logarithm, -1 at 30 keV, 1 at 3 MeV."""
    low, high = np.log(_TILT_KEV)
    return np.asarray(np.clip((2.0 * np.log(energy_kev) - low - high) / (high - low), -1.0, 1.0))


def orders(response: Response, spectra: Floats) -> Floats:
    """Coefficients [..., GAINS, ORDERS, bins] of spectra [..., channels] in the bins of identification.

    At a gain near one of `GAINS`, whose difference is u, and a width t (`swarmsim.radiation.templates`), the counts are
    the sum of the coefficients times 1, u, u^2, t and t^2.
    """
    once = conducted(response, spectra)
    changes = [once, 0.5 * conducted(response, once)]
    edges = np.asarray(identification_bins(response))

    def at(gain: float) -> Floats:
        low, here, high = (rebinned(response, spectra, gain + step, edges) for step in (-_GAIN_STEP, 0.0, _GAIN_STEP))
        first, second = 0.5 * (high - low) / _GAIN_STEP, (0.5 * (high + low) - here) / _GAIN_STEP**2
        return np.stack([here, first, second, *(rebinned(response, part, gain, edges) for part in changes)], axis=-2)

    return np.stack([at(gain) for gain in GAINS], axis=-3)


def conducted(response: Response, spectra: Floats) -> Floats:
    """The change A S [..., channels] of spectra [..., channels] with the width t, to first order."""
    first = identification_bins(response)[0]
    variance = (response.sigma_kev(response.channel_centre_kev) / response.channel_width_kev) ** 2
    flow = np.diff((variance * spectra)[..., first:], axis=-1)
    # nothing flows over the threshold or the end
    change = np.zeros_like(spectra)
    change[..., first:] = np.diff(flow, axis=-1, prepend=0.0, append=0.0)
    return change


def rebinned(response: Response, spectra: Floats, gain: float, edges: NDArray[np.intp]) -> Floats:
    """Counts [..., bins] of spectra [..., channels] between ``edges`` [bins + 1] (channels) at a gain.

    Below the threshold, where the tables hold nothing, they go on as in the first channel above it.
    """
    first, channels = identification_bins(response)[0], spectra.shape[-1]
    filled = np.where(np.arange(channels) < first, spectra[..., first : first + 1], spectra)
    below = np.concatenate([np.zeros((*spectra.shape[:-1], 1)), np.cumsum(filled, axis=-1)], axis=-1)
    place = np.clip(edges / gain, 0.0, channels)
    left = np.minimum(place.astype(int), channels - 1)
    return np.diff(below[..., left] + (place - left) * filled[..., left], axis=-1)
