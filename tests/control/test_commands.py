"""Commands of every level: how they are made, written out, and refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.control.commands import (
    ATTITUDE,
    BODY_RATE,
    DRIVE,
    DRIVE_TO,
    POSITION,
    ROTOR_SPEED,
    WHEEL_SPEED,
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

ONE = jnp.ones(())
UPRIGHT = jnp.array([1.0, 0.0, 0.0, 0.0])
FLOWN = [
    (POSITION, go_to(jnp.array([1.0, 2.0, 3.0]), 0.5)),
    (ATTITUDE, AttitudeCommand(quaternion=UPRIGHT, thrust_n=20.0 * ONE)),
    (BODY_RATE, BodyRateCommand(body_rate_rad_s=jnp.array([0.1, 0.2, 0.3]), thrust_n=20.0 * ONE)),
    (ROTOR_SPEED, RotorSpeedCommand(rotor_speed_rad_s=jnp.full(6, 300.0))),
]
DRIVEN = [
    (DRIVE_TO, DriveToCommand(position_m=jnp.array([1.0, 2.0]), speed_m_s=ONE)),
    (DRIVE, DriveCommand(speed_m_s=ONE, yaw_rate_rad_s=0.2 * ONE)),
    (WHEEL_SPEED, WheelSpeedCommand(wheel_speed_rad_s=jnp.arange(4.0))),
]


def assert_written_out(whole, level, command):
    assert int(whole.level) == level
    for name, value in vars(whole).items():
        if name in vars(command):
            np.testing.assert_array_equal(value, getattr(command, name))
        elif name == "quaternion":
            np.testing.assert_array_equal(value, UPRIGHT)
        elif name != "level":
            np.testing.assert_array_equal(value, 0.0)


@pytest.mark.parametrize(("level", "command"), FLOWN)
def test_a_multirotors_command_is_written_out(level, command):
    whole = multirotor_command(command, 6)
    assert_written_out(whole, level, command)
    assert whole.rotor_speed_rad_s.shape == (6,)
    jax.tree.map(np.testing.assert_array_equal, multirotor_command(whole, 6), whole)


@pytest.mark.parametrize(("level", "command"), DRIVEN)
def test_a_rovers_command_is_written_out(level, command):
    whole = skid_steer_command(command)
    assert_written_out(whole, level, command)
    jax.tree.map(np.testing.assert_array_equal, skid_steer_command(whole), whole)


def test_commands_of_different_levels_have_one_structure():
    for commands, write in ((FLOWN, lambda c: multirotor_command(c, 6)), (DRIVEN, skid_steer_command)):
        wholes = [write(command) for _, command in commands]
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *wholes)
        np.testing.assert_array_equal(stacked.level, [level for level, _ in commands])
        assert len({tuple((x.shape, str(x.dtype)) for x in jax.tree.leaves(whole)) for whole in wholes}) == 1


def test_going_to_a_place_corrects_the_position_and_feeds_forward():
    plain = go_to([1, 2, 3])
    np.testing.assert_array_equal(plain.position_m, [1.0, 2.0, 3.0])
    assert plain.position_m.dtype == jnp.float32
    for zero in (plain.velocity_m_s, plain.acceleration_m_s2, plain.yaw_rad):
        np.testing.assert_array_equal(zero, 0.0)
    assert float(plain.hold_position) == 1.0
    ahead = go_to(jnp.zeros(3), 0.3, velocity_m_s=jnp.ones(3), acceleration_m_s2=2.0 * jnp.ones(3))
    np.testing.assert_array_equal(ahead.velocity_m_s, 1.0)
    np.testing.assert_array_equal(ahead.acceleration_m_s2, 2.0)
    assert float(ahead.yaw_rad) == pytest.approx(0.3)


def test_flying_a_velocity_leaves_the_position_alone():
    command = fly_velocity([1.0, 0.0, -0.5], 0.3)
    np.testing.assert_array_equal(command.velocity_m_s, [1.0, 0.0, -0.5])
    assert float(command.hold_position) == 0.0
    assert float(command.yaw_rad) == pytest.approx(0.3)
    whole = multirotor_command(command, 4)
    assert (int(whole.level), float(whole.hold_position)) == (POSITION, 0.0)


def test_a_position_command_holds_the_position_unless_told_otherwise():
    zero = jnp.zeros(3)
    command = PositionCommand(position_m=zero, velocity_m_s=zero, acceleration_m_s2=zero, yaw_rad=jnp.zeros(()))
    assert float(multirotor_command(command, 4).hold_position) == 1.0


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (DRIVEN[1][1], "a multirotor is commanded by one of PositionCommand, AttitudeCommand, .*, not by DriveCommand"),
        (jnp.zeros(3), "not by ArrayImpl"),
        (None, "not by NoneType"),
        (go_to(jnp.zeros(2)), r"PositionCommand.position_m of one multirotor has the shape \(2,\), it must be \(3,\)"),
        (AttitudeCommand(quaternion=UPRIGHT, thrust_n=jnp.zeros(1)), r"AttitudeCommand.thrust_n .* it must be \(\)"),
        (FLOWN[3][1], r"RotorSpeedCommand.rotor_speed_rad_s .* shape \(6,\), it must be \(4,\)"),
        (multirotor_command(FLOWN[3][1], 6), r"MultirotorCommand.rotor_speed_rad_s .* it must be \(4,\)"),
    ],
)
def test_what_does_not_command_a_quadrotor_is_refused(command, message):
    with pytest.raises(TypeError, match=message):
        multirotor_command(command, 4)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (FLOWN[0][1], "a skid-steer rover is commanded by one of DriveToCommand, DriveCommand, .* not by Position"),
        (DriveToCommand(position_m=jnp.zeros(3), speed_m_s=ONE), r"DriveToCommand.position_m .* it must be \(2,\)"),
        (WheelSpeedCommand(wheel_speed_rad_s=ONE), r"WheelSpeedCommand.wheel_speed_rad_s of one skid-steer rover"),
    ],
)
def test_what_does_not_command_a_rover_is_refused(command, message):
    with pytest.raises(TypeError, match=message):
        skid_steer_command(command)
