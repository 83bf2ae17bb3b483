"""Poisson numbers by a fixed number of operations, so that vehicles and missions side by side do not wait for another.

`jax.random.poisson` tries until the last of all numbers is accepted: on a GPU each try is a pause of the whole program.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

INVERTED_BELOW = 10.0
"""Mean up to which the distribution is inverted; above, transformed rejection holds."""
_TERMS = 48  # of the distribution: beyond them lie 1e-16 of it at a mean of 10
_TRIES = 16  # each is accepted with a probability of 0.8 at a mean of 10, of more above: all fail once in 10^11 numbers
_LOG_FACTORIAL = np.array([math.lgamma(k + 1.0) for k in range(_TERMS)], np.float32)


def poisson(key: jax.Array, mean: jax.Array) -> jax.Array:
    """A Poisson number [] (float32) of a ``mean`` [] that is finite and not negative.

    Small means: inversion of the distribution, with uniform numbers of 24 bits, so that what happens less often than
    once in 10^7 numbers does not happen. Large means: PTRS, Hörmann (Insurance Math. Econom. 12, 1993, 39),
    with the logarithm of the probability written as a deviance, which does not cancel in float32 where the mean is
    large.
    """
    low, high = jax.random.split(key)
    mean = jnp.asarray(mean, jnp.float32)
    few = _inverted(jax.random.uniform(low), jnp.minimum(mean, INVERTED_BELOW))
    many = _transformed(jax.random.uniform(high, (2, _TRIES)), jnp.maximum(mean, INVERTED_BELOW))
    return jnp.where(mean < INVERTED_BELOW, few, many)


def _inverted(u: jax.Array, mean: jax.Array) -> jax.Array:
    """The number at which the distribution function passes ``u``."""
    k = np.arange(_TERMS, dtype=np.float32)
    logarithm = k * jnp.log(jnp.maximum(mean, 1e-30)) - mean - _LOG_FACTORIAL
    below = jnp.cumsum(jnp.exp(logarithm))
    # of the sum as rounded, which a uniform number next to 1 would exceed: no number is the last of all terms then
    return jnp.sum(u * below[-1] >= below, dtype=jnp.float32)


def _transformed(uv: jax.Array, mean: jax.Array) -> jax.Array:
    """The first of several tries that is accepted; the mean itself, rounded, if there is none."""
    root = jnp.sqrt(mean)
    b = 0.931 + 2.53 * root
    a = -0.059 + 0.02483 * b
    u, v = uv[0] - 0.5, jnp.maximum(uv[1], 1e-12)
    room = 0.5 - jnp.abs(u)
    k = jnp.floor((2.0 * a / jnp.maximum(room, 1e-7) + b) * u + mean + 0.43)
    certain = (room >= 0.07) & (v <= 0.9277 - 3.6224 / (b - 2.0))
    possible = (k >= 0.0) & ((room >= 0.013) | (v <= room))
    inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
    squeeze = jnp.log(v * inverse_alpha / (a / jnp.maximum(room * room, 1e-12) + b))
    accepted = certain | (possible & (squeeze <= _log_probability(jnp.maximum(k, 0.0), mean)))
    first = jnp.argmax(accepted)
    return jnp.where(jnp.any(accepted), k[first], jnp.round(mean))


def _log_probability(k: jax.Array, mean: jax.Array) -> jax.Array:
    """Logarithm of the probability of ``k`` [...] by Stirling's series, and the deviance from the mean."""
    some = jnp.maximum(k, 1.0)
    x = (some - mean) / mean
    near = jnp.abs(x) < 0.05
    small = jnp.where(near, x, 0.0)
    series = small * small * (1 / 2 - small * (1 / 6 - small * (1 / 12 - small * (1 / 20 - small / 30))))
    deviance = jnp.where(near, series, (1.0 + x) * jnp.log(some / mean) - x)
    stirling = 0.5 * jnp.log(2.0 * math.pi * some) + 1.0 / (12.0 * some) - 1.0 / (360.0 * some**3)
    return jnp.where(k < 0.5, -mean, -mean * deviance - stirling)
