"""Cascaded control of a multirotor: position, velocity, attitude, body rate, rotor thrusts.

A command may enter at any of the four levels of `swarmsim.control.commands`. The structure is that of PX4 and of
Brescianini and D'Andrea, "Tilt-prioritized quadrocopter attitude control", IEEE
Transactions on Control Systems Technology 28(2), 2020: the tilt, which carries the thrust, comes before the yaw.
World ENU, body FLU, SI units; one vehicle. Run it every 10 ms.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.control.commands import ATTITUDE, BODY_RATE, POSITION, MultirotorCommand, PositionCommand
from swarmsim.physics.rigid_body import times_inertia
from swarmsim.physics.rotations import conjugate, multiply, rotation_matrix, to_body
from swarmsim.pytree import pytree
from swarmsim.vehicles.multirotor import ControlParams, MultirotorParams
from swarmsim.vehicles.state import GRAVITY_M_S2, MultirotorState, RigidState

LIFT_MIN = 0.2
"""Least vertical part of the commanded thrust over the weight: below it the thrust's direction means nothing."""
LANDED_AFTER_S = 0.4
"""How long the ground must stop a commanded descent before the vehicle counts as landed."""
LANDED_LOAD = 0.02
"""Load on the landing gear, over the weight, from which it feels the ground."""
RATE_INTEGRAL_1_S = 4.0 / 3.0
"""Integral over proportional gain of the body rates (PX4's defaults MC_ROLLRATE_I 0.2 and MC_ROLLRATE_P 0.15): it holds
against moments such as that of rotors in an air flow, above the centre of mass."""
RATE_ERROR_MAX = 1.0
"""Rate error [rad/s] beyond which the integral grows no faster."""
RATE_INTEGRAL_MAX = 2.0
"""Largest integral of the rate error [rad/s]: PX4's MC_RR_INT_LIM 0.3 over MC_ROLLRATE_P 0.15. Where motors are full
and yaw has to give way, it would grow for as long as that lasts."""
DISTURBANCE_MAX_M_S2 = 2.0 * GRAVITY_M_S2
"""Largest disturbance that is believed, horizontal and vertical: twice what holds at a tilt of 45 degrees, because in a
strong wind the rotors also lose thrust, which the observer takes for a disturbance along their axes."""
LEVEL_SHARE_MIN = 0.3
"""Share of the full thrust that stays for going sideways when height needs all (PX4's MPC_THR_XY_MARG)."""
CATCH_UP = 0.2
"""Share of the commanded speed by which a vehicle that has fallen behind may exceed its largest speed."""
SETTLED_LIFT = 0.05
"""Thrust over the weight once the feet touch in a landing."""
LANDED_DESCENT_M_S = 0.2
"""Minimum commanded descent rate for landing detection."""
LANDED_SPEED_M_S, LANDED_SINK_M_S = 1.5, 0.25
"""Largest horizontal and vertical speed for landing detection (PX4's defaults LNDMC_XY_VEL_MAX and LNDMC_Z_VEL_MAX)."""


@pytree
class ControlMemory:
    """What the controller carries from call to call."""

    disturbance_m_s2: jax.Array  # [3] m/s^2, world: estimated acceleration by wind, payload and model error
    velocity_m_s: jax.Array  # [3] m/s, world: predicted from thrust, attitude and disturbance
    thrust_m_s2: jax.Array  # [] predicted thrust over the nominal mass; 0 with the motors off
    rate_integral_rad_s: jax.Array  # [3] rad/s, body: integral of the rate error by its gain
    stuck_s: jax.Array  # [] s for which the ground has stopped a commanded descent: landed from LANDED_AFTER_S on


def control_start(*, landed: bool = False) -> ControlMemory:
    """Memory of a controller that has not run yet; ``landed`` leaves the motors off until a climb is commanded."""
    return ControlMemory(
        disturbance_m_s2=jnp.zeros(3),
        velocity_m_s=jnp.zeros(3),
        thrust_m_s2=jnp.zeros(()),
        rate_integral_rad_s=jnp.zeros(3),
        stuck_s=jnp.asarray(LANDED_AFTER_S if landed else 0.0, jnp.float32),
    )


def is_landed(memory: ControlMemory) -> jax.Array:
    """Whether [] the controller holds the vehicle for landed and has switched the motors off."""
    return memory.stuck_s >= LANDED_AFTER_S


