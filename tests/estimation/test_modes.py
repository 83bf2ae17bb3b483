"""Likely places of a source among walls against the posterior by fits on a grid."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.mission import Knowledge
from swarmsim.estimation.localise import problem_of
from swarmsim.estimation.modes import modes_around
from swarmsim.estimation.search import bounds
from swarmsim.estimation.state import without
from tests.estimation.survey import detector, drawn_of_one, place, presumed, survey
from tests.estimation.test_posterior import SPANS, _grid, _state

ACTIVITY = 25e6
COUNT = 96


@jax.jit
def _modes(problem, state):
    u = replace(state.unknowns, activity_bq=state.sources.activity_bq[0])
    return modes_around(problem, state, jnp.int32(0), without(state, jnp.int32(0)).added, u, COUNT)[0]


def among_walls(seed):
    """What a survey tells of a source among eight walls at random, and the state with the likeliest place of a grid."""
    rng = np.random.default_rng(seed)
    at, far, angle = jnp.array([12.0, 4.0, 1.0]), rng.uniform(2.0, 7.0, 8), rng.uniform(0.0, 2.0 * np.pi, 8)
    middle = np.stack([12.0 + far * np.cos(angle), 4.0 + far * np.sin(angle), np.full(8, 1.5)], axis=1)
    walls = [
        (tuple(map(float, m)), (2.0, 0.1, 1.5) if across else (0.1, 2.0, 1.5), "steel")
        for m, across in zip(middle, rng.random(8) < 0.5, strict=True)
    ]
    site, flight = place(walls), survey(altitude=12.0, count=231)
    certain = Knowledge(site="exact", background_std=0.05, model_std=0.01)
    known = presumed(site, (detector(),), knowledge=certain, height_std_m=1e-3)
    problem = problem_of(known, drawn_of_one(site, detector(), flight, at, ACTIVITY, seed), SPANS)
    x, y = np.meshgrid(12.0 + np.arange(-7.5, 7.6, 0.5), 4.0 + np.arange(-7.5, 7.6, 0.5))
    grid = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1).astype(np.float32)
    value = np.asarray(_grid(problem, _state(problem, at), jnp.asarray(grid))[1])
    return problem, _state(problem, jnp.asarray(grid[np.argmax(value)])), grid, float(problem.learning_rate) * value


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_all_that_is_likely_is_among_them(seed):
    problem, state, grid, value = among_walls(seed)
    modes = np.asarray(_modes(problem, state))
    low, high = bounds(problem)
    assert np.all((modes >= low) & (modes <= high))
    weight = np.exp(value - value.max())
    weight /= weight.sum()
    nearest = np.min(np.linalg.norm(grid[:, None, :2] - modes[:, :2], axis=-1), axis=1)
    assert weight[nearest < 0.6].sum() > 0.9
