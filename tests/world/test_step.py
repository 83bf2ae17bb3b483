"""The step by hand: rest, commands at every level, vehicles that do not take part, and what is refused."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.control.commands import (
    AttitudeCommand,
    BodyRateCommand,
    DriveCommand,
    DriveToCommand,
    PositionCommand,
    RotorSpeedCommand,
    WheelSpeedCommand,
    fly_velocity,
    go_to,
    multirotor_command,
    skid_steer_command,
)
from swarmsim.physics.rotations import from_yaw
from swarmsim.world.model import World
from swarmsim.world.state import WorldState
from swarmsim.world.step import full_commands, hold, step
from tests.flights import PLAIN, attitude
from tests.world.worlds import (
    ROVERS,
    TICK_S,
    UAVS,
    airborne,
    begin,
    fly,
    full_command,
    happened,
    stay,
    team,
    with_group,
)

GRAVITY = 9.81
HIGH = np.array([[-30.0 + 10.0 * k, -20.0, 12.0] for k in range(UAVS)], np.float32)


@pytest.fixture(scope="module")
def world() -> World:
    return team()


@pytest.fixture(scope="module")
def start(world) -> WorldState:
    return begin(world, jax.random.key(3))


def every(command, count=UAVS):
    """The same command for all vehicles of a group."""
    return jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x, jnp.float32), (count, *jnp.shape(x))), command)


def rows(commands):
    """Commands of the vehicles of a group, one after another."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *commands)


def assert_same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_reset_puts_every_vehicle_at_rest_at_its_start(world, start):
    state, tracks = fly(world, start, stay(world, start), 2.0)
    for group, before, after, track in zip(world.groups, start.groups, state.groups, tracks, strict=True):
        body = before.vehicle.body
        np.testing.assert_allclose(body.position_m[:, :2], group.start_m, atol=1e-6)
        np.testing.assert_array_equal(body.velocity_m_s, 0.0)
        np.testing.assert_array_equal(body.angular_velocity_rad_s, 0.0)
        np.testing.assert_allclose(body.quaternion, jax.vmap(from_yaw)(group.yaw_rad), atol=1e-6)
        np.testing.assert_allclose(track.position_m - np.asarray(body.position_m), 0.0, atol=1e-3)
        assert np.abs(track.velocity_m_s[-1]).max() < 1e-3
        assert bool(after.active.all())
    assert happened(state, 0) == [set()] * UAVS
    assert happened(state, 1) == [set()] * ROVERS
    assert int(state.clock.tick) == round(2.0 / TICK_S)


def test_multirotors_take_off_to_a_position_and_stay_there(world, start):
    above = start.groups[0].vehicle.body.position_m + jnp.array([1.0, -1.0, 4.0])
    commands = (jax.vmap(partial(go_to, yaw_rad=0.5))(above), stay(world, start)[1])
    state, tracks = fly(world, start, commands, 8.0)
    np.testing.assert_allclose(tracks[0].position_m[-1], above, atol=0.05)
    assert np.abs(tracks[0].velocity_m_s[-50:]).max() < 0.1
    assert np.all(np.diff(tracks[0].position_m[100:200, :, 2], axis=0) > 0.0)
    front = attitude(tracks[0].quaternion[-1])[:, :2, 0]
    np.testing.assert_allclose(np.arctan2(front[:, 1], front[:, 0]), 0.5, atol=0.02)
    assert happened(state, 0) == [set()] * UAVS


def test_a_velocity_is_flown(world, start):
    up = airborne(world, start, HIGH)
    wanted = jnp.array([1.0, 2.0, 0.5])
    _, tracks = fly(world, up, (every(fly_velocity(wanted)), stay(world, start)[1]), 6.0)
    np.testing.assert_allclose(tracks[0].velocity_m_s[-1], np.tile(wanted, (UAVS, 1)), atol=0.05)


def weight(world: World) -> float:
    return float(world.groups[0].params.mass_kg[0]) * GRAVITY


def tilted(angle: float, axis: int) -> np.ndarray:
    quaternion = np.zeros(4, np.float32)
    quaternion[[0, 1 + axis]] = np.cos(angle / 2), np.sin(angle / 2)
    return quaternion


