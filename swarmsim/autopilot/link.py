"""What every link to a vehicle can do, whatever it speaks: `VehicleLink`, what is sent and what is received.

World ENU of the mission, body FLU, SI units. Times are those of `time.monotonic`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from swarmsim.autopilot.frames import Geodetic

Vector = tuple[float, float, float]


class LinkError(Exception):
    """The vehicle or the link to it does not do what a flight needs; the message says what, and what to do."""


@dataclass(frozen=True)
class Setpoint:
    """What the vehicle is to do now; at least one of position and velocity is given.

    A position may have a velocity, and both an acceleration, fed forward. Of yaw and yaw rate one at most is given; a
    multirotor without either keeps its heading, a rover heads where it drives. In the ``body`` frame there is no
    position, and the velocity is forward, left, up: how a rover is driven.
    """

    position_m: Vector | None = None
    velocity_m_s: Vector | None = None
    acceleration_m_s2: Vector | None = None
    yaw_rad: float | None = None  # counter-clockwise from east
    yaw_rate_rad_s: float | None = None  # counter-clockwise seen from above
    body: bool = False


class Mode(Enum):
    """Flight modes that are told apart; how an autopilot calls its own stands in `Telemetry.mode_name`."""

    FOLLOW = "follow"  # it follows setpoints: OFFBOARD, GUIDED
    HOLD = "hold"
    LAND = "land"
    RETURN = "return"
    TAKEOFF = "takeoff"
    OTHER = "other"  # the operator's


@dataclass(frozen=True)
class Telemetry:
    """The latest that is known of the vehicle; None for what it has not told yet."""

    heard_s: float | None = None  # when its last heartbeat came
    pose_s: float | None = None  # when its last position came
    position_m: Vector | None = (
        None  # world, after `VehicleLink.align`; before that relative to the vehicle's own origin
    )
    velocity_m_s: Vector | None = None
    quaternion: tuple[float, float, float, float] | None = None  # w x y z, body to world
    angular_velocity_rad_s: Vector | None = None  # body
    armed: bool | None = None
    mode: Mode = Mode.OTHER
    mode_name: str = "unknown"
    on_ground: bool | None = None
    battery: float | None = None  # share of the capacity that is left
    estimate_ok: bool | None = None  # its state estimate can be flown on
    ready_to_arm: bool | None = None
    failsafe: bool = False  # it acts by itself: a failsafe is active
    place: Geodetic | None = None  # on the Earth, WGS-84, altitude above mean sea level
    gnss_fix: int | None = None  # as GPS_RAW_INT.fix_type: 3 for 3D, 5 and 6 for RTK


@dataclass(frozen=True)
class Identity:
    """Which vehicle a link talks to."""

    autopilot: str  # px4 | ardupilot | ardrone2 | pelican | sim
    vehicle: str  # copter | rover
    system: int
    component: int
    version: str = "unknown"
    reverses: bool = True  # a rover: whether it can be driven backwards


class VehicleLink(Protocol):
    """A vehicle that can be flown from outside. Calls that wait raise `LinkError` when their time is up."""

    identity: Identity
    dry: bool
    """Whether nothing is sent that moves the vehicle."""
    streams_first: bool
    """Whether setpoints must be streamed before it follows them; it then takes off by setpoints as well."""
    arms: bool
    """Whether arming starts its motors; otherwise take-off does, and it tells that it is armed from then on."""

    def telemetry(self) -> Telemetry:
        """The latest that is known; any thread may ask."""

    def on_mode(self, callback: Callable[[Telemetry], None]) -> None:
        """Have ``callback`` called at once, by the thread that reads, when the mode or the arming changes."""

    def align(self, world_m: Vector) -> None:
        """From now on the place where the vehicle is now is ``world_m`` in the mission's world."""

    def preflight(self, tell: Callable[[str], None], timeout_s: float) -> None:
        """Wait until it can be armed; raise with every reason why not when the time is up."""

    def send(self, setpoint: Setpoint) -> None:
        """Send one setpoint; returns at once. Called from the stream's thread alone."""

    def follow(self, timeout_s: float) -> None:
        """Have it follow setpoints, which must be streamed already where the autopilot asks for that."""

    def arm(self, timeout_s: float) -> None:
        """Arm, confirmed by the vehicle's state."""

    def disarm(self, timeout_s: float) -> None:
        """Disarm a vehicle that stands, confirmed by its state; in the air it refuses."""

    def take_off(self, height_m: float, timeout_s: float) -> None:
        """Climb to ``height_m`` above where it stands, where the autopilot needs a command for that; else nothing."""

    def enter(self, mode: Mode, timeout_s: float) -> None:
        """Change to HOLD, LAND or RETURN, confirmed by the vehicle's state."""

    def request(self, mode: Mode) -> None:
        """Ask for a mode without waiting: for an emergency."""

    def messages(self) -> list[str]:
        """What the vehicle has told in words since the last call."""

    def close(self) -> None:
        """Close the link; the vehicle is left as it is."""
