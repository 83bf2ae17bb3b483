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

Most of a round's places lie about the mean, spread as all places are; of a ridge that bends by more than its width few
of those are of use. The others lie each along the ridge as it runs at a likely place (a local covariance as of Elvira,
Martino, Luengo and Corander, ICASSP 2015, 4075), as far as it is straight there. A source next to a place where a
vehicle stood, or climbed, may lie in any direction from it, and all of a ring is likely: in the second round those
places lie around the ring through the likeliest place so far, and if much of it is likely in every other round.
Some places of each round lie about others that are given, likely ones in all modes that there may be
(`swarmsim.estimation.modes`): what all earlier places are far from is never drawn otherwise.

What all places are off by from the site's geometry is drawn with each of them: it moves the walls' shadows, which tell
it in turn where they are sharp. Half of its draws follow what was likely so far, the others its prior.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from swarmsim.device import each, repeat_while
from swarmsim.estimation.likelihood import scaled_inverse
from swarmsim.estimation.mixture import (
    Normals,
    Rounds,
    Weighed,
    any_weight,
    drawn_by,
    likeliest_of,
    log_weights_of,
    nowhere,
    with_round,
    worth_of,
)
from swarmsim.estimation.search import TOGETHER
from swarmsim.estimation.weights import (
    EVEN,
    drawn_evenly,
    even_normals,
    flattened,
    moments,
    normalised,
    truncated,
    worth,
)
from swarmsim.pytree import pytree

# of what all places are off by (`even_normals`): the last three of six dimensions, of the root of x^7 = x + 1
_EVEN_OFF = (0.6521828, 0.5860865, 0.5266888)
# Standard deviations of the first round, in turn, over those that are promised; the start itself is one of its places.
# Between walls the posterior may be a needle that none of the others comes near.
FIRST_SCALES = (4.2, 2.0, 1.0, 2.0, 2.0, 4.2, 1.0, 1.0, 0.02, 2.0, 2.0, 1.0)
MODE_ROUNDS = 5  # in which half of the places lie about modes that are given; later a quarter do
NEIGHBOURS = 8  # about each of which they are spread as so many of the nearest modes are,
NEIGHBOUR_M = 2.4  # those within this distance,
OVERLAP = 0.8  # times this,
WIDEST_MODE_M = 0.8  # at most by this
BLUNT_M = 0.1  # and at least by this about every other one
# Of a later round, in turn: standard deviations over those of the places so far or, about a likely one, of the ridge
# there; whether about a likely place, or about the mean, to see the tails; whether the error of all places is drawn as
# was likely so far. Those of a mode have its own.
SCALES = (2.5, 1.0, 1.2, 1.0, 1.2, 1.0, 1.2, 1.0)
LIKELY = (False, False, False, True, False, False, False, True)
ADAPTED = (False, True, True, True, True, True, False, True)
CLOSER = (1.0, 0.3, 0.1)  # the same in turn of those about the likeliest place, while a few outweigh all others
FEW = 2.0  # so many
TURNED = 1  # number of the round whose places about likely ones lie around a ring; of a ring so do those of every other
RING = 0.4  # of its radius: standard deviation from which on places are taken to lie on one
PLACED_EFFECTIVE = 8.0  # weights are flattened until they count as this many when the next round is placed
LEAST_EFFECTIVE = 16.0  # and as this many for the moments
ENOUGH_EFFECTIVE = 40.0  # no further rounds are needed then
LEAST_ROUNDS = 5
LEAST_STD_M = 1e-3
OFF_WIDER = 1.2  # standard deviations of the error of all places that are drawn, over those so far
LEAST_OFF = 0.1  # of its prior's
OFF_EFFECTIVE = 40.0  # weights are flattened until they count as this many for its distribution
OFF_NEAR_M = 2.0  # standard deviation of the distance within which places count for it: each mode has one of its own
SHRUNK = 0.1  # of the variance of places, by which what the error follows from them is lessened
LEAST_SHARE = 1e-3  # standard deviation of a round in any direction, over that in all: two places far apart span one


@pytree
class Posterior:
    """Moments of (x, y, height above the ground, log activity in Bq)."""

    mean: jax.Array  # [4]
    covariance: jax.Array  # [4, 4]
    effective: jax.Array  # [] number of independent places that the weighted ones are worth (`truncated`)
    halves: jax.Array  # [] distance between the means of two halves of the places, in standard deviations
    likeliest: jax.Array  # [3] of the places that were drawn


