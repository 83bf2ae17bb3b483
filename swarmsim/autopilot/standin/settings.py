"""Numbers of the stand-in autopilot: those of ``configs/autopilots/standin_*.yaml``."""

from typing import Annotated, Literal

from pydantic import Field

from swarmsim.autopilot.settings import load_settings as settings_of
from swarmsim.config.autopilot import Origin
from swarmsim.config.base import Delay, Duration, Length, Model, Name, Speed, Vec2
from swarmsim.config.errors import InputError

Kind = Literal["px4", "ardupilot"]
KINDS: tuple[Kind, ...] = ("px4", "ardupilot")
Rate = Annotated[float, Field(gt=0, le=200)]  # Hz


class DefaultVehicle(Model):
    """The vehicle that stands in where no mission is given."""

    site: Name
    type: Name
    position_m: Vec2


class Setpoints(Model):
    """How setpoints are followed: what PX4 asks of their stream, and ArduPilot's time-out of velocities."""

    stream_s: Delay
    failsafe_s: Delay
    timeout_s: Duration | None


class Manners(Model):
    """How fast a simulated vehicle flies what it does by itself, and how often it is stepped."""

    step_s: float = Field(ge=0.005, le=0.1)
    take_off_speed_m_s: Speed
    land_speed_m_s: Speed
    land_speed_high_m_s: Speed
    land_low_m: Length
    return_speed_m_s: Speed
    arrived_m: Length


class Settings(Manners):
    """One kind of autopilot. A whole number among the ``parameters`` is an integer parameter."""

    autopilot: Kind
    ready_s: Delay
    origin: Origin
    default: DefaultVehicle
    version: tuple[int, int, int]
    gps_coast_s: Delay
    streams: dict[str, Rate]
    status_text: bool
    setpoint: Setpoints
    parameters: dict[str, int | float]


def load_settings(kind: str) -> Settings:
    """Settings of ``px4`` or ``ardupilot``, from the working folder's ``configs`` or the shipped ones."""
    if kind not in KINDS:
        raise InputError.of(f"there is no autopilot '{kind}'", given=kind, allowed=" or ".join(KINDS))
    settings: Settings = settings_of(f"standin_{kind}", Settings)
    return settings
