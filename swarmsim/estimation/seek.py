"""One source: a new one beside those that are known, or one of them again, the others held.

Places in buildings and the grid's most promising points (`swarmsim.estimation.starts`) are tried with rays through the
site, then places ever closer to the best one so far; its nuclide is chosen among all that are allowed, twice.
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
from swarmsim.estimation.overload import prominent
from swarmsim.estimation.screen import screen_of
from swarmsim.estimation.search import FITTED, Candidates, Tried, best_of, spread, spread_along
from swarmsim.estimation.starts import STARTS, Places, Starts, no_starts, starts_of
from swarmsim.estimation.state import State, Suspect, nobody, shared, without
from swarmsim.pytree import pytree, static

PART = 12  # candidates in each part of a round, at least
INDOORS = 1  # rounds that try places in buildings, those where the open air's statistic is largest
BEGINNINGS = INDOORS + STARTS // FITTED  # and points of the grid
AROUND = 1.5  # how far around a grid point, over the distance from one to the next
REACHES = (1.5, 1.0)  # of the rounds after those, over `SearchParams.reach_m`; nuclides are compared in the second
CLOSING = 0.55  # reach of a later round over that of the one before
NAMED_AGAIN = 3  # of those rounds, after which nuclides are compared again: from 6 m it is known to a metre then
PROMISING = 0.3  # of the threshold: the open-air statistic that makes a search with rays worth while
HOPELESS = 0.4  # of what a source must reach: given up once the best place after the first starts has less than that
TOLERANT = 0.25  # 1/m: error of the model in a round over its reach, so that wrong places differ by little at first
MOST_TOLERANT = 0.5


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


def sought(
    problem: Problem,
    places: Places,
    allowed: jax.Array,
    params: SearchParams,
    state: State,
    slot: jax.Array,
    adding: jax.Array,
    wide: jax.Array,
    least: jax.Array,
) -> tuple[State, jax.Array, Suspect]:
    """The state with a source in ``slot`` sought, a new one or that one again; and whether [] there is one.

    A new one is if twice the logarithm of its likelihood ratio exceeds ``least`` []. The best there is comes last.
    """
    others = without(state, slot).added
    starts, statistic = for_those(
        adding | wide,
        lambda: starts_of(problem, places, allowed, others, state.unknowns),
        lambda: (no_starts(places), jnp.zeros(())),
    )

    def look() -> tuple[State, jax.Array, Suspect]:
        best, values = _best(problem, starts, allowed, params, state, others, slot, adding, wide)
        ratio = 2.0 * (best.fit.likelihood - state.likelihood)
        # what is sought again stays where it is rather than at a place that explains much less
        found = ratio > jnp.where(adding, least, -HOPELESS * params.further)
        fit = best.fit
        found &= ~adding | prominent(problem, fit.unknowns.activity_bq * fit.rates.counts, others)
        after = with_source(problem, state, slot, best)
        table = after.sources.nuclide_value.at[slot].set(values)
        after = replace(after, sources=replace(after.sources, nuclide_value=table))
        return (
            jax.tree.map(partial(jnp.where, found), after, state),
            found,
            Suspect(ratio=ratio, place=best.place, nuclide=best.nuclide),
        )

    worth = ~adding | (statistic > PROMISING * params.threshold)
    return for_those(worth, look, lambda: (state, jnp.array(False), nobody()), IN_STEP)


def least_of(params: SearchParams, state: State) -> jax.Array:
    """Twice the logarithm of the likelihood ratio [] that a source must reach beside those of ``state``, if any."""
    return jnp.where(jnp.any(state.sources.present), params.further, params.threshold)


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
        """By how much a round's pattern is turned: rounds of buildings and of the second names draw none."""
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
            near=no[0],
            reach_m=reaches[number],
        )

    def name(best: Tried, number: jax.Array) -> Candidates:
        everyone = jnp.arange(size, dtype=jnp.int32)
        places = jnp.broadcast_to(best.place, (size, 3))
        asked = jnp.pad(allowed, (0, size - known))
        kinds = jnp.minimum(everyone, known - 1)
        # the nuclide so far is compared with the others in any case
        sure = asked & (everyone == best.nuclide)
        return Candidates(
            place=places, nuclide=kinds, allowed=asked, sure=sure, apart=no[0], near=no[0], reach_m=reaches[number]
        )  # fmt: skip

    def around(best: Tried, number: jax.Array) -> Candidates:
        reach_m, index = reaches[number], jnp.arange(size)
        turn = turn_of(number)
        part = size // FITTED
        near = spread(best.place, reach_m, jnp.minimum(reach_m, up_m), size - part, turn)
        places = jnp.concatenate([near, spread_along(problem, best, reach_m, part, turn)])
        # the best place so far is the first candidate: the tolerance is another now
        sure = (index == 0) | (index == size - part)
        places = jnp.where((index == 0)[:, None], best.place, places)
        nuclide, near = jnp.full(size, best.nuclide), number >= closer
        return Candidates(
            place=places, nuclide=nuclide, allowed=yes, sure=sure, apart=yes[0], near=near, reach_m=reach_m
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
        hopeless = adding & (number >= BEGINNINGS) & (ratio < HOPELESS * least_of(params, state))
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


def with_source(problem: Problem, state: State, k: jax.Array, best: Tried) -> State:
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
    return replace(state, sources=sources, added=added, unknowns=shared(u), likelihood=best.fit.likelihood)
