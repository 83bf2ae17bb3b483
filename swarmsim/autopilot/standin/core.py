"""What both stand-in autopilots have in common: state, modes, arming and activities. No sockets, no clock of its own.

`receive` takes a message, `tick` goes on by one step; what is to be sent gathers in ``outbox``. Time is that of the
simulation since boot.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from swarmsim.autopilot.frames import (
    Alignment,
    Geodetic,
    enu_of_geodetic,
    geodetic_of_enu,
    yaw_of_quaternion,
)
from swarmsim.autopilot.standin.activities import Activity, Follow, Hold, Idle, Land, Return, TakeOff, vector
from swarmsim.autopilot.standin.body import Array, Motion, Sensed
from swarmsim.autopilot.standin.parameters import Parameters
from swarmsim.autopilot.standin.settings import Settings
from swarmsim.autopilot.standin.targets import Target

HEARD_AGAIN_S = 2.0
"""For how long a status text is not repeated."""
AIRBORNE_M = 0.3
"""Height of the feet from which a copter has taken off."""
FORCE = 21196.0
"""Second parameter of an arming command that passes over the checks."""


@dataclass
class Faults:
    """What a test may have go wrong; the physics is not touched."""

    battery: float | None = None  # share of the charge that is told, instead of the true one
    estimate_lost: bool = False  # the EKF fails
    gnss_lost: bool = False  # no fix; the EKF coasts for ``gps_coast_s``
    silent: bool = False  # the link is dead in both directions
    drop_share: float = 0.0  # share of packets lost, each way


@dataclass(frozen=True)
class Command:
    """COMMAND_LONG or COMMAND_INT."""

    number: int
    params: tuple[float, float, float, float, float, float, float]
    system: int  # who asks
    component: int
    frame: int | None = None  # of COMMAND_INT, whose fifth and sixth parameters are degrees here too


class Autopilot(ABC):
    """A vehicle's autopilot; what only PX4 or only ArduPilot does stands in the subclasses."""

    type_number: int  # MAV_AUTOPILOT
    bit_patterns: bool  # integer parameters travel as the bits of a float
    manual_mode: str  # the mode of the operator that it boots in
    set_mode_told_as: int  # the command that the message SET_MODE is acknowledged as
    refused: int  # result of a command that cannot be carried out now

    def __init__(self, settings: Settings, sensed: Sensed, flies: bool, system: int = 1):
        """Switch on at the place where the body stands."""
        self.settings, self.flies, self.system, self.component = settings, flies, system, 1
        self.modes, self.roles = self.mode_tables()
        self.parameters = Parameters(settings.parameters, self.bit_patterns)
        for name in ("MAV_SYS_ID", "SYSID_THISMAV"):
            if name in self.parameters.names:
                self.parameters.put(name, system)
        self.faults = Faults()
        self.outbox: list[Any] = []
        self.log: list[str] = []
        self.time_s = 0.0
        self.sensed = sensed
        world = Geodetic(**settings.origin.model_dump())
        self.world_origin = world
        self.home_m: Array = np.array(sensed.position_m)
        self.origin = geodetic_of_enu(sensed.position_m, world)
        self.local = Alignment(world_m=vector(sensed.position_m), local_m=(0.0, 0.0, 0.0))
        self.armed = False
        self.mode = self.boot_mode()
        self.activity: Activity = self.make(Idle)
        self.flown = False  # it has left the ground since it was armed
        self.failsafe = False
        self.armed_s = 0.0  # when it was armed
        self.ground_s: float | None = 0.0  # since when it has stood on the ground
        self.gnss_lost_s: float | None = None
        self.heard: dict[int, float] = {}  # when the last heartbeat of each system came
        self._told: dict[str, float] = {}

    # What the kinds differ in

    @abstractmethod
    def mode_tables(self) -> tuple[dict[str, int], dict[str, str]]:
        """Custom mode and role (manual, hold, takeoff, return, land, follow) of each mode by its name."""

    def boot_mode(self) -> str:
        """The mode after boot."""
        return self.manual_mode

    @abstractmethod
    def supervise(self) -> None:
        """Failsafes, once a step."""

    @abstractmethod
    def finished(self) -> None:
        """An activity has come to its end."""

    @abstractmethod
    def setpoint(self, message: Any) -> None:
        """A SET_POSITION_TARGET message."""

    @abstractmethod
    def set_mode(self, name: str | None) -> list[int]:
        """Results of a mode command, in the order in which they are told."""

    @abstractmethod
    def arm(self, force: bool) -> int:
        """Result of a command to arm."""

    @abstractmethod
    def take_off(self, command: Command) -> int:
        """Result of a command to take off."""

    @abstractmethod
    def disarm_command(self, command: Command) -> int:
        """Result of a command to disarm."""

    def prearm_checks(self) -> int:
        """Result of a command to run the checks before arming."""
        return int(mav.MAV_RESULT_UNSUPPORTED)

    def reaches(self, target: Target) -> bool:
        """Whether it would fly to a position."""
        return True

    @abstractmethod
    def land_after_failure(self) -> None:
        """The state estimate has failed in flight."""

    # State

    @property
    def estimate_ok(self) -> bool:
        """Whether the EKF knows position and velocity."""
        coasted = self.gnss_lost_s is not None and self.time_s - self.gnss_lost_s > self.settings.gps_coast_s
        return self.time_s >= self.settings.ready_s and not self.faults.estimate_lost and not coasted

    @property
    def ready(self) -> bool:
        """Whether the checks before arming pass."""
        return self.estimate_ok and not self.faults.gnss_lost and self.sensed.intact

    @property
    def airborne(self) -> bool:
        """Whether it flies."""
        wreck = not self.armed and self.sensed.height_m < AIRBORNE_M
        return self.flies and not self.sensed.landed and not wreck

    @property
    def role(self) -> str:
        """Role of the mode."""
        return self.roles[self.mode]

    @property
    def charge(self) -> float:
        """Share of the battery that is told to be left."""
        return self.sensed.charge if self.faults.battery is None else self.faults.battery

    # Changes

    def tick(self, sensed: Sensed) -> Motion:
        """Go on by a step: from what is sensed to what the body is to do."""
        dt = self.settings.step_s
        self.time_s += dt
        self.sensed = sensed
        if self.faults.gnss_lost and self.gnss_lost_s is None:
            self.gnss_lost_s = self.time_s
        elif not self.faults.gnss_lost:
            self.gnss_lost_s = None
        if self.airborne:
            self.ground_s = None
            self.flown = self.flown or sensed.height_m > AIRBORNE_M
        elif self.ground_s is None:
            self.ground_s = self.time_s
        if self.armed and not sensed.intact:
            self.text(mav.MAV_SEVERITY_EMERGENCY, "Crash: Disarming")
            self.disarm()
        if self.armed and (self.airborne or not self.flies) and not self.estimate_ok:
            self.land_after_failure()
        self.supervise()
        if self.armed and self.activity.done:
            self.finished()
        if not self.armed:
            return Motion(yaw_rad=self.activity.yaw_rad)
        return self.activity.motion(sensed, dt)

    def disarm(self) -> None:
        """Stop the motors."""
        self.armed, self.flown = False, False
        self.activity = self.make(Idle)

    def start_motors(self) -> None:
        """Arm, and begin what the mode does."""
        self.armed, self.armed_s, self.flown = True, self.time_s, False
        self.ground_s = self.time_s
        self.home_m = np.array(self.sensed.position_m)
        self.begin()

    def enter(self, mode: str) -> None:
        """Change the mode and begin what it does."""
        self.mode = mode
        self.begin()

    def begin(self) -> None:
        """Begin what the mode does, where it is armed."""
        if not self.armed:
            self.activity = self.make(Idle)
            return
        role = self.role
        if role == "return":
            self.activity = self.returning()
        elif role == "land":
            self.activity = self.make(Land)
        elif role == "follow":
            self.activity = self.following()
        elif role == "takeoff":
            self.activity = self.climbing(float(self.parameters.get("MIS_TAKEOFF_ALT", 2.5)))
        else:
            self.activity = self.resting()

    def resting(self) -> Activity:
        """Hold in the air, idle on the ground."""
        return self.make(Hold) if self.airborne or not self.flies else self.make(Idle)

    def following(self) -> Activity:
        """What follows setpoints begins with."""
        return self.resting()

    def climbing(self, height_m: float) -> Activity:
        """A take-off to a height above where it stands."""
        return self.make(TakeOff, top_m=float(self.sensed.position_m[2]) + height_m)

    def returning(self) -> Activity:
        """A flight home."""
        height, wait = self.return_height_m()
        return self.make(Return, home_m=self.home_m, cruise_m=float(self.home_m[2]) + height, wait_s=wait)

    @abstractmethod
    def return_height_m(self) -> tuple[float, float]:
        """Height above home of a flight home, and how long it waits there before it lands."""

    def make(self, kind: Any, **fields: Any) -> Any:
        """An activity that keeps the heading."""
        yaw = yaw_of_quaternion(self.sensed.quaternion)
        return kind(self.settings, self.flies, yaw, **fields)

    def follow(self, target: Any) -> None:
        """Follow a target, also from the ground."""
        if isinstance(self.activity, Follow):
            self.activity.target = target
        else:
            self.activity = self.make(Follow, target=target)

    # Faults that happen at once

    def operator_mode(self, name: str) -> None:
        """The operator changes the mode, as by a switch of the remote control."""
        if name not in self.modes:
            raise ValueError(f"there is no mode '{name}': {', '.join(self.modes)}")
        self.take_over()
        self.enter(name)

    def take_over(self) -> None:
        """The operator decides from now on."""
        self.failsafe = False

    # Messages

    def send(self, message: Any) -> None:
        """Send to whoever listens."""
        self.outbox.append(message)

    def text(self, severity: int, sentence: str) -> None:
        """Tell in words, where this autopilot does; a repeated sentence is told once in a while."""
        last = self._told.get(sentence, -math.inf)
        if self.time_s - last < HEARD_AGAIN_S:
            return
        self._told[sentence] = self.time_s
        self.log.append(sentence)
        if self.settings.status_text:
            self.send(mav.MAVLink_statustext_message(severity, sentence.encode()[:50]))

    def place(self) -> Geodetic:
        """Where it is on the Earth."""
        return geodetic_of_enu(self.sensed.position_m, self.world_origin)

    def world_of(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Array:
        """A place of the Earth in the world."""
        return enu_of_geodetic(Geodetic(latitude_deg, longitude_deg, altitude_m), self.world_origin)

    @property
    def home_altitude_m(self) -> float:
        """Altitude of the home."""
        return self.world_origin.altitude_m + float(self.home_m[2])

    def origin_of(self, position_m: Array) -> Geodetic:
        """A place of the world on the Earth."""
        return geodetic_of_enu(position_m, self.world_origin)