def test_an_attitude_is_taken_and_accelerates_as_its_tilt_says(start):
    world = team(effects=PLAIN)
    angle, up = 0.15, airborne(world, start, HIGH)
    wanted = tilted(angle, 1)  # nose down: forward
    command = AttitudeCommand(quaternion=jnp.asarray(wanted), thrust_n=jnp.float32(weight(world) / np.cos(angle)))
    _, tracks = fly(world, up, (every(command), stay(world, start)[1]), 1.5)
    np.testing.assert_allclose(tracks[0].quaternion[-1], np.tile(wanted, (UAVS, 1)), atol=0.01)
    rise = (tracks[0].velocity_m_s[-1] - tracks[0].velocity_m_s[-51]) / 0.5
    speed = tracks[0].velocity_m_s[-26, 0, 0]
    drag = float(world.groups[0].params.drag_quadratic_kg_m[0, 0]) * speed**2 / weight(world) * GRAVITY
    np.testing.assert_allclose(rise[:, 0], GRAVITY * np.tan(angle) - drag, rtol=0.03)
    np.testing.assert_allclose(rise[:, 1:], 0.0, atol=0.05)


def test_body_rates_are_followed(world, start):
    up = airborne(world, start, HIGH)
    wanted = jnp.array([0.0, 0.0, 0.6])
    command = BodyRateCommand(body_rate_rad_s=wanted, thrust_n=jnp.float32(weight(world)))
    _, tracks = fly(world, up, (every(command), stay(world, start)[1]), 1.0)
    np.testing.assert_allclose(tracks[0].angular_velocity_rad_s[-1], np.tile(wanted, (UAVS, 1)), atol=0.03)
    np.testing.assert_allclose(tracks[0].position_m[-1, :, 2], 12.0, atol=0.1)
    roll = BodyRateCommand(body_rate_rad_s=jnp.array([0.4, 0.0, 0.0]), thrust_n=jnp.float32(weight(world)))
    _, tracks = fly(world, up, (every(roll), stay(world, start)[1]), 0.5)
    # The rotors' inflow resists a roll, and the integral makes it good within a second.
    np.testing.assert_allclose(tracks[0].angular_velocity_rad_s[-1, :, 0], 0.4, atol=0.05)


def test_rotor_speeds_at_hover_keep_the_height_and_faster_ones_climb(world, start):
    up = airborne(world, start, HIGH)
    hover = up.groups[0].vehicle.rotor_speed_rad_s
    share = jnp.array([1.0, 1.0, 1.05, 0.95, 0.0])[:, None]
    command = RotorSpeedCommand(rotor_speed_rad_s=share * hover)
    state, tracks = fly(world, up, (command, stay(world, start)[1]), 1.0)
    rise = tracks[0].position_m[-1, :, 2] - 12.0
    np.testing.assert_allclose(rise[:2], 0.0, atol=0.01)
    assert 0.3 < rise[2] < 0.55  # (1.05^2 - 1) g / 2, less the lag
    assert -0.55 < rise[3] < -0.3
    assert -5.0 < rise[4] < -4.0  # in free fall, less the drag and the rotors' running down
    np.testing.assert_allclose(state.groups[0].vehicle.rotor_speed_rad_s[:4], command.rotor_speed_rad_s[:4], rtol=1e-3)


def test_vehicles_of_a_group_may_be_commanded_at_different_levels(world, start):
    up, rover = airborne(world, start, HIGH), stay(world, start)[1]
    hover = up.groups[0].vehicle.rotor_speed_rad_s[0]
    force = jnp.float32(weight(world))
    levels = [
        go_to(jnp.asarray(HIGH[0]) + 1.0),
        AttitudeCommand(quaternion=jnp.asarray(tilted(0.1, 0)), thrust_n=force),
        BodyRateCommand(body_rate_rad_s=jnp.array([0.0, 0.1, 0.2]), thrust_n=force),
        RotorSpeedCommand(rotor_speed_rad_s=1.02 * hover),
        fly_velocity(jnp.array([0.5, 0.0, 0.0])),
    ]
    alike = [full_command(world, 0, every(command)) for command in levels]
    mixed = rows([jax.tree.map(lambda x, k=k: x[k], command) for k, command in enumerate(alike)])
    _, together = fly(world, up, (mixed, rover), 0.5)
    for k, command in enumerate(alike):
        _, alone = fly(world, up, (command, rover), 0.5)
        np.testing.assert_array_equal(together[0].position_m[:, k], alone[0].position_m[:, k])
        np.testing.assert_array_equal(together[0].quaternion[:, k], alone[0].quaternion[:, k])
    ends = together[0].quaternion[-1]
    assert len({tuple(np.round(q, 3)) for q in ends}) == UAVS


