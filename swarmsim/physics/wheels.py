"""Loads of a skid-steer rover other than tyre contact: motors, rolling resistance; attitude on a slope; battery."""

import jax
import jax.numpy as jnp

from swarmsim.vehicles.skid_steer import SkidSteerParams
from swarmsim.vehicles.state import SkidSteerState

ROLLING_ONSET_RAD_S = 0.1  # wheel speed at which the regularised rolling resistance reaches 76 %


def motor_torque(params: SkidSteerParams, state: SkidSteerState, command_rad_s: jax.Array, dt: float) -> jax.Array:
    """Torque [4] (N m) of the motors after this step: proportional speed loop, limit, exact first-order lag.

    A castor has no motor.
    """
    limit = params.wheel_speed_max_rad_s
    error = jnp.clip(command_rad_s, -limit, limit) - state.wheel_speed_rad_s
    wanted = params.driven * jnp.clip(params.speed_gain_nm_s * error, -params.torque_max_nm, params.torque_max_nm)
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
