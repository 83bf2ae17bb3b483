"""What a mission makes of the spectrum that it took about a source."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import swarmsim
from swarmsim.estimation import Measurements
from swarmsim.missions import knowledge
from swarmsim.missions.begin import begin_mission
from swarmsim.radiation import identify

PLACE, HEIGHT_M = (50.0, -13.0), 0.5
SOURCE = (
    f"sources=[{{nuclide: Eu-152, position_m: [{PLACE[0]}, {PLACE[1]}], height_m: {HEIGHT_M}, activity_mbq: 170.0}}]"
)


def around(place, radius_m: float, detector: int) -> Measurements:
    """Eight windows in a circle about a place, the crystal pointing along the way, and two that are padding."""
    n, angle = 10, np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    side = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    along = np.stack([-np.sin(angle), np.cos(angle), 0.0 * angle], axis=1)
    padding = np.full((2, 3), np.nan)
    return Measurements(
        time_s=jnp.arange(1.0, n + 1.0),
        position_m=jnp.asarray(np.concatenate([place + radius_m * side, padding]), jnp.float32),
        travel_m=jnp.zeros((n, 3)),
        axis=jnp.asarray(np.concatenate([along, padding]), jnp.float32),
        counts=jnp.zeros(n),
        exposure_s=jnp.full(n, 10.0),
        valid=jnp.arange(n) < 8,
        detector=jnp.full(n, detector, jnp.int32),
    )


@pytest.mark.slow
def test_a_source_is_identified_as_the_crystal_saw_it() -> None:
    """From the side of the crystal X-rays of Eu-152 count a third more: end on, the same spectrum would fit badly."""
    simulation = swarmsim.build(swarmsim.load("recon", ["engine=analytic", SOURCE]))
    world, plan, key = simulation.world, simulation.plan, jax.random.key(3)
    place = np.asarray(world.sources.position_m)[0]
    measurements = around(place, 2.0, plan.spectrometer)
    mission, _ = jax.eval_shape(lambda: begin_mission(key, world, plan))
    known = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), mission.survey)
    fits = replace(known.estimated.fits, position_m=known.estimated.fits.position_m.at[0].set(place))
    known = replace(known, found=jnp.array(True), estimated=replace(known.estimated, fits=fits))
    _, spectrum, found = jax.jit(lambda: knowledge.named(key, world, plan, known, measurements))()
    detector = plan.detectors[plan.spectrometer]
    assert float(jnp.sum(spectrum.counts)) > 1e5
    assert detector.nuclide_names[int(found.nuclide)] == "Eu-152"
    assert float(found.goodness) > 1e-3
    assert float(jax.jit(identify)(detector, spectrum.counts, spectrum.live_s).goodness) < 1e-3
