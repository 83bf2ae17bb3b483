"""How a multirotor moves: two engines behind one signature.

Both take the same loads (rotors, drag, feet) and differ in who integrates the body: ``mjx`` steps MuJoCo's model of it,
``analytic`` the closed form of a free body. In the air both are of second order: air and attitude are those of the
middle of the step, and half of the change of velocity comes before the motion. While something is touched all of it
does, as in MuJoCo's Euler scheme.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.config.vehicles import Multirotor, inertia_tensor
from swarmsim.physics.contact import ContactPoints, Plane, contact_wrench, wall_wrench
from swarmsim.physics.rigid_body import free_body_step, rates_after, torque_of_euler_step
from swarmsim.physics.rotations import conjugate, from_yaw, multiply, normalise, rotation_matrix, to_body, to_world
from swarmsim.pytree import pytree
from swarmsim.scalars import Layout, over_vehicles
from swarmsim.vehicles.battery import open_circuit_voltage, under_load
from swarmsim.vehicles.multirotor import (
    MultirotorParams,
    airframe_drag,
    battery_power,
    free_body_mjcf,
    rotor_momentum,
    rotor_speeds,
    wrench,
)
from swarmsim.vehicles.state import GRAVITY_M_S2, MultirotorState, RigidState

Engine = Literal["mjx", "analytic"]
Step = Callable[..., MultirotorState]


@pytree
class Loads:
    """What acts on the body during one step, and what the step makes of the rest of the state."""

    first: jax.Array  # [] share of the change of velocity that comes before the motion: 1/2 in the air, 1 in contact
    force_n: jax.Array  # [3] N, world
    torque_nm: jax.Array  # [3] N m, body; the rotors' gyroscopic torque apart
    rotor_momentum_nms: jax.Array  # [] N m s, along body z
    rotor_speed_rad_s: jax.Array  # [R] rad/s at the end of the step
    contact_slip_m: jax.Array  # [C, 3] m, body, at the end of the step
    ground_force_n: jax.Array  # [] N along the ground's normal
    power_w: jax.Array  # [] W that the battery's cells give
    voltage_v: jax.Array  # [] V at its terminals


Integrate = Callable[[MultirotorParams, RigidState, Loads], RigidState]


def make_multirotor_step(engine: Engine, dt: float, layout: Layout = "scalars") -> Step:
    """The function ``step(params, state, rotor_command_rad_s [R], wind_m_s [3] world, ground[, wall]) -> state``.

    It goes over ``dt`` s; ``ground`` and ``wall`` are the `Plane` below and the one beside the vehicle.

    Everything about the vehicle comes from ``params``, so that masses, drags and the like are swept without compiling
    anew. A command at or below zero disarms its rotor. The step is pure, of one vehicle, and has no loop that a
    non-finite input could keep alive.

    ``layout`` is how the step is mapped over vehicles by its caller: under ``vmap`` MJX's part of it is mapped as
    scalars by itself, because a third of MJX's operations are arithmetic on indices that XLA does not fold in a loop:
    2.7 times as fast for three vehicles on a CPU.

    Raises `InputError` for an unknown engine.
    """
    engines = {"mjx": _mjx_body, "analytic": _analytic_body}
    if engine not in engines:
        raise InputError.of(f"there is no engine '{engine}': choose one of {', '.join(engines)}")
    integrate = engines[engine](dt)
    if engine == "mjx" and layout == "vmap":
        integrate = _as_scalars(integrate)

    def step(
        params: MultirotorParams,
        state: MultirotorState,
        rotor_command_rad_s: jax.Array,
        wind_m_s: jax.Array,
        ground: Plane,
        wall: Plane | None = None,
    ) -> MultirotorState:
        loads = step_loads(params, state, rotor_command_rad_s, wind_m_s, ground, dt, wall)
        return MultirotorState(
            body=integrate(params, state.body, loads),
            rotor_speed_rad_s=loads.rotor_speed_rad_s,
            contact_slip_m=loads.contact_slip_m,
            ground_force_n=loads.ground_force_n,
            energy_j=state.energy_j + dt * loads.power_w,
            voltage_v=loads.voltage_v,
        )

    return step


def check_time_step(spec: Multirotor, dt: float) -> None:
    """Raise `InputError` where ``dt`` is too long for the feet of ``spec``."""
    longest = longest_time_step(spec)
    if dt > longest:
        raise InputError.of(
            f"a time step of {dt:g} s is too long for the feet of {spec.name}: use {longest:.2g} s or less, "
            "or softer feet (feet.stiffness_n_m, feet.damping_n_s_m)"
        )


def step_loads(
    params: MultirotorParams,
    state: MultirotorState,
    rotor_command_rad_s: jax.Array,
    wind_m_s: jax.Array,
    ground: Plane,
    dt: float,
    wall: Plane | None = None,
) -> Loads:
    """Loads on the vehicle over a step of ``dt`` s; the wind [3] m/s is the air's velocity in the world."""
    body = state.body
    attitude, rate = rotation_matrix(body.quaternion), body.angular_velocity_rad_s
    velocity = to_body(attitude, body.velocity_m_s)
    normal = to_body(attitude, ground.normal)
    height = jnp.sum((body.position_m - ground.point_m) * ground.normal)
    contact_height = height + jnp.sum(params.contact_position_m * normal, axis=-1)
    rotor_height = height + jnp.sum(params.rotor_position_m * normal, axis=-1)
    contact_force, contact_torque, slip = contact_wrench(
        contact_points(params),
        slip_m=state.contact_slip_m,
        height_m=contact_height,
        normal=normal,
        velocity_m_s=velocity if ground.velocity_m_s is None else velocity - to_body(attitude, ground.velocity_m_s),
        angular_velocity_rad_s=rate,
        dt=dt,
    )
    ground_force = jnp.sum(contact_force * normal)
    touches = ground_force > 0.0
    if wall is not None:
        away = to_body(attitude, wall.normal)
        push, turn = wall_wrench(
            contact_points(params),
            radius_m=params.collision_radius_m,
            distance_m=jnp.sum((body.position_m - wall.point_m) * wall.normal),
            normal=away,
            velocity_m_s=velocity,
            angular_velocity_rad_s=rate,
            inertia_kg_m2=params.inertia_kg_m2,
            dt=dt,
        )
        contact_force, contact_torque = contact_force + push, contact_torque + turn
        touches |= jnp.sum(push * away) > 0.0
    speed = rotor_speeds(params, state.rotor_speed_rad_s, rotor_command_rad_s, state.voltage_v, dt)
    air = velocity - to_body(attitude, wind_m_s)
    thrust = params.thrust_coefficient_n_s2 * jnp.sum((0.5 * (state.rotor_speed_rad_s + speed)) ** 2)
    pull = (contact_force + airframe_drag(params, air)) / params.mass_kg - GRAVITY_M_S2 * attitude[2]
    pull = pull + jnp.stack([jnp.zeros_like(thrust), jnp.zeros_like(thrust), thrust / params.mass_kg])
    # Air and forces in the axes that the body has in the middle of the step.
    air = air + 0.5 * dt * (pull - jnp.cross(rate, air))
    air_force, air_torque = wrench(
        params,
        speed_before_rad_s=state.rotor_speed_rad_s,
        speed_after_rad_s=speed,
        rotor_height_m=rotor_height,
        air_velocity_m_s=air,
        angular_velocity_rad_s=rate,
        dt=dt,
    )
    air_force = air_force + 0.5 * dt * jnp.cross(rate, air_force)
    power = battery_power(params, speed_before_rad_s=state.rotor_speed_rad_s, speed_after_rad_s=speed, dt=dt)
    voltage, drawn = under_load(params.battery, state.energy_j, power)
    return Loads(
        first=jnp.where(touches, 1.0, 0.5),
        force_n=to_world(attitude, contact_force + air_force),
        torque_nm=contact_torque + air_torque,
        rotor_momentum_nms=rotor_momentum(params, speed),
        rotor_speed_rad_s=speed,
        contact_slip_m=slip,
        ground_force_n=ground_force,
        power_w=drawn,
        voltage_v=voltage,
    )