def test_a_rover_takes_its_three_levels(world, start):
    uavs = stay(world, start)[0]
    first = np.asarray(start.groups[1].vehicle.body.position_m)
    to = DriveToCommand(position_m=jnp.asarray(first[:, :2] + [3.0, 1.0]), speed_m_s=jnp.full(ROVERS, 1.0))
    _, tracks = fly(world, start, (uavs, to), 8.0)
    np.testing.assert_allclose(tracks[1].position_m[-1, :, :2], first[:, :2] + [3.0, 1.0], atol=0.1)
    assert np.linalg.norm(tracks[1].velocity_m_s[..., :2], axis=-1).max() < 1.1
    turning = rows(
        [
            skid_steer_command(DriveCommand(speed_m_s=jnp.float32(0.6), yaw_rate_rad_s=jnp.float32(0.3))),
            skid_steer_command(WheelSpeedCommand(wheel_speed_rad_s=jnp.full(4, 4.0))),
        ]
    )
    _, tracks = fly(world, start, (uavs, turning), 3.0)
    speed = np.linalg.norm(tracks[1].velocity_m_s[-1, :, :2], axis=-1)
    radius = float(world.groups[1].params.wheel_radius_m[1])
    np.testing.assert_allclose(speed, [0.6, 4.0 * radius], rtol=0.08)
    np.testing.assert_allclose(tracks[1].angular_velocity_rad_s[-1, :, 2], [0.3, 0.0], atol=0.03)
    moved = tracks[1].position_m[-1, 1] - first[1]
    assert abs(moved[1]) < 0.02  # straight ahead, to the east


def test_hold_brakes_and_hovers(world, start):
    up = airborne(world, start, HIGH, velocity_m_s=(2.0, 0.0, 0.0))
    commands = hold(world, up)
    _, tracks = fly(world, up, commands, 6.0)
    assert np.abs(tracks[0].velocity_m_s[-1]).max() < 0.05
    assert np.linalg.norm(tracks[0].position_m - HIGH, axis=-1).max() < 1.5


def test_vehicles_that_are_not_active_rest_bit_exactly(world, start):
    active = jnp.array([True, False, True, False, True])
    up = with_group(airborne(world, start, HIGH, velocity_m_s=(1.0, 0.0, 0.0)), 0, active=active)
    commands = (jax.vmap(go_to)(jnp.asarray(HIGH) + 2.0), stay(world, start)[1])
    state, _ = fly(world, up, commands, 1.0)
    before, after = up.groups[0], state.groups[0]
    for old, new in zip(
        jax.tree.leaves((before.vehicle, before.control)), jax.tree.leaves((after.vehicle, after.control)), strict=True
    ):
        np.testing.assert_array_equal(np.asarray(new)[1::2], np.asarray(old)[1::2])
    assert np.all(np.abs(after.vehicle.body.position_m[::2, 0] - HIGH[::2, 0]) > 0.1)
    assert happened(state, 0) == [set()] * UAVS


def test_a_group_that_does_not_run_is_left_as_it_is(world, start):
    halted = replace(start, clock=replace(start.clock, running=jnp.array([True, False])))
    drive = DriveCommand(speed_m_s=jnp.ones(ROVERS), yaw_rate_rad_s=jnp.zeros(ROVERS))
    commands = (
        jax.vmap(go_to)(start.groups[0].vehicle.body.position_m + 3.0),
        full_commands(world, (hold(world, start)[0], drive))[1],
    )
    state, _ = fly(world, halted, commands, 1.0)
    assert_same(state.groups[1].vehicle, start.groups[1].vehicle)
    assert np.all(state.groups[0].vehicle.body.position_m[:, 2] > 0.5)


