"""Dose rates from counts by energy window: what a spectrometer reports (host side).

A spectrum-dose operator G gives every count the dose that it stands for, so that the sum over the counts of photons of
any energy is their dose: sum_i N_i(E) G_i = h(E) for the counts N_i(E) in window i per unit fluence of photons of E
(Moriuchi, JAERI 1209, 1971; Tsuda and Tsutsumi, Journal of Nuclear Science and Technology 49, 2012, 1093). Photons are
taken to come from all sides alike. A counter without energy resolution has one number, right at the 662 keV of Cs-137.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from swarmsim.config.radiation import Detector as DetectorSpec
from swarmsim.radiation.crystal import ENERGIES_KEV
from swarmsim.radiation.cylinder import fit_effective_area
from swarmsim.radiation.detector import counting_of, rois_of
from swarmsim.radiation.dose import MICRO_PER_HOUR, Quantity, per_fluence
from swarmsim.radiation.library import Library
from swarmsim.radiation.rate import saturating_rate, shown
from swarmsim.radiation.response import REFERENCE_KEV, build_response, line_spectra, normalised

Floats = NDArray[np.float64]

LOWEST_KEV, HIGHEST_KEV = 60.0, 2700.0
"""Energies for which the operator is made; a detector's channels may end before."""
_ENERGIES = 48
_EVEN = np.array([1.0, 1 / 2, np.pi / 4, 1 / 3, 1 / 3])  # mean over all directions of cylinder.direction_basis
_LEAST_SHARE = 0.05
"""Of the counts that are registered, and of the change of what is shown with the true rate, in a saturated detector.

Beyond, chance decides: a non-paralyzable detector that shows 95 % of its highest rate may be at any rate from there on.
"""
_NODES = 4096  # of the inverse of the dead time law


@dataclass(frozen=True)
class DoseRates:
    """What n measurements say of the dose rate where they were taken, natural background included."""

    live_s: Floats  # [n] part of the exposure in which the detector was not dead, by its dead time law
    ambient_usv_h: Floats  # [n] ambient dose equivalent rate H*(10)
    ambient_std_usv_h: Floats  # [n] standard deviation by counting statistics, which dead time enlarges
    kerma_ugy_h: Floats  # [n] air kerma rate


@dataclass(frozen=True)
class DoseOperator:
    """Dose rates from the counts by region of interest of a detector model."""

    edges_kev: tuple[float, ...]  # [R + 1] of the regions; () for a counter without energy resolution, which has one
    ambient: Floats  # [R] uSv/h per count per second
    kerma: Floats  # [R] uGy/h per count per second
    energy_kev: Floats  # [k] for which the operator was made
    error: Floats  # [k] relative error of the ambient dose rate of photons of that energy from all sides
    paralyzable_s: float
    non_paralyzable_s: float

    def rates(self, counts: Floats, exposure_s: Floats) -> DoseRates:
        """Dose rates from ``counts`` [n, R] of exposures [n]; those of a saturated detector are lower bounds.

        The standard deviation of no count at all is that of one.
        """
        total = np.asarray(counts, float).sum(axis=1)
        share = self._live_share(total / exposure_s)
        live, dose = exposure_s * share, counts @ self.ambient
        # all windows have in common what the dead time makes of a chance excess of all counts
        stretched = self._stretch(total / exposure_s, share) ** 2 - 1.0
        variance = counts @ self.ambient**2 + stretched * dose**2 / np.maximum(total, 1.0)
        variance += np.where(total > 0.0, 0.0, np.mean(self.ambient**2))
        return DoseRates(
            live_s=live,
            ambient_usv_h=dose / live,
            ambient_std_usv_h=np.sqrt(variance) / live,
            kerma_ugy_h=counts @ self.kerma / live,
        )

    def _live_share(self, observed_cps: Floats) -> Floats:
        """Share [n] of the true counts that is registered where ``observed_cps`` [n] are: `registered_share` there."""
        paralyzable, non_paralyzable = self.paralyzable_s, self.non_paralyzable_s
        if paralyzable <= 0.0:
            return np.asarray(np.maximum(1.0 - observed_cps * non_paralyzable, _LEAST_SHARE))
        true = saturating_rate(paralyzable, non_paralyzable) * np.linspace(0.0, 1.0, _NODES) ** 2
        registered = shown(true, paralyzable, non_paralyzable)
        return np.interp(observed_cps, registered, np.concatenate([[1.0], registered[1:] / true[1:]]))

    def _stretch(self, observed_cps: Floats, share: Floats) -> Floats:
        """Relative change [n] of the true rate over that of what is registered, by the law of `registered_share`."""
        true = observed_cps / share
        dead = true * self.paralyzable_s + true * self.non_paralyzable_s / (1.0 + true * self.non_paralyzable_s)
        return np.asarray(1.0 / np.maximum(1.0 - dead, _LEAST_SHARE))


def dose_operator(spec: DetectorSpec, library: Library, kind: str) -> DoseOperator:
    """The operator of a detector model, counting as ``kind`` (`swarmsim.radiation.detector.KINDS`) says.

    Non-negative least squares of the relative errors of single energies from `LOWEST_KEV` to `HIGHEST_KEV`.
    """
    edges: tuple[float, ...] = ()
    energy = np.array([REFERENCE_KEV])
    response = None
    if spec.crystal is not None:
        assert spec.spectrometer is not None
        edges = spec.spectrometer.rois_kev
        response = build_response(spec, library.material(spec.crystal), library.material(spec.housing.material))
        highest = min(HIGHEST_KEV, 0.95 * spec.spectrometer.energy_max_kev, float(ENERGIES_KEV[-1]))
        energy = np.geomspace(max(LOWEST_KEV, 1.5 * spec.spectrometer.threshold_kev), highest, _ENERGIES)
    counting = counting_of(spec, library, response, kind)
    mu = np.broadcast_to(counting.attenuation_1_m(energy), energy.shape)
    area = fit_effective_area(spec.diameter_mm / 2000, spec.length_mm / 1000, mu) @ _EVEN
    met = 1e4 * area * counting.through_housing(energy)  # photons that interact per photon and cm2
    if response is None:
        counts = (met * counting.counts(energy))[:, None]
    else:
        spectra = line_spectra(response, energy)  # counts per photon that interacts; an idealised counter counts each
        counts = met[:, None] * (spectra if kind == "physical" else normalised(spectra)) @ rois_of(response, edges)
    ambient, kerma = (_solved(counts, energy, quantity) for quantity in ("ambient_dose_equivalent", "air_kerma"))
    return DoseOperator(
        edges_kev=edges,
        ambient=ambient,
        kerma=kerma,
        energy_kev=energy,
        error=counts @ ambient / (MICRO_PER_HOUR * per_fluence("ambient_dose_equivalent", energy)) - 1.0,
        paralyzable_s=spec.dead_time.paralyzable_us * 1e-6,
        non_paralyzable_s=spec.dead_time.non_paralyzable_us * 1e-6,
    )


def _solved(counts: Floats, energy_kev: Floats, quantity: Quantity) -> Floats:
    """The operator [R] for counts [k, R] per photon and cm2 of each energy [k]."""
    wanted = MICRO_PER_HOUR * per_fluence(quantity, energy_kev)
    return np.asarray(nnls(counts / wanted[:, None], np.ones(len(wanted)))[0])
