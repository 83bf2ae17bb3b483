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

from swarmsim.device import each, on_processor
from swarmsim.estimation.fit import Settled, settle
from swarmsim.estimation.forward import Problem, Rates, Ways, dead_time, rates, ways_from, with_one_ray
from swarmsim.estimation.likelihood import height_precision, position_of, scaled_inverse
from swarmsim.estimation.normal_equations import (
    MEAN_FLOOR,
    Others,
    Unknowns,
    inverse_of_two,
    linearised,
    normal_equations,
    of_window,
)
from swarmsim.pytree import pytree
from swarmsim.site import sample
from swarmsim.site.model import bounds_m

GOLDEN_ANGLE_RAD = 2.399963  # pi (3 - sqrt 5): points turned by it from one to the next never line up
GOLDEN_RATIO = 0.618034  # multiples of it modulo 1 fill an interval evenly
FITTED = 4  # of the candidates of a round: the best of each part
STEPS = 4  # Gauss-Newton steps at a place
HEIGHT_REACH = 4.0  # heights are sought within so many of their standard deviations
ROUNDING = 1e-5  # of sums over all windows, relative
FARTHEST = 6.0  # standard deviations of a place within which others are looked for along its uncertainty
NEAREST_M = 0.1  # of a window from a source: nearer ones tell no more
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
    fit = settle(problem, ways_from(problem, place), nuclide, others, u, STEPS, fresh=True, fitted=fitted)
    return Tried(place=place, nuclide=nuclide, fit=fit)


@pytree
class Screen:
    """What the posterior of other places is approximated with: the fit at one place, linearised. Windows come last."""

    nuclide: jax.Array  # [] int32 of the source of the fit
    left: jax.Array  # [R, n] counts less those of everything but the source sought
    weight: jax.Array  # [R, n] over their variance
    own: jax.Array  # [2, R, n] change with the window's own unknowns
    of_others: jax.Array  # [R, n] of it what the other sources have of the gain's
    inverse: jax.Array  # [2, 2, n] of the information about those
    precision: jax.Array  # [2, n] of their priors
    registered: jax.Array  # [n] of the counts that are added
    there: jax.Array  # [C, R, n] change with the source of the fit (log activity, place), and with the other sources
    there_own: jax.Array  # [C, 2, n] of it the part that the window's own unknowns take up
    there_inverse: jax.Array  # [C, C] of the information about those


def screen_of(
    problem: Problem, others: Others, source: Rates, nuclide: jax.Array, where: jax.Array, u: Unknowns
) -> Screen:  # fmt: skip
    """The screen from the fit ``u`` with a source of ``nuclide`` at ``where`` [3] (world) that adds ``source``."""
    m = problem.measurements
    assert m.rois is not None
    model = linearised(problem, source, others, where, u)
    zero = jnp.zeros_like(u.gain)
    sources = 1 + u.others.shape[0]
    own, at = of_window(model.columns, sources - 1), normal_equations(problem, model, u)
    inverse = at.own
    weight = jnp.where(m.valid, problem.trust.T / jnp.maximum(model.mean, MEAN_FLOOR), 0.0)
    there = jnp.concatenate([model.columns[:1], model.columns[0] * model.nearer[:, None], model.columns[1:sources]])
    inside = jnp.sum(own * (weight * there)[:, None], axis=2)  # [C, 2, n]
    there_own = jnp.einsum("abn,cbn->can", inverse, inside)
    information = jnp.einsum("crn,drn->cd", there * weight, there) - jnp.einsum("can,dan->cd", there_own, inside)
    information = information.at[3, 3].add(height_precision(problem.height_std_m))
    rest = linearised(problem, source, others, where, replace(u, background=zero, gain=zero, activity_bq=jnp.zeros(())))
    return Screen(
        nuclide=nuclide,
        left=jnp.where(m.valid, m.rois.T - rest.mean, 0.0),
        weight=weight,
        own=own,
        of_others=own[1] - model.columns[0],
        inverse=inverse,
        precision=at.precision,
        registered=model.registered,
        there=there,
        there_own=there_own,
        there_inverse=scaled_inverse(information),
    )


@pytree
class _Seen:
    """A source of 1 Bq at a place, by a screen."""

    weighted: jax.Array  # [R, n] what it adds over the variance of the counts
    inside: jax.Array  # [2, n] what the window's own unknowns have of it
    whole: jax.Array  # [] information about its activity with those known
    information: jax.Array  # [] and with those unknown
    score: jax.Array  # []


