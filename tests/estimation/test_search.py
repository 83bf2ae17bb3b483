"""Fits at places where the source is not, and the steps that lead from them to where it is."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim import device
from swarmsim.config.mission import Knowledge
from swarmsim.estimation import screen as screen_module
from swarmsim.estimation import search as search_module
from swarmsim.estimation.fit import settle
from swarmsim.estimation.forward import rates, ways_from, with_one_ray
from swarmsim.estimation.likelihood import position_of
from swarmsim.estimation.localise import localisation_params, problem_of
from swarmsim.estimation.measurements import concatenate
from swarmsim.estimation.screen import Screen, _own, nearby, screen_of, screened, screened_near
from swarmsim.estimation.search import Candidates, Tried, _screened, _screened_all, attempt, spread, spread_along
from swarmsim.estimation.seek import least_of
from swarmsim.estimation.seek import sought as seek
from swarmsim.estimation.state import no_sources, settled, signals
from tests.estimation.survey import (
    NUCLIDES,
    counted,
    drawn,
    mean_rois,
    orbit,
    place,
    presumed,
    spec,
    spectrometer,
    survey,
)

CO_60 = jnp.int32(NUCLIDES.index("Co-60"))
DETECTORS = (spectrometer(),)
FLIGHT = survey(altitude=12.0, count=60, half=40.0, lines=6)
DRIVE = replace(orbit((3.0, 3.0), 5.0, 40), detector=jnp.zeros(40, jnp.int32))
BOTH = concatenate(FLIGHT, DRIVE)
SPANS = ((0, 60, 0, 1), (60, 100, 0, 1))
WALLS = [((0.5, 3.0, 1.5), (0.15, 4.0, 1.5), "concrete"), ((3.0, 6.5, 1.5), (2.5, 0.1, 1.5), "steel")]
FAR_OFF = [((x, -38.0, 0.1), (0.1, 0.1, 0.1), matter) for x, matter in ((-38.0, "concrete"), (38.0, "steel"))]
AT = np.array([3.0, 3.5, 1.0])


def told(boxes, activity=4e8):
    site = place(boxes, half=40.0)
    m = drawn(BOTH, mean_rois(site, DETECTORS, BOTH, [(AT, activity, "Co-60")]), 3)
    return presumed(site, DETECTORS, half=40.0, knowledge=Knowledge(site="geometry")), m


@jax.jit
def _tried(known, m, at):
    problem = problem_of(known, m, SPANS)
    nothing = no_sources(problem, 1, len(NUCLIDES))
    return attempt(problem, CO_60, nothing.added, nothing.unknowns, at)


@jax.jit
def _fitted(known, m, places):
    problem = problem_of(known, m, SPANS)
    nothing = no_sources(problem, 1, len(NUCLIDES))

    def one(at):
        ways, u, others = ways_from(problem, at), nothing.unknowns, nothing.added
        few = attempt(problem, CO_60, others, u, at).fit
        return few.value, settle(problem, ways, CO_60, others, u, 8, 5, fresh=True).value, few.move

    return jax.lax.map(one, places)


@pytest.mark.slow
def test_a_few_steps_come_as_far_as_many_wherever_the_source_is_sought():
    """Places up to 9 m off, where windows are off by factors of ten."""
    known, m = told(WALLS)
    rng = np.random.default_rng(0)
    places = np.concatenate([AT[None], AT + np.column_stack([rng.uniform(-6, 6, (40, 2)), rng.uniform(-0.5, 1, 40)])])
    few, many, _ = (np.asarray(x, np.float64) for x in _fitted(known, m, jnp.float32(places)))
    lost = many[0] - many
    assert lost[1:].min() > 50.0
    assert abs(few[0] - many[0]) < 0.1
    short = np.abs(few - many)[1:] / lost[1:]  # of the value that the wrong place costs
    assert np.median(short) < 0.08
    assert np.quantile(short, 0.9) < 0.35
    assert short.max() < 0.75


def test_a_few_steps_find_walls_half_as_thick_as_presumed():
    """Where the presumed ones let a fiftieth of it through, activity and thickness are far off together."""

    def block(half):
        return place([(tuple(AT), (half, half, half), "concrete"), FAR_OFF[1]], half=40.0)

    m = drawn(BOTH, mean_rois(block(0.25), DETECTORS, BOTH, [(AT, 2e9, "Co-60")]), 3)
    known = presumed(block(0.5), DETECTORS, half=40.0, knowledge=Knowledge(site="geometry"))
    found = _tried(known, m, jnp.float32(AT)).fit.unknowns
    assert float(found.lengths[0]) == pytest.approx(np.log(0.5), abs=0.05)
    assert float(found.activity_bq) == pytest.approx(2e9, rel=0.1)


@pytest.mark.slow
def test_a_step_of_the_place_leads_to_a_source_in_the_open():
    known, m = told([])
    rng = np.random.default_rng(1)
    places = AT + np.column_stack([rng.uniform(-0.6, 0.6, (12, 2)), np.zeros(12)])
    move = np.asarray(_fitted(known, m, jnp.float32(places))[2])
    left = np.linalg.norm((places + move - AT)[:, :2], axis=1)
    assert np.all(left < 0.15)
    assert np.median(left) < 0.06


@pytest.mark.parametrize("reach", [0.05, 2.0])
def test_places_along_the_uncertainty_follow_its_ridge(reach):
    known, m = told([])

    @jax.jit
    def spread(known, m, at):
        problem = problem_of(known, m, SPANS)
        nothing = no_sources(problem, 1, len(NUCLIDES))
        fit = attempt(problem, CO_60, nothing.added, nothing.unknowns, at).fit
        ridge = replace(fit, towards=jnp.diag(jnp.array([1e4, 1.0, 1e4])), move=jnp.array([0.03, -9.0, 0.0]))
        best = Tried(place=at, nuclide=CO_60, fit=ridge)
        return spread_along(problem, best, jnp.float32(reach), 12, jnp.float32(0.0))

    places = np.asarray(spread(known, m, jnp.float32(AT))) - AT
    # where the step leads, within reach
    np.testing.assert_allclose(places[0], [0.03, -reach, 0.0], atol=1e-5)
    across, along = np.abs(places[1:, 0]).max(), np.abs(places[1:, 1]).max()
    assert 0.5 * reach < along < 3.1 * reach
    assert across < 0.05 * along


@pytest.mark.slow
def test_what_is_sought_again_is_named_again():
    """It was named where it was sought at first, which may have been metres off."""
    known, m = told(WALLS)
    params = localisation_params(spec(search_rounds=5, sources_max=1)).search

    @jax.jit
    def sought(known, m):
        problem = problem_of(known, m, SPANS)
        nothing = no_sources(problem, 1, len(NUCLIDES))
        wrong = replace(
            nothing.sources, place=jnp.float32(AT)[None], nuclide=CO_60[None] + 1, present=jnp.array([True])
        )
        wrong = replace(wrong, activity_bq=jnp.array([4e8]))
        state = settled(problem, replace(nothing, sources=wrong, added=signals(problem, wrong, jnp.zeros(2))))
        no, allowed = jnp.array(False), jnp.ones(len(NUCLIDES), bool)
        return seek(problem, known.places, allowed, params, state, jnp.int32(0), no, no, params.further)[0].sources

    after = sought(known, m)
    assert NUCLIDES[int(after.nuclide[0])] == "Co-60"
    assert int(jnp.argmax(after.nuclide_value[0])) == int(CO_60)
    assert np.linalg.norm(np.asarray(after.place[0]) - AT) < 0.2


def test_a_window_s_gain_has_the_spectrum_of_the_nuclide_that_is_asked_for():
    """One with the spectrum of the source of the fit is as that one, also where a detector registers less for more."""
    rng = np.random.default_rng(0)
    registered = np.array([0.9, 0.5, -0.2, 0.0])  # [n] of what is added
    source, others, background, weight = rng.uniform(0.5, 2.0, (4, 5, 4))
    precision = np.array([[100.0] * 4, [4.0] * 4])
    own = np.stack([background, (source + others) * registered])
    inverse = np.linalg.inv(np.einsum("arn,brn,rn->nab", own, own, weight) + [np.diag(p) for p in precision.T])
    screen = Screen(
        nuclide=CO_60, left=weight, weight=weight, own=own, of_others=others * registered,
        inverse=np.moveaxis(inverse, 0, 2), precision=precision, registered=registered,
        there=own, there_own=own, there_inverse=own,
    )  # fmt: skip
    for nuclide in (CO_60, CO_60 + 1):
        mine, back = _own(screen, nuclide, jnp.asarray(3.0 * source * registered))
        np.testing.assert_allclose(mine, own, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(back, screen.inverse, rtol=1e-4, atol=1e-6)
    mine, _ = _own(screen, CO_60 + 1, jnp.asarray(source[::-1] * registered))
    np.testing.assert_allclose(
        mine[1], (source[::-1] * source.sum(0) / source[::-1].sum(0) + others) * registered, rtol=1e-5
    )


def _screen(problem, best):
    nothing, fit = no_sources(problem, 1, len(NUCLIDES)), best.fit
    where = position_of(problem.site, best.place)
    return screen_of(problem, nothing.added, fit.rates, CO_60, where, fit.unknowns)


@jax.jit
def _together_and_alone(known, m, best, places, nuclides, asked):
    problem = problem_of(known, m, SPANS)
    screen = _screen(problem, best)
    alone = jax.lax.map(lambda x: screened(problem, screen, *x), (nuclides, places))
    return _screened(problem, screen, nuclides, places, asked), alone


def test_candidates_have_what_each_has_alone_whether_or_not_they_are_at_one_place():
    known, m = told(WALLS)
    best = _tried(known, m, jnp.float32(AT))
    nuclides, asked = jnp.arange(len(NUCLIDES)), np.arange(len(NUCLIDES)) != 2
    for off in (np.zeros((len(NUCLIDES), 3)), np.random.default_rng(0).normal(size=(len(NUCLIDES), 3))):
        together, alone = _together_and_alone(known, m, best, jnp.float32(AT + 0.3 + off), nuclides, jnp.asarray(asked))
        np.testing.assert_allclose(together[asked], alone[asked], rtol=1e-5)
        assert np.ptp(np.asarray(alone)) > 10.0


@jax.jit
def _by_all_and_by_few(known, m, best):
    tolerant = replace(problem_of(known, m, SPANS), model_std=0.25)
    quick, reach = with_one_ray(tolerant), jnp.float32(1.0)
    screen = _screen(tolerant, best)
    near = nearby(quick, best.fit.rates, best.fit.unknowns.activity_bq, best.place, reach)
    places = spread(best.place, reach, jnp.float32(0.3), 48, jnp.float32(0.0))
    by_all = jax.lax.map(lambda at: screened(quick, screen, CO_60, at), places)
    return by_all, jax.lax.map(lambda at: screened_near(quick, screen, near, at), places), near.rows


def test_few_windows_tell_places_near_one_another_apart_as_all_do(monkeypatch):
    """24 of each 60 and 40; the open air's inverse square holds for the others, and a common factor besides."""
    monkeypatch.setattr(screen_module, "NEARBY", 24)
    for boxes, alike in ((FAR_OFF, 0.99), (WALLS, 0.95)):
        known, m = told(boxes)
        best = _tried(known, m, jnp.float32(AT + np.array([0.6, -0.4, 0.1])))
        found = _by_all_and_by_few(known, m, best)
        by_all, by_few, rows = (np.asarray(x, float) for x in found)
        assert len(set(rows)) == 48
        assert np.ptp(by_all) > 300.0
        assert np.corrcoef(by_all, by_few)[0, 1] > alike
        if boxes is FAR_OFF:
            assert np.std(by_few - by_all) < 0.05 * np.ptp(by_all)
        # of 48, the one to be fitted is one of the best ten
        assert np.sum(by_all > by_all[np.argmax(by_few)]) < 10


