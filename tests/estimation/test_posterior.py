"""The sampled posterior against its integral on a grid, in the open and beside a wall."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.estimation.likelihood import FitProblem, evaluate, scaled_inverse
from swarmsim.estimation.posterior import sample_posterior
from swarmsim.estimation.search import background_only, best_at, bounds
from tests.estimation.survey import NUCLIDE, detector, draw, mean_rates, place, survey

SOURCE, ACTIVITY = jnp.array([12.0, 4.0, 1.0]), 170e6
THETA = jnp.array([12.0, 4.0, 1.0, jnp.log(ACTIVITY), 0.0])
WALLS = [((9.5, 4.0, 1.5), (0.05, 4.0, 1.5), "concrete"), ((12.0, 6.2, 1.5), (2.5, 0.05, 1.5), "concrete")]


def problem_of(boxes, seed):
    """What a survey of 231 windows at 12 m tells of a source whose height is known."""
    site, d, flight = place(boxes), (detector(),), survey(altitude=12.0, count=231)
    m = draw(flight, mean_rates(site, d, flight, [(SOURCE, ACTIVITY)]), seed)
    m = jax.tree.map(lambda leaf: leaf[jnp.argsort(m.position_m[:, 2])], m)
    return FitProblem(
        site=site, detectors=d, measurements=m, nuclide=NUCLIDE, natural=jnp.ones(231), extra_cps=jnp.zeros(231),
        height_m=jnp.float32(1.0), height_std_m=jnp.float32(1e-3), rays=1,
    )  # fmt: skip


@jax.jit
def _sample(problem, start):
    log_scale, _ = background_only(problem)
    covariance = scaled_inverse(evaluate(problem, THETA).information)
    return sample_posterior(problem, bounds(problem), start, covariance, log_scale, 6, 64)


@jax.jit
def _grid(problem, places):
    log_scale, _ = background_only(problem)
    return jax.lax.map(lambda p: best_at(problem, p, log_scale)[:2], places)


def integral(problem):
    """Mean [5] and standard deviations [5] of the posterior on a grid of 0.15 m (activity: of the best ones alone)."""
    x, y = np.meshgrid(np.arange(8.0, 16.51, 0.15), np.arange(0.0, 8.51, 0.15))
    places = jnp.asarray(np.stack([x.ravel(), y.ravel(), np.ones(x.size)], -1), jnp.float32)
    theta, value = (np.asarray(v, np.float64) for v in _grid(problem, places))
    weight = np.exp(value - value.max())
    weight /= weight.sum()
    mean = weight @ theta
    return mean, np.sqrt(weight @ (theta - mean) ** 2)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("boxes", [[], WALLS], ids=["open", "walls"])
def test_moments_are_those_of_the_integral(boxes, seed):
    problem = problem_of(boxes, seed)
    mean, std = integral(problem)
    found = _sample(problem, THETA)
    sampled = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(np.asarray(found.mean)[:2] - mean[:2]) < 0.15 * std[:2])
    assert abs(float(found.mean[3]) - mean[3]) < 0.15 * float(sampled[3])
    np.testing.assert_allclose(sampled[:2], std[:2], rtol=0.2)
    assert float(found.effective) > 16.0


def test_the_mean_does_not_depend_on_where_sampling_starts():
    problem = problem_of(WALLS, 1)
    std = integral(problem)[1][:2]
    means = [
        _sample(problem, THETA + jnp.array([dx, dy, 0, 0, 0])).mean[:2] for dx, dy in ((0, 0), (0.5, -0.4), (-0.6, 0.2))
    ]
    assert np.all(np.ptp(np.asarray(means), axis=0) < 0.3 * std)


def test_activity_spread_includes_its_own_at_each_place():
    """On open ground it is that of the information, of which the place's part is less than half."""
    problem = problem_of([], 0)
    found = _sample(problem, THETA)
    expected = np.sqrt(np.asarray(scaled_inverse(evaluate(problem, THETA).information))[3, 3])
    np.testing.assert_allclose(np.sqrt(found.covariance[3, 3]), expected, rtol=0.15)


def test_without_any_measurement_the_moments_are_finite():
    problem = problem_of([], 0)
    m = problem.measurements
    nothing = replace(problem, measurements=replace(m, valid=jnp.zeros_like(m.valid)))
    found = _sample(nothing, THETA)
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(found))
