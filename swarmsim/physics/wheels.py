"""Loads of a skid-steer rover other than tyre contact: motors, rolling resistance, walls; ground planes; battery."""

import jax
import jax.numpy as jnp

from swarmsim.physics.rotations import rotation_matrix
from swarmsim.site import Site, sample_with_gradient
from swarmsim.vehicles.skid_steer import SkidSteerParams
from swarmsim.vehicles.state import SkidSteerState

ROLLING_ONSET_RAD_S = 0.1  # wheel speed at which the regularised rolling resistance reaches 76 %


def motor_torque(params: SkidSteerParams, state: SkidSteerState, command_rad_s: jax.Array, dt: float) -> jax.Array:
    """Torque [4] (N m) of the motors after this step: proportional speed loop, limit, exact first-order lag."""
    limit = params.wheel_speed_max_rad_s
    error = jnp.clip(command_rad_s, -limit, limit) - state.wheel_speed_rad_s
    wanted = jnp.clip(params.speed_gain_nm_s * error, -params.torque_max_nm, params.torque_max_nm)
    return wanted + (state.wheel_torque_nm - wanted) * jnp.exp(-dt / params.motor_time_constant_s)


def rolling_torque(params: SkidSteerParams, wheel_speed_rad_s: jax.Array) -> jax.Array:
    """Resisting torque [4] (N m) of the rolling tyres under a quarter of the weight each, smooth through standstill."""
    load = 0.25 * params.mass_kg * params.gravity_m_s2
    onset = jnp.tanh(wheel_speed_rad_s / ROLLING_ONSET_RAD_S)
    return -params.rolling_resistance * load * params.wheel_radius_m * onset


def energy_used(params: SkidSteerParams, state: SkidSteerState, torque_nm: jax.Array, dt: float) -> jax.Array:
    """Energy [] (J) drawn since the start: |torque x speed| through the drive's efficiency, and the avionics."""
    shaft = jnp.sum(jnp.abs(torque_nm * state.wheel_speed_rad_s))
    return state.energy_j + dt * (shaft / params.drive_efficiency + params.avionics_power_w)


def ground_planes(site: Site, xy: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Tangent planes of the terrain at ``xy`` [n, 2] (m, world): heights [n] (m) and unit normals [n, 3], world."""
    height, slope = sample_with_gradient(site.terrain_m, site, xy)
    up = jax.lax.rsqrt(1.0 + jnp.sum(slope * slope, axis=-1, keepdims=True))
    return height, jnp.concatenate([-slope * up, up], axis=-1)


def wall_contact(
    params: SkidSteerParams, state: SkidSteerState, rotation: jax.Array, site: Site
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Contact of the outline's corners with walls.

    Returns the depth [4] (m, > 0 in the wall), the direction out of the wall [4, 2] (unit, world), the speed into the
    wall [4] (m/s) and the corners' positions from the centre of mass [4, 2] (m, world). ``rotation`` [3, 3]: body to
    world.
    """
    arm = jnp.sum(rotation[:2, :2] * params.corner_m[:, None, :], axis=-1)
    clearance, gradient = sample_with_gradient(site.clearance_m, site, state.body.position_m[:2] + arm)
    outward = gradient * jax.lax.rsqrt(jnp.sum(gradient * gradient, axis=-1, keepdims=True) + 1e-12)
    spin = jnp.sum(rotation[2] * state.body.angular_velocity_rad_s)
    velocity = state.body.velocity_m_s[:2] + spin * jnp.stack([-arm[:, 1], arm[:, 0]], axis=-1)
    return -clearance, outward, -jnp.sum(velocity * outward, axis=-1), arm


def bumper_wrench(
    params: SkidSteerParams, state: SkidSteerState, rotation: jax.Array, site: Site
) -> tuple[jax.Array, jax.Array]:
    """Force [2] (N, world x and y) and moment [] (N m, about the vertical) of the walls on the rover.

    A spring-damper at each corner pushes along the gradient of the clearance, without friction. It acts at the height
    of the centre of mass, so a wall neither lifts nor tips the rover.
    """
    depth, outward, approach, arm = wall_contact(params, state, rotation, site)
    push = params.bumper_stiffness_n_m * depth + params.bumper_damping_n_s_m * approach
    force = outward * jnp.where(depth > 0.0, jnp.maximum(push, 0.0), 0.0)[:, None]
    return force.sum(axis=0), jnp.sum(arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0])


def impact_speed(params: SkidSteerParams, state: SkidSteerState, site: Site) -> jax.Array:
    """Largest speed [] (m/s) of a corner into the wall that it touches; 0 without contact.

    A value above ``params.impact_speed_max_m_s`` is a collision.
    """
    depth, _, approach, _ = wall_contact(params, state, rotation_matrix(state.body.quaternion), site)
    return jnp.max(jnp.where(depth > 0.0, jnp.maximum(approach, 0.0), 0.0))


def stand_on(slope: jax.Array, yaw: jax.Array) -> jax.Array:
    """Quaternion [4] of a body on ground of ``slope`` [2] (rise per metre along x, y), heading ``yaw`` [] (rad)."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    return attitude(slope[0] * c + slope[1] * s, slope[1] * c - slope[0] * s, yaw)


def attitude(climb: jax.Array, bank: jax.Array, yaw: jax.Array) -> jax.Array:
    """Quaternion [4] of a body with heading ``yaw`` [] (rad) on ground that rises by ``climb`` [] per metre ahead and
    ``bank`` [] per metre to the left.
    """
    pitch = -jnp.arctan(climb)
    roll = jnp.arctan(bank * jnp.cos(pitch))
    half = 0.5 * jnp.stack([yaw, pitch, roll])
    (cy, cp, cr), (sy, sp, sr) = jnp.cos(half), jnp.sin(half)
    return jnp.stack(
        [
            cy * cp * cr + sy * sp * sr,
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
        ]
    )
