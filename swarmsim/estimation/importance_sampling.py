"""Mean and covariance of a posterior over places, by adaptive importance sampling.

Where walls throw shadows the likelihood has steps and ridges of its own height all over the region that the data leave
open. The largest of them is a matter of chance: the maximum is neither the estimate of least squared error nor stable
under rounding, and its curvature says nothing about the uncertainty. The mean over the region has none of these faults.

Places are drawn in rounds. Those of a round lie about places that the earlier ones found likely, at several distances
(population Monte Carlo: Cappé, Guillin, Marin and Robert, Journal of Computational and Graphical Statistics 13, 2004,
907), and are weighted with the posterior over the mixture of all distributions drawn from (adaptive multiple importance
sampling: Cornuet, Marin, Mira and Robert, Scandinavian Journal of Statistics 39, 2012, 798). Rounds go on until the
places are worth enough independent ones. Whatever else is unknown is fitted at each place; its own spread about that is
normal.

Distributions drawn from are normal: of a ridge that bends by more than its width the ends come to weigh too late. Of
arcs with a radius of 12 m, known to 3 m along them, 92 % of the 95 % regions cover the truth where they are 0.6 m wide,
85 % where it is 0.3 m and 72 % where it is 0.15 m (standard deviations).
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from swarmsim.device import each, repeat_while
from swarmsim.estimation.search import TOGETHER
from swarmsim.pytree import pytree

# Fractional parts of multiples of these fill the unit cube evenly: powers of the root 1.2207 of x^4 = x + 1 (Roberts,
# "The unreasonable effectiveness of quasirandom sequences", 2018).
_EVEN = (0.8191725, 0.6710436, 0.5497005)
FIRST_SPREAD = 2.0  # standard deviations of the first round over those that the curvature promises
SCALES = (2.5, 1.2, 1.2, 0.6)  # spread of a round's places, in turn, over that of the places weighed so far
ABOUT_MEAN = 3  # so many of the scales are about the mean, to see the tails. The others are about likely places.
PLACED_EFFECTIVE = 8.0  # weights are flattened until they count as this many when the next round is placed
LEAST_EFFECTIVE = 16.0  # and as this many for the moments
ENOUGH_EFFECTIVE = 40.0  # no further rounds are needed then
LEAST_ROUNDS = 5
LEAST_STD_M = 1e-3
LEAST_SHARE = 1e-3  # standard deviation of a round in any direction, over that in all: two places far apart span one


@pytree
class Weighed:
    """Places and their posterior; leading axes of any shape."""

    place: jax.Array  # [..., 3] x, y, height above the ground
    log_activity: jax.Array  # [...] of the best fit there
    variance: jax.Array  # [...] of the logarithm of the activity, the place held
    log_posterior: jax.Array  # [...]


@pytree
class Posterior:
    """Moments of (x, y, height above the ground, log activity in Bq)."""

    mean: jax.Array  # [4]
    covariance: jax.Array  # [4, 4]
    effective: jax.Array  # [] number of independent places that the weighted ones are worth (`_truncated`)
    halves: jax.Array  # [] distance between the means of two halves of the places, in standard deviations


@pytree
class _Rounds:
    """Places weighed so far, and the distributions that they were drawn from; Q rounds of P places."""

    known: Weighed  # [Q, P]
    centres: jax.Array  # [Q, P, 3]
    roots: jax.Array  # [Q, 3, 3] of the covariance
    mixture: jax.Array  # [Q, P] log density of all distributions together
    count: jax.Array  # [] int32 rounds done


def sample_posterior(
    weigh: Callable[[jax.Array], Weighed],
    start: jax.Array,
    covariance: jax.Array,
    rounds: int,
    per_round: int,
    others: jax.Array | None = None,
) -> Posterior:
    """Moments of the posterior around ``start`` [3], whose covariance near it is about ``covariance`` [3, 3].

    ``weigh`` gives the posterior at a place [3]. There are ``rounds`` of ``per_round`` places at most. Half of the
    first ones lie about ``others`` [m, 3], in turn, where there may be further modes.
    """
    index = jnp.arange(per_round)[:, None]
    starts = start if others is None else jnp.where(index % 2, others[index[:, 0] // 2 % len(others)], start)
    even = jnp.mod(0.5 + jnp.arange(1, rounds * per_round + 1)[:, None] * jnp.array(_EVEN), 1.0)
    normal = jax.scipy.special.ndtri(jnp.clip(even, 1e-6, 1.0 - 1e-6)).reshape(rounds, per_round, 3)
    scales = _scales(per_round)

    # The places of rounds to come have no weight yet, and their distributions no density.
    none = jnp.zeros((rounds, per_round))
    empty = Weighed(
        place=jnp.zeros((rounds, per_round, 3)),
        log_activity=none,
        variance=none,
        log_posterior=jnp.full((rounds, per_round), -jnp.inf),
    )
    nowhere = _Rounds(
        known=empty,
        centres=jnp.zeros((rounds, per_round, 3)),
        roots=jnp.broadcast_to(jnp.eye(3), (rounds, 3, 3)),
        mixture=jnp.full((rounds, per_round), -jnp.inf),
        count=jnp.int32(0),
    )

    def placed(done: _Rounds) -> tuple[jax.Array, jax.Array]:
        """Centres and the covariance of the next round."""
        weight = flattened(_log_weights(done), PLACED_EFFECTIVE)
        mean, about = _moments(done.known.place, weight)
        likely = drawn_evenly(done.known.place.reshape(-1, 3), weight.reshape(-1), per_round)
        wide = jnp.arange(per_round)[:, None] % len(SCALES) < ABOUT_MEAN
        first = ~_any_weight(done)
        centres = jnp.where(first, starts, jnp.where(wide, mean, likely))
        return centres, jnp.where(first, (FIRST_SPREAD / SCALES[1]) ** 2 * covariance, about)

    def round_(done: _Rounds) -> _Rounds:
        k = done.count
        centres, about = placed(done)
        root = jnp.linalg.cholesky(about + (LEAST_STD_M**2 + LEAST_SHARE**2 * jnp.trace(about)) * jnp.eye(3))
        drawn = each(weigh, centres + scales[:, None] * (normal[k] @ root.T), TOGETHER)
        return _with_round(done, drawn, centres, root)

    def more(done: _Rounds) -> jax.Array:
        enough = _worth(done) >= ENOUGH_EFFECTIVE
        return (done.count < rounds) & ~(enough & (done.count >= LEAST_ROUNDS))

    done = repeat_while(more, round_, nowhere)
    return _summary(done)


def _summary(done: _Rounds) -> Posterior:
    known, log_weights = done.known, _log_weights(done)
    weight = flattened(log_weights, LEAST_EFFECTIVE)
    values = jnp.concatenate([known.place, known.log_activity[..., None]], axis=-1)
    mean, covariance = _moments(values, weight)
    covariance = covariance.at[3, 3].add(jnp.sum(jnp.where(weight > 0.0, weight * known.variance, 0.0)))
    return Posterior(
        mean=mean,
        covariance=covariance,
        effective=_worth(done),
        halves=_halves(values, log_weights, covariance, _drawn(done)),
    )


def _scales(per_round: int) -> jax.Array:
    return jnp.array(SCALES)[jnp.arange(per_round) % len(SCALES)]


def drawn_evenly(places: jax.Array, weight: jax.Array, count: int) -> jax.Array:
    """``count`` of the places [N, 3], each as often as its weight [N] says (systematic resampling, Kitagawa 1996)."""
    at = (jnp.arange(count) + 0.5) / count
    index = jnp.searchsorted(jnp.cumsum(weight), at)
    # neighbours in the order of the places have different scales
    turned = jnp.argsort(jnp.mod(jnp.arange(count) * _EVEN[0], 1.0))
    return places[jnp.minimum(index, places.shape[0] - 1)][turned]


def _halves(values: jax.Array, log_weights: jax.Array, covariance: jax.Array, drawn: jax.Array) -> jax.Array:
    """How far the means of two halves of the places of each round lie apart, in standard deviations of x and y.

    There are ``drawn`` [] places in both.
    """
    odd = jnp.arange(values.shape[1]) // len(SCALES) % 2 == 1  # both halves have all scales
    means = [
        _moments(values, _truncated(jnp.where(half, log_weights, -jnp.inf), 0.5 * drawn))[0]
        for half in (odd, jnp.logical_not(odd))
    ]
    apart = jnp.abs(means[0] - means[1])[:2] / jnp.sqrt(jnp.maximum(jnp.diagonal(covariance)[:2], LEAST_STD_M**2))
    return jnp.max(apart)


def _with_round(done: _Rounds, drawn: Weighed, centres: jax.Array, root: jax.Array) -> _Rounds:
    """The rounds and one more: places [P], and the distribution that they were drawn from."""
    k = done.count
    known = jax.tree.map(lambda all_, new: all_.at[k].set(new), done.known, drawn)
    centres, roots = done.centres.at[k].set(centres), done.roots.at[k].set(root)
    # the new distribution at all places, and those before it at the new places: the rest is known
    places = known.place.reshape(-1, 3)
    of_new = _log_density(places, places[0], centres[k], root).reshape(known.log_posterior.shape)
    before = jax.vmap(partial(_log_density, drawn.place, places[0]))(centres, roots)
    before = jnp.where(jnp.arange(len(roots))[:, None] < k, before, -jnp.inf)
    mixture = done.mixture.at[k].set(jax.scipy.special.logsumexp(before, axis=0))
    return _Rounds(known=known, centres=centres, roots=roots, mixture=jnp.logaddexp(mixture, of_new), count=k + 1)


def _log_density(places: jax.Array, origin: jax.Array, centres: jax.Array, root: jax.Array) -> jax.Array:
    """Log density [m] of a round's distribution at ``places`` [m, 3], up to a constant.

    Those and its ``centres`` [P, 3] are taken relative to ``origin`` [3]: large coordinates would lose digits in
    float32.
    """
    scales = _scales(centres.shape[0])
    inverse = jax.scipy.linalg.solve_triangular(root, jnp.eye(3), lower=True)
    turned = (places - origin) @ inverse.T
    offset = (turned[:, None] - (centres - origin) @ inverse.T) / scales[:, None]
    each_ = -0.5 * jnp.sum(offset * offset, axis=-1) - 3.0 * jnp.log(scales)
    return jax.scipy.special.logsumexp(each_, axis=-1) - jnp.sum(jnp.log(jnp.diagonal(root)))


def _log_weights(done: _Rounds) -> jax.Array:
    """Logarithms [Q, P] of posterior over mixture of the distributions of all rounds so far."""
    weight = done.known.log_posterior - done.mixture
    return jnp.where(jnp.isfinite(weight), weight, -jnp.inf)


def _any_weight(done: _Rounds) -> jax.Array:
    """Whether [] a place that the posterior does not rule out has been found."""
    return jnp.any(jnp.isfinite(_log_weights(done)))


def _worth(done: _Rounds) -> jax.Array:
    """How many independent places [] the weighted ones are worth."""
    return jnp.where(_any_weight(done), _effective(_truncated(_log_weights(done), _drawn(done))), 0.0)


def _drawn(done: _Rounds) -> jax.Array:
    """Number [] of places drawn so far."""
    return (done.count * done.mixture.shape[1]).astype(jnp.float32)


def _weights(log_weights: jax.Array, power: jax.Array | float = 1.0) -> jax.Array:
    """Weights [...] of sum 1 to a power; equal ones where no place has any."""
    top = jnp.max(log_weights)
    relative = jnp.where(jnp.isfinite(top), log_weights - top, 0.0)
    return jax.nn.softmax(jnp.where(jnp.isfinite(relative), power * relative, -jnp.inf), axis=None)


def _effective(weights: jax.Array) -> jax.Array:
    """How many equal weights these are worth [] (Kish 1965)."""
    return 1.0 / jnp.sum(jnp.square(weights))


def flattened(log_weights: jax.Array, effective: float) -> jax.Array:
    """Weights [...] of sum 1 to the greatest power, at most 1, that makes them worth ``effective`` equal ones."""

    def halve(_: int, bracket: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = bracket
        middle = 0.5 * (low + high)
        enough = _effective(_weights(log_weights, jnp.exp(middle))) >= effective
        return jnp.where(enough, middle, low), jnp.where(enough, high, middle)

    low, _ = jax.lax.fori_loop(0, 12, halve, (jnp.asarray(-12.0), jnp.asarray(0.0)))
    enough = _effective(_weights(log_weights)) >= effective
    return _weights(log_weights, jnp.where(enough, 1.0, jnp.exp(low)))


def _truncated(log_weights: jax.Array, drawn: jax.Array) -> jax.Array:
    """Weights [...] of sum 1, cut off at their mean times the root of their number (Ionides, JCGS 17, 2008, 295).

    A place that the distributions drawn from hardly ever reach would otherwise outweigh all others. That number is of
    those ``drawn`` [], not of all that there is room for.
    """
    weights = _weights(log_weights)
    weights = jnp.minimum(weights, jax.lax.rsqrt(jnp.maximum(drawn, 1.0)))
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