def control(
    params: MultirotorParams,
    memory: ControlMemory,
    state: MultirotorState,
    command: MultirotorCommand | PositionCommand,
    dt: float,
) -> tuple[jax.Array, ControlMemory]:
    """Rotor commands [R] rad/s that follow ``command``, and the controller's memory ``dt`` s later.

    Only ``params.control`` is read: the controller does not know the true mass. As on a real autopilot, a position
    command whose descent the ground stops is a landing: the rotors are disarmed (commands of zero) until a climb is
    commanded. Commands below the position level are obeyed without that.
    """
    autopilot, body = params.control, state.body
    touching = state.ground_force_n > LANDED_LOAD * GRAVITY_M_S2 * autopilot.mass_kg
    attitude = rotation_matrix(body.quaternion)
    memory = _observed(autopilot, memory, body, attitude, touching, dt)
    damping = autopilot.climb_damping_1_s * jnp.sum(attitude[:, 2] * body.velocity_m_s)
    acceleration, stuck = _acceleration(autopilot, memory, body, touching, damping, command, dt)
    pull = acceleration + jnp.array([0.0, 0.0, GRAVITY_M_S2], acceleration.dtype)
    pull_body = to_body(attitude, pull)
    rate = _body_rate(autopilot, attitude, pull_body, command.yaw_rad)
    thrust = autopilot.mass_kg * jnp.maximum(pull_body[2] + damping, 0.0)
    if isinstance(command, PositionCommand):
        integral = _rate_integral(memory, body, rate, touching, dt)
        speeds = _rotor_speeds_of(autopilot, body, attitude, rate, integral, thrust)
        speeds = jnp.where(stuck >= LANDED_AFTER_S, 0.0, speeds)
        given = _thrust_after(autopilot, memory, speeds, dt)
        return speeds, replace(memory, thrust_m_s2=given, rate_integral_rad_s=integral, stuck_s=stuck)
    at_position = command.level == POSITION
    wanted = jnp.where(command.level == ATTITUDE, _attitude_rate(autopilot, body, command), command.body_rate_rad_s)
    rate = jnp.where(at_position, rate, wanted)
    thrust = jnp.where(at_position, thrust, jnp.maximum(command.thrust_n, 0.0))
    integral = _rate_integral(memory, body, rate, touching, dt)
    speeds = _rotor_speeds_of(autopilot, body, attitude, rate, integral, thrust)
    speeds = jnp.where(at_position & (stuck >= LANDED_AFTER_S), 0.0, speeds)
    speeds = jnp.where(command.level <= BODY_RATE, speeds, command.rotor_speed_rad_s)
    stuck = jnp.where(at_position, stuck, memory.stuck_s)
    given = _thrust_after(autopilot, memory, speeds, dt)
    return speeds, replace(memory, thrust_m_s2=given, rate_integral_rad_s=integral, stuck_s=stuck)


def _rate_integral(
    memory: ControlMemory, body: RigidState, rate: jax.Array, touching: jax.Array, dt: float
) -> jax.Array:
    """Integral [3] rad/s of the rate error over time, which starts anew on the ground."""
    error = rate - body.angular_velocity_rad_s
    grown = memory.rate_integral_rad_s + dt * RATE_INTEGRAL_1_S * jnp.clip(error, -RATE_ERROR_MAX, RATE_ERROR_MAX)
    grown = jnp.clip(grown, -RATE_INTEGRAL_MAX, RATE_INTEGRAL_MAX)
    return jnp.where(touching | (memory.thrust_m_s2 <= 0.0), 0.0, grown)


def _thrust_after(autopilot: ControlParams, memory: ControlMemory, speed_rad_s: jax.Array, dt: float) -> jax.Array:
    """Predicted thrust [] over the nominal mass (m/s^2) after ``dt`` s of the rotor commands [R]."""
    held = jnp.clip(speed_rad_s, 0.0, autopilot.speed_max_rad_s)
    wanted = autopilot.thrust_coefficient_n_s2 * jnp.sum(held * held) / autopilot.mass_kg
    late = jnp.where((memory.thrust_m_s2 > 0.0) & (wanted > 0.0), jnp.exp(-dt / autopilot.rotor_time_constant_s), 0.0)
    return wanted + late * (memory.thrust_m_s2 - wanted)


