"""Mean and covariance of the posterior of a source, by adaptive importance sampling.

Where walls throw shadows the likelihood has steps and ridges of its own height all over the region that the data leave
open. The largest of them is a matter of chance: the maximum is neither the estimate of least squared error nor stable
under rounding, and its curvature says nothing about the uncertainty. The mean over the region has none of these faults.

Places are drawn in rounds, each from a normal distribution with the moments that the earlier ones gave, and weighted
with the posterior over the mixture of all distributions drawn from (adaptive multiple importance sampling: Cornuet,
Marin, Mira and Robert, Scandinavian Journal of Statistics 39, 2012, 798). Activity and background are at their best
for each place; their own spread about it is normal.
"""

import jax
import jax.numpy as jnp

from swarmsim.estimation.likelihood import FitProblem
from swarmsim.estimation.search import Bounds, best_at
from swarmsim.pytree import pytree

# Fractional parts of multiples of these fill the unit cube evenly: powers of the root 1.2207 of x^4 = x + 1 (Roberts,
# "The unreasonable effectiveness of quasirandom sequences", 2018).
_EVEN = (0.8191725, 0.6710436, 0.5497005)
FIRST_SPREAD = 2.0  # standard deviations of the first round over those that the curvature promises
SPREAD = 1.25  # the same of later rounds over those of the places weighed so far
WIDE_EVERY = 4  # one place in so many comes from a distribution `WIDE` times as wide: no tail goes unseen
WIDE = 2.5
LEAST_EFFECTIVE = 16.0  # weights are flattened until they count as this many when the next round is placed
LEAST_STD_M = 1e-3


@pytree
class Weighed:
    """Places and their posterior."""

    theta: jax.Array  # [K, n, 5] with the activity and the background that suit each place best
    log_posterior: jax.Array  # [K, n]
    nuisance: jax.Array  # [K, n, 2, 2] covariance of log activity and log background with the place held


@pytree
class Posterior:
    """Moments of theta = (x, y, height above the ground, log activity in Bq, log background scale)."""

    mean: jax.Array  # [5]
    covariance: jax.Array  # [5, 5]
    effective: jax.Array  # [] number of independent places that the weighted ones are worth


def sample_posterior(
    problem: FitProblem,
    bounds: Bounds,
    start: jax.Array,
    covariance: jax.Array,
    log_scale: jax.Array,
    rounds: int,
    per_round: int,
) -> Posterior:
    """Moments of the posterior around ``start`` [5], whose covariance near it is about ``covariance`` [5, 5]."""
    low, high = bounds
    even = jnp.mod(0.5 + jnp.arange(1, rounds * per_round + 1)[:, None] * jnp.array(_EVEN), 1.0)
    normal = jax.scipy.special.ndtri(jnp.clip(even, 1e-6, 1.0 - 1e-6)).reshape(rounds, per_round, 3)
    normal = normal * jnp.where(jnp.arange(per_round) % WIDE_EVERY == 0, WIDE, 1.0)[:, None]

    def weigh(place: jax.Array) -> Weighed:
        theta, value, spread = best_at(problem, place, log_scale)
        inside = jnp.all((place >= low[:3]) & (place <= high[:3]))
        return Weighed(
            theta=theta, log_posterior=jnp.where(inside & jnp.isfinite(value), value, -jnp.inf), nuisance=spread
        )

    # The places of rounds to come have no weight yet, and their distributions no density.
    empty = Weighed(
        theta=jnp.zeros((rounds, per_round, 5)),
        log_posterior=jnp.full((rounds, per_round), -jnp.inf),
        nuisance=jnp.zeros((rounds, per_round, 2, 2)),
    )
    means, roots = jnp.zeros((rounds, 3)), jnp.broadcast_to(jnp.eye(3), (rounds, 3, 3))
    Carry = tuple[Weighed, jax.Array, jax.Array, jax.Array, jax.Array]

    def round_(carry: Carry, inputs: tuple[jax.Array, jax.Array]) -> tuple[Carry, None]:
        known, means, roots, mean, covariance = carry
        k, normal = inputs
        root = jnp.linalg.cholesky(covariance)
        means, roots = means.at[k].set(mean), roots.at[k].set(root)
        drawn = jax.lax.map(weigh, mean + normal @ root.T)
        known = jax.tree.map(lambda all_, new: all_.at[k].set(new), known, drawn)
        weight = _flattened(_log_weights(known, means, roots, k), LEAST_EFFECTIVE)
        mean, covariance = _moments(known.theta[..., :3], weight)
        return (known, means, roots, mean, SPREAD**2 * covariance + LEAST_STD_M**2 * jnp.eye(3)), None

    first = FIRST_SPREAD**2 * covariance[:3, :3] + LEAST_STD_M**2 * jnp.eye(3)
    carry: Carry = (empty, means, roots, start[:3], first)
    known, means, roots, _, _ = jax.lax.scan(round_, carry, (jnp.arange(rounds), normal))[0]
    weight = _truncated(_log_weights(known, means, roots, jnp.asarray(rounds - 1)))
    mean, covariance = _moments(known.theta, weight)
    own = jnp.einsum("kn,knij->ij", weight, known.nuisance)
    return Posterior(mean=mean, covariance=covariance.at[3:, 3:].add(own), effective=_effective(weight))


