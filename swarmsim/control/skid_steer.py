"""Control of a skid-steer rover: pure pursuit of a target, and wheel speeds that compensate slip."""

import jax
import jax.numpy as jnp

from swarmsim.physics.rotations import rotate_inverse, yaw_of
from swarmsim.vehicles.skid_steer import SkidSteerParams, turning_force, turning_track
from swarmsim.vehicles.state import SkidSteerState

YAW_RATE_FEEDBACK = 0.5  # gain from the yaw-rate error to the yaw-rate command
FRICTION_ONSET_RAD_S = 0.1  # wheel speed at which the compensation of Coulomb friction reaches 76 %
SPEED_HORIZON_S = 0.4  # the commanded speed is limited to what the acceleration limit reaches in this time
TURN_IN_PLACE_RAD = 1.0  # with a larger bearing to the target the rover turns on the spot before it drives
ARRIVED_M = 0.02  # distance below which the rover stops


def wheel_speeds(
    params: SkidSteerParams, speed_m_s: jax.Array, yaw_rate_rad_s: jax.Array, state: SkidSteerState
) -> jax.Array:
    """Wheel-speed commands [4] (rad/s) for a speed ahead [] (m/s) and a yaw rate [] (rad/s, counter-clockwise).

    Left and right follow from the effective track of the slipping rover, with feedback of the measured yaw rate. The
    motors' speed loops are proportional, so a feedforward is added for the torques of the slope (gravity in the rover's
    attitude), of rolling and of skidding. Above the wheels' limit all commands are scaled down together, which keeps
    the curvature.
    """
    measured = state.body.angular_velocity_rad_s[2]
    yaw_rate = yaw_rate_rad_s + YAW_RATE_FEEDBACK * (yaw_rate_rad_s - measured)
    side = jnp.array([-1.0, 1.0, -1.0, 1.0])
    half_track = 0.5 * turning_track(params)
    wanted = (speed_m_s + side * half_track * yaw_rate) / params.wheel_radius_m
    weight = params.mass_kg * params.gravity_m_s2
    up = rotate_inverse(state.body.quaternion, jnp.array([0.0, 0.0, 1.0]))
    skid_onset = jnp.tanh(half_track * yaw_rate_rad_s / params.wheel_radius_m / FRICTION_ONSET_RAD_S)
    rolling_onset = jnp.tanh(wanted / FRICTION_ONSET_RAD_S)
    force = weight * up[0] + side * skid_onset * turning_force(params, weight)
    torque = (
        params.wheel_radius_m / jnp.sum(params.driven) * (force + rolling_onset * params.rolling_resistance * weight)
    )
    command = wanted + torque / params.speed_gain_nm_s
    return command / jnp.maximum(1.0, jnp.max(jnp.abs(command)) / params.wheel_speed_max_rad_s)


def pursue(
    params: SkidSteerParams, state: SkidSteerState, target_xy: jax.Array, speed_m_s: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Speed ahead [] (m/s) and yaw rate [] (rad/s) to ``target_xy`` [2] (m, world) at ``speed_m_s`` [] or less.

    Pure pursuit (Coulter, CMU-RI-TR-92-01): the arc through the target, tangent to the heading. For a large bearing the
    rover turns in place first. The speed is limited so that it stops at the target and respects the limits of yaw rate
    and acceleration.
    """
    offset = target_xy - state.body.position_m[:2]
    distance = jnp.sqrt(jnp.sum(offset * offset) + 1e-12)
    arrived = distance < ARRIVED_M
    offset = jnp.where(arrived, jnp.array([1.0, 0.0]), offset)  # the direction to zero distance has no derivative
    bearing = jnp.arctan2(offset[1], offset[0]) - yaw_of(state.body.quaternion)
    bearing = jnp.arctan2(jnp.sin(bearing), jnp.cos(bearing))
    limit = params.yaw_rate_max_rad_s
    curvature = 2.0 * jnp.sin(bearing) / jnp.maximum(distance, 0.5 * params.lookahead_m)
    stopping = jnp.sqrt(2.0 * params.acceleration_max_m_s2 * distance) * jnp.minimum(1.0, distance / 0.3)
    cruise = jnp.minimum(jnp.minimum(speed_m_s, params.speed_max_m_s), stopping)
    cruise = jnp.minimum(cruise, limit / jnp.maximum(jnp.abs(curvature), 1e-3))
    in_place = jnp.abs(bearing) > TURN_IN_PLACE_RAD
    present = rotate_inverse(state.body.quaternion, state.body.velocity_m_s)[0]
    change = params.acceleration_max_m_s2 * SPEED_HORIZON_S
    speed = jnp.clip(jnp.where(in_place | arrived, 0.0, cruise), present - change, present + change)
    turn = jnp.where(in_place, params.yaw_gain_1_s * bearing, speed * curvature)
    return speed, jnp.where(arrived, 0.0, jnp.clip(turn, -limit, limit))
