import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.stats import poisson

from swarmsim.estimation import cramer_rao_covariance, fisher_information, net_rates
from swarmsim.estimation.likelihood import (
    FitProblem,
    evaluate,
    poisson_log_likelihood,
    position_covariance,
    scaled_inverse,
    travel_gain,
)
from swarmsim.radiation import Source, net_rate
from swarmsim.site import crossed
from tests.estimation.survey import NUCLIDE, detector, draw, mean_rates, orbit, place, survey

_information = jax.jit(fisher_information)
SOURCE, ACTIVITY = jnp.array([12.0, 4.0, 1.0]), 170e6


@given(seed=st.integers(0, 2**31), level=st.floats(0.05, 3000.0), factor=st.floats(0.7, 1.4))
def test_float32_likelihood_ratio_equals_float64(seed, level, factor):
    rng = np.random.default_rng(seed)
    mean = level * rng.uniform(0.5, 2.0, 900)
    counts = rng.poisson(mean)
    candidates = np.float32(mean), np.float32(mean * (1.0 + (factor - 1.0) * rng.random(900)))
    exact = [poisson.logpmf(counts, np.float64(c)).sum() for c in candidates]
    ours = [poisson_log_likelihood(jnp.float32(counts), jnp.asarray(c), jnp.ones(900, bool)) for c in candidates]
    np.testing.assert_allclose(ours[1] - ours[0], exact[1] - exact[0], rtol=2e-5, atol=1e-3)


def test_likelihood_survives_a_model_without_rate():
    value = poisson_log_likelihood(jnp.array([3.0, 0.0]), jnp.zeros(2), jnp.ones(2, bool))
    assert np.isfinite(value)
    assert value < -30.0


def test_net_rates_are_those_of_the_radiation_model_for_every_detector():
    site = place([((0.0, 0.0, 2.0), (3.0, 2.0, 2.0), "concrete")])
    detectors = (detector(), detector(model="nai_2x2"))
    m = orbit((0.0, 0.0), 9.0, 10)
    m = jax.tree.map(lambda a, b: jnp.concatenate([a[::200], b]), survey(), m)
    rates = jax.jit(net_rates)(site, detectors, m, SOURCE, NUCLIDE)
    source = Source(position_m=SOURCE, activity_bq=jnp.ones(()), nuclide=NUCLIDE)
    one = jax.jit(lambda d, place, axis: net_rate(d, source, crossed(site, SOURCE, place), place, axis))
    for i in range(m.counts.shape[0]):
        expected = one(detectors[int(m.detector[i])], m.position_m[i], m.axis[i])
        np.testing.assert_allclose(rates[i], expected, rtol=1e-5)


def test_information_of_an_inverse_square_law_in_closed_form():
    site, d = place(), (detector("paper_ideal"),)
    m = survey(count=300, lines=5)
    net = np.asarray(ACTIVITY * jax.jit(net_rates)(site, d, m, SOURCE, NUCLIDE), np.float64)
    mean = np.asarray(mean_rates(site, d, m, [(SOURCE, ACTIVITY)]), np.float64)
    information = np.asarray(_information(site, d, m, SOURCE, ACTIVITY, NUCLIDE))
    lam = net + float(d[0].background_cps)
    slope = (mean / lam) * (1.0 - lam * float(d[0].paralyzable_s))
    np.testing.assert_allclose(information[3, 3], np.sum((slope * net) ** 2 / mean), rtol=1e-4)
    background = slope * float(d[0].background_cps)
    np.testing.assert_allclose(information[3, 4], np.sum(slope * net * background / mean), rtol=1e-4)
    np.testing.assert_allclose(information[4, 4], np.sum(background**2 / mean), rtol=1e-4)
    offset = np.asarray(SOURCE - m.position_m, np.float64)
    r, a = np.linalg.norm(offset, axis=1), float(d[0].radius_m)
    height, length = np.abs(offset[:, 2]), float(d[0].length_m)
    rho = np.hypot(offset[:, 0], offset[:, 1])
    # rate ~ (pi a^2 h + 2 a L rho) / r^3: silhouettes of the ends and of the side.
    shape = np.pi * a**2 * height + 2 * a * length * rho
    by_x = net * (2 * a * length * offset[:, 0] / rho / shape - 3.0 * offset[:, 0] / r**2)
    np.testing.assert_allclose(information[0, 0], np.sum((slope * by_x) ** 2 / mean), rtol=2e-3)


