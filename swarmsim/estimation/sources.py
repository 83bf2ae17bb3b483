"""How many sources there are, where, and of which nuclides: one after another, then all together.

As long as a further source explains the counts so much better that chance is out of the question, the grid's most
promising points (`swarmsim.estimation.scan`) are tried with rays through the site, its nuclide is chosen among all
that are allowed, and the sources known before are fitted again beside it.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp

from swarmsim.device import IN_STEP, for_those, repeat_while, switch
from swarmsim.estimation.fit import FLAT, Settled
from swarmsim.estimation.forward import Problem, Rates, variance_of
from swarmsim.estimation.likelihood import position_of
from swarmsim.estimation.normal_equations import Others
from swarmsim.estimation.pairs import are_mixed, divided, divisible, joined, strain
from swarmsim.estimation.search import FITTED, Candidates, Tried, best_of, screen_of, spread, spread_along
from swarmsim.estimation.starts import STARTS, Places, Starts, no_starts, starts_of
from swarmsim.estimation.state import State, ratios, settled, shared, signals, without
from swarmsim.pytree import pytree, static

PART = 12  # candidates in each part of a round, at least
INDOORS = 1  # rounds that try places in buildings, those where the open air's statistic is largest
BEGINNINGS = INDOORS + STARTS // FITTED  # and points of the grid
AROUND = 1.5  # how far around a grid point, over the distance from one to the next
REACHES = (1.5, 1.0)  # of the rounds after those, over `SearchParams.reach_m`; nuclides are compared in the second
CLOSING = 0.55  # reach of a later round over that of the one before
NAMED_AGAIN = 3  # of those rounds, after which nuclides are compared again: from a reach of 6 m one is known to a metre then
PROMISING = 0.3  # of the threshold: the open-air statistic that makes a search with rays worth while
HOPELESS = 0.4  # of the threshold: the ratio at the best of some starts below which no further round is worth while
TOLERANT = 0.25  # 1/m: error of the model in a round over its reach, so that wrong places differ by little at first
MOST_TOLERANT = 0.5
TRIAL = 10.0  # times the threshold: the ratio of a source below which it is tried whether it can be done without
SEEKS_PER_SOURCE = 6  # on average, at most
DIVISIONS = 4  # of one into two, or of two into other two, at most
MIXINGS = 4  # times that two of different nuclides are placed together, at most
RELAXED = 0.5
"""Of the strain before, what two of different nuclides that are placed together may leave at most.

