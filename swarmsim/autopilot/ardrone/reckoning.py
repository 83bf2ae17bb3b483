"""Where an AR.Drone is, as far as its velocity, heading and height tell: dead reckoning from where it was aligned."""

import math

from swarmsim.autopilot.ardrone.navdata import Demo
from swarmsim.autopilot.link import Vector

CLIMB_LAG_S = 0.2  # of the filter that makes a climb rate of the heights


class Reckoning:
    """Position from the optical flow's velocity, relative to where it was `begin`; it drifts without bound.

    The heading is that of the gyroscope since then, plus the one that is given. The climb rate comes from the height:
    the drone's own vertical velocity is not documented.
    """

    def __init__(self, start_yaw_rad: float, gap_s: float):
        """``start_yaw_rad`` is the heading at `begin`, counter-clockwise from east; ``gap_s`` the longest pause."""
        self._start_yaw_rad, self._gap_s = start_yaw_rad, gap_s
        self._last: tuple[float, Demo] | None = None
        self._heading_rad: float | None = None  # the drone's, at `begin`
        self._level = (0.0, 0.0)
        self._climb_m_s = 0.0
        self.broken = False
        """Whether data were missing for so long that the position is not known any more."""

    def begin(self) -> None:
        """The position is zero now, and the heading the given one."""
        self._level, self.broken = (0.0, 0.0), False
        self._heading_rad = None if self._last is None else self._last[1].heading_rad

    def add(self, now_s: float, demo: Demo) -> None:
        """New data, that came at ``now_s``."""
        if self._heading_rad is None:
            self._heading_rad = demo.heading_rad
        if self._last is not None:
            then_s, before = self._last
            dt = now_s - then_s
            self.broken = self.broken or dt > self._gap_s
            (ax, ay), (bx, by) = self._velocity(before), self._velocity(demo)
            x, y = self._level
            self._level = x + 0.5 * dt * (ax + bx), y + 0.5 * dt * (ay + by)
            if dt > 1e-3:
                rate = (demo.height_m - before.height_m) / dt
                self._climb_m_s += (1.0 - math.exp(-dt / CLIMB_LAG_S)) * (rate - self._climb_m_s)
        self._last = now_s, demo

    def yaw_rad(self, demo: Demo) -> float:
        """Heading in the world, counter-clockwise from east."""
        begun = demo.heading_rad if self._heading_rad is None else self._heading_rad
        return self._start_yaw_rad - (demo.heading_rad - begun)

    def _velocity(self, demo: Demo) -> tuple[float, float]:
        yaw = self.yaw_rad(demo)
        c, s = math.cos(yaw), math.sin(yaw)
        return c * demo.forward_m_s + s * demo.right_m_s, s * demo.forward_m_s - c * demo.right_m_s

    @property
    def position_m(self) -> Vector | None:
        """East, north of where it was `begin`, and height above the ground below it; None before the first data."""
        return None if self._last is None else (*self._level, self._last[1].height_m)

    @property
    def velocity_m_s(self) -> Vector | None:
        """World; None before the first data."""
        return None if self._last is None else (*self._velocity(self._last[1]), self._climb_m_s)