@pytest.mark.parametrize("processor", [True, False], ids=["processor", "accelerator"])
def test_candidates_near_the_best_are_screened_by_few_windows_and_all_others_by_all(monkeypatch, processor):
    for module in (screen_module, search_module):
        monkeypatch.setattr(module, "NEARBY", 24)
    for module in (device, search_module):
        monkeypatch.setattr(module, "on_processor", lambda: processor)
    known, m = told(WALLS)

    @jax.jit
    def found(known, m, best):
        problem, at = problem_of(known, m, SPANS), best.place
        quick, screen = with_one_ray(problem), _screen(problem, best)
        places, reach = spread(at, jnp.float32(1.0), jnp.float32(0.3), 8, jnp.float32(0.0)), jnp.float32(1.0)
        near = nearby(quick, best.fit.rates, best.fit.unknowns.activity_bq, at, reach)
        one = Candidates(
            place=places, nuclide=jnp.full(8, CO_60), allowed=jnp.ones(8, bool), sure=jnp.zeros(8, bool),
            apart=jnp.array(True), near=jnp.array(True), reach_m=reach,
        )  # fmt: skip
        both = jax.vmap(lambda yes: _screened_all(quick, screen, replace(one, near=yes), best))(
            jnp.array([True, False])
        )
        by_few = jax.lax.map(lambda at: screened_near(quick, screen, near, at), places)
        return both, by_few, jax.lax.map(lambda at: screened(quick, screen, CO_60, at), places)

    both, by_few, by_all = found(known, m, _tried(known, m, jnp.float32(AT + 0.3)))
    np.testing.assert_allclose(both, [by_few, by_all], rtol=1e-4, atol=1e-2)
    assert np.max(np.abs(np.asarray(by_few - by_all))) > 1.0