def sample_posterior(
    weigh: Callable[[jax.Array, jax.Array], Weighed],
    start: jax.Array,
    covariance: jax.Array,
    rounds: int,
    per_round: int,
    modes: jax.Array | None = None,
    pivot: jax.Array | None = None,
    off_std_m: jax.Array | float = 0.0,
) -> Posterior:
    """Moments of the posterior around ``start`` [3], whose covariance near it is about ``covariance`` [3, 3].

    All places are told with one unknown error [3], which in each direction is normal of ``off_std_m`` []: the moments
    are those of the place less it.

    Args:
        weigh: gives the posterior at a place [3], by what it is off [3].
        start: [3] a likely place.
        covariance: [3, 3] about that of the posterior near it.
        rounds: at most (static).
        per_round: places in a round (static).
        modes: [m, 3] likely places in all modes that the posterior may have, evenly in any order: some of a round's
            lie about them, in turn.
        pivot: [3] around which what is likely may lie on a ring; without one ridges are taken to be straight.
        off_std_m: [] standard deviation of the error.
    """
    index, quarter = jnp.arange(per_round), per_round // 4
    modes = jnp.zeros((0, 3)) if modes is None else modes
    normal, normal_off = even_normals(rounds, per_round), even_normals(rounds, per_round, _EVEN_OFF)
    first_scale, later_scale = (jnp.array(x)[index % len(x)] for x in (FIRST_SCALES, SCALES))
    shapes = _shapes(modes)
    local, adapted = (jnp.array(x)[index % len(x)] for x in (LIKELY, ADAPTED))
    errs = jnp.asarray(off_std_m) > 0.0

    def about_modes(done: Rounds) -> jax.Array:
        """Which places [P] of the next round lie about modes."""
        of_four = index % 4
        return (len(modes) > 0) & ((of_four == 1) | ((of_four == 2) & (done.count < MODE_ROUNDS)))

    def placed(done: Rounds) -> tuple[jax.Array, jax.Array]:
        """Centres [P, 3] and covariances [P, 3, 3] of the next round."""
        first, weight = ~any_weight(done), flattened(log_weights_of(done), PLACED_EFFECTIVE)
        mean, about = moments(done.known.place, weight)
        places, ridges = _along_ridges(done, weight, about, local, pivot)
        centres = jnp.where(first, start, jnp.where(local[:, None], places, mean))
        spread = jnp.where(first, covariance, jnp.where(local[:, None, None], ridges, about))
        # a tip that is much narrower than all that is known is closed in on
        few = ~first & (worth(normalised(log_weights_of(done))) < FEW)
        closer = jnp.where(few & local, jnp.array(CLOSER)[(jnp.cumsum(local) - 1) % len(CLOSER)], 1.0)
        centres = jnp.where((closer < 1.0)[:, None], likeliest_of(done), centres)
        covariances = jnp.square(jnp.where(first, first_scale, later_scale * closer))[:, None, None] * spread
        if len(modes) == 0:
            return centres, covariances
        beside = about_modes(done)[:, None]
        before = quarter * (done.count + jnp.minimum(done.count, MODE_ROUNDS))
        number = (before + jnp.cumsum(beside[:, 0]) - 1) % len(modes)
        return jnp.where(beside, modes[number], centres), jnp.where(beside[..., None], shapes[number], covariances)

    def round_(done: Rounds) -> Rounds:
        centres, covariances = placed(done)
        roots = jnp.linalg.cholesky(covariances + _least(covariances))
        eye = jnp.broadcast_to(jnp.eye(3), roots.shape)
        inverse = jax.scipy.linalg.solve_triangular(roots, eye, lower=True)
        modes_, later = about_modes(done), any_weight(done)
        exact = (modes_ | (first_scale < 1.0)) & (done.count == 0)
        mean, std, slope = _of_off(done, centres, errs & exact, errs & later & adapted)
        drawn_from = Normals(centres=centres, inverse=inverse, off=mean, off_std=std, slope=slope)
        aside = jnp.einsum("pij,pj->pi", roots, normal[done.count])
        places, off = centres + aside, mean + jnp.einsum("pij,pj->pi", slope, aside) + std * normal_off[done.count]
        drawn = each(lambda x: weigh(*x), (places, off_std_m * off), TOGETHER)
        return with_round(done, drawn, off, drawn_from)

    def more(done: Rounds) -> jax.Array:
        enough = worth_of(done) >= ENOUGH_EFFECTIVE
        return (done.count < rounds) & ~(enough & (done.count >= LEAST_ROUNDS))

    done = repeat_while(more, round_, nowhere(rounds, per_round))
    return _summary(done, off_std_m)