def contact_points(params: MultirotorParams) -> ContactPoints:
    """The feet and rotor hubs as contact points."""
    return ContactPoints(
        position_m=params.contact_position_m,
        stiffness_n_m=params.contact_stiffness_n_m,
        tangential_n_m=params.contact_tangential_n_m,
        damping_n_s_m=params.contact_damping_n_s_m,
        friction=params.contact_friction,
        mass_kg=params.mass_kg,
    )


def rest_state(params: MultirotorParams, ground: Plane, yaw_rad: jax.Array) -> MultirotorState:
    """The vehicle at rest on its feet at the plane's point, motors off, heading ``yaw_rad`` (from east) before tilting.

    The body stands along the plane's normal and is sunk by its weight, so that it starts without a bounce.
    """
    feet = params.contact_position_m.shape[0] - params.rotor_spin.shape[0]
    sink = params.mass_kg * GRAVITY_M_S2 * ground.normal[2] / (feet * params.contact_stiffness_n_m)
    height = -jnp.min(params.contact_position_m[:, 2]) - sink
    # Shortest turn that takes the world's z to the normal.
    tilt = jnp.stack([1.0 + ground.normal[2], -ground.normal[1], ground.normal[0], jnp.zeros_like(ground.normal[0])])
    upright = tilt / jnp.linalg.norm(tilt)
    return MultirotorState(
        body=RigidState(
            position_m=ground.point_m + height * ground.normal,
            quaternion=multiply(upright, from_yaw(jnp.asarray(yaw_rad, jnp.float32))),
            velocity_m_s=jnp.zeros(3),
            angular_velocity_rad_s=jnp.zeros(3),
        ),
        rotor_speed_rad_s=jnp.zeros_like(params.rotor_spin),
        contact_slip_m=jnp.zeros_like(params.contact_position_m),
        ground_force_n=params.mass_kg * GRAVITY_M_S2 * ground.normal[2],
        energy_j=jnp.zeros(()),
        voltage_v=open_circuit_voltage(params.battery, jnp.ones(())),
    )


