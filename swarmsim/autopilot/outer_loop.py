"""From positions and velocities to what a vehicle without setpoints takes: tilt, climb rate and turn rate.

Used by the links to vehicles that are flown by sticks (AR.Drone, Pelican). World ENU, heading counter-clockwise from
east, SI units.
"""

import math
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from swarmsim.autopilot.link import Setpoint, Telemetry, Vector
from swarmsim.config.base import Gain, Model, Speed

GRAVITY_M_S2 = 9.80665  # standard gravity, BIPM (2019)
_STEP_MAX_S = 0.2  # a longer pause is not integrated over

Angle = Annotated[float, Field(gt=0, le=60)]  # deg
TurnRate = Annotated[float, Field(gt=0, le=720)]  # deg/s
Integral = Annotated[float, Field(ge=0, le=100)]


class LoopSettings(Model):
    """Gains and limits of the loop: a position error makes a velocity, a velocity error an acceleration.

    ``height_gain_1_s`` makes a climb rate of a height error, ``yaw_gain_1_s`` a turn rate of a heading error.
    """

    position_gain_1_s: Gain
    velocity_gain_1_s: Gain
    velocity_integral_1_s2: Integral
    height_gain_1_s: Gain
    yaw_gain_1_s: Gain
    speed_max_m_s: Speed
    climb_max_m_s: Speed
    tilt_max_deg: Angle
    turn_max_deg_s: TurnRate


@dataclass(frozen=True)
class Demand:
    """What the vehicle is to do in the next period."""

    velocity_m_s: Vector  # world, position error included; its third component is the climb rate
    acceleration_m_s2: tuple[float, float]  # world, level
    turn_rad_s: float  # counter-clockwise seen from above

    def level_velocity(self, yaw_rad: float) -> tuple[float, float]:
        """Velocity forward and to the left of a vehicle with that heading."""
        return _turned(self.velocity_m_s[0], self.velocity_m_s[1], -yaw_rad)

    def tilt(self, yaw_rad: float) -> tuple[float, float]:
        """Tilt [rad] forward (nose down) and to the left that gives the acceleration in level flight."""
        forward, left = _turned(*self.acceleration_m_s2, -yaw_rad)
        return math.atan2(forward, GRAVITY_M_S2), math.atan2(left, GRAVITY_M_S2)


class OuterLoop:
    """The loop of one vehicle; it has a state: the integral of the velocity error, and the heading that is kept."""

    def __init__(self, settings: LoopSettings):
        """At rest, without a heading to keep."""
        self.settings = settings
        self._acceleration_max = GRAVITY_M_S2 * math.tan(math.radians(settings.tilt_max_deg))
        self.reset()

    def reset(self) -> None:
        """Forget the integral and the heading: the vehicle was flown by somebody else."""
        self._integral = (0.0, 0.0)
        self._kept_yaw_rad: float | None = None

    def step(self, setpoint: Setpoint, now: Telemetry, yaw_rad: float, dt_s: float) -> Demand:
        """What the setpoint demands of a vehicle in the state ``now``, ``dt_s`` after the last step.

        Raises ValueError where the setpoint needs a position or velocity that the vehicle does not tell.
        """
        if now.velocity_m_s is None or (setpoint.position_m is not None and now.position_m is None):
            raise ValueError("the vehicle tells no position or velocity")
        dt = min(max(dt_s, 0.0), _STEP_MAX_S)
        velocity = self._velocity(setpoint, now, yaw_rad)
        fed = setpoint.acceleration_m_s2 or (0.0, 0.0, 0.0)
        acceleration = self._acceleration(velocity, now.velocity_m_s, fed, dt)
        return Demand(velocity, acceleration, self._turn(setpoint, yaw_rad))

    def _velocity(self, setpoint: Setpoint, now: Telemetry, yaw_rad: float) -> Vector:
        s = self.settings
        x, y, z = setpoint.velocity_m_s or (0.0, 0.0, 0.0)
        if setpoint.body:
            x, y = _turned(x, y, yaw_rad)
        if setpoint.position_m is not None and now.position_m is not None:
            dx, dy, dz = (a - b for a, b in zip(setpoint.position_m, now.position_m, strict=True))
            x, y, z = x + s.position_gain_1_s * dx, y + s.position_gain_1_s * dy, z + s.height_gain_1_s * dz
        x, y = _limited(x, y, s.speed_max_m_s)
        return x, y, max(-s.climb_max_m_s, min(s.climb_max_m_s, z))

    def _acceleration(self, wanted: Vector, has: Vector, fed: Vector, dt: float) -> tuple[float, float]:
        """The level acceleration; the integral stands still while the tilt is at its limit."""
        s = self.settings
        ex, ey = wanted[0] - has[0], wanted[1] - has[1]
        ix, iy = self._integral
        grown = ix + s.velocity_integral_1_s2 * ex * dt, iy + s.velocity_integral_1_s2 * ey * dt
        gain = s.velocity_gain_1_s
        ax, ay = fed[0] + gain * ex + grown[0], fed[1] + gain * ey + grown[1]
        if math.hypot(ax, ay) <= self._acceleration_max:
            self._integral = grown
        return _limited(ax, ay, self._acceleration_max)

    def _turn(self, setpoint: Setpoint, yaw_rad: float) -> float:
        if setpoint.yaw_rate_rad_s is not None:
            self._kept_yaw_rad = None
            turn = setpoint.yaw_rate_rad_s
        else:
            if setpoint.yaw_rad is not None:
                self._kept_yaw_rad = setpoint.yaw_rad
            elif self._kept_yaw_rad is None:
                self._kept_yaw_rad = yaw_rad
            error = self._kept_yaw_rad - yaw_rad
            turn = self.settings.yaw_gain_1_s * math.atan2(math.sin(error), math.cos(error))
        limit = math.radians(self.settings.turn_max_deg_s)
        return max(-limit, min(limit, turn))


def _turned(x: float, y: float, angle_rad: float) -> tuple[float, float]:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return c * x - s * y, s * x + c * y


def _limited(x: float, y: float, limit: float) -> tuple[float, float]:
    size = math.hypot(x, y)
    share = 1.0 if size <= limit else limit / size
    return share * x, share * y
