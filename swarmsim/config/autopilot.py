"""How a vehicle of a mission is flown on a real autopilot (``swarmsim fly``)."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from swarmsim.config.base import Acceleration, Delay, Duration, Fraction, Gap, Model, Speed
from swarmsim.config.manual import Manual


class Origin(Model):
    """Where the origin of the mission's site lies on the Earth: WGS-84, the altitude above mean sea level."""

    latitude_deg: float = Field(ge=-89, le=89)
    longitude_deg: float = Field(ge=-180, le=180)
    altitude_m: float = Field(ge=-500, le=9000)


class SetpointLimits(Model):
    """What no setpoint that is sent may exceed; it is checked before any byte leaves.

    A position stays inside the site's outline less ``margin_m``, between ``floor_m`` below and ``ceiling_m`` above
    where the vehicle started. Two positions in a row may lie ``jump_m`` farther apart than the speed allows.
    """

    speed_m_s: Speed = 8.0
    climb_m_s: Speed = 3.0
    acceleration_m_s2: Acceleration = 6.0
    yaw_rate_deg_s: Annotated[float, Field(ge=1, le=720)] = 120.0
    jump_m: Gap = 1.0
    margin_m: Gap = 1.0
    floor_m: Gap = 5.0
    ceiling_m: Annotated[float, Field(ge=1, le=10_000)] = 120.0


class Watchdogs(Model):
    """After how long what is missed: setpoints of the mission, heartbeats and positions of the vehicle.

    A vehicle whose setpoints are ``stale_s`` old holds; ``hold_s`` later it does what ``then`` says, and the mission
    does not take it back. The same happens to one that holds while the mission plans, after ``planning_s``. A battery
    below ``battery`` ends its part of the mission, and so does a measured position that jumps by more than ``jump_m``
    beyond what its speed explains: the state estimate was reset, and the setpoints are somewhere else now.

    A vehicle that does not follow its positions holds as one whose setpoints are stale: one that is farther than
    ``away_m`` from them for ``away_s``, or that has not left a place of ``stuck_m`` around it for ``stuck_s`` though
    its setpoint lies farther off. The policies' references wait 1 to 2 m ahead of a vehicle that lags: a vehicle to
    which no setpoint comes any more stays that near, and only standing there tells it. In flight it lags as much and
    moves; corners and gusts add 2 to 3 m for a second or two, telemetry that is ``position_s`` old the way flown
    meanwhile, at most 8 m by the limits.
    """

    stale_s: Duration = 0.5
    planning_s: Duration = 120.0
    hold_s: Delay = 5.0
    then: Literal["land", "return"] = "land"
    heartbeat_s: Duration = 3.0
    position_s: Duration = 1.0
    jump_m: Gap = 3.0
    away_m: Gap = 10.0
    away_s: Duration = 5.0
    stuck_m: Gap = 1.5
    stuck_s: Duration = 10.0
    battery: Fraction = 0.2


class Autopilot(Model):
    """How a vehicle is flown on a real autopilot.

    ``at_end``: what it does when its part of the mission has ended in the air, and on Ctrl-C. When the operator changes
    its mode we stop commanding at once, for good.

    With ``origin`` the vehicle's place in the mission is where its receiver says, which must be within ``start_m`` of
    its start there; without it the place where the vehicle stands before the flight is taken for its start. Heights
    always count from where it stands.
    """

    origin: Origin | None = None
    start_m: Gap = 3.0
    stream_hz: float = Field(default=20.0, ge=5, le=100)
    take_off_m: float = Field(default=3.0, ge=0.5, le=100)
    at_end: Literal["land", "hold", "return"] = "land"
    ready_s: Duration = 120.0
    answer_s: Duration = 5.0
    take_off_s: Duration = 60.0
    land_s: Duration = 120.0
    limits: SetpointLimits = SetpointLimits()
    watchdogs: Watchdogs = Watchdogs()
    manual: Manual = Manual()

    @model_validator(mode="after")
    def _stream_is_not_stale(self) -> "Autopilot":
        if self.watchdogs.stale_s * self.stream_hz < 2.0:
            raise ValueError(
                "watchdogs.stale_s is less than two periods of stream_hz: give it more, or stream more often"
            )
        return self
