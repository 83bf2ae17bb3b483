"""How many sources there are, where, and of which nuclides: one after another, then all together.

As long as a further source explains the counts so much better that chance is out of the question, the grid's most
promising points (`swarmsim.estimation.scan`) are tried with rays through the site, its nuclide is chosen among all
that are allowed, and the sources known before are fitted again beside it.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.estimation.model import (
    Others,
    Problem,
    Settled,
    Unknowns,
    _linear,
    _log_likelihood,
    _moved,
    _normal,
    _prior,
    nothing_known,
    position_of,
    rates,
    silent,
    variance_of,
    ways_from,
)
from swarmsim.estimation.scan import scan, strongest
from swarmsim.estimation.search import STEPS, Asked, Tried, answered, promising
from swarmsim.pytree import pytree, static

ALONE_STEPS = 4  # Gauss-Newton steps without a further source
SCREENED = 48  # places looked at in a later round of the search
STARTS = 6  # grid points that are tried for a further source
FAR = 1.5  # reach of the first round, in which the most are looked at
CLOSING = 0.4  # reach of a round over that of the one before
PROMISING = 0.3  # of the threshold: the open-air statistic that makes a search with rays worth while
APART_M = 12.0  # between starts
TRIAL = 10.0  # times the threshold: the ratio of a source below which it is tried whether it can be done without
SEEKS_PER_SOURCE = 6  # on average, at most


@pytree
class SearchParams:
    """Settings of the search for sources."""

    threshold: jax.Array  # [] twice the logarithm of the likelihood ratio that a source must reach
    reach_m: jax.Array  # [] of the first round around a grid point
    screened: int = static()  # places looked at in the first round around a grid point
    rounds: int = static()
    sources_max: int = static()


@pytree
class Sources:
    """Sources found; K places for them."""

    place: jax.Array  # [K, 3] x, y, height above the ground
    nuclide: jax.Array  # [K] int32
    activity_bq: jax.Array  # [K]
    present: jax.Array  # [K] bool
    nuclide_value: jax.Array  # [K, N] logarithm of the posterior of each nuclide at its place
    towards: jax.Array  # [K, 3, 3] information about its place (`Settled.towards`)


@pytree
class State:
    """Sources, and the fit of all of them."""

    sources: Sources
    added: Others  # what they add; nothing for those that are not there
    unknowns: Unknowns  # its own activity is zero: that of the sources stands there
    likelihood: jax.Array  # []


def no_sources(problem: Problem, count: int, nuclides: int) -> State:
    """Nothing found yet."""
    zero = jnp.zeros(count)
    return State(
        sources=Sources(
            place=jnp.zeros((count, 3)).at[:, 2].set(problem.height_m),
            nuclide=jnp.zeros(count, jnp.int32),
            activity_bq=zero,
            present=jnp.zeros(count, bool),
            nuclide_value=jnp.zeros((count, nuclides)),
            towards=jnp.zeros((count, 3, 3)),
        ),
        added=Others(
            counts=jnp.zeros((count, *problem.background.shape)), variance=jnp.zeros((count, len(problem.background)))
        ),
        unknowns=nothing_known(problem, count),
        likelihood=-jnp.asarray(jnp.inf),
    )


def signals(problem: Problem, s: Sources, lengths: jax.Array) -> Others:
    """What the sources add; nothing for those that are not there."""

    def one(x: tuple[jax.Array, jax.Array, jax.Array, jax.Array]) -> Others:
        place, nuclide, activity, there = x
        n, regions = problem.background.shape

        def seen() -> Others:
            ways = ways_from(problem, place)
            found = rates(problem, ways, nuclide, lengths)
            return Others(counts=activity * found.counts, variance=variance_of(problem, ways.position_m) + found.edge)

        return jax.lax.cond(there, seen, lambda: Others(counts=jnp.zeros((n, regions)), variance=jnp.zeros(n)))

    return jax.lax.map(one, (s.place, s.nuclide, s.activity_bq, s.present))


def _alone(problem: Problem, others: Others, u: Unknowns, steps: int) -> tuple[Unknowns, Any]:
    """Best unknowns with the sources ``others`` alone, and the model there."""
    m = problem.measurements
    assert m.rois is not None

    def linear(u: Unknowns) -> Any:
        return _linear(problem, silent(problem), others, jnp.zeros(3), u)

    def step(u: Unknowns, _: None) -> tuple[Unknowns, None]:
        return _moved(problem, u, _normal(problem, linear(u), u)), None

    u = jax.lax.scan(step, replace(u, activity_bq=jnp.zeros(())), None, length=steps)[0]
    return u, linear(u)


def without_more(problem: Problem, others: Others, u: Unknowns, steps: int) -> tuple[Unknowns, jax.Array]:
    """Best unknowns with the sources ``others`` alone, and the likelihood with the priors."""
    m = problem.measurements
    assert m.rois is not None
    u, model = _alone(problem, others, u, steps)
    common = _prior(problem, u.others.shape[0])
    penalty = jnp.sum(common[-u.lengths.shape[0] :] * jnp.square(u.lengths))
    each = jnp.stack([u.background, u.gain], axis=-1)
    penalty = penalty + jnp.sum(jnp.where(m.valid[:, None], model.precision * jnp.square(each), 0.0))
    return u, _log_likelihood(m.rois, model.mean, m.valid) - 0.5 * penalty


@pytree
class _Progress:
    """How far the search is."""

    state: State
    again: jax.Array  # [K] bool, sources that are to be sought again, the others held
    trial: jax.Array  # [] bool, whether ``state`` lacks a source that `before` has
    before: State
    over: jax.Array  # [] bool
    left: jax.Array  # [] int32, seeks at most


def find_sources(
    problem: Problem, points_m: jax.Array, allowed: jax.Array, params: SearchParams, state: State
) -> State:
    """Seek the sources of ``state`` again, then add others until no further one explains the counts beyond chance.

    After each that is added the others are sought again. Then the one that is missed least is left out for a trial: the
    first source found between two others is none, and the others, sought again, explain the counts as well.

    Args:
        problem: the data.
        points_m: [C, 3] grid of the first look, world.
        allowed: [N] bool, nuclides in question.
        params: settings.
        state: what is known already (`no_sources`).
    """
    first = settled(problem, replace(state, added=signals(problem, state.sources, state.unknowns.lengths)))
    no = jnp.array(False)
    start = _Progress(
        state=first, again=first.sources.present, trial=no, before=first, over=no,
        left=jnp.int32(SEEKS_PER_SOURCE * params.sources_max),
    )  # fmt: skip

    def step(p: _Progress) -> _Progress:
        adding = ~jnp.any(p.again)
        slot = jnp.where(adding, jnp.argmin(p.state.sources.present), jnp.argmax(p.again))
        state, found = _sought(problem, points_m, allowed, params, p.state, slot, adding)
        present = state.sources.present
        mine = jnp.arange(present.shape[0]) == slot
        again = jnp.where(adding & found, present, p.again) & ~mine
        done = ~jnp.any(again) & (found | ~adding)
        p = replace(p, state=state, again=again, over=adding & ~found, left=p.left - 1)
        p = _ended_trial(params, p, done & p.trial)
        p = _begun_trial(problem, params, p, done & ~p.trial & (jnp.sum(present) >= 2))
        full = jnp.all(p.state.sources.present) & ~jnp.any(p.again)
        return replace(p, over=p.over | full | (p.left <= 0))

    return jax.lax.while_loop(lambda p: ~p.over, step, start).state


def _begun_trial(problem: Problem, params: SearchParams, p: _Progress, now: jax.Array) -> _Progress:
    """``now``, and if a source may be missed little: the others without it, to be sought again."""

    def begin() -> _Progress:
        s = p.state.sources
        ratio = jnp.where(s.present, ratios(problem, p.state), jnp.inf)
        k = jnp.argmin(ratio)
        less = replace(p, state=settled(problem, without(p.state, k)), before=p.state)
        less = replace(less, trial=jnp.array(True), again=less.state.sources.present)
        return jax.tree.map(partial(jnp.where, ratio[k] < TRIAL * params.threshold), less, p)

    return jax.lax.cond(now, begin, lambda: p)


def _ended_trial(params: SearchParams, p: _Progress, now: jax.Array) -> _Progress:
    """``now``: the sources before the trial, unless those left explain the counts as well."""
    needless = 2.0 * (p.before.likelihood - p.state.likelihood) < params.threshold
    kept = jax.tree.map(partial(jnp.where, now & ~needless), p.before, p.state)
    return replace(p, state=kept, trial=p.trial & ~now)


def _sought(
    problem: Problem,
    points_m: jax.Array,
    allowed: jax.Array,
    params: SearchParams,
    state: State,
    slot: jax.Array,
    adding: jax.Array,
) -> tuple[State, jax.Array]:
    """The state with a source in ``slot`` sought, a new one or that one again; and whether [] there is one."""
    s = state.sources
    others = without(state, slot).added
    own = jnp.arange(allowed.shape[0]) == s.nuclide[slot]
    nuclides = jnp.where(adding, allowed, own)
    scanned = scan(problem, points_m, nuclides, others, state.unknowns)
    index, statistic = strongest(scanned, points_m, STARTS, APART_M)

    def look() -> tuple[State, jax.Array]:
        best, nuclide, values = _best(
            problem, points_m[index], scanned.nuclide[index], nuclides, params, state, others, slot, adding
        )
        ratio = 2.0 * (best.fit.likelihood - state.likelihood)
        found = ~adding | (ratio > params.threshold)
        after = _with(problem, state, slot, best, nuclide)
        kept = jnp.where(adding, values, s.nuclide_value[slot])
        table = after.sources.nuclide_value.at[slot].set(kept)
        after = replace(after, sources=replace(after.sources, nuclide_value=table))
        return jax.tree.map(partial(jnp.where, found), after, state), found

    worth = ~adding | (statistic[0] > PROMISING * params.threshold)
    return jax.lax.cond(worth, look, lambda: (state, jnp.array(False)))


def _best(
    problem: Problem,
    points_m: jax.Array,
    nuclides: jax.Array,
    allowed: jax.Array,
    params: SearchParams,
    state: State,
    others: Others,
    slot: jax.Array,
    adding: jax.Array,
) -> tuple[Tried, jax.Array, jax.Array]:
    """The best place from some grid points, or from where the source is; its nuclide, and the value of each [N]."""
    s, known = state.sources, allowed.shape[0]
    most = max(known, STARTS + 1)
    u = replace(state.unknowns, activity_bq=jnp.where(adding, 0.0, s.activity_bq[slot]))
    far = -(-params.screened // SCREENED)
    # the first round fits the starts, and one in between the nuclides at the best place
    reaches = jnp.concatenate(
        [
            jnp.zeros(1),
            jnp.full(far, FAR),
            jnp.array([1.0, 0.5, 0.0]),
            CLOSING ** jnp.arange(params.rounds, dtype=jnp.float32),
        ]
    )
    naming = far + 3

    def begin() -> Asked:
        starts = jnp.concatenate([points_m[:, :2], jnp.broadcast_to(problem.height_m, (STARTS, 1))], axis=1)
        places = jnp.concatenate([s.place[slot][None], starts])
        kinds = jnp.append(jnp.where(adding, nuclides[0], s.nuclide[slot]), nuclides)
        first = jnp.where(adding, 1, 0)  # a new source has no place yet
        return Asked(
            place=jnp.pad(jnp.roll(places, -first, axis=0), [(0, most - STARTS - 1), (0, 0)]),
            nuclide=jnp.pad(jnp.roll(kinds, -first), (0, most - STARTS - 1)),
            fresh=jnp.arange(most) >= 1 - first,
            count=STARTS + 1 - first,
        )

    def name(best: Tried) -> Asked:
        everyone = jnp.argsort(~allowed).astype(jnp.int32)  # the allowed ones first
        places = jnp.broadcast_to(best.place, (most, 3))
        everyone = jnp.pad(everyone, (0, most - known))
        return Asked(place=places, nuclide=everyone, fresh=jnp.ones(most, bool), count=jnp.sum(allowed))

    Carry = tuple[Tried, jax.Array, jax.Array]

    def round_(carry: Carry, x: tuple[jax.Array, jax.Array]) -> tuple[Carry, None]:
        best, nuclide, values = carry
        number, reach = x
        which = jnp.where(number == 0, 0, jnp.where(number == naming, 1, 2))
        reach_m = reach * params.reach_m
        asked = jax.lax.switch(
            which,
            [
                begin,
                lambda: name(best),
                lambda: promising(problem, nuclide, others, best, reach_m, number, SCREENED, most),
            ],
        )
        skipped = (which == 1) & ~adding
        asked = replace(asked, count=jnp.where(skipped, 0, asked.count))
        none = replace(best, fit=replace(best.fit, value=-jnp.asarray(jnp.inf)))
        before = jax.tree.map(partial(jnp.where, (which == 1) & ~skipped), none, best)
        start = jax.tree.map(partial(jnp.where, which == 0), u, best.fit.unknowns)
        best, chosen, found = answered(problem, others, start, asked, before, STEPS)
        named = (which == 1) & ~skipped
        table = jnp.full(known, -jnp.inf).at[asked.nuclide].max(found)
        nuclide = jnp.where(chosen >= 0, asked.nuclide[jnp.maximum(chosen, 0)], nuclide)
        return (best, nuclide, jnp.where(named, table, values)), None

    carry: Carry = (_nowhere(problem, u), s.nuclide[slot], jnp.zeros(known))
    return jax.lax.scan(round_, carry, (jnp.arange(reaches.shape[0]), reaches))[0]


def _nowhere(problem: Problem, u: Unknowns) -> Tried:
    """A place that is worse than any."""
    unknown = -jnp.asarray(jnp.inf)
    shared = 1 + u.others.shape[0] + u.level.shape[0] + u.lengths.shape[0]
    return Tried(
        place=jnp.zeros(3),
        fit=Settled(
            value=unknown,
            likelihood=unknown,
            unknowns=u,
            covariance=jnp.eye(shared),
            towards=jnp.eye(3),
            rates=silent(problem),
        ),
    )


def _with(problem: Problem, state: State, k: jax.Array, best: Tried, nuclide: jax.Array) -> State:
    """The state with source ``k`` as the fit has it."""
    s, u = state.sources, best.fit.unknowns
    sources = replace(
        s,
        place=s.place.at[k].set(best.place),
        nuclide=s.nuclide.at[k].set(nuclide),
        activity_bq=(s.activity_bq * u.others).at[k].set(u.activity_bq),
        present=s.present.at[k].set(True),
        towards=s.towards.at[k].set(best.fit.towards),
    )
    scaled = state.added.counts * u.others[:, None, None]
    added = Others(
        counts=scaled.at[k].set(u.activity_bq * best.fit.rates.counts),
        variance=state.added.variance.at[k].set(
            variance_of(problem, position_of(problem.site, best.place)) + best.fit.rates.edge
        ),
    )
    return State(sources=sources, added=added, unknowns=_shared(u), likelihood=best.fit.likelihood)


def without(state: State, k: jax.Array) -> State:
    """The state without source ``k``, nothing fitted anew."""
    present = state.sources.present.at[k].set(False)
    added = replace(state.added, counts=state.added.counts.at[k].set(0.0))
    return replace(state, sources=replace(state.sources, present=present), added=added)


def settled(problem: Problem, state: State) -> State:
    """The state with all unknowns but the places fitted."""
    u, likelihood = without_more(problem, state.added, state.unknowns, ALONE_STEPS)
    sources = replace(state.sources, activity_bq=state.sources.activity_bq * u.others)
    added = replace(state.added, counts=state.added.counts * u.others[:, None, None])
    return State(sources=sources, added=added, unknowns=_shared(u), likelihood=likelihood)


def _shared(u: Unknowns) -> Unknowns:
    """The unknowns with what they say of sources taken over by these."""
    return replace(u, activity_bq=jnp.zeros(()), others=jnp.ones_like(u.others))


def ratios(problem: Problem, state: State) -> jax.Array:
    """Twice the logarithm of the likelihood ratio [K] against the same without each source, the other places held."""

    def one(k: jax.Array) -> jax.Array:
        def look() -> jax.Array:
            rest = without(state, k).added
            return 2.0 * (state.likelihood - without_more(problem, rest, state.unknowns, ALONE_STEPS)[1])

        return jax.lax.cond(state.sources.present[k], look, lambda: jnp.zeros(()))

    return jax.lax.map(one, jnp.arange(state.sources.present.shape[0]))
