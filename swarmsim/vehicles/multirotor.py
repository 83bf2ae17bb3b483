"""What a multirotor is: its parameters, its rotors and airframe in the air, and its body as MJCF.

Everything here is one vehicle in its body frame FLU (x forward, y left, z up, origin at the centre of mass), SI units.
All rotor axes point along body z.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.vehicles import Multirotor
from swarmsim.pytree import on_device, pytree
from swarmsim.vehicles.state import GRAVITY_M_S2

GROUND_EFFECT_HEIGHT_MIN = 0.5
"""Lowest rotor height in propeller radii at which the ground effect is evaluated: the theory holds above it."""


@pytree
class ControlParams:
    """The autopilot's gains, limits and what it believes of the vehicle; sweeping the true mass leaves them alone."""

    mass_kg: jax.Array  # [] kg, nominal
    inertia_kg_m2: jax.Array  # [3] kg m^2, nominal, body
    allocation: jax.Array  # [R, 4] rotor thrust (N) for thrust (N) and torque x, y, z (N m, body): pseudo-inverse
    thrust_coefficient_n_s2: jax.Array  # [] N/(rad/s)^2, nominal
    speed_min_rad_s: jax.Array  # [] rad/s
    speed_max_rad_s: jax.Array  # [] rad/s
    rotor_time_constant_s: jax.Array  # [] s, nominal: mean of rising and falling
    position_gain_1_s: jax.Array  # []
    velocity_gain_1_s: jax.Array  # []
    velocity_integral_1_s2: jax.Array  # []
    attitude_gain_1_s: jax.Array  # []
    yaw_gain_1_s: jax.Array  # []
    rate_gain_1_s: jax.Array  # []
    yaw_rate_max_rad_s: jax.Array  # []
    tilt_max_tan: jax.Array  # [] tangent of the largest tilt
    speed_max_m_s: jax.Array  # [] horizontal
    climb_rate_max_m_s: jax.Array  # [] up and down
    acceleration_max_m_s2: jax.Array  # [] horizontal and vertical


@pytree
class MultirotorParams:
    """Physics of one multirotor; every leaf may be swept without compiling anew."""

    mass_kg: jax.Array  # [] kg
    inertia_kg_m2: jax.Array  # [3] kg m^2, principal, body axes
    rotor_position_m: jax.Array  # [R, 3] m, body
    rotor_spin: jax.Array  # [R] +1 counter-clockwise seen from above, -1 clockwise
    thrust_coefficient_n_s2: jax.Array  # [] N/(rad/s)^2
    moment_constant_m: jax.Array  # [] m, torque over thrust
    time_constant_up_s: jax.Array  # [] s, speed rising
    time_constant_down_s: jax.Array  # [] s, speed falling
    speed_min_rad_s: jax.Array  # [] rad/s
    speed_max_rad_s: jax.Array  # [] rad/s
    rotor_inertia_kg_m2: jax.Array  # [] kg m^2, of one rotor about its axis
    rotor_radius_m: jax.Array  # [] m
    drag_quadratic_kg_m: jax.Array  # [] N/(m/s)^2
    contact_position_m: jax.Array  # [C, 3] m, body: the feet, then the rotor hubs (on which it lies when it has tipped)
    contact_stiffness_n_m: jax.Array  # [] N/m, normal, of one point
    contact_tangential_n_m: jax.Array  # [] N/m, tangential, of one point
    contact_damping_n_s_m: jax.Array  # [] N s/m, normal, of one point
    contact_friction: jax.Array  # [] Coulomb coefficient
    drive_efficiency: jax.Array  # [] battery to shaft
    avionics_power_w: jax.Array  # [] W
    battery_capacity_j: jax.Array  # [] J
    control: ControlParams


def multirotor_params(spec: Multirotor) -> MultirotorParams:
    """The parameters of the vehicle file ``spec`` as float32 arrays."""
    arms = np.array([r.position_m for r in spec.rotors])
    rotor, feet, battery = spec.rotor, spec.feet, spec.battery
    contacts = np.concatenate([np.array(feet.positions_m), arms])
    numbers = {
        "mass_kg": spec.mass_kg,
        "inertia_kg_m2": spec.inertia_kg_m2,
        "rotor_position_m": arms,
        "rotor_spin": _spins(spec),
        "thrust_coefficient_n_s2": rotor.thrust_coefficient_n_s2,
        "moment_constant_m": rotor.moment_constant_m,
        "time_constant_up_s": rotor.time_constant_up_s,
        "time_constant_down_s": rotor.time_constant_down_s,
        "speed_min_rad_s": rotor.speed_min_rad_s,
        "speed_max_rad_s": rotor.speed_max_rad_s,
        "rotor_inertia_kg_m2": rotor.inertia_kg_m2,
        "rotor_radius_m": rotor.radius_m,
        "drag_quadratic_kg_m": spec.drag_quadratic_kg_m,
        "contact_position_m": contacts,
        "contact_stiffness_n_m": feet.stiffness_n_m,
        "contact_tangential_n_m": feet.tangential_stiffness_n_m,
        "contact_damping_n_s_m": feet.damping_n_s_m,
        "contact_friction": feet.friction,
        "drive_efficiency": battery.drive_efficiency,
        "avionics_power_w": battery.avionics_power_w,
        "battery_capacity_j": 3600.0 * battery.capacity_wh,
    }
    return MultirotorParams(**_float32(numbers), control=control_params(spec))


