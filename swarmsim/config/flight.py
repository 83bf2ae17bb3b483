"""How a mission's multirotors fly: which effects are taken into account, and their failsafes."""

from typing import Annotated, Literal

from pydantic import Field

from swarmsim.config.base import Delay, Fraction, Gap, Model


class FlightEffects(Model):
    """Effects that can be left out one by one, to see what each does. All are on by default.

    An effect also needs its numbers in the vehicle's file: one without a solidity, say, has no inflow.
    """

    rotor_drag: bool = True
    rolling_moment: bool = True
    inflow: bool = True
    translational_lift: bool = True
    ground_effect: bool = True
    battery_sag: bool = True
    downwash: bool = True
    motor_noise: bool = True


Action = Literal["none", "hold", "return", "land"]


class Failsafe(Model):
    """What sets in, and what the vehicle then does; ``none``: nothing."""

    action: Action = "none"


class Fence(Failsafe):
    """The site's outline less ``margin_m``, and a ceiling above the terrain. It is felt a braking distance ahead."""

    action: Action = "return"
    margin_m: Gap = 0.0
    ceiling_m: Annotated[float, Field(ge=1, le=10_000)] = 120.0


class WindFailsafe(Failsafe):
    """For ``after_s`` the air carries the vehicle off, faster than ``drift_m_s``, although it does nearly all it can.

    Nearly all is a ``share`` of the largest tilt (as tangents) or rotor speed. A vehicle that only lags behind in a
    gust flies on; where the wind would have it over the fence before it is down it lands at once.
    """

    action: Action = "land"
    share: float = Field(default=0.9, ge=0.01, le=1)
    drift_m_s: Annotated[float, Field(ge=0, le=100)] = 1.0
    after_s: Delay = 8.0


class BatteryFailsafe(Failsafe):
    """No more than ``charge`` of the battery is left (PX4's default BAT_LOW_THR is 0.15)."""

    action: Action = "return"
    charge: Fraction = 0.15


class LinkFailsafe(Failsafe):
    """Further than ``range_m`` from its start, where the ground station is, for ``after_s`` (PX4's COM_DL_LOSS_T)."""

    range_m: Annotated[float, Field(ge=0.1, le=1e6)] = 1000.0
    after_s: Delay = 10.0


class Failsafes(Model):
    """What autopilots do by themselves, as PX4 and ArduPilot do; the action ``none`` switches one off.

    A vehicle that returns climbs to ``return_clearance_m`` above everything on the site, flies to where it started, and
    lands there. One that lands elsewhere flies to the nearest place within the fence that is flat and where nothing
    stands within its radius and ``landing_clearance_m``, above what stands around it on the way.
    """

    fence: Fence = Fence()
    wind: WindFailsafe = WindFailsafe()
    battery: BatteryFailsafe = BatteryFailsafe()
    link: LinkFailsafe = LinkFailsafe()
    return_clearance_m: Gap = 5.0
    landing_clearance_m: float = Field(default=2.0, ge=0.0, le=100.0)
