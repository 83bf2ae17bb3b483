"""Pulse-height spectra of a scintillator for photon energies and for the background (host side)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from swarmsim.config.radiation import Background, Detector, Material
from swarmsim.radiation.library import ELECTRON_KEV, linear_attenuation

Floats = NDArray[np.float64]

REFERENCE_KEV = 661.66
SIGMA_PER_FWHM = 1 / 2.354820045
_STEP_KEV = 3.0  # grid of deposited energies, before the finite resolution is applied
# Shares of the continuum below a full-energy peak, estimates for a crystal of 1.5 to 2 inches on a light vehicle:
_BACKSCATTER_SHARE = 0.08  # photons backscattered by the surroundings of the crystal
_MULTIPLE_SHARE = 0.12  # several Compton events in the crystal, between the edge and the peak


@dataclass(frozen=True)
class Response:
    """A crystal's resolution, channels and efficiencies as functions of energy."""

    channel_edge_kev: Floats  # [channels + 1]
    threshold_kev: float
    fwhm_at_reference: float  # relative, at 661.66 keV
    efficiency_kev: Floats  # [p]
    efficiency_factor: Floats  # [p] tabulated total over the narrow-beam 1 - exp(-mu L)
    peak_share: Floats  # [p] photopeak over total
    crystal: Material
    crystal_length_m: float
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
        return self.fwhm_at_reference * np.sqrt(REFERENCE_KEV * energy_kev) * SIGMA_PER_FWHM

    def bare_factor(self, energy_kev: Floats) -> Floats:
        """Tabulated end-on efficiency over 1 - exp(-mu L), linear in ln(energy): loss by escape below the threshold."""
        return np.interp(np.log(energy_kev), np.log(self.efficiency_kev), self.efficiency_factor)

    def housing_transmission(self, energy_kev: Floats) -> Floats:
        """Share of the photons that cross the housing unscattered."""
        return np.exp(-linear_attenuation(self.housing, energy_kev) * self.housing_thickness_m)

    def end_on_efficiency(self, energy_kev: Floats) -> Floats:
        """Counts per photon that meets the housing end-on."""
        narrow = -np.expm1(-linear_attenuation(self.crystal, energy_kev) * self.crystal_length_m)
        return narrow * self.bare_factor(energy_kev) * self.housing_transmission(energy_kev)

    def photopeak_share(self, energy_kev: Floats) -> Floats:
        """Share of the counts in the full-energy peak; log-log between the points and beyond the last, at most 1."""
        x, points, values = np.log(energy_kev), np.log(self.efficiency_kev), np.log(self.peak_share)
        slope = (values[-1] - values[-2]) / (points[-1] - points[-2])
        beyond = values[-1] + slope * np.maximum(x - points[-1], 0.0)
        return np.exp(np.minimum(np.where(x > points[-1], beyond, np.interp(x, points, values)), 0.0))


def build_response(spec: Detector, crystal: Material, housing: Material) -> Response:
    """Response of the crystal that ``spec`` describes."""
    points = np.array([p.energy_kev for p in spec.efficiency])
    total = np.array([p.total for p in spec.efficiency])
    narrow = -np.expm1(-linear_attenuation(crystal, points) * spec.length_mm / 1000)
    analyser = spec.spectrometer
    return Response(
        channel_edge_kev=np.linspace(0.0, analyser.energy_max_kev, analyser.channels + 1),
        threshold_kev=analyser.threshold_kev,
        fwhm_at_reference=analyser.resolution_percent_at_662_kev / 100,
        efficiency_kev=points,
        efficiency_factor=total / narrow,
        peak_share=np.array([p.photopeak / p.total for p in spec.efficiency]),
        crystal=crystal,
        crystal_length_m=spec.length_mm / 1000,
        housing=housing,
        housing_thickness_m=spec.housing.thickness_mm / 1000,
    )


def compton_edge_kev(energy_kev: Floats) -> Floats:
    """Largest energy deposited by one Compton event: E 2k / (1 + 2k), k = E / 511 keV."""
    k = energy_kev / ELECTRON_KEV
    return energy_kev * 2 * k / (1 + 2 * k)


def compton_recoil(energy_kev: float, recoil_kev: Floats) -> Floats:
    """Klein-Nishina distribution of the recoil energy [t], unnormalised; 0 beyond the Compton edge.

    The Klein-Nishina formula (Knoll, Radiation Detection and Measurement, 4th ed., section 2.III) in terms of
    s = T / E instead of the angle.
    """
    k = energy_kev / ELECTRON_KEV
    inside = (recoil_kev > 0) & (recoil_kev < compton_edge_kev(np.array(energy_kev)))
    s = np.where(inside, recoil_kev, 0.0) / energy_kev
    shape = 2.0 + s**2 / (k * (1.0 - s)) ** 2 + s / (1.0 - s) * (s - 2.0 / k)
    return np.where(inside, shape, 0.0)


