"""What ends a vehicle's part: crashes, obstacles, collisions and an empty battery, whenever they fall."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.control.commands import DriveCommand, RotorSpeedCommand, fly_velocity, go_to
from swarmsim.world import events
from tests.world.worlds import (
    BUILDING,
    ROVERS,
    TICK_S,
    UAVS,
    airborne,
    at_tick,
    begin,
    fly,
    happened,
    stay,
    team,
    with_group,
)

JUDGE_TICKS = 5
OFF = RotorSpeedCommand(rotor_speed_rad_s=jnp.zeros((UAVS, 4)))
APART = np.array([[-30.0 + 8.0 * k, -20.0, 12.0] for k in range(UAVS)], np.float32)
"""Places at which nobody is in anybody's way."""


@pytest.fixture(scope="module")
def world():
    return team()


@pytest.fixture(scope="module")
def start(world):
    return begin(world, jax.random.key(5))


@pytest.fixture(scope="module")
def rest(start):
    """Height of the centre of a UAV that stands on the ground."""
    return float(start.groups[0].vehicle.body.position_m[0, 2])


def times_of(state, kind, group=0):
    return np.asarray(state.groups[group].event_time_s)[:, events.KINDS.index(kind)]


def test_only_the_first_event_ends_a_vehicles_part():
    nothing = jnp.zeros(len(events.KINDS), bool)
    times = events.record(events.none_yet(), nothing, jnp.float32(1.0))
    assert bool(events.able(times))
    times = events.record(times, nothing.at[events.OBSTACLE].set(True), jnp.float32(3.0))
    assert not bool(events.able(times))
    times = events.record(times, nothing.at[events.CRASH].set(True), jnp.float32(4.0))
    assert float(times[events.OBSTACLE]) == 3.0
    assert np.isinf(float(times[events.CRASH]))
    both = nothing.at[events.CRASH].set(True).at[events.VEHICLE].set(True)
    np.testing.assert_array_equal(np.isfinite(events.record(events.none_yet(), both, jnp.float32(2.0))), both)
    assert set(events.DESCRIPTIONS) == set(events.KINDS)


@pytest.mark.slow
@pytest.mark.parametrize("offset", range(JUDGE_TICKS))
def test_a_hard_drop_is_recorded_at_every_phase_of_the_judging_period(world, start, rest, offset):
    clearance = np.linspace(0.5, 2.5, UAVS) + 0.07 * offset
    place = APART.copy()
    place[:, 2] = rest + clearance
    state, tracks = fly(world, at_tick(airborne(world, start, place), offset), (OFF, stay(world, start)[1]), 1.2)
    assert happened(state) == [{"crash"}] * UAVS
    contact = TICK_S * (offset + 1 + np.argmax(tracks[0].position_m[..., 2] < rest, axis=0))
    delay = times_of(state, "crash") - contact
    assert np.all((delay > -1.5 * TICK_S) & (delay < (JUDGE_TICKS + 1) * TICK_S))
    assert happened(state, 1) == [set()] * ROVERS


@pytest.mark.slow
def test_a_soft_landing_is_no_crash(world, start, rest):
    place = APART.copy()
    place[:, 2] = rest + np.linspace(0.02, 0.14, UAVS)
    state, tracks = fly(world, airborne(world, start, place), (OFF, stay(world, start)[1]), 1.0)
    assert tracks[0].velocity_m_s[..., 2].min() < -1.0
    assert happened(state) == [set()] * UAVS
    np.testing.assert_allclose(state.groups[0].vehicle.body.position_m[:, 2], rest, atol=2e-3)


def test_a_uav_that_lies_on_its_side_has_crashed(world, start, rest):
    place = APART.copy()
    place[:, 2] = rest + 0.1
    up = airborne(world, start, place)
    vehicle = up.groups[0].vehicle
    side = vehicle.body.quaternion.at[1].set(jnp.array([0.7071, 0.7071, 0.0, 0.0]))
    up = with_group(up, 0, vehicle=replace(vehicle, body=replace(vehicle.body, quaternion=side)))
    state, _ = fly(world, up, (OFF, stay(world, start)[1]), 0.2)
    assert happened(state)[1] == {"crash"}
    assert happened(state)[0] == set()


@pytest.mark.parametrize("offset", range(JUDGE_TICKS))
def test_a_head_on_pass_is_recorded_as_a_collision_with_a_detector_of_1_hz(world, start, offset):
    """Two UAVs of 12 m/s each come 1.2 m closer in a judging period; five gaps at each phase of it."""
    assert world.groups[0].counter.ticks * world.groups[0].counter.evaluations == 100
    velocity = np.zeros((UAVS, 3), np.float32)
    velocity[:2, 0] = 12.0, -12.0
    command = jax.vmap(go_to)(jnp.asarray(APART))
    head_on = jax.vmap(fly_velocity)(jnp.asarray(velocity))
    command = jax.tree.map(lambda all_, two: all_.at[:2].set(two[:2]), command, head_on)
    for gap in 4.0 + 0.24 * np.arange(5):
        place = APART.copy()
        place[:2] = [[-20.0, -20.0, 12.0], [-20.0 + gap, -20.0, 12.0]]
        up = at_tick(airborne(world, start, place, velocity), offset)
        state, tracks = fly(world, up, (command, stay(world, start)[1]), 0.4)
        assert happened(state) == [{"vehicle"}, {"vehicle"}, set(), set(), set()]
        met = TICK_S * (offset + 1 + np.argmin(np.abs(tracks[0].position_m[:, 0, 0] - tracks[0].position_m[:, 1, 0])))
        assert abs(times_of(state, "vehicle")[0] - met) <= (JUDGE_TICKS + 1) * TICK_S


