"""Places that were drawn in rounds, weighted over the mixture of all distributions that they were drawn from.

Adaptive multiple importance sampling: Cornuet, Marin, Mira and Robert, Scandinavian Journal of Statistics 39, 2012,
798. Where the places of a round lie is decided in `swarmsim.estimation.importance_sampling`.
"""

import jax
import jax.numpy as jnp

from swarmsim.estimation.weights import truncated, worth
from swarmsim.pytree import pytree


@pytree
class Weighed:
    """Places and their posterior; leading axes of any shape."""

    place: jax.Array  # [..., 3] x, y, height above the ground
    log_activity: jax.Array  # [...] of the best fit there
    variance: jax.Array  # [...] of the logarithm of the activity, the place held
    log_posterior: jax.Array  # [...]
    information: jax.Array  # [..., 3, 3] about the place, by the curvature there; as if nothing were in the way


@pytree
class Normals:
    """Normal distributions of places, and of the error of all places over the standard deviation of its prior."""

    centres: jax.Array  # [..., 3]
    inverse: jax.Array  # [..., 3, 3] of the lower triangular root of the covariance
    off: jax.Array  # [..., 3] mean of that at the centre
    off_std: jax.Array  # [..., 3]
    slope: jax.Array  # [..., 3, 3] change of that mean with the place


@pytree
class Rounds:
    """Places weighed so far, and the distributions that they were drawn from; Q rounds of P places."""

    known: Weighed  # [Q, P]
    off: jax.Array  # [Q, P, 3] error of all places, over the standard deviation of its prior
    drawn_from: Normals  # [Q, P]
    mixture: jax.Array  # [Q, P] log density of all distributions together
    count: jax.Array  # [] int32 rounds done


def nowhere(rounds: int, per_round: int) -> Rounds:
    """No round yet: the places of those to come have no weight, and their distributions no density."""
    none, eye = jnp.zeros((rounds, per_round)), jnp.broadcast_to(jnp.eye(3), (rounds, per_round, 3, 3))
    empty = Weighed(
        place=jnp.zeros((rounds, per_round, 3)),
        log_activity=none,
        variance=none,
        log_posterior=jnp.full((rounds, per_round), -jnp.inf),
        information=eye,
    )
    places = empty.place
    return Rounds(
        known=empty,
        off=places,
        drawn_from=Normals(centres=places, inverse=eye, off=places, off_std=jnp.ones_like(places), slope=0.0 * eye),
        mixture=empty.log_posterior,
        count=jnp.int32(0),
    )


def with_round(done: Rounds, drawn: Weighed, off: jax.Array, drawn_from: Normals) -> Rounds:
    """The rounds and one more: places [P], the error [P, 3] of all places, and what both were drawn from [P]."""
    k = done.count
    known, every, all_off = (
        jax.tree.map(lambda all_, new: all_.at[k].set(new), *x)
        for x in ((done.known, drawn), (done.drawn_from, drawn_from), (done.off, off))
    )
    # the new distributions at all places, and those before them at the new places: the rest is known
    places = known.place.reshape(-1, 3)
    of_new = _log_density(places, all_off.reshape(-1, 3), places[0], drawn_from).reshape(known.log_posterior.shape)
    earlier = jnp.repeat(jnp.arange(len(done.off)) < k, len(off))
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), done.drawn_from)
    before = _log_density(drawn.place, off, places[0], flat, earlier)
    mixture = done.mixture.at[k].set(before)
    return Rounds(
        known=known,
        off=all_off,
        drawn_from=every,
        mixture=jnp.logaddexp(mixture, of_new),
        count=k + 1,
    )


def _log_density(
    places: jax.Array, off: jax.Array, origin: jax.Array, of: Normals, drawn: jax.Array | bool = True
) -> jax.Array:
    """Log density [m] at ``places`` [m, 3] that are ``off`` [m, 3], of those of [n] that are ``drawn`` [n] from.

    Up to a constant. Places and centres are taken relative to ``origin`` [3]: large coordinates would lose digits in
    float32.
    """
    offset = (places - origin)[:, None] - (of.centres - origin)
    turned = [sum(of.inverse[:, i, j] * offset[..., j] for j in range(i + 1)) for i in range(3)]
    left = [
        off[:, i, None] - of.off[:, i] - sum(of.slope[:, i, j] * offset[..., j] for j in range(3)) for i in range(3)
    ]
    turned += [left[i] / of.off_std[:, i] for i in range(3)]
    sharp = jnp.sum(jnp.log(jnp.diagonal(of.inverse, axis1=1, axis2=2)) - jnp.log(of.off_std), axis=1)
    each_ = sharp - 0.5 * sum(jnp.square(x) for x in turned)
    return jax.scipy.special.logsumexp(jnp.where(drawn, each_, -jnp.inf), axis=1)


def log_weights_of(done: Rounds) -> jax.Array:
    """Logarithms [Q, P] of posterior over mixture of the distributions of all rounds so far."""
    weight = _log_posterior(done) - done.mixture
    return jnp.where(jnp.isfinite(weight), weight, -jnp.inf)


def _log_posterior(done: Rounds) -> jax.Array:
    """Logarithms [Q, P] of the posterior at each place, by what all places are off there."""
    return done.known.log_posterior - 0.5 * jnp.sum(jnp.square(done.off), axis=-1)


def likeliest_of(done: Rounds) -> jax.Array:
    """The likeliest place [3] so far."""
    return done.known.place.reshape(-1, 3)[jnp.argmax(_log_posterior(done))]


def any_weight(done: Rounds) -> jax.Array:
    """Whether [] a place that the posterior does not rule out has been found."""
    return jnp.any(jnp.isfinite(log_weights_of(done)))


def worth_of(done: Rounds) -> jax.Array:
    """How many independent places [] the weighted ones are worth."""
    return jnp.where(any_weight(done), worth(truncated(log_weights_of(done), drawn_by(done))), 0.0)


def drawn_by(done: Rounds) -> jax.Array:
    """Number [] of places drawn so far."""
    return (done.count * done.mixture.shape[1]).astype(jnp.float32)