def _log_weights(known: Weighed, means: jax.Array, roots: jax.Array, last: jax.Array) -> jax.Array:
    """Logarithms [K, n] of posterior over mixture of the distributions of the rounds up to ``last``."""
    offset = known.theta[..., None, :3] - means  # [K, n, K, 3]
    scaled = jnp.einsum("qij,knqj->knqi", _inverse(roots), offset)
    scale = jnp.sum(jnp.log(jnp.diagonal(roots, axis1=-2, axis2=-1)), axis=-1)
    squared = jnp.sum(scaled**2, axis=-1)
    share = 1.0 / WIDE_EVERY
    narrow, wide = jnp.log(1.0 - share) - 0.5 * squared, jnp.log(share / WIDE**3) - 0.5 * squared / WIDE**2
    log_density = jnp.logaddexp(narrow, wide) - scale
    log_density = jnp.where(jnp.arange(means.shape[0]) <= last, log_density, -jnp.inf)
    mixture = jax.scipy.special.logsumexp(log_density, axis=-1)
    return jnp.where(jnp.isfinite(known.log_posterior), known.log_posterior - mixture, -jnp.inf)


def _inverse(roots: jax.Array) -> jax.Array:
    """Inverse [..., 3, 3] of lower triangles."""
    eye = jnp.broadcast_to(jnp.eye(3), roots.shape)
    return jax.scipy.linalg.solve_triangular(roots, eye, lower=True)


def _weights(log_weights: jax.Array, power: jax.Array | float = 1.0) -> jax.Array:
    """Weights [...] of sum 1 to a power; equal ones where no place has any."""
    top = jnp.max(log_weights)
    relative = jnp.where(jnp.isfinite(top), log_weights - top, 0.0)
    return jax.nn.softmax(jnp.where(jnp.isfinite(relative), power * relative, -jnp.inf), axis=None)


def _effective(weights: jax.Array) -> jax.Array:
    """How many equal weights these are worth [] (Kish 1965)."""
    return 1.0 / jnp.sum(jnp.square(weights))


def _flattened(log_weights: jax.Array, effective: float) -> jax.Array:
    """Weights [...] of sum 1 to the greatest power, at most 1, that makes them worth ``effective`` equal ones."""

    def halve(_: int, bracket: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = bracket
        middle = 0.5 * (low + high)
        enough = _effective(_weights(log_weights, jnp.exp(middle))) >= effective
        return jnp.where(enough, middle, low), jnp.where(enough, high, middle)

    low, _ = jax.lax.fori_loop(0, 12, halve, (jnp.asarray(-12.0), jnp.asarray(0.0)))
    enough = _effective(_weights(log_weights)) >= effective
    return _weights(log_weights, jnp.where(enough, 1.0, jnp.exp(low)))


def _truncated(log_weights: jax.Array) -> jax.Array:
    """Weights [...] of sum 1, cut off at their mean times the root of their number (Ionides, JCGS 17, 2008, 295).

    A place that the distributions drawn from hardly ever reach would otherwise outweigh all others.
    """
    weights = _weights(log_weights)
    weights = jnp.minimum(weights, 1.0 / jnp.sqrt(weights.size))
    return weights / jnp.sum(weights)


def _moments(values: jax.Array, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean [k] and covariance [k, k] of ``values`` [..., k] under weights [...] of sum 1."""
    flat, w = values.reshape(-1, values.shape[-1]), weight.reshape(-1)
    # relative to the heaviest: a mean of large coordinates would lose digits in float32
    origin = flat[jnp.argmax(w)]
    offset = jnp.where(w[:, None] > 0.0, flat - origin, 0.0)
    mean = w @ offset
    apart = offset - mean
    return origin + mean, (apart * w[:, None]).T @ apart