@pytest.mark.parametrize("level", ["position", "yaw", "acceleration", "rotor speed"])
def test_a_non_finite_command_stops_its_vehicle_and_no_other(world, start, level):
    up, rover = airborne(world, start, HIGH, velocity_m_s=(0.5, 0.0, 0.0)), stay(world, start)[1]
    fine = full_command(world, 0, jax.vmap(go_to)(jnp.asarray(HIGH) + 1.0))
    if level == "position":
        broken = replace(fine, position_m=fine.position_m.at[2, 1].set(jnp.nan))
    elif level == "yaw":
        broken = replace(fine, yaw_rad=fine.yaw_rad.at[2].set(jnp.nan))
    elif level == "acceleration":
        broken = replace(fine, acceleration_m_s2=fine.acceleration_m_s2.at[2, 2].set(jnp.inf))
    else:
        speeds = up.groups[0].vehicle.rotor_speed_rad_s.at[2, 1].set(jnp.nan)
        bad = full_command(world, 0, RotorSpeedCommand(rotor_speed_rad_s=speeds))
        broken = jax.tree.map(lambda a, b: a.at[2].set(b[2]), fine, bad)
    before, _ = fly(world, up, (fine, rover), 0.2)
    state, _ = fly(world, before, (broken, rover), 0.2)
    state, _ = fly(world, state, (fine, rover), 0.2)  # sound commands do not bring it back
    other, _ = fly(world, before, (fine, rover), 0.4)
    assert happened(state, 0) == [set(), set(), {"non_finite"}, set(), set()]
    assert happened(state, 1) == [set()] * ROVERS
    assert float(state.groups[0].event_time_s[2].min()) <= 0.25 + 1e-6
    kept = [0, 1, 3, 4]
    for now, held, free in zip(
        *(jax.tree.leaves((s.groups[0].vehicle, s.groups[0].control)) for s in (state, before, other)), strict=True
    ):
        assert np.isfinite(now).all()
        np.testing.assert_array_equal(np.asarray(now)[2], np.asarray(held)[2])
        np.testing.assert_array_equal(np.asarray(now)[kept], np.asarray(free)[kept])


@pytest.mark.parametrize("field", ["speed_m_s", "yaw_rate_rad_s"])
def test_a_rover_with_a_non_finite_command_is_stopped(world, start, field):
    up, _ = stay(world, start)
    drive = full_command(world, 1, DriveCommand(speed_m_s=jnp.full(ROVERS, 0.5), yaw_rate_rad_s=jnp.zeros(ROVERS)))
    broken = replace(drive, **{field: getattr(drive, field).at[0].set(jnp.nan)})
    state, _ = fly(world, start, (up, broken), 0.2)
    assert happened(state, 1) == [{"non_finite"}, *[set()] * (ROVERS - 1)]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.groups[1].vehicle))


def test_each_level_may_be_given_to_step_as_it_is(world, start):
    zero = jnp.zeros((UAVS, 3))
    of_uavs = (
        PositionCommand(position_m=zero, velocity_m_s=zero, acceleration_m_s2=zero, yaw_rad=jnp.zeros(UAVS)),
        AttitudeCommand(quaternion=jnp.zeros((UAVS, 4)), thrust_n=jnp.zeros(UAVS)),
        BodyRateCommand(body_rate_rad_s=zero, thrust_n=jnp.zeros(UAVS)),
        RotorSpeedCommand(rotor_speed_rad_s=jnp.zeros((UAVS, 4))),
    )
    of_rovers = (
        DriveToCommand(position_m=jnp.zeros((ROVERS, 2)), speed_m_s=jnp.ones(ROVERS)),
        DriveCommand(speed_m_s=jnp.ones(ROVERS), yaw_rate_rad_s=jnp.zeros(ROVERS)),
        WheelSpeedCommand(wheel_speed_rad_s=jnp.zeros((ROVERS, 4))),
    )
    for number, command in enumerate(of_uavs):
        (full, rover) = full_commands(world, (command, of_rovers[number % 3]))
        assert isinstance(full, PositionCommand) or np.all(np.asarray(full.level) == number)
        np.testing.assert_array_equal(rover.level, number % 3)
    state, readings = jax.eval_shape(partial(step, world), start, (of_uavs[1], of_rovers[2]))
    assert jax.tree.map(jnp.shape, state) == jax.tree.map(jnp.shape, start)
    assert [r.counts.shape for r in readings] == [(UAVS,), (ROVERS,)]


