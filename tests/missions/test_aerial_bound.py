"""The aerial estimate against its Cramér–Rao bound, on the samples of the shipped survey as flown."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, kstest

import swarmsim
from swarmsim.estimation import cramer_rao_covariance, fisher_information
from swarmsim.missions import keys, knowledge

SEEDS = 256
# Fewer rounds, rays and places than a mission takes: the bound is asked for within 30 %, and there are 256 fits.
QUICK = (
    "localisation.iterations=120",
    "localisation.search_rounds=0",
    "localisation.fisher_steps=4",
    "localisation.sample_rounds=3",
    "localisation.samples=32",
    "localisation.rays_per_window=1",
)


@pytest.fixture(scope="module")
def survey():
    """The scenario `recon` with its source in the open, and what 256 missions learn from the counts of its flight."""
    place = "sources.0.position_m=[50.0, -13.0]"
    simulation = swarmsim.build(swarmsim.load("recon", ["engine=analytic", place, *QUICK]))
    world, per_window = simulation.world, simulation.per_window
    do, key = simulation.stages(1), keys.mission_keys(np.array([0]))
    ticks = jnp.arange(round(330.0 / simulation.timing.uav_tick_s))
    flights, log = do.fly(key, world, do.plan_survey(world), do.ready_to_fly(key, world), ticks)
    assert np.all(np.min(np.asarray(flights.event_time_s), axis=-1) < 330.0)  # every UAV has landed
    log = jax.tree.map(lambda leaf: leaf[0], log)
    count = jax.jit(lambda key: knowledge.count_from_air(key, world, log))

    def mission(key):
        found = knowledge.learn_from_air(world, knowledge.count_from_air(key, world, log), per_window, 4)
        return found.fit, found.found

    mission_keys = keys.mission_keys(np.arange(SEEDS))
    fits, found = jax.jit(lambda every: jax.lax.map(mission, every))(mission_keys)
    return world, knowledge.windows(count(mission_keys[0]), per_window), jax.device_get(fits), np.asarray(found)


def test_rmse_of_the_aerial_estimate_is_its_cramer_rao_bound(survey):
    world, windows, fits, found = survey
    source = jax.tree.map(lambda leaf: leaf[0], world.sources)
    detectors = knowledge.detectors(world)
    information = jax.jit(lambda: fisher_information(
        world.site, detectors, windows, source.position_m, source.activity_bq, source.nuclide, rays=6
    ))()  # fmt: skip
    bound = np.sqrt(np.diag(cramer_rao_covariance(information, world.localisation.height_std_m)))[:2]
    assert np.all((bound > 0.6) & (bound < 1.2))  # tens of centimetres from 20 m above: not a bound that says nothing
    error = fits.position_m[:, :2] - np.asarray(source.position_m)[:2]
    rmse = np.sqrt(np.mean(error**2, axis=0))
    assert np.all(rmse <= 1.3 * bound)
    assert np.all(rmse >= 0.85 * bound)  # nobody beats the bound: the errors or the bound would be wrong
    assert np.all(np.abs(error.mean(axis=0)) < 4.0 * bound / np.sqrt(SEEDS))
    assert np.all(found)
    assert np.mean(fits.converged) > 0.98


def test_the_aerial_estimate_knows_its_error(survey):
    world, _, fits, _ = survey
    error = fits.position_m[:, :2] - np.asarray(world.sources.position_m)[0, :2]
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.covariance_m2[:, :2, :2]), error)
    assert kstest(normalised, chi2(2).cdf).pvalue > 1e-3
    deviation = np.log(fits.activity_bq / float(world.sources.activity_bq[0])) / (
        fits.activity_std_bq / fits.activity_bq
    )
    assert 0.8 < np.sqrt(np.mean(deviation**2)) < 1.25
