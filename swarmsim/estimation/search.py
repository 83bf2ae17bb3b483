"""The best place of one source: many places are screened, few are fitted, ever closer to the best one so far.

Where walls throw shadows the posterior is a ragged funnel: it rises towards the source over metres but has steps of
several nats every half metre, over which no gradient leads. A screen, which holds all that a fit knows of the
background and of other sources, looks at many places for the price of few fits. Close to a strong source in the open it
is a ridge: some of the places lie along it, and one is where a Gauss-Newton step leads.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp

from swarmsim.device import each, for_those, in_turn, on_processor
from swarmsim.estimation.fit import Settled, settle
from swarmsim.estimation.forward import Problem, Ways, dead_time, few_rows, ways_from, with_one_ray
from swarmsim.estimation.likelihood import height_precision, position_of, scaled_inverse
from swarmsim.estimation.normal_equations import Others, Unknowns
from swarmsim.estimation.screen import NEARBY, NEAREST_M, Screen, nearby, screened, screened_near
from swarmsim.pytree import pytree
from swarmsim.site import sample
from swarmsim.site.model import bounds_m

GOLDEN_ANGLE_RAD = 2.399963  # pi (3 - sqrt 5): points turned by it from one to the next never line up
GOLDEN_RATIO = 0.618034  # multiples of it modulo 1 fill an interval evenly
FITTED = 4  # of the candidates of a round: the best of each part
STEPS, PASSES = 2, 3  # Gauss-Newton steps at a place (`settle`)
HEIGHT_REACH = 4.0  # heights are sought within so many of their standard deviations
FARTHEST = 6.0  # standard deviations of a place within which others are looked for along its uncertainty
TOGETHER = 24  # places that an accelerator looks at side by side

Bounds = tuple[jax.Array, jax.Array]  # lower and upper [3]


@pytree
class Tried:
    """Places and the fits there; leading axis."""

    place: jax.Array  # [..., 3] x, y, height above the ground
    nuclide: jax.Array  # [...] int32
    fit: Settled


@pytree
class Candidates:
    """Places that may be better; C of them in `FITTED` parts of equal size."""

    place: jax.Array  # [C, 3]
    nuclide: jax.Array  # [C] int32
    allowed: jax.Array  # [C] bool, whether it is one
    sure: jax.Array  # [C] bool, to be fitted in any case; one of its part at most
    apart: jax.Array  # [] bool, whether the best of each part is fitted, or the best of all
    near: jax.Array  # [] bool, whether all are of the nuclide of the best so far, and near it
    reach_m: jax.Array  # [] how near; a third of them up to three times as far


def attempt(
    problem: Problem,
    nuclide: jax.Array,
    others: Others,
    u: Unknowns,
    place: jax.Array,
    fitted: jax.Array | bool = True,
) -> Tried:
    """The fit at a place [3] from the unknowns ``u``: from the levels and the others' factors alone.

    Where ``fitted`` [] is False nothing is, and rates are those with the lengths of ``u``.
    """
    # lengths that a wrong place asked for would make others look wrong
    u = replace(u, lengths=jnp.where(fitted, 0.0, u.lengths))
    fit = settle(problem, ways_from(problem, place), nuclide, others, u, STEPS, PASSES, fresh=True, fitted=fitted)
    return Tried(place=place, nuclide=nuclide, fit=fit)


def spread(centre: jax.Array, reach_m: jax.Array, up_m: jax.Array, count: int, turn: jax.Array) -> jax.Array:
    """Places [count, 3] within ``reach_m`` of ``centre`` [3], denser near it, heights within ``up_m``.

    A third of them is up to three times as far; ``turn`` [] turns the pattern.
    """
    return centre + _pattern(count, turn) * jnp.stack([reach_m, reach_m, up_m])


def spread_along(problem: Problem, best: Tried, reach_m: jax.Array, count: int, turn: jax.Array) -> jax.Array:
    """Places [count, 3] about ``best``, as far in each direction as its place is uncertain, ``reach_m`` at most.

    Close to a strong source the posterior is a ridge, centimetres wide and a metre long, which places all around would
    miss. The first of them is where the Gauss-Newton step of the place leads.
    """
    covariance = scaled_inverse(best.fit.towards.at[2, 2].add(height_precision(problem.height_std_m)))
    widest = jnp.sqrt(jnp.maximum(jnp.max(jnp.diagonal(covariance)), 1e-12))
    shape = covariance / jnp.square(widest) + 1e-4 * jnp.eye(3)
    root = jnp.minimum(reach_m, FARTHEST * widest) * jnp.linalg.cholesky(shape)
    step = jnp.clip(jnp.nan_to_num(best.fit.move), -reach_m, reach_m)
    return best.place + (_pattern(count, turn) @ root.T).at[0].set(step)


def _pattern(count: int, turn: jax.Array) -> jax.Array:
    """Offsets [count, 3] in a cylinder of radius and half height 1, a third of them up to three times as far out."""
    index = jnp.arange(count)
    share = jnp.sqrt((index + 0.5) / count) * jnp.where(index % 3 == 2, 3.0, 1.0)
    angle = GOLDEN_ANGLE_RAD * (index + count * turn)
    height = 2.0 * jnp.mod((index + count * turn) * GOLDEN_RATIO, 1.0) - 1.0
    return jnp.stack([share * jnp.cos(angle), share * jnp.sin(angle), height], axis=-1)


def mirrored_place(problem: Problem, place: jax.Array, counts: jax.Array) -> jax.Array:
    """The place [3] on the other side of the way from which most of a source's ``counts`` [n] came.

    A vehicle that drives straight past a source does not know on which side of it that lies. The way is the line that
    fits the windows' places best, weighted with the squares of the counts, so that it is the part next to the source.
    """
    m = problem.measurements
    weight = _shares_of(problem, counts)
    offset = jnp.where(m.valid[:, None], m.position_m[:, :2] - place[:2], 0.0)
    middle = weight @ offset
    apart = jnp.where(m.valid[:, None], offset - middle, 0.0)
    xx, yy, xy = (weight @ (apart[:, i] * apart[:, j]) for i, j in ((0, 0), (1, 1), (0, 1)))
    angle = 0.5 * jnp.arctan2(2.0 * xy, xx - yy)
    across = jnp.stack([-jnp.sin(angle), jnp.cos(angle)])
    return place.at[:2].add(2.0 * jnp.dot(middle, across) * across)


def heard_most_at(problem: Problem, place: jax.Array, counts: jax.Array) -> jax.Array:
    """Where [3] (x, y, height above the ground) a source at ``place`` [3] was heard from that its ``counts`` [n] tell.

    The mean of the windows' places, weighted with the squares of what each tells of the distance: those of a vehicle
    that stood beside the source, and not the many that flew by above with as many counts. What an overloaded counter
    does not register tells nothing.
    """
    m = problem.measurements
    offset = jnp.where(m.valid[:, None], m.position_m - position_of(problem.site, place), 0.0)
    total = counts + jnp.sum(problem.background, axis=1)
    share, fall = dead_time(problem, total)
    registered = jnp.abs(share + fall * total) * counts
    told = jnp.where(m.valid, registered / jnp.maximum(jnp.sum(jnp.square(offset), axis=1), NEAREST_M**2), 0.0)
    found = position_of(problem.site, place) + _shares_of(problem, told) @ offset
    return found.at[2].add(-sample(problem.site.terrain_m, problem.site, found[:2]))


def _shares_of(problem: Problem, counts: jax.Array) -> jax.Array:
    """Shares [n] of the windows, as the squares of their ``counts`` [n] or the like; 0 of those not valid."""
    weight = jnp.square(
        jnp.where(problem.measurements.valid, counts / jnp.maximum(jnp.max(counts), 1e-9), 0.0)
    )  # fmt: skip
    return weight / jnp.maximum(jnp.sum(weight), 1e-9)


def best_of(
    problem: Problem, others: Others, u: Unknowns, screen: Screen, candidates: Candidates, best: Tried
) -> tuple[Tried, jax.Array]:
    """The best of ``candidates`` and of ``best``, and the value of each candidate [C].

    The most promising ones are fitted from the unknowns ``u``; the values of the rest are those of the screen.
    """
    low, high = bounds(problem)
    places, c = jnp.clip(candidates.place, low, high), candidates
    seen = _screened_all(with_one_ray(problem), screen, replace(c, place=places), best)
    rank = jnp.where(c.sure, jnp.inf, jnp.where(c.allowed, seen, -jnp.inf))
    parts = rank.reshape(FITTED, -1)
    of_parts = jnp.argmax(parts, axis=1) + jnp.arange(FITTED) * parts.shape[1]
    chosen = jnp.where(c.apart, of_parts, jax.lax.top_k(rank, FITTED)[1])
    tried = each(
        lambda k: attempt(problem, c.nuclide[k], others, u, places[k]), chosen, FITTED
    )  # fmt: skip
    value = jnp.where(rank[chosen] > -jnp.inf, tried.fit.value, -jnp.inf)
    first = jnp.argmax(value)
    # those that are not fitted are no better than the best of those that are
    unfitted = jnp.minimum(seen + (value - seen[chosen])[first], value[first])
    values = jnp.where(c.allowed, unfitted, -jnp.inf).at[chosen].set(value)
    better = value[first] > best.fit.value
    return jax.tree.map(lambda a, b: jnp.where(better, a[first], b), tried, best), values


def _screened_all(problem: Problem, screen: Screen, c: Candidates, best: Tried) -> jax.Array:
    """What the screen of the fit of ``best`` finds at each of the candidates [C]; of those not allowed anything."""

    def of_all() -> jax.Array:
        return _screened(problem, screen, c.nuclide, c.place, c.allowed | c.sure)

    if few_rows(problem, NEARBY):
        return of_all()
    nothing = jnp.zeros(c.allowed.shape)

    def of_few() -> jax.Array:
        fit = best.fit
        near = nearby(problem, fit.rates, fit.unknowns.activity_bq, best.place, c.reach_m)
        return each(lambda place: screened_near(problem, screen, near, place), c.place, TOGETHER)

    close = for_those(c.near, of_few, lambda: nothing)
    return jnp.where(c.near, close, for_those(~c.near, of_all, lambda: nothing))


def _screened(
    problem: Problem, screen: Screen, nuclide: jax.Array, places: jax.Array, asked: jax.Array
) -> jax.Array:  # fmt: skip
    """What `screened` finds at each of ``places`` [C, 3] with its ``nuclide`` [C]; of those not ``asked`` [C] anything.

    Nuclides are compared at one place: a processor, which takes one after another, follows the ways from there once.
    """
    if not on_processor():
        return each(lambda x: screened(problem, screen, x[1], x[0]), (places, nuclide), TOGETHER)
    unseen: Ways = jax.eval_shape(partial(ways_from, problem, places[0]))
    nowhere = jnp.full(3, jnp.nan), jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), unseen)
    Last = tuple[jax.Array, Ways]  # the last place and the ways from there

    def one(last: Last, x: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[Last, jax.Array]:
        place, nuclide, asked = x

        def look() -> tuple[Last, jax.Array]:
            at, ways = last
            ways = jax.lax.cond(jnp.all(place == at), lambda: ways, lambda: ways_from(problem, place))
            return (place, ways), screened(problem, screen, nuclide, place, ways)

        return jax.lax.cond(asked, look, lambda: (last, jnp.zeros(())))

    return in_turn(one, nowhere, (places, nuclide, asked))


def bounds(problem: Problem) -> Bounds:
    """Lower and upper bounds [3] of a place."""
    reach = HEIGHT_REACH * jnp.maximum(problem.height_std_m, 1e-3)
    low, high = bounds_m(problem.site)
    return jnp.append(low, problem.height_m - reach), jnp.append(high, problem.height_m + reach)