ZEROS = jnp.zeros(UAVS)
SIX_SPEEDS = jnp.zeros((UAVS, 6))
WRONG = {
    "too few": (lambda u, r: (u,), ValueError, "there are 1 commands for 2 groups of vehicles"),
    "not a sequence": (lambda u, r: u, TypeError, "a sequence with one command for each group, not a PositionCommand"),
    "array": (lambda u, r: (u.position_m, r), TypeError, "one of the classes of swarmsim.control.commands"),
    "dictionary": (lambda u, r: ({}, r), TypeError, "the command of group 0 is a dict"),
    "none": (lambda u, r: (u, None), TypeError, "the command of group 1 is a NoneType"),
    "number of vehicles": (
        lambda u, r: (jax.tree.map(lambda x: x[:3], u), r),
        ValueError,
        "the group has 5 vehicles, so its first axis must be 5",
    ),
    "of one vehicle": (
        lambda u, r: (go_to(jnp.zeros(3)), r),
        ValueError,
        r"PositionCommand.position_m for group 0 has the shape \(3,\)",
    ),
    "place in the plane": (
        lambda u, r: (replace(u, position_m=jnp.zeros((UAVS, 2))), r),
        TypeError,
        r"PositionCommand.position_m of one multirotor has the shape \(2,\), it must be \(3,\)",
    ),
    "one number for a place": (
        lambda u, r: (replace(u, position_m=0.0), r),
        TypeError,
        r"has the shape \(\), it must be \(3,\)",
    ),
    "six rotors": (
        lambda u, r: (RotorSpeedCommand(rotor_speed_rad_s=SIX_SPEEDS), r),
        TypeError,
        r"has the shape \(6,\), it must be \(4,\)",
    ),
    "six rotors among all levels": (
        lambda u, r: (replace(every_level(u), rotor_speed_rad_s=SIX_SPEEDS), r),
        TypeError,
        r"MultirotorCommand.rotor_speed_rad_s of one multirotor has the shape \(6,\)",
    ),
    "a rover's to a multirotor": (
        lambda u, r: (DriveCommand(speed_m_s=ZEROS, yaw_rate_rad_s=ZEROS), r),
        TypeError,
        "a multirotor is commanded by one of PositionCommand, .*, not by DriveCommand",
    ),
    "a multirotor's to a rover": (
        lambda u, r: (u, jax.tree.map(lambda x: x[:ROVERS], u)),
        TypeError,
        "a skid-steer rover is commanded by one of DriveToCommand, .*, not by PositionCommand",
    ),
}


def every_level(command):
    return jax.vmap(partial(multirotor_command, rotors=4))(command)


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_command_is_refused_with_a_sentence(world, start, case):
    made, error, message = WRONG[case]
    commands = made(*hold(world, start))
    with pytest.raises(error, match=message):
        full_commands(world, commands)


def test_a_wrong_command_is_refused_by_the_step(world, start):
    with pytest.raises(ValueError, match="there are 1 commands for 2 groups"):
        jax.eval_shape(partial(step, world), start, (hold(world, start)[0],))


def test_a_number_stands_for_all_vehicles(world, start):
    drive = DriveCommand(speed_m_s=0.5, yaw_rate_rad_s=0.0)
    (_, full) = full_commands(world, (hold(world, start)[0], drive))
    np.testing.assert_array_equal(full.speed_m_s, [0.5, 0.5])
    assert full.wheel_speed_rad_s.shape == (ROVERS, 4)
