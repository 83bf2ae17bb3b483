"""Weights of sampled places: how much they are worth, moments under them, and places drawn by them."""

import jax
import jax.numpy as jnp

# fractional parts of its multiples fill the unit interval evenly: the inverse of the root of x^4 = x + 1
EVEN = 0.8191725
# The same in the unit cube: powers of the root 1.2207 of that (Roberts, "The unreasonable effectiveness of quasirandom
# sequences", 2018).
_EVEN_3 = (EVEN, 0.6710436, 0.5497005)


def normalised(log_weights: jax.Array, power: jax.Array | float = 1.0) -> jax.Array:
    """Weights [...] of sum 1 to a power; equal ones where no place has any."""
    top = jnp.max(log_weights)
    relative = jnp.where(jnp.isfinite(top), log_weights - top, 0.0)
    return jax.nn.softmax(jnp.where(jnp.isfinite(relative), power * relative, -jnp.inf), axis=None)


def worth(weights: jax.Array) -> jax.Array:
    """How many equal weights these are worth [] (Kish 1965)."""
    return 1.0 / jnp.sum(jnp.square(weights))


def flattened(log_weights: jax.Array, effective: float) -> jax.Array:
    """Weights [...] of sum 1 to the greatest power, at most 1, that makes them worth ``effective`` equal ones."""

    def halve(_: int, bracket: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = bracket
        middle = 0.5 * (low + high)
        enough = worth(normalised(log_weights, jnp.exp(middle))) >= effective
        return jnp.where(enough, middle, low), jnp.where(enough, high, middle)

    low, _ = jax.lax.fori_loop(0, 12, halve, (jnp.asarray(-12.0), jnp.asarray(0.0)))
    enough = worth(normalised(log_weights)) >= effective
    return normalised(log_weights, jnp.where(enough, 1.0, jnp.exp(low)))


def truncated(log_weights: jax.Array, drawn: jax.Array) -> jax.Array:
    """Weights [...] of sum 1, cut off at their mean times the root of their number (Ionides, JCGS 17, 2008, 295).

    A place that the distributions drawn from hardly ever reach would otherwise outweigh all others. That number is of
    those ``drawn`` [], not of all that there is room for.
    """
    weights = normalised(log_weights)
    weights = jnp.minimum(weights, jax.lax.rsqrt(jnp.maximum(drawn, 1.0)))
    return weights / jnp.sum(weights)


def drawn_evenly(weight: jax.Array, count: int) -> jax.Array:
    """Numbers [count] of places, each as often as its weight [N] says (systematic resampling, Kitagawa 1996)."""
    at = (jnp.arange(count) + 0.5) / count
    index = jnp.searchsorted(jnp.cumsum(weight), at)
    # neighbours in the order of the places have different scales
    turned = jnp.argsort(jnp.mod(jnp.arange(count) * EVEN, 1.0))
    return jnp.minimum(index, weight.shape[0] - 1)[turned]


def even_normals(rounds: int, per_round: int, even: tuple[float, ...] = _EVEN_3) -> jax.Array:
    """Standard normal numbers [rounds, per_round, 3] that fill space evenly; ``even`` makes another set of them."""
    share = jnp.mod(0.5 + jnp.arange(1, rounds * per_round + 1)[:, None] * jnp.array(even), 1.0)
    return jax.scipy.special.ndtri(jnp.clip(share, 1e-6, 1.0 - 1e-6)).reshape(rounds, per_round, 3)


def moments(values: jax.Array, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean [k] and covariance [k, k] of ``values`` [..., k] under weights [...] of sum 1."""
    flat, w = values.reshape(-1, values.shape[-1]), weight.reshape(-1)
    # relative to the heaviest: a mean of large coordinates would lose digits in float32
    origin = flat[jnp.argmax(w)]
    offset = jnp.where(w[:, None] > 0.0, flat - origin, 0.0)
    mean = w @ offset
    apart = offset - mean
    return origin + mean, (apart * w[:, None]).T @ apart
