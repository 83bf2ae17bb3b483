"""How well a Poisson spectrum agrees with its expectation (device side)."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, xlogy
from scipy.special import gammaln
from scipy.special import xlogy as host_xlogy

_MEANS = np.geomspace(1e-3, 1e3, 121)
_COUNTS = np.arange(1400.0)


def deviance(data: jax.Array, expected: jax.Array) -> jax.Array:
    """Poisson deviance [...] of counts from expected counts > 0: twice the loss of log likelihood."""
    return 2.0 * (expected - data + xlogy(data, data / expected))


def p_value(
    data: jax.Array, expected: jax.Array, certainty: jax.Array, fitted: jax.Array | float, error: float = 0.0
) -> jax.Array:
    """Probability [] of a larger deviance than that of ``data`` [bins], if ``expected`` [bins] were the truth.

    ``certainty`` [bins] weighs the bins, ``fitted`` is the number of fitted parameters. Mean and variance of a bin's
    deviance are those of the Poisson distribution, tabulated: with few counts they are far from 1 and 2. ``error`` is
    the relative standard deviation of the expectation itself in a bin: it adds ``error``^2 ``expected`` to the counts'
    variance in units of their mean, by which the deviance grows. The sum is taken as a gamma variable (Wilson and
    Hilferty).
    """
    log_mean = jnp.log(jnp.clip(expected, _MEANS[0], _MEANS[-1]))
    mean, variance = (jnp.interp(log_mean, np.log(_MEANS), table) for table in _MOMENTS)
    small = jnp.minimum(expected / _MEANS[0], 1.0)
    weight = certainty * (1.0 + error**2 * expected)
    total = jnp.sum(certainty * deviance(data, expected))
    mean_total = jnp.maximum(jnp.sum(weight * mean * small) - fitted, 1e-3)
    variance_total = jnp.maximum(jnp.sum(weight**2 * variance * small), 1e-6)
    freedom = 2.0 * mean_total**2 / variance_total
    cube = jnp.cbrt(total / mean_total)
    return 1.0 - ndtr((cube - (1.0 - 2.0 / (9.0 * freedom))) / jnp.sqrt(2.0 / (9.0 * freedom)))


def _moments() -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance [means] of the deviance of a Poisson number, by summation."""
    mean = _MEANS[:, None]
    chance = np.exp(host_xlogy(_COUNTS, mean) - mean - gammaln(_COUNTS + 1.0))
    loss = 2.0 * (mean - _COUNTS + host_xlogy(_COUNTS, _COUNTS / mean))
    first = np.sum(chance * loss, axis=1)
    spread = np.sum(chance * (loss - first[:, None]) ** 2, axis=1)
    return first.astype(np.float32), spread.astype(np.float32)


_MOMENTS = _moments()
