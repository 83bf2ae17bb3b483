"""Setpoint messages as each autopilot reads them: which frames and masks it takes, and what then counts."""

import math
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from swarmsim.autopilot.frames import (
    Alignment,
    Geodetic,
    enu_of_geodetic,
    enu_of_ned,
    yaw_enu_of_ned,
    yaw_of_quaternion,
)
from swarmsim.autopilot.standin.body import Sensed

Axes = tuple[float | None, float | None, float | None]
Vector = tuple[float, float, float]
NOTHING: Axes = (None, None, None)

POSITION_BITS, VELOCITY_BITS, ACCELERATION_BITS = 0x007, 0x038, 0x1C0
YAW_BIT, YAW_RATE_BIT = 0x400, 0x800
FORCE_BIT = 0x200
YAW_RATE_MAX_RAD_S = 10.0
FAR_M = 1e6
"""Largest component of a target; the physics is in single precision."""


@dataclass(frozen=True)
class Target:
    """What to do now, world ENU. A component that is not commanded is None; one commanded as NaN stays NaN."""

    position_m: Axes = NOTHING
    velocity_m_s: Axes = NOTHING
    acceleration_m_s2: Axes = NOTHING
    yaw_rad: float | None = None
    yaw_rate_rad_s: float | None = None  # counter-clockwise
    ahead_m_s: float | None = None  # of a rover: speed in its own frame

    @property
    def has_position(self) -> bool:
        """Whether any axis of a position is commanded."""
        return any(x is not None for x in self.position_m)


class UnsupportedError(Exception):
    """The autopilot does not take this frame or mask."""


class KilledError(Exception):
    """ArduPilot's process dies: a floating-point exception."""


def read_px4(message: Any, sensed: Sensed, local: Alignment, origin: Geodetic, home_m: float) -> Target:
    """The target of a setpoint that PX4 takes; raises `UnsupportedError` for one that it drops."""
    mask = message.type_mask
    frame = message.coordinate_frame
    if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
        if frame not in (mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_NED):
            raise UnsupportedError(f"frame {frame}")
        body = frame == mav.MAV_FRAME_BODY_NED
        if body:
            mask |= POSITION_BITS
        position = (message.x, message.y, message.z)
    else:
        position, body = _global(message, local, origin, home_m), False
    target = _target(message, mask, position, local, _heading(sensed) if body else None)
    # a component that is no number is as one that the mask leaves out
    if not any(_number(x) for x in (*target.position_m, *target.velocity_m_s, *target.acceleration_m_s2)):
        raise UnsupportedError(f"type mask {mask:#x} commands nothing")
    if mask & FORCE_BIT and any(_number(x) for x in target.acceleration_m_s2):
        raise UnsupportedError("force")
    return target


def read_ardupilot(message: Any, sensed: Sensed, local: Alignment, origin: Geodetic, home_m: float) -> Target | None:
    """The target of a setpoint as ArduPilot's GUIDED takes it; None means stop.

    Raises `KilledError` for a position that is no number.
    """
    mask, frame = message.type_mask, message.coordinate_frame
    if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
        if frame not in (
            mav.MAV_FRAME_LOCAL_NED,
            mav.MAV_FRAME_LOCAL_OFFSET_NED,
            mav.MAV_FRAME_BODY_NED,
            mav.MAV_FRAME_BODY_OFFSET_NED,
        ):
            return None
        position = (message.x, message.y, message.z)
        turned = frame in (mav.MAV_FRAME_BODY_NED, mav.MAV_FRAME_BODY_OFFSET_NED)
        if frame != mav.MAV_FRAME_LOCAL_NED:
            heading = _heading(sensed) if turned else 0.0
            here = local.to_local(sensed.position_m)
            offset = _turn(position, heading)
            position = (float(here[0]) + offset[0], float(here[1]) + offset[1], float(here[2]) + offset[2])
    else:
        try:
            position, turned = _global(message, local, origin, home_m), False
        except UnsupportedError:
            return None
    has_position, has_velocity = not mask & POSITION_BITS, not mask & VELOCITY_BITS
    has_acceleration = not mask & ACCELERATION_BITS
    if has_position and any(map(math.isnan, position)):
        raise KilledError("floating point exception")
    if not has_position and not has_velocity and not has_acceleration:
        return None
    if has_position and has_acceleration and not has_velocity:
        return None
    keep = (POSITION_BITS if not has_position else 0) | (VELOCITY_BITS if not has_velocity else 0)
    keep |= (ACCELERATION_BITS if not has_acceleration else 0) | (mask & (YAW_BIT | YAW_RATE_BIT))
    given = (_components(message, "v") if has_velocity else ()) + (
        _components(message, "a") if has_acceleration else ()
    )
    if any(map(math.isnan, given)):
        return None
    return _target(message, keep, position, local, _heading(sensed) if turned else None)


