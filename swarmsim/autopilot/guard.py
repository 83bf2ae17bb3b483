"""What is asked of every setpoint before any byte of it is sent."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from swarmsim.autopilot.link import Setpoint, Vector
from swarmsim.config.autopilot import SetpointLimits
from swarmsim.site.model import Site, bounds_m

ROUNDING = 1.001  # a command at a limit may exceed it by float32's rounding

ROUNDS, INSIDE_M = 32, 1e-3  # of the search for the nearest place inside, and how far inside it then is


class RefusedError(ValueError):
    """A setpoint that must not be sent; the message says why."""


def outline_of(site: Site) -> np.ndarray:
    """Corners [4, 2] of a site, counter-clockwise, world: where positions may lie."""
    (west, south), (east, north) = (np.asarray(corner, np.float64) for corner in bounds_m(site))
    return np.array([[west, south], [east, south], [east, north], [west, north]])


@dataclass
class Guard:
    """Refuses setpoints that are not finite, too fast, out of the volume, or far from the last one.

    Args:
        limits: of the mission.
        outline_m: [V, 2] corners of the area that positions stay in, convex and counter-clockwise, world.
        ground_m: height of the ground where the vehicle started, world.
        flies: whether heights are checked and climbing is limited by itself.
    """

    limits: SetpointLimits
    outline_m: np.ndarray
    ground_m: float
    flies: bool
    _last: tuple[float, Vector] | None = field(default=None, repr=False)

    def check(self, setpoint: Setpoint, now_s: float) -> Setpoint:
        """The setpoint, if it may be sent at the time ``now_s``; raises `RefusedError` if not."""
        self._shape(setpoint)
        self._motion(setpoint)
        if setpoint.position_m is not None:
            self._volume(setpoint.position_m)
            self._jump(setpoint.position_m, now_s)
            self._last = now_s, setpoint.position_m
        return setpoint

    def left(self, place: Vector) -> str | None:
        """Where a measured place lies, if that is outside of the volume: velocities alone may lead there.

        Positions that are sent stay ``margin_m`` inside the outline; an overshoot of ``jump_m`` over the ceiling is let
        pass.
        """
        inside = float(np.min(inward_distances(self.outline_m, inward_normals(self.outline_m), place)))
        if inside < 0.0:
            return f"{-inside:.1f} m outside the site's outline"
        above = place[2] - self.ground_m
        if self.flies and above > self.limits.ceiling_m + self.limits.jump_m:
            return f"{above:.1f} m above its start, limits.ceiling_m is {self.limits.ceiling_m:g}"
        return None

    def forget(self) -> None:
        """The next position may lie anywhere in the volume: the vehicle has been elsewhere meanwhile."""
        self._last = None

    def nearest(self, place_m: Vector) -> Vector | None:
        """Where positions may lie, near a finite place that may be outside; None if the volume is empty."""
        normals, limits = inward_normals(self.outline_m), self.limits
        level = np.array(place_m[:2], np.float64)
        for _ in range(ROUNDS):
            short = limits.margin_m + INSIDE_M - inward_distances(self.outline_m, normals, level)
            worst = int(np.argmax(short))
            if short[worst] <= 0.5 * INSIDE_M:
                low, high = self.ground_m - limits.floor_m, self.ground_m + limits.ceiling_m
                height = min(high - INSIDE_M, max(low + INSIDE_M, place_m[2])) if self.flies else place_m[2]
                return float(level[0]), float(level[1]), height
            level = level + short[worst] * normals[worst]
        return None

    def _shape(self, s: Setpoint) -> None:
        if s.position_m is None and s.velocity_m_s is None:
            raise RefusedError("it has neither a position nor a velocity")
        if s.body and s.position_m is not None:
            raise RefusedError("it has a position in the body frame")
        if s.yaw_rad is not None and s.yaw_rate_rad_s is not None:
            raise RefusedError("it has both a yaw and a yaw rate")
        for name, value in vars(s).items():
            if value is None or isinstance(value, bool):
                continue
            numbers = np.asarray(value, np.float64)
            if numbers.shape not in ((), (3,)) or not np.isfinite(numbers).all():
                raise RefusedError(f"{name} is {value}: every number must be finite")

    def _motion(self, s: Setpoint) -> None:
        limits = self.limits
        if s.velocity_m_s is not None:
            *level, up = s.velocity_m_s
            speed = math.hypot(*level)
            if speed > ROUNDING * limits.speed_m_s:
                raise RefusedError(f"its speed is {speed:.1f} m/s, limits.speed_m_s is {limits.speed_m_s:g}")
            if self.flies and abs(up) > ROUNDING * limits.climb_m_s:
                raise RefusedError(f"it climbs with {up:.1f} m/s, limits.climb_m_s is {limits.climb_m_s:g}")
        if s.acceleration_m_s2 is not None:
            size = math.hypot(*s.acceleration_m_s2)
            if size > ROUNDING * limits.acceleration_m_s2:
                raise RefusedError(
                    f"its acceleration is {size:.1f} m/s2, limits.acceleration_m_s2 is {limits.acceleration_m_s2:g}"
                )
        rate = math.degrees(abs(s.yaw_rate_rad_s or 0.0))
        if rate > ROUNDING * limits.yaw_rate_deg_s:
            raise RefusedError(f"it turns with {rate:.0f} deg/s, limits.yaw_rate_deg_s is {limits.yaw_rate_deg_s:g}")

    def _volume(self, place: Vector) -> None:
        x, y, z = place
        inside = np.min(inward_distances(self.outline_m, inward_normals(self.outline_m), place))
        if inside < self.limits.margin_m:
            where = f"{-inside:.1f} m outside" if inside < 0 else f"{inside:.1f} m inside"
            raise RefusedError(
                f"its position ({x:.1f}, {y:.1f}) is {where} the site's outline: limits.margin_m is "
                f"{self.limits.margin_m:g}"
            )
        above = z - self.ground_m
        if self.flies and not -self.limits.floor_m <= above <= self.limits.ceiling_m:
            raise RefusedError(
                f"its height is {above:.1f} m above the start: allowed are -{self.limits.floor_m:g} to "
                f"{self.limits.ceiling_m:g} m (limits.floor_m, limits.ceiling_m)"
            )

    def _jump(self, place: Vector, now_s: float) -> None:
        if self._last is None:
            return
        then_s, before = self._last
        apart = math.dist(place, before)
        fastest = math.hypot(self.limits.speed_m_s, self.limits.climb_m_s if self.flies else 0.0)
        allowed = self.limits.jump_m + fastest * max(0.0, now_s - then_s)
        if apart > allowed:
            raise RefusedError(
                f"its position jumps by {apart:.1f} m in {now_s - then_s:.2f} s: {allowed:.1f} m are allowed "
                "(limits.jump_m and the greatest speed)"
            )


def inward_normals(outline_m: np.ndarray) -> np.ndarray:
    """Unit normals [V, 2] of the edges of a convex, counter-clockwise outline [V, 2], towards its inside."""
    corners = np.asarray(outline_m, np.float64)
    edges = np.roll(corners, -1, axis=0) - corners
    normals: np.ndarray = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
    return normals


def inward_distances(outline_m: np.ndarray, normals: np.ndarray, place_m: Sequence[float] | np.ndarray) -> np.ndarray:
    """Distances [V] of a place (x, y, …) inside of each edge of an outline; negative outside."""
    apart = np.asarray(place_m, np.float64)[:2] - np.asarray(outline_m, np.float64)
    distances: np.ndarray = np.sum(apart * normals, axis=1)
    return distances
