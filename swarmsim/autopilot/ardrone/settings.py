"""How an AR.Drone 2.0 is flown: ``configs/autopilots/ardrone2.yaml``."""

from typing import Annotated

from pydantic import Field

from swarmsim.autopilot.outer_loop import Angle, LoopSettings, TurnRate
from swarmsim.config.base import Duration, Fraction, Length, Model, Speed

Port = Annotated[int, Field(ge=1, le=65_535)]


class Limits(Model):
    """What is written to the drone's configuration: the arguments of PCMD are shares of the first three."""

    tilt_deg: Angle  # control:euler_angle_max
    climb_m_s: Speed  # control:control_vz_max
    turn_deg_s: TurnRate  # control:control_yaw
    height_m: Length  # control:altitude_max
    outdoor: bool  # control:outdoor
    without_hull: bool  # control:flight_without_shell


class ArdroneSettings(Model):
    """An AR.Drone 2.0.

    ``start_heading_deg`` is where its nose points when it is aligned, counter-clockwise from east: it knows no north.
    ``gap_s`` is the longest pause between navdata that its position can be reckoned over.
    """

    command_port: Port
    navdata_port: Port
    rate_hz: float = Field(ge=10, le=100)
    demo: bool
    start_heading_deg: float = Field(ge=-360, le=360)
    stale_s: Duration
    gap_s: Duration
    acknowledge_s: Duration
    battery_min: Fraction
    limits: Limits
    loop: LoopSettings
