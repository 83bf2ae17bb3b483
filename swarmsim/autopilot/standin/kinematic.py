"""A body without physics, for quick tests of protocols and state machines: it follows commands with a short lag."""

import math
from dataclasses import replace

import numpy as np

from swarmsim.autopilot.frames import yaw_of_quaternion
from swarmsim.autopilot.standin.body import Motion, Sensed
from swarmsim.config.vehicle_checks import GRAVITY_M_S2

LAG_S = 0.15
GAIN_1_S = 1.0
CLIMB_MAX_M_S = 3.0
CLIMBS_M_S = 0.2
CRASH_M_S = 2.0
DRAIN_1_S = 1e-4


class KinematicBody:
    """A point with a heading over level ground at height zero."""

    def __init__(self, *, flies: bool = True, step_s: float = 0.02, speed_max_m_s: float = 10.0):
        """At rest at the origin, heading east."""
        self.flies, self.step_s, self.speed_max_m_s = flies, step_s, speed_max_m_s
        self.sensed = Sensed(
            position_m=np.zeros(3),
            velocity_m_s=np.zeros(3),
            quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
            angular_velocity_rad_s=np.zeros(3),
            height_m=0.0,
            landed=True,
            intact=True,
            charge=1.0,
            voltage_v=16.0,
        )

    def step(self, motion: Motion, armed: bool) -> Sensed:
        """The state one step later."""
        self.sensed = self._fly(motion, armed) if self.flies else self._drive(motion, armed)
        return self.sensed

    def _fly(self, motion: Motion, armed: bool) -> Sensed:
        old, dt = self.sensed, self.step_s
        wanted = np.array(motion.velocity_m_s)
        if motion.hold_position:
            wanted = wanted + GAIN_1_S * (np.array(motion.position_m) - old.position_m)
        speed = float(np.hypot(wanted[0], wanted[1]))
        wanted[:2] *= min(1.0, self.speed_max_m_s / max(speed, 1e-9))
        wanted[2] = np.clip(wanted[2], -CLIMB_MAX_M_S, CLIMB_MAX_M_S)
        if armed:
            velocity = old.velocity_m_s + min(1.0, dt / LAG_S) * (wanted - old.velocity_m_s)
        else:
            velocity = old.velocity_m_s - np.array([0.0, 0.0, GRAVITY_M_S2 * dt])
        position = old.position_m + dt * velocity
        landed, intact = old.landed, old.intact
        if landed and not (armed and wanted[2] > CLIMBS_M_S):
            position, velocity = old.position_m, np.zeros(3)
        elif position[2] <= 0.0 and velocity[2] <= 0.0:
            landed, intact = True, intact and velocity[2] > -CRASH_M_S
            position, velocity = np.array([*position[:2], 0.0]), np.zeros(3)
        else:
            landed = False
        q = _yawed(motion.yaw_rad) if armed else old.quaternion
        charge = old.charge - (DRAIN_1_S * dt if armed else 0.0)
        return replace(
            old, position_m=position, velocity_m_s=velocity, quaternion=q, height_m=float(position[2]), landed=landed,
            intact=intact, charge=charge,
        )  # fmt: skip

    def _drive(self, motion: Motion, armed: bool) -> Sensed:
        old, dt = self.sensed, self.step_s
        yaw = yaw_of_quaternion(old.quaternion)
        speed, turn = motion.speed_m_s, motion.yaw_rate_rad_s
        if motion.hold_position:
            offset = np.array(motion.position_m)[:2] - old.position_m[:2]
            error = math.atan2(offset[1], offset[0]) - yaw
            error = math.atan2(math.sin(error), math.cos(error))
            far = float(np.hypot(*offset))
            speed = min(speed, far) * max(0.0, math.cos(error))
            turn = 2.0 * error if far > 0.05 else 0.0
        if not armed:
            speed, turn = 0.0, 0.0
        yaw += turn * dt
        velocity = speed * np.array([math.cos(yaw), math.sin(yaw), 0.0])
        rates = np.array([0.0, 0.0, turn])
        return replace(
            old, position_m=old.position_m + dt * velocity, velocity_m_s=velocity, quaternion=_yawed(yaw),
            angular_velocity_rad_s=rates,
        )  # fmt: skip


def _yawed(yaw_rad: float) -> np.ndarray:
    return np.array([math.cos(yaw_rad / 2.0), 0.0, 0.0, math.sin(yaw_rad / 2.0)])