def _observed(
    autopilot: ControlParams,
    memory: ControlMemory,
    body: RigidState,
    attitude: jax.Array,
    touching: jax.Array,
    dt: float,
) -> ControlMemory:
    """The memory with disturbance and velocity of now.

    An observer of the velocity with both poles at the root of ``velocity_integral_1_s2``. Its prediction takes the
    attitude as it is and the thrust that the motors can give, less what the inflow of a climb and the rotors' drag take
    of it, so that neither a step nor a limit winds it up, as they do an integral of the control error. On the ground
    and with the motors off it waits.
    """
    along = memory.thrust_m_s2 - autopilot.climb_damping_1_s * jnp.sum(attitude[:, 2] * body.velocity_m_s)
    predicted = memory.velocity_m_s + dt * (along * attitude[:, 2] + memory.disturbance_m_s2)
    predicted = predicted - jnp.array([0.0, 0.0, dt * GRAVITY_M_S2], predicted.dtype)
    predicted = predicted - dt * _rotor_drag(autopilot, body)
    waits = touching | (memory.thrust_m_s2 <= 0.0)
    error = jnp.where(waits, 0.0, body.velocity_m_s - predicted)
    gain = autopilot.velocity_integral_1_s2
    found = memory.disturbance_m_s2 + dt * gain * error
    return replace(
        memory,
        disturbance_m_s2=_limited(found, (DISTURBANCE_MAX_M_S2, DISTURBANCE_MAX_M_S2)),
        velocity_m_s=jnp.where(waits, body.velocity_m_s, predicted + 2.0 * dt * jnp.sqrt(gain) * error),
    )


def _rotor_drag(autopilot: ControlParams, body: RigidState) -> jax.Array:
    """Deceleration [3] m/s^2 (world) by the drag of the rotors, as in still air and level flight.

    Left to the observer, it would push a vehicle on after it has stopped.
    """
    east, north = autopilot.drag_1_s * body.velocity_m_s[0], autopilot.drag_1_s * body.velocity_m_s[1]
    return jnp.stack([east, north, jnp.zeros_like(east)])


def _rotor_speeds_of(
    autopilot: ControlParams,
    body: RigidState,
    attitude: jax.Array,
    rate: jax.Array,
    integral: jax.Array,
    thrust: jax.Array,
) -> jax.Array:
    """Rotor speeds [R] rad/s for body rates [3] rad/s and a collective thrust [] N.

    The moment of the air on the rotors is fed forward as in still air: a small vehicle with slow motors, whose
    attitude control is weak, would swing over its place. What the wind adds is left to the integral. Beyond the
    vehicle's own largest speed it is the wind that moves it, whose air does not meet the rotors.
    """
    w, inertia, axes = body.angular_velocity_rad_s, autopilot.inertia_kg_m2, autopilot.principal_axes
    turn = times_inertia(inertia, axes, autopilot.rate_gain_1_s * (rate - w + integral))
    forward, left = (jnp.sum(attitude[:, axis] * body.velocity_m_s) for axis in (0, 1))
    share = jnp.minimum(1.0, autopilot.speed_max_m_s * jax.lax.rsqrt(forward * forward + left * left + 1e-12))
    forward, left = share * forward, share * left
    drag, rolling = autopilot.drag_moment_ns, autopilot.rolling_moment_ns
    air = jnp.stack([rolling * forward - drag * left, drag * forward + rolling * left, jnp.zeros_like(forward)])
    torque = turn + jnp.cross(w, times_inertia(inertia, axes, w)) + air
    return rotor_commands(autopilot, thrust, torque)


def _attitude_rate(autopilot: ControlParams, body: RigidState, command: MultirotorCommand) -> jax.Array:
    """Body rate [3] rad/s towards the commanded attitude: twice the error quaternion's vector part, by the gains."""
    error = multiply(conjugate(body.quaternion), command.quaternion)
    vector = 2.0 * jnp.where(error[0] < 0.0, -1.0, 1.0) * error[1:]
    limit = autopilot.yaw_rate_max_rad_s
    turn = jnp.clip(autopilot.yaw_gain_1_s * vector[2], -limit, limit)
    return jnp.stack([autopilot.attitude_gain_1_s * vector[0], autopilot.attitude_gain_1_s * vector[1], turn])


