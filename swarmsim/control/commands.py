"""What a policy may command: four levels for a multirotor, three for a skid-steer rover.

A policy returns one of the small classes below; the step works on `MultirotorCommand` and `SkidSteerCommand`, which
hold every level side by side with the one that counts, so that vehicles of one group may be commanded at different
levels. World ENU, body FLU, SI units; one vehicle.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree

T = TypeVar("T")

POSITION, ATTITUDE, BODY_RATE, ROTOR_SPEED = range(4)
"""Levels of a `MultirotorCommand`."""
DRIVE_TO, DRIVE, WHEEL_SPEED = range(3)
"""Levels of a `SkidSteerCommand`."""


@pytree
class PositionCommand:
    """Where a multirotor should be, with velocity and acceleration fed forward."""

    position_m: jax.Array  # [3] m, world
    velocity_m_s: jax.Array  # [3] m/s, world
    acceleration_m_s2: jax.Array  # [3] m/s^2, world
    yaw_rad: jax.Array  # [] rad, counter-clockwise from east
    hold_position: jax.Array | float = 1.0  # [] 1: correct the position error; 0: track velocity and acceleration alone


@pytree
class AttitudeCommand:
    """Attitude and collective thrust of a multirotor."""

    quaternion: jax.Array  # [4] w x y z, body to world
    thrust_n: jax.Array  # [] N, along body z


@pytree
class BodyRateCommand:
    """Body rates and collective thrust of a multirotor."""

    body_rate_rad_s: jax.Array  # [3] rad/s, body
    thrust_n: jax.Array  # [] N, along body z


@pytree
class RotorSpeedCommand:
    """Speed of each rotor; zero or less disarms it."""

    rotor_speed_rad_s: jax.Array  # [R] rad/s


@pytree
class MultirotorCommand:
    """All four levels, and which of them counts."""

    level: jax.Array  # [] int32: POSITION, ATTITUDE, BODY_RATE or ROTOR_SPEED
    position_m: jax.Array  # [3] m, world
    velocity_m_s: jax.Array  # [3] m/s, world
    acceleration_m_s2: jax.Array  # [3] m/s^2, world
    yaw_rad: jax.Array  # [] rad, counter-clockwise from east
    hold_position: jax.Array  # [] 1: correct the position error; 0: track velocity and acceleration alone
    quaternion: jax.Array  # [4] w x y z, body to world
    body_rate_rad_s: jax.Array  # [3] rad/s, body
    thrust_n: jax.Array  # [] N, along body z
    rotor_speed_rad_s: jax.Array  # [R] rad/s


@pytree
class DriveToCommand:
    """A point that a rover should pursue, no faster than a speed."""

    position_m: jax.Array  # [2] m, world
    speed_m_s: jax.Array  # [] m/s


@pytree
class DriveCommand:
    """Speed and yaw rate of a rover."""

    speed_m_s: jax.Array  # [] m/s, ahead
    yaw_rate_rad_s: jax.Array  # [] rad/s, counter-clockwise


@pytree
class WheelSpeedCommand:
    """Speed of each wheel of a rover: front left, front right, rear left, rear right."""

    wheel_speed_rad_s: jax.Array  # [4] rad/s


@pytree
class SkidSteerCommand:
    """All three levels, and which of them counts."""

    level: jax.Array  # [] int32: DRIVE_TO, DRIVE or WHEEL_SPEED
    position_m: jax.Array  # [2] m, world
    speed_m_s: jax.Array  # [] m/s: of the pursuit, or ahead
    yaw_rate_rad_s: jax.Array  # [] rad/s, counter-clockwise
    wheel_speed_rad_s: jax.Array  # [4] rad/s


def go_to(
    position_m: jax.Array,
    yaw_rad: jax.Array | float = 0.0,
    velocity_m_s: jax.Array | None = None,
    acceleration_m_s2: jax.Array | None = None,
) -> PositionCommand:
    """Command of a multirotor to a position [3] m (world), with a velocity and an acceleration [3] fed forward."""
    position = jnp.asarray(position_m, jnp.float32)
    zero = jnp.zeros_like(position)
    return PositionCommand(
        position_m=position,
        velocity_m_s=zero if velocity_m_s is None else velocity_m_s,
        acceleration_m_s2=zero if acceleration_m_s2 is None else acceleration_m_s2,
        yaw_rad=jnp.asarray(yaw_rad, jnp.float32),
        hold_position=jnp.ones(()),
    )


def fly_velocity(velocity_m_s: jax.Array, yaw_rad: jax.Array | float = 0.0) -> PositionCommand:
    """Command of a multirotor to a velocity [3] m/s (world)."""
    velocity = jnp.asarray(velocity_m_s, jnp.float32)
    zero = jnp.zeros_like(velocity)
    yaw = jnp.asarray(yaw_rad, jnp.float32)
    return PositionCommand(
        position_m=zero, velocity_m_s=velocity, acceleration_m_s2=zero, yaw_rad=yaw, hold_position=jnp.zeros(())
    )


def multirotor_command(command: object, rotors: int) -> MultirotorCommand:
    """The full command [one vehicle] of what a policy returned; ``rotors`` is the number of rotors.

    Raises TypeError for anything that does not command a multirotor, and for a wrong shape.
    """
    zero3 = jnp.zeros(3)
    level: dict[type, int] = {PositionCommand: POSITION, AttitudeCommand: ATTITUDE, BodyRateCommand: BODY_RATE}
    whole = MultirotorCommand(
        level=jnp.int32(level.get(type(command), ROTOR_SPEED)),
        position_m=zero3,
        velocity_m_s=zero3,
        acceleration_m_s2=zero3,
        yaw_rad=jnp.zeros(()),
        hold_position=jnp.zeros(()),
        quaternion=jnp.array([1.0, 0.0, 0.0, 0.0]),
        body_rate_rad_s=zero3,
        thrust_n=jnp.zeros(()),
        rotor_speed_rad_s=jnp.zeros(rotors),
    )
    return _filled(whole, command, (PositionCommand, AttitudeCommand, BodyRateCommand, RotorSpeedCommand), "multirotor")


def skid_steer_command(command: object) -> SkidSteerCommand:
    """The full command [one vehicle] of what a policy returned.

    Raises TypeError for anything that does not command a skid-steer rover, and for a wrong shape.
    """
    level: dict[type, int] = {DriveToCommand: DRIVE_TO, DriveCommand: DRIVE}
    whole = SkidSteerCommand(
        level=jnp.int32(level.get(type(command), WHEEL_SPEED)),
        position_m=jnp.zeros(2),
        speed_m_s=jnp.zeros(()),
        yaw_rate_rad_s=jnp.zeros(()),
        wheel_speed_rad_s=jnp.zeros(4),
    )
    return _filled(whole, command, (DriveToCommand, DriveCommand, WheelSpeedCommand), "skid-steer rover")


def _filled(whole: T, command: object, classes: tuple[type, ...], kind: str) -> T:
    classes = (*classes, type(whole))
    if not isinstance(command, classes):
        names = ", ".join(c.__name__ for c in classes)
        raise TypeError(f"a {kind} is commanded by one of {names}, not by {type(command).__name__}")
    given = vars(command)
    fields = {}
    for name, default in vars(whole).items():
        value = jnp.asarray(given.get(name, default), default.dtype)
        if value.shape != default.shape:
            raise TypeError(
                f"{type(command).__name__}.{name} of one {kind} has the shape {value.shape}, it must be {default.shape}"
            )
        fields[name] = value
    return type(whole)(**fields)
