"""What differs between autopilots, as data: ``configs/autopilots/*.yaml``, chosen by what the vehicle says it is."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from swarmsim.autopilot.link import LinkError, Mode
from swarmsim.config import files
from swarmsim.config.base import Duration, Model, Name, NonNegative
from swarmsim.config.errors import InputError
from swarmsim.config.load import load_model
from swarmsim.config.names import did_you_mean, one_of

Byte = Annotated[int, Field(ge=0, le=255)]
Bits = Annotated[int, Field(ge=0, le=0xFFFF)]
Rate = Annotated[float, Field(gt=0, le=200)]
Text = Annotated[str, Field(min_length=1, max_length=400)]
AUTOPILOTS = ("px4", "ardupilot")
VEHICLES = ("copter", "rover")


class Estimator(Model):
    """When the state estimate can be flown on: which flags of which message are needed, and which must not be set."""

    message: Literal["ESTIMATOR_STATUS", "EKF_STATUS_REPORT"]
    needed: Bits
    forbidden: Bits = 0


class Rule(Model):
    """What a parameter should be before take-off, and what to say where it is not."""

    parameter: Annotated[str, Field(min_length=1, max_length=16)]
    severity: Literal["refuse", "warn", "tell"]
    say: Text
    min: float | None = None
    max: float | None = None
    unequal: float | None = None

    def broken_by(self, value: float) -> bool:
        """Whether the parameter's value is outside of what it should be; a rule without bounds tells any value."""
        if self.min is None and self.max is None and self.unequal is None:
            return True
        below = self.min is not None and not value >= self.min
        above = self.max is not None and not value <= self.max
        return below or above or (self.unequal is not None and value == self.unequal)


class Setpoints(Model):
    """How setpoints are encoded: frames (MAV_FRAME) and what the vehicle makes of the fields."""

    frame_local: Byte
    frame_body: Byte
    acceleration: bool
    """Whether acceleration is fed forward; otherwise it is not sent."""
    position_with_velocity: bool
    """Whether the velocity of a setpoint with a position is fed forward; otherwise it is not sent."""
    heading_kept_by: Literal["ignore", "zero_rate", "motion"]
    """What keeps the heading where a setpoint has none: both fields ignored, a yaw rate of zero; a rover's follows
    its motion."""
    turns_by: Literal["rate", "direction"] = "rate"
    """What turns a vehicle in the body frame: the yaw rate, or the direction of the velocity (PX4 rovers)."""
    turn_gain_1_s: Annotated[float, Field(gt=0, le=100)] = 1.0
    """With ``direction``: yaw rate by error of direction."""
    still_m_s: NonNegative = 0.0
    """Slower than this a rover is told to stand, in a way that does not turn it to the north."""
    reverse: bool = True


class Command(Model):
    """How the vehicle is brought to follow setpoints and off the ground."""

    stream_first_s: NonNegative
    """Setpoints must be streamed for this long before the mode is asked for."""
    takeoff: bool
    """Whether NAV_TAKEOFF is needed; otherwise setpoints lift it off."""


class VehicleProfile(Model):
    """One kind of vehicle of an autopilot."""

    types: tuple[Byte, ...]  # MAV_TYPE
    modes: dict[str, tuple[Byte, Byte]]
    """Main and sub mode by name: PX4's custom_mode has both, ArduPilot's the first alone."""
    follow: tuple[str, ...]
    """Names of the modes of each role: the first is commanded, the others count as the same."""
    hold: tuple[str, ...]
    land: tuple[str, ...]
    return_: Annotated[tuple[str, ...], Field(alias="return")]
    takeoff: tuple[str, ...] = ()
    setpoints: Setpoints
    command: Command
    rules: tuple[Rule, ...] = ()


class Autopilot(Model):
    """A file of ``configs/autopilots``."""

    name: Name
    autopilot: Byte  # MAV_AUTOPILOT
    custom_mode: Literal["number", "main_and_sub"]
    integer_parameters: Literal["value", "bits"]
    """Whether integers come as the value of the float, or as its bit pattern."""
    runs_prearm_checks: bool
    """Whether RUN_PREARM_CHECKS has it say in words why it cannot be armed."""
    prearm_is_present: bool
    """Whether SYS_STATUS names the pre-arm check among the present ones; otherwise its health alone is told."""
    gnss_fix_min: Byte
    battery_min: Annotated[float, Field(ge=0, le=1)]
    estimator: Estimator
    messages_hz: dict[str, Rate]
    polled_hz: dict[str, Rate] = Field(default_factory=dict)
    """Messages that are asked for one by one, as their rate cannot be set."""
    silent_s: Duration
    """A message that was asked for and has not come for this long is asked for again."""
    advice: dict[str, Text] = Field(default_factory=dict)
    """What to do where a command is refused, by what was wanted: follow, arm, take off, hold, land, return."""
    nav_states: dict[Byte, Name] = Field(default_factory=dict)
    """Names of the modes by vehicle_status.nav_state, as logs of PX4 have it."""
    copter: VehicleProfile
    rover: VehicleProfile


