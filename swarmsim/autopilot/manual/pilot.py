"""Sticks to setpoints: what a pilot commands, such that the guard refuses none of it."""

import math

import numpy as np

from swarmsim.autopilot.frames import yaw_of_quaternion
from swarmsim.autopilot.guard import Guard, inward_distances, inward_normals
from swarmsim.autopilot.link import Setpoint, Telemetry, Vector
from swarmsim.autopilot.manual.sticks import Sticks
from swarmsim.config.manual import Manual

HEIGHT_1_S = 1.0  # gain of the held height
BRAKING = 0.5  # of the acceleration, with which it stops before the edge of where it may fly
EDGE_M = 0.5  # it stops so far inside
FAR_M = 2.0  # outside of where it may fly, from which on it is brought back by a velocity
STEP_MAX_S = 0.2  # between two setpoints; after a pause commands do not jump

_STILL: Vector = (0.0, 0.0, 0.0)


class Pilot:
    """Turns sticks into velocities of a copter (world) or of a rover (body), and holds the place without them.

    A copter moves in the frame of its heading, level whatever its attitude. Where the limits of setpoints bound a
    volume, it stops at its edge. Rovers turn by ``turn`` and by ``left``.
    """

    def __init__(self, manual: Manual, guard: Guard, *, speed_max_m_s: float, reverses: bool = True):
        """``speed_max_m_s`` is what the vehicle can do; one that does not ``reverses`` cannot drive backwards."""
        limits = guard.limits
        self._manual, self._guard, self._reverses = manual, guard, reverses
        self._normals = inward_normals(guard.outline_m)
        self._speed = min(manual.speed_m_s, limits.speed_m_s, speed_max_m_s)
        self._climb = min(manual.climb_m_s, limits.climb_m_s)
        self._rate = math.radians(min(manual.yaw_rate_deg_s, limits.yaw_rate_deg_s))
        self._acceleration = min(manual.acceleration_m_s2, limits.acceleration_m_s2)
        self._level, self._up, self._turn = np.zeros(2), 0.0, 0.0  # commanded; of a rover: ahead and zero
        self._now_s: float | None = None
        self._released_s: float | None = None  # since when no stick moves it
        self._height_m: float | None = None  # held
        self._place_m: Vector | None = None  # held
        self._yaw_rad: float | None = None  # held with the place

    @property
    def holds(self) -> bool:
        """Whether it keeps its place."""
        return self._place_m is not None

    def begin(self, t: Telemetry) -> None:
        """Take a vehicle over: commands begin with the velocity that it has."""
        limits = self._guard.limits
        velocity = np.zeros(3) if t.velocity_m_s is None else np.nan_to_num(np.asarray(t.velocity_m_s, np.float64))
        if self._guard.flies:
            self._level = _within(velocity[:2], limits.speed_m_s)
            self._up = float(np.clip(velocity[2], -limits.climb_m_s, limits.climb_m_s))
        else:
            yaw = _heading(t)
            ahead = float(velocity[0] * math.cos(yaw) + velocity[1] * math.sin(yaw))
            self._level = np.array([np.clip(ahead, -self._speed if self._reverses else 0.0, self._speed), 0.0])
            self._up = 0.0
        self._turn, self._now_s, self._released_s = 0.0, None, None
        self._height_m = self._place_m = None
        self._guard.forget()

    def setpoint(self, sticks: Sticks, t: Telemetry, now_s: float) -> Setpoint:
        """What to send at the time ``now_s``."""
        dt = 0.0 if self._now_s is None else min(STEP_MAX_S, max(0.0, now_s - self._now_s))
        self._now_s = now_s
        turn = sticks.turn if self._guard.flies else min(1.0, max(-1.0, sticks.turn + sticks.left))
        step = math.radians(self._manual.yaw_acceleration_deg_s2) * dt
        self._turn += min(step, max(-step, turn * self._rate - self._turn))
        return self._fly(sticks, t, now_s, dt) if self._guard.flies else self._drive(sticks, t, dt)

    def _drive(self, sticks: Sticks, t: Telemetry, dt: float) -> Setpoint:
        yaw, step = _heading(t), self._acceleration * dt
        wanted = sticks.forward * self._speed
        wanted = wanted if self._reverses else max(0.0, wanted)
        ahead = float(self._level[0]) + min(step, max(-step, wanted - float(self._level[0])))
        fastest = self._fastest(t)
        outward = -(self._normals @ (ahead * np.array([math.cos(yaw), math.sin(yaw)])))
        over = outward > fastest
        if over.any():
            ahead *= float(np.min(fastest[over] / outward[over]))
        self._level = np.array([ahead, 0.0])
        return Setpoint(velocity_m_s=(ahead, 0.0, 0.0), yaw_rate_rad_s=self._turn, body=True)

    def _fly(self, sticks: Sticks, t: Telemetry, now_s: float, dt: float) -> Setpoint:
        if sticks.moves:
            self._released_s = self._place_m = None
        elif self._released_s is None:
            self._released_s = now_s
        elif self._place_m is None:
            self._hold(t, now_s)
        if self._place_m is not None:
            return self._held(t)
        return self._move(sticks, t, dt)

    def _held(self, t: Telemetry) -> Setpoint:
        """The place, and the heading where it does not turn: some vehicles drift at a turn rate of zero."""
        if self._turn:
            self._yaw_rad = None
        elif self._yaw_rad is None and heading_known(t):
            self._yaw_rad = _heading(t)
        rate = self._turn if self._yaw_rad is None else None
        return Setpoint(self._place_m, _STILL, yaw_rad=self._yaw_rad, yaw_rate_rad_s=rate)

    def _hold(self, t: Telemetry, now_s: float) -> None:
        """Keep the place, where it has stopped; one that is far outside of its volume is brought back before."""
        here = place_of(t)
        assert self._released_s is not None
        known = t.velocity_m_s is not None and bool(np.isfinite(t.velocity_m_s).all())
        still = known and math.hypot(*t.velocity_m_s) < self._manual.still_m_s  # type: ignore[misc]
        if here is None or not (still or now_s - self._released_s > self._manual.brake_s) or self._level.any():
            return
        place = self._guard.nearest(here)
        if place is not None and math.dist(place, here) <= FAR_M:
            self._place_m, self._height_m, self._up, self._yaw_rad = place, None, 0.0, None
            self._guard.forget()

    def _move(self, sticks: Sticks, t: Telemetry, dt: float) -> Setpoint:
        step = self._acceleration * dt
        self._level = self._level + _within(self._wanted(sticks, t) - self._level, step)
        fastest = self._fastest(t)
        for _ in range(2):  # of two edges that meet, the second may push over the first
            for normal, most in zip(self._normals, fastest, strict=True):
                self._level = self._level + max(0.0, -float(normal @ self._level) - most) * normal
        self._level = _within(self._level, self._guard.limits.speed_m_s)
        self._up += min(step, max(-step, self._climbing(sticks, t) - self._up))
        lowest, highest = self._vertical(t)
        self._up = max(lowest, min(highest, self._up))
        velocity = (float(self._level[0]), float(self._level[1]), float(self._up))
        return Setpoint(velocity_m_s=velocity, yaw_rate_rad_s=self._turn)

    def _wanted(self, sticks: Sticks, t: Telemetry) -> np.ndarray:
        """Level velocity [2] that the sticks ask for, world; towards the volume of one that has left it."""
        here = place_of(t)
        if not sticks.moves and here is not None:
            inside = self._guard.nearest(here)
            if inside is not None and math.dist(inside[:2], here[:2]) > FAR_M:
                return _within(np.subtract(inside[:2], here[:2]), self._speed)
        forward, left = _within(np.array([sticks.forward, sticks.left]), 1.0)
        yaw = _heading(t)
        c, s = math.cos(yaw), math.sin(yaw)
        return self._speed * np.array([c * forward - s * left, s * forward + c * left])

    def _climbing(self, sticks: Sticks, t: Telemetry) -> float:
        """Climb that the sticks ask for; without them what keeps the height."""
        here = place_of(t)
        if sticks.up or here is None:
            self._height_m = None
            return sticks.up * self._climb
        if self._height_m is None:
            if self._up:
                return 0.0
            self._height_m = here[2]
        return max(-0.5, min(0.5, HEIGHT_1_S * (self._height_m - here[2]) / self._climb)) * self._climb

    def _fastest(self, t: Telemetry) -> np.ndarray:
        """Speed [V] towards each edge of the outline from which it can still stop."""
        here = place_of(t)
        if here is None:
            return np.full(len(self._normals), math.inf)
        inside = inward_distances(self._guard.outline_m, self._normals, here) - self._guard.limits.margin_m - EDGE_M
        return np.sqrt(2.0 * BRAKING * self._acceleration * np.maximum(inside, 0.0))

    def _vertical(self, t: Telemetry) -> tuple[float, float]:
        """Least and greatest climb that keep it between floor and ceiling."""
        here, limits = place_of(t), self._guard.limits
        if here is None:
            return -self._climb, self._climb
        above = here[2] - self._guard.ground_m
        down, up = (max(0.0, x - EDGE_M) for x in (above + limits.floor_m, limits.ceiling_m - above))
        lowest, highest = (math.sqrt(2.0 * BRAKING * self._acceleration * x) for x in (down, up))
        return -min(limits.climb_m_s, lowest), min(limits.climb_m_s, highest)


def place_of(t: Telemetry) -> Vector | None:
    """The position, where it is known."""
    return t.position_m if t.position_m is not None and bool(np.isfinite(t.position_m).all()) else None


def _heading(t: Telemetry) -> float:
    """Yaw, counter-clockwise from east; 0 where it is not known."""
    return yaw_of_quaternion(t.quaternion) if t.quaternion is not None and heading_known(t) else 0.0


def heading_known(t: Telemetry) -> bool:
    """Whether the attitude is known."""
    return t.quaternion is not None and bool(np.isfinite(t.quaternion).all())


def _within(vector: np.ndarray, most: float) -> np.ndarray:
    """The vector, no longer than ``most``."""
    length = float(np.hypot(*vector))
    return vector if length <= most else vector * (most / length)