def _shapes(modes: jax.Array) -> jax.Array:
    """Covariances [m, 3, 3] about ``modes`` [m, 3], by the nearest of these: a needle's are narrow, a ridge's long.

    A mode that is given several times is one neighbour of others, and none of itself: what is drawn about it is as wide
    as the region that it stands for.
    """
    number = jnp.arange(len(modes))
    apart = modes[:, None] - modes
    squared = jnp.sum(jnp.square(apart), axis=-1)
    same = squared < LEAST_STD_M**2
    again = jnp.any(same & (number[:, None] > number), axis=1)
    far = jnp.where(same | again, jnp.inf, squared)
    nearest = jnp.argsort(far, axis=1)[:, :NEIGHBOURS]
    used = jnp.take_along_axis(far, nearest, axis=1) < NEIGHBOUR_M**2
    near = jnp.where(used[..., None], jnp.take_along_axis(apart, nearest[..., None], axis=1), 0.0)
    count = jnp.maximum(jnp.sum(used, axis=1), 1)[:, None, None]
    shape = OVERLAP**2 * jnp.einsum("mni,mnj->mij", near, near) / count
    size = jnp.trace(shape, axis1=1, axis2=2)
    shape = shape * jnp.minimum(1.0, WIDEST_MODE_M**2 / jnp.maximum(size, LEAST_STD_M**2))[:, None, None]
    blunt = jnp.where(number % 2 == 0, BLUNT_M**2, 0.0)
    return shape + blunt[:, None, None] * jnp.eye(3)