def longest_time_step(spec: Multirotor) -> float:
    """Longest step [s] at which the feet of ``spec`` are stable with a margin of two.

    Semi-implicit Euler of m x'' = -k x - c x' is stable while k dt^2 / m + 2 c dt / m < 4; the stiffest motion of the
    body on its feet is the largest eigenvalue of their stiffness over the masses and inertias it moves.
    """
    feet, eye = spec.feet, np.eye(3)
    ratio = feet.tangential_stiffness_n_m / feet.stiffness_n_m
    inverse_mass = np.diag([1.0 / spec.mass_kg] * 6)
    inverse_mass[3:, 3:] = np.linalg.inv(inertia_tensor(spec.inertia_kg_m2))
    stiffness = np.zeros((6, 6))
    for x, y, z in feet.positions_m:
        turn = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # velocity of the foot of a unit rate
        jacobian = np.concatenate([eye, turn], axis=1)
        stiffness += jacobian.T @ np.diag([ratio, ratio, 1.0]) @ jacobian
    largest = float(np.max(np.linalg.eigvals(inverse_mass @ stiffness).real))
    k, c = largest * feet.stiffness_n_m, largest * feet.damping_n_s_m
    return float((-c + np.sqrt(c * c + 2.0 * k)) / k)  # k dt^2 + 2 c dt = 2


def _as_scalars(integrate: Integrate) -> Integrate:
    """The same for one vehicle, by `over_vehicles` of a fleet of one."""
    fleet = over_vehicles(integrate)

    def alone(*arguments: Any) -> RigidState:
        moved: RigidState = jax.tree.map(lambda x: x[0], fleet(*jax.tree.map(lambda x: x[None], arguments)))
        return moved

    return alone


def _analytic_body(dt: float) -> Integrate:
    def integrate(params: MultirotorParams, body: RigidState, loads: Loads) -> RigidState:
        return free_body_step(
            body,
            mass_kg=params.mass_kg,
            inertia_kg_m2=params.inertia_kg_m2,
            principal_axes=params.principal_axes,
            force_n=loads.force_n,
            torque_nm=loads.torque_nm,
            rotor_momentum_nms=loads.rotor_momentum_nms,
            first=loads.first,
            dt=dt,
        )

    return integrate


@cache
def _free_body(dt: float) -> tuple[Any, Any]:
    """MJX's model and data of one free body of unit mass and inertia, which the step replaces."""
    from swarmsim.physics.mjx_import import mjx

    compiled = mujoco.MjModel.from_xml_string(free_body_mjcf("body", 1.0, (1.0, 1.0, 1.0), dt))
    with jax.ensure_compile_time_eval():  # the cached arrays must not be tracers of the program that asks first
        return mjx.put_model(compiled), mjx.make_data(compiled)


def _mjx_body(dt: float) -> Integrate:
    from swarmsim.physics.mjx_import import mjx  # takes 0.6 s, and is not needed where the program is kept compiled

    model, template = _free_body(dt)  # constants of the compiled step

    def integrate(params: MultirotorParams, body: RigidState, loads: Loads) -> RigidState:
        swept = replace(
            model,
            body_mass=jnp.stack([jnp.zeros_like(params.mass_kg), params.mass_kg]),
            body_inertia=jnp.stack([jnp.zeros_like(params.inertia_kg_m2), params.inertia_kg_m2]),
        )
        inertia, axes, frame = params.inertia_kg_m2, params.principal_axes, body.quaternion
        turning, after = rates_after(
            body.angular_velocity_rad_s, inertia, axes, loads.torque_nm, loads.rotor_momentum_nms, loads.first, dt
        )
        rate = body.angular_velocity_rad_s
        if axes is not None:  # MuJoCo's body has its frame along the principal axes
            turned, frame = rotation_matrix(axes), multiply(frame, axes)
            rate, turning = to_body(turned, rate), to_body(turned, turning)
        # MuJoCo's Euler step takes the gyroscopic torque of the old rate, which gains energy; under this torque it
        # turns the body by the mean rate of the step.
        torque = to_world(rotation_matrix(frame), torque_of_euler_step(rate, inertia, turning, dt))
        load = jnp.concatenate([loads.force_n, torque])
        data = template.replace(
            qpos=jnp.concatenate([jnp.zeros(3), frame]),  # float32 is fine near zero, and a step is short
            qvel=jnp.concatenate([body.velocity_m_s, rate]),
            xfrc_applied=jnp.stack([jnp.zeros_like(load), load]),
        )
        data = mjx.step(swept, data)
        # It also moves the body by the new velocity, which is too far by what has to come after the motion.
        late = (1.0 - loads.first) * (data.qvel[:3] - body.velocity_m_s)
        return RigidState(
            position_m=body.position_m + (data.qpos[:3] - dt * late),
            quaternion=data.qpos[3:] if axes is None else normalise(multiply(data.qpos[3:], conjugate(axes))),
            velocity_m_s=data.qvel[:3],
            angular_velocity_rad_s=after,
        )

    return integrate
