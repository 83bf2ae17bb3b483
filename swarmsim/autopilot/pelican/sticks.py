"""From what the loop demands to the sticks of a Pelican, in each of the modes that the operator's switch selects."""

import math

from swarmsim.autopilot.outer_loop import GRAVITY_M_S2, Demand
from swarmsim.autopilot.pelican.packets import STICK_MAX, THRUST_MAX, Control, FlightMode
from swarmsim.autopilot.pelican.settings import PelicanSettings

_STEP_MAX_S = 0.2
_LIFT_MAX_M_S2 = 5.0  # of the integral in attitude mode


class Sticks:
    """The sticks of one vehicle; its state is the integral of the climb rate's error in attitude mode."""

    def __init__(self, settings: PelicanSettings):
        """At rest."""
        self._settings = settings
        self._lift_m_s2 = 0.0

    def reset(self) -> None:
        """Forget the integral."""
        self._lift_m_s2 = 0.0

    def of(self, demand: Demand, yaw_rad: float, climb_m_s: float, mode: FlightMode, dt_s: float) -> Control:
        """The command for a vehicle with that heading and climb rate, in the mode that its status tells."""
        scales, signs = self._settings.scales, self._settings.signs
        if mode & FlightMode.POSITION:
            forward, left = (STICK_MAX * v / scales.speed_m_s for v in demand.level_velocity(yaw_rad))
        else:
            forward, left = (math.degrees(a) / scales.tilt_deg for a in demand.tilt(yaw_rad))
        turn = math.degrees(demand.turn_rad_s) / scales.turn_deg_s
        if mode & (FlightMode.HEIGHT | FlightMode.POSITION):
            thrust = STICK_MAX * (1.0 + demand.velocity_m_s[2] / scales.climb_m_s)
        else:
            thrust = THRUST_MAX * self._collective(demand, climb_m_s, dt_s)
        return Control(
            pitch=signs.pitch_stick * _stick(forward, STICK_MAX),
            roll=signs.roll_stick * _stick(left, STICK_MAX),
            yaw=signs.yaw_stick * _stick(turn, scales.yaw_max),
            thrust=max(0, min(THRUST_MAX, round(thrust))),
        )

    def _collective(self, demand: Demand, climb_m_s: float, dt_s: float) -> float:
        """Share of the full thrust that brings about the climb rate."""
        loop = self._settings.thrust
        error = demand.velocity_m_s[2] - climb_m_s
        grown = self._lift_m_s2 + loop.integral_1_s2 * error * min(dt_s, _STEP_MAX_S)
        self._lift_m_s2 = max(-_LIFT_MAX_M_S2, min(_LIFT_MAX_M_S2, grown))
        lift = math.hypot(GRAVITY_M_S2 + loop.gain_1_s * error + self._lift_m_s2, *demand.acceleration_m_s2)
        return self._settings.scales.hover_thrust * lift / GRAVITY_M_S2


def _stick(counts: float, limit: int) -> int:
    return max(-limit, min(limit, round(counts)))