def _of_off(
    done: Rounds, centres: jax.Array, exact: jax.Array, adapted: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:  # fmt: skip
    """The error of all places in the next round, about ``centres`` [P, 3]: see `Normals`.

    That of its prior; but next to none for those that are ``exact`` [P], and for the ``adapted`` [P] as it was likely
    near them so far. Walls tell where a source is on the site and distances where it is to the vehicles, so that the
    error follows from the place where both are sharp, about each mode in another way.
    """
    both, log_weights = jnp.concatenate([done.known.place, done.off], axis=-1), log_weights_of(done)
    flat = jnp.log(flattened(log_weights, OFF_EFFECTIVE))

    def of(centre: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Mean [3], standard deviation [3] and slope [3, 3] of the error about a ``centre`` [3], as was likely."""
        near = -0.5 * jnp.sum(jnp.square((done.known.place - centre) / OFF_NEAR_M), axis=-1)
        mean, covariance = moments(both, flattened(flat + near, OFF_EFFECTIVE))
        of_place, across, own = covariance[:3, :3], covariance[3:, :3], jnp.diagonal(covariance)[3:]
        slope = across @ scaled_inverse(of_place * (1.0 + SHRUNK * jnp.eye(3)) + _least(of_place))
        left = own - jnp.sum(slope * across, axis=1)
        std = jnp.clip(OFF_WIDER * jnp.sqrt(jnp.maximum(left, 0.0)), LEAST_OFF, 1.0)
        return mean[3:] + slope @ (centre - mean[:3]), std, slope

    mean, std, slope = jax.vmap(of)(centres)
    adapted, exact = adapted[:, None], exact[:, None]
    return (
        jnp.where(adapted, mean, 0.0),
        jnp.where(adapted, std, jnp.where(exact, LEAST_OFF, 1.0)),
        jnp.where(adapted[..., None], slope, 0.0),
    )


def _least(covariance: jax.Array) -> jax.Array:
    """What makes covariances [..., 3, 3] positive, and none of their standard deviations too small."""
    least = LEAST_STD_M**2 + LEAST_SHARE**2 * jnp.trace(covariance, axis1=-2, axis2=-1)
    return least[..., None, None] * jnp.eye(3)


def _along_ridges(
    done: Rounds, weight: jax.Array, about: jax.Array, local: jax.Array, pivot: jax.Array | None
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """Likely places [P, 3] and covariances [P, 3, 3] of their ridges, to draw about; turned around a ring.

    ``weight`` [Q, P] and ``about`` [3, 3] are the weights of the places so far and their covariance, ``local`` [P] says
    which places of the next round are to lie about these.
    """
    known = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), done.known)
    likely = drawn_evenly(weight.reshape(-1), len(local))
    # where walls cut it short a ridge is narrower than its curvature promises
    narrower = scaled_inverse(about + _least(about))
    if pivot is None:
        places = known.place[likely]
        return places, _ridge(known.information[likely] + narrower, places, pivot)
    best, begun = jnp.argmax(known.log_posterior), done.count == TURNED
    turn = begun | ((done.count % 2 == TURNED % 2) & _is_ring(about, known.place[best], pivot))
    likely = jnp.where(begun, best, likely)
    places = known.place[likely]
    ridges = _ridge(known.information[likely] + jnp.where(turn, 0.0, narrower), places, pivot)
    share = (jnp.cumsum(local) - 1 + jnp.mod(done.count * EVEN, 1.0)) / jnp.maximum(jnp.sum(local), 1)
    return _turned(places, ridges, pivot, jnp.where(turn, 2.0 * jnp.pi * share, 0.0))


def _ridge(information: jax.Array, places: jax.Array, pivot: jax.Array | None) -> jax.Array:
    """Covariances [P, 3, 3] of ``places`` [P, 3] about which the posterior has so much ``information`` [P, 3, 3].

    A ring of radius R about the pivot leaves its tangent by w, the width of the ridge, within sqrt(2 R w): no standard
    deviation is longer.
    """
    if pivot is not None:
        radius = jnp.maximum(jnp.linalg.norm(places - pivot, axis=1), LEAST_STD_M)
        bend = 0.5 * jnp.sqrt(jnp.trace(information, axis1=1, axis2=2)) / radius
        information = information + bend[:, None, None] * jnp.eye(3)
    return jax.vmap(scaled_inverse)(information)


def _is_ring(about: jax.Array, place: jax.Array, pivot: jax.Array) -> jax.Array:
    """Whether [] places of covariance ``about`` [3, 3] reach far around ``pivot`` [3]; ``place`` [3] is likely."""
    return jnp.trace(about[:2, :2]) > RING**2 * jnp.sum(jnp.square(place[:2] - pivot[:2]))


def _turned(
    places: jax.Array, covariances: jax.Array, pivot: jax.Array, angle: jax.Array
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """Places [P, 3] and covariances [P, 3, 3] turned about the vertical through ``pivot`` [3] by angles [P] in rad."""
    c, s, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
    turn = jnp.stack([jnp.stack([c, -s, zero]), jnp.stack([s, c, zero]), jnp.stack([zero, zero, zero + 1.0])])
    offset = places - pivot
    return pivot + jnp.einsum("ijp,pj->pi", turn, offset), jnp.einsum("ijp,pjk,lkp->pil", turn, covariances, turn)


def _summary(done: Rounds, off_std_m: jax.Array | float) -> Posterior:
    known, log_weights = done.known, log_weights_of(done)
    weight = flattened(log_weights, LEAST_EFFECTIVE)
    values = jnp.concatenate([known.place - off_std_m * done.off, known.log_activity[..., None]], axis=-1)
    mean, covariance = moments(values, weight)
    covariance = covariance.at[3, 3].add(jnp.sum(jnp.where(weight > 0.0, weight * known.variance, 0.0)))
    return Posterior(
        mean=mean,
        covariance=covariance,
        effective=worth_of(done),
        halves=_halves(values, log_weights, covariance, drawn_by(done)),
        likeliest=likeliest_of(done),
    )


def _halves(values: jax.Array, log_weights: jax.Array, covariance: jax.Array, drawn: jax.Array) -> jax.Array:
    """How far the means of two halves of the places of each round lie apart, in standard deviations of x and y.

    There are ``drawn`` [] places in both.
    """
    # both have all kinds, and neighbours in the order of draws, which fill space evenly, are in different ones
    number = jnp.arange(values.shape[1])
    odd = (number + number // len(SCALES) + jnp.arange(values.shape[0])[:, None]) % 2 == 1
    means = [
        moments(values, truncated(jnp.where(half, log_weights, -jnp.inf), 0.5 * drawn))[0]
        for half in (odd, jnp.logical_not(odd))
    ]
    apart = jnp.abs(means[0] - means[1])[:2] / jnp.sqrt(jnp.maximum(jnp.diagonal(covariance)[:2], LEAST_STD_M**2))
    return jnp.max(apart)
