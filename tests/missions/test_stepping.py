"""A team stepped by hand, and what can go wrong with a vehicle."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import swarmsim
from swarmsim.missions.events import KINDS

TEAM = (
    "engine=analytic",
    "wind.gusts=false",
    "vehicles=[{name: uav1, type: tarot_t650, position_m: [-40, 2]},"
    " {name: uav2, type: tarot_t650, position_m: [-34, 2]},"
    " {name: orpheus, type: orpheus, position_m: [-24, 4], heading_deg: 0}]",
)


@pytest.fixture(scope="module")
def stepper():
    return swarmsim.Stepper(swarmsim.build(swarmsim.load("recon", TEAM)))


def fly(stepper, state, command, ticks):
    for _ in range(ticks):
        state, seen = stepper.step(state, command)
    return state, seen


def happened(state, vehicle, mission=0):
    times = np.asarray(state.flights.event_time_s)[mission, vehicle]
    return {kind for kind, time in zip(KINDS, times, strict=True) if np.isfinite(time)}


def climbed(stepper, missions=1, height=8.0):
    state = stepper.reset(range(missions))
    command = stepper.hold(state)
    command = dataclasses.replace(command, position_m=command.position_m + jnp.array([0.0, 0.0, height]))
    return *fly(stepper, state, command, 70), command


def test_vehicles_hold_a_position_and_count_the_background(stepper):
    state, seen, command = climbed(stepper, missions=2)
    np.testing.assert_allclose(seen.position_m, command.position_m, atol=0.15)
    np.testing.assert_allclose(seen.velocity_m_s, 0.0, atol=0.2)
    assert bool(seen.active.all())
    assert float(seen.time_s) == pytest.approx(70 * stepper.tick_s)
    rates = []
    for _ in range(30):
        state, seen = stepper.step(state, command)
        rates.append(np.asarray(seen.count_rate_cps))
    # 30 ticks x 4 counters of 94 cps and 0.09 s: standard error 3 cps
    assert np.mean(rates) == pytest.approx(94.0, abs=12.0)


def test_the_rover_drives_as_told(stepper):
    state = stepper.reset(0)
    command = dataclasses.replace(stepper.hold(state), rover_speed_m_s=jnp.array([0.5]))
    start = np.asarray(state.rover.vehicle.body.position_m)
    _, seen = fly(stepper, state, command, 60)
    moved = np.asarray(seen.rover_position_m) - start
    assert moved[0, 0] == pytest.approx(0.5 * 60 * stepper.tick_s, rel=0.15)
    assert abs(moved[0, 1]) < 0.1


def test_two_uavs_that_meet_have_collided_and_fall(stepper):
    state, _, command = climbed(stepper)
    meet = command.position_m.at[:, 0, 0].set(-37.0).at[:, 1, 0].set(-37.0)
    state, seen = fly(stepper, state, dataclasses.replace(command, position_m=meet), 60)
    assert "vehicle" in happened(state, 0)
    assert "vehicle" in happened(state, 1)
    assert not seen.active.any()
    assert float(seen.position_m[0, 0, 2]) < 3.0


def test_a_uav_that_flies_into_a_building_has_collided(stepper):
    state, _, command = climbed(stepper, height=4.0)
    # the middle building stands around (-4, 4); one UAV is sent into its wall, the other stays
    into = command.position_m.at[:, 0].set(jnp.array([-4.0, 4.0, 5.0]))
    path = dataclasses.replace(command, position_m=into.at[:, 1].add(jnp.array([0.0, -12.0, 6.0])))
    state, _ = fly(stepper, state, path, 140)
    assert "obstacle" in happened(state, 0)
    assert happened(state, 1) == set()


def test_a_hard_landing_is_a_crash(stepper):
    state, _, command = climbed(stepper, height=12.0)
    dive = command.position_m - jnp.array([0.0, 0.0, 60.0])
    fall = dataclasses.replace(command, position_m=dive, velocity_m_s=jnp.zeros_like(dive).at[..., 2].set(-6.0))
    state, _ = fly(stepper, state, fall, 80)
    assert happened(state, 0) == {"crash"}


def test_a_non_finite_state_is_recorded_and_does_not_spread(stepper):
    state, _, command = climbed(stepper, missions=2)
    broken = dataclasses.replace(command, position_m=command.position_m.at[0, 0].set(jnp.nan))
    state, seen = fly(stepper, state, broken, 5)
    assert happened(state, 0, mission=0) == {"non_finite"}
    assert happened(state, 1, mission=0) == set()
    assert happened(state, 0, mission=1) == set()
    assert np.isfinite(np.asarray(seen.position_m)).all()
    state, fine = fly(stepper, stepper.reset(range(2)), stepper.hold(stepper.reset(range(2))), 1)
    assert np.isfinite(np.asarray(fine.position_m)).all()


def test_an_empty_battery_ends_the_flight():
    scenario = swarmsim.load("recon", (*TEAM, "definitions.vehicles.tarot_t650.battery.capacity_wh=0.5"))
    stepper = swarmsim.Stepper(swarmsim.build(scenario))
    state, seen, command = climbed(stepper)
    state, seen = fly(stepper, state, command, 30)
    assert "battery_empty" in happened(state, 0)
    assert not seen.active.any()


def test_wrong_shapes_are_refused_at_the_door(stepper):
    state = stepper.reset(range(2))
    command = stepper.hold(state)
    with pytest.raises(ValueError, match="shapes"):
        stepper.step(state, dataclasses.replace(command, yaw_rad=command.yaw_rad[0]))
