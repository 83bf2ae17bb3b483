"""What the stand-in flies by itself or when told: each activity turns the sensed state into a `Motion`. World ENU."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace

import numpy as np

from swarmsim.autopilot.frames import yaw_of_quaternion
from swarmsim.autopilot.standin.body import Array, Motion, Sensed
from swarmsim.autopilot.standin.settings import Manners
from swarmsim.autopilot.standin.targets import Target

STILL_M_S = 0.3
"""Speed below which braking has ended and the place is held."""
APPROACH_1_S = 1.0
"""Gain from a position error to a velocity, where only some axes of a position are commanded."""
TURN_1_S, TURN_RAD_S, TURN_FIRST_RAD = 2.0, 1.0, 1.0
"""Steering of a rover: gain and limit of the yaw rate, and the heading error from which it turns in place."""
SINK_M_S = 0.5
"""Descent that is commanded on the ground: it keeps the motors off."""
STOPS_M_S = 0.05
"""Commanded speed below which a rover stands."""

Vector = tuple[float, float, float]


def vector(x: Array) -> Vector:
    """Three numbers as a tuple."""
    return float(x[0]), float(x[1]), float(x[2])


@dataclass
class Activity(ABC):
    """One thing that the vehicle does; ``done`` when its end is reached."""

    settings: Manners
    flies: bool
    yaw_rad: float
    done: bool = False

    @abstractmethod
    def motion(self, sensed: Sensed, dt: float) -> Motion:
        """The command of the next ``dt`` s."""

    def at(self, position_m: Array, velocity_m_s: Vector = (0.0, 0.0, 0.0), speed_m_s: float = 1.0) -> Motion:
        """Be at a position, with a velocity fed forward; ``speed_m_s`` is a rover's limit."""
        return Motion(
            position_m=vector(position_m), velocity_m_s=velocity_m_s, yaw_rad=self.yaw_rad, hold_position=True,
            speed_m_s=speed_m_s,
        )  # fmt: skip

    def moving(self, velocity_m_s: Vector) -> Motion:
        """Have a velocity; a rover stands."""
        return Motion(velocity_m_s=velocity_m_s, yaw_rad=self.yaw_rad)


@dataclass
class Idle(Activity):
    """Stand on the ground with the motors idling."""

    def motion(self, sensed: Sensed, dt: float) -> Motion:
        """Press on the ground."""
        return self.moving((0.0, 0.0, -SINK_M_S))


@dataclass
class Hold(Activity):
    """Brake, then keep the place."""

    place_m: Array | None = None

    def motion(self, sensed: Sensed, dt: float) -> Motion:
        """Zero velocity until it is still, then its position."""
        if not self.flies:
            return self.moving((0.0, 0.0, 0.0))
        if self.place_m is None and float(np.linalg.norm(sensed.velocity_m_s)) < STILL_M_S:
            self.place_m = sensed.position_m
        return self.moving((0.0, 0.0, 0.0)) if self.place_m is None else self.at(self.place_m)


@dataclass
class TakeOff(Activity):
    """Climb straight up to ``top_m`` of the world."""

    top_m: float = 0.0
    start_m: Array | None = None

    def motion(self, sensed: Sensed, dt: float) -> Motion:
        """Climb at the speed of a take-off, and slower near the end."""
        if self.start_m is None:
            self.start_m = sensed.position_m
        left = self.top_m - float(sensed.position_m[2])
        self.done = left < self.settings.arrived_m
        climb = min(self.settings.take_off_speed_m_s, max(APPROACH_1_S * left, 0.3))
        if self.done:
            return self.at(np.array([*self.start_m[:2], self.top_m]))
        return self.at(np.array([*self.start_m[:2], sensed.position_m[2]]), (0.0, 0.0, climb))


@dataclass
class Land(Activity):
    """Descend where it is, or at ``place_m``; done when the ground holds it."""

    place_m: Array | None = None

    def motion(self, sensed: Sensed, dt: float) -> Motion:
        """Brake, then descend, slowly near the ground."""
        if not self.flies:
            self.done = True
            return self.moving((0.0, 0.0, 0.0))
        self.done = sensed.landed
        settings = self.settings
        if self.place_m is None:
            if float(np.linalg.norm(sensed.velocity_m_s[:2])) > STILL_M_S and not sensed.landed:
                return self.moving((0.0, 0.0, 0.0))
            self.place_m = sensed.position_m
        high = sensed.height_m > settings.land_low_m
        sink = settings.land_speed_high_m_s if high else settings.land_speed_m_s
        return self.at(np.array([*self.place_m[:2], sensed.position_m[2]]), (0.0, 0.0, -sink))


