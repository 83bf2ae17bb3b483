"""Cascaded control of a multirotor: position, velocity, attitude, body rate, rotor thrusts.

A command may enter at any of the four levels of `swarmsim.control.commands`. The structure is that of PX4 and of
Brescianini and D'Andrea, "Tilt-prioritized quadrocopter attitude control", IEEE
Transactions on Control Systems Technology 28(2), 2020: the tilt, which carries the thrust, comes before the yaw.
World ENU, body FLU, SI units; one vehicle. Run it every 10 ms.
"""

import jax
import jax.numpy as jnp

from swarmsim.control.commands import ATTITUDE, BODY_RATE, POSITION, MultirotorCommand, PositionCommand
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
SOFT_M_S2 = 0.2
"""Acceleration beyond a limit at which the integral grows half as fast."""
LANDED_DESCENT_M_S = 0.2
"""Minimum commanded descent rate for landing detection."""
LANDED_SPEED_M_S = 0.15
"""Maximum speed for landing detection."""


@pytree
class ControlMemory:
    """What the controller carries from call to call."""

    integral_m_s2: jax.Array  # [3] m/s^2, world: acceleration that holds against wind, payload and model error
    stuck_s: jax.Array  # [] s for which the ground has stopped a commanded descent: landed from LANDED_AFTER_S on


def control_start(*, landed: bool = False) -> ControlMemory:
    """Memory of a controller that has not run yet; ``landed`` leaves the motors off until a climb is commanded."""
    return ControlMemory(
        integral_m_s2=jnp.zeros(3), stuck_s=jnp.asarray(LANDED_AFTER_S if landed else 0.0, jnp.float32)
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
    commanded. Commands below the position level are obeyed without that, and leave the integral as it is.
    """
    autopilot, body = params.control, state.body
    touching = state.ground_force_n > LANDED_LOAD * GRAVITY_M_S2 * autopilot.mass_kg
    acceleration, after = _acceleration(autopilot, memory, body, touching, command, dt)
    pull = acceleration + jnp.array([0.0, 0.0, GRAVITY_M_S2], acceleration.dtype)
    attitude = rotation_matrix(body.quaternion)
    pull_body = to_body(attitude, pull)
    rate = _body_rate(autopilot, attitude, pull_body, command.yaw_rad)
    thrust = autopilot.mass_kg * jnp.maximum(pull_body[2], 0.0)
    if isinstance(command, PositionCommand):
        speeds = _rotor_speeds_of(autopilot, body, rate, thrust)
        return jnp.where(is_landed(after), 0.0, speeds), after
    at_position = command.level == POSITION
    wanted = jnp.where(command.level == ATTITUDE, _attitude_rate(autopilot, body, command), command.body_rate_rad_s)
    rate = jnp.where(at_position, rate, wanted)
    thrust = jnp.where(at_position, thrust, jnp.maximum(command.thrust_n, 0.0))
    speeds = _rotor_speeds_of(autopilot, body, rate, thrust)
    speeds = jnp.where(at_position & is_landed(after), 0.0, speeds)
    memory = jax.tree.map(lambda new, old: jnp.where(at_position, new, old), after, memory)
    return jnp.where(command.level <= BODY_RATE, speeds, command.rotor_speed_rad_s), memory


def _rotor_speeds_of(autopilot: ControlParams, body: RigidState, rate: jax.Array, thrust: jax.Array) -> jax.Array:
    """Rotor speeds [R] rad/s for body rates [3] rad/s and a collective thrust [] N."""
    w, inertia = body.angular_velocity_rad_s, autopilot.inertia_kg_m2
    torque = inertia * autopilot.rate_gain_1_s * (rate - w) + jnp.cross(w, inertia * w)
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
    setpoint: MultirotorCommand | PositionCommand,
    dt: float,
) -> tuple[jax.Array, ControlMemory]:
    """Wanted acceleration [3] m/s^2 (world) within the limits; the integral stands still where it would wind up."""
    offset = setpoint.position_m - body.position_m
    approach = autopilot.position_gain_1_s * setpoint.hold_position * offset
    limits = jnp.stack([autopilot.speed_max_m_s, autopilot.climb_rate_max_m_s])
    velocity = _limited(setpoint.velocity_m_s + approach, limits)
    error = velocity - body.velocity_m_s
    reach = autopilot.acceleration_max_m_s2
    feedback = setpoint.acceleration_m_s2 + autopilot.velocity_gain_1_s * error
    wanted = _limited(feedback, jnp.stack([reach, reach])) + memory.integral_m_s2
    lowest = (LIFT_MIN - 1.0) * GRAVITY_M_S2
    lift = jnp.maximum(wanted[2], lowest)
    level = _limited(wanted, jnp.stack([autopilot.tilt_max_tan * (GRAVITY_M_S2 + lift), reach]))
    given = jnp.stack([level[0], level[1], lift])
    # The integral stands still where it would grow and a limit cuts already: that of the feedback too, or a vehicle far
    # from its reference turns its integral with it and circles for ever. The passage is smooth, for the derivatives.
    sign = jnp.sign(error)
    excess = jnp.maximum((feedback + memory.integral_m_s2 - given) * sign, 0.0) / SOFT_M_S2
    free = 1.0 / (1.0 + excess * excess)
    unwinding = jnp.clip(-memory.integral_m_s2 * sign / SOFT_M_S2, 0.0, 1.0)
    growth = (free + (1.0 - free) * unwinding) * error
    integral = memory.integral_m_s2 + autopilot.velocity_integral_1_s2 * dt * growth
    bounds = jnp.stack([autopilot.tilt_max_tan * GRAVITY_M_S2, reach])
    still = touching & (jnp.sum(body.velocity_m_s * body.velocity_m_s) < LANDED_SPEED_M_S**2)
    return given, ControlMemory(
        integral_m_s2=_limited(integral, bounds), stuck_s=_stuck(memory.stuck_s, velocity[2], still, dt)
    )


def _stuck(stuck_s: jax.Array, climb_m_s: jax.Array, still: jax.Array, dt: float) -> jax.Array:
    """Time [] s for which the vehicle has stood ``still`` on the ground although ``climb_m_s`` [] commands a descent.

    It starts again when the vehicle moves, unless it has landed already; a commanded climb clears it.
    """
    longer = jnp.where((climb_m_s < -LANDED_DESCENT_M_S) & still, stuck_s + dt, 0.0)
    kept = jnp.where(stuck_s >= LANDED_AFTER_S, stuck_s, longer)
    return jnp.where(climb_m_s > LANDED_DESCENT_M_S, 0.0, kept)


def _limited(v: jax.Array, limits: jax.Array) -> jax.Array:
    """Vector ``v`` [3] with its horizontal length and its height held to ``limits`` [2]."""
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
