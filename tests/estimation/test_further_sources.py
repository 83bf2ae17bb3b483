"""Further sources that explain less than is asked of one until others, found between two of them, make way."""

import importlib
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.estimation import localisation_params, sources
from swarmsim.estimation.seek import HOPELESS
from swarmsim.estimation.state import Suspect, no_sources
from tests.estimation.survey import ACTIVITY, NUCLIDES, spec
from tests.estimation.test_pairs import KNOWN, PARAMS, east, state_of

localise = importlib.import_module("swarmsim.estimation.localise")  # the package has the function of that name
ASKED = float(PARAMS.search.further)
MORE = replace(PARAMS.search, sources_max=2)
ALLOWED = jnp.ones(len(NUCLIDES), bool)


def found_by(monkeypatch, ratio, regained):
    """What `find_sources` finds where a second source has so much of what is asked, and the first has more beside it.

    And what was sought: whether a new one, and whether from everywhere.
    """
    problem, _ = state_of([(east(0.0), ACTIVITY)])
    nothing = replace(no_sources(problem, 2, len(NUCLIDES)), likelihood=jnp.zeros(()))
    calls = []

    def sought(problem, places, allowed, params, state, slot, adding, wide, least):
        before = int(jnp.sum(state.sources.present))
        moved = ("first", True) in calls
        calls.append(("new", bool(wide)) if adding else (("first", "second")[int(slot)], bool(wide)))
        gain = 500.0 if adding and not before else ratio * ASKED if adding else 0.0
        if not adding and before == 2 and int(slot) == 0 and not moved:
            gain = regained * ASKED
        gain = jnp.float32(gain)
        found = gain > least if adding else jnp.array(True)
        after = replace(state, likelihood=state.likelihood + 0.5 * gain)
        after = replace(after, sources=replace(state.sources, present=state.sources.present.at[slot].set(True)))
        return (
            jax.tree.map(lambda a, b: jnp.where(found, a, b), after, state),
            found,
            Suspect(ratio=gain, place=jnp.full(3, 7.0), nuclide=jnp.int32(1)),
        )

    def ratios(problem, state):
        """Nothing can be done without."""
        return jnp.full(2, 1e6) * state.sources.present

    monkeypatch.setattr(sources, "sought", sought)
    monkeypatch.setattr(sources, "settled", lambda problem, state: state)
    monkeypatch.setattr(sources, "signals", lambda problem, s, lengths: nothing.added)
    monkeypatch.setattr(sources, "ratios", ratios)
    monkeypatch.setattr(sources, "strain", lambda *_: (jnp.zeros(()), jnp.zeros(())))
    monkeypatch.setattr(sources, "joined", lambda problem, state: (state, jnp.array(False)))
    with jax.disable_jit():
        state = sources.find_sources(problem, KNOWN.places, ALLOWED, MORE, nothing)
    return state, calls


def test_one_that_explains_enough_once_others_have_made_way_is_one(monkeypatch):
    state, calls = found_by(monkeypatch, 0.6, 0.5)
    assert int(jnp.sum(state.sources.present)) == 2
    # both are sought from everywhere, and then no third one: there is room for two
    assert calls == [("new", True), ("new", False), ("first", True), ("second", True)]
    assert float(state.suspect.ratio) == 0.0


def test_one_that_explains_too_little_still_is_none_but_suspected(monkeypatch):
    state, calls = found_by(monkeypatch, 0.6, 0.3)
    assert int(jnp.sum(state.sources.present)) == 1
    assert float(state.likelihood) == 250.0  # as before it
    assert calls[2:] == [("first", True), ("second", True)]
    np.testing.assert_allclose(state.suspect.ratio, 0.9 * ASKED, rtol=1e-5)


@pytest.mark.parametrize("ratio", [0.9 * HOPELESS, 0.0])
def test_one_that_explains_next_to_nothing_is_not_tried(monkeypatch, ratio):
    state, calls = found_by(monkeypatch, ratio, 5.0)
    assert calls == [("new", True), ("new", False)]
    np.testing.assert_allclose(state.suspect.ratio, ratio * ASKED, rtol=1e-5)
    np.testing.assert_allclose(state.suspect.place, 7.0)
    assert int(state.suspect.nuclide) == 1


def test_one_that_explains_enough_at_once_is_sought_again_after_the_others(monkeypatch):
    state, calls = found_by(monkeypatch, 1.1, 0.0)
    assert int(jnp.sum(state.sources.present)) == 2
    assert calls == [("new", True), ("new", False), ("first", False), ("second", False)]


@pytest.mark.parametrize(
    ("gain", "several", "turns"), [(1.1 * HOPELESS, True, 2), (1.1 * HOPELESS, False, 1), (0.9 * HOPELESS, True, 1)]
)
def test_what_sampling_moved_far_is_sought_again_beside_others(monkeypatch, gain, several, turns):
    problem, state = state_of([(east(0.0), ACTIVITY), (east(30.0), ACTIVITY)][: 1 + several])
    sampled = jax.eval_shape(lambda: localise.posteriors(problem, state, 1, 8))
    sampled = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), sampled)
    sought = []

    def posteriors(problem, found, rounds, samples):
        return replace(sampled, state=replace(found, likelihood=found.likelihood + 0.5 * gain * ASKED))

    def find_sources(problem, places, allowed, params, state):
        sought.append(float(state.likelihood))
        return state

    monkeypatch.setattr(localise, "posteriors", posteriors)
    monkeypatch.setattr(localise, "find_sources", find_sources)
    with jax.disable_jit():
        localise._found(KNOWN, problem, localisation_params(spec()), state)
    assert len(sought) == turns
    # from where sampling had moved it
    np.testing.assert_allclose(np.diff(sought), [0.5 * gain * ASKED] * (turns - 1), rtol=0.01)