def _blur(response: Response, grid_kev: Floats) -> Floats:
    """Share [grid, channels] of the pulses of each deposited energy in each channel above the threshold."""
    edges = (response.channel_edge_kev - grid_kev[:, None]) / response.sigma_kev(grid_kev)[:, None]
    return np.diff(ndtr(edges), axis=1) * (response.channel_centre_kev >= response.threshold_kev)


def _grid(response: Response) -> Floats:
    return np.arange(0.5 * _STEP_KEV, response.channel_edge_kev[-1] * 1.1, _STEP_KEV)


def _continuum(response: Response, energy_kev: float, grid: Floats) -> Floats:
    """Distribution of deposited energies below the full-energy peak [grid]; sums to 1.

    It consists of single Compton events, multiple ones, and backscatter.
    """
    edge = float(compton_edge_kev(np.array(energy_kev)))
    above = grid >= response.threshold_kev
    single = compton_recoil(energy_kev, grid) * above
    multiple = ((grid > edge) & (grid < energy_kev)) * above
    back = energy_kev - edge
    backscatter = np.exp(-0.5 * ((grid - 1.05 * back) / (0.08 * back)) ** 2) * (grid < energy_kev) * above
    single_share = 1 - _MULTIPLE_SHARE - _BACKSCATTER_SHARE
    parts = ((single, single_share), (multiple, _MULTIPLE_SHARE), (backscatter, _BACKSCATTER_SHARE))
    total = sum(share * shape / max(float(shape.sum()), 1e-12) for shape, share in parts)
    return np.asarray(total / max(float(np.sum(total)), 1e-12))


def _normalised(spectra: Floats) -> Floats:
    return np.asarray(spectra / spectra.sum(axis=-1, keepdims=True))


def peak_spectrum(response: Response, energy_kev: Floats) -> Floats:
    """Spectra [..., channels] of unscattered photons of the lines ``energy_kev`` [...]; each sums to 1."""
    grid = _grid(response)
    flat, back = np.unique(energy_kev, return_inverse=True)
    share = response.photopeak_share(flat)[:, None]
    continuum = np.stack([_continuum(response, float(e), grid) for e in flat]) @ _blur(response, grid)
    spectra = _normalised(share * _blur(response, flat) + (1 - share) * continuum)
    return spectra[back].reshape(*energy_kev.shape, -1)


def scattered_flux(energy_kev: float, grid: Floats) -> Floats:
    """Photons per keV [grid] that scattered between source and detector, unnormalised.

    A compromise between the Monte Carlo spectra of air and of concrete at 1 to 2 mean free paths
    (``configs/materials/generate_build_up.py``): flat in ln(E) up to the line, with a maximum at 105 keV and a fall
    below 50 keV, where photons are absorbed.
    """
    hump = 0.22 + 0.28 * np.exp(-0.5 * (np.log(grid / 105.0) / 0.5) ** 2)
    return np.where(grid < energy_kev, hump * -np.expm1(-((grid / 50.0) ** 3)) / grid, 0.0)


def scattered_spectrum(response: Response, energy_kev: Floats) -> Floats:
    """Spectra [..., channels] of the scattered photons of the lines ``energy_kev`` [...]; each sums to 1."""
    grid = _grid(response)
    inside = np.flatnonzero((grid >= response.threshold_kev) & (grid <= response.crystal.energy_kev[-1]))[::2]
    photons = grid[inside]
    share = response.photopeak_share(photons)
    deposits = (1 - share)[:, None] * np.stack([_continuum(response, float(e), grid) for e in photons])
    deposits[np.arange(len(inside)), inside] += share
    flat, back = np.unique(energy_kev, return_inverse=True)
    flux = np.stack([scattered_flux(float(e), photons) for e in flat]) * response.end_on_efficiency(photons)
    return _normalised(flux @ deposits @ _blur(response, grid))[back].reshape(*energy_kev.shape, -1)


def background_spectrum(response: Response, background: Background) -> Floats:
    """Background [channels] in cps: the lines with their continua, on exp(-E / continuum_kev) above the threshold."""
    centre = response.channel_centre_kev
    continuum = _normalised(np.exp(-centre / background.continuum_kev) * (centre >= response.threshold_kev))
    spectrum = (1 - sum(line.share for line in background.lines)) * continuum
    if background.lines:
        lines = peak_spectrum(response, np.array([line.energy_kev for line in background.lines]))
        spectrum = spectrum + np.array([line.share for line in background.lines]) @ lines
    return background.rate_cps * spectrum
