"""How an AscTec Pelican is flown: ``configs/autopilots/pelican.yaml``."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from swarmsim.autopilot.outer_loop import LoopSettings
from swarmsim.config.base import Duration, Fraction, Gain, Length, Model, Positive, Speed

Sign = Literal[-1, 1]
Stick = Annotated[int, Field(ge=1, le=2047)]


class Signs(Model):
    """Directions of the autopilot's angles and sticks, each against forward-left-up: they changed between firmwares.

    An angle's sign times the angle is the one about x (roll), y (nick) and z (heading). A stick's sign times the stick
    tilts forward (pitch), to the left (roll), and turns counter-clockwise (yaw).
    """

    nick_angle: Sign
    roll_angle: Sign
    pitch_stick: Sign
    roll_stick: Sign
    yaw_stick: Sign


class Scales(Model):
    """What a stick means: degrees of tilt and degrees a second of turn for each count, and speeds at full deflection.

    ``yaw_max`` keeps the yaw stick away from where it starts and stops the motors.
    """

    tilt_deg: Positive
    turn_deg_s: Positive
    speed_m_s: Speed
    climb_m_s: Speed
    hover_thrust: Fraction
    yaw_max: Stick


class ThrustLoop(Model):
    """In attitude mode: acceleration from the error of the climb rate, as a gain and an integral."""

    gain_1_s: Gain
    integral_1_s2: Gain


class Battery(Model):
    """Voltages between which the charge is taken as linear."""

    empty_v: Positive
    full_v: Positive

    @model_validator(mode="after")
    def _in_order(self) -> "Battery":
        if self.full_v <= self.empty_v:
            raise ValueError("full_v must exceed empty_v")
        return self


class PelicanSettings(Model):
    """An AscTec Pelican (or Hummingbird) with AutoPilot.

    ``declination_deg`` is where magnetic north lies, clockwise from true north. ``poll_every`` is how many periods lie
    between one poll of status and satellites and the next. ``motors`` is the deflection of the yaw stick that starts
    and stops them with the thrust at zero, ``motors_s`` how long it is held at most. A descent that has stood still
    for ``landed_s`` is a landing.
    """

    rate_hz: float = Field(ge=5, le=50)
    poll_every: int = Field(ge=1, le=20)
    declination_deg: float = Field(ge=-180, le=180)
    stale_s: Duration
    motors: int = Field(ge=-2047, le=2047)
    motors_s: Duration
    accuracy_max_m: Length
    battery_min: Fraction
    battery: Battery
    land_m_s: Speed
    landed_s: Duration
    signs: Signs
    scales: Scales
    thrust: ThrustLoop
    loop: LoopSettings
