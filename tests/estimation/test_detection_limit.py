"""How strong a source would have had to be to be noticed."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from swarmsim.device import some_at_a_time
from swarmsim.estimation.detection_limit import MOST, limits, noticed, ratio
from swarmsim.estimation.forward import variance_of
from swarmsim.estimation.localise import localisation_params, problem_of
from swarmsim.estimation.overload import overloaded
from swarmsim.estimation.scan import open_counts, open_totals, scan
from swarmsim.estimation.search import attempt
from swarmsim.estimation.state import no_sources, settled
from tests.estimation.survey import NUCLIDES, counted, mean_rois, place, presumed, spec, spectrometer, survey

CO_60 = NUCLIDES.index("Co-60")
DETECTORS = (spectrometer(),)
FLIGHT = survey(altitude=12.0, count=60, half=40.0, lines=6)
SPANS = ((0, 60, 0, 1),)
SITE = place(half=40.0)
KNOWN = presumed(SITE, DETECTORS, half=40.0)
SEARCH = localisation_params(spec()).search
ASKED = jnp.asarray(SEARCH.threshold)
BACKGROUND = np.asarray(mean_rois(SITE, DETECTORS, FLIGHT))
ALL = jnp.ones(len(NUCLIDES), bool)


def _nothing(rois, known=KNOWN, flight=FLIGHT):
    problem = problem_of(known, counted(flight, rois), SPANS)
    return problem, settled(problem, no_sources(problem, 1, len(NUCLIDES)))


def _limits(problem, state, point):
    points = jnp.broadcast_to(point, (len(NUCLIDES), 3))
    faint = scan(problem, points[:1], ALL, state.added, state.unknowns).information[0]
    return limits(problem, state, points, ASKED, faint)


def _ratio(problem, state, point, nuclide=CO_60):
    """Twice the logarithm of the likelihood ratio that a search would find at the place of the source."""
    fit = attempt(problem, jnp.int32(nuclide), state.added, state.unknowns, point.at[2].set(1.0)).fit
    return 2.0 * (fit.likelihood - state.likelihood)


@cache
def _counter(model):
    """What a survey with such a counter knows and expects, and the limit and the ratio of a place by its counts."""
    detectors = (spectrometer(model),)
    known = presumed(SITE, detectors, half=40.0)

    def limit_of(rois, point):
        problem, state = _nothing(rois, known)
        return _limits(problem, state, point)[CO_60]

    def ratio_of(rois, point):
        problem, state = _nothing(rois, known)
        return _ratio(problem, state, point)

    def all_of(function):
        return jax.jit(lambda rois, point: jax.lax.map(lambda one: function(one, point), rois))

    return detectors, known, np.asarray(mean_rois(SITE, detectors, FLIGHT)), all_of(limit_of), all_of(ratio_of)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["nai_1p5x1p5", "geiger_sbm20"])
@pytest.mark.parametrize("at", [(10.0, 4.0, 1.0), (-33.0, 28.0, 1.0), (39.0, -39.0, 1.0)])
def test_a_source_at_its_detection_limit_is_noticed_nineteen_times_of_twenty(at, model):
    """A counter of one energy window cannot tell a strong source from its background by the spectrum."""
    point = jnp.array(at)
    detectors, known, silent, limits_of, ratios_of = _counter(model)
    per_bq = (np.asarray(mean_rois(SITE, detectors, FLIGHT, [(at, 1e6, "Co-60")])) - silent) / 1e6
    rng = np.random.default_rng(0)
    background = silent * np.exp(float(known.background_std) * rng.standard_normal((300, 60, 1)))
    drawn = jnp.float32(rng.poisson(background))
    activity = np.asarray(limits_of(drawn, point))
    added = jnp.float32(rng.poisson(np.maximum(activity[:, None, None] * per_bq, 0.0)))
    ratio = np.asarray(ratios_of(drawn + added, point))
    assert 0.87 < np.mean(ratio > ASKED) < 0.995


def test_a_source_at_its_limit_has_the_ratio_that_is_asked_and_its_chance():
    @jax.jit
    def reached(rois):
        problem, state = _nothing(rois)
        point = jnp.array([10.0, 4.0, 1.0])

        def of(activity, nuclide):
            signal = activity * open_counts(problem, point, nuclide)
            return ratio(problem, state, signal, variance_of(problem, point))

        return jax.vmap(of)(_limits(problem, state, point), jnp.arange(len(NUCLIDES)))

    root = np.sqrt(np.asarray(reached(BACKGROUND)))
    np.testing.assert_allclose(root, np.sqrt(float(ASKED)) + norm.ppf(0.95), rtol=5e-3)


def test_most_places_reach_the_limit_that_is_told():
    @jax.jit
    def told(rois, allowed):
        problem, state = _nothing(rois)
        every = scan(problem, KNOWN.places.points_m, allowed, state.added, state.unknowns).information[:, CO_60]
        return noticed(problem, KNOWN.places, allowed, SEARCH, state)[0], every

    (whole, every), (one, _) = told(BACKGROUND, ALL), told(BACKGROUND, jnp.arange(len(NUCLIDES)) == CO_60)
    # a faint source would be noticed there from so many standard deviations on
    faint = (np.sqrt(float(ASKED)) + norm.ppf(0.95)) / np.sqrt(np.asarray(every))
    assert np.mean(faint < whole[CO_60]) > MOST - 0.01
    assert np.isfinite(whole).all()
    assert one[CO_60] == pytest.approx(float(whole[CO_60]), rel=1e-4)
    assert np.isinf(np.delete(np.asarray(one), CO_60)).all()


@pytest.mark.slow
@pytest.mark.parametrize(("measured", "least", "most"), [(60, 1.0, 1.0), (30, 1.5, np.inf), (0, np.inf, np.inf)])
def test_the_fewer_places_were_measured_the_higher_is_the_limit(measured, least, most):
    @jax.jit
    def told(valid):
        m = replace(counted(FLIGHT, BACKGROUND), valid=valid)
        problem = problem_of(KNOWN, m, SPANS)
        state = settled(problem, no_sources(problem, 1, len(NUCLIDES)))
        return noticed(problem, KNOWN.places, ALL, SEARCH, state)[0]

    whole, part = (np.asarray(told(jnp.arange(60) < count)) for count in (60, measured))
    assert np.isfinite(whole).all()
    assert np.all(part >= 0.999 * least * whole)
    assert np.all(part <= 1.001 * most * whole)


@pytest.mark.slow
def test_an_accelerator_tells_the_same_limits_of_many_missions(monkeypatch):
    def told(rois):
        problem, state = _nothing(rois)
        return some_at_a_time(lambda: noticed(problem, KNOWN.places, ALL, SEARCH, state)[0])

    rng = np.random.default_rng(1)
    drawn = jnp.float32(rng.poisson(BACKGROUND * rng.uniform(0.5, 2.0, (3, 1, 1))))
    one_by_one = np.asarray(jax.lax.map(told, drawn))
    monkeypatch.setattr("swarmsim.device.on_processor", lambda: False)
    together = jax.jit(jax.vmap(told))(drawn)
    np.testing.assert_allclose(together, one_by_one, rtol=1e-3)
    assert np.ptp(one_by_one[:, CO_60]) > 0.1 * one_by_one[:, CO_60].mean()


def test_a_source_of_another_nuclide_than_those_in_question_shows():
    only = jnp.arange(len(NUCLIDES)) == NUCLIDES.index("I-131")

    @jax.jit
    def excluded(rois, allowed):
        problem, state = _nothing(rois)
        return noticed(problem, KNOWN.places, allowed, SEARCH, state)[1]

    rng = np.random.default_rng(3)
    there = mean_rois(SITE, DETECTORS, FLIGHT, [((10.0, 4.0, 1.0), 3e8, "Co-60")])
    silent, loud = (jnp.float32(rng.poisson(np.asarray(mean))) for mean in (BACKGROUND, there))
    assert float(excluded(loud, only)) > 1.0
    assert float(excluded(silent, only)) < 0.5
    assert float(excluded(loud, ALL)) == 0.0


@pytest.mark.slow
def test_where_as_many_sources_are_known_as_are_sought_no_further_one_is_noticed():
    state = _nothing(jnp.float32(BACKGROUND))[1]
    full = replace(state, sources=replace(state.sources, present=jnp.ones(1, bool)))
    search = jax.jit(lambda rois, s: noticed(_nothing(rois)[0], KNOWN.places, ALL, SEARCH, s))
    told, unsought = search(jnp.float32(BACKGROUND), full)
    assert np.isinf(np.asarray(told)).all()
    assert float(unsought) < 0.5
    # but that there is one more is told
    there = mean_rois(SITE, DETECTORS, FLIGHT, [((10.0, 4.0, 1.0), 3e8, "Co-60")])
    assert float(search(jnp.float32(np.round(there)), full)[1]) > 1.0


def test_beside_a_source_that_overloads_a_counter_only_what_is_believed_is_noticed():
    """A limit of 29 MBq was told where one of 590 was not found."""
    there = mean_rois(SITE, DETECTORS, FLIGHT, [((-20.0, -20.0, 1.0), 1e8, "Co-60")])
    strong = np.maximum(np.asarray(there) - BACKGROUND, 0.0)
    dead_s = float(jnp.sum(DETECTORS[0].paralyzable_s + DETECTORS[0].non_paralyzable_s))
    rate = strong.sum(axis=1) / np.asarray(FLIGHT.exposure_s)
    counts = 0.3 / (dead_s * rate.max()) * strong
    shown = np.exp(-0.3 * rate / rate.max())[:, None] * (BACKGROUND + counts)
    problem, state = _nothing(jnp.float32(np.round(shown)))
    assert bool(overloaded(problem))
    added = replace(state.added, counts=jnp.broadcast_to(jnp.float32(counts), state.added.counts.shape))
    told = jax.jit(lambda p, s: noticed(p, KNOWN.places, ALL, SEARCH, s)[0])(problem, replace(state, added=added))
    points = jnp.asarray(KNOWN.places.points_m)
    own = told[CO_60] * open_totals(problem, points, jnp.full(len(points), CO_60))
    shares = np.max(np.asarray(own) / np.maximum(counts.sum(axis=1), 1e-6), axis=1)
    assert 0.94 <= np.mean(shares > 0.3 - 1e-3) < 1.0


@pytest.mark.slow
def test_a_straight_way_is_counted_as_the_places_along_it():
    """Windows of a slow counter are metres long."""
    at, nuclide = jnp.array([3.0, 4.0, 1.0]), jnp.int32(CO_60)
    way = jnp.array([30.0, 0.0, 0.0])
    m = counted(FLIGHT, BACKGROUND)

    @jax.jit
    def shown(position_m, travel_m):
        moved = replace(m, position_m=position_m, travel_m=travel_m)
        return open_counts(problem_of(KNOWN, moved, SPANS), at, nuclide).sum(axis=1)

    share = (np.arange(200) + 0.5) / 200 - 0.5
    long = shown(m.position_m, jnp.broadcast_to(way, (60, 3)))
    along = np.mean([np.asarray(shown(m.position_m + by * way, jnp.zeros((60, 3)))) for by in share], axis=0)
    np.testing.assert_allclose(np.asarray(long), along, rtol=0.04)
