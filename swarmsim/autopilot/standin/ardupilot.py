"""ArduPilot, copter and rover: GUIDED, its take-off command, its time-out of velocities, fence and GCS failsafe."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from swarmsim.autopilot.frames import yaw_of_quaternion
from swarmsim.autopilot.standin.activities import Activity, Follow, TakeOff
from swarmsim.autopilot.standin.body import Motion, Sensed
from swarmsim.autopilot.standin.core import FORCE, Autopilot, Command
from swarmsim.autopilot.standin.targets import Target, read_ardupilot

_COPTER = {
    "STABILIZE": (0, "manual"),
    "ALT_HOLD": (2, "manual"),
    "GUIDED": (4, "follow"),
    "LOITER": (5, "hold"),
    "RTL": (6, "return"),
    "LAND": (9, "land"),
    "BRAKE": (17, "hold"),
}
_ROVER = {
    "MANUAL": (0, "manual"),
    "HOLD": (4, "hold"),
    "LOITER": (5, "hold"),
    "RTL": (11, "return"),
    "GUIDED": (15, "follow"),
}
CIRCLE = 2  # bit of FENCE_TYPE
FENCE_BRAKE_M_S2 = 2.5
FENCE_LAG_S = 0.4  # by which a vehicle is late in slowing down
FAILSAFE_RTL, FAILSAFE_HOLD = 1, 2
ACCEPTED, FAILED = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_FAILED


class ArduPilot(Autopilot):
    """ArduPilot 4.6."""

    type_number = mav.MAV_AUTOPILOT_ARDUPILOTMEGA
    bit_patterns = False
    set_mode_told_as = mav.MAVLINK_MSG_ID_SET_MODE
    refused = FAILED

    def __init__(self, *arguments: Any, **fields: Any):
        """As every autopilot."""
        self._setpoint_s = math.inf
        self._gcs_lost = False
        self._estimate_failed = False
        super().__init__(*arguments, **fields)

    def mode_tables(self) -> tuple[dict[str, int], dict[str, str]]:
        """Of a copter or a rover."""
        table = _COPTER if self.flies else _ROVER
        return {name: number for name, (number, _) in table.items()}, {name: role for name, (_, role) in table.items()}

    @property
    def manual_mode(self) -> str:  # type: ignore[override]
        """STABILIZE of a copter, MANUAL of a rover."""
        return "STABILIZE" if self.flies else "MANUAL"

    def setpoint(self, message: Any) -> None:
        """Of interest in GUIDED only; one that is not understood stops the vehicle."""
        if self.mode != "GUIDED":
            return
        target = read_ardupilot(message, self.sensed, self.local, self.world_origin, self.home_altitude_m)
        if not self.armed:
            return
        if self.flies and not self.airborne:  # take-off is a command of its own
            return
        if target is not None and not self.reaches(target):
            return
        self._setpoint_s = self.time_s
        if target is None:
            self.activity = self.resting()
        else:
            self.follow(target)

    def set_mode(self, name: str | None) -> list[int]:
        """One result."""
        needs_position = name is not None and (self.roles[name] in ("follow", "return") or name in ("LOITER", "BRAKE"))
        if name is None or (needs_position and not self.estimate_ok):
            if name is not None:
                self.text(mav.MAV_SEVERITY_WARNING, f"Mode change to {name} failed: requires position")
            return [FAILED]
        if name != self.mode:
            self.enter(name)
        return [ACCEPTED]

    def following(self) -> Activity:
        """GUIDED stops and waits for setpoints."""
        self._setpoint_s = math.inf
        return self.resting()

    def arm(self, force: bool) -> int:
        """Refused before the estimate is ready, and in modes that land."""
        if self.armed:
            return ACCEPTED
        if not force and not self.ready:
            self.text(mav.MAV_SEVERITY_CRITICAL, f"Arm: {self.why_not()}")
            return FAILED
        if self._gcs_lost and not force:
            self.text(mav.MAV_SEVERITY_CRITICAL, "Arm: GCS failsafe on")
            return FAILED
        if self.role in ("land", "return") and self.flies:
            self.text(mav.MAV_SEVERITY_CRITICAL, f"Arm: {self.mode} mode not armable")
            return FAILED
        self.start_motors()
        self.text(mav.MAV_SEVERITY_INFO, "Arming motors")
        return ACCEPTED

    def prearm_checks(self) -> int:
        """Say what the checks find."""
        if not self.ready:
            self.text(mav.MAV_SEVERITY_CRITICAL, f"PreArm: {self.why_not()}")
        return ACCEPTED

    def why_not(self) -> str:
        """The reason for which it cannot be armed."""
        if self.faults.gnss_lost:
            return "GPS 1: Bad fix"
        if not self.sensed.intact:
            return "Crash detected"
        return "AHRS: EKF not healthy" if self.time_s >= self.settings.ready_s else "AHRS: waiting for home"

    def disarm(self) -> None:
        """Stop the motors, and say so."""
        if self.armed:
            self.text(mav.MAV_SEVERITY_INFO, "Disarming motors")
        super().disarm()
        self._estimate_failed = False
        self._tell_failsafe()

    def take_off(self, command: Command) -> int:
        """Refused unless armed, in GUIDED and on the ground."""
        height = command.params[6]
        able = self.flies and self.armed and self.mode == "GUIDED" and not self.airborne
        if not able or not math.isfinite(height) or height <= 0.0:
            return FAILED
        self.activity = self.climbing(height + float(self.home_m[2] - self.sensed.position_m[2]))
        return ACCEPTED

    def supervise(self) -> None:
        """Time-out of velocities, GCS failsafe, disarming on the ground."""
        self._supervise_gcs()
        if not self.armed:
            return
        limit = self.parameters["GUID_TIMEOUT"]
        follows = self.activity if isinstance(self.activity, Follow) else None
        if follows is not None and not follows.target.has_position and self.time_s - self._setpoint_s > limit:
            if not self.flies:
                self.text(mav.MAV_SEVERITY_WARNING, f"target not received last {limit:.0f}secs, stopping")
            self.activity = self.resting()
        if self.flies and self.ground_s is not None and not isinstance(self.activity, TakeOff):
            delay = float(self.parameters["DISARM_DELAY"])
            if self.role not in ("land", "return") and delay > 0 and self.time_s - self.ground_s > delay:
                self.disarm()

    def _supervise_gcs(self) -> None:
        last = self.heard.get(int(self.parameters["SYSID_MYGCS"]))
        enabled = self.parameters["FS_GCS_ENABLE"] > 0
        lost = enabled and last is not None and self.time_s - last > self.parameters["FS_GCS_TIMEOUT"]
        if lost == self._gcs_lost:
            return
        self._gcs_lost = lost
        self._tell_failsafe()
        if not lost:
            self.text(mav.MAV_SEVERITY_WARNING, "GCS Failsafe Cleared")
            return
        self.text(mav.MAV_SEVERITY_WARNING, "GCS Failsafe")
        action = FAILSAFE_RTL if self.flies else self.parameters["FS_ACTION"]
        if self.flies and not self.airborne:
            self.disarm()
        elif self.armed and self.role != "land" and action in (FAILSAFE_RTL, FAILSAFE_HOLD):
            self.enter("RTL" if action == FAILSAFE_RTL else "HOLD")

    def _tell_failsafe(self) -> None:
        """Its HEARTBEAT is critical while any failsafe lasts."""
        self.failsafe = self._gcs_lost or self._estimate_failed

    def finished(self) -> None:
        """A take-off hovers at its top; a landing ends with the motors off."""
        if self.role in ("land", "return") and self.flies:
            self.disarm()

    def take_over(self) -> None:
        """The EKF failsafe is over."""
        self._estimate_failed = False
        self._tell_failsafe()

    def land_after_failure(self) -> None:
        """The EKF failsafe lands a copter and stops a rover."""
        mode = "LAND" if self.flies else "HOLD"
        if self.mode != mode and self.role != "manual" and self.parameters["FS_EKF_ACTION"]:
            self._estimate_failed = True
            self._tell_failsafe()
            self.text(mav.MAV_SEVERITY_CRITICAL, f"EKF Failsafe: changed to {mode} Mode")
            self.enter(mode)

    def return_height_m(self) -> tuple[float, float]:
        """RTL_ALT and RTL_LOIT_TIME."""
        return float(self.parameters["RTL_ALT"]) / 100.0, float(self.parameters["RTL_LOIT_TIME"]) / 1000.0

    def disarm_command(self, command: Command) -> int:
        """Refused in the air, unless forced."""
        if self.airborne and command.params[1] != FORCE:
            return FAILED
        self.disarm()
        return ACCEPTED

    # Circular fence

    @property
    def _fence_m(self) -> float:
        """Radius that is kept, infinite without a fence."""
        on = self.parameters["FENCE_ENABLE"] and int(self.parameters["FENCE_TYPE"]) & CIRCLE
        return float(self.parameters["FENCE_RADIUS"] - self.parameters["FENCE_MARGIN"]) if on else math.inf

    def reaches(self, target: Target) -> bool:
        """Not a position outside the fence."""
        x, y, _ = target.position_m
        if x is None or y is None:
            return True
        return math.hypot(x - self.home_m[0], y - self.home_m[1]) <= self._fence_m

    def tick(self, sensed: Sensed) -> Motion:
        """As every autopilot, and no faster towards the fence than it can brake."""
        motion = super().tick(sensed)
        if math.isinf(self._fence_m) or motion.hold_position:
            return motion
        out = sensed.position_m[:2] - self.home_m[:2]
        far = float(np.hypot(*out))
        if far < 0.1:
            return motion
        away, velocity = out / far, np.array(motion.velocity_m_s[:2])
        if not self.flies:
            yaw = yaw_of_quaternion(sensed.quaternion)
            velocity = motion.speed_m_s * np.array([math.cos(yaw), math.sin(yaw)])
        late = FENCE_LAG_S * max(float(sensed.velocity_m_s[:2] @ away), 0.0)
        limit = math.sqrt(2.0 * FENCE_BRAKE_M_S2 * max(self._fence_m - far - late, 0.0))
        over = float(velocity @ away) - limit
        if over <= 0.0:
            return motion
        if not self.flies:  # it drives where it points, only slower
            return replace(motion, speed_m_s=motion.speed_m_s * limit / (limit + over))
        x, y = velocity - over * away
        return replace(motion, velocity_m_s=(float(x), float(y), motion.velocity_m_s[2]))