def control_params(spec: Multirotor) -> ControlParams:
    """The autopilot of the vehicle file ``spec``, with its rotor allocation worked out."""
    gains, rotor = spec.control, spec.rotor
    numbers = {
        "mass_kg": spec.mass_kg,
        "inertia_kg_m2": spec.inertia_kg_m2,
        "allocation": np.linalg.pinv(effectiveness(spec)),
        "thrust_coefficient_n_s2": rotor.thrust_coefficient_n_s2,
        "speed_min_rad_s": rotor.speed_min_rad_s,
        "speed_max_rad_s": rotor.speed_max_rad_s,
        "rotor_time_constant_s": 0.5 * (rotor.time_constant_up_s + rotor.time_constant_down_s),
        "position_gain_1_s": gains.position_gain_1_s,
        "velocity_gain_1_s": gains.velocity_gain_1_s,
        "velocity_integral_1_s2": gains.velocity_integral_1_s2,
        "attitude_gain_1_s": gains.attitude_gain_1_s,
        "yaw_gain_1_s": gains.yaw_gain_1_s,
        "rate_gain_1_s": gains.rate_gain_1_s,
        "yaw_rate_max_rad_s": np.radians(gains.yaw_rate_max_deg_s),
        "tilt_max_tan": np.tan(np.radians(gains.tilt_max_deg)),
        "speed_max_m_s": gains.speed_max_m_s,
        "climb_rate_max_m_s": gains.climb_rate_max_m_s,
        "acceleration_max_m_s2": gains.acceleration_max_m_s2,
    }
    return ControlParams(**_float32(numbers))


def effectiveness(spec: Multirotor) -> np.ndarray:
    """Matrix [4, R] from rotor thrusts (N) to total thrust (N) and torque x, y, z (N m, body)."""
    arms = np.array([r.position_m for r in spec.rotors])
    yaw = -_spins(spec) * spec.rotor.moment_constant_m
    return np.stack([np.ones(len(arms)), arms[:, 1], -arms[:, 0], yaw])


def rotor_speeds(params: MultirotorParams, speed_rad_s: jax.Array, command_rad_s: jax.Array, dt: float) -> jax.Array:
    """Rotor speeds [R] rad/s after ``dt`` s of the commands [R] rad/s, a first-order lag solved exactly.

    A command at or below zero disarms the rotor, which then runs down to rest; any other is held to the motor's range.
    """
    inside = jnp.clip(command_rad_s, params.speed_min_rad_s, params.speed_max_rad_s)
    target = jnp.where(command_rad_s <= 0.0, 0.0, inside)
    time_constant = jnp.where(target > speed_rad_s, params.time_constant_up_s, params.time_constant_down_s)
    return target + (speed_rad_s - target) * jnp.exp(-dt / time_constant)


def ground_effect(height_m: jax.Array, radius_m: jax.Array) -> jax.Array:
    """Thrust over thrust far from the ground, at equal power, of rotors [...] ``height_m`` above it.

    Cheeseman and Bennett, "The effect of the ground on a helicopter rotor in forward flight" (ARC R&M 3021, 1955), in
    hover: 1 / (1 - (R / 4 z)^2). The height is held above half a radius, where the theory ends: the factor is at most
    4/3.
    """
    ratio = 0.25 * radius_m / jnp.maximum(height_m, GROUND_EFFECT_HEIGHT_MIN * radius_m)
    return 1.0 / (1.0 - ratio * ratio)


