"""The way from where a pilot hands a copter back to where its policy has it."""

import numpy as np

from swarmsim.autopilot.guard import Guard
from swarmsim.autopilot.link import Setpoint, Telemetry, Vector
from swarmsim.autopilot.manual.pilot import place_of
from swarmsim.config.manual import Manual

JOINED_M = 0.3  # from the policy's position: the policy goes on
LAG_M = 2.0  # the reference waits for a vehicle that is further behind than this
LAST_M_S = 0.1  # speed of the reference where it arrives
STEP_MAX_S = 0.5  # between two of the policy's setpoints; after a pause the reference does not jump


class Rejoin:
    """Leads a reference to the policy's position, straight as seen from there; it moves along with that.

    Without it the autopilot would fly there as fast as it can.
    """

    def __init__(self, manual: Manual, guard: Guard, t: Telemetry, now_s: float):
        """Begin where the vehicle is."""
        limits, here = guard.limits, place_of(t)
        inside = None if here is None else guard.nearest(here)
        self._place = None if inside is None else np.array(inside)
        self._speed_max = min(manual.speed_m_s, limits.speed_m_s)
        self._climb_max = min(manual.climb_m_s, limits.climb_m_s)
        self._acceleration = min(manual.acceleration_m_s2, limits.acceleration_m_s2)
        self._speed, self._now_s, self._guard = 0.0, now_s, guard
        guard.forget()

    def setpoint(self, policy: Setpoint, t: Telemetry, now_s: float) -> Setpoint | None:
        """What to send instead of the policy's; None once it has arrived, and where a policy gives no position."""
        here = place_of(t)
        if policy.position_m is None or self._place is None or here is None:
            return None
        dt, self._now_s = min(STEP_MAX_S, max(0.0, now_s - self._now_s)), now_s
        offset = np.asarray(policy.position_m, np.float64) - self._place
        far = float(np.linalg.norm(offset))
        if far < JOINED_M:
            return None
        along = offset / far
        most = min(self._speed_max, self._climb_max / max(abs(along[2]), 1e-9))
        most = min(most, float(np.sqrt(2.0 * self._acceleration * far)) + LAST_M_S)
        waits = float(np.linalg.norm(self._place - here)) > LAG_M
        self._speed = 0.0 if waits else min(most, self._speed + self._acceleration * dt)
        moves = np.zeros(3) if waits or policy.velocity_m_s is None else np.asarray(policy.velocity_m_s, np.float64)
        velocity = self._limited(self._speed * along + moves)
        step = self._limited(min(far / max(dt, 1e-9), self._speed) * along + moves) * dt
        place = self._guard.nearest(_vector(self._place + step))
        if place is None:
            return None
        self._place = np.array(place)
        return Setpoint(
            position_m=place, velocity_m_s=_vector(velocity), yaw_rad=policy.yaw_rad,
            yaw_rate_rad_s=policy.yaw_rate_rad_s,
        )  # fmt: skip

    def _limited(self, velocity: np.ndarray) -> np.ndarray:
        """A velocity within the limits of setpoints."""
        limits = self._guard.limits
        level = float(np.hypot(velocity[0], velocity[1]))
        share = min(1.0, limits.speed_m_s / max(level, 1e-9))
        climb = float(np.clip(velocity[2], -limits.climb_m_s, limits.climb_m_s))
        return np.array([share * velocity[0], share * velocity[1], climb])


def _vector(values: np.ndarray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
