"""Closed-form model of a skid-steer rover that follows the terrain, without a contact solver, for the largest sweeps.

Three motions are integrated separately: along the wheels (traction up to friction x load, rolling resistance), turning
(effective track and turning resistance of `swarmsim.vehicles.skid_steer`) and sideways (slides when the side force
exceeds friction). Coulomb friction is implicit in each, so any step size is stable and the rover comes to rest exactly.
Height and attitude are those of the plane through the ground below the four wheels.
"""

import jax
import jax.numpy as jnp

from swarmsim.physics import wheels
from swarmsim.physics.rotations import rotation_matrix, to_body, to_world, yaw_of
from swarmsim.physics.walls import near_walls, stopped_by
from swarmsim.site import Site, sample
from swarmsim.vehicles.skid_steer import (
    SkidSteerParams,
    effective_track,
    turning_force,
    tyre_creep,
    tyre_sinkage,
    wheel_spacing,
)
from swarmsim.vehicles.state import RigidState, SkidSteerState


def analytic_step(
    dt: float, params: SkidSteerParams, state: SkidSteerState, command_rad_s: jax.Array, site: Site
) -> SkidSteerState:
    """One step of ``dt`` seconds; same signature and state as the ``mjx`` engine."""
    body = state.body
    rotation = rotation_matrix(body.quaternion)
    torque = wheels.motor_torque(params, state, command_rad_s, dt)
    pushed = -params.mass_kg * params.gravity_m_s2 * rotation[2]
    load = jnp.maximum(-pushed[2], 0.0)
    speed, side, _ = to_body(rotation, body.velocity_m_s)
    speed, wheel_mean = _roll(dt, params, speed, state.wheel_speed_rad_s, torque, pushed[0], load)
    hold = dt * params.friction * load / params.mass_kg
    side = _coulomb(side + dt * pushed[1] / params.mass_kg, hold, tyre_creep(params))
    wheel_half_difference, yaw_rate = _turn(dt, params, state.wheel_speed_rad_s, torque, load)
    velocity = to_world(rotation, jnp.stack([speed, side, jnp.zeros(())]))
    walls = near_walls(params, body, rotation, site)
    held, yaw_rate = stopped_by(walls, params, velocity[:2], yaw_rate, dt)
    speed, side, _ = to_body(rotation, jnp.append(held, velocity[2]))
    yaw = yaw_of(body.quaternion) + dt * yaw_rate
    position, quaternion = _stand(params, site, body.position_m[:2] + dt * held, yaw)
    turned = rotation_matrix(quaternion)
    wheel_speed = wheel_mean + wheel_half_difference * jnp.array([-1.0, 1.0, -1.0, 1.0])
    return SkidSteerState(
        body=RigidState(
            position_m=position,
            quaternion=quaternion,
            velocity_m_s=to_world(turned, jnp.stack([speed, side, jnp.zeros(())])),
            angular_velocity_rad_s=yaw_rate * turned[2],
        ),
        wheel_angle_rad=state.wheel_angle_rad + dt * wheel_speed,
        wheel_speed_rad_s=wheel_speed,
        wheel_torque_nm=torque,
        energy_j=wheels.energy_used(params, state, torque, dt),
    )


def _coulomb(speed: jax.Array, most: jax.Array, onset: jax.Array | float = 0.0) -> jax.Array:
    """``speed`` [] after Coulomb friction, which changes it by at most ``most`` [] (same unit) in the step.

    Below the speed ``onset`` [] the friction is proportional to the speed at the end of the step.
    """
    return speed - jnp.clip(speed * most / (most + onset + 1e-9), -most, most)


def _wheels_mass(params: SkidSteerParams) -> jax.Array:
    """Inertia of the four wheels with their motors as an equivalent mass [] (kg) at the speed of the treads."""
    return 4.0 * (params.wheel_inertia_kg_m2 + params.rotor_inertia_kg_m2) / _rolling_radius(params) ** 2


def _rolling_radius(params: SkidSteerParams) -> jax.Array:
    """Rolling radius [] (m) of a loaded tyre: as in MuJoCo, the contact is halfway between tyre and ground."""
    return params.wheel_radius_m - 0.5 * tyre_sinkage(params)


def _roll(
    dt: float,
    params: SkidSteerParams,
    speed: jax.Array,
    wheel_speed: jax.Array,
    torque: jax.Array,
    push: jax.Array,
    load: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Speed of the rover ahead [] (m/s) and mean wheel speed [] (rad/s) after the step.

    The traction makes tyre and rover equally fast at the end of the step, up to the limit of friction.
    """
    mass, wheels_mass, radius = params.mass_kg, _wheels_mass(params), _rolling_radius(params)
    tyre_free = jnp.mean(wheel_speed) * radius + dt * jnp.sum(torque) / radius / wheels_mass
    speed_free = speed + dt * push / mass
    grip = dt * params.friction * load
    impulse = jnp.clip((tyre_free - speed_free) * mass * wheels_mass / (mass + wheels_mass), -grip, grip)
    resistance = dt * params.rolling_resistance * load / (mass + wheels_mass)
    tyre = tyre_free - impulse / wheels_mass
    lost = tyre - _coulomb(tyre, resistance)
    return speed_free + impulse / mass - lost, (tyre - lost) / radius


def _turn(
    dt: float, params: SkidSteerParams, wheel_speed: jax.Array, torque: jax.Array, load: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Half the difference of right and left wheel speeds [] (rad/s) and yaw rate [] (rad/s) after the step."""
    side = jnp.array([-1.0, 1.0, -1.0, 1.0])
    lever = 0.5 * effective_track(params.wheel_position_m)
    inertia = _wheels_mass(params) + params.inertia_kg_m2[2, 2] / (lever * lever)
    radius = _rolling_radius(params)
    rolling = (
        0.25 * load * params.rolling_resistance * jnp.sum(side * jnp.tanh(wheel_speed / wheels.ROLLING_ONSET_RAD_S))
    )
    force = jnp.sum(side * torque) / radius - rolling
    free = 0.25 * jnp.sum(side * wheel_speed) * radius + dt * force / inertia
    base, track = wheel_spacing(params.wheel_position_m)
    # Slip of a tyre over the tread's speed while turning: half the diagonal times b / B, and the yaw rate.
    onset = tyre_creep(params) * lever * 2.0 * track / base * jax.lax.rsqrt(base * base + track * track)
    tread = _coulomb(free, dt * turning_force(params, load) / inertia, onset)
    return tread / radius, tread / lever


def _stand(params: SkidSteerParams, site: Site, xy: jax.Array, yaw: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Position [3] and quaternion [4] of the rover over ``xy`` [2] on the plane of the ground below its wheels."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    x, y = params.wheel_position_m[:, 0], params.wheel_position_m[:, 1]
    height = sample(site.terrain_m, site, xy + jnp.stack([c * x - s * y, s * x + c * y], axis=-1))
    base, track = wheel_spacing(params.wheel_position_m)
    climb = 0.5 * jnp.sum(height * jnp.array([1.0, 1.0, -1.0, -1.0])) / base
    bank = 0.5 * jnp.sum(height * jnp.array([1.0, -1.0, 1.0, -1.0])) / track
    ground = jnp.mean(height) - climb * jnp.mean(x) - bank * jnp.mean(y)
    rise = params.wheel_radius_m - tyre_sinkage(params) - jnp.mean(params.wheel_position_m[:, 2])
    return jnp.append(xy, ground + rise * jnp.sqrt(1.0 + climb**2 + bank**2)), wheels.attitude(climb, bank, yaw)