def test_who_collided_falls_and_has_no_more_events(world, start):
    place = APART.copy()
    place[1] = place[0] + [0.5, 0.0, 0.1]
    command = jax.vmap(go_to)(jnp.asarray(place))
    state, tracks = fly(world, airborne(world, start, place), (command, stay(world, start)[1]), 3.0)
    assert happened(state) == [{"vehicle"}, {"vehicle"}, set(), set(), set()]
    lowest = tracks[0].position_m[:, :2, 2].min(axis=0)  # they hit the ground, which is no event any more ...
    assert lowest.min() < 0.3
    assert lowest.max() < 0.7  # ... or one the other
    np.testing.assert_allclose(tracks[0].position_m[-1, 2:], place[2:], atol=0.1)


def test_a_collision_with_a_vehicle_that_has_no_part_is_the_others_event(world, start):
    place = APART.copy()
    place[1] = place[0] + [0.5, 0.0, 0.1]
    up = with_group(airborne(world, start, place), 0, active=jnp.arange(UAVS) != 1)
    state, _ = fly(world, up, (jax.vmap(go_to)(jnp.asarray(place)), stay(world, start)[1]), 0.2)
    assert happened(state) == [{"vehicle"}, set(), set(), set(), set()]


def test_a_uav_that_flies_into_a_rover_has_collided_with_it(world, start):
    place, velocity = APART.copy(), np.zeros((UAVS, 3), np.float32)
    place[3] = start.groups[1].vehicle.body.position_m[1] + jnp.array([1.8, 0.1, 0.1])
    velocity[3] = [-4.0, 0.0, 0.0]
    fly_on = jax.vmap(go_to)(jnp.asarray(place))
    state, tracks = fly(world, airborne(world, start, place, velocity), (fly_on, stay(world, start)[1]), 1.0)
    assert happened(state) == [set(), set(), set(), {"vehicle"}, set()]
    assert happened(state, 1) == [set(), {"vehicle"}]
    apart = np.linalg.norm((tracks[0].position_m[:, 3] - tracks[1].position_m[:, 1])[:, :2], axis=-1)
    assert apart.min() > 0.386 + float(world.groups[1].limits.radius_m[1]) - 0.15


def test_traffic_tells_the_later_vehicle_to_hold(world, start):
    place = APART.copy()
    place[1] = place[0] + [3.0, 0.0, 0.0]
    state, _ = fly(world, airborne(world, start, place), (jax.vmap(go_to)(place), stay(world, start)[1]), 0.1)
    around = state.groups[0].around
    np.testing.assert_array_equal(around.hold, [False, True, False, False, False])
    np.testing.assert_allclose(around.nearest_m[:2], 3.0, atol=0.02)
    assert 0.0 < around.push_m[1, 0] < 1.0  # it grows while it is asked for
    np.testing.assert_array_equal(around.push_m[2:], 0.0)
    assert happened(state) == [set()] * UAVS
    later, _ = fly(world, state, (jax.vmap(go_to)(place), stay(world, start)[1]), 1.0)
    assert later.groups[0].around.push_m[1, 0] > 1.0


def test_a_uav_that_flies_into_a_house_has_collided_and_one_above_it_has_not(world, start):
    west = BUILDING[0]
    place = APART.copy()
    place[0], place[1] = [west - 3.0, 0.0, 4.0], [west - 3.0, 5.0, 8.0]
    velocity = np.zeros((UAVS, 3), np.float32)
    velocity[:2, 0] = 4.0
    state, tracks = fly(
        world, airborne(world, start, place, velocity), (jax.vmap(fly_velocity)(velocity), stay(world, start)[1]), 1.5
    )
    assert happened(state) == [{"obstacle"}] + [set()] * 4
    hit = tracks[0].position_m[round(times_of(state, "obstacle")[0] / TICK_S), 0, 0]
    radius = float(world.groups[0].limits.radius_m[0])
    assert west - radius - 0.3 < hit < west - radius + 0.3
    assert tracks[0].position_m[:, 0, 0].max() < west
    assert tracks[0].position_m[-1, 1, 0] > west + 1.0


def test_a_rover_that_drives_into_a_wall_fast_has_collided(world, start):
    rover = start.groups[1].vehicle
    before = rover.body.position_m.at[:, :2].set(jnp.array([[BUILDING[0] - 4.0, -3.0], [BUILDING[0] - 4.0, 3.0]]))
    near = with_group(start, 1, vehicle=replace(rover, body=replace(rover.body, position_m=before)))
    drive = DriveCommand(speed_m_s=jnp.array([1.9, 0.8]), yaw_rate_rad_s=jnp.zeros(ROVERS))
    state, tracks = fly(world, near, (stay(world, start)[0], drive), 6.0)
    assert happened(state, 1) == [{"obstacle"}, set()]
    assert tracks[1].position_m[-1, :, 0].max() < BUILDING[0]
    assert np.abs(tracks[1].velocity_m_s[-1, 0]).max() < 0.05  # who has ended brakes


def test_an_empty_battery_ends_the_flight(world, start):
    group = world.groups[0]
    little = jnp.full(UAVS, 1e6, jnp.float32).at[2].set(150.0)
    poor = replace(world, groups=(replace(group, limits=replace(group.limits, battery_j=little)), world.groups[1]))
    state, tracks = fly(
        poor, airborne(poor, start, APART), (jax.vmap(go_to)(jnp.asarray(APART)), stay(world, start)[1]), 3.0
    )
    assert happened(state) == [set(), set(), {"battery_low", "battery_empty"}, set(), set()]
    hovering = float(state.groups[0].vehicle.energy_j[0]) / 3.0  # W
    assert times_of(state, "battery_empty")[2] == pytest.approx(150.0 / hovering, abs=0.1)
    assert tracks[0].position_m[:, 2, 2].min() < 0.5
