"""What a four-wheel skid-steer rover is: its parameters and its MJCF, both made from the specification."""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.vehicles import SkidSteer
from swarmsim.pytree import pytree

GRAVITY_M_S2 = 9.81
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RoverBody:
    """Masses and shape of a rover on the host; body frame FLU with its origin in the rover's centre of mass."""

    mass_kg: float  # the whole rover
    inertia_kg_m2: Floats  # [3, 3] the whole rover about its centre of mass
    wheel_position_m: Floats  # [4, 3] wheel centres
    wheel_radius_m: float
    wheel_width_m: float
    wheel_mass_kg: float
    wheel_inertia_kg_m2: tuple[float, float]  # about the axle, across the axle
    outline_m: tuple[float, float, float, float]  # rear, front, right, left bounds of the plan view (x, x, y, y)


@pytree
class SkidSteerParams:
    """Everything of a rover that a sweep may vary. Body frame FLU, origin in the centre of mass; wheels FL, FR, RL, RR."""

    mass_kg: jax.Array  # [] the whole rover
    inertia_kg_m2: jax.Array  # [3, 3] the whole rover about its centre of mass
    wheel_position_m: jax.Array  # [4, 3] wheel centres
    wheel_radius_m: jax.Array  # []
    wheel_inertia_kg_m2: jax.Array  # [] one wheel about its axle
    rotor_inertia_kg_m2: jax.Array  # [] motor and gears of one wheel, as the wheel feels them
    friction: jax.Array  # [] Coulomb coefficient between tyre and ground
    rolling_resistance: jax.Array  # [] resisting force over load
    torque_max_nm: jax.Array  # [] per wheel
    motor_time_constant_s: jax.Array  # [] lag of the torque
    speed_gain_nm_s: jax.Array  # [] torque per wheel-speed error
    wheel_speed_max_rad_s: jax.Array  # []
    corner_m: jax.Array  # [4, 2] corners of the outline in the body's x-y plane
    bumper_stiffness_n_m: jax.Array  # [] per corner
    bumper_damping_n_s_m: jax.Array  # [] per corner
    impact_speed_max_m_s: jax.Array  # [] hitting a wall faster is a collision
    battery_capacity_j: jax.Array  # []
    drive_efficiency: jax.Array  # [] battery to wheel
    avionics_power_w: jax.Array  # []
    lookahead_m: jax.Array  # [] pure pursuit
    speed_max_m_s: jax.Array  # []
    yaw_rate_max_rad_s: jax.Array  # []
    acceleration_max_m_s2: jax.Array  # []
    yaw_gain_1_s: jax.Array  # [] yaw-rate command per heading error
    gravity_m_s2: jax.Array  # []


def rover_body(spec: SkidSteer) -> RoverBody:
    """Body of the specification: a uniform box between four uniform discs, all upright over level ground."""
    wheels = spec.wheels
    x, y = 0.5 * wheels.wheel_base_m, 0.5 * wheels.track_m
    chassis_mass = spec.mass_kg - 4.0 * wheels.mass_kg
    height = (chassis_mass * spec.chassis_height_m + 4.0 * wheels.mass_kg * wheels.radius_m) / spec.mass_kg
    hub = wheels.radius_m - height
    wheel_position = np.array([[x, y, hub], [x, -y, hub], [-x, y, hub], [-x, -y, hub]])
    axle = 0.5 * wheels.mass_kg * wheels.radius_m**2
    across = wheels.mass_kg * (3.0 * wheels.radius_m**2 + wheels.width_m**2) / 12.0
    sides = np.square(spec.chassis_size_m)
    inertia = chassis_mass / 12.0 * np.diag(sides.sum() - sides)
    inertia += steiner(chassis_mass, np.array([0.0, 0.0, spec.chassis_height_m - height]))
    for position in wheel_position:
        inertia += np.diag([across, axle, across]) + steiner(wheels.mass_kg, position)
    front = max(0.5 * spec.chassis_size_m[0], x + wheels.radius_m)
    side = max(0.5 * spec.chassis_size_m[1], y + 0.5 * wheels.width_m)
    return RoverBody(
        mass_kg=spec.mass_kg,
        inertia_kg_m2=inertia,
        wheel_position_m=wheel_position,
        wheel_radius_m=wheels.radius_m,
        wheel_width_m=wheels.width_m,
        wheel_mass_kg=wheels.mass_kg,
        wheel_inertia_kg_m2=(axle, across),
        outline_m=(-front, front, -side, side),
    )


def steiner(mass_kg: float, offset_m: Floats) -> Floats:
    """Inertia [3, 3] that ``mass_kg`` gains when its centre stands at ``offset_m`` [3] (parallel axes)."""
    return mass_kg * (np.eye(3) * (offset_m @ offset_m) - np.outer(offset_m, offset_m))


