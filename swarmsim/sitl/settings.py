"""How firmware of one kind is joined to our physics: the numbers of ``configs/autopilots/sitl_*.yaml``."""

from typing import Literal

from pydantic import Field

from swarmsim.autopilot.settings import load_settings
from swarmsim.config.autopilot import Origin
from swarmsim.config.base import Delay, Duration, Model, Name
from swarmsim.config.errors import InputError
from swarmsim.config.mission import Timing

KINDS = ("px4", "ardupilot")


class RoverChannels(Model):
    """Which outputs turn a rover's sides."""

    left: int = Field(ge=0, le=15)
    right: int = Field(ge=0, le=15)


class SitlSettings(Model):
    """One kind of firmware.

    ``origin`` is where the site lies if the mission does not say. ``period_s`` is one exchange of sensors and
    actuators. ``port`` is that of the first vehicle's physics and ``link_port`` that of its MAVLink, both ``*_step``
    apart from vehicle to vehicle. ``motors_deg`` are the azimuths of the firmware's motors by their number, clockwise
    from the nose; empty where it takes the order of the vehicle's file. An answer is waited for ``wait_s``, the very
    first for ``first_wait_s``; one that took more than ``stall_s`` counts as a stall, and after ``lost_s`` without any
    the firmware is taken to have ended.
    """

    autopilot: Literal["px4", "ardupilot"]
    period_s: float = Field(ge=0.001, le=0.02)
    physics_steps: int = Field(ge=1, le=20)
    judge_period_s: float = Field(ge=0.001, le=0.1)
    origin: Origin
    port: int = Field(ge=1, le=65_000)
    port_step: int = Field(ge=1, le=100)
    link: str
    link_port: int = Field(ge=1, le=65_000)
    link_port_step: int = Field(ge=1, le=100)
    sensors: tuple[Name, ...]
    state_hz: float = Field(gt=0, le=1000)
    satellites: int = Field(ge=0, le=60)
    motors_deg: dict[int, tuple[float, ...]]
    rover_answers: bool
    rover_channels: RoverChannels
    start_s: Duration
    first_wait_s: Duration
    wait_s: Duration
    lost_s: Duration
    stall_s: Delay

    @property
    def timing(self) -> Timing:
        """Timing of a world that is stepped once an exchange."""
        return Timing(
            control_period_s=self.period_s, physics_steps=self.physics_steps, judge_period_s=self.judge_period_s
        )

    def link_of(self, number: int) -> str:
        """The link string of ``swarmsim fly`` for a vehicle."""
        return self.link.format(port=self.link_port + number * self.link_port_step)


def load_sitl_settings(kind: str) -> SitlSettings:
    """Settings of ``px4`` or ``ardupilot``, from the working folder's ``configs`` or the shipped ones."""
    if kind not in KINDS:
        raise InputError.of(f"there is no autopilot '{kind}'", given=kind, allowed=" or ".join(KINDS))
    return load_settings(f"sitl_{kind}", SitlSettings)
