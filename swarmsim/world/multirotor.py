"""The kind ``multirotor``: how one is controlled, flown and judged (see `swarmsim.world.kinds.Kind`)."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.control.commands import POSITION, MultirotorCommand, PositionCommand, multirotor_command
from swarmsim.control.multirotor import ControlMemory, control, is_landed
from swarmsim.control.multirotor import control_start as controller
from swarmsim.physics.contact import Plane
from swarmsim.physics.multirotor import make_multirotor_step, rest_state
from swarmsim.physics.rigid_body import over_inertia
from swarmsim.physics.rotations import rotation_matrix, to_body, yaw_of
from swarmsim.scalars import Layout
from swarmsim.site import Site, sample, sample_with_gradient
from swarmsim.site.walls import LOWEST_M, Walls, wall_near
from swarmsim.vehicles.multirotor import MultirotorParams
from swarmsim.vehicles.state import MultirotorState
from swarmsim.world.failsafes import Rescue
from swarmsim.world.model import Limits

FLIES = True
TILT_LIMIT_COSINE = 0.3  # about 72 degrees: beyond it near the ground a multirotor has tipped over
TIP_HEIGHT_M = 1.0
ROOF_SLOPE_MAX = 1.0
ROOF_DEPTH_M = 0.3  # what is no further below a roof's surface than this has landed on it and has not run into it

Command = MultirotorCommand | PositionCommand


def ground_below(site: Site, position_m: jax.Array) -> Plane:
    """Tangent plane of what is below a position [3]: the terrain, or a roof that it is over.

    A surface steeper than `ROOF_SLOPE_MAX` is the edge of something, where the terrain below is what one falls to.
    """
    xy = position_m[:2]
    terrain, slope = sample_with_gradient(site.terrain_m, site, xy)
    roof, pitch = sample_with_gradient(site.surface_m, site, xy)
    over = (roof - terrain > LOWEST_M) & (position_m[2] > roof - ROOF_DEPTH_M)
    over &= jnp.sum(pitch * pitch) < ROOF_SLOPE_MAX**2
    height, slope = jnp.where(over, roof, terrain), jnp.where(over, pitch, slope)
    normal = jnp.append(-slope, 1.0)
    unit = normal * jax.lax.rsqrt(jnp.sum(normal * normal))
    return Plane(point_m=jnp.append(xy, height), normal=unit, velocity_m_s=jnp.zeros(3))


def wall_beside(site: Site, walls: Walls, position_m: jax.Array, half_height_m: jax.Array) -> Plane:
    """Upright plane of the nearest wall at the height of a vehicle's lower end."""
    xy = position_m[:2]
    low = position_m[2] - half_height_m + ROOF_DEPTH_M - sample(site.terrain_m, site, xy)
    distance, normal = wall_near(walls, site, xy, low)
    return Plane(point_m=position_m - jnp.append(distance * normal, 0.0), normal=jnp.append(normal, 0.0))


def rest(params: MultirotorParams, site: Site, start_m: jax.Array, yaw_rad: jax.Array) -> MultirotorState:
    """At rest on its feet, motors off."""
    return rest_state(params, ground_below(site, jnp.append(start_m, 0.0)), yaw_rad)


def control_start() -> ControlMemory:
    """Controller of a vehicle on the ground: motors off until a climb is commanded."""
    return controller(landed=True)


def full_command(params: MultirotorParams, command: Any) -> Command:
    """What a policy returned, its shapes checked; a position command needs no other levels beside it."""
    whole = multirotor_command(command, params.rotor_spin.shape[-1])
    if isinstance(command, PositionCommand):
        return PositionCommand(**{name: getattr(whole, name) for name in vars(command)})
    return whole


def stay(params: MultirotorParams, vehicle: MultirotorState) -> PositionCommand:
    """Brake and hold the velocity at zero, heading as it is."""
    zero = jnp.zeros(3)
    yaw = yaw_of(vehicle.body.quaternion)
    return PositionCommand(
        position_m=zero, velocity_m_s=zero, acceleration_m_s2=zero, yaw_rad=yaw, hold_position=jnp.zeros(())
    )


def rescued(command: Command, rescue: Rescue) -> Command:
    """The command, or what the autopilot flies by itself; the heading stays as commanded."""
    here = rescue.takes_over
    changes: dict[str, Any] = {
        "position_m": jnp.where(here, rescue.position_m, command.position_m),
        "velocity_m_s": jnp.where(here, rescue.velocity_m_s, command.velocity_m_s),
        "acceleration_m_s2": jnp.where(here, 0.0, command.acceleration_m_s2),
        "hold_position": jnp.where(here, 1.0, command.hold_position),
    }
    if isinstance(command, MultirotorCommand):
        changes["level"] = jnp.where(here, POSITION, command.level)
    return replace(command, **changes)


