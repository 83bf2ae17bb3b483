"""Parameters of a four-wheel skid-steer rover and its MJCF, both from the specification."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.vehicles import SkidSteer
from swarmsim.pytree import on_device, pytree
from swarmsim.vehicles.rover_body import RoverBody, rover_body, steiner
from swarmsim.vehicles.state import GRAVITY_M_S2

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")

# Contact of a tyre in MuJoCo's terms. MuJoCo's relaxed friction cone lifts a sliding contact: at the default settings a
# rover that turns on the spot hops, and turns at half the rate of Coulomb's law. It does not hop while friction x
# SLIP_DAMPING x slip stays below load x inverse mass x (1 - IMPEDANCE) / IMPEDANCE, here up to 0.9 m/s of slip. Stiff
# friction rows (FRICTION_RATIO) keep a parked rover from creeping: 2 mm/s on a slope of 15 degrees.
IMPEDANCE = 0.5  # solimp, constant over the depth
FRICTION_RATIO = 100.0  # impratio
SLIP_DAMPING_1_S = 10.0  # b of solreffriction


@pytree
class SkidSteerParams:
    """Parameters of a rover; each can be swept. Body frame FLU, origin in the centre of mass; wheels FL, FR, RL, RR."""

    mass_kg: jax.Array  # [] the whole rover
    inertia_kg_m2: jax.Array  # [3, 3] the whole rover about its centre of mass
    wheel_position_m: jax.Array  # [4, 3] wheel centres
    wheel_radius_m: jax.Array  # []
    wheel_width_m: jax.Array  # []
    wheel_inertia_kg_m2: jax.Array  # [] one wheel about its axle
    rotor_inertia_kg_m2: jax.Array  # [4] motor and gears of each wheel, as it feels them; 0 of a castor
    driven: jax.Array  # [4] 1, or 0 of a castor
    friction: jax.Array  # [4] Coulomb coefficient between tyre and ground
    contact_softness: jax.Array  # [] inverse mass of a wheel's centre (`wheel_inverse_mass`) x the rover's mass
    contact_stiffness_1_s2: jax.Array  # [] k of the reference acceleration -b v - k d r, see `tyre_constants`
    contact_damping_1_s: jax.Array  # [] b of the same, along the normal
    rolling_resistance: jax.Array  # [] resisting force over load
    torque_max_nm: jax.Array  # [] per wheel
    motor_time_constant_s: jax.Array  # [] lag of the torque
    speed_gain_nm_s: jax.Array  # [] torque per wheel-speed error
    wheel_speed_max_rad_s: jax.Array  # []
    corner_m: jax.Array  # [4, 2] corners of the outline in the body's x-y plane
    hull_m: jax.Array  # [2, 3] lowest and highest corner of the chassis
    hull_stiffness_n_m: jax.Array  # [] per point of contact
    hull_damping_n_s_m: jax.Array  # [] per point of contact
    hull_friction: jax.Array  # [] Coulomb coefficient between chassis and ground
    step_max_m: jax.Array  # [] highest step that it climbs
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


def skid_steer_params(spec: SkidSteer, body: RoverBody | None = None) -> SkidSteerParams:
    """Parameters of ``spec``; ``body`` replaces the body that it describes."""
    body = body or rover_body(spec)
    rear, front, right, left = body.outline_m
    stiffness, damping = tyre_constants(spec, body)
    half = 0.5 * np.array(spec.chassis_size_m)
    driven, friction = wheel_kinds(spec)
    middle = np.array([0.0, 0.0, spec.chassis_height_m - body.wheel_radius_m + body.wheel_position_m[0, 2]])
    values = {
        "mass_kg": body.mass_kg,
        "inertia_kg_m2": body.inertia_kg_m2,
        "wheel_position_m": body.wheel_position_m,
        "wheel_radius_m": body.wheel_radius_m,
        "wheel_width_m": body.wheel_width_m,
        "wheel_inertia_kg_m2": body.wheel_inertia_kg_m2[0],
        "rotor_inertia_kg_m2": spec.motor.rotor_inertia_kg_m2 * driven,
        "driven": driven,
        "friction": friction,
        "contact_softness": wheel_inverse_mass(spec, body) * body.mass_kg,
        "contact_stiffness_1_s2": stiffness,
        "contact_damping_1_s": damping,
        "rolling_resistance": spec.wheels.rolling_resistance,
        "torque_max_nm": spec.motor.torque_max_nm,
        "motor_time_constant_s": spec.motor.time_constant_s,
        "speed_gain_nm_s": spec.motor.speed_gain_nm_s,
        "wheel_speed_max_rad_s": spec.motor.speed_max_rad_s,
        "corner_m": [[front, left], [front, right], [rear, left], [rear, right]],
        "hull_m": [-half + middle, half + middle],
        "hull_stiffness_n_m": spec.bumper.stiffness_n_m,
        "hull_damping_n_s_m": spec.bumper.damping_n_s_m,
        "hull_friction": spec.bumper.friction,
        "step_max_m": spec.step_max_m,
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
    return SkidSteerParams(**{name: on_device(value) for name, value in values.items()})


def wheel_kinds(spec: SkidSteer) -> tuple[np.ndarray, np.ndarray]:
    """Which wheels are driven [4] (1 or 0), and the friction [4] of each."""
    castors = spec.wheels.castors
    if castors is None:
        return np.ones(4), np.full(4, spec.wheels.friction)
    return np.array([1.0, 1.0, 0.0, 0.0]), np.array([spec.wheels.friction] * 2 + [castors.friction] * 2)


def wheel_spacing(wheel_position_m: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Wheel base [] and track [] (m) of wheels at ``wheel_position_m`` [4, 3]."""
    front_left, front_right, rear_left, rear_right = wheel_position_m
    base = 0.5 * (front_left[0] + front_right[0] - rear_left[0] - rear_right[0])
    track = 0.5 * (front_left[1] + rear_left[1] - front_right[1] - rear_right[1])
    return base, track