def _components(message: Any, kind: str) -> Vector:
    names = ("vx", "vy", "vz") if kind == "v" else ("afx", "afy", "afz")
    x, y, z = (float(getattr(message, name)) for name in names)
    return x, y, z


def _number(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _heading(sensed: Sensed) -> float:
    """Heading clockwise from north."""
    return yaw_enu_of_ned(yaw_of_quaternion(sensed.quaternion))


def _turn(vector: Vector, heading_rad: float) -> Vector:
    """A vector forward-right-down as north-east-down."""
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    return c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]


def _global(message: Any, local: Alignment, origin: Geodetic, home_m: float) -> Vector:
    """Local NED position of a global setpoint; ``home_m`` is the altitude of the home."""
    relative = (mav.MAV_FRAME_GLOBAL_RELATIVE_ALT, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)
    absolute = (mav.MAV_FRAME_GLOBAL, mav.MAV_FRAME_GLOBAL_INT)
    frame = message.coordinate_frame
    if frame not in (*relative, *absolute):
        raise UnsupportedError(f"frame {frame}")
    altitude = message.alt + (home_m if frame in relative else 0.0)
    known = abs(altitude) < FAR_M
    place = Geodetic(message.lat_int * 1e-7, message.lon_int * 1e-7, altitude if known else home_m)
    north, east, down = local.to_local(enu_of_geodetic(place, origin))
    return float(north), float(east), float(down) if known else math.nan


def _target(message: Any, mask: int, position: Vector, local: Alignment, heading: float | None) -> Target:
    """The components that ``mask`` leaves; velocities are turned by ``heading`` where the frame is the body's."""
    velocity, acceleration = _components(message, "v"), _components(message, "a")
    yaw = float(message.yaw)
    if heading is not None:
        velocity, acceleration, yaw = _turn(velocity, heading), _turn(acceleration, heading), yaw + heading
    return Target(
        position_m=_kept(local.to_world(position), mask, 0),
        velocity_m_s=_kept(enu_of_ned(velocity), mask, 3),
        acceleration_m_s2=_kept(enu_of_ned(acceleration), mask, 6),
        yaw_rad=None if mask & YAW_BIT or not math.isfinite(yaw) else yaw_enu_of_ned(yaw),
        yaw_rate_rad_s=None if mask & YAW_RATE_BIT else _finite(-message.yaw_rate, YAW_RATE_MAX_RAD_S),
        ahead_m_s=None if heading is None or mask & 0x8 else _finite(message.vx, FAR_M),
    )


def _finite(value: float, limit: float) -> float | None:
    """A number within a limit; None for what is none."""
    return max(-limit, min(limit, value)) if math.isfinite(value) else None


def _kept(enu: Any, mask: int, shift: int) -> Axes:
    """Axes east, north, up of a vector whose bits north, east, down of the mask are not set."""
    north, east, down = (bool(mask >> (shift + k) & 1) for k in range(3))
    x, y, z = (max(-FAR_M, min(FAR_M, float(v))) if math.isfinite(v) else math.nan for v in enu)
    return None if east else x, None if north else y, None if down else z
