"""The sources that an estimate has found so far, and the fit of all of them together."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.device import for_those
from swarmsim.estimation.fit import without_more
from swarmsim.estimation.forward import Problem, rates, variance_of, ways_from
from swarmsim.estimation.normal_equations import Others, Unknowns, nothing_known
from swarmsim.pytree import pytree

ALONE_STEPS = 4  # Gauss-Newton steps without a further source


@pytree
class Sources:
    """Sources found; K places for them."""

    place: jax.Array  # [K, 3] x, y, height above the ground
    nuclide: jax.Array  # [K] int32
    activity_bq: jax.Array  # [K]
    present: jax.Array  # [K] bool
    nuclide_value: jax.Array  # [K, N] logarithm of the posterior of each nuclide at its place
    towards: jax.Array  # [K, 3, 3] information about its place (`Settled.towards`)
    joined_m: jax.Array  # [K] how far off another one of its nuclide was that was taken away; 0: there was none
    beside_m: jax.Array  # [K] root of the second moment of it and such others about their mean, by activity
    beside_bq: jax.Array  # [K] activity of such others that are too far off to be counted with it


@pytree
class Suspect:
    """A further source, the best there is, whether or not it explains enough."""

    ratio: jax.Array  # [] twice the logarithm of the likelihood ratio against the same without it; 0: none was sought
    place: jax.Array  # [3] x, y, height above the ground
    nuclide: jax.Array  # [] int32


@pytree
class State:
    """Sources, and the fit of all of them."""

    sources: Sources
    added: Others  # what they add; nothing for those that are not there
    unknowns: Unknowns  # its own activity is zero: that of the sources stands there
    likelihood: jax.Array  # []
    suspect: Suspect  # that is not taken for a source


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
            joined_m=zero,
            beside_m=zero,
            beside_bq=zero,
        ),
        added=Others(
            counts=jnp.zeros((count, *problem.background.shape)), variance=jnp.zeros((count, len(problem.background)))
        ),
        unknowns=nothing_known(problem, count),
        likelihood=-jnp.asarray(jnp.inf),
        suspect=nobody(),
    )


def nobody() -> Suspect:
    """No further source."""
    return Suspect(ratio=jnp.zeros(()), place=jnp.zeros(3), nuclide=jnp.int32(0))


def signals(problem: Problem, s: Sources, lengths: jax.Array) -> Others:
    """What the sources add; nothing for those that are not there."""

    def one(x: tuple[jax.Array, jax.Array, jax.Array, jax.Array]) -> Others:
        place, nuclide, activity, there = x
        n, regions = problem.background.shape

        def seen() -> Others:
            ways = ways_from(problem, place)
            found = rates(problem, ways, nuclide, lengths, slopes=False)
            return Others(counts=activity * found.counts, variance=variance_of(problem, ways.position_m) + found.edge)

        return for_those(there, seen, lambda: Others(counts=jnp.zeros((n, regions)), variance=jnp.zeros(n)))

    return jax.lax.map(one, (s.place, s.nuclide, s.activity_bq, s.present))


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
    return replace(state, sources=sources, added=added, unknowns=shared(u), likelihood=likelihood)


def shared(u: Unknowns) -> Unknowns:
    """The unknowns with what they say of sources taken over by these."""
    return replace(u, activity_bq=jnp.zeros(()), others=jnp.ones_like(u.others))


def ratios(problem: Problem, state: State) -> jax.Array:
    """Twice the logarithm of the likelihood ratio [K] against the same without each source, the places held.

    The state's own likelihood holds the priors of the height and of the walls of the source that was fitted last: of
    the ratio of another one they would take away what is none of its.
    """
    present = state.sources.present
    number = jnp.arange(present.shape[0])

    def one(k: jax.Array) -> jax.Array:
        counts = jnp.where((number == k)[:, None, None], 0.0, state.added.counts)
        return without_more(problem, replace(state.added, counts=counts), state.unknowns, ALONE_STEPS)[1]

    asked = jnp.append(present, True)  # the last is that of all of them
    every = jnp.arange(len(asked))
    likelihood = jax.lax.map(lambda k: for_those(asked[k], lambda: one(k), lambda: jnp.zeros(())), every)
    return jnp.where(present, 2.0 * (likelihood[-1] - likelihood[:-1]), 0.0)
