"""How a skid-steer rover moves: one step of either engine on a site's terrain and between its walls."""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp

from swarmsim.config.vehicles import SkidSteer
from swarmsim.physics import rotations, wheel_contact, wheels
from swarmsim.physics.skid_steer_analytic import analytic_step
from swarmsim.site import Site, sample_with_gradient
from swarmsim.vehicles.rover_body import RoverBody, rover_body
from swarmsim.vehicles.skid_steer import SkidSteerParams
from swarmsim.vehicles.state import RigidState, SkidSteerState

NEWTON_ITERATIONS = 4
LINE_SEARCH_ITERATIONS = 6

Step = Callable[[SkidSteerParams, SkidSteerState, jax.Array, Site], SkidSteerState]


def make_skid_steer_step(
    spec: SkidSteer, engine: Literal["mjx", "analytic"], dt: float, body: RoverBody | None = None
) -> Step:
    """Step function ``(params, state, wheel_command_rad_s [4], site) -> state`` of ``engine``, ``dt`` seconds long.

    ``mjx`` solves MuJoCo's contact problem under each wheel; ``analytic`` follows the terrain in closed form. Terrain
    is ``site.terrain_m``; walls are where ``site.clearance_m`` is negative. Raises ValueError for an unknown engine.
    """
    if engine == "mjx":
        problem = wheel_contact.contact_problem(
            spec, body or rover_body(spec), dt, NEWTON_ITERATIONS, LINE_SEARCH_ITERATIONS
        )
        return lambda params, state, command, site: mjx_step(problem, dt, params, state, command, site)
    if engine == "analytic":
        return lambda params, state, command, site: analytic_step(dt, params, state, command, site)
    raise ValueError(f"unknown engine {engine!r}; engines: mjx, analytic")


def rest_state(params: SkidSteerParams, site: Site, xy: jax.Array, yaw: jax.Array) -> SkidSteerState:
    """Rover at rest on the terrain at ``xy`` [2] (m, world) with heading ``yaw`` [] (rad, counter-clockwise from east).

    All wheels stand on the tangent plane below the centre of mass.
    """
    xy = jnp.asarray(xy, jnp.float32)
    height, slope = sample_with_gradient(site.terrain_m, site, xy)
    quaternion = wheels.stand_on(slope, jnp.asarray(yaw, jnp.float32))
    up = jax.lax.rsqrt(1.0 + jnp.sum(slope * slope))
    drop = params.wheel_radius_m - params.tyre_sinkage_m - jnp.mean(params.wheel_position_m[:, 2])
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
    problem: wheel_contact.ContactProblem,
    dt: float,
    params: SkidSteerParams,
    state: SkidSteerState,
    command_rad_s: jax.Array,
    site: Site,
) -> SkidSteerState:
    """One step with MuJoCo's contact: speeds first, then the places they lead to (semi-implicit Euler, as MuJoCo's)."""
    body = state.body
    rotation = wheels.rotation_matrix(body.quaternion)
    torque = wheels.motor_torque(params, state, command_rad_s, dt)
    hub = body.position_m + params.wheel_position_m @ rotation.T
    height, normal = wheels.ground_planes(site, hub[:, :2])
    distance = (hub[:, 2] - height) * normal[:, 2] - params.wheel_radius_m
    push, turn = wheels.bumper_wrench(params, state, rotation, site)
    weight = -params.mass_kg * params.gravity_m_s2
    force = jnp.append(push, weight) @ rotation
    twist = jnp.concatenate([body.velocity_m_s @ rotation, body.angular_velocity_rad_s, state.wheel_speed_rad_s])
    wheel_torque = torque + wheels.rolling_torque(params, state.wheel_speed_rad_s)
    smooth = wheel_contact.smooth_force(params, twist, force, turn * rotation[2], wheel_torque)
    change = dt * wheel_contact.accelerations(problem, params, twist, smooth, distance, normal @ rotation)
    velocity = body.velocity_m_s + rotation @ change[:3]
    spin = body.angular_velocity_rad_s + change[3:6]
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
