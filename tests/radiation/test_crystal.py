"""Pulse heights of crystals against published efficiencies, and their features."""

import numpy as np
import pytest

from swarmsim.config.load import load_named
from swarmsim.radiation import Library, build_detector
from swarmsim.radiation.crystal import ENERGIES_KEV, pulse_heights
from swarmsim.radiation.cylinder import direction_basis
from swarmsim.radiation.response import build_response, line_spectra
from tests.radiation.points import MOUNT

# Bare cylinder, parallel beam end on: counts above 30 keV and in the full-energy peak, per photon
PUBLISHED = {
    38.1: {356.0: (0.78, 0.57), 661.66: (0.622, 0.263), 1173.23: (0.512, 0.133), 1332.49: (0.490, 0.116)},
    50.8: {356.0: (0.87, 0.68), 661.66: (0.725, 0.357), 1173.23: (0.615, 0.198), 1332.49: (0.592, 0.174)},
    76.2: {356.0: (0.95, 0.80), 661.66: (0.855, 0.514), 1173.23: (0.761, 0.325), 1332.49: (0.739, 0.293)},
}


def response(library: Library, size_mm: float):
    spec = load_named("detectors", "nai_2x2").model_copy(update={"diameter_mm": size_mm, "length_mm": size_mm})
    return build_response(spec, library.material("sodium_iodide"), library.material("aluminium"))


@pytest.mark.parametrize("size_mm", PUBLISHED)
def test_efficiency_from_the_dimensions(library: Library, size_mm: float) -> None:
    crystal = response(library, size_mm)
    for energy, (total, peak) in PUBLISHED[size_mm].items():
        e = np.asarray(energy)
        interacts = float(-np.expm1(-crystal.attenuation_1_m(e) * size_mm / 1000))
        assert interacts * float(crystal.counts(e)) == pytest.approx(total, rel=0.015)
        full = np.interp(np.log(energy), np.log(ENERGIES_KEV), crystal.pulses.full * crystal.pulses.deposits)
        assert interacts * float(full) == pytest.approx(peak, rel=0.05)


@pytest.mark.slow
def test_a_new_size_is_right_by_itself(library: Library) -> None:
    """A 1 x 1 inch crystal detects 0.482 of the photons of 662 keV; its housing lets 0.98 of them through."""
    spec = load_named("detectors", "nai_1p5x1p5").model_copy(update={"diameter_mm": 25.4, "length_mm": 25.4})
    detector = build_detector(spec, MOUNT, library, "physical")
    row = detector.nuclide_names.index("Cs-137")
    line = int(np.argmax(np.asarray(detector.yields[row])))
    end_on = np.asarray(detector.effective_area_m2[row, line]) @ np.asarray(
        direction_basis(np.float32(1), np.float32(0))
    )
    assert end_on / (np.pi * 0.0127**2) == pytest.approx(0.482 * 0.978, rel=0.015)


def test_escape_of_iodine_x_rays(library: Library) -> None:
    """Knoll, section 10.II: 28 keV below the peak; a tenth of the pulses at 60 keV, next to none at 662 keV."""
    pulses = pulse_heights(library.material("sodium_iodide"), 0.0254, 0.0508)
    at = dict(zip(ENERGIES_KEV, pulses.x_ray, strict=True))
    assert pulses.x_ray_kev == pytest.approx(28.5, abs=0.3)
    assert 0.08 < at[60.0] < 0.14
    assert at[720.0] < 0.01
    assert at[30.0] < 0.01  # below the K edge


def test_annihilation_escape_peaks(library: Library) -> None:
    """A line of 2614.5 keV has peaks 511 and 1022 keV lower; one of 1332 keV hardly."""
    crystal = response(library, 50.8)
    spectrum = line_spectra(crystal, np.array([2614.5]))[0]
    energy = crystal.channel_centre_kev
    for peak in (2614.5 - 511.0, 2614.5 - 1022.0):
        near, beside = (np.abs(energy - peak) < 15), (np.abs(np.abs(energy - peak) - 110) < 15)
        assert spectrum[near].mean() > 1.3 * spectrum[beside].mean()


def test_shares_sum_to_one(library: Library) -> None:
    pulses = pulse_heights(library.material("sodium_iodide"), 0.02, 0.06)
    total = pulses.full + pulses.x_ray + pulses.single + pulses.double + pulses.continuum.sum(axis=1)
    np.testing.assert_allclose(total, 1.0, atol=1e-9)
    assert np.all(pulses.deposits > 0.98)


def test_continuum_ends_at_the_compton_edge(library: Library) -> None:
    crystal = response(library, 25.4)
    spectrum = line_spectra(crystal, np.array([661.66]))[0]
    energy = crystal.channel_centre_kev
    plateau, valley = (spectrum[(energy > a) & (energy < b)].mean() for a, b in ((350, 440), (530, 570)))
    assert valley < 0.35 * plateau