def carried(params: MultirotorParams, vehicle: MultirotorState, share: jax.Array) -> jax.Array:
    """Speed [] m/s at which the air carries it off although it does nearly all that it can; zero while it does less.

    Nearly all is more than ``share`` [] of the largest tilt (as tangents) or of the rotor speed that the battery
    allows. It is carried off when it moves against its own thrust: with the wind, or, its motors full, down.
    """
    up, velocity = rotation_matrix(vehicle.body.quaternion)[:, 2], vehicle.body.velocity_m_s
    level = jnp.sqrt(up[0] * up[0] + up[1] * up[1] + 1e-12)
    tilted = level > share * params.control.tilt_max_tan * jnp.maximum(up[2], 0.1)
    volts = jnp.minimum(1.0, vehicle.voltage_v / jnp.maximum(params.speed_max_voltage_v, 1e-3))
    full = jnp.mean(vehicle.rotor_speed_rad_s) > share * volts * params.speed_max_rad_s
    back = -(up[0] * velocity[0] + up[1] * velocity[1]) / level
    off = jnp.maximum(jnp.where(tilted | full, back, 0.0), jnp.where(full, -velocity[2], 0.0))
    return jnp.maximum(off, 0.0)


def landed(memory: ControlMemory) -> jax.Array:
    """Whether [] it stands on the ground with its motors off."""
    return is_landed(memory)


def rotors(params: MultirotorParams) -> int:
    """How many rotors it has."""
    return int(params.rotor_spin.shape[-1])


def jet(params: MultirotorParams, vehicle: MultirotorState) -> tuple[jax.Array, jax.Array]:
    """Thrust [] N with which it blows at those below it, and the distance [] m of its opposite motors."""
    thrust = params.thrust_coefficient_n_s2 * jnp.sum(vehicle.rotor_speed_rad_s**2)
    arm = jnp.max(jnp.sum(params.rotor_position_m[:, :2] ** 2, axis=-1))
    return params.downwash * thrust, 2.0 * jnp.sqrt(arm)


def knocked(params: MultirotorParams, vehicle: MultirotorState, velocity_m_s: jax.Array, spin_nms: jax.Array) -> Any:
    """The vehicle after a change of its velocity [3] and an angular impulse [3] N m s, both world."""
    body = vehicle.body
    spin = to_body(rotation_matrix(body.quaternion), spin_nms)
    rate = body.angular_velocity_rad_s + over_inertia(params.inertia_kg_m2, params.principal_axes, spin)
    body = replace(body, velocity_m_s=body.velocity_m_s + velocity_m_s, angular_velocity_rad_s=rate)
    return replace(vehicle, body=body)


def tick(
    params: MultirotorParams,
    vehicle: MultirotorState,
    memory: ControlMemory,
    command: Command,
    armed: jax.Array,
    ground: Plane,
    wall: Plane,
    wind_m_s: jax.Array,
    motor_noise: jax.Array,
    site: Site,
    *,
    engine: Any,
    dt: float,
    substeps: int,
    layout: Layout,
) -> tuple[MultirotorState, ControlMemory, jax.Array]:
    """Vehicle, controller and impact speed [] after one control period; rotors that are not ``armed`` run down."""
    step = make_multirotor_step(engine, dt, layout)
    speeds, memory = control(params, memory, vehicle, command, substeps * dt)
    speeds = jnp.where(armed, speeds * (1.0 + params.speed_noise * motor_noise), 0.0)
    velocity, stood = vehicle.body.velocity_m_s, vehicle.ground_force_n > 0.0

    def one(vehicle: MultirotorState, _: None) -> tuple[MultirotorState, None]:
        return step(params, vehicle, speeds, wind_m_s, ground, wall), None

    vehicle, _ = jax.lax.scan(one, vehicle, None, length=substeps)
    relative = velocity if ground.velocity_m_s is None else velocity - ground.velocity_m_s
    meets = jnp.sqrt(jnp.sum(relative * relative) + 1e-12)
    impact = jnp.where(stood, -jnp.sum(relative * ground.normal), meets)  # what slides over the ground hits nothing
    return vehicle, memory, jnp.where(vehicle.ground_force_n > 0.0, impact, 0.0)


def height(params: MultirotorParams, vehicle: MultirotorState, ground: Plane) -> jax.Array:
    """Height [] of the feet of the level vehicle above the ground."""
    rest_height = -jnp.min(params.contact_position_m[:, 2])
    return jnp.sum((vehicle.body.position_m - ground.point_m) * ground.normal) - rest_height


def crashed(
    params: MultirotorParams, vehicle: MultirotorState, height_m: jax.Array, impact_m_s: jax.Array, limits: Limits
) -> jax.Array:
    """Whether [] it met the ground too fast, or lies on its side."""
    q = vehicle.body.quaternion
    upright = 1.0 - 2.0 * (q[1] ** 2 + q[2] ** 2)
    return (impact_m_s > limits.impact_speed_m_s) | ((height_m < TIP_HEIGHT_M) & (upright < TILT_LIMIT_COSINE))


def obstructed(
    params: MultirotorParams, vehicle: MultirotorState, wall: Plane, impact_m_s: jax.Array, limits: Limits, site: Site
) -> jax.Array:
    """Whether [] its rotors touch a wall."""
    return jnp.sum((vehicle.body.position_m - wall.point_m) * wall.normal) < limits.radius_m
