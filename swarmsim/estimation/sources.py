"""How many sources there are, where, and of which nuclides: one after another, then all together.

As long as a further source explains the counts so much better that chance is out of the question, it is
sought (`swarmsim.estimation.seek`), and the sources known before are sought again beside it.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp

from swarmsim.device import IN_STEP, for_those, repeat_while
from swarmsim.estimation.forward import Problem
from swarmsim.estimation.pairs import are_mixed, divided, divisible, joined, strain
from swarmsim.estimation.seek import HOPELESS, SearchParams, least_of, sought, with_source
from swarmsim.estimation.starts import Places
from swarmsim.estimation.state import State, Suspect, nobody, ratios, settled, signals, without
from swarmsim.pytree import pytree

TRIAL = 10.0  # times the threshold: the ratio of a source below which it is tried whether it can be done without
SEEKS_PER_SOURCE = 6  # on average, at most
DIVISIONS = 4  # of one into two, or of two into other two, at most
MIXINGS = 4  # times that two of different nuclides are placed together, at most
ADVANCES = 2  # times that others are sought beside a further source that does not explain enough yet, at most
RELAXED = 0.5
"""Of the strain before, what two of different nuclides that are placed together may leave at most.

Where a further source is missing they take up some of what it adds wherever they are, and leave 0.96 of it; right
places left 0.05 to 0.15.
"""


@pytree
class _Progress:
    """How far the search is."""

    state: State
    again: jax.Array  # [K] bool, sources that are to be sought again, the others held
    wide: jax.Array  # [] bool, whether they are sought as far as a new one
    trial: jax.Array  # [] bool, whether ``state`` lacks a source that `before` has
    advanced: jax.Array  # [] bool, whether it has one that `before` lacks and that does not explain enough yet
    before: State
    over: jax.Array  # [] bool
    left: jax.Array  # [] int32, seeks at most
    divisions: jax.Array  # [] int32, how often one may still be taken for two, or two be placed anew
    mixings: jax.Array  # [] int32, how often two of different nuclides may still be placed together
    advances: jax.Array  # [] int32, how often one may still be taken for such a source
    made: jax.Array  # [K] bool, sources that the last division made
    closing: jax.Array  # [] bool, whether companions have been joined: no more sources are added


def find_sources(problem: Problem, places: Places, allowed: jax.Array, params: SearchParams, state: State) -> State:
    """Seek the sources of ``state`` again, then add others until no further one explains the counts beyond chance.

    After each that is added the others are sought again, and then that one beside them. Then the one that is missed
    least is left out for a trial: the first source found between two others is none, and the others, sought again,
    explain the counts as well. One found between two keeps the second from explaining what is asked of it: a further
    source that explains part of that is taken for one if all of them, sought again from everywhere, do. In the end one
    is taken for two where that is what the counts ask for, and companions are taken away (`swarmsim.estimation.pairs`).

    Args:
        problem: the data.
        places: where a source is looked for first.
        allowed: [N] bool, nuclides in question.
        params: settings.
        state: what is known already (`no_sources`).
    """
    s = state.sources
    zero = jnp.zeros_like(s.joined_m)
    fresh = replace(s, joined_m=zero, beside_m=zero, beside_bq=zero)
    state = replace(state, sources=fresh, suspect=nobody())
    first = settled(problem, replace(state, added=signals(problem, state.sources, state.unknowns.lengths)))
    no = jnp.array(False)
    start = _Progress(
        state=first, again=first.sources.present, wide=~no, trial=no, before=first, over=no,
        left=jnp.int32(SEEKS_PER_SOURCE * params.sources_max), divisions=jnp.int32(DIVISIONS), closing=no,
        mixings=jnp.int32(MIXINGS), made=jnp.zeros_like(first.sources.present),
        advanced=no, advances=jnp.int32(ADVANCES),
    )  # fmt: skip

    def step(p: _Progress) -> _Progress:
        adding = ~jnp.any(p.again)
        slot = jnp.where(adding, jnp.argmin(p.state.sources.present), jnp.argmax(p.again))
        asked = least_of(params, p.state)
        advance = adding & jnp.any(p.state.sources.present) & (p.advances > 0)
        least = jnp.where(advance, HOPELESS, 1.0) * asked
        state, found, best = sought(problem, places, allowed, params, p.state, slot, adding, p.wide, least)
        advance &= found & (best.ratio < asked)
        suspect = jax.tree.map(partial(jnp.where, adding & ~found), best, state.suspect)
        state = replace(state, suspect=suspect)
        present = state.sources.present
        mine = jnp.arange(present.shape[0]) == slot
        # a new one as well, once it stands beside others: before, it explained what these did where they were
        beside = adding & found & (jnp.sum(present) > 1)
        again = jnp.where(adding & found, present, p.again) & (beside | ~mine)
        done = ~jnp.any(again) & (found | ~adding)
        wide = advance | (p.wide & jnp.any(again) & ~adding)
        before = jax.tree.map(partial(jnp.where, advance), p.state, p.before)
        p = replace(p, state=state, again=again, wide=wide, over=adding & ~found, left=p.left - 1)
        p = replace(p, before=before, advanced=p.advanced | advance, advances=p.advances - advance)
        untried = done & ~p.trial & ~p.closing
        p = _ended_trial(params.further, p, done & p.trial)
        p = _ended_advance(params.further, p, done & p.advanced)
        untried &= ~p.over & (jnp.sum(p.state.sources.present) >= 2)
        p = _begun_trial(problem, params, p, untried)
        full = (jnp.all(p.state.sources.present) | p.closing) & ~jnp.any(p.again)
        spent = p.left <= 0
        # a trial that found no end has shown nothing
        state = jax.tree.map(partial(jnp.where, spent & (p.trial | p.advanced)), p.before, p.state)
        p = replace(p, state=state, trial=p.trial & ~spent, advanced=p.advanced & ~spent, over=p.over | full | spent)
        return _joined(problem, _divided(problem, params, p))

    return _believed(problem, params, repeat_while(lambda p: ~p.over, step, start, IN_STEP).state)


def _believed(problem: Problem, params: SearchParams, state: State) -> State:
    """The state, without its only source where that explains less than is asked of one.

    An earlier estimate may have had it from counts to which later ones say otherwise.
    """

    def judged() -> State:
        k = jnp.argmax(state.sources.present)
        none = settled(problem, without(state, k))
        return jax.tree.map(partial(jnp.where, ratios(problem, state)[k] < params.threshold), none, state)

    return for_those(jnp.sum(state.sources.present) == 1, judged, lambda: state)


def needed(problem: Problem, params: SearchParams, state: State) -> tuple[State, jax.Array]:
    """The state without those beside others that are not missed; and each one's likelihood ratio [K] (`ratios`).

    Where sampling has moved a source it may explain what another one stood for. The one that is missed least is taken
    away first.
    """

    def look(known: tuple[State, jax.Array, jax.Array]) -> tuple[State, jax.Array, jax.Array]:
        state, _, _ = known
        present, ratio = state.sources.present, ratios(problem, state)
        k = jnp.argmin(jnp.where(present, ratio, jnp.inf))
        needless = (jnp.sum(present) > 1) & (ratio[k] < HOPELESS * params.further)
        left = for_those(needless, lambda: settled(problem, without(state, k)), lambda: state)
        return left, ratio, needless

    start = state, jnp.zeros(state.sources.present.shape[0]), jnp.array(True)
    state, ratio, _ = repeat_while(lambda known: known[2], look, start)
    return state, ratio


def _divided(problem: Problem, params: SearchParams, p: _Progress) -> _Progress:
    """Two sources in the place of one, or of two, if windows' rates depart from the model without that.

    At the end, and two of different nuclides before others are added, which would explain what these do not. Both are
    sought again, and then tried as all others are.
    """
    sources = p.state.sources
    # enough are left to try them
    enough = p.left > sources.present.shape[0] + 2
    open_ = ~jnp.any(p.again) & ~p.closing & ~p.trial & enough
    ends = p.over & divisible(sources) & (p.divisions > 0)
    mixed = are_mixed(sources) & (p.mixings > 0) & ~ends
    possible = open_ & (mixed | ends)
    before = for_those(possible, lambda: strain(problem, p.state)[0], lambda: jnp.zeros(()))
    now = possible & (before > params.further)

    def divide() -> _Progress:
        two, state, ratio = divided(problem, p.state, mixed)
        state, numbers = with_source(problem, state, two.slot, two.second), jnp.arange(sources.present.shape[0])
        from_ = jnp.where(mixed, two.slot, two.number)
        table = state.sources.nuclide_value.at[two.slot].set(state.sources.nuclide_value[from_])
        state = replace(state, sources=replace(state.sources, nuclide_value=table))
        both = (numbers == two.number) | (numbers == two.slot)
        once = mixed.astype(jnp.int32)
        tried = replace(p, mixings=p.mixings - once, divisions=p.divisions - (1 - once))
        # what is placed together was not made by a division before
        made = jnp.where(mixed, p.made & ~both, both)
        after = replace(tried, state=state, again=both, made=made, over=jnp.array(False))
        relaxed = ~mixed | (strain(problem, state)[0] < RELAXED * before)
        better = (ratio > HOPELESS * params.further) & relaxed
        # what cannot be divided now cannot be later
        hopeless = replace(tried, divisions=jnp.where(mixed, p.divisions, 0))
        return jax.tree.map(partial(jnp.where, better), after, hopeless)

    return for_those(now, divide, lambda: p)


def _joined(problem: Problem, p: _Progress) -> _Progress:
    """At the end: companions are taken away, and those that are left sought again.

    While others were sought they took up what the model does not explain.
    """
    now = p.over & ~p.closing & ~p.trial

    def join() -> _Progress:
        state, some = joined(problem, p.state)
        left = state.sources.present
        after = replace(
            p, state=state, again=left, over=jnp.array(False), closing=jnp.array(True), left=p.left + left.shape[0]
        )
        return jax.tree.map(partial(jnp.where, some), after, p)

    return for_those(now, join, lambda: p)


def _begun_trial(problem: Problem, params: SearchParams, p: _Progress, now: jax.Array) -> _Progress:
    """``now``: the others without the source that is missed least, to be sought again.

    For a trial if that source may not be needed; for good if the counts do not ask for it where the others are.
    """

    def begin() -> _Progress:
        s = p.state.sources
        ratio = jnp.where(s.present, ratios(problem, p.state), jnp.inf)
        k = jnp.argmin(ratio)
        less = replace(p, state=settled(problem, without(p.state, k)), before=p.state)
        least = params.further
        less = replace(less, trial=ratio[k] >= least, again=less.state.sources.present)
        less = replace(less, divisions=_divisions(p, (jnp.arange(len(s.present)) == k) & (ratio[k] < least)))
        return jax.tree.map(partial(jnp.where, ratio[k] < TRIAL * least), less, p)

    return for_those(now, begin, lambda: p)


def _ended_trial(least: jax.Array, p: _Progress, now: jax.Array) -> _Progress:
    """``now``: the sources before the trial, unless those left explain the counts as well, within ``least`` []."""
    gone = p.before.sources.present & ~p.state.sources.present
    needless = 2.0 * (p.before.likelihood - p.state.likelihood) < least
    kept = jax.tree.map(partial(jnp.where, now & ~needless), p.before, p.state)
    return replace(p, state=kept, trial=p.trial & ~now, divisions=_divisions(p, now & needless & gone))


def _ended_advance(least: jax.Array, p: _Progress, now: jax.Array) -> _Progress:
    """``now``: the sources with the further one if all explain ``least`` [] more; else those before, and no more."""
    gain = 2.0 * (p.state.likelihood - p.before.likelihood)
    short = now & (gain < least)
    s = p.state.sources
    new = jnp.argmax(s.present & ~p.before.sources.present)
    before = replace(p.before, suspect=Suspect(ratio=gain, place=s.place[new], nuclide=s.nuclide[new]))
    kept = jax.tree.map(partial(jnp.where, short), before, p.state)
    return replace(p, state=kept, advanced=p.advanced & ~now, over=p.over | short)


def _divisions(p: _Progress, removed: jax.Array) -> jax.Array:
    """How many more there may be: none once one that a division made is ``removed`` [K], for it would come again."""
    return jnp.where(jnp.any(removed & p.made), 0, p.divisions)