def wrench(
    params: MultirotorParams,
    *,
    speed_before_rad_s: jax.Array,
    speed_after_rad_s: jax.Array,
    rotor_height_m: jax.Array,
    air_velocity_m_s: jax.Array,
    dt: float,
) -> tuple[jax.Array, jax.Array]:
    """Force [3] N and torque [3] N m (body) of rotors and air on the vehicle, mean over a step of ``dt`` s.

    ``speed_before_rad_s`` and ``speed_after_rad_s`` [R] are the rotor speeds at the ends of the step,
    ``rotor_height_m`` [R] the hubs' heights above the ground, ``air_velocity_m_s`` [3] the vehicle's velocity through
    the air (body).

    Thrust k w^2 along body z; its torque c k w^2 and the reaction to the rotor's acceleration act against the spin
    (Mahony, Kumar, Corke, "Multirotor aerial vehicles", IEEE Robotics & Automation Magazine 19(3), 2012). The rotors'
    gyroscopic torque is the integrator's part (`rotor_momentum`). Drag is quadratic against the air velocity, as in the
    MRS multirotor simulator.
    """
    speed = 0.5 * (speed_before_rad_s + speed_after_rad_s)
    free_thrust = params.thrust_coefficient_n_s2 * speed * speed
    thrust = free_thrust * ground_effect(rotor_height_m, params.rotor_radius_m)
    acceleration = (speed_after_rad_s - speed_before_rad_s) / dt
    shaft_torque = params.moment_constant_m * free_thrust + params.rotor_inertia_kg_m2 * acceleration
    x, y = params.rotor_position_m[:, 0], params.rotor_position_m[:, 1]
    torque = jnp.stack(
        [
            jnp.sum(y * thrust),
            -jnp.sum(x * thrust),
            -jnp.sum(params.rotor_spin * shaft_torque),
        ]
    )
    airspeed = jnp.sqrt(jnp.sum(air_velocity_m_s**2) + 1e-12)  # the small term keeps the gradient finite at rest
    drag = -params.drag_quadratic_kg_m * airspeed * air_velocity_m_s
    return drag + jnp.sum(thrust) * jnp.array([0.0, 0.0, 1.0], drag.dtype), torque


def rotor_momentum(params: MultirotorParams, speed_rad_s: jax.Array) -> jax.Array:
    """Angular momentum [] N m s of rotors that turn at ``speed_rad_s`` [R], along body z, relative to the body.

    It turns with the body and so gives the gyroscopic torque -omega x h.
    """
    return params.rotor_inertia_kg_m2 * jnp.sum(params.rotor_spin * speed_rad_s)


def battery_power(
    params: MultirotorParams, *, speed_before_rad_s: jax.Array, speed_after_rad_s: jax.Array, dt: float
) -> jax.Array:
    """Power [] W drawn from the battery: shaft power over the drive's efficiency, plus the avionics.

    A rotor that slows down gives nothing back to the battery.
    """
    speed = 0.5 * (speed_before_rad_s + speed_after_rad_s)
    drag_torque = params.moment_constant_m * params.thrust_coefficient_n_s2 * speed * speed
    torque = drag_torque + params.rotor_inertia_kg_m2 * (speed_after_rad_s - speed_before_rad_s) / dt
    return jnp.sum(jnp.maximum(torque * speed, 0.0)) / params.drive_efficiency + params.avionics_power_w


def multirotor_mjcf(spec: Multirotor, dt: float = 0.005, *, visual: bool = True) -> str:
    """MJCF of the vehicle: one free body at its centre of mass, without contact (the feet are forces of ours).

    ``visual`` adds arms, rotor discs and feet to look at.
    """
    return free_body_mjcf(spec.name, spec.mass_kg, spec.inertia_kg_m2, dt, _shapes(spec) if visual else ())


def free_body_mjcf(
    name: str, mass_kg: float, inertia_kg_m2: Sequence[float], dt: float, shapes: Sequence[str] = ()
) -> str:
    """MJCF of one free body with geometries ``shapes``.

    The options switch off all that a free body has no use for; a sparse Jacobian is what MJX steps fastest here.
    """
    inertia = " ".join(f"{i:.9g}" for i in inertia_kg_m2)
    lines = "\n".join(shapes)
    return f"""<mujoco model="{name}">
  <option timestep="{dt:.9g}" integrator="Euler" jacobian="sparse" gravity="0 0 {-GRAVITY_M_S2}">
    <flag contact="disable" constraint="disable" eulerdamp="disable"/>
  </option>
  <worldbody>
    <body name="{name}">
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass_kg:.9g}" diaginertia="{inertia}"/>
{lines}
    </body>
  </worldbody>
</mujoco>
"""


def _shapes(spec: Multirotor) -> list[str]:
    """Geometries that only show: arms and rotor discs, legs and feet."""
    look = 'contype="0" conaffinity="0" mass="0"'
    lines = []
    for rotor in spec.rotors:
        x, y, z = rotor.position_m
        radius = spec.rotor.radius_m
        lines += [
            f'      <geom type="capsule" fromto="0 0 0 {x} {y} {z}" size="0.012" rgba="0.15 0.15 0.15 1" {look}/>',
            f'      <geom type="cylinder" pos="{x} {y} {z}" size="{radius} 0.003" rgba="0.2 0.2 0.2 0.4" {look}/>',
        ]
    for x, y, z in spec.feet.positions_m:
        lines.append(
            f'      <geom type="capsule" fromto="{0.4 * x} {0.4 * y} 0 {x} {y} {z}" size="0.008" '
            f'rgba="0.3 0.3 0.3 1" {look}/>'
        )
    return lines


def _spins(spec: Multirotor) -> np.ndarray:
    return np.array([1.0 if r.spin == "ccw" else -1.0 for r in spec.rotors])


def _float32(numbers: dict[str, Any]) -> dict[str, jax.Array]:
    return {name: on_device(number) for name, number in numbers.items()}
