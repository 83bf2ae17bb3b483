"""What of a multirotor's aerodynamics and power a mission takes into account."""

from swarmsim.config.base import Model


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
