"""How strong a source would have had to be to be noticed."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from swarmsim.device import some_at_a_time
from swarmsim.estimation.detection_limit import MOST, limits, noticed
from swarmsim.estimation.localise import problem_of
from swarmsim.estimation.scan import scan
from swarmsim.estimation.search import attempt
from swarmsim.estimation.state import no_sources, settled
from tests.estimation.survey import NUCLIDES, counted, mean_rois, place, presumed, spectrometer, survey

CO_60 = NUCLIDES.index("Co-60")
DETECTORS = (spectrometer(),)
FLIGHT = survey(altitude=12.0, count=60, half=40.0, lines=6)
SPANS = ((0, 60, 0, 1),)
SITE = place(half=40.0)
KNOWN = presumed(SITE, DETECTORS, half=40.0)
ASKED = jnp.float32(5.5**2)
BACKGROUND = np.asarray(mean_rois(SITE, DETECTORS, FLIGHT))
ALL = jnp.ones(len(NUCLIDES), bool)


def _nothing(rois):
    problem = problem_of(KNOWN, counted(FLIGHT, rois), SPANS)
    return problem, settled(problem, no_sources(problem, 1, len(NUCLIDES)))


@jax.jit
def _limits(rois, point):
    problem, state = _nothing(rois)
    return limits(problem, state, jnp.broadcast_to(point, (len(NUCLIDES), 3)), ASKED)


@jax.jit
def _ratio(rois, point):
    """Twice the logarithm of the likelihood ratio that a search would find at the place of the source."""
    problem, state = _nothing(rois)
    at = point.at[2].set(1.0)
    fit = attempt(problem, jnp.int32(CO_60), state.added, state.unknowns, at).fit
    return 2.0 * (fit.likelihood - state.likelihood)


@pytest.mark.parametrize("at", [(10.0, 4.0, 1.0), (-33.0, 28.0, 1.0), (39.0, -39.0, 1.0)])
def test_a_source_at_its_detection_limit_is_noticed_nineteen_times_of_twenty(at):
    point = jnp.array(at)
    per_bq = (np.asarray(mean_rois(SITE, DETECTORS, FLIGHT, [(at, 1e6, "Co-60")])) - BACKGROUND) / 1e6
    rng = np.random.default_rng(0)
    background = BACKGROUND * np.exp(float(KNOWN.background_std) * rng.standard_normal((300, 60, 1)))
    silent = jnp.float32(rng.poisson(background))
    activity = np.asarray(jax.lax.map(lambda rois: _limits(rois, point)[CO_60], silent))
    added = jnp.float32(rng.poisson(np.maximum(activity[:, None, None] * per_bq, 0.0)))
    ratio = np.asarray(jax.lax.map(lambda rois: _ratio(rois, point), silent + added))
    assert 0.85 < np.mean(ratio > ASKED) < 0.99


def test_most_places_reach_the_limit_that_is_told():
    @jax.jit
    def told(rois, allowed):
        problem, state = _nothing(rois)
        every = scan(problem, KNOWN.places.points_m, allowed, state.added, state.unknowns).information[:, CO_60]
        return noticed(problem, KNOWN.places, allowed, ASKED, state), every

    (whole, every), (one, _) = told(BACKGROUND, ALL), told(BACKGROUND, jnp.arange(len(NUCLIDES)) == CO_60)
    # a faint source would be noticed there from so many standard deviations on
    faint = (np.sqrt(float(ASKED)) + norm.ppf(0.95)) / np.sqrt(np.asarray(every))
    assert np.mean(faint < whole[CO_60]) > MOST - 0.01
    assert np.isfinite(whole).all()
    assert one[CO_60] == pytest.approx(float(whole[CO_60]), rel=1e-4)
    assert np.isinf(np.delete(np.asarray(one), CO_60)).all()


@pytest.mark.parametrize(("measured", "least", "most"), [(60, 1.0, 1.0), (30, 1.5, np.inf), (0, np.inf, np.inf)])
def test_the_fewer_places_were_measured_the_higher_is_the_limit(measured, least, most):
    @jax.jit
    def told(valid):
        m = replace(counted(FLIGHT, BACKGROUND), valid=valid)
        problem = problem_of(KNOWN, m, SPANS)
        state = settled(problem, no_sources(problem, 1, len(NUCLIDES)))
        return noticed(problem, KNOWN.places, ALL, ASKED, state)

    whole, part = (np.asarray(told(jnp.arange(60) < count)) for count in (60, measured))
    assert np.isfinite(whole).all()
    assert np.all(part >= 0.999 * least * whole)
    assert np.all(part <= 1.001 * most * whole)


def test_an_accelerator_tells_the_same_limits_of_many_missions(monkeypatch):
    def told(rois):
        problem, state = _nothing(rois)
        return some_at_a_time(lambda: noticed(problem, KNOWN.places, ALL, ASKED, state))

    rng = np.random.default_rng(1)
    drawn = jnp.float32(rng.poisson(BACKGROUND * rng.uniform(0.5, 2.0, (3, 1, 1))))
    one_by_one = np.asarray(jax.lax.map(told, drawn))
    monkeypatch.setattr("swarmsim.device.on_processor", lambda: False)
    together = jax.jit(jax.vmap(told))(drawn)
    np.testing.assert_allclose(together, one_by_one, rtol=1e-3)
    assert np.ptp(one_by_one[:, CO_60]) > 0.1 * one_by_one[:, CO_60].mean()