def effective_track(wheel_position_m: jax.Array) -> jax.Array:
    """Track [] (m) of the differential-drive robot that turns at the same rate as the slipping rover.

    A skid-steer robot turns about centres of rotation of its left and right treads that lie outside them (Martinez et
    al., Int. J. Robotics Research 24(10), 2005; Mandow et al., IROS 2007). Their distance follows from the balance of
    yaw moments of equally loaded Coulomb contacts: each slips sideways at w b / 2, so it must slip along the wheel at
    w b^2 / (2 B), and the tread's speed is w / 2 (B + b^2 / B) with the track B and the wheel base b, whatever the
    friction.
    """
    base, track = wheel_spacing(wheel_position_m)
    return track + base * base / track


def turning_track(params: SkidSteerParams) -> jax.Array:
    """Track [] (m) by which wheel speeds turn the rover: `effective_track`, or that of the driven wheels with castors.

    With castors it turns about a point of the driven axle, where no driven wheel has to slip.
    """
    _, track = wheel_spacing(params.wheel_position_m)
    return jnp.where(jnp.min(params.driven) > 0.0, effective_track(params.wheel_position_m), track)


def turning_force(params: SkidSteerParams, load_n: jax.Array) -> jax.Array:
    """Total force [] (N) along the wheels that keeps a rover of weight ``load_n`` [] turning, see `effective_track`.

    With castors, what their friction at the distance of the wheel base takes, at the driven wheels' half track.
    """
    base, track = wheel_spacing(params.wheel_position_m)
    skid = params.friction[0] * load_n * base * jax.lax.rsqrt(base * base + track * track)
    share = jnp.mean(params.wheel_position_m[:2, 0]) / base
    swept = params.friction[2] * share * load_n * base / (0.5 * track)
    return jnp.where(jnp.min(params.driven) > 0.0, skid, swept)


def tyre_sinkage(params: SkidSteerParams) -> jax.Array:
    """Depth [] (m) of a tyre in the ground under a quarter of the weight: load over D k d (`tyre_constants`)."""
    load_per_mass = 0.25 * params.gravity_m_s2 * params.contact_softness * (1.0 - IMPEDANCE) / IMPEDANCE
    return load_per_mass / (params.contact_stiffness_1_s2 * IMPEDANCE)


def tyre_creep(params: SkidSteerParams) -> jax.Array:
    """Slip [4] (m/s) at which MuJoCo's regularised friction under a quarter of the weight is fully developed."""
    load_per_mass = 0.25 * params.gravity_m_s2 * params.contact_softness * (1.0 - IMPEDANCE) / IMPEDANCE
    return params.friction * load_per_mass / (FRICTION_RATIO * SLIP_DAMPING_1_S)


def wheel_inverse_mass(spec: SkidSteer, body: RoverBody) -> float:
    """Acceleration of a wheel's centre per force (1/kg), mean over directions: MuJoCo's body_invweight0."""
    axle = body.wheel_inertia_kg_m2[0]
    mass = np.zeros((10, 10))
    mass[:3, :3], mass[3:6, 3:6] = body.mass_kg * np.eye(3), body.inertia_kg_m2
    mass[4, 6:] = mass[6:, 4] = axle
    mass[6:, 6:] = np.diag(axle + spec.motor.rotor_inertia_kg_m2 * wheel_kinds(spec)[0])
    x, y, z = body.wheel_position_m[0]
    jacobian = np.hstack([np.eye(3), [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]], np.zeros((3, 4))])
    return float(np.trace(jacobian @ np.linalg.solve(mass, jacobian.T)) / 3.0)


