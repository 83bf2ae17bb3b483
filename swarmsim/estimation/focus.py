"""An estimate's problem as one source sees it: the windows that tell its place in detail, and all others in sum.

A posterior is sampled at hundreds of places within metres of its source. What most windows of a survey tell changes
evenly from one of them to the next, and the more vehicles there are the more such windows: they are kept to second
order about the fit, once for all places. The others, near the source or where walls throw shadows on them, stay as they
are.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.estimation.forward import Problem, Rates, Rest, few_rows, most_of, of_rows, rates, silent, ways_from
from swarmsim.estimation.likelihood import height_precision, scaled_inverse
from swarmsim.estimation.normal_equations import Others, eliminated, linearised, sums_of, unknowns_of
from swarmsim.estimation.state import State, without

KEPT = 96  # windows of each span
ALONG = 1.5  # standard deviations along each axis of what is known of the place, at which windows are looked at
AROUND_M = 1.0  # and so far off, in modes that there may be beside it
LEAST_STD_M = 0.02  # of the place, at least
DARK = 1e-3  # of the brightest rate per becquerel: darker windows count as if they were as bright


def focused(problem: Problem, state: State, k: jax.Array) -> tuple[Problem, State]:
    """The same with at most `KEPT` windows of each span, those that tell most of source ``k``, and the `Rest`."""
    if few_rows(problem, KEPT):
        return problem, state
    others = without(state, k).added
    u = replace(state.unknowns, activity_bq=state.sources.activity_bq[k])
    source, log_rates, places = _looked_at(problem, state, k, u.lengths)
    model = linearised(problem, source, others, places[-1], u)
    e, sources = eliminated(problem, model, u), u.others.shape[0]
    # what a straight line about the source would tell wrongly
    bent = log_rates[:-1] - log_rates[-1] - (places[:-1] - places[-1]) @ model.nearer
    rows = most_of(problem, e.products[0, 0] * jnp.mean(jnp.square(bent), axis=0), KEPT)
    information, push = sums_of(problem, model, sources, e, jnp.ones(u.gain.shape).at[rows].set(0.0))
    rest = Rest(information=information, push=push, unknowns=unknowns_of(model, u))
    return replace(of_rows(problem, rows, KEPT), rest=rest), _state_of(state, rows)


def _looked_at(problem: Problem, state: State, k: jax.Array, lengths: jax.Array) -> tuple[Rates, jax.Array, jax.Array]:
    """The rates of source ``k``, and their logarithms [m, n] at places [m, 3] (world) around it, it being the last."""
    place, nuclide = state.sources.place[k], state.sources.nuclide[k]
    known = jnp.diag(jnp.append(jnp.full(2, 1.0 / AROUND_M**2), height_precision(problem.height_std_m)))
    covariance = scaled_inverse(problem.learning_rate * state.sources.towards[k] + known)
    least = jnp.square(problem.geometry_std_m) + LEAST_STD_M**2
    axes = ALONG * jnp.linalg.cholesky(covariance + least * jnp.eye(3)).T
    # four along the axes would not see what bends along the diagonals alone, as the distance of a window does there
    turn = jnp.arange(6) * (jnp.pi / 3.0)
    wide = AROUND_M * jnp.stack([jnp.cos(turn), jnp.sin(turn), jnp.zeros(6)], axis=1)
    offsets = jnp.concatenate([axes, -axes, wide, jnp.zeros((1, 3))])

    def look(offset: jax.Array) -> tuple[Rates, tuple[jax.Array, jax.Array]]:
        ways = ways_from(problem, place + offset)
        found = rates(problem, ways, nuclide, lengths)
        return found, (jnp.sum(found.counts, axis=1), ways.position_m)

    # a scan keeps the rates of one place alone, and compiles them once
    source, (bright, places) = jax.lax.scan(lambda _, offset: look(offset), silent(problem), offsets)
    return source, jnp.log(bright + DARK * jnp.max(bright[-1]) + 1e-30), places


def _state_of(state: State, rows: jax.Array) -> State:
    """The state with what it holds of these rows [m] alone."""
    u, added = state.unknowns, state.added
    return replace(
        state,
        added=Others(counts=added.counts[:, rows], variance=added.variance[:, rows]),
        unknowns=replace(u, background=u.background[rows], gain=u.gain[rows]),
    )