Where a further source is missing they take up some of what it adds wherever they are, and leave 0.96 of it; right
places left 0.05 to 0.15.
"""


@pytree
class SearchParams:
    """Settings of the search for sources."""

    threshold: jax.Array  # [] twice the logarithm of the likelihood ratio that a source must reach
    further: jax.Array  # [] the same of a source beside others, whose errors of the model look like further sources
    reach_m: jax.Array  # [] of the search around the best of the grid points
    grid_m: jax.Array  # [] from one grid point to the next
    rounds: int = static()  # that close in
    sources_max: int = static()


_Rounds = tuple[jax.Array, Tried, jax.Array, jax.Array]
"""Number of the next round; the best so far; the value of each nuclide; whether it may go back for another nuclide."""


@pytree
class _Progress:
    """How far the search is."""

    state: State
    again: jax.Array  # [K] bool, sources that are to be sought again, the others held
    wide: jax.Array  # [] bool, whether they are sought as far as a new one
    trial: jax.Array  # [] bool, whether ``state`` lacks a source that `before` has
    before: State
    over: jax.Array  # [] bool
    left: jax.Array  # [] int32, seeks at most
    divisions: jax.Array  # [] int32, how often one may still be taken for two, or two be placed anew
    mixings: jax.Array  # [] int32, how often two of different nuclides may still be placed together
    made: jax.Array  # [K] bool, sources that the last division made
    closing: jax.Array  # [] bool, whether companions have been joined: no more sources are added


def find_sources(problem: Problem, places: Places, allowed: jax.Array, params: SearchParams, state: State) -> State:
    """Seek the sources of ``state`` again, then add others until no further one explains the counts beyond chance.

    After each that is added the others are sought again. Then the one that is missed least is left out for a trial: the
    first source found between two others is none, and the others, sought again, explain the counts as well. In the end
    one is taken for two where that is what the counts ask for, and companions are taken away
    (`swarmsim.estimation.pairs`).

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
    state = replace(state, sources=fresh)
    first = settled(problem, replace(state, added=signals(problem, state.sources, state.unknowns.lengths)))
    no = jnp.array(False)
    start = _Progress(
        state=first, again=first.sources.present, wide=~no, trial=no, before=first, over=no,
        left=jnp.int32(SEEKS_PER_SOURCE * params.sources_max), divisions=jnp.int32(DIVISIONS), closing=no,
        mixings=jnp.int32(MIXINGS), made=jnp.zeros_like(first.sources.present),
    )  # fmt: skip

    def step(p: _Progress) -> _Progress:
        adding = ~jnp.any(p.again)
        slot = jnp.where(adding, jnp.argmin(p.state.sources.present), jnp.argmax(p.again))
        state, found = _sought(problem, places, allowed, params, p.state, slot, adding, p.wide)
        present = state.sources.present
        mine = jnp.arange(present.shape[0]) == slot
        again = jnp.where(adding & found, present, p.again) & ~mine
        done = ~jnp.any(again) & (found | ~adding)
        wide = p.wide & jnp.any(again) & ~adding
        p = replace(p, state=state, again=again, wide=wide, over=adding & ~found, left=p.left - 1)
        untried = done & ~p.trial & ~p.closing & (jnp.sum(present) >= 2)
        p = _ended_trial(params.further, p, done & p.trial)
        p = _begun_trial(problem, params, p, untried)
        full = (jnp.all(p.state.sources.present) | p.closing) & ~jnp.any(p.again)
        spent = p.left <= 0
        # a trial that found no end has shown nothing
        state = jax.tree.map(partial(jnp.where, spent & p.trial), p.before, p.state)
        p = replace(p, state=state, trial=p.trial & ~spent, over=p.over | full | spent)
        return _joined(problem, _divided(problem, params, p))

    return repeat_while(lambda p: ~p.over, step, start, IN_STEP).state


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
        state, numbers = _with(problem, state, two.slot, two.second), jnp.arange(sources.present.shape[0])
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


def _divisions(p: _Progress, removed: jax.Array) -> jax.Array:
    """How many more there may be: none once one that a division made is ``removed`` [K], for it would come again."""
    return jnp.where(jnp.any(removed & p.made), 0, p.divisions)


def _sought(
    problem: Problem,
    places: Places,
    allowed: jax.Array,
    params: SearchParams,
    state: State,
    slot: jax.Array,
    adding: jax.Array,
    wide: jax.Array,
) -> tuple[State, jax.Array]:
    """The state with a source in ``slot`` sought, a new one or that one again; and whether [] there is one."""
    s = state.sources
    others = without(state, slot).added
    starts, statistic = for_those(
        adding | wide,
        lambda: starts_of(problem, places, allowed, others, state.unknowns),
        lambda: (no_starts(places), jnp.zeros(())),
    )

    def look() -> tuple[State, jax.Array]:
        best, values = _best(problem, starts, allowed, params, state, others, slot, adding, wide)
        ratio = 2.0 * (best.fit.likelihood - state.likelihood)
        # what is sought again stays where it is rather than at a place that explains much less
        least = jnp.where(jnp.any(s.present), params.further, params.threshold)
        found = ratio > jnp.where(adding, least, -HOPELESS * params.further)
        after = _with(problem, state, slot, best)
        table = after.sources.nuclide_value.at[slot].set(values)
        after = replace(after, sources=replace(after.sources, nuclide_value=table))
        return jax.tree.map(partial(jnp.where, found), after, state), found

    worth = ~adding | (statistic > PROMISING * params.threshold)
    return for_those(worth, look, lambda: (state, jnp.array(False)), IN_STEP)


