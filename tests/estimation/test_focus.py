"""A problem with few of its windows, and the sum of the others, against the whole."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.estimation.fit import settle
from swarmsim.estimation.focus import KEPT, focused
from swarmsim.estimation.forward import ways_from
from swarmsim.estimation.posterior import WEIGH_STEPS
from swarmsim.estimation.state import without
from tests.estimation.test_posterior import AT, CO_60, WALLS, told


@jax.jit
def _values(problem, state, places):
    u = replace(state.unknowns, activity_bq=state.sources.activity_bq[0])
    others = without(state, 0).added

    def one(at):
        fit = settle(problem, ways_from(problem, at), CO_60, others, u, WEIGH_STEPS)
        return fit.value, fit.covariance[0, 0], jnp.log(fit.unknowns.activity_bq)

    return jax.lax.map(one, places)


@pytest.mark.parametrize(("boxes", "std"), [([], 1.0), (WALLS, 0.5)])
def test_places_have_the_posterior_that_all_windows_give_them(boxes, std):
    problem, state = told(boxes, 0)
    few, own = jax.jit(focused)(problem, state, jnp.int32(0))
    assert few.background.shape[0] == KEPT < problem.background.shape[0]
    off = np.random.default_rng(0).normal(size=(200, 3)) * [std, std, 0.0]
    places = AT + jnp.asarray(off, jnp.float32)
    (whole, variance, activity), (part, own_variance, own_activity) = (
        np.asarray(_values(*x, places), np.float64) for x in ((problem, state), (few, own))
    )
    likely = whole > whole.max() - 8.0
    assert likely.sum() > 20
    weight = np.exp(whole - whole.max())[likely]
    difference = (part - whole)[likely]
    difference -= weight @ difference / weight.sum()
    assert np.sqrt(weight @ difference**2 / weight.sum()) < 0.4  # of the logarithm of the posterior
    # the background's level is known from all windows, and with it the activity
    np.testing.assert_allclose(own_variance[likely], variance[likely], rtol=0.1)
    np.testing.assert_allclose(own_activity[likely], activity[likely], atol=0.3 * np.sqrt(variance.min()))


def test_few_windows_are_left_as_they_are():
    problem, state = told([], 0)
    few, own = focused(problem, state, jnp.int32(0))
    assert focused(few, own, jnp.int32(0)) == (few, own)


def test_a_window_in_the_edge_of_a_shadow_stays_however_far_off_it_is():
    """Where nothing is in the way those near the source stay; a wall's shadow adds those that it falls on."""
    for boxes in ([], WALLS):
        problem, state = told(boxes, 0)
        few = jax.jit(focused)(problem, state, jnp.int32(0))[0]
        apart = np.linalg.norm(np.asarray(few.measurements.position_m)[:, :2] - np.asarray(AT)[:2], axis=1)
        every = np.linalg.norm(np.asarray(problem.measurements.position_m)[:, :2] - np.asarray(AT)[:2], axis=1)
        nearest = np.sort(every)[KEPT - 1]
        assert (apart > 1.5 * nearest).any() == bool(boxes)