def rotor_commands(autopilot: ControlParams, thrust_n: jax.Array, torque_nm: jax.Array) -> jax.Array:
    """Rotor speeds [R] rad/s that give thrust [] N and torque [3] N m (body) as far as the motors can.

    What they cannot is given up in this order: yaw torque, then thrust, then roll and pitch torque.
    """
    lowest = autopilot.thrust_coefficient_n_s2 * autopilot.speed_min_rad_s**2
    highest = autopilot.thrust_coefficient_n_s2 * autopilot.speed_max_rad_s**2
    mix = autopilot.allocation
    tilting = mix[:, 1] * torque_nm[0] + mix[:, 2] * torque_nm[1]
    lifting = mix[:, 0] * thrust_n
    turning = mix[:, 3] * torque_nm[2]
    level = lifting + tilting
    # Move the collective thrust so that roll and pitch fit; if they are too large for that, keep the middle.
    room_above, room_below = highest - jnp.max(level), jnp.min(level) - lowest
    shift = jnp.where(
        room_above + room_below < 0.0,
        0.5 * (room_above - room_below),
        jnp.minimum(room_above, 0.0) + jnp.maximum(-room_below, 0.0),
    )
    level = jnp.clip(level + shift, lowest, highest)
    room = jnp.where(turning > 0.0, highest - level, level - lowest)
    share = jnp.minimum(1.0, jnp.min(room / jnp.maximum(jnp.abs(turning), 1e-6)))
    return jnp.sqrt((level + share * turning) / autopilot.thrust_coefficient_n_s2)


def _acceleration(
    autopilot: ControlParams,
    memory: ControlMemory,
    body: RigidState,
    touching: jax.Array,
    damping_m_s2: jax.Array,
    setpoint: MultirotorCommand | PositionCommand,
    dt: float,
) -> tuple[jax.Array, jax.Array]:
    """Wanted acceleration [3] m/s^2 (world) within the limits, and how long [] s the ground has stopped a descent.

    Height comes before place, as in PX4: going sideways has what the tilt and, of the full thrust, lifting leaves.
    """
    offset = setpoint.position_m - body.position_m
    approach = setpoint.hold_position * _approach(autopilot, offset)
    fed = setpoint.velocity_m_s
    # Without room above the commanded velocity, what a vehicle has once fallen behind it never makes good.
    fastest, climb = autopilot.speed_max_m_s, autopilot.climb_rate_max_m_s
    fastest += CATCH_UP * jnp.minimum(jnp.sqrt(fed[0] * fed[0] + fed[1] * fed[1] + 1e-12), fastest)
    velocity = _limited(fed + approach, (fastest, climb + CATCH_UP * jnp.minimum(jnp.abs(fed[2]), climb)))
    reach = autopilot.acceleration_max_m_s2
    feedback = setpoint.acceleration_m_s2 + autopilot.velocity_gain_1_s * (velocity - body.velocity_m_s)
    wanted = _limited(feedback, (reach, reach)) - memory.disturbance_m_s2 + _rotor_drag(autopilot, body)
    lift = jnp.maximum(wanted[2], (LIFT_MIN - 1.0) * GRAVITY_M_S2)
    # Feet on the ground in a landing: upright, and the weight on them, or the wind would tip it over (as PX4 does).
    settles = (touching | (memory.stuck_s > 0.0)) & (velocity[2] < -LANDED_DESCENT_M_S)
    lift = jnp.where(settles, (SETTLED_LIFT - 1.0) * GRAVITY_M_S2, lift)
    sideways = _sideways(autopilot, GRAVITY_M_S2 + lift, damping_m_s2)
    level = _limited(wanted, (jnp.where(settles, 0.0, sideways), reach))
    east, north = body.velocity_m_s[0] - fed[0], body.velocity_m_s[1] - fed[1]  # over what it is to land on
    still = touching & (east * east + north * north < LANDED_SPEED_M_S**2)
    still &= jnp.abs(body.velocity_m_s[2]) < LANDED_SINK_M_S
    given = jnp.stack([level[0], level[1], lift])
    return given, _stuck(memory.stuck_s, velocity[2], still, dt)