def _seen(problem: Problem, screen: Screen, nuclide: jax.Array, place: jax.Array, ways: Ways | None = None) -> _Seen:
    lengths, ways = jnp.zeros_like(problem.material_std), ways_from(problem, place) if ways is None else ways
    net = rates(problem, ways, nuclide, lengths, slopes=False).counts.T * screen.registered
    weighted = screen.weight * net
    own, inverse = _own(screen, nuclide, net)
    inside = jnp.sum(own * weighted, axis=1)
    of_left = jnp.sum(own * screen.weight * screen.left, axis=1)
    back = inverse[:, 0] * inside[0] + inverse[:, 1] * inside[1]
    whole = jnp.sum(weighted * net)
    return _Seen(
        weighted=weighted,
        inside=inside,
        whole=whole,
        information=whole - jnp.sum(back * inside),
        score=jnp.sum(weighted * screen.left) - jnp.sum(back * of_left),
    )


def _own(screen: Screen, nuclide: jax.Array, net: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Change [2, R, n] with the window's own unknowns, and the inverse [2, 2, n] of the information about those.

    A window's gain multiplies what its sources add. With that of the source of the fit, which has the spectrum of
    another nuclide, any nuclide would explain what that one does.
    """
    of_fit = jnp.sum(screen.own[1] - screen.of_others, axis=0)
    total = jnp.sum(net, axis=0)
    # both are negative where a detector beyond saturation registers less for more
    some = total != 0.0
    gain = screen.of_others + net * jnp.where(some, of_fit / jnp.where(some, total, 1.0), 0.0)
    alike = nuclide == screen.nuclide
    own = jnp.stack([screen.own[0], jnp.where(alike, screen.own[1], gain)])
    h = jnp.sum(own[:, None] * own * screen.weight, axis=2) + screen.precision[:, None] * jnp.eye(2)[..., None]
    return own, jnp.where(alike, screen.inverse, inverse_of_two(h)[0])


def _value(problem: Problem, seen: _Seen, place: jax.Array) -> jax.Array:
    deviation = place[2] - problem.height_m
    prior = 0.5 * height_precision(problem.height_std_m) * jnp.square(deviation)
    value = 0.5 * jnp.square(jnp.maximum(seen.score, 0.0)) / jnp.maximum(seen.information, 1e-30) - prior
    # what walls hide all of, and what is as nothing beside rounding, explains no count
    return jnp.where(jnp.isfinite(value) & (seen.information > ROUNDING * seen.whole), value, -prior)


def screened(
    problem: Problem, screen: Screen, nuclide: jax.Array, place: jax.Array, ways: Ways | None = None
) -> jax.Array:  # fmt: skip
    """About the log posterior [] at ``place`` [3], up to a constant: the activity and the windows' unknowns fitted.

    ``ways`` are those from there, if they are known.
    """
    return _value(problem, _seen(problem, screen, nuclide, place, ways), place)


def looked_at(
    problem: Problem, screen: Screen, nuclide: jax.Array, place: jax.Array
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """What `screened` finds with a source at ``place`` [3] in the place of that of the fit; and with one beside it.

    The latter is the information [] (1/Bq^2) about its activity. The place and activity of the source of the fit are
    unknown then, and the activities of the others.
    """
    seen = _seen(problem, screen, nuclide, place)
    both = jnp.einsum("rn,crn->c", seen.weighted, screen.there) - jnp.einsum(
        "can,an->c", screen.there_own, seen.inside
    )  # fmt: skip
    beside = seen.information - both @ screen.there_inverse @ both
    return _value(problem, seen, place), jnp.where(beside > ROUNDING * seen.whole, beside, 0.0)


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
    quick = with_one_ray(problem)
    seen = _screened(quick, screen, c.nuclide, places, c.allowed | c.sure)
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


def _screened(
    problem: Problem, screen: Screen, nuclide: jax.Array, places: jax.Array, asked: jax.Array
) -> jax.Array:  # fmt: skip
    """What `screened` finds at each of ``places`` [C, 3] with its ``nuclide`` [C]; of those not ``asked`` [C] anything.

    Nuclides are compared at one place: a processor, which takes one after another, follows the ways from there once.
    """
    if not on_processor():
        return each(lambda x: screened(problem, screen, x[1], x[0]), (places, nuclide), TOGETHER)
    alike, first = jnp.all(places == places[0]), partial(ways_from, problem, places[0])
    unseen = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(first))
    known = jax.lax.cond(alike, first, lambda: unseen)

    def one(x: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        place, nuclide, asked = x

        def look() -> jax.Array:
            ways = jax.lax.cond(alike, lambda: known, lambda: ways_from(problem, place))
            return screened(problem, screen, nuclide, place, ways)

        return jax.lax.cond(asked, look, lambda: jnp.zeros(()))

    return each(one, (places, nuclide, asked), TOGETHER)


def bounds(problem: Problem) -> Bounds:
    """Lower and upper bounds [3] of a place."""
    reach = HEIGHT_REACH * jnp.maximum(problem.height_std_m, 1e-3)
    low, high = bounds_m(problem.site)
    return jnp.append(low, problem.height_m - reach), jnp.append(high, problem.height_m + reach)