class Profile:
    """An autopilot with one kind of vehicle."""

    def __init__(self, autopilot: Autopilot, vehicle: str):
        """``vehicle`` is copter or rover; raises `InputError` where a role names a mode that the table lacks."""
        self.autopilot = autopilot
        self.vehicle = vehicle
        self.kind: VehicleProfile = getattr(autopilot, vehicle)
        self._roles: dict[Mode, tuple[str, ...]] = {
            Mode.FOLLOW: self.kind.follow,
            Mode.HOLD: self.kind.hold,
            Mode.LAND: self.kind.land,
            Mode.RETURN: self.kind.return_,
            Mode.TAKEOFF: self.kind.takeoff,
        }
        unknown = [name for names in self._roles.values() for name in names if name not in self.kind.modes]
        if unknown:
            allowed = one_of(self.kind.modes)
            raise InputError.of(f"{autopilot.name} {vehicle} has no mode {unknown[0]}", allowed=allowed)
        self._names = {self._custom(*mode): name for name, mode in self.kind.modes.items()}
        self._modes = {name: mode for mode, names in reversed(self._roles.items()) for name in names}

    def _custom(self, main: int, sub: int) -> int:
        return main << 16 | sub << 24 if self.autopilot.custom_mode == "main_and_sub" else main

    def command_of(self, mode: Mode) -> tuple[str, int, tuple[int, int]]:
        """Name, HEARTBEAT.custom_mode and parameters 2 and 3 of DO_SET_MODE of the mode to command."""
        names = self._roles.get(mode)
        if not names:
            raise ValueError(f"{mode} cannot be commanded")
        main, sub = self.kind.modes[names[0]]
        return names[0], self._custom(main, sub), (main, sub)

    def mode_of(self, custom_mode: int) -> tuple[Mode, str]:
        """The mode that HEARTBEAT.custom_mode tells, and its name."""
        name = self._names.get(custom_mode)
        if name is None:
            return Mode.OTHER, f"mode {custom_mode}"
        return self._modes.get(name, Mode.OTHER), name


def load_autopilot(name: str) -> Autopilot:
    """The autopilot of this name from the first ``configs/autopilots`` that has it; raises `InputError`."""
    found = {p.stem: p for folder in reversed(files.config_dirs()) for p in _yaml_files(folder)}
    if name not in found:
        hint = did_you_mean(name, found)
        raise InputError.of(f"there is no autopilot '{name}'", allowed=one_of(found), suggestion=hint)
    autopilot: Autopilot = load_model(found[name], Autopilot)
    return autopilot


def _yaml_files(folder: Path) -> list[Path]:
    return sorted(files.listing(folder / "autopilots", "*.yaml"))


def load_profile(autopilot: str, vehicle: str) -> Profile:
    """The profile of ``px4`` or ``ardupilot``, ``copter`` or ``rover``; raises `InputError`."""
    if vehicle not in VEHICLES:
        hint = did_you_mean(vehicle, VEHICLES)
        raise InputError.of(f"there is no vehicle '{vehicle}'", allowed=one_of(VEHICLES), suggestion=hint)
    return Profile(load_autopilot(autopilot), vehicle)


def detect_profile(autopilot: int, vehicle_type: int, wanted: str = "auto", vehicle: str = "auto") -> Profile:
    """The profile by HEARTBEAT.autopilot and type; raises `LinkError` where it is none, or not the one ``wanted``."""
    for name in AUTOPILOTS:
        known = load_autopilot(name)
        if known.autopilot != autopilot:
            continue
        for kind in VEHICLES:
            if vehicle_type not in getattr(known, kind).types:
                continue
            if wanted not in ("auto", name) or vehicle not in ("auto", kind):
                expected = " ".join(word for word in (wanted, vehicle) if word != "auto")
                raise LinkError(f"the vehicle is {name} {kind}, not {expected}: check port and system id")
            return Profile(known, kind)
        raise LinkError(f"{name} flies a vehicle of MAV_TYPE {vehicle_type}; known are copters and rovers")
    raise LinkError(f"the vehicle's autopilot is MAV_AUTOPILOT {autopilot}; known are {' and '.join(AUTOPILOTS)}")
