"""From what a policy commands to what is sent to a vehicle, and from telemetry to a body of the mission."""

from typing import Any

import numpy as np

from swarmsim.autopilot.link import LinkError, Setpoint, Telemetry, Vector
from swarmsim.control.commands import DRIVE, POSITION, MultirotorCommand, PositionCommand, SkidSteerCommand
from swarmsim.vehicles.state import RigidState


def setpoint_of(command: Any) -> Setpoint:
    """The setpoint of a command that `swarmsim.missions.external.command_of` gives.

    Raises `LinkError` for levels that no autopilot takes from outside.
    """
    if isinstance(command, MultirotorCommand | PositionCommand):
        return _of_multirotor(command)
    if isinstance(command, SkidSteerCommand):
        return _of_rover(command)
    raise LinkError(f"a {type(command).__name__} cannot be sent to a vehicle")


def _of_multirotor(command: MultirotorCommand | PositionCommand) -> Setpoint:
    if isinstance(command, MultirotorCommand) and int(command.level) != POSITION:
        raise LinkError(
            "the policy commands attitudes, body rates or rotor speeds: a real autopilot is flown by positions and "
            "velocities; choose a policy that returns a PositionCommand"
        )
    acceleration = _vector(command.acceleration_m_s2)
    return Setpoint(
        position_m=_vector(command.position_m) if float(command.hold_position) >= 0.5 else None,
        velocity_m_s=_vector(command.velocity_m_s),
        acceleration_m_s2=acceleration if any(acceleration) else None,
        yaw_rad=float(command.yaw_rad),
    )


def _of_rover(command: SkidSteerCommand) -> Setpoint:
    if int(command.level) != DRIVE:
        raise LinkError("the policy commands wheel speeds: a real rover is driven by velocities; choose another policy")
    ahead, turn = float(command.speed_m_s), float(command.yaw_rate_rad_s)
    return Setpoint(velocity_m_s=(ahead, 0.0, 0.0), yaw_rate_rad_s=turn, body=True)


def hold_at(telemetry: Telemetry, flies: bool) -> Setpoint:
    """The setpoint that keeps a vehicle where it is."""
    if not flies:
        return Setpoint(velocity_m_s=(0.0, 0.0, 0.0), yaw_rate_rad_s=0.0, body=True)
    assert telemetry.position_m is not None
    return Setpoint(position_m=telemetry.position_m, velocity_m_s=(0.0, 0.0, 0.0))


def body_of(telemetry: Telemetry, before: RigidState) -> RigidState:
    """The body of the mission's vehicle as it was measured; what is not measured is as ``before``."""

    def known(measured: Any, old: Any) -> Any:
        return np.asarray(old if measured is None else measured, np.float32)

    return RigidState(
        position_m=known(telemetry.position_m, before.position_m),
        quaternion=known(telemetry.quaternion, before.quaternion),
        velocity_m_s=known(telemetry.velocity_m_s, before.velocity_m_s),
        angular_velocity_rad_s=known(telemetry.angular_velocity_rad_s, before.angular_velocity_rad_s),
    )


def _vector(values: Any) -> Vector:
    x, y, z = (float(v) for v in np.asarray(values))
    return x, y, z
