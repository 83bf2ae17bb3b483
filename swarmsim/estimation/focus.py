"""An estimate's problem as one source sees it: the windows that tell most of it, and what all others tell in sum.

A posterior is sampled at hundreds of places within metres of its source. Half of a survey's windows are so far off that
hardly anything changes there, and the more vehicles there are the more of them: together they hold some hundredths of
what is known of the source, but also the levels of the background and the other sources. They are kept to second order
about the fit, once for all places.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.estimation.forward import Problem, Rest, rates, ways_from
from swarmsim.estimation.likelihood import height_precision, scaled_inverse
from swarmsim.estimation.nodes import Span
from swarmsim.estimation.normal_equations import (
    Linearised,
    Others,
    Unknowns,
    linearised,
    sums_of,
    told_by_each,
    unknowns_of,
)
from swarmsim.estimation.state import State, without

KEPT = 96  # windows of each span


def focused(problem: Problem, state: State, k: jax.Array) -> tuple[Problem, State]:
    """The same with at most `KEPT` windows of each span, those that tell most of source ``k``, and the `Rest`."""
    if all(last - first <= KEPT for first, last, _, _ in problem.spans):
        return problem, state
    s = state.sources
    u = replace(state.unknowns, activity_bq=s.activity_bq[k])
    ways = ways_from(problem, s.place[k])
    source = rates(problem, ways, s.nuclide[k], u.lengths)
    model = linearised(problem, source, without(state, k).added, ways.position_m, u)
    rows = _most_telling(problem, model, u)
    m = problem.measurements
    left = replace(problem, measurements=replace(m, valid=m.valid.at[rows].set(False)))
    information, push = sums_of(left, model, u)
    rest = Rest(information=information, push=push, unknowns=unknowns_of(model, u))
    return replace(_of_rows(problem, rows), rest=rest), _state_of(state, rows)


def _most_telling(problem: Problem, model: Linearised, u: Unknowns) -> jax.Array:
    """The rows [m] of the windows to keep, in ascending order: by their leverage on the place and the activity."""
    told = told_by_each(problem, model, u)
    by = jnp.concatenate([model.nearer, jnp.ones((1, told.shape[0]))])
    information = (by * told) @ by.T
    covariance = scaled_inverse(information.at[2, 2].add(height_precision(problem.height_std_m)))
    leverage = told * jnp.sum(by * (covariance @ by), axis=0)
    leverage = jnp.where(problem.measurements.valid, leverage, -1.0)
    rows = [
        first + jnp.sort(jax.lax.top_k(leverage[first:last], min(KEPT, last - first))[1])
        for first, last, _, _ in problem.spans
    ]
    return jnp.concatenate(rows)


def _of_rows(problem: Problem, rows: jax.Array) -> Problem:
    """The problem with these rows [m] alone."""
    spans: list[Span] = []
    nodes, begin, at = [], 0, 0
    for first, last, number, rays in problem.spans:
        kept = min(KEPT, last - first)
        own = rows[at : at + kept] - first
        nodes.append(begin + (own[:, None] * rays + np.arange(rays)).reshape(-1))
        spans.append((at, at + kept, number, rays))
        begin, at = begin + (last - first) * rays, at + kept
    chosen = jnp.concatenate(nodes)
    return replace(
        problem,
        measurements=jax.tree.map(lambda x: x[rows], problem.measurements),
        background=problem.background[rows],
        pose_std_m=problem.pose_std_m[rows],
        trust=problem.trust[rows],
        detector=problem.detector[rows],
        dead_s=problem.dead_s[rows],
        nodes=jax.tree.map(lambda x: x[chosen], problem.nodes),
        spans=tuple(spans),
    )


def _state_of(state: State, rows: jax.Array) -> State:
    """The state with what it holds of these rows [m] alone."""
    u, added = state.unknowns, state.added
    return replace(
        state,
        added=Others(counts=added.counts[:, rows], variance=added.variance[:, rows]),
        unknowns=replace(u, background=u.background[rows], gain=u.gain[rows]),
    )