@pytest.mark.parametrize(("activity", "far"), [(1e9, 0), (3e11, 24)])
def test_windows_that_an_overloaded_counter_hardly_registers_tell_no_places_apart(monkeypatch, activity, far):
    """Of 40 windows 2 m from a source and 40 windows 20 m from it, the former are deaf if it is strong."""
    monkeypatch.setattr(screen_module, "NEARBY", 24)
    m = concatenate(*(orbit((3.0, 3.5), radius, 40, which=0) for radius in (2.0, 20.0)))
    site = place([], half=40.0)
    m = counted(m, mean_rois(site, DETECTORS, m))

    @jax.jit
    def rows(known, m):
        problem = with_one_ray(problem_of(known, m, ((0, 80, 0, 1),)))
        at = jnp.float32(AT)
        source = rates(problem, ways_from(problem, at), CO_60, jnp.zeros_like(problem.material_std))
        return nearby(problem, source, jnp.float32(activity), at, jnp.float32(1.0)).rows

    assert np.sum(np.asarray(rows(presumed(site, DETECTORS, half=40.0), m)) >= 40) == far


def test_a_further_source_must_explain_more_than_the_first():
    known, m = told([])
    params = localisation_params(spec(sources_max=2)).search
    nothing = no_sources(problem_of(known, m, SPANS), 2, len(NUCLIDES))
    one = replace(nothing, sources=replace(nothing.sources, present=jnp.array([False, True])))
    assert float(least_of(params, nothing)) == float(params.threshold)
    assert float(least_of(params, one)) == float(params.further) > float(params.threshold)
