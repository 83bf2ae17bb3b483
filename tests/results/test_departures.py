"""What was drawn for a mission within its knowledge, against what its counters and its estimate take."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import swarmsim
from swarmsim.estimation.windows import windows_start
from swarmsim.missions.knowledge import errors_of_places, expected_spectrum, gathered, pose_errors
from swarmsim.results.departures import departures_of
from swarmsim.results.record import Departures
from swarmsim.runtime.simulation import Simulation

SEED = 11


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return swarmsim.build(swarmsim.load("recon", ["engine=analytic"]))


def departures(simulation: Simulation, seed: int = SEED) -> Departures:
    assert simulation.plan.presumed is not None
    made = departures_of(simulation, simulation.world, errors_of_places(simulation.plan.presumed), seed)
    assert made is not None
    return made


def test_they_are_within_the_knowledge_and_each_mission_has_its_own(simulation):
    made, other = departures(simulation), departures(simulation, SEED + 1)
    assert set(made.pose_error_m) == {"uav1", "uav2", "uav3", "orpheus"}
    assert set(made.sensitivity_factor) == set(simulation.scenario.detectors)
    assert made.thickness_factor
    assert not {"air", "soil"} & set(made.thickness_factor)
    assert all(0.5 <= factor <= 1.5 for factor in made.thickness_factor.values())
    assert made.thickness_factor != other.thickness_factor
    again = departures(simulation)
    np.testing.assert_array_equal(
        np.stack(list(again.pose_error_m.values())), np.stack(list(made.pose_error_m.values()))
    )


def test_pose_errors_are_what_the_estimate_has_in_its_places(simulation):
    world, plan, key = simulation.world, simulation.plan, jax.random.key(SEED)
    windows = []
    for group, size in zip(world.groups, plan.windows, strict=True):
        nothing = windows_start(group.size, size, group.counter.detector.background_rois.shape[0])
        ones = jnp.ones_like(nothing.exposure_s)
        windows.append(replace(nothing, exposure_s=ones, samples=jnp.full(group.size, size, jnp.int32)))
    measurements = gathered(world, plan, tuple(windows), key)  # of crystals at the origin
    shown = {tuple(np.round(row, 6)) for row in np.asarray(measurements.position_m) if np.any(row)}
    assert {tuple(np.round(error, 6)) for error in departures(simulation).pose_error_m.values()} == shown


def test_vehicles_have_the_error_of_the_geometry_in_common(simulation):
    """Each its own as well: by as much as the stated covariance of a source's place has of both."""
    std_m = errors_of_places(simulation.plan.presumed)
    keys = jax.vmap(jax.random.key)(jnp.arange(4000))
    errors = np.asarray(jax.jit(jax.vmap(lambda key: pose_errors(std_m, key, jnp.arange(2))))(keys))
    covariance = np.cov(errors.reshape(4000, 6).T)
    own, alike = (float(std) ** 2 for std in std_m)
    assert alike == pytest.approx(0.05**2)
    expected = np.kron(np.array([[alike + own, alike], [alike, alike + own]]), np.eye(3))
    np.testing.assert_allclose(covariance, expected, atol=0.07 * alike)


@pytest.mark.slow
def test_the_sensitivity_is_what_counts_have(simulation):
    world, made = simulation.world, departures(simulation)
    exact = replace(world, departures=replace(world.departures, sensitivity_std=jnp.zeros(())))
    place, axis = jnp.array([12.0, 20.0, 20.0]), jnp.array([0.0, 0.0, 1.0])
    for model, name in enumerate(made.sensitivity_factor):
        quiet = [replace(w, background=replace(w.background, scale=jnp.zeros(()))) for w in (world, exact)]
        rates = [float(jnp.sum(expected_spectrum(jax.random.key(SEED), w, model)(place, axis, 0.0))) for w in quiet]
        assert rates[0] / rates[1] == pytest.approx(made.sensitivity_factor[name], rel=1e-4)


def test_without_an_estimate_there_are_no_measured_places(simulation):
    made = departures_of(simulation, simulation.world, None, SEED)
    assert made is not None
    assert made.pose_error_m == {}
    assert made.thickness_factor == departures(simulation).thickness_factor
    bare = replace(simulation.world, groups=tuple(replace(g, counter=None) for g in simulation.world.groups))
    assert departures_of(simulation, bare, None, SEED) is None
