"""PX4: OFFBOARD on a stream of setpoints, its loss and its return, and two answers to a mode command."""

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from swarmsim.autopilot.standin.activities import Activity
from swarmsim.autopilot.standin.core import FORCE, Autopilot, Command
from swarmsim.autopilot.standin.targets import Target, UnsupportedError, read_px4

# main mode, sub mode and role (PX4's px4_custom_mode.h)
_MODES = {
    "MANUAL": (1, 0, "manual"),
    "ALTCTL": (2, 0, "manual"),
    "POSCTL": (3, 0, "manual"),
    "AUTO.TAKEOFF": (4, 2, "takeoff"),
    "AUTO.LOITER": (4, 3, "hold"),
    "AUTO.RTL": (4, 5, "return"),
    "AUTO.LAND": (4, 6, "land"),
    "OFFBOARD": (6, 0, "follow"),
}
_ENDS = ("land", "return")  # roles in which it cannot be armed
ACCEPTED, REJECTED, DENIED = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_TEMPORARILY_REJECTED, mav.MAV_RESULT_DENIED


class PX4(Autopilot):
    """PX4 1.17 with one link to a companion computer."""

    type_number = mav.MAV_AUTOPILOT_PX4
    bit_patterns = True
    manual_mode = "MANUAL"
    set_mode_told_as = mav.MAV_CMD_DO_SET_MODE
    refused = REJECTED

    def __init__(self, *arguments: Any, **fields: Any):
        """As every autopilot."""
        super().__init__(*arguments, **fields)
        self.intention = self.mode  # what was commanded; the mode may differ in a failsafe
        self._armable = self.mode  # the last one commanded that it can be armed in: it stands in it after a flight
        self.target: Target | None = None
        self._last_s = -math.inf  # of the stream's setpoints
        self._since_s = math.inf

    def mode_tables(self) -> tuple[dict[str, int], dict[str, str]]:
        """By the names of PX4's mode list."""
        numbers = {name: main << 16 | sub << 24 for name, (main, sub, _) in _MODES.items()}
        return numbers, {name: role for name, (_, _, role) in _MODES.items()}

    def boot_mode(self) -> str:
        """HOLD: there is no remote control."""
        return "AUTO.LOITER"

    @property
    def ready(self) -> bool:
        """Not in OFFBOARD without a stream."""
        return super().ready and (self.armed or self.mode != "OFFBOARD" or self.streams_setpoints)

    @property
    def streams_setpoints(self) -> bool:
        """Whether setpoints have come for long enough, and come still."""
        return self._fresh and self.time_s - self._since_s >= self.settings.setpoint.stream_s

    @property
    def _fresh(self) -> bool:
        return self.time_s - self._last_s <= self.parameters["COM_OF_LOSS_T"]

    def setpoint(self, message: Any) -> None:
        """Take a setpoint of the stream; one in a frame that is not supported is as if it had not come."""
        try:
            target = read_px4(message, self.sensed, self.local, self.world_origin, self.home_altitude_m)
        except UnsupportedError:
            return
        if not self._fresh:
            self._since_s = self.time_s
        self._last_s, self.target = self.time_s, target
        if self.armed and self.mode == "OFFBOARD":
            self.follow(target)

    def following(self) -> Activity:
        """Begin with the last setpoint."""
        if self.target is not None:
            self.follow(self.target)
            return self.activity
        return self.resting()

    def set_mode(self, name: str | None) -> list[int]:
        """Results of a mode command: two of them."""
        if name is None:
            return [DENIED]
        if name == "OFFBOARD" and self.armed and not self.streams_setpoints:
            return [ACCEPTED, REJECTED]
        if self.roles[name] in ("takeoff", "return") and not self.estimate_ok:
            return [ACCEPTED, REJECTED]
        self.intention, self.failsafe = name, False
        if self.roles[name] not in _ENDS:
            self._armable = name
        if self.mode != name or name == "AUTO.TAKEOFF":
            self.enter(name)
        return [ACCEPTED, ACCEPTED]

    def take_over(self) -> None:
        """OFFBOARD is not entered again by itself."""
        super().take_over()
        self.intention = ""

    def arm(self, force: bool) -> int:
        """Refused before the estimate is ready, and in OFFBOARD without a stream."""
        if self.armed:
            return ACCEPTED
        if not force and not self.ready:
            return REJECTED
        if self.mode == "OFFBOARD" and not self.streams_setpoints:
            return REJECTED
        if self.role in _ENDS:
            return REJECTED
        self.start_motors()
        return ACCEPTED

    def take_off(self, command: Command) -> int:
        """Take-off is a mode; without an altitude it climbs to MIS_TAKEOFF_ALT."""
        if not self.estimate_ok or not self.flies:
            return REJECTED
        self.intention, self.failsafe = "AUTO.TAKEOFF", False
        if self.armed and self.airborne:
            self.enter("AUTO.LOITER")
            return ACCEPTED
        self.enter("AUTO.TAKEOFF")
        altitude = command.params[6]
        if self.armed and self.home_altitude_m < altitude < math.inf:
            self.activity = self.climbing(altitude - self.home_altitude_m)
        return ACCEPTED

    def supervise(self) -> None:
        """Loss of the stream, its return, and disarming on the ground."""
        if not self.armed:
            return
        lost = self.time_s - self._last_s > self.parameters["COM_OF_LOSS_T"] + self.settings.setpoint.failsafe_s
        if self.mode == "OFFBOARD" and lost:
            self.failsafe = True
            self.enter("POSCTL")
        elif self.failsafe and self.intention == "OFFBOARD" and self.mode == "POSCTL" and self.streams_setpoints:
            self.failsafe = False
            self.enter("OFFBOARD")
        if not self.flies or self.ground_s is None:
            return
        stood = self.time_s - self.ground_s
        after = self.parameters["COM_DISARM_LAND" if self.flown else "COM_DISARM_PRFLT"]
        if after > 0 and stood > after:
            self.disarm()

    def finished(self) -> None:
        """After a take-off it loiters; after a landing it is disarmed by `supervise`."""
        if self.mode == "AUTO.TAKEOFF":
            self.intention = "AUTO.LOITER"
            self.enter("AUTO.LOITER")

    def land_after_failure(self) -> None:
        """A copter descends, a rover stands."""
        mode = "AUTO.LAND" if self.flies else "AUTO.LOITER"
        if self.mode != mode:
            self.failsafe, self.intention = True, mode
            self.enter(mode)

    def return_height_m(self) -> tuple[float, float]:
        """RTL_RETURN_ALT; it does not wait."""
        return float(self.parameters["RTL_RETURN_ALT"]), 0.0

    def disarm(self) -> None:
        """Stop the motors; a landing or a return is over, and a failsafe."""
        super().disarm()
        if self.role in _ENDS or self.failsafe:
            self.mode = self.intention = self._armable
            self.failsafe = False

    def disarm_command(self, command: Command) -> int:
        """Refused in the air, unless forced."""
        if self.airborne and command.params[1] != FORCE:
            return REJECTED
        self.disarm()
        return ACCEPTED