def test_score_has_zero_mean_and_the_information_as_covariance():
    site, d = place([((10.0, 0.0, 1.5), (1.0, 3.0, 1.5), "brick")]), (detector(),)
    m = survey(count=231)
    rates = mean_rates(site, d, m, [(SOURCE, ACTIVITY)])
    theta = jnp.array([12.0, 4.0, 1.0, np.log(ACTIVITY), 0.0])

    def score(key):
        problem = FitProblem(
            site=site,
            detectors=d,
            measurements=draw(m, rates, key),
            nuclide=NUCLIDE,
            natural=jnp.ones(231),
            extra_cps=jnp.zeros(231),
            height_m=jnp.float32(1.0),
            height_std_m=jnp.float32(jnp.inf),
            rays=1,
        )
        found = evaluate(problem, theta)
        return found.score, found.information

    keys = jax.random.split(jax.random.key(2), 512)
    scores, information = jax.jit(lambda k: jax.lax.map(score, k, batch_size=64))(keys)
    sigma = np.sqrt(np.diag(information[0]))
    unit = np.asarray(scores) / sigma
    expected = np.asarray(information[0]) / np.outer(sigma, sigma)
    assert np.max(np.abs(unit.mean(axis=0))) < 4.0 / np.sqrt(512)
    np.testing.assert_allclose(np.cov(unit.T), expected, atol=4.0 * np.sqrt(2.0 / 512))


def test_the_reference_floor_of_the_published_survey():
    """0.55 m (ideal) and 1.42 m (physical, uncollided) per axis.

    Air adds counts to the physical one (0.96 m), and the ground as many again as reach it from the source (0.50 m).
    """
    bounds = {}
    for kind in ("paper_ideal", "physical"):
        information = _information(place(), (detector(kind),), survey(), SOURCE, ACTIVITY, NUCLIDE)
        bounds[kind] = np.sqrt(np.diag(cramer_rao_covariance(information, 0.0)))
    assert 0.4 < bounds["paper_ideal"][0] < 0.6
    assert 0.45 < bounds["physical"][0] < 0.6
    assert 0.015 < bounds["paper_ideal"][3] < 0.03
    assert 0.015 < bounds["physical"][3] < 0.03


def test_the_bound_shrinks_with_the_time_measured_and_grows_with_less_prior_knowledge():
    m = survey(count=300)
    information = _information(place(), (detector(),), m, SOURCE, ACTIVITY, NUCLIDE)
    double = _information(
        place(), (detector(),), jax.tree.map(lambda a: jnp.concatenate([a, a]), m), SOURCE, ACTIVITY, NUCLIDE
    )
    np.testing.assert_allclose(double, 2.0 * information, rtol=1e-3)
    known, vague, free = (cramer_rao_covariance(information, s)[3, 3] for s in (0.0, 0.5, jnp.inf))
    assert known < vague < free


def test_the_vertical_uncertainty_follows_a_slope():
    covariance = jnp.diag(jnp.array([4.0, 1.0, 0.01, 1.0, 1.0]))
    turned = position_covariance(place(slope=(0.2, 0.0)), jnp.zeros(5), covariance)
    np.testing.assert_allclose(turned[2, 2], 0.2**2 * 4.0 + 0.01, rtol=1e-4)
    np.testing.assert_allclose(turned[0, 2], 0.2 * 4.0, rtol=1e-4)


@given(seed=st.integers(0, 2**31))
def test_inverse_of_matrices_with_entries_of_many_decades(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(5, 8))
    scale = 10.0 ** rng.uniform(-6, 6, 5)
    matrix = scale[:, None] * (root @ root.T) * scale
    ours = np.asarray(scaled_inverse(jnp.asarray(matrix, jnp.float32)), np.float64)
    product = (ours * scale[:, None] * scale) @ (root @ root.T)
    np.testing.assert_allclose(product, np.eye(5), atol=0.03)


@given(st.lists(st.floats(-8.0, 8.0), min_size=6, max_size=6))
def test_travel_gain_is_the_mean_of_inverse_square_over_the_way(numbers):
    offset, travel = np.array(numbers[:3]), 0.4 * np.array(numbers[3:])
    part = (np.arange(4000) + 0.5) / 4000 - 0.5
    squared = np.sum((offset + part[:, None] * travel) ** 2, axis=1)
    assume(squared.min() > 0.05)
    expected = np.mean(1.0 / squared) * np.sum(offset**2)
    gain = travel_gain(jnp.array(offset, jnp.float32)[None], jnp.array(travel, jnp.float32)[None])
    assert float(gain[0]) == pytest.approx(expected, rel=2e-3)
