"""The aerial estimate against its Cramér–Rao bound, on the samples of the shipped survey as flown."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from scipy.stats import chi2, kstest

import swarmsim
from swarmsim.config.files import packaged_dir
from swarmsim.estimation import Measurements, cramer_rao_covariance, fisher_information, localise
from swarmsim.estimation.nodes import spans_of
from swarmsim.estimation.windows import gather, measured, merged, windows_start
from swarmsim.radiation import draw_counts, observed_rois
from swarmsim.radiation.background import background_factor
from swarmsim.randomness import mission_keys
from swarmsim.sensors.radiation import source_rate

pytestmark = pytest.mark.optimised

SEEDS = 32
# Fewer rounds and places than a mission takes: the bound is asked for within 30 %, and there are many fits.
QUICK = (
    "localisation.search_rounds=5",
    "localisation.sample_rounds=4",
    "localisation.samples=32",
    "localisation.sources_max=1",
    "knowledge={site: exact, pose_std_m: 0.0, sensitivity_std: 0.0, model_std: 0.01, spectrum_std: 0.0,"
    " learning_rate: 1.0, nuclides: [Co-60]}",
)


# The survey of the shipped mission alone, whose plan is smaller.
SURVEY = (
    "phases=[{name: survey, who: multirotor, policy: parallel_lines, time_limit_s: 400,"
    " settings: {altitude_m: 20.0, speed_m_s: 2.4}}]"
)


@pytest.fixture(scope="module")
def survey():
    """The scenario `recon` with its source in the open, and what many missions learn from the counts of its flight."""
    common = ("engine=analytic", "sources.0.position_m=[50.0, -13.0]")
    shipped = yaml.safe_load((packaged_dir() / "missions" / "recon.yaml").read_text(encoding="utf-8"))["phases"][0]
    # what is learnt from the samples of the flight takes most of the time to compile, and is not asked for
    alone = (f"phases=[{json.dumps(shipped)}]", "mapping=null", "localisation=null", "identification=null")
    flown = swarmsim.build(swarmsim.load("recon", (*common, *alone)))
    batch = flown.rollout(0)
    simulation = swarmsim.build(swarmsim.load("recon", [*common, SURVEY, *QUICK]))
    world, plan = simulation.world, simulation.plan
    assert swarmsim.mission_record(flown, batch, 0).phases[0].in_time  # every UAV has landed
    of_uavs = [segment for segment in batch.segments if segment.log.samples[0] is not None]
    samples = [jax.tree.map(partial(segment.of, 0), segment.log.samples[0]) for segment in of_uavs]
    joined = jax.tree.map(lambda *parts: jnp.concatenate(parts), *samples)
    counter = world.groups[0].counter
    rate = jax.vmap(jax.vmap(lambda place, axis: source_rate(world.site, counter.detector, world.sources, place, axis)))
    key, reference = jax.random.key(0), counter.detector.background_height_m
    natural = jax.vmap(jax.vmap(lambda place: background_factor(world.background, world.site, key, place, reference)))
    flat = jax.jit(
        lambda: observed_rois(counter.detector, rate(joined.position_m, joined.axis), natural(joined.position_m))
    )()
    live_s = float(joined.exposure_s.max())

    def windows(key):
        keys = jax.random.split(key, flat.shape[:2])
        each = jax.vmap(jax.vmap(lambda key, mean: draw_counts(counter.detector, key, mean, live_s)))
        counts, exposure = each(keys, flat)
        drawn = Measurements(
            time_s=joined.time_s, position_m=joined.position_m, travel_m=joined.travel_m, axis=joined.axis,
            counts=counts.sum(axis=-1), exposure_s=exposure, valid=joined.new, rois=counts,
            detector=jnp.zeros(counts.shape[:2], jnp.int32),
        )  # fmt: skip
        start = windows_start(3, plan.windows[0], flat.shape[-1])
        return merged(gather(start, drawn, joined.new, plan.per_window[0]), plan.kept[0])

    def mission(key):
        m = measured(windows(key), 0)
        found = localise(plan.presumed, m, spans_of([(m.counts.shape[0], 0, 1)]), plan.localisation)
        return jax.tree.map(lambda x: x[0], found.fits)

    keys = mission_keys(np.arange(SEEDS))
    fits = jax.jit(lambda every: jax.lax.map(mission, every))(keys)
    return simulation, measured(jax.jit(windows)(keys[0]), 0), jax.device_get(fits)


@pytest.mark.slow
def test_rmse_of_the_aerial_estimate_is_its_cramer_rao_bound(survey):
    simulation, windows, fits = survey
    world, plan = simulation.world, simulation.plan
    source = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), world.sources)
    information = jax.jit(lambda: fisher_information(
        world.site, plan.detectors, windows, source.position_m, source.activity_bq, source.nuclide, rays=6,
        ground_share=plan.presumed.ground_share,
    ))()  # fmt: skip
    bound = np.sqrt(np.diag(cramer_rao_covariance(information, plan.presumed.height_std_m)))[:2]
    assert np.all((bound > 0.4) & (bound < 1.0))  # tens of centimetres from 20 m above: not a bound that says nothing
    error = fits.position_m[:, :2] - np.asarray(source.position_m)[:2]
    rmse = np.sqrt(np.mean(error**2, axis=0))
    # the bound is that of total counts of a known background: energies tell more, an unknown background less, all the
    # more of photons that the ground scatters, whose spectrum is like its own
    assert np.all(rmse <= 2.0 * bound)
    assert np.all(rmse >= 0.6 * bound)
    assert np.all(np.abs(error.mean(axis=0)) < 4.0 * bound / np.sqrt(SEEDS))
    assert np.all(fits.present)
    assert np.mean(fits.converged) > 0.95


@pytest.mark.slow
def test_the_aerial_estimate_knows_its_error(survey):
    simulation, _, fits = survey
    world = simulation.world
    error = fits.position_m[:, :2] - np.asarray(world.sources.position_m)[0, :2]
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.covariance_m2[:, :2, :2]), error)
    assert kstest(normalised, chi2(2).cdf).pvalue > 1e-3
    deviation = np.log(fits.activity_bq / float(world.sources.activity_bq[0])) / (
        fits.activity_std_bq / fits.activity_bq
    )
    assert 0.8 < np.sqrt(np.mean(deviation**2)) < 1.25
