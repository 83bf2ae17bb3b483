"""The p-value of a fit to a spectrum."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import kstest

from swarmsim.radiation.goodness import p_value


def test_goodness_is_a_p_value() -> None:
    """Uniform over counts of the expectation, whether few or many are expected, and small for others."""
    rng = np.random.default_rng(8)
    for scale in (0.2, 3.0, 100.0):
        expected = jnp.asarray(scale * rng.uniform(0.2, 2.0, 170), jnp.float32)
        counts = rng.poisson(np.asarray(expected), (400, 170)).astype(np.float32)
        values = jax.vmap(lambda row, e=expected: p_value(row, e, jnp.ones(170), 0.0))(counts)
        assert kstest(np.asarray(values), "uniform").pvalue > 0.01
    assert float(p_value(jnp.asarray(counts[0]), expected * 1.3, jnp.ones(170), 0.0)) < 1e-4


def test_goodness_allows_for_the_error_of_the_model() -> None:
    """Uniform where the expectation is off by that error in each bin, which the counts show."""
    rng = np.random.default_rng(9)
    mean = rng.uniform(200.0, 1000.0, 170)
    counts = rng.poisson(mean * np.maximum(1.0 + 0.03 * rng.standard_normal((400, 170)), 0.0)).astype(np.float32)
    expected = jnp.asarray(mean, jnp.float32)
    values = jax.vmap(lambda row: p_value(row, expected, jnp.ones(170), 0.0, 0.03))(counts)
    assert kstest(np.asarray(values), "uniform").pvalue > 0.01
    assert np.median(jax.vmap(lambda row: p_value(row, expected, jnp.ones(170), 0.0))(counts)) < 0.01
