"""Setpoints to the fields of SET_POSITION_TARGET_LOCAL_NED, as each autopilot and vehicle takes them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swarmsim.autopilot.frames import Alignment, frd_of_flu, ned_of_enu, yaw_ned_of_enu
from swarmsim.autopilot.link import Setpoint, Vector
from swarmsim.autopilot.mavlink.profile import Profile

IGNORE_POSITION, IGNORE_VELOCITY, IGNORE_ACCELERATION = 0x007, 0x038, 0x1C0  # POSITION_TARGET_TYPEMASK
IGNORE_YAW, IGNORE_YAW_RATE = 0x400, 0x800
LARGEST = 1e6
"""Bound of every number of a setpoint, in m, m/s, m/s2 or rad: beyond it is a mistake."""
_ZERO: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Target:
    """Fields of SET_POSITION_TARGET_LOCAL_NED: NED or FRD by ``frame``, SI; what the mask ignores is zero."""

    frame: int
    mask: int
    position: Vector = _ZERO
    velocity: Vector = _ZERO
    acceleration: Vector = _ZERO
    yaw: float = 0.0  # clockwise from north
    yaw_rate: float = 0.0  # clockwise seen from above


def encode(setpoint: Setpoint, profile: Profile, alignment: Alignment) -> Target:
    """The fields for ``setpoint``; ``alignment`` leads from the world to the vehicle's local frame.

    A rover heads where it drives: yaw and yaw rate outside the body frame are not sent to it. Raises ValueError for
    a number that is not finite or beyond `LARGEST`, a combination that `Setpoint` rules out, and what the vehicle
    cannot do (a rover sideways; a PX4 rover backwards).
    """
    _check(setpoint)
    rover = profile.vehicle == "rover"
    if setpoint.body:
        return _rover_body(setpoint, profile) if rover else _copter_body(setpoint, profile)
    rules = profile.kind.setpoints
    if rover and setpoint.position_m is None and _level(setpoint.velocity_m_s) <= rules.still_m_s:
        return _rover_body(Setpoint(velocity_m_s=_ZERO, body=True), profile)
    mask = 0
    position = velocity = acceleration = _ZERO
    if setpoint.position_m is None:
        mask |= IGNORE_POSITION
    else:
        position = _vector(alignment.to_local(setpoint.position_m))
    both = setpoint.position_m is not None and setpoint.velocity_m_s is not None
    if setpoint.velocity_m_s is None or (both and not rules.position_with_velocity):
        mask |= IGNORE_VELOCITY
    else:
        velocity = _vector(ned_of_enu(setpoint.velocity_m_s))
    if setpoint.acceleration_m_s2 is None or not rules.acceleration or mask & IGNORE_VELOCITY:
        mask |= IGNORE_ACCELERATION
    else:
        acceleration = _vector(ned_of_enu(setpoint.acceleration_m_s2))
    heading, yaw, yaw_rate = _heading(setpoint, profile)
    return Target(rules.frame_local, mask | heading, position, velocity, acceleration, yaw, yaw_rate)


def _heading(setpoint: Setpoint, profile: Profile) -> tuple[int, float, float]:
    """Mask bits, yaw and yaw rate (clockwise)."""
    kept_by = profile.kind.setpoints.heading_kept_by
    if kept_by == "motion":
        return IGNORE_YAW | IGNORE_YAW_RATE, 0.0, 0.0
    if setpoint.yaw_rad is not None:
        return IGNORE_YAW_RATE, yaw_ned_of_enu(setpoint.yaw_rad), 0.0
    if setpoint.yaw_rate_rad_s is not None:
        return IGNORE_YAW, 0.0, -setpoint.yaw_rate_rad_s
    return (IGNORE_YAW if kept_by == "zero_rate" else IGNORE_YAW | IGNORE_YAW_RATE), 0.0, 0.0


def _copter_body(setpoint: Setpoint, profile: Profile) -> Target:
    rules = profile.kind.setpoints
    mask, acceleration = IGNORE_POSITION | IGNORE_ACCELERATION, _ZERO
    if setpoint.acceleration_m_s2 is not None and rules.acceleration:
        mask, acceleration = IGNORE_POSITION, _vector(frd_of_flu(setpoint.acceleration_m_s2))
    heading, yaw, yaw_rate = _heading(setpoint, profile)
    velocity = _vector(frd_of_flu(setpoint.velocity_m_s or _ZERO))
    return Target(rules.frame_body, mask | heading, _ZERO, velocity, acceleration, yaw, yaw_rate)


def _rover_body(setpoint: Setpoint, profile: Profile) -> Target:
    """Forward speed and yaw rate of a rover."""
    rules = profile.kind.setpoints
    forward, left, _ = setpoint.velocity_m_s or _ZERO
    rate = -(setpoint.yaw_rate_rad_s or 0.0)  # clockwise
    if abs(left) > 1e-6:
        raise ValueError(f"a rover cannot drive sideways (velocity {left} m/s to the left)")
    if forward < 0.0 and not rules.reverse:
        raise ValueError(f"a {profile.autopilot.name} rover cannot be driven backwards ({forward} m/s)")
    mask = IGNORE_POSITION | IGNORE_ACCELERATION | IGNORE_YAW
    if rules.turns_by == "rate":
        return Target(rules.frame_body, mask, velocity=(forward, 0.0, 0.0), yaw_rate=rate)
    # It turns to the direction of its velocity, which must not vanish: that of zero is north.
    speed = max(forward, rules.still_m_s)
    turn = min(max(rate / rules.turn_gain_1_s, -math.pi / 2), math.pi / 2)
    velocity = (speed * math.cos(turn), speed * math.sin(turn), 0.0)
    return Target(rules.frame_body, mask | IGNORE_YAW_RATE, velocity=velocity)


def _check(setpoint: Setpoint) -> None:
    for name in ("position_m", "velocity_m_s", "acceleration_m_s2", "yaw_rad", "yaw_rate_rad_s"):
        value = getattr(setpoint, name)
        if value is None:
            continue
        numbers: Sequence[float] | np.ndarray = value if isinstance(value, Sequence | np.ndarray) else (value,)
        if len(numbers) != (1 if name.startswith("yaw") else 3):
            raise ValueError(f"{name} has {len(numbers)} numbers: {value}")
        if not all(abs(float(number)) <= LARGEST for number in numbers):  # false for NaN
            raise ValueError(f"{name} is not finite, or beyond {LARGEST:g}: {value}")
    if setpoint.position_m is None and setpoint.velocity_m_s is None:
        raise ValueError("a setpoint needs a position or a velocity")
    if setpoint.acceleration_m_s2 is not None and setpoint.velocity_m_s is None:
        raise ValueError("an acceleration is fed forward beside a velocity: give the velocity too")
    if setpoint.yaw_rad is not None and setpoint.yaw_rate_rad_s is not None:
        raise ValueError("a setpoint has a yaw or a yaw rate, not both")
    if setpoint.body and setpoint.position_m is not None:
        raise ValueError("a setpoint in the body frame has no position")
    if setpoint.body and setpoint.yaw_rad is not None:
        raise ValueError("a setpoint in the body frame has a yaw rate, not a yaw")


def _level(velocity: Vector | None) -> float:
    return math.inf if velocity is None else math.hypot(velocity[0], velocity[1])


def _vector(values: Sequence[float] | np.ndarray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
