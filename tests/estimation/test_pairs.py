"""Sources beside one another: one that is rather two, two that are rather one, two nuclides, and what is not known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.estimation import localisation_params, pairs, seek, sources
from swarmsim.estimation.likelihood import position_of
from swarmsim.estimation.localise import problem_of
from swarmsim.estimation.pairs import are_mixed, divided, joined, strain
from swarmsim.estimation.posterior import of_others
from swarmsim.estimation.screen import looked_at, screen_of
from swarmsim.estimation.seek import as_known
from swarmsim.estimation.state import no_sources, settled, signals, without
from tests.estimation.conftest import BOTH, DETECTORS, SPANS
from tests.estimation.survey import ACTIVITY, NUCLIDES, SOURCE, drawn, mean_rois, place, presumed, spec

SITE = place()
KNOWN, PARAMS = presumed(SITE, DETECTORS), localisation_params(spec())
CERTAIN = replace(KNOWN, background_std=jnp.float32(0.01), model_std=jnp.float32(0.001), height_std_m=jnp.float32(0.05))
AT = np.array([*SOURCE[:2], 1.0])
# compiled once for all tests: what runs piece by piece is compiled anew for each call
DIVIDED, JOINED, STRAIN, OF_OTHERS = jax.jit(divided), jax.jit(joined), jax.jit(strain), jax.jit(of_others)
PROBLEM, SCREEN, ARE_MIXED = jax.jit(problem_of, static_argnums=2), jax.jit(screen_of), jax.jit(are_mixed)
AS_TWO, ALONG = jax.jit(pairs._as_two), jax.jit(pairs._along)


def state_of(truth, given=None, known=KNOWN, seed=None, nuclides=None):
    """The problem of the counts of ``truth``, and a state with the sources ``given``: (place, activity) each.

    They are of Co-60, unless the third of a source's values is another name; those given are of ``nuclides``.
    """
    mean = mean_rois(SITE, DETECTORS, BOTH, [(*one, "Co-60")[:3] for one in truth])
    problem = PROBLEM(known, drawn(BOTH, mean, seed) if seed is not None else replace(BOTH, rois=mean), SPANS)
    if known is CERTAIN:
        problem = replace(problem, pose_std_m=jnp.zeros_like(problem.pose_std_m))
    given = truth if given is None else given
    places, activities = (jnp.array(x, jnp.float32) for x in zip(*given, strict=True))
    return problem, with_sources(problem, places, activities, jnp.array(nuclides or [0] * len(given)))


@jax.jit
def with_sources(problem, places, activities, nuclides):
    """The state with sources there, all else fitted."""
    nothing = no_sources(problem, len(places), len(NUCLIDES))
    found = replace(
        nothing.sources,
        present=jnp.ones(len(places), bool),
        nuclide=nuclides,
        place=places,
        activity_bq=activities,
    )
    added = signals(problem, found, nothing.unknowns.lengths)
    return settled(problem, replace(nothing, sources=found, added=added))


def east(metres):
    return AT + np.array([metres, 0.0, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("apart", "nuclides", "one"),
    [(2.0, (0, 0), True), (7.0, (0, 0), True), (20.0, (0, 0), False), (2.0, (0, 1), False)],
)
def test_companions_of_a_nuclide_are_told_as_one(apart, nuclides, one):
    """The counts are those of one source: the weaker is taken away, but not where it is another, or far off."""
    problem, state = state_of(
        [(AT, ACTIVITY)], [(east(apart), 0.02 * ACTIVITY), (AT, ACTIVITY)], seed=3, nuclides=list(nuclides)
    )
    after, some = JOINED(problem, state)
    assert after.sources.present.tolist() == [not one, True]
    assert bool(some) == one
    share = float(state.sources.activity_bq[0] / jnp.sum(state.sources.activity_bq))
    told = [apart, apart * np.sqrt(share * (1.0 - share))] if one else [0.0, 0.0]
    np.testing.assert_allclose(after.sources.joined_m, [0.0, told[0]], rtol=1e-4)
    np.testing.assert_allclose(after.sources.beside_m, [0.0, told[1]], rtol=1e-3)
    assert float(jnp.max(jnp.abs(after.added.counts[0]))) == 0.0 or not one
    told_bq = float(state.sources.activity_bq[0]) if one and apart > 3.0 else 0.0
    np.testing.assert_allclose(after.sources.beside_bq, [0.0, told_bq], rtol=1e-6)


def joined_by(monkeypatch, places_m, activities, ratios):
    """What `joined` makes of sources on a line with such likelihood ratios."""
    monkeypatch.setattr(
        pairs, "ratios", lambda problem, state: jnp.where(state.sources.present, jnp.array(ratios), 0.0)
    )
    problem, state = state_of([(east(x), a) for x, a in zip(places_m, activities, strict=True)])
    after, some = joined(problem, state)
    assert bool(some) == (not bool(jnp.all(after.sources.present)))
    return after.sources


def test_of_two_that_stand_for_one_another_one_stays():
    """A source 9 m from a stronger one, that is told as two 0.4 m apart: neither of these is missed by itself."""
    truth = [(AT, 248e6), (east(9.0), 351e6)]
    problem, state = state_of(truth, [(AT, 248e6), (east(9.0), 188e6), (east(9.4), 163e6)])
    after = JOINED(problem, state)[0].sources
    assert int(jnp.sum(after.present)) == 2
    assert bool(after.present[0])
    second = int(jnp.argmax(after.present[1:])) + 1
    assert float(after.joined_m[second]) == pytest.approx(0.4, rel=1e-3)
    assert float(after.joined_m[0]) == 0.0
    assert float(after.activity_bq[second]) == pytest.approx(351e6, rel=0.1)


def test_what_a_companion_stands_for_goes_with_it(monkeypatch):
    after = joined_by(monkeypatch, [0.0, 10.0, 20.0], [300e6, 50e6, 5e6], [9000.0, 900.0, 90.0])
    assert after.present.tolist() == [True, False, False]
    assert float(after.joined_m[0]) == pytest.approx(20.0, rel=1e-4)
    # what explains much is taken away by none
    after = joined_by(monkeypatch, [0.0, 10.0, 20.0], [300e6, 50e6, 5e6], [9000.0, 8000.0, 90.0])
    assert after.present.tolist() == [True, True, False]
    assert after.joined_m.tolist() == pytest.approx([0.0, 10.0, 0.0], rel=1e-4)


def test_the_one_that_explains_less_is_taken_away_whatever_its_activity(monkeypatch):
    after = joined_by(monkeypatch, [0.0, 2.0], [100e6, 400e6], [9000.0, 70.0])
    assert after.present.tolist() == [True, False]
    after = joined_by(monkeypatch, [0.0, 2.0], [100e6, 100e6], [500.0, 500.0])
    assert int(jnp.sum(after.present)) == 1


@pytest.mark.slow
def test_a_source_is_divided_where_two_others_beside_one_another_are_right():
    """Strain comes from the third, that is two 4 m apart: it is divided, and not the pair placed anew."""
    pair = [(np.array([-35.0, -30.0, 1.0]), 300e6), (np.array([-35.0, -20.0, 1.0]), 300e6)]
    halves = [(east(-2.0), 170e6), (east(2.0), 170e6)]
    problem, state = state_of([*pair, *halves], [*pair, (AT, 340e6)], seed=2)
    sources_ = jax.tree.map(lambda x: jnp.concatenate([x, jnp.zeros_like(x[:1])]), state.sources)
    others = replace(state.unknowns, others=jnp.ones(4))
    added = jax.tree.map(lambda x: jnp.concatenate([x, jnp.zeros_like(x[:1])]), state.added)
    state = replace(state, sources=sources_, unknowns=others, added=added)
    two, with_first, ratio = DIVIDED(problem, state, jnp.array(False))
    assert int(two.number) == 2
    assert int(two.slot) == 3
    assert float(ratio) > float(PARAMS.search.further)
    found = np.sort([float(with_first.sources.place[2, 0]), float(two.second.place[0])])
    np.testing.assert_allclose(found, SOURCE[0] + np.array([-2.0, 2.0]), atol=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("apart", "off"), [(0.0, (4.0, 4.3)), (0.0, (-3.0, 2.0)), (2.0, (4.0, 4.0)), (5.0, (-1.5, 8.0))]
)
def test_two_nuclides_beside_one_another_are_sought_together(apart, off):
    """From where the survey had them: each by itself follows the other, wherever that is."""
    truth = [(AT, 150e6), (east(apart), 200e6, "Cs-137")]
    problem, state = state_of(truth, [(east(off[0]), 150e6), (east(off[1]), 200e6)], nuclides=[0, 1], seed=4)
    assert bool(ARE_MIXED(state.sources))
    two, with_first, ratio = DIVIDED(problem, state, jnp.array(True))
    assert float(ratio) > float(PARAMS.search.further)
    first, slot = int(two.number), int(two.slot)
    assert {first, slot} == {0, 1}
    assert int(two.second.nuclide) == slot  # each keeps its nuclide
    found = np.zeros((2, 2))
    found[first], found[slot] = with_first.sources.place[first, :2], two.second.place[:2]
    np.testing.assert_allclose(found, [AT[:2], east(apart)[:2]], atol=0.3)


@pytest.mark.parametrize("nuclides", [(0, 0), (0, 1)])
def test_a_step_of_both_leads_from_beside_two_sources_to_them(nuclides):
    """The counts are those expected: of two 6 m apart, both misplaced at right angles to one another."""
    names = ["Co-60", "Cs-137"]
    at = np.array([AT, east(6.0)])
    truth = [(at[k], 200e6, names[kind]) for k, kind in enumerate(nuclides)]
    off = np.array([[0.3, -0.1, 0.0], [0.1, 0.3, 0.0]])
    given = [(place, 200e6) for place in at + off]
    problem, state = state_of(truth, given, CERTAIN, nuclides=list(nuclides))
    two = AS_TWO(
        problem, without(state, jnp.int32(1)), jnp.int32(0), jnp.int32(1), jnp.float32(1.0), jnp.int32(nuclides[1]),
        jnp.asarray([[0.0, 0.0, 0.0], given[1][0] - given[0][0]], jnp.float32),
    )  # fmt: skip
    changes = np.asarray(ALONG(problem, without(state, jnp.int32(1)), two, jnp.float32(2.0)))
    left = np.linalg.norm((at + off + changes[0] - at)[:, :2], axis=1)
    assert (left < 0.25 * np.linalg.norm(off, axis=1)).all()
    # and those that are drawn spread about it
    assert np.ptp(changes[5:, 0, :2], axis=0).min() > 0.01


@pytest.mark.slow
def test_a_height_that_is_known_is_not_left_for_two_nuclides():
    known = replace(KNOWN, height_m=jnp.float32(1.0), height_std_m=jnp.float32(0.05))
    truth = [(AT, 150e6), (AT, 200e6, "Cs-137")]
    problem, state = state_of(truth, [(east(4.0), 150e6), (east(4.3), 200e6)], known, 4, [0, 1])
    two, _, ratio = DIVIDED(problem, state, jnp.array(True))
    heights = np.array([two.place[2], two.second.place[2]])
    np.testing.assert_allclose(heights, 1.0, atol=0.1)
    assert float(ratio) > float(PARAMS.search.further)
    before = state.sources.place[two.number]
    np.testing.assert_allclose(before + two.offset_m, [two.place, two.second.place], atol=1e-4)


@pytest.mark.slow
def test_two_nuclides_in_one_place_are_found_in_it(localiser):
    """The survey has them metres apart, and the first that is sought by all counts goes to the other."""
    counts = drawn(BOTH, mean_rois(SITE, DETECTORS, BOTH, [(AT, 150e6, "Co-60"), (AT, 250e6, "Cs-137")]), 2)
    aerial = localiser(replace(counts, valid=counts.valid & (counts.detector == 0)))
    fits = localiser(counts, known=aerial.state).fits
    assert int(jnp.sum(fits.present)) == 2
    assert {NUCLIDES[int(n)] for n in fits.nuclide[:2]} == {"Co-60", "Cs-137"}
    np.testing.assert_allclose(fits.position_m[:2, :2], [AT[:2]] * 2, atol=0.3)


@pytest.mark.parametrize(
    ("mixed", "ratio", "left", "better"),
    [(True, 500.0, 0.1, True), (True, 500.0, 0.9, False), (True, 5.0, 0.1, False), (False, 500.0, 0.9, True)],
)
def test_two_nuclides_are_placed_together_if_that_is_what_was_wrong(monkeypatch, mixed, ratio, left, better):
    """Where another source is missing two wrong ones take up a little of it: the strain hardly falls."""
    problem, state = state_of([(AT, ACTIVITY), (east(4.0), ACTIVITY)], nuclides=[0, 1 if mixed else 0])
    moved = replace(state, sources=replace(state.sources, place=state.sources.place + 1.0))
    tried = as_known(problem, moved, jnp.int32(1), jnp.array(False))
    two = pairs.Two(
        number=jnp.int32(0), slot=jnp.int32(1), offset_m=jnp.zeros((2, 3)), place=moved.sources.place[0],
        first=state.added, second=tried, value=jnp.float32(0.0),
    )  # fmt: skip
    monkeypatch.setattr(sources, "divided", lambda *_: (two, moved, jnp.float32(ratio)))
    strains = iter([1000.0, 1000.0 * left])
    monkeypatch.setattr(sources, "strain", lambda *_: (jnp.float32(next(strains)), jnp.float32(0.0)))
    no = jnp.array(False)
    p = sources._Progress(
        state=state, again=jnp.zeros(2, bool), wide=no, trial=no, before=state, over=jnp.array(not mixed),
        left=jnp.int32(9), divisions=jnp.int32(3), mixings=jnp.int32(2), made=jnp.ones(2, bool), closing=no,
        advanced=no, advances=jnp.int32(0),
    )  # fmt: skip
    with jax.disable_jit():
        after = sources._divided(problem, PARAMS.search, p)
    assert bool(jnp.all(after.again)) == better
    place = (moved if better else state).sources.place
    np.testing.assert_allclose(after.state.sources.place[0], place[0], rtol=1e-6)
    assert int(after.mixings) == 2 - mixed
    assert int(after.divisions) == 3 - (not mixed)
    # a division that is refuted later is not one that was placed together since
    assert bool(jnp.all(after.made)) == (not (mixed and better))


def test_mixed_are_two_of_different_nuclides_beside_one_another():
    for apart, nuclides, mixed in ((4.0, [0, 1], True), (4.0, [1, 1], False), (14.0, [0, 1], False)):
        _, state = state_of([(AT, ACTIVITY), (east(apart), ACTIVITY)], nuclides=nuclides)
        assert bool(ARE_MIXED(state.sources)) == mixed
        assert not bool(ARE_MIXED(without(state, jnp.int32(0)).sources))


def test_one_source_strains_nothing_and_two_taken_for_one_do():
    strains, usuals = [], []
    for apart in (0.0, 4.0):
        truth = [(east(x), 0.5 * ACTIVITY) for x in (-0.5 * apart, 0.5 * apart)]
        found, usual = STRAIN(*state_of(truth, [(AT, ACTIVITY)], seed=5))
        strains.append(float(found))
        usuals.append(float(usual))
    assert strains[0] < 30.0
    assert strains[1] > 2.0 * float(PARAMS.search.further)
    # errors from the prior have 1.40 for each window whose rate is known well: the rover's 60 are half known
    assert all(0.4 * 1.40 * 60 < usual < 1.41 * 90 for usual in usuals)
    # of no source no window tells
    assert float(STRAIN(*state_of([(AT, 1.0)]))[1]) < 0.1


def columns_of(truth):
    """Means [n, R] of the counts, and their derivatives [4 K, n, R] by place and log activity of each source."""
    theta = np.array([[*at, np.log(activity)] for at, activity in truth])

    def means(theta):
        return np.asarray(mean_rois(SITE, DETECTORS, BOTH, [(t[:3], np.exp(t[3]), "Co-60") for t in theta]), float)

    slopes = []
    for k in range(len(truth)):
        for axis, step in enumerate((0.2, 0.2, 0.2, 0.02)):
            change = np.zeros_like(theta)
            change[k, axis] = step
            slopes.append((means(theta + change) - means(theta - change)) / (2.0 * step))
    return means(theta), np.array(slopes)


@pytest.mark.parametrize("apart", [4.0, 9.0])
def test_what_others_places_add_is_that_of_the_information_about_all(apart):
    """Fisher information by central differences, where only sources and the levels of the background are unknown."""
    truth = [(east(0.0), 200e6), (east(apart), 150e6)]
    problem, state = state_of(truth, known=CERTAIN)
    mean, slopes = columns_of(truth)
    levels = [np.asarray(problem.background) * (np.asarray(BOTH.detector) == d)[:, None] for d in range(2)]
    slopes = np.concatenate([slopes, levels])
    weight = np.asarray(problem.trust) / np.maximum(mean, 1e-9)
    information = np.einsum("anr,bnr,nr->ab", slopes, slopes, weight)
    own, across = information[:8, :8], information[:8, 8:]
    information = float(problem.learning_rate) * (own - across @ np.linalg.solve(information[8:, 8:], across.T))
    information += np.diag(np.tile([1e-6, 1e-6, 1.0 / float(problem.height_std_m) ** 2, 1e-6], 2))
    every = np.linalg.inv(information)
    added = np.asarray(OF_OTHERS(problem, state))
    for k, own in enumerate((slice(0, 4), slice(4, 8))):
        free = [i for i in range(8) if own.start <= i < own.stop or i % 4 == 3]
        held = np.linalg.inv(information[np.ix_(free, free)])
        here = [free.index(i) for i in range(own.start, own.stop)]
        expected = (every[own, own] - held[np.ix_(here, here)])[[0, 1, 3], [0, 1, 3]]
        np.testing.assert_allclose(added[k][[0, 1, 3], [0, 1, 3]], expected, rtol=0.25, atol=0.05 * expected.max())


def test_nothing_is_added_where_others_are_far_off():
    problem, state = state_of([(AT, 200e6), (AT - [45.0, 30.0, 0.0], 200e6)])
    assert float(jnp.max(jnp.abs(OF_OTHERS(problem, state)))) == 0.0


@pytest.mark.parametrize("apart", [3.0, 8.0, 12.0])
def test_what_is_known_of_another_source_beside_one_is_the_information_about_both(apart):
    problem, state = state_of([(AT, 200e6)], known=CERTAIN)
    slopes = columns_of([(AT, 200e6), (east(apart), 4e6)])[1]
    mean = np.asarray(mean_rois(SITE, DETECTORS, BOTH, [(AT, 200e6, "Co-60")]), float)
    weight = np.asarray(problem.trust) / np.maximum(mean, 1e-9)
    columns = np.concatenate([slopes[:4], slopes[7:] / 4e6])  # place and log activity of the one, activity of the other
    information = np.einsum("anr,bnr,nr->ab", columns, columns, weight)
    information[2, 2] += 1.0 / float(problem.height_std_m) ** 2
    expected = information[4, 4] - information[4, :4] @ np.linalg.solve(information[:4, :4], information[:4, 4])
    rest = without(state, jnp.int32(0)).added
    best = as_known(problem, state, jnp.int32(0), jnp.array(False)).fit
    screen = SCREEN(problem, rest, best.rates, jnp.int32(0), position_of(SITE, state.sources.place[0]), best.unknowns)
    found = looked_at(problem, screen, jnp.int32(0), jnp.asarray(east(apart), jnp.float32))[1]
    assert float(found) == pytest.approx(expected, rel=0.05)


def test_what_is_sought_again_does_not_go_where_it_explains_less(monkeypatch):
    problem, state = state_of([(AT, ACTIVITY)], seed=1)
    no, allowed = jnp.array(False), jnp.ones(len(NUCLIDES), bool)
    for loss, stays in ((100.0, True), (-1.0, False)):
        tried = as_known(problem, state, jnp.int32(0), no)
        fit = replace(tried.fit, likelihood=state.likelihood - loss)
        elsewhere = replace(tried, place=tried.place + 3.0, fit=fit)
        monkeypatch.setattr(seek, "_best", lambda *_, found=elsewhere: (found, jnp.zeros(len(NUCLIDES))))
        after, _, _ = seek.sought(
            problem, KNOWN.places, allowed, PARAMS.search, state, jnp.int32(0), no, no, PARAMS.search.further
        )
        assert bool(jnp.allclose(after.sources.place[0], tried.place)) == stays


def test_what_a_division_made_and_a_trial_refuted_is_not_made_again():
    _, two = state_of([(AT, ACTIVITY), (east(4.0), ACTIVITY)])
    one = without(two, jnp.int32(1))
    begun = sources._Progress(
        state=one, again=jnp.zeros(2, bool), wide=jnp.array(False), trial=jnp.array(True), before=two,
        over=jnp.array(False), left=jnp.int32(9), divisions=jnp.int32(3), made=jnp.ones(2, bool),
        mixings=jnp.int32(0), closing=jnp.array(False), advanced=jnp.array(False), advances=jnp.int32(0),
    )  # fmt: skip
    least, now = PARAMS.search.further, jnp.array(True)
    assert int(sources._ended_trial(least, begun, now).divisions) == 0
    # where the trial shows that it is needed, or another one was left out, there may be more
    needed = replace(begun, before=replace(two, likelihood=two.likelihood + 1000.0))
    assert int(sources._ended_trial(least, needed, now).divisions) == 3
    elsewhere = replace(begun, made=jnp.array([True, False]))
    assert int(sources._ended_trial(least, elsewhere, now).divisions) == 3