def _best(
    problem: Problem,
    starts: Starts,
    allowed: jax.Array,
    params: SearchParams,
    state: State,
    others: Others,
    slot: jax.Array,
    adding: jax.Array,
    wide: jax.Array,
) -> tuple[Tried, jax.Array]:
    """The best place from some of buildings and of the grid, or from where it is, and each nuclide's value [N]."""
    known = allowed.shape[0]
    size = FITTED * max(PART, -(-known // FITTED))
    naming, closer = BEGINNINGS + 1, BEGINNINGS + len(REACHES)
    again = min(NAMED_AGAIN, params.rounds)
    closing = CLOSING ** jnp.array([*range(1, again + 1), *range(again, params.rounds + 1)])
    reaches = params.reach_m * jnp.concatenate([jnp.ones(BEGINNINGS), jnp.array(REACHES), closing])
    outdoors = INDOORS - jnp.minimum(-(-jnp.sum(starts.there) // size), INDOORS)
    first = jnp.where(adding | wide, outdoors, closer)
    s = state.sources
    yes, no = jnp.ones(size, bool), jnp.zeros(size, bool)
    up_m = 1.5 * problem.height_std_m

    def turn_of(number: jax.Array) -> jax.Array:
        """By how much a round's pattern is turned: rounds of buildings and names draw none."""
        return (number - INDOORS - (number > closer + again)).astype(jnp.float32)

    def begin(best: Tried, number: jax.Array) -> Candidates:
        index = FITTED * jnp.clip(number - INDOORS, 0, BEGINNINGS - INDOORS - 1) + jnp.arange(FITTED)
        centre = jnp.concatenate([starts.point_m[index, :2], jnp.broadcast_to(problem.height_m, (FITTED, 1))], axis=1)
        around = jax.vmap(lambda c: spread(c, AROUND * params.grid_m, up_m, size // FITTED, turn_of(number)))(centre)
        nuclides = jnp.repeat(starts.nuclide[index], size // FITTED)
        # where a source was found before is the first candidate
        known_one = ~adding & (number == INDOORS) & (jnp.arange(size) == 0)
        places = jnp.where(known_one[:, None], s.place[slot], around.reshape(-1, 3))
        nuclides = jnp.where(known_one, s.nuclide[slot], nuclides)
        indoors = number < INDOORS
        first_room = size * jnp.clip(number - outdoors, 0, INDOORS - 1)
        room = jnp.minimum(first_room + jnp.arange(size), starts.there.shape[0] - 1)
        inside = jnp.concatenate([starts.inside_m[room], jnp.broadcast_to(problem.height_m, (size, 1))], axis=1)
        return Candidates(
            place=jnp.where(indoors, inside, places),
            nuclide=jnp.where(indoors, starts.inside_nuclide[room], nuclides),
            allowed=~indoors | starts.there[room],
            sure=known_one,
            apart=~indoors,
        )

    def name(best: Tried, number: jax.Array) -> Candidates:
        everyone = jnp.arange(size, dtype=jnp.int32)
        places = jnp.broadcast_to(best.place, (size, 3))
        asked = jnp.pad(allowed, (0, size - known))
        kinds = jnp.minimum(everyone, known - 1)
        # the nuclide so far is compared with the others in any case
        sure = asked & (everyone == best.nuclide)
        return Candidates(place=places, nuclide=kinds, allowed=asked, sure=sure, apart=no[0])

    def around(best: Tried, number: jax.Array) -> Candidates:
        reach_m, index = reaches[number], jnp.arange(size)
        turn = turn_of(number)
        part = size // FITTED
        near = spread(best.place, reach_m, jnp.minimum(reach_m, up_m), size - part, turn)
        places = jnp.concatenate([near, spread_along(problem, best, reach_m, part, turn)])
        # the best place so far is the first candidate: the tolerance is another now
        sure = (index == 0) | (index == size - part)
        places = jnp.where((index == 0)[:, None], best.place, places)
        return Candidates(
            place=places, nuclide=jnp.full(size, best.nuclide), allowed=yes, sure=sure, apart=yes[0]
        )  # fmt: skip

    def round_(carry: _Rounds) -> _Rounds:
        number, best, table, once = carry
        later = number == closer + again
        named = ((number == naming) & (adding | wide)) | later
        kind = jnp.where(number < BEGINNINGS, 0, jnp.where(named, 1, 2))
        candidates = switch(kind, [partial(kind_, best, number) for kind_ in (begin, name, around)])
        u = best.fit.unknowns
        tolerance = jnp.clip(
            TOLERANT * reaches[number], problem.model_std, jnp.maximum(problem.model_std, MOST_TOLERANT)
        )
        tolerant = replace(problem, model_std=tolerance)
        screen = screen_of(tolerant, others, best.fit.rates, best.nuclide, position_of(problem.site, best.place), u)
        anew = number >= BEGINNINGS
        before = replace(best, fit=replace(best.fit, value=jnp.where(anew, -jnp.inf, best.fit.value)))
        found, values = best_of(tolerant, others, u, screen, candidates, before)
        # the rounds before led to where another nuclide explained most
        back = later & once & (found.nuclide != best.nuclide)
        return jnp.where(back, BEGINNINGS, number + 1), found, jnp.where(named, values[:known], table), once & ~back

    def on(carry: _Rounds) -> jax.Array:
        number, best, *_ = carry
        ratio = 2.0 * (best.fit.likelihood - state.likelihood)
        hopeless = adding & (number >= BEGINNINGS) & (ratio < HOPELESS * params.threshold)
        return (number < reaches.shape[0]) & ~hopeless

    start = (first, as_known(problem, state, slot, adding), jnp.zeros(known), jnp.array(True))
    return repeat_while(on, round_, start)[1:3]


def as_known(problem: Problem, state: State, slot: jax.Array, adding: jax.Array) -> Tried:
    """The source in ``slot`` as the state has it, or none if one is ``adding``; worse than any place that is fitted.

    How its rates change with lengths is not known.
    """
    s, unknown = state.sources, -jnp.asarray(jnp.inf)
    activity = jnp.maximum(s.activity_bq[slot], 1e-3)
    n, regions = problem.background.shape
    shared = 1 + state.unknowns.others.shape[0] + len(problem.detectors) + problem.material_std.shape[0]
    return Tried(
        place=s.place[slot],
        nuclide=s.nuclide[slot],
        fit=Settled(
            value=unknown,
            likelihood=unknown,
            unknowns=replace(state.unknowns, activity_bq=jnp.where(adding, 0.0, activity)),
            covariance=jnp.eye(shared),
            towards=s.towards[slot] + FLAT * jnp.eye(3),
            move=jnp.zeros(3),
            rates=Rates(
                counts=jnp.where(adding, 0.0, state.added.counts[slot] / activity),
                slopes=jnp.zeros((n, problem.material_std.shape[0], regions)),
                edge=jnp.zeros(n),
            ),
        ),
    )


def _with(problem: Problem, state: State, k: jax.Array, best: Tried) -> State:
    """The state with source ``k`` as the fit has it."""
    s, u = state.sources, best.fit.unknowns
    sources = replace(
        s,
        place=s.place.at[k].set(best.place),
        nuclide=s.nuclide.at[k].set(best.nuclide),
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
    return State(sources=sources, added=added, unknowns=shared(u), likelihood=best.fit.likelihood)
