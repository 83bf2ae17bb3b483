"""Poisson numbers by a fixed number of operations: against the distribution, for small and for large means."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from swarmsim.radiation.poisson import INVERTED_BELOW, _inverted, poisson

N = 100_000
draw = jax.jit(lambda mean: jax.vmap(partial(poisson, mean=mean))(jax.random.split(jax.random.key(11), N)))


@pytest.mark.parametrize("mean", [1e-3, 0.4, 3.0, 9.99, INVERTED_BELOW, 14.0, 97.0, 1500.0])
def test_frequencies_are_those_of_the_distribution(mean):
    drawn = np.asarray(draw(jnp.float32(mean)), np.float64)
    low, high = (int(stats.poisson.ppf(p, mean)) for p in (1e-4, 1.0 - 1e-4))
    counted = np.bincount(np.clip(drawn, low, high).astype(int) - low, minlength=high - low + 1)
    expected = stats.poisson.pmf(np.arange(low, high + 1), mean)
    expected[0], expected[-1] = stats.poisson.cdf(low, mean), stats.poisson.sf(high - 1, mean)
    often = N * expected > 5.0
    chi = np.sum((counted - N * expected)[often] ** 2 / (N * expected[often]))
    assert stats.chi2.sf(chi, max(often.sum() - 1, 1)) > 1e-3


@pytest.mark.parametrize("mean", [1e5, 3e7])
def test_large_means_have_their_moments(mean):
    """The logarithm of the probability would cancel in float32, were it not written as a deviance."""
    drawn = np.asarray(draw(jnp.float32(mean)), np.float64)
    assert abs(drawn.mean() - mean) < 4.0 * np.sqrt(mean / N)
    assert drawn.var() == pytest.approx(mean, rel=4.0 * np.sqrt(2.0 / N))


def test_nothing_comes_of_nothing_and_no_number_of_no_mean():
    np.testing.assert_array_equal(draw(jnp.float32(0.0)), 0.0)
    assert np.isnan(np.asarray(poisson(jax.random.key(0), jnp.float32(np.nan))))


def test_the_largest_uniform_number_gives_what_is_that_rare():
    """The sum of the terms as rounded may stay below it: no number of counts follows from that."""
    means = np.geomspace(1e-3, INVERTED_BELOW, 400)
    largest = jnp.float32(1.0 - 2.0**-23)
    drawn = np.asarray(jax.vmap(lambda mean: _inverted(largest, mean))(jnp.asarray(means, jnp.float32)))
    assert np.all(drawn <= stats.poisson.isf(1e-9, means))
    assert np.all(drawn >= stats.poisson.isf(1e-5, means))