def skid_steer_params(spec: SkidSteer, body: RoverBody | None = None) -> SkidSteerParams:
    """Parameters of ``spec``; ``body`` (from a URDF) takes the place of the body that the specification describes."""
    body = body or rover_body(spec)
    rear, front, right, left = body.outline_m
    values = {
        "mass_kg": body.mass_kg,
        "inertia_kg_m2": body.inertia_kg_m2,
        "wheel_position_m": body.wheel_position_m,
        "wheel_radius_m": body.wheel_radius_m,
        "wheel_inertia_kg_m2": body.wheel_inertia_kg_m2[0],
        "rotor_inertia_kg_m2": spec.motor.rotor_inertia_kg_m2,
        "friction": spec.wheels.friction,
        "rolling_resistance": spec.wheels.rolling_resistance,
        "torque_max_nm": spec.motor.torque_max_nm,
        "motor_time_constant_s": spec.motor.time_constant_s,
        "speed_gain_nm_s": spec.motor.speed_gain_nm_s,
        "wheel_speed_max_rad_s": spec.motor.speed_max_rad_s,
        "corner_m": [[front, left], [front, right], [rear, left], [rear, right]],
        "bumper_stiffness_n_m": spec.bumper.stiffness_n_m,
        "bumper_damping_n_s_m": spec.bumper.damping_n_s_m,
        "impact_speed_max_m_s": spec.impact_speed_max_m_s,
        "battery_capacity_j": 3600.0 * spec.battery.capacity_wh,
        "drive_efficiency": spec.battery.drive_efficiency,
        "avionics_power_w": spec.battery.avionics_power_w,
        "lookahead_m": spec.control.lookahead_m,
        "speed_max_m_s": spec.control.speed_max_m_s,
        "yaw_rate_max_rad_s": spec.control.yaw_rate_max_rad_s,
        "acceleration_max_m_s2": spec.control.acceleration_max_m_s2,
        "yaw_gain_1_s": spec.control.yaw_gain_1_s,
        "gravity_m_s2": GRAVITY_M_S2,
    }
    return SkidSteerParams(**{name: jnp.asarray(value, jnp.float32) for name, value in values.items()})


def effective_track(wheel_position_m: jax.Array) -> jax.Array:
    """Track [] (m) of the differential-drive robot that turns as the rover does while its tyres slip.

    A skid-steer robot turns about centres of rotation of its left and right treads that lie outside them (Martinez et al.,
    Int. J. Robotics Research 24(10), 2005; Mandow et al., IROS 2007). Their distance follows from the yaw balance of
    equally loaded Coulomb contacts: each slips sideways at w b / 2, so it must slip along the wheel at w b^2 / (2 B), and
    the tread's speed is w / 2 (B + b^2 / B) with the track B and the wheel base b, whatever the friction.
    """
    base = 0.5 * (wheel_position_m[0, 0] + wheel_position_m[1, 0] - wheel_position_m[2, 0] - wheel_position_m[3, 0])
    track = 0.5 * (wheel_position_m[0, 1] + wheel_position_m[2, 1] - wheel_position_m[1, 1] - wheel_position_m[3, 1])
    return track + base * base / track


def skid_steer_mjcf(spec: SkidSteer, body: RoverBody | None = None, time_step_s: float = 0.005) -> str:
    """MJCF of the rover: a free chassis, four wheels on hinges, and for each wheel a mocap plane that touches it alone.

    The free body's frame has its origin in the rover's centre of mass. Wheels touch the ground as spheres: one contact
    each, under the centre. Elliptic cones, so that friction has no preferred direction.
    """
    body = body or rover_body(spec)
    axle, across = body.wheel_inertia_kg_m2
    chassis_mass = body.mass_kg - 4.0 * body.wheel_mass_kg
    chassis_centre = -body.wheel_mass_kg * body.wheel_position_m.sum(axis=0) / chassis_mass
    inertia = body.inertia_kg_m2 - steiner(chassis_mass, chassis_centre)
    for position in body.wheel_position_m:
        inertia = inertia - np.diag([across, axle, across]) - steiner(body.wheel_mass_kg, position)
    full = (inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2])
    planes, wheels, motors = [], [], []
    for bit, (name, position) in enumerate(zip(WHEELS, body.wheel_position_m, strict=True)):
        pair = 1 << (bit + 1)
        friction = f'friction="{spec.wheels.friction} 0 0"'
        planes.append(
            f'<body name="ground_{name}" mocap="true" pos="0 0 {_text(position[2] - body.wheel_radius_m)}">'
            f'<geom type="plane" size="1 1 1" contype="0" conaffinity="{pair}" {friction}/></body>'
        )
        wheels.append(
            f'<body name="{name}" pos="{_text(*position)}">'
            f'<joint name="{name}" type="hinge" axis="0 1 0" armature="{spec.motor.rotor_inertia_kg_m2}"/>'
            f'<inertial pos="0 0 0" mass="{body.wheel_mass_kg}" diaginertia="{_text(across, axle, across)}"/>'
            f'<geom type="sphere" size="{body.wheel_radius_m}" contype="{pair}" conaffinity="0" {friction}/></body>'
        )
        motors.append(f'<motor name="{name}" joint="{name}"/>')
    return "\n".join(
        [
            f'<mujoco model="{spec.name}">',
            f'<option timestep="{time_step_s}" gravity="0 0 -{GRAVITY_M_S2}" cone="elliptic" jacobian="dense">'
            '<flag eulerdamp="disable"/></option>',
            "<worldbody>",
            *planes,
            '<body name="chassis"><freejoint/>',
            f'<inertial pos="{_text(*chassis_centre)}" mass="{chassis_mass}" fullinertia="{_text(*full)}"/>',
            *wheels,
            "</body>",
            "</worldbody>",
            f"<actuator>{''.join(motors)}</actuator>",
            "</mujoco>",
        ]
    )


def _text(*numbers: float) -> str:
    """Numbers for an MJCF attribute; refuses what MuJoCo would not read."""
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"a body needs finite numbers, not {numbers}")
    return " ".join(f"{number:.9g}" for number in numbers)
