"""Spectra and identification."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.radiation import Detector, Identification, Library, identify, net_rate, spectrum_rate
from swarmsim.radiation.crystal import compton_edge_kev
from swarmsim.radiation.identify import hypotheses
from swarmsim.radiation.interactions import klein_nishina, scattered_fraction
from tests.radiation.points import point, through

UP, PLACE = jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 0.0, 5.0])
LIVE_S = 60.0
Detectors = dict[tuple[str, str], Detector]
BATCH = 30
_run = jax.jit(jax.vmap(identify, in_axes=(None, 0, None)))


def spectrum(detector: Detector, nuclide: str, cps: float, **metres: float) -> jax.Array:
    """Source spectrum [channels] scaled to ``cps``."""
    channels = spectrum_rate(detector, point(detector, nuclide), through(detector, air=5.0, **metres), PLACE, UP)
    return channels * cps / jnp.sum(channels)


def draws(detector: Detector, mean_cps: jax.Array, n: int, live_s: float = LIVE_S, seed: int = 0) -> Identification:
    """Identify ``n`` Poisson draws of a mean spectrum with the background on top."""
    mean = (np.asarray(mean_cps) + np.asarray(detector.background_spectrum)) * live_s
    return run(detector, np.random.default_rng(seed).poisson(mean, (n, len(mean))), live_s)


def run(detector: Detector, counts: np.ndarray, live_s: float) -> Identification:
    """Identify each row, in batches of one size so that it compiles once per kind."""
    padded = np.zeros((-(-len(counts) // BATCH) * BATCH, counts.shape[1]), np.float32)
    padded[: len(counts)] = counts
    parts = [_run(detector, batch, live_s) for batch in padded.reshape(-1, BATCH, counts.shape[1])]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(counts)], *parts)


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
    detector = detectors["nai_2x2", "physical"]
    bare, walled = spectrum(detector, "Cs-137", 1.0), spectrum(detector, "Cs-137", 1.0, concrete=0.2)
    low = detector.energy_kev < 300
    assert float(jnp.sum(walled * low)) > 1.5 * float(jnp.sum(bare * low))
    ideal = detectors["nai_2x2", "paper_ideal"]
    assert float(jnp.sum(ideal.energy_kev * spectrum(ideal, "Cs-137", 1.0))) == pytest.approx(
        float(jnp.sum(ideal.energy_kev * spectrum(ideal, "Cs-137", 1.0, concrete=0.2))), rel=0.02
    )


@pytest.mark.parametrize("kind", ["physical", "paper_ideal"])
@pytest.mark.parametrize("wall_m", [0.0, 0.1])
def test_every_shipped_nuclide_is_identified(library: Library, detectors: Detectors, kind: str, wall_m: float) -> None:
    """150 cps over 60 s, free and behind 10 cm of concrete."""
    detector = detectors["nai_2x2", kind]
    mean = np.stack([spectrum(detector, n, 150.0, concrete=wall_m) for n in library.nuclide_names])
    counts = np.random.default_rng(2).poisson((mean + np.asarray(detector.background_spectrum)) * LIVE_S)
    found = run(detector, counts, LIVE_S)
    names = [library.nuclide_names[i] if i >= 0 else "none" for i in np.asarray(found.nuclide)]
    assert names == list(library.nuclide_names)
    assert np.all(np.asarray(found.confidence) > 0.6)
    np.testing.assert_allclose(np.sum(found.fit, axis=1), np.sum(counts, axis=1), rtol=0.02)


def test_bare_background_has_no_nuclide(detectors: Detectors) -> None:
    for kind in ("physical", "paper_ideal"):
        for name in ("nai_1p5x1p5", "nai_2x2"):
            found = draws(detectors[name, kind], jnp.zeros(1024), 30, seed=3)
            assert np.mean(found.nuclide >= 0) <= 0.05
            assert np.mean(found.none) > 0.8


def test_confidence_grows_with_counts(detectors: Detectors) -> None:
    detector = detectors["nai_2x2", "physical"]
    co60 = detector.nuclide_names.index("Co-60")
    found = [draws(detector, spectrum(detector, "Co-60", cps), 30) for cps in (0.3, 3.0, 8.0, 60.0)]
    chance = [float(np.mean(f.posterior[:, co60])) for f in found]
    assert chance[0] < 0.15
    assert chance == sorted(chance)
    assert chance[-1] > 0.98


def test_no_data_is_the_prior(detectors: Detectors) -> None:
    found = run(detectors["nai_2x2", "physical"], np.zeros((1, 1024)), 0.0)
    assert found.nuclide[0] == -1
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(found))
    assert found.confidence[0] < 0.8


def test_confidence_is_calibrated(detectors: Detectors) -> None:
    """Of the nuclides named at confidence c, a share of c is right, over random nuclides, strengths, walls."""
    detector = detectors["nai_2x2", "physical"]
    rng = np.random.default_rng(11)
    n = 240
    nuclide = rng.integers(len(detector.nuclide_names), size=n)
    strength = 50.0 * np.abs(np.tan(0.5 * np.pi * rng.random(n))).clip(0, 40)
    walls = rng.choice([0.0, 0.03, 0.1], size=n)
    present = rng.random(n) < 0.55
    shapes = {
        (i, w): np.asarray(spectrum(detector, name, 1.0, concrete=w))
        for i, name in enumerate(detector.nuclide_names)
        for w in (0.0, 0.03, 0.1)
    }
    mean = np.stack([p * s * shapes[i, w] for i, s, w, p in zip(nuclide, strength, walls, present, strict=True)])
    mean = (mean + np.asarray(detector.background_spectrum)) * 20.0
    found = run(detector, rng.poisson(mean), 20.0)
    named = np.asarray(found.nuclide) >= 0
    right = named & present & (np.asarray(found.nuclide) == nuclide)
    confidence = np.asarray(found.confidence)
    assert named.sum() > 60
    for low, high in ((0.0, 0.8), (0.8, 0.98), (0.98, 1.01)):
        chosen = named & (confidence >= low) & (confidence < high)
        if chosen.sum() >= 5:
            claimed, seen = confidence[chosen].mean(), right[chosen].mean()
            assert seen > claimed - 3 * np.sqrt(max(claimed * (1 - claimed), 0.01) / chosen.sum())


def test_a_mixture_names_both(detectors: Detectors) -> None:
    detector = detectors["nai_2x2", "physical"]
    both = spectrum(detector, "Co-60", 120.0) + spectrum(detector, "Cs-137", 60.0)
    found = draws(detector, both, 6, seed=5)
    co60, cs137 = (detector.nuclide_names.index(n) for n in ("Co-60", "Cs-137"))
    assert np.all(np.asarray(found.posterior)[:, [co60, cs137]] > 0.9)
    assert np.all(np.asarray(found.nuclide) == co60)
    np.testing.assert_allclose(np.mean(found.strength_cps, axis=0)[[co60, cs137]], (120, 60), rtol=0.25)


def test_prior_sums_to_one() -> None:
    for nuclides in (1, 2, 7):
        members, continua, log_prior = hypotheses(nuclides)
        assert len(members) == len(continua) == len(log_prior) == 2 + nuclides + nuclides * (nuclides - 1) // 2
        assert np.exp(log_prior).sum() == pytest.approx(1.0)
