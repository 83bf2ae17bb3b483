"""Identification of nuclides, mixtures and strangers in spectra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.errors import InputError
from swarmsim.config.load import load_named
from swarmsim.radiation import Detector, Identification, Library, build_detector, identify, spectrum_rate
from swarmsim.radiation.detector import AIR
from swarmsim.radiation.identify import NONE, UNKNOWN, _present
from swarmsim.radiation.laplace import COLUMNS, Data, Hypothesis, laplace
from swarmsim.radiation.lines import ORDERS
from swarmsim.radiation.rate import end_on, mean_view
from swarmsim.radiation.templates import shielded, thickness_m
from tests.radiation.points import MOUNT, point, through

pytestmark = pytest.mark.optimised

UP, PLACE = jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 0.0, 5.0])
LIVE_S = 60.0
Detectors = dict[tuple[str, str], Detector]
BATCH = 30
_run = jax.jit(jax.vmap(identify, in_axes=(None, 0, None)))
_viewed = jax.jit(identify)


def test_certainty_is_no_more_than_one() -> None:
    """All chances are of hypotheses with one nuclide: they sum to 1 but for the rounding of single precision."""
    rng, nuclides, stages = np.random.default_rng(0), 12, 4
    base = np.zeros((stages, nuclides), np.float32)
    base[1:, 0] = 1.0
    for _ in range(100):
        score = rng.normal(size=(stages, nuclides))
        score[0, 1:] = score[1:, 0] = -np.inf
        chance = jax.nn.softmax(jnp.asarray(score.ravel(), jnp.float32)).reshape(stages, nuclides)
        present = np.asarray(_present(chance, jnp.asarray(base)))
        assert 1.0 - 1e-5 < present[0] <= 1.0
        assert present[1:].sum() + float(chance[0, 0]) == pytest.approx(1.0, abs=1e-5)


def spectrum(detector: Detector, nuclide: str, cps: float, **metres: float) -> jax.Array:
    """Source spectrum [channels] scaled to ``cps``."""
    channels = spectrum_rate(detector, point(detector, nuclide), through(detector, **{"air": 5.0} | metres), PLACE, UP)
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


@pytest.mark.slow
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
    above = slice(detector.identification_bins[0], None)
    np.testing.assert_allclose(np.sum(found.fit[:, above], axis=1), np.sum(counts[:, above], axis=1), rtol=0.02)


@pytest.mark.slow
def test_the_fit_in_channels_is_the_spectrum(library: Library, detectors: Detectors) -> None:
    """Without noise: in every channel about the peak within 3 % of the largest. Lines between bins were 8 % off."""
    detector = detectors["nai_2x2", "physical"]
    mean = np.asarray(spectrum(detector, "Cs-137", 500.0)) + np.asarray(detector.background_spectrum)
    found = run(detector, (mean * LIVE_S)[None], LIVE_S)
    first, energy = detector.identification_bins[0], np.asarray(detector.energy_kev)
    peak = slice(int(np.searchsorted(energy, 560.0)), int(np.searchsorted(energy, 760.0)))
    off = np.abs(np.asarray(found.fit)[0] - mean * LIVE_S)
    assert np.max(off[peak]) / (LIVE_S * np.max(mean[peak])) < 0.03
    assert np.all(np.asarray(found.fit)[0, first - 1 :] > 0.0)


def test_a_spectrum_of_a_hundred_million_counts_is_named(library: Library, detectors: Detectors) -> None:
    """Beside a source of 200 GBq sums over such counts had no digits left, and the answer was background."""
    detector = detectors["nai_2x2", "physical"]
    mean = np.asarray(spectrum(detector, "Cs-137", 1e8 / LIVE_S)) + np.asarray(detector.background_spectrum)
    found = run(detector, np.round(mean * LIVE_S)[None], LIVE_S)
    assert detector.nuclide_names[int(found.nuclide[0])] == "Cs-137"
    assert found.confidence[0] > 0.999
    assert 0.0 <= float(found.goodness[0]) <= 1.0
    assert float(np.sum(found.fit[0])) == pytest.approx(1e8, rel=0.02)
    assert float(np.sum(found.strength_cps[0])) == pytest.approx(1e8 / LIVE_S, rel=0.02)


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
    assert found.nuclide[0] == NONE
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


def test_nuclides_above_the_ground_are_identified(library: Library, detectors: Detectors) -> None:
    """However much the ground shines, bare and behind a wall."""
    detector = detectors["nai_2x2", "physical"]
    numbers, live = jnp.arange(len(library.nuclide_names)), 40.0
    concrete = jnp.arange(len(detector.material_names)) == detector.material_names.index("concrete")
    for wall_m, above in ((0.0, 0.4), (0.0, 1.0), (0.05, 0.8)):
        mean = np.asarray(jax.vmap(lambda k, w=wall_m, g=above: shielded(detector, k, w * concrete, 0.5, g))(numbers))
        mean = 80.0 * mean / mean.sum(axis=1, keepdims=True) + np.asarray(detector.background_spectrum)
        found = run(detector, np.random.default_rng(10).poisson(mean * live), live)
        assert np.mean(found.nuclide == np.arange(len(mean))) >= 0.96
        assert np.median(found.goodness) > 0.05


def test_scattering_by_air_and_the_ground_is_no_nuclide(library: Library, detectors: Detectors) -> None:
    """10,000 counts, 5 m away above a ground: between the templates of air and those of the ground, as most are."""
    detector = detectors["nai_2x2", "physical"]
    numbers, live = np.arange(len(library.nuclide_names)), 40.0
    air = jnp.arange(len(detector.material_names)) == detector.material_names.index(AIR)
    mean = np.asarray(jax.vmap(lambda k: shielded(detector, k, 5.0 * air, 0.5, 0.3))(numbers))
    mean = 1e4 / live * mean / mean.sum(axis=1, keepdims=True) + np.asarray(detector.background_spectrum)
    found = run(detector, np.round(mean * live), live)
    absent = np.asarray(found.posterior).copy()
    absent[numbers, numbers] = 0.0
    assert np.mean(absent.max(axis=1) > 0.5) <= 0.1
    assert np.all(found.nuclide == numbers)


@pytest.mark.parametrize("wall", ["lead", "steel"])
def test_a_nuclide_behind_two_shields_is_one(detectors: Detectors, wall: str) -> None:
    """Half of the counts from the way in the open, half from behind a wall: no template, and no second nuclide."""
    detector = detectors["nai_2x2", "physical"]
    numbers, net = np.arange(len(detector.nuclide_names)), 3000.0
    is_wall = jnp.arange(len(detector.material_names)) == detector.material_names.index(wall)

    def half(k: jax.Array, depth: float) -> jax.Array:
        found = shielded(detector, k, thickness_m(detector, k, jnp.argmax(is_wall), jnp.float32(depth)) * is_wall)
        return 0.5 * found / jnp.sum(found)

    live = net / float(detector.background_cps)
    rng, right, absent = np.random.default_rng(0), [], []
    for depth in (2.0, 5.0):
        mean = np.asarray(jax.vmap(lambda k, d=depth: half(k, 0.0) + half(k, d))(jnp.asarray(numbers)))
        found = run(detector, rng.poisson(mean * net + np.asarray(detector.background_spectrum) * live), live)
        right.append(found.nuclide == numbers)
        others = np.asarray(found.posterior).copy()
        others[numbers, numbers] = 0.0
        absent.append(others.max(axis=1) > 0.9)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    assert np.mean(right) >= 0.94
    assert np.mean(absent) <= 0.1


def test_a_fit_that_comes_to_nothing_has_the_least_score(detectors: Detectors) -> None:
    """Two sources alike but for their scattered photons, far from the counts: single precision loses the steps."""
    bins, rng = 60, np.random.default_rng(0)
    shape = np.exp(-np.linspace(0.0, 6.0, bins)) + 1e-3
    column = np.zeros((COLUMNS, ORDERS, bins), np.float32)
    column[:, 0] = shape / shape.sum() * (1.0 + 1e-6 * rng.normal(size=(COLUMNS, bins)))
    alike = Hypothesis(
        column=jnp.asarray(column), scale=jnp.full(COLUMNS, 1e20), strength=jnp.zeros(COLUMNS).at[2].set(1.0),
        start=jnp.full(COLUMNS, 1e25), gain=jnp.float32(1.0),
    )  # fmt: skip
    data = Data(jnp.full(bins, 1e3), jnp.ones(bins), jnp.float32(1e3), jnp.float32(300.0))
    fit = laplace(alike, data)
    assert fit.score <= -1e5
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(fit))


def test_a_mixture_names_both(detectors: Detectors) -> None:
    detector = detectors["nai_2x2", "physical"]
    both = spectrum(detector, "Co-60", 120.0) + spectrum(detector, "Cs-137", 60.0)
    found = draws(detector, both, 6, seed=5)
    co60, cs137 = (detector.nuclide_names.index(n) for n in ("Co-60", "Cs-137"))
    assert np.all(np.asarray(found.posterior)[:, [co60, cs137]] > 0.9)
    assert np.all(np.asarray(found.nuclide) == co60)
    np.testing.assert_allclose(np.mean(found.strength_cps, axis=0)[[co60, cs137]], (120, 60), rtol=0.25)


def test_strengths_are_the_counts_of_the_sources(detectors: Detectors) -> None:
    """Also where far more photons are scattered than in the templates, or fewer: both columns of a source count."""
    detector = detectors["nai_2x2", "physical"]
    air = jnp.arange(len(detector.material_names)) == detector.material_names.index(AIR)
    ways, names = ((0.3, 0.0), (2.0, 0.1), (2.0, 1.0), (12.0, 0.0)), ("Co-60", "Cs-137", "Ba-133", "Eu-152", "Tc-99m")
    cases = [(detector.nuclide_names.index(name), metres, above) for metres, above in ways for name in names]
    mean = np.stack([np.asarray(shielded(detector, k, metres * air, 0.5, above)) for k, metres, above in cases])
    mean = 1500.0 * mean / mean.sum(axis=1, keepdims=True) + np.asarray(detector.background_spectrum)
    found = run(detector, np.round(mean * LIVE_S), LIVE_S)
    np.testing.assert_allclose(found.strength_cps.sum(axis=1), 1500.0, rtol=0.1)


@pytest.mark.parametrize("fault", ["negative", "none", "no time", "background taken off"])
def test_what_is_no_spectrum_has_no_name(detectors: Detectors, fault: str) -> None:
    detector = detectors["nai_2x2", "physical"]
    counts, live = np.asarray(spectrum(detector, "Co-60", 100.0)) * LIVE_S, LIVE_S
    if fault == "negative":
        counts[100] = -1.0
    elif fault == "none":
        counts[100] = np.nan
    elif fault == "background taken off":
        counts -= 40.0
    else:
        live = 0.0
    found = run(detector, counts[None], live)
    assert (found.nuclide[0], found.confidence[0], found.goodness[0]) == (UNKNOWN, 0.0, 0.0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


def test_a_spectrum_of_other_channels_is_refused(detectors: Detectors) -> None:
    with pytest.raises(InputError, match="channels"):
        identify(detectors["nai_2x2", "physical"], jnp.ones(512), jnp.float32(60.0))


def drifted(detector: Detector, mean: np.ndarray, gain: float) -> np.ndarray:
    """A mean spectrum [n, channels] after a change of gain."""
    channel = np.arange(mean.shape[1] + 1)
    below = np.pad(np.cumsum(mean, axis=1), ((0, 0), (1, 0)))
    return np.stack([np.diff(np.interp(channel / gain, channel, row)) for row in below])


@pytest.mark.parametrize("gain", [0.97, 1.03])
def test_drift_of_the_gain_is_found(library: Library, detectors: Detectors, gain: float) -> None:
    detector = detectors["nai_2x2", "physical"]
    mean = np.stack([spectrum(detector, n, 80.0, concrete=0.03) for n in library.nuclide_names])
    mean = drifted(detector, mean + np.asarray(detector.background_spectrum), gain)
    found = run(detector, np.random.default_rng(4).poisson(mean * 40.0), 40.0)
    assert np.mean(found.nuclide == np.arange(len(mean))) >= 0.96
    assert np.median(found.gain) == pytest.approx(gain, abs=0.006)


@pytest.mark.slow
def test_a_stranger_is_unknown(library: Library) -> None:
    """A nuclide that the tables lack: unknown at 1500 counts, and what the tables hold is not."""
    strangers = ("Cs-137", "Zn-65", "Tc-99m", "F-18", "Bi-207")
    spec = load_named("detectors", "nai_2x2")
    whole = build_detector(spec, MOUNT, library, "physical")
    known = tuple(n for n in library.nuclides if n.name not in strangers)
    detector = build_detector(spec, MOUNT, Library(known, library.materials), "physical")
    live = 1500.0 / (0.5 * 167.0)
    for names, expected in ((strangers, [UNKNOWN] * 5), (detector.nuclide_names, list(range(len(known))))):
        mean = np.stack([spectrum(whole, n, 83.5) for n in names]) + np.asarray(whole.background_spectrum)
        found = run(detector, np.random.default_rng(6).poisson(mean * live), live)
        assert list(found.nuclide) == expected
        assert np.all(found.confidence > 0.5)


@pytest.mark.parametrize("nuclide", ["Ba-133", "Eu-152"])
def test_a_source_close_by_and_from_the_side_fits(detectors: Detectors, nuclide: str) -> None:
    """400,000 counts: X-rays count more over harder photons than end on, by up to a half. Far away, end on is right."""
    detector = detectors["nai_2x2", "physical"]
    offsets = jnp.array([[6.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.6, 0.0, 0.6], [0.0, 0.0, 50.0]])
    source, live = point(detector, nuclide), 90.0
    for number, offset in enumerate(offsets):
        mean = np.asarray(spectrum_rate(detector, source, through(detector), source.position_m - offset, UP))
        mean = mean * 4e5 / mean.sum() + np.asarray(detector.background_spectrum) * live
        counts = np.random.default_rng(number).poisson(mean).astype(np.float32)
        view = mean_view(detector, offset[None], UP[None], jnp.ones(1))
        fits = _viewed(detector, counts, live, view)
        assert detector.nuclide_names[int(fits.nuclide)] == nuclide
        assert fits.goodness > 0.01
        if number == 3:
            np.testing.assert_allclose(view, end_on(), rtol=2e-3, atol=1e-4)
        elif number == 2:
            assert _viewed(detector, counts, live, end_on()).goodness < 0.01


def test_a_view_is_the_mean_over_the_way(detectors: Detectors) -> None:
    """Weighted with the time and with 1 / (r^2 + S^2), which is how much of the spectrum each place adds."""
    detector = detectors["nai_2x2", "physical"]
    offsets, weight = jnp.array([[3.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.1, 0.2, 0.2]]), jnp.array([2.0, 1.0, 0.0])
    axes = jnp.broadcast_to(UP, offsets.shape)
    one = [mean_view(detector, offsets[k : k + 1], axes[:1], jnp.ones(1)) for k in range(2)]
    reach2 = float(detector.radius_m**2 + 0.25 * detector.length_m**2)
    share = np.array([2.0 / (9.0 + reach2), 1.0 / (1.0 + reach2)])
    expected = (share[0] * one[0] + share[1] * one[1]) / share.sum()
    np.testing.assert_allclose(mean_view(detector, offsets, axes, weight), expected, rtol=1e-5)
    np.testing.assert_array_equal(mean_view(detector, offsets, axes, jnp.zeros(3)), end_on())
    padded = mean_view(detector, offsets.at[2].set(jnp.nan), axes.at[2].set(jnp.inf), weight)
    np.testing.assert_allclose(padded, expected, rtol=1e-5)


def test_three_nuclides_are_named(detectors: Detectors) -> None:
    detector = detectors["nai_2x2", "physical"]
    names = ("Am-241", "Co-60", "Cs-137")
    found = draws(detector, jnp.sum(jnp.stack([spectrum(detector, n, 100.0) for n in names]), axis=0), 6, seed=7)
    chosen = [detector.nuclide_names.index(n) for n in names]
    assert np.mean(np.all(np.asarray(found.posterior)[:, chosen] > 0.9, axis=1)) > 0.8
    assert np.all(np.delete(np.asarray(found.posterior), chosen, axis=1) < 0.1)
    assert np.all(np.abs(found.gain - 1.0) < 0.004)
    assert np.all(np.abs(found.width - 1.0) < 0.06)
    assert np.median(found.goodness) > 0.05


def test_random_mixtures_are_named(detectors: Detectors) -> None:
    """Two or three nuclides of the library in 1 to 50 m of air behind a wall: every name at 20,000 counts in most."""
    detector = detectors["nai_2x2", "physical"]
    rng, thickest_m = np.random.default_rng(12), {"concrete": 0.05, "steel": 0.01, "lead": 0.001}
    chosen, mean = np.zeros((BATCH, len(detector.nuclide_names)), bool), []
    for row in range(BATCH):
        numbers = rng.choice(len(detector.nuclide_names), 2 + row % 2, replace=False)
        chosen[row, numbers] = True
        wall = rng.choice(list(thickest_m))
        walls = {str(wall): float(rng.uniform(0.0, thickest_m[wall])), "air": float(rng.uniform(1.0, 50.0))}
        channels = [spectrum(detector, detector.nuclide_names[n], 1.0, **walls) for n in numbers]
        mean.append(80.0 * np.mean(np.asarray(channels), axis=0) + np.asarray(detector.background_spectrum))
    found = run(detector, rng.poisson(np.stack(mean) * 250.0), 250.0)
    named = np.asarray(found.posterior) > 0.9
    assert np.mean(np.all(named >= chosen, axis=1)) > 0.85
    assert np.mean(np.any(named & ~chosen, axis=1)) < 0.1
    assert np.mean(np.asarray(found.unknown) > 0.5) < 0.1


def test_thickness_gives_its_optical_depth(detectors: Detectors) -> None:
    detector = detectors["nai_2x2", "physical"]
    lead, manganese = detector.material_names.index("lead"), detector.nuclide_names.index("Mn-54")  # of one line
    attenuation = float(detector.attenuation_1_m[manganese, 0, lead])
    found = thickness_m(detector, jnp.int32(manganese), jnp.int32(lead), jnp.float32(2.0))
    assert float(found) == pytest.approx(2.0 / attenuation, rel=1e-4)


def test_a_counter_without_energy_resolution_is_refused(library: Library) -> None:
    detector = build_detector(load_named("detectors", "geiger_sbm20"), MOUNT, library, "physical")
    with pytest.raises(InputError, match="energy resolution"):
        identify(detector, jnp.ones(1), jnp.float32(1.0))