@dataclass
class Return(Activity):
    """Climb to ``cruise_m`` of the world, fly home, wait, land; a rover drives there and stands."""

    home_m: Array | None = None
    cruise_m: float = 0.0
    wait_s: float = 0.0
    landing: Land | None = None
    way_m: Array | None = None  # reference point under way

    def motion(self, sensed: Sensed, dt: float) -> Motion:
        """The next leg."""
        assert self.home_m is not None
        settings, home = self.settings, self.home_m
        if self.landing is not None:
            command = self.landing.motion(sensed, dt)
            self.done = self.landing.done
            return command
        to_go = home[:2] - sensed.position_m[:2]
        distance = float(np.hypot(*to_go))
        if not self.flies:
            self.done = distance < settings.arrived_m
            return self.moving((0.0, 0.0, 0.0)) if self.done else self.at(home, speed_m_s=settings.return_speed_m_s)
        if self.way_m is None:
            near = distance < 2.0 * settings.arrived_m
            self.way_m = sensed.position_m
            self.cruise_m = float(sensed.position_m[2]) if near else max(self.cruise_m, float(sensed.position_m[2]))
        goal = np.array([*home[:2], self.cruise_m])
        if self.cruise_m - sensed.position_m[2] > 1.0:
            goal[:2] = self.way_m[:2]
        self.way_m, velocity = _ahead(self.way_m, goal, settings.return_speed_m_s, settings.take_off_speed_m_s, dt)
        if distance < settings.arrived_m and abs(goal[2] - sensed.position_m[2]) < 1.0:
            self.wait_s -= dt
            if self.wait_s <= 0.0:
                self.landing = Land(settings, self.flies, self.yaw_rad, place_m=home)
        return self.at(self.way_m, velocity)


def _ahead(way_m: Array, goal_m: Array, speed_m_s: float, climb_m_s: float, dt: float) -> tuple[Array, Vector]:
    """The reference point ``dt`` s further on its way to the goal, and its velocity."""
    left = goal_m - way_m
    far = float(np.hypot(left[0], left[1]))
    level = min(speed_m_s, math.sqrt(2.0 * far) + 0.1)
    climb = min(climb_m_s, math.sqrt(2.0 * abs(left[2])) + 0.1)
    share = min(1.0, level * dt / far) if far > 0.0 else 0.0
    moved = np.array([share * left[0], share * left[1], math.copysign(min(abs(left[2]), climb * dt), left[2])])
    return way_m + moved, vector(moved / dt)


@dataclass
class Follow(Activity):
    """Do what the last setpoint says."""

    target: Target = field(default_factory=Target)
    place_m: Array | None = None  # held while the target is no number

    def motion(self, sensed: Sensed, dt: float) -> Motion:
        """Position where one is commanded, else velocity, else acceleration."""
        target = self.target
        if not self.flies:
            return self._drive(sensed)
        if target.yaw_rad is not None:
            self.yaw_rad = target.yaw_rad
        elif target.yaw_rate_rad_s is not None:
            self.yaw_rad += target.yaw_rate_rad_s * dt
        numbers = (*target.position_m, *target.velocity_m_s, *target.acceleration_m_s2)
        if any(x is not None and not math.isfinite(x) for x in numbers):
            if self.place_m is None:
                self.place_m = sensed.position_m
            return self.at(self.place_m)
        self.place_m = None
        velocity, acceleration = _filled(target.velocity_m_s), _filled(target.acceleration_m_s2)
        if all(x is not None for x in target.position_m):
            command = self.at(np.array(_filled(target.position_m)), velocity)
            return replace(command, acceleration_m_s2=acceleration)
        if target.has_position:
            velocity = _mixed(target, sensed)
        elif all(x is None for x in target.velocity_m_s) and any(x is not None for x in target.acceleration_m_s2):
            velocity = vector(sensed.velocity_m_s)
        return replace(self.moving(velocity), acceleration_m_s2=acceleration)

    def _drive(self, sensed: Sensed) -> Motion:
        target = self.target
        numbers = (*target.position_m[:2], *target.velocity_m_s[:2])
        if any(x is not None and not math.isfinite(x) for x in numbers):
            return Motion()
        limit = self.settings.return_speed_m_s
        x, y, _ = target.position_m
        if x is not None and y is not None:
            given = _filled(target.velocity_m_s)
            speed = math.hypot(given[0], given[1]) or limit
            return self.at(np.array([x, y, 0.0]), speed_m_s=speed)
        turn = target.yaw_rate_rad_s
        if target.ahead_m_s is not None and turn is not None:
            return Motion(speed_m_s=target.ahead_m_s, yaw_rate_rad_s=turn)
        east, north, _ = _filled(target.velocity_m_s)
        speed = math.hypot(east, north)
        if speed < STOPS_M_S:
            return Motion(yaw_rate_rad_s=turn or 0.0)
        heading = math.atan2(north, east)
        backwards = target.ahead_m_s is not None and target.ahead_m_s < 0.0
        error = heading + (math.pi if backwards else 0.0) - yaw_of_quaternion(sensed.quaternion)
        error = math.atan2(math.sin(error), math.cos(error))
        rate = max(-TURN_RAD_S, min(TURN_RAD_S, TURN_1_S * error))
        ahead = 0.0 if abs(error) > TURN_FIRST_RAD else speed * math.cos(error)
        return Motion(speed_m_s=-ahead if backwards else ahead, yaw_rate_rad_s=rate if turn is None else turn)


def _filled(axes: tuple[float | None, float | None, float | None]) -> Vector:
    """The axes with zero for those that are not commanded."""
    x, y, z = (0.0 if value is None else value for value in axes)
    return x, y, z


def _mixed(target: Target, sensed: Sensed) -> Vector:
    """Velocity where some axes are commanded by position and others by velocity."""
    given = _filled(target.velocity_m_s)
    pairs = zip(target.position_m, sensed.position_m, given, strict=True)
    x, y, z = (v if p is None else v + APPROACH_1_S * (p - float(here)) for p, here, v in pairs)
    return x, y, z