def tyre_constants(spec: SkidSteer, body: RoverBody) -> tuple[float, float]:
    """Stiffness k (1/s^2) and damping b (1/s) of MuJoCo's reference acceleration -b v - k d r for the tyre of ``spec``.

    At depth r the force is D k d r with the impedance d and D = d / (1 - d) / inverse mass; D also acts as added mass.
    """
    added = IMPEDANCE / (1.0 - IMPEDANCE) / wheel_inverse_mass(spec, body)
    stiffness = spec.wheels.stiffness_n_m / (added * IMPEDANCE)
    critical = 2.0 * math.sqrt(spec.wheels.stiffness_n_m * (0.25 * body.mass_kg + added))
    return stiffness, spec.wheels.damping_ratio * critical / added


def skid_steer_mjcf(spec: SkidSteer, body: RoverBody | None = None, time_step_s: float = 0.005) -> str:
    """MJCF of the rover: a free chassis, four wheels on hinges, and for each wheel a mocap plane that touches it alone.

    The free body's frame has its origin in the rover's centre of mass. Wheels touch the ground as spheres: one contact
    each, under the centre. Elliptic cones, so that friction has no preferred direction.
    """
    body = body or rover_body(spec)
    stiffness, damping = tyre_constants(spec, body)
    # MuJoCo divides a negative solref by the square of the impedance (stiffness) and by the impedance (damping).
    reference = _text(-stiffness * IMPEDANCE**2, -damping * IMPEDANCE)
    contact = (
        f'condim="3" solref="{reference}" '
        f'solreffriction="-1 {-SLIP_DAMPING_1_S * IMPEDANCE}" solimp="{IMPEDANCE} {IMPEDANCE} 0.001 0.5 1"'
    )
    geom = 'contype="0" conaffinity="0"'
    planes, wheels, pairs, motors = [], [], [], []
    for name, position, driven, mu in zip(WHEELS, body.wheel_position_m, *wheel_kinds(spec), strict=True):
        planes.append(
            f'<body name="ground_{name}" mocap="true" pos="0 0 {_text(position[2] - body.wheel_radius_m)}">'
            f'<geom name="ground_{name}" type="plane" size="1 1 1" {geom}/></body>'
        )
        axle, across = body.wheel_inertia_kg_m2
        wheels.append(
            f'<body name="{name}" pos="{_text(*position)}">'
            f'<joint name="{name}" type="hinge" axis="0 1 0" armature="{driven * spec.motor.rotor_inertia_kg_m2}"/>'
            f'<inertial pos="0 0 0" mass="{body.wheel_mass_kg}" diaginertia="{_text(across, axle, across)}"/>'
            f'<geom name="{name}" type="sphere" size="{body.wheel_radius_m}" {geom}/></body>'
        )
        pairs.append(f'<pair geom1="ground_{name}" geom2="{name}" friction="{mu} {mu} 0 0 0" {contact}/>')
        motors.append(f'<motor name="{name}" joint="{name}"/>')
    return "\n".join(
        [
            f'<mujoco model="{spec.name}">',
            f'<option timestep="{time_step_s}" gravity="0 0 -{GRAVITY_M_S2}" cone="elliptic"'
            f' impratio="{FRICTION_RATIO}" jacobian="dense"><flag eulerdamp="disable"/></option>',
            "<worldbody>",
            *planes,
            '<body name="chassis"><freejoint/>',
            _chassis_inertial(body),
            *wheels,
            "</body>",
            "</worldbody>",
            f"<contact>{''.join(pairs)}</contact>",
            f"<actuator>{''.join(motors)}</actuator>",
            "</mujoco>",
        ]
    )


def _chassis_inertial(body: RoverBody) -> str:
    """The ``inertial`` element of the chassis: the rover less its wheels."""
    axle, across = body.wheel_inertia_kg_m2
    mass = body.mass_kg - 4.0 * body.wheel_mass_kg
    centre = -body.wheel_mass_kg * body.wheel_position_m.sum(axis=0) / mass
    inertia = body.inertia_kg_m2 - steiner(mass, centre)
    for position in body.wheel_position_m:
        inertia = inertia - np.diag([across, axle, across]) - steiner(body.wheel_mass_kg, position)
    full = (inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2])
    return f'<inertial pos="{_text(*centre)}" mass="{mass}" fullinertia="{_text(*full)}"/>'


def _text(*numbers: float) -> str:
    """Numbers for an MJCF attribute. Raises ValueError for non-finite ones, which MuJoCo does not read."""
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"a body needs finite numbers, not {numbers}")
    return " ".join(f"{number:.9g}" for number in numbers)
