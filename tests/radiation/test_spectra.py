"""Spectra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.radiation import Detector, net_rate, spectrum_rate
from swarmsim.radiation.crystal import compton_edge_kev
from swarmsim.radiation.interactions import klein_nishina, scattered_fraction
from tests.radiation.points import point, through

UP, PLACE = jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 0.0, 5.0])
Detectors = dict[tuple[str, str], Detector]


def spectrum(detector: Detector, nuclide: str, cps: float, **metres: float) -> jax.Array:
    """Source spectrum [channels] scaled to ``cps``."""
    channels = spectrum_rate(detector, point(detector, nuclide), through(detector, air=5.0, **metres), PLACE, UP)
    return channels * cps / jnp.sum(channels)


@pytest.mark.parametrize("kind", ["physical", "paper_ideal"])
def test_channels_sum_to_the_rate(detectors: Detectors, kind: str) -> None:
    detector = detectors["nai_2x2", kind]
    for nuclide in detector.nuclide_names:
        arguments = (point(detector, nuclide), through(detector, air=4.0, concrete=0.05), PLACE, UP)
        total = float(jnp.sum(spectrum_rate(detector, *arguments)))
        assert total == pytest.approx(float(net_rate(detector, *arguments)), rel=1e-4)
    assert float(jnp.sum(detector.background_spectrum)) == pytest.approx(167.0, rel=1e-5)


def test_photopeak_place_width_and_area(detectors: Detectors) -> None:
    """662 keV: FWHM 7 %, the peak holds photopeak / total of the counts, the continuum ends at the Compton edge."""
    detector = detectors["nai_2x2", "physical"]
    line = list(np.asarray(detector.line_energy_kev[detector.nuclide_names.index("Cs-137")])).index(np.float32(661.66))
    shape = np.asarray(detector.peak_spectrum[detector.nuclide_names.index("Cs-137"), line], np.float64)
    energy = np.asarray(detector.energy_kev, np.float64)
    peak = shape * (energy > 590)
    assert np.sum(peak * energy) / peak.sum() == pytest.approx(661.7, rel=0.003)
    half = energy[shape > 0.5 * peak.max()]
    half = half[half > 590]
    assert half[-1] - half[0] == pytest.approx(0.07 * 661.66, abs=4.0)
    assert peak.sum() == pytest.approx(0.357 / 0.725, rel=0.07)  # some continuum lies under the peak
    plateau = shape[(energy > 350) & (energy < 440)].mean()
    valley = shape[(energy > 530) & (energy < 570)].mean()
    assert valley < 0.5 * plateau


def test_compton_formulae() -> None:
    """Compton edges of Cs-137 and Co-60, backscatter, and the total Klein-Nishina cross section in closed form."""
    np.testing.assert_allclose(compton_edge_kev(np.array([661.66, 1173.2, 1332.5])), (477, 963, 1118), atol=1)
    assert 661.66 * float(scattered_fraction(661.66, -1.0)) == pytest.approx(184.3, abs=0.2)
    cosine = np.linspace(-1, 1, 20_001)
    for energy in (1.0, 100.0, 661.66, 2614.0):
        k = energy / 510.99895
        log = np.log1p(2 * k)
        total = (1 + k) / k**2 * (2 * (1 + k) / (1 + 2 * k) - log / k) + log / (2 * k) - (1 + 3 * k) / (1 + 2 * k) ** 2
        assert np.trapezoid(klein_nishina(energy, cosine), cosine) == pytest.approx(total, rel=3e-4)


def test_scattered_photons_come_below_their_line(detectors: Detectors) -> None:
    """Of a nuclide of one line, whose spectrum without scattered photons is the same behind a wall."""
    detector = detectors["nai_2x2", "physical"]
    bare, walled = spectrum(detector, "Mn-54", 1.0), spectrum(detector, "Mn-54", 1.0, concrete=0.2)
    low = detector.energy_kev < 300
    assert float(jnp.sum(walled * low)) > 1.5 * float(jnp.sum(bare * low))
    ideal = detectors["nai_2x2", "paper_ideal"]
    assert float(jnp.sum(ideal.energy_kev * spectrum(ideal, "Mn-54", 1.0))) == pytest.approx(
        float(jnp.sum(ideal.energy_kev * spectrum(ideal, "Mn-54", 1.0, concrete=0.2))), rel=0.02
    )
