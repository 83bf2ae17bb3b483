"""Pulse-height spectra of a scintillator for photon energies and for the background (host side)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from swarmsim.config.errors import InputError
from swarmsim.config.radiation import Background, Detector, Material
from swarmsim.radiation.attenuation import coefficients, linear_attenuation
from swarmsim.radiation.crystal import ENERGIES_KEV, PulseHeights, compton_edge_kev, deposit_edges, pulse_heights
from swarmsim.radiation.elements import CUT_KEV, ELECTRON_KEV

Floats = NDArray[np.float64]

REFERENCE_KEV = 661.66
SIGMA_PER_FWHM = 1 / 2.354820045
_STEP_KEV = 3.0  # grid of deposited energies, before the finite resolution is applied


@dataclass(frozen=True)
class Response:
    """A scintillator's resolution, channels and pulse heights as functions of the photon's energy."""

    channel_edge_kev: Floats  # [channels + 1]
    threshold_kev: float
    fwhm_at_reference: float  # relative, at 661.66 keV
    backscatter_share: float  # of the continuum: photons that the surroundings of the crystal scatter back
    pulses: PulseHeights
    crystal: Material
    housing: Material
    housing_thickness_m: float

    @property
    def channel_centre_kev(self) -> Floats:
        """Centre of each channel."""
        return 0.5 * (self.channel_edge_kev[1:] + self.channel_edge_kev[:-1])

    @property
    def channel_width_kev(self) -> float:
        """Width of a channel."""
        return float(self.channel_edge_kev[1] - self.channel_edge_kev[0])

    def sigma_kev(self, energy_kev: Floats) -> Floats:
        """Standard deviation of the peak at an energy: FWHM = R sqrt(661.66 E)."""
        return self.fwhm_at_reference * np.sqrt(REFERENCE_KEV * np.maximum(energy_kev, 1.0)) * SIGMA_PER_FWHM

    def attenuation_1_m(self, energy_kev: Floats) -> Floats:
        """Attenuation by what leaves energy in the crystal: all but coherent scattering."""
        parts = coefficients(self.crystal, energy_kev)
        return (parts.total - parts.coherent) * 0.1 * self.crystal.density_kg_m3

    def housing_transmission(self, energy_kev: Floats) -> Floats:
        """Share of the photons that cross the housing unscattered."""
        return np.exp(-linear_attenuation(self.housing, energy_kev) * self.housing_thickness_m)

    def counts(self, energy_kev: Floats) -> Floats:
        """Counts above the threshold per photon that interacts [...], linear between 96 energies."""
        grid = np.geomspace(CUT_KEV, ENERGIES_KEV[-1], 96)
        return np.interp(np.log(energy_kev), np.log(grid), line_spectra(self, grid).sum(axis=1))


def build_response(spec: Detector, crystal: Material, housing: Material) -> Response:
    """Response of the crystal that ``spec`` describes."""
    assert spec.spectrometer is not None
    analyser = spec.spectrometer
    return Response(
        channel_edge_kev=np.linspace(0.0, analyser.energy_max_kev, analyser.channels + 1),
        threshold_kev=analyser.threshold_kev,
        fwhm_at_reference=analyser.resolution_percent_at_662_kev / 100,
        backscatter_share=spec.backscatter_share,
        pulses=pulse_heights(crystal, spec.diameter_mm / 2000, spec.length_mm / 1000),
        crystal=crystal,
        housing=housing,
        housing_thickness_m=spec.housing.thickness_mm / 1000,
    )


def _blur(response: Response, grid_kev: Floats) -> Floats:
    """Share [grid, channels] of the pulses of each deposited energy in each channel above the threshold."""
    edges = (response.channel_edge_kev - grid_kev[:, None]) / response.sigma_kev(grid_kev)[:, None]
    return np.diff(ndtr(edges), axis=1) * (response.channel_centre_kev >= response.threshold_kev)


def line_spectra(response: Response, energy_kev: Floats) -> Floats:
    """Spectra [k, channels] of the lines ``energy_kev`` [k]: counts per photon that interacts in the crystal.

    Peaks are at their place; the continuum is that of the Monte Carlo's neighbouring energies in its own scale, below
    the Compton edge and above it.
    """
    energy = np.asarray(energy_kev, np.float64)
    if np.any(energy > ENERGIES_KEV[-1]):
        raise InputError.of(
            f"a line of {energy.max():g} keV lies beyond crystals' response ({ENERGIES_KEV[-1]:g} keV): leave it out"
        )
    pulses, log_grid = response.pulses, np.log(ENERGIES_KEV)

    def at(values: Floats) -> Floats:
        return np.interp(np.log(energy), log_grid, values)

    grid_edge = np.arange(0.0, max(response.channel_edge_kev[-1] * 1.1, energy.max() + 30.0), _STEP_KEV)
    continua = np.stack([at(column) for column in pulses.continuum.T], axis=1)
    bare = np.stack([_rebinned(e, c, grid_edge) for e, c in zip(energy, continua, strict=True)])
    below_peak = bare.sum(axis=1, keepdims=True)
    middle = 0.5 * (grid_edge[1:] + grid_edge[:-1])
    back = np.stack([_backscatter(float(e), middle) for e in energy])
    share = response.backscatter_share
    spectra = ((1.0 - share) * bare + share * below_peak * back) @ _blur(response, middle)
    for part, lost in (
        (pulses.full, 0.0), (pulses.x_ray, pulses.x_ray_kev), (pulses.single, ELECTRON_KEV),
        (pulses.double, 2 * ELECTRON_KEV),
    ):  # fmt: skip
        left = energy - lost
        spectra = spectra + (at(part) * (left > 1.0))[:, None] * _blur(response, np.maximum(left, 1.0))
    return np.asarray(at(pulses.deposits)[:, None] * spectra)


def _rebinned(energy: float, continuum: Floats, grid_edge: Floats) -> Floats:
    """Shares of the continuum in the cells of the grid."""
    sums = np.concatenate([[0.0], np.cumsum(continuum)])
    return np.diff(np.interp(grid_edge, deposit_edges(energy), sums))


def _backscatter(energy: float, grid: Floats) -> Floats:
    """Photons scattered back by the surroundings [grid], a hump near the energy after 180 degrees; sums to 1."""
    back = energy - float(compton_edge_kev(np.asarray(energy)))
    hump = np.exp(-0.5 * ((grid - 1.05 * back) / (0.08 * back)) ** 2) * (grid < energy)
    return np.asarray(hump / max(float(hump.sum()), 1e-12))


def normalised(spectra: Floats) -> Floats:
    """Spectra [..., channels] that sum to 1."""
    return np.asarray(spectra / np.maximum(spectra.sum(axis=-1, keepdims=True), 1e-30))


def background_spectrum(response: Response, background: Background) -> Floats:
    """Background [channels] in cps: the lines with their continua, on exp(-E / continuum_kev) above the threshold."""
    centre = response.channel_centre_kev
    continuum = normalised(np.exp(-centre / background.continuum_kev) * (centre >= response.threshold_kev))
    spectrum = (1 - sum(line.share for line in background.lines)) * continuum
    if background.lines:
        lines = normalised(line_spectra(response, np.array([line.energy_kev for line in background.lines])))
        spectrum = spectrum + np.array([line.share for line in background.lines]) @ lines
    return background.rate_cps * spectrum
