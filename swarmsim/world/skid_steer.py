"""The kind ``skid_steer``: how a rover is controlled, driven and judged (see `swarmsim.world.kinds.Kind`)."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.control.commands import DRIVE, DRIVE_TO, DriveCommand, SkidSteerCommand, skid_steer_command
from swarmsim.control.skid_steer import pursue, wheel_speeds
from swarmsim.physics.contact import Plane
from swarmsim.physics.rotations import rotation_matrix
from swarmsim.physics.skid_steer import make_skid_steer_step, rest_state
from swarmsim.physics.walls import impact_speed
from swarmsim.scalars import Layout
from swarmsim.site import Site
from swarmsim.vehicles.skid_steer import SkidSteerParams
from swarmsim.vehicles.state import SkidSteerState
from swarmsim.world.model import Limits

FLIES = False
TILT_LIMIT_COSINE = 0.5  # a rover tilted by 60 degrees has tipped over


def rest(params: SkidSteerParams, site: Site, start_m: jax.Array, yaw_rad: jax.Array) -> SkidSteerState:
    """At rest on its wheels."""
    return rest_state(params, site, start_m, yaw_rad)


def control_start() -> tuple[()]:
    """The rover's controller remembers nothing."""
    return ()


def full_command(params: SkidSteerParams, command: Any) -> SkidSteerCommand:
    """What a policy returned, with every level."""
    return skid_steer_command(command)


def stay(params: SkidSteerParams, vehicle: SkidSteerState) -> SkidSteerCommand:
    """Stand still."""
    return skid_steer_command(DriveCommand(speed_m_s=jnp.zeros(()), yaw_rate_rad_s=jnp.zeros(())))


def jet(params: SkidSteerParams, vehicle: SkidSteerState) -> tuple[jax.Array, jax.Array]:
    """It has no rotors."""
    return jnp.zeros(()), jnp.zeros(())


def tick(
    params: SkidSteerParams,
    vehicle: SkidSteerState,
    memory: tuple[()],
    command: SkidSteerCommand,
    armed: jax.Array,
    ground: Plane,
    wall: Plane,
    wind_m_s: jax.Array,
    motor_noise: None,
    site: Site,
    *,
    engine: Any,
    dt: float,
    substeps: int,
    layout: Layout,
) -> tuple[SkidSteerState, tuple[()], jax.Array]:
    """Vehicle, controller and speed [] at a wall, after one control period; it brakes if not ``armed``."""
    step = make_skid_steer_step(engine, dt)
    speed, yaw_rate = pursue(params, vehicle, command.position_m, command.speed_m_s)
    to_point = command.level == DRIVE_TO
    speed = jnp.where(armed, jnp.where(to_point, speed, command.speed_m_s), 0.0)
    yaw_rate = jnp.where(armed, jnp.where(to_point, yaw_rate, command.yaw_rate_rad_s), 0.0)
    steered = wheel_speeds(params, speed, yaw_rate, vehicle)
    wheels = jnp.where(armed & (command.level > DRIVE), command.wheel_speed_rad_s, steered)
    hit = impact_speed(params, vehicle, site, substeps * dt)  # before the wall takes the speed off

    def one(vehicle: SkidSteerState, _: None) -> tuple[SkidSteerState, None]:
        return step(params, vehicle, wheels, site), None

    vehicle, _ = jax.lax.scan(one, vehicle, None, length=substeps)
    return vehicle, memory, hit


def knocked(params: SkidSteerParams, vehicle: SkidSteerState, velocity_m_s: jax.Array, spin_nms: jax.Array) -> Any:
    """The rover after a change of its velocity [3] and an angular impulse [3] N m s (world); it stays on the ground."""
    body, level = vehicle.body, jnp.array([1.0, 1.0, 0.0])
    up = rotation_matrix(body.quaternion)[2]
    turn = spin_nms[2] / params.inertia_kg_m2[2, 2] * up
    rate = body.angular_velocity_rad_s + turn
    body = replace(body, velocity_m_s=body.velocity_m_s + level * velocity_m_s, angular_velocity_rad_s=rate)
    return replace(vehicle, body=body)


def height(params: SkidSteerParams, vehicle: SkidSteerState, ground: Plane) -> jax.Array:
    """A rover is taken to stand on the ground: zero []."""
    return jnp.zeros(())


def crashed(
    params: SkidSteerParams, vehicle: SkidSteerState, height_m: jax.Array, impact_m_s: jax.Array, limits: Limits
) -> jax.Array:
    """Whether [] it has tipped over."""
    q = vehicle.body.quaternion
    return 1.0 - 2.0 * (q[1] ** 2 + q[2] ** 2) < TILT_LIMIT_COSINE


def obstructed(
    params: SkidSteerParams, vehicle: SkidSteerState, wall: Plane, impact_m_s: jax.Array, limits: Limits, site: Site
) -> jax.Array:
    """Whether [] it hit a wall faster than it may."""
    return impact_m_s > limits.impact_speed_m_s