def _sideways(autopilot: ControlParams, up_m_s2: jax.Array, damping_m_s2: jax.Array) -> jax.Array:
    """Largest horizontal part [] m/s^2 of a thrust over the mass whose vertical part is ``up_m_s2`` [].

    ``damping_m_s2`` [] is what the thrust makes up for besides.
    """
    rotors, speed = autopilot.allocation.shape[0], autopilot.speed_max_rad_s
    full = rotors * autopilot.thrust_coefficient_n_s2 * speed * speed / autopilot.mass_kg
    full = jnp.maximum(full - damping_m_s2, GRAVITY_M_S2)
    left = jnp.maximum(full * full - up_m_s2 * up_m_s2, (LEVEL_SHARE_MIN * full) ** 2)
    return jnp.minimum(autopilot.tilt_max_tan * up_m_s2, jnp.sqrt(left))


def _approach(autopilot: ControlParams, offset: jax.Array) -> jax.Array:
    """Velocity [3] m/s towards a place at an ``offset`` [3] m: proportional near it, and farther away what the vehicle
    can brake from, by half its largest acceleration (the square root controller of ArduPilot's AC_PosControl).
    """
    gain, brake = autopilot.position_gain_1_s, 0.5 * autopilot.acceleration_max_m_s2
    distance = jnp.sqrt(offset[0] * offset[0] + offset[1] * offset[1] + 1e-12)
    linear = brake / (gain * gain)
    far = jnp.sqrt(2.0 * brake * jnp.maximum(distance - 0.5 * linear, 0.5 * linear)) / jnp.maximum(distance, linear)
    level = jnp.where(distance > linear, far, gain)
    return jnp.stack([level * offset[0], level * offset[1], gain * offset[2]])


def _stuck(stuck_s: jax.Array, climb_m_s: jax.Array, still: jax.Array, dt: float) -> jax.Array:
    """Time [] s for which the vehicle has stood ``still`` on the ground although ``climb_m_s`` [] commands a descent.

    It runs back while the vehicle moves, hopping in a gust, unless it has landed already; a commanded climb clears it.
    """
    longer = jnp.where(still, stuck_s + dt, jnp.maximum(stuck_s - dt, 0.0))
    longer = jnp.where(climb_m_s < -LANDED_DESCENT_M_S, longer, 0.0)
    kept = jnp.where(stuck_s >= LANDED_AFTER_S, stuck_s, longer)
    return jnp.where(climb_m_s > LANDED_DESCENT_M_S, 0.0, kept)


def _limited(v: jax.Array, limits: tuple[jax.Array | float, jax.Array | float]) -> jax.Array:
    """Vector ``v`` [3] with its horizontal length and its height held to the two ``limits``."""
    length = jnp.sqrt(v[0] * v[0] + v[1] * v[1] + 1e-12)
    share = jnp.minimum(1.0, limits[0] / length)
    return jnp.stack([share * v[0], share * v[1], jnp.clip(v[2], -limits[1], limits[1])])


def _body_rate(autopilot: ControlParams, attitude: jax.Array, pull_body: jax.Array, yaw_rad: jax.Array) -> jax.Array:
    """Wanted body rate [3] rad/s that turns body z onto the wanted thrust, and the heading onto ``yaw_rad``."""
    direction = pull_body * jax.lax.rsqrt(jnp.sum(pull_body * pull_body) + 1e-12)
    # 2 sin(angle / 2) about the axis z x direction: proportional for small angles, still growing when upside down.
    reach = autopilot.attitude_gain_1_s * jax.lax.rsqrt(jnp.maximum(0.5 * (1.0 + direction[2]), 1e-4))
    forward_x, forward_y = attitude[0, 0], attitude[1, 0]
    cosine, sine = jnp.cos(yaw_rad), jnp.sin(yaw_rad)
    heading_error = jnp.arctan2(forward_x * sine - forward_y * cosine, forward_x * cosine + forward_y * sine + 1e-9)
    turn = jnp.clip(autopilot.yaw_gain_1_s * heading_error, -autopilot.yaw_rate_max_rad_s, autopilot.yaw_rate_max_rad_s)
    about_vertical = turn * attitude[2]  # the world's vertical in the body frame
    return jnp.stack(
        [about_vertical[0] - reach * direction[1], about_vertical[1] + reach * direction[0], about_vertical[2]]
    )
