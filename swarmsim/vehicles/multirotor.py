"""What a multirotor is: its parameters, its rotors and airframe in the air, and its body as MJCF.

Everything here is one vehicle in its body frame FLU (x forward, y left, z up, origin at the centre of mass), SI units.
All rotor axes point along body z.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.config.flight import FlightEffects
from swarmsim.config.vehicle_checks import effectiveness
from swarmsim.config.vehicles import Multirotor, RotorModel, inertia_tensor
from swarmsim.pytree import on_device, pytree
from swarmsim.vehicles.battery import BatteryParams
from swarmsim.vehicles.rotors import AIR_DENSITY_KG_M3, RotorAir, thrusts
from swarmsim.vehicles.state import GRAVITY_M_S2

LIFT_SLOPE = 5.73
"""Lift over angle of attack [1/rad] of a rotor blade's section (Leishman, section 2.14.1: 0.1 per degree)."""


@pytree
class ControlParams:
    """The autopilot's gains, limits and what it believes of the vehicle; sweeping the true mass leaves them alone."""

    mass_kg: jax.Array  # [] kg, nominal
    inertia_kg_m2: jax.Array  # [3] kg m^2, nominal, principal
    principal_axes: jax.Array | None = None  # [4] as in `MultirotorParams`
    allocation: jax.Array  # [R, 4] rotor thrust (N) for thrust (N) and torque x, y, z (N m, body): pseudo-inverse
    thrust_coefficient_n_s2: jax.Array  # [] N/(rad/s)^2, nominal
    speed_min_rad_s: jax.Array  # [] rad/s
    speed_max_rad_s: jax.Array  # [] rad/s
    rotor_time_constant_s: jax.Array  # [] s, nominal: mean of rising and falling
    drag_1_s: jax.Array  # [] deceleration by the rotors' drag over the airspeed, nominal
    drag_moment_ns: jax.Array  # [] moment of the rotors' drag about the centre of mass over the airspeed, nominal
    rolling_moment_ns: jax.Array  # [] the rotors' rolling moment over the airspeed, nominal
    climb_damping_1_s: jax.Array  # [] deceleration by the rotors' inflow over the speed along their axes, nominal
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
    inertia_kg_m2: jax.Array  # [3] kg m^2, principal moments
    principal_axes: jax.Array | None = None  # [4] quaternion, principal axes to body; None: they are the body's axes
    rotor_position_m: jax.Array  # [R, 3] m, body
    rotor_spin: jax.Array  # [R] +1 counter-clockwise seen from above, -1 clockwise
    thrust_coefficient_n_s2: jax.Array  # [] N/(rad/s)^2
    moment_constant_m: jax.Array  # [] m, yaw torque over thrust
    shaft_torque_nms2: jax.Array  # [] N m/(rad/s)^2 that the motor works against
    time_constant_up_s: jax.Array  # [] s, speed rising
    time_constant_down_s: jax.Array  # [] s, speed falling
    speed_min_rad_s: jax.Array  # [] rad/s
    speed_max_rad_s: jax.Array  # [] rad/s
    speed_max_voltage_v: jax.Array  # [] V: below it the largest speed falls with the voltage
    rotor_inertia_kg_m2: jax.Array  # [] kg m^2, of one rotor about its axis
    rotor_air: RotorAir
    downwash: jax.Array  # [] 1, or 0 to leave out what it does to those below
    speed_noise: jax.Array  # [] standard deviation of a rotor's speed over what is commanded
    drag_quadratic_kg_m: jax.Array  # [3] N/(m/s)^2 along the body axes
    collision_radius_m: jax.Array  # [] m, of the upright cylinder around it
    contact_position_m: jax.Array  # [C, 3] m, body: the feet, then the rotor hubs (on which it lies when it has tipped)
    contact_stiffness_n_m: jax.Array  # [] N/m, normal, of one point
    contact_tangential_n_m: jax.Array  # [] N/m, tangential, of one point
    contact_damping_n_s_m: jax.Array  # [] N s/m, normal, of one point
    contact_friction: jax.Array  # [] Coulomb coefficient
    drive_efficiency: jax.Array  # [] battery to shaft
    avionics_power_w: jax.Array  # [] W
    battery: BatteryParams
    control: ControlParams


