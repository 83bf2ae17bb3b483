"""The best place of one source: many places are screened, few are fitted, ever closer to the best one so far.

Where walls throw shadows the posterior is a ragged funnel: it rises towards the source over metres but has steps of
several nats every half metre, over which no gradient leads. A screen, which holds all that a fit knows of the
background and of other sources, looks at many places for the price of few fits.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.estimation.likelihood import height_precision
from swarmsim.estimation.model import (
    MEAN_FLOOR,
    Others,
    Problem,
    Settled,
    Unknowns,
    _linear,
    _normal,
    position_of,
    rates,
    settle,
    ways_from,
)
from swarmsim.pytree import pytree

GOLDEN_ANGLE_RAD = 2.399963  # pi (3 - sqrt 5): points turned by it from one to the next never line up
GOLDEN_RATIO = 0.618034  # multiples of it modulo 1 fill an interval evenly
SETTLED = 3  # of the places screened in a round, which are fitted
STEPS = 3  # Gauss-Newton steps at a place
HEIGHT_REACH = 4.0  # heights are sought within so many of their standard deviations

Bounds = tuple[jax.Array, jax.Array]  # lower and upper [3]


@pytree
class Tried:
    """Places and the fits there; leading axis."""

    place: jax.Array  # [..., 3]
    fit: Settled


def attempt(
    problem: Problem,
    nuclide: jax.Array,
    others: Others,
    u: Unknowns,
    place: jax.Array,
    steps: int,
    fresh: jax.Array | bool,
) -> Tried:
    """The fit at a place [3]."""
    # lengths that a wrong place asked for would make others look wrong
    u = replace(u, lengths=jnp.zeros_like(u.lengths))
    ways = ways_from(problem, place)
    return Tried(place=place, fit=settle(problem, ways, nuclide, others, u, steps, fresh))


@pytree
class Screen:
    """What the posterior of other places is approximated with: the fit at one place, linearised."""

    left: jax.Array  # [n, R] counts less those of everything but the source sought
    weight: jax.Array  # [n, R] over their variance
    own: jax.Array  # [n, R, 2] change with the window's own unknowns
    inverse: jax.Array  # [n, 2, 2] of the information about those
    share: jax.Array  # [n] of the counts that is registered


def screen_of(problem: Problem, others: Others, at: Tried) -> Screen:
    """The screen from the fit ``at`` a place."""
    m, fit = problem.measurements, at.fit
    u, net = fit.unknowns, fit.rates.counts
    assert m.rois is not None
    where = position_of(problem.site, at.place)
    model = _linear(problem, fit.rates, others, where, u)
    linear = _normal(problem, model, u)
    zero = jnp.zeros_like(u.gain)
    bare = replace(u, background=zero, gain=zero, activity_bq=jnp.zeros(()))
    rest = _linear(problem, fit.rates, others, where, bare)
    true = jnp.sum(u.activity_bq * net * jnp.exp(u.gain)[:, None], axis=1)
    added = jnp.sum(model.common[..., 0], axis=1)
    return Screen(
        left=jnp.where(m.valid[:, None], m.rois - rest.mean, 0.0),
        weight=jnp.where(m.valid[:, None], 1.0 / jnp.maximum(model.mean, MEAN_FLOOR), 0.0),
        own=model.own,
        inverse=linear.own,
        share=jnp.where(true > 0.0, added / jnp.maximum(true, 1e-20), 1.0),
    )


def screened(problem: Problem, screen: Screen, nuclide: jax.Array, lengths: jax.Array, place: jax.Array) -> jax.Array:
    """About the log posterior [] at ``place`` [3], up to a constant: the activity and the windows' unknowns fitted."""
    net = rates(problem, ways_from(problem, place), nuclide, lengths).counts * screen.share[:, None]
    weighted = screen.weight * net
    inside = jnp.stack([jnp.sum(screen.own[..., k] * weighted, axis=1) for k in range(2)], axis=-1)
    of_left = jnp.stack([jnp.sum(screen.own[..., k] * screen.weight * screen.left, axis=1) for k in range(2)], axis=-1)
    back = jnp.einsum("nab,nb->na", screen.inverse, inside)
    score = jnp.sum(weighted * screen.left) - jnp.sum(back * of_left)
    information = jnp.sum(weighted * net) - jnp.sum(back * inside)
    deviation = place[2] - problem.height_m
    prior = 0.5 * height_precision(problem.height_std_m) * jnp.square(deviation)
    return 0.5 * jnp.square(jnp.maximum(score, 0.0)) / jnp.maximum(information, 1e-30) - prior


