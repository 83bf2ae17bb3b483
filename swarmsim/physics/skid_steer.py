"""Motion of a skid-steer rover: one step of either engine on the terrain of a site and between its walls."""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp

from swarmsim.physics import rotations, wheel_contact, wheels
from swarmsim.physics.rotations import to_body, to_world
from swarmsim.physics.skid_steer_analytic import analytic_step
from swarmsim.physics.step_contact import spring_wrench, step_under, wheel_ground
from swarmsim.physics.walls import near_walls, stopped_by
from swarmsim.site import Site
from swarmsim.vehicles.skid_steer import SkidSteerParams, tyre_sinkage
from swarmsim.vehicles.state import RigidState, SkidSteerState

Step = Callable[[SkidSteerParams, SkidSteerState, jax.Array, Site], SkidSteerState]


def make_skid_steer_step(engine: Literal["mjx", "analytic"], dt: float) -> Step:
    """Step function ``(params, state, wheel_command_rad_s [4], site) -> state`` of ``engine`` over ``dt`` seconds.

    ``mjx`` solves MuJoCo's contact problem under each wheel (without a MuJoCo model: everything comes from ``params``);
    ``analytic`` follows the terrain in closed form. Terrain is ``site.terrain_m``; walls are where ``site.clearance_m``
    is negative. The step is pure, of one vehicle, and differentiable in forward and reverse mode.

    Raises ValueError for an unknown engine.
    """
    steps = {"mjx": mjx_step, "analytic": analytic_step}
    if engine not in steps:
        raise ValueError(f"unknown engine {engine!r}; engines: {', '.join(steps)}")
    return lambda params, state, command, site: steps[engine](dt, params, state, command, site)


def rest_state(params: SkidSteerParams, site: Site, xy: jax.Array, yaw: jax.Array) -> SkidSteerState:
    """Rover at rest on the terrain at ``xy`` [2] (m, world) with heading ``yaw`` [] (rad, counter-clockwise from east).

    All wheels stand on the tangent plane below the centre of mass.
    """
    xy = jnp.asarray(xy, float)
    ground = jax.tree.map(lambda x: x[0], step_under(site, xy[None]))
    height, slope = ground.low_m + jnp.where(ground.beyond_m > 0.0, ground.rise_m, 0.0), ground.slope
    quaternion = wheels.stand_on(slope, jnp.asarray(yaw, float))
    up = jax.lax.rsqrt(1.0 + jnp.sum(slope * slope))
    drop = params.wheel_radius_m - tyre_sinkage(params) - jnp.mean(params.wheel_position_m[:, 2])
    zero3, zero4 = jnp.zeros(3), jnp.zeros(4)
    body = RigidState(
        position_m=jnp.append(xy, height + drop / up),
        quaternion=quaternion,
        velocity_m_s=zero3,
        angular_velocity_rad_s=zero3,
    )
    return SkidSteerState(
        body=body, wheel_angle_rad=zero4, wheel_speed_rad_s=zero4, wheel_torque_nm=zero4, energy_j=jnp.zeros(())
    )


def mjx_step(
    dt: float, params: SkidSteerParams, state: SkidSteerState, command_rad_s: jax.Array, site: Site
) -> SkidSteerState:
    """One step with MuJoCo's contact model and its semi-implicit Euler scheme: velocities first, then the pose."""
    body = state.body
    rotation = rotations.rotation_matrix(body.quaternion)
    torque = wheels.motor_torque(params, state, command_rad_s, dt)
    hub = body.position_m + to_world(rotation, params.wheel_position_m)
    ground = wheel_ground(params, site, rotation, hub)
    push, moment = spring_wrench(params, body, rotation, ground, stepped=site.steps is not None)
    force = to_body(rotation, push) - params.mass_kg * params.gravity_m_s2 * rotation[2]
    velocity = to_body(rotation, body.velocity_m_s)
    twist = jnp.concatenate([velocity, body.angular_velocity_rad_s, state.wheel_speed_rad_s])
    wheel_torque = torque + wheels.rolling_torque(params, state.wheel_speed_rad_s)
    smooth = wheel_contact.smooth_force(params, twist, force, moment, wheel_torque)
    change = dt * wheel_contact.accelerations(
        params, twist, smooth, ground.distance_m, to_body(rotation, ground.normal), radius=ground.radius_m
    )
    velocity = body.velocity_m_s + to_world(rotation, change[:3])
    spin = body.angular_velocity_rad_s + change[3:6]
    yaw_rate = jnp.sum(rotation[2] * spin)
    held, turn = stopped_by(near_walls(params, body, rotation, site), params, velocity[:2], yaw_rate, dt)
    velocity = jnp.append(held, velocity[2])
    spin = spin + (turn - yaw_rate) * rotation[2]
    wheel_speed = state.wheel_speed_rad_s + change[6:]
    turned = rotations.multiply(body.quaternion, rotations.from_rotation_vector(dt * spin))
    return SkidSteerState(
        body=RigidState(
            position_m=body.position_m + dt * velocity,
            quaternion=rotations.normalise(turned),
            velocity_m_s=velocity,
            angular_velocity_rad_s=spin,
        ),
        wheel_angle_rad=state.wheel_angle_rad + dt * wheel_speed,
        wheel_speed_rad_s=wheel_speed,
        wheel_torque_nm=torque,
        energy_j=wheels.energy_used(params, state, torque, dt),
    )
