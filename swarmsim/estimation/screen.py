"""Screens: about how well a source at each of many places explains the counts, for the price of rays and no fit.

All that a fit at one place knows of the background and of other sources is linearised there. Hundreds of other places
are compared by it (`swarmsim.estimation.search`, `swarmsim.estimation.modes`).
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.estimation.forward import Problem, Rates, Ways, dead_time, most_of, of_rows, rates, ways_from
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

ROUNDING = 1e-5  # of sums over all windows, relative
NEAREST_M = 0.1  # of a window from a source: nearer ones tell no more
NEARBY = 64  # windows of each span that tell places near one another apart


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


def _added(problem: Problem, nuclide: jax.Array, ways: Ways) -> jax.Array:
    """True counts [R, n] of a source of 1 Bq, by the presumed materials."""
    return rates(problem, ways, nuclide, jnp.zeros_like(problem.material_std), slopes=False).counts.T


def _seen(screen: Screen, nuclide: jax.Array, added: jax.Array) -> _Seen:
    net = added * screen.registered
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
    ways = ways_from(problem, place) if ways is None else ways
    return _value(problem, _seen(screen, nuclide, _added(problem, nuclide, ways)), place)


@pytree
class Nearby:
    """What places near that of a screen's fit have in common: rays lead to the windows that tell them apart alone."""

    few: Problem  # those windows
    rows: jax.Array  # [m] which they are
    added: jax.Array  # [R, n] true counts of a source of 1 Bq by the fit
    activity_bq: jax.Array  # [] of the fit
    squared_m2: jax.Array  # [n] distance of each window from its place, squared


def nearby(
    problem: Problem, source: Rates, activity_bq: jax.Array, place: jax.Array, reach_m: jax.Array
) -> Nearby:  # fmt: skip
    """For places around ``place`` [3], where a fit has ``activity_bq`` [] of a ``source``; by one ray each.

    Taken are the windows that would tell most of the distance if nothing were in the way, and whose distance changes
    most within about ``reach_m`` []. A window in the shadow of a wall may tell most of a place beside it, so shadows do
    not count here; what an overloaded counter does not register does.
    """
    m, added = problem.measurements, source.counts.T
    squared = _squared_m2(problem, position_of(problem.site, place))
    exposure_s = jnp.maximum(m.exposure_s, 1e-9)
    strength = jnp.where(m.valid, jnp.sum(added, axis=0) * squared / exposure_s, 0.0)
    amount = activity_bq * jnp.max(strength) * exposure_s / squared
    mean = amount + jnp.sum(problem.background, axis=1)
    share, fall = dead_time(problem, mean)
    change, registered = jnp.abs(share + fall * mean) * amount, jnp.maximum(share * mean, MEAN_FLOOR)
    information = jnp.square(change) / (jnp.square(problem.model_std * change) + registered)
    rows = most_of(problem, information * jnp.minimum(jnp.square(reach_m) / squared, 1.0), NEARBY)
    few = of_rows(problem, rows, NEARBY)
    return Nearby(few=few, rows=rows, added=added, activity_bq=activity_bq, squared_m2=squared)


def screened_near(problem: Problem, screen: Screen, near: Nearby, place: jax.Array) -> jax.Array:
    """`screened` [] with the nuclide of the screen's fit.

    What the windows without rays count changes with the inverse square of the distance, times a factor that is fitted
    to those with rays.
    """
    few = _added(near.few, screen.nuclide, ways_from(near.few, place))
    rest = near.added * (near.squared_m2 / _squared_m2(problem, position_of(problem.site, place)))
    expected = rest[:, near.rows]
    weight = screen.weight[:, near.rows] * jnp.square(near.activity_bq * screen.registered[near.rows])
    # with a prior about one, as wide as one: where no counter registers more for more there is no other
    factor = (jnp.sum(weight * expected * few) + 1.0) / (jnp.sum(weight * jnp.square(expected)) + 1.0)
    return _value(problem, _seen(screen, screen.nuclide, (factor * rest).at[:, near.rows].set(few)), place)


def _squared_m2(problem: Problem, where: jax.Array) -> jax.Array:
    """Squared distance [n] of each window, of which one place is looked at, from ``where`` [3] (world)."""
    return jnp.maximum(jnp.sum(jnp.square(problem.nodes.position_m - where), axis=1), NEAREST_M**2)


def looked_at(
    problem: Problem, screen: Screen, nuclide: jax.Array, place: jax.Array
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """What `screened` finds with a source at ``place`` [3] in the place of that of the fit; and with one beside it.

    The latter is the information [] (1/Bq^2) about its activity. The place and activity of the source of the fit are
    unknown then, and the activities of the others.
    """
    seen = _seen(screen, nuclide, _added(problem, nuclide, ways_from(problem, place)))
    both = jnp.einsum("rn,crn->c", seen.weighted, screen.there) - jnp.einsum(
        "can,an->c", screen.there_own, seen.inside
    )  # fmt: skip
    beside = seen.information - both @ screen.there_inverse @ both
    return _value(problem, seen, place), jnp.where(beside > ROUNDING * seen.whole, beside, 0.0)