def multirotor_params(spec: Multirotor, effects: FlightEffects | None = None) -> MultirotorParams:
    """The parameters of the vehicle file ``spec`` as float32 arrays; ``effects`` are all of them by default."""
    effects = effects or FlightEffects()
    arms = np.array([r.position_m for r in spec.rotors])
    rotor, feet, battery = spec.rotor, spec.feet, spec.battery
    contacts = np.concatenate([np.array(feet.positions_m), arms])
    moments, axes = principal_inertia(spec)
    numbers = {
        "mass_kg": spec.mass_kg,
        "inertia_kg_m2": moments,
        "rotor_position_m": arms,
        "rotor_spin": _spins(spec),
        "thrust_coefficient_n_s2": rotor.thrust_coefficient_n_s2,
        "moment_constant_m": rotor.moment_constant_m,
        "time_constant_up_s": rotor.time_constant_up_s,
        "time_constant_down_s": rotor.time_constant_down_s,
        "speed_min_rad_s": rotor.speed_min_rad_s,
        "speed_max_rad_s": rotor.speed_max_rad_s,
        "rotor_inertia_kg_m2": rotor.inertia_kg_m2,
        "shaft_torque_nms2": rotor.thrust_coefficient_n_s2 * hover_induced(rotor) / rotor.figure_of_merit,
        "speed_max_voltage_v": rotor.speed_max_voltage_v if effects.battery_sag else 0.0,
        "downwash": 1.0 if effects.downwash else 0.0,
        "speed_noise": (rotor.speed_noise or 0.0) if effects.motor_noise else 0.0,
        "drag_quadratic_kg_m": np.broadcast_to(spec.drag_quadratic_kg_m, 3),
        "collision_radius_m": spec.collision_radius_m,
        "contact_position_m": contacts,
        "contact_stiffness_n_m": feet.stiffness_n_m,
        "contact_tangential_n_m": feet.tangential_stiffness_n_m,
        "contact_damping_n_s_m": feet.damping_n_s_m,
        "contact_friction": feet.friction,
        "drive_efficiency": battery.drive_efficiency,
        "avionics_power_w": battery.avionics_power_w,
    }
    pack = {
        "capacity_j": 3600.0 * battery.capacity_wh,
        "cells": battery.cells,
        "resistance_ohm": battery.resistance_ohm if effects.battery_sag else 0.0,
    }
    air = _rotor_air(spec, effects)
    return MultirotorParams(
        **_float32(numbers),
        principal_axes=None if axes is None else on_device(axes),
        rotor_air=air,
        battery=BatteryParams(**_float32(pack)),
        control=control_params(spec, air),
    )


def principal_inertia(spec: Multirotor) -> tuple[np.ndarray, np.ndarray | None]:
    """Principal moments [3] (kg m^2) and the quaternion [4] from their axes to the body's; None: they are those axes.

    Of the many ways to name and to point the principal axes, that nearest to the body's axes.
    """
    tensor = inertia_tensor(spec.inertia_kg_m2)
    if np.array_equal(tensor, np.diag(np.diag(tensor))):
        return np.diag(tensor), None
    moments, axes = np.linalg.eigh(tensor)
    order = max(itertools.permutations(range(3)), key=lambda p: np.abs(axes[range(3), p]).prod())
    moments, axes = moments[list(order)], axes[:, order]
    axes = axes * np.where(np.diag(axes) < 0.0, -1.0, 1.0)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    return moments, quaternion


def hover_induced(rotor: RotorModel) -> float:
    """Induced velocity in hover [m/s] over the rotor speed [rad/s]: that of the ideal rotor, sqrt(T / 2 rho A)."""
    area = np.pi * rotor.radius_m**2
    return float(np.sqrt(rotor.thrust_coefficient_n_s2 / (2.0 * AIR_DENSITY_KG_M3 * area)))


def _rotor_air(spec: Multirotor, effects: FlightEffects) -> RotorAir:
    """Coefficients of the rotors in moving air, by blade element theory with a uniform inflow.

    With the lift slope a and the solidity sigma, thrust changes by rho A a sigma / 4 per tip speed and inflow; in hover
    the induced velocity, which follows the thrust, takes the share 1 / (1 + a sigma / 16 lambda) of it (Leishman,
    sections 3.2 and 3.3).
    """
    rotor = spec.rotor
    induced, area = hover_induced(rotor), np.pi * rotor.radius_m**2
    lift = LIFT_SLOPE * (rotor.solidity or 0.0)
    ratio = induced / rotor.radius_m
    inflow = AIR_DENSITY_KG_M3 * area * 0.25 * lift / (1.0 + lift / (16.0 * ratio))
    coefficient = rotor.thrust_coefficient_n_s2 / (AIR_DENSITY_KG_M3 * area * rotor.radius_m**2)
    numbers = {
        "radius_m": rotor.radius_m,
        "induced_m": induced,
        "inflow_kg_m": inflow if effects.inflow else 0.0,
        "translational_lift_kg_m": inflow if effects.translational_lift else 0.0,
        "pitch_rad": 3.0 * (2.0 * coefficient / lift + 0.5 * ratio) if lift else 0.0,
        "drag_kg": (rotor.drag_kg or 0.0) if effects.rotor_drag else 0.0,
        "rolling_moment_kg_m": (rotor.rolling_moment_kg_m or 0.0) if effects.rolling_moment else 0.0,
        "ground_effect": 1.0 if effects.ground_effect else 0.0,
    }
    return RotorAir(**_float32(numbers))


