"""Counters driven into their dead time."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.device import some_at_a_time
from swarmsim.estimation.localise import problem_of
from swarmsim.estimation.normal_equations import Others
from swarmsim.estimation.overload import FACTORS, likeliest, overloaded, prominent
from swarmsim.estimation.search import attempt
from swarmsim.estimation.state import no_sources, settled
from swarmsim.radiation.rate import share_registered
from tests.estimation.survey import NUCLIDES, counted, mean_rois, place, presumed, spectrometer, survey

DETECTORS = (spectrometer(),)
FLIGHT = survey(altitude=12.0, count=60, half=40.0, lines=6)
SPANS = ((0, 60, 0, 1),)
SITE = place(half=40.0)
KNOWN = presumed(SITE, DETECTORS, half=40.0)
BACKGROUND = mean_rois(SITE, DETECTORS, FLIGHT)
AT = (10.0, 4.0, 1.0)


@pytest.mark.parametrize("number", [0, 3, 12, 14])
def test_of_several_activities_the_one_that_was_counted_is_likeliest(number):
    """The strongest leaves next to no counts where the crystal is nearest."""
    net = (mean_rois(SITE, DETECTORS, FLIGHT, [(AT, 1e8, "Co-60")]) - BACKGROUND).sum(axis=1)
    added = 0.1 / float(DETECTORS[0].paralyzable_s) * net / net.max() * FLIGHT.exposure_s
    beside = BACKGROUND.sum(axis=1)
    true = FACTORS[number] * added + beside
    registered = true * share_registered(true / FLIGHT.exposure_s, DETECTORS[0].paralyzable_s, jnp.zeros(()))
    problem = problem_of(KNOWN, replace(counted(FLIGHT, BACKGROUND), counts=jnp.round(registered)), SPANS)
    factor, gain = likeliest(problem, added, beside, jnp.full(60, 0.01))
    assert float(factor) == pytest.approx(FACTORS[number])
    assert float(gain) > 100.0


def test_beside_a_source_that_overloads_a_counter_a_faint_one_is_not_believed():
    m = counted(FLIGHT, BACKGROUND)
    dead_s = float(jnp.sum(DETECTORS[0].paralyzable_s + DETECTORS[0].non_paralyzable_s))
    added = jnp.linspace(0.0, 1e4, 60)[:, None] * jnp.ones(3)
    others = Others(counts=jnp.stack([added, 2.0 * added]), variance=jnp.zeros((2, 60)))
    alone = Others(counts=jnp.zeros((2, 60, 3)), variance=jnp.zeros((2, 60)))
    for rate, loud in ((0.05 / dead_s, False), (0.15 / dead_s, True)):
        problem = problem_of(KNOWN, replace(m, counts=m.counts.at[7].set(rate * m.exposure_s[7])), SPANS)
        assert bool(overloaded(problem)) == loud
        assert bool(prominent(problem, 0.2 * 3.0 * added, others)) != loud
        assert bool(prominent(problem, (0.2 * 3.0 * added).at[5].mul(2.0), others))
        assert bool(prominent(problem, 0.01 * added, alone))


@pytest.mark.slow
def test_an_accelerator_begins_fits_of_many_missions_alike(monkeypatch):
    """Of some that overloaded a counter and others that did not."""
    means = [mean_rois(SITE, DETECTORS, FLIGHT, [(AT, activity, "Co-60")]) for activity in (2e8, 1e11, 3e12)]
    drawn = jnp.float32(np.random.default_rng(2).poisson(np.stack(means)))
    places = jnp.array([[10.0, 4.0, 1.0], [11.0, 2.0, 1.0]])

    def fitted(rois):
        def look():
            problem = problem_of(KNOWN, counted(FLIGHT, rois), SPANS)
            state = settled(problem, no_sources(problem, 1, len(NUCLIDES)))
            tries = jax.vmap(lambda at: attempt(problem, jnp.int32(0), state.added, state.unknowns, at).fit)(places)
            return overloaded(problem), tries.unknowns.activity_bq, tries.likelihood

        return some_at_a_time(look)

    loud, *one_by_one = jax.jit(lambda many: jax.lax.map(fitted, many))(drawn)
    assert loud.tolist() == [False, True, True]
    np.testing.assert_allclose(one_by_one[0][:, 0], [2e8, 1e11, 3e12], rtol=0.1)
    monkeypatch.setattr("swarmsim.device.on_processor", lambda: False)
    _, *together = jax.jit(jax.vmap(fitted))(drawn)
    np.testing.assert_allclose(together[0], one_by_one[0], rtol=1e-3)
    np.testing.assert_allclose(together[1], one_by_one[1], rtol=1e-3, atol=0.1)