@pytree
class Asked:
    """Places to be fitted; the first ``count`` of m."""

    place: jax.Array  # [m, 3]
    nuclide: jax.Array  # [m] int32
    fresh: jax.Array  # [m] bool, whether the activity is not known yet
    count: jax.Array  # [] int32


def promising(
    problem: Problem,
    nuclide: jax.Array,
    others: Others,
    best: Tried,
    reach_m: jax.Array,
    number: jax.Array,
    count: int,
    most: int,
) -> Asked:
    """The best of ``count`` places within ``reach_m`` of the best so far, by a screen.

    A third of them is up to three times as far. ``number`` [] turns the pattern; ``most`` is the size of the result.
    """
    low, high = bounds(problem)
    index = jnp.arange(count)
    share = jnp.sqrt((index + 0.5) / count) * jnp.where(index % 3 == 2, 3.0, 1.0)
    turn = GOLDEN_ANGLE_RAD * (index + count * number)
    height = 2.0 * jnp.mod((index + count * number) * GOLDEN_RATIO, 1.0) - 1.0
    up = height * jnp.minimum(reach_m, 1.5 * problem.height_std_m)
    offset = jnp.stack([reach_m * share * jnp.cos(turn), reach_m * share * jnp.sin(turn), up], axis=-1)
    places = jnp.clip(best.place + offset, low, high)
    screen, lengths = screen_of(problem, others, best), jnp.zeros_like(best.fit.unknowns.lengths)
    values = jax.lax.map(lambda p: screened(problem, screen, nuclide, lengths, p), places)
    chosen = places[jax.lax.top_k(values, SETTLED)[1]]
    return Asked(
        place=jnp.pad(chosen, [(0, most - SETTLED), (0, 0)]),
        nuclide=jnp.full(most, nuclide),
        fresh=jnp.zeros(most, bool),
        count=jnp.int32(SETTLED),
    )


def answered(
    problem: Problem, others: Others, u: Unknowns, asked: Asked, best: Tried, steps: int
) -> tuple[Tried, jax.Array, jax.Array]:
    """The best of the places asked for and ``best``, its number (-1: that of ``best``), and the value of each [m]."""
    Carry = tuple[jax.Array, Tried, jax.Array, jax.Array]

    def next_(carry: Carry) -> Carry:
        k, best, number, values = carry
        tried = attempt(problem, asked.nuclide[k], others, u, asked.place[k], steps, asked.fresh[k])
        better = tried.fit.value > best.fit.value
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), tried, best)
        return k + 1, best, jnp.where(better, k, number), values.at[k].set(tried.fit.value)

    start: Carry = (jnp.int32(0), best, jnp.int32(-1), jnp.full(asked.nuclide.shape, -jnp.inf))
    return jax.lax.while_loop(lambda c: c[0] < asked.count, next_, start)[1:]


def bounds(problem: Problem) -> Bounds:
    """Lower and upper bounds [3] of a place."""
    site = problem.site
    ny, nx = site.terrain_m.shape
    extent = site.cell_m * jnp.array([nx - 1, ny - 1], jnp.float32)
    reach = HEIGHT_REACH * jnp.maximum(problem.height_std_m, 1e-3)
    low, high = site.origin_m, site.origin_m + extent
    return jnp.append(low, problem.height_m - reach), jnp.append(high, problem.height_m + reach)