def control_params(spec: Multirotor, air: RotorAir) -> ControlParams:
    """The autopilot of the vehicle file ``spec`` with rotors in ``air``, its rotor allocation worked out."""
    gains, rotor = spec.control, spec.rotor
    moments, axes = principal_inertia(spec)
    numbers = {
        "mass_kg": spec.mass_kg,
        "inertia_kg_m2": moments,
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
    hover = np.sqrt(GRAVITY_M_S2 * spec.mass_kg / len(spec.rotors) / rotor.thrust_coefficient_n_s2)
    inflow = float(air.inflow_kg_m) * rotor.radius_m * hover
    level = len(spec.rotors) * hover
    numbers["drag_1_s"] = float(air.drag_kg) * level / spec.mass_kg
    numbers["drag_moment_ns"] = float(np.mean([r.position_m[2] for r in spec.rotors])) * float(air.drag_kg) * level
    numbers["rolling_moment_ns"] = float(air.rolling_moment_kg_m) * level
    numbers["climb_damping_1_s"] = 0.5 * len(spec.rotors) * inflow / spec.mass_kg
    return ControlParams(**_float32(numbers), principal_axes=None if axes is None else on_device(axes))


def rotor_speeds(
    params: MultirotorParams, speed_rad_s: jax.Array, command_rad_s: jax.Array, voltage_v: jax.Array, dt: float
) -> jax.Array:
    """Rotor speeds [R] rad/s after ``dt`` s of the commands [R] rad/s, a first-order lag solved exactly.

    A command at or below zero disarms the rotor, which then runs down to rest; any other is held to the motor's range.
    A motor's speed is bounded by its back-EMF, so that the range ends lower where the battery's ``voltage_v`` [] is
    low.
    """
    share = jnp.minimum(1.0, voltage_v / jnp.maximum(params.speed_max_voltage_v, 1e-3))
    inside = jnp.clip(command_rad_s, params.speed_min_rad_s, share * params.speed_max_rad_s)
    target = jnp.where(command_rad_s <= 0.0, 0.0, inside)
    rising, falling = jnp.exp(-dt / params.time_constant_up_s), jnp.exp(-dt / params.time_constant_down_s)
    return target + (speed_rad_s - target) * jnp.where(target > speed_rad_s, rising, falling)


def wrench(
    params: MultirotorParams,
    *,
    speed_before_rad_s: jax.Array,
    speed_after_rad_s: jax.Array,
    rotor_height_m: jax.Array,
    air_velocity_m_s: jax.Array,
    angular_velocity_rad_s: jax.Array,
    dt: float,
) -> tuple[jax.Array, jax.Array]:
    """Force [3] N and torque [3] N m (body) of rotors and air on the vehicle, mean over a step of ``dt`` s.

    ``speed_before_rad_s`` and ``speed_after_rad_s`` [R] are the rotor speeds at the ends of the step,
    ``rotor_height_m`` [R] the hubs' heights above the ground, ``air_velocity_m_s`` [3] the vehicle's velocity through
    the air (body); each rotor meets the air at its own hub.

    Thrust (`swarmsim.vehicles.rotors.thrusts`) along body z; the yaw torque c k w^2 and the reaction to the rotor's
    acceleration act against the spin (Mahony, Kumar, Corke, "Multirotor aerial vehicles", IEEE Robotics & Automation
    Magazine 19(3), 2012). Drag and rolling moment in the plane of a rotor are proportional to its speed and to the
    air's (Martin and Salaun, "The true role of accelerometer feedback in quadrotor control", ICRA 2010). The airframe's
    drag is quadratic, along each body axis with its own coefficient. The rotors' gyroscopic torque is the integrator's
    part (`rotor_momentum`).
    """
    speed = 0.5 * (speed_before_rad_s + speed_after_rad_s)
    place, air = params.rotor_position_m, params.rotor_air
    hub = air_velocity_m_s + jnp.cross(angular_velocity_rad_s, place)
    thrust = thrusts(air, params.thrust_coefficient_n_s2, speed, hub, rotor_height_m)
    across = -air.drag_kg * speed[:, None] * hub[:, :2]
    roll = -air.rolling_moment_kg_m * jnp.sum(speed[:, None] * hub[:, :2], axis=0)
    acceleration = (speed_after_rad_s - speed_before_rad_s) / dt
    free_thrust = params.thrust_coefficient_n_s2 * speed * speed
    shaft_torque = params.moment_constant_m * free_thrust + params.rotor_inertia_kg_m2 * acceleration
    x, y, z = place[:, 0], place[:, 1], place[:, 2]
    torque = jnp.stack(
        [
            jnp.sum(y * thrust - z * across[:, 1]) + roll[0],
            jnp.sum(z * across[:, 0] - x * thrust) + roll[1],
            jnp.sum(x * across[:, 1] - y * across[:, 0] - params.rotor_spin * shaft_torque),
        ]
    )
    force = jnp.append(jnp.sum(across, axis=0), jnp.sum(thrust))
    return airframe_drag(params, air_velocity_m_s) + force, torque


def airframe_drag(params: MultirotorParams, air_velocity_m_s: jax.Array) -> jax.Array:
    """Drag [3] N of the airframe, which moves by ``air_velocity_m_s`` [3] through the air; both body frame."""
    airspeed = jnp.sqrt(jnp.sum(air_velocity_m_s**2) + 1e-12)  # the small term keeps the gradient finite at rest
    return -params.drag_quadratic_kg_m * airspeed * air_velocity_m_s


def rotor_momentum(params: MultirotorParams, speed_rad_s: jax.Array) -> jax.Array:
    """Angular momentum [] N m s of rotors that turn at ``speed_rad_s`` [R], along body z, relative to the body.

    It turns with the body and so gives the gyroscopic torque -omega x h.
    """
    return params.rotor_inertia_kg_m2 * jnp.sum(params.rotor_spin * speed_rad_s)


def battery_power(
    params: MultirotorParams, *, speed_before_rad_s: jax.Array, speed_after_rad_s: jax.Array, dt: float
) -> jax.Array:
    """Power [] W at the battery's terminals: shaft power over the drive's efficiency, plus the avionics.

    A rotor that slows down gives nothing back to the battery.
    """
    speed = 0.5 * (speed_before_rad_s + speed_after_rad_s)
    torque = (
        params.shaft_torque_nms2 * speed * speed
        + params.rotor_inertia_kg_m2 * (speed_after_rad_s - speed_before_rad_s) / dt
    )
    return jnp.sum(jnp.maximum(torque * speed, 0.0)) / params.drive_efficiency + params.avionics_power_w


def multirotor_mjcf(spec: Multirotor, dt: float = 0.005, *, visual: bool = True) -> str:
    """MJCF of the vehicle: one free body at its centre of mass, without contact (the feet are forces of ours).

    ``visual`` adds arms, rotor discs and feet to look at.
    """
    return free_body_mjcf(spec.name, spec.mass_kg, spec.inertia_kg_m2, dt, _shapes(spec) if visual else ())


def free_body_mjcf(
    name: str, mass_kg: float, inertia_kg_m2: Sequence[float], dt: float, shapes: Sequence[str] = ()
) -> str:
    """MJCF of one free body with geometries ``shapes``; the inertia as in a vehicle's file, of 3 or 6 numbers.

    The options switch off all that a free body has no use for; a sparse Jacobian is what MJX steps fastest here.
    """
    inertia = " ".join(f"{i:.9g}" for i in inertia_kg_m2)
    which = "diaginertia" if len(inertia_kg_m2) == 3 else "fullinertia"
    lines = "\n".join(shapes)
    return f"""<mujoco model="{name}">
  <option timestep="{dt:.9g}" integrator="Euler" jacobian="sparse" gravity="0 0 {-GRAVITY_M_S2}">
    <flag contact="disable" constraint="disable" eulerdamp="disable"/>
  </option>
  <worldbody>
    <body name="{name}">
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass_kg:.9g}" {which}="{inertia}"/>
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
    for name, number in numbers.items():
        if not np.all(np.abs(np.asarray(number, np.float64)) < 1e30):
            raise InputError.of(f"{name} is too large for a vehicle", given=str(number))
    return {name: on_device(number) for name, number in numbers.items()}
