"""Model of a skid-steer rover that follows the terrain, without a contact solver, for the largest sweeps.

The rover moves in the plane through the ground below its four wheels. Each tyre has Coulomb friction against its slip
along and across the wheel, under its share of the weight on the slope. Friction is implicit with a coefficient from the
slip before (lagged diffusivity: Vogel and Oman, SIAM J. Sci. Comput. 17(1), 1996): one linear equation in the three
velocities, solved by hand, and stable for any step.

Limits. It has no motion normal to the ground: no suspension, no bouncing, and no wheel leaves the ground. Weight shifts
between the wheels with the slope, not with acceleration. Where that does not hold the rover is laid on its side, where
it stays, and the world records a crash: when gravity tips it over its wheels, and when a wheel drives off a step higher
than ``step_max_m``. A face higher than ``step_max_m`` stops the wheels; a lower one is rolled over.
"""

import dataclasses

import jax
import jax.numpy as jnp

from swarmsim.physics import wheels
from swarmsim.physics.rotations import multiply, rotation_matrix, to_body, to_world, yaw_of
from swarmsim.physics.step_contact import step_under
from swarmsim.physics.walls import OutlineContacts, near_walls, stopped_by
from swarmsim.site import Site
from swarmsim.site.steps import StepAt
from swarmsim.vehicles.skid_steer import SkidSteerParams, tyre_creep, tyre_sinkage, wheel_spacing
from swarmsim.vehicles.state import RigidState, SkidSteerState

ITERATIONS = 2  # of the friction coefficients in each step
LYING_COSINE = 0.5  # tilted by more than 60 degrees: it lies, and stays
FALLEN_M = 0.03  # a wheel this far within a face came from above


def analytic_step(
    dt: float, params: SkidSteerParams, state: SkidSteerState, command_rad_s: jax.Array, site: Site
) -> SkidSteerState:
    """One step of ``dt`` seconds; same signature and state as the ``mjx`` engine."""
    body = state.body
    rotation = rotation_matrix(body.quaternion)
    torque = wheels.motor_torque(params, state, command_rad_s, dt)
    weight = -params.mass_kg * params.gravity_m_s2 * rotation[2]
    load = _loads(params, weight)
    forward, side, _ = to_body(rotation, body.velocity_m_s)
    motion, wheel_speed = _slide(
        dt,
        params,
        jnp.stack([forward, side, body.angular_velocity_rad_s[2]]),
        state.wheel_speed_rad_s,
        torque,
        weight,
        load,
    )
    velocity = to_world(rotation, jnp.append(motion[:2], 0.0))
    upright = jnp.maximum(rotation[2, 2], 0.1)
    yaw_rate = motion[2] * upright
    hub = body.position_m + to_world(rotation, params.wheel_position_m)
    obstacles = near_walls(params, body, rotation, site)
    if site.steps is not None:
        obstacles = _with_faces(obstacles, params, rotation, hub - body.position_m, step_under(site, hub[:, :2]))
    held, yaw_rate = stopped_by(obstacles, params, velocity[:2], yaw_rate, dt)
    position, quaternion, fell = _stand(
        params, site, body.position_m[:2] + dt * held, yaw_of(body.quaternion) + dt * yaw_rate
    )
    turned = rotation_matrix(quaternion)
    forward, side, _ = to_body(rotation, jnp.append(held, velocity[2]))
    moved = RigidState(
        position_m=position,
        quaternion=quaternion,
        velocity_m_s=to_world(turned, jnp.stack([forward, side, jnp.zeros(())])),
        angular_velocity_rad_s=yaw_rate / upright * jnp.array([0.0, 0.0, 1.0]),
    )
    return SkidSteerState(
        body=_laid_down(moved, body, rotation, fell | _tips(params, weight)),
        wheel_angle_rad=state.wheel_angle_rad + dt * wheel_speed,
        wheel_speed_rad_s=wheel_speed,
        wheel_torque_nm=torque,
        energy_j=wheels.energy_used(params, state, torque, dt),
    )


def _height(params: SkidSteerParams) -> jax.Array:
    """Height [] (m) of the centre of mass above the ground under it."""
    return params.wheel_radius_m - tyre_sinkage(params) - jnp.mean(params.wheel_position_m[:, 2])


def _loads(params: SkidSteerParams, weight: jax.Array) -> jax.Array:
    """Load [4] (N) of each wheel under the ``weight`` [3] (N, body), with the moment of its part along the ground."""
    base, track = wheel_spacing(params.wheel_position_m)
    place = params.wheel_position_m[:, :2]
    middle = jnp.mean(place, axis=0)
    lean = (_height(params) * weight[:2] + weight[2] * middle) * 4.0 / jnp.stack([base * base, track * track])
    share = -weight[2] + jnp.sum((place - middle) * lean, axis=-1)
    return 0.25 * jnp.maximum(share, 0.0)


def _slide(
    dt: float,
    params: SkidSteerParams,
    motion: jax.Array,
    wheel_speed: jax.Array,
    torque: jax.Array,
    weight: jax.Array,
    load: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Velocity ahead, to the left (m/s) and yaw rate (rad/s) [3], and wheel speeds [4] (rad/s), after the step.

    ``weight`` [3] (N, body) and ``load`` [4] (N) of each wheel. A wheel that turns freely gives way along its rolling
    direction: its inertia is in series with the friction there.
    """
    radius = params.wheel_radius_m - 0.5 * tyre_sinkage(params)  # as in MuJoCo, contact is halfway into the tyre
    inertia = params.wheel_inertia_kg_m2 + params.rotor_inertia_kg_m2
    x, y = params.wheel_position_m[:, 0], params.wheel_position_m[:, 1]
    free = wheel_speed + dt * (torque + wheels.rolling_torque(params, wheel_speed)) / inertia
    creep = tyre_creep(params)
    mass, yaw_inertia = params.mass_kg, params.inertia_kg_m2[2, 2]
    start_x, start_y = mass * motion[0] + dt * weight[0], mass * motion[1] + dt * weight[1]
    after, speed = motion, wheel_speed
    for _ in range(ITERATIONS):
        slip_x = after[0] - after[2] * y - radius * speed
        slip_y = after[1] + after[2] * x
        slip = jnp.sqrt(slip_x * slip_x + slip_y * slip_y + 1e-12)
        across = dt * params.friction * load / jnp.maximum(slip, creep)
        along = across * inertia / (inertia + radius * radius * across)
        drive = along * radius * free
        a, b = mass + jnp.sum(along), mass + jnp.sum(across)
        p, q = -jnp.sum(along * y), jnp.sum(across * x)
        w = yaw_inertia + jnp.sum(along * y * y + across * x * x)
        right_x = start_x + jnp.sum(drive)
        right_w = yaw_inertia * motion[2] - jnp.sum(drive * y)
        turn = (right_w - p * right_x / a - q * start_y / b) / (w - p * p / a - q * q / b)
        ahead = (right_x - p * turn) / a
        after = jnp.stack([ahead, (start_y - q * turn) / b, turn])
        speed = free + radius * along * (ahead - turn * y - radius * free) / inertia
    # The slip may have grown beyond that of its coefficient: the force stays in the cone of friction.
    pull, push = along * (after[0] - after[2] * y - radius * free), across * (after[1] + after[2] * x)
    most = dt * params.friction * load
    inside = jnp.minimum(1.0, most * jax.lax.rsqrt(pull * pull + push * push + 1e-12))
    pull, push = inside * pull, inside * push
    change = jnp.stack([-jnp.sum(pull), -jnp.sum(push)])
    turn = motion[2] + jnp.sum(y * pull - x * push) / yaw_inertia
    return jnp.append((jnp.stack([start_x, start_y]) + change) / mass, turn), free + radius * pull / inertia


def _with_faces(
    walls: OutlineContacts, params: SkidSteerParams, rotation: jax.Array, arm: jax.Array, step: StepAt
) -> OutlineContacts:
    """``walls`` and the faces that are too high for the wheels at ``arm`` [4, 3] (world) from the centre of mass."""
    blocks = (step.rise_m > params.step_max_m) & (step.beyond_m < 0.0)
    return OutlineContacts(
        clearance_m=jnp.concatenate([walls.clearance_m, jnp.where(blocks, _before_face(params, step), 1e3)]),
        outward=jnp.concatenate([walls.outward, -step.to_high]),
        arm_m=jnp.concatenate([walls.arm_m, arm[:, :2]]),
    )


def _before_face(params: SkidSteerParams, step: StepAt) -> jax.Array:
    """Distance [4] (m) that each wheel may still go before it touches the edge of its step."""
    over = jnp.maximum(params.wheel_radius_m - step.rise_m, 0.0)
    reach = jnp.sqrt(jnp.maximum(params.wheel_radius_m**2 - over * over, 1e-8))
    return -step.beyond_m - reach


def _stand(
    params: SkidSteerParams, site: Site, xy: jax.Array, yaw: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Position [3] and quaternion [4] over ``xy`` [2] on the plane of the ground below the wheels, and if one fell.

    At an edge that the wheels can roll over, each stands on the higher of the low level and the edge.
    """
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    x, y = params.wheel_position_m[:, 0], params.wheel_position_m[:, 1]
    step = step_under(site, xy + jnp.stack([c * x - s * y, s * x + c * y], axis=-1))
    height, fell = step.low_m, jnp.array(False)
    if site.steps is not None:
        on_top = (step.beyond_m > 0.0) & (step.rise_m > 0.0)
        before = jnp.minimum(-step.beyond_m, params.wheel_radius_m)
        rolled = step.rise_m - params.wheel_radius_m + jnp.sqrt(params.wheel_radius_m**2 - before**2 + 1e-8)
        low = (step.rise_m > 0.0) & (step.rise_m <= params.step_max_m) & ~on_top
        height = height + jnp.where(on_top, step.rise_m, jnp.where(low, jnp.maximum(rolled, 0.0), 0.0))
        inside = (step.beyond_m < 0.0) & (_before_face(params, step) < -FALLEN_M)
        fell = jnp.any(inside & (step.rise_m > params.step_max_m))
    base, track = wheel_spacing(params.wheel_position_m)
    climb = 0.5 * jnp.sum(height * jnp.array([1.0, 1.0, -1.0, -1.0])) / base
    bank = 0.5 * jnp.sum(height * jnp.array([1.0, -1.0, 1.0, -1.0])) / track
    ground = jnp.mean(height) - climb * jnp.mean(x) - bank * jnp.mean(y)
    position = jnp.append(xy, ground + _height(params) * jnp.sqrt(1.0 + climb**2 + bank**2))
    return position, wheels.attitude(climb, bank, yaw), fell


def _tips(params: SkidSteerParams, weight: jax.Array) -> jax.Array:
    """Whether [] the ``weight`` [3] (N, body) tips the rover over its wheels, which hold it by friction at most."""
    base, track = wheel_spacing(params.wheel_position_m)
    down = -weight[2]
    held = jnp.minimum(jnp.abs(weight[:2]), jnp.mean(params.friction) * down)
    reach = 0.5 * jnp.stack([base, track]) - jnp.abs(jnp.mean(params.wheel_position_m[:, :2], axis=0))
    return jnp.any(_height(params) * held > down * reach) | (down <= 0.0)


def _laid_down(moved: RigidState, before: RigidState, rotation: jax.Array, tips: jax.Array) -> RigidState:
    """``moved``, or at rest on its lower side where it ``tips`` [], or as it was ``before`` where it lies already.

    ``rotation`` [3, 3] is that before, body to world.
    """
    lies = rotation[2, 2] < LYING_COSINE
    half = jnp.sqrt(0.5)
    roll = jnp.where(rotation[2, 1] > 0.0, half, -half)  # towards the right where the left side is higher
    on_side = multiply(before.quaternion, jnp.stack([half, roll, 0.0 * half, 0.0 * half]))
    quaternion = jnp.where(lies, before.quaternion, jnp.where(tips, on_side, moved.quaternion))
    still = lies | tips
    return dataclasses.replace(
        moved,
        position_m=jnp.where(still, before.position_m, moved.position_m),
        quaternion=quaternion,
        velocity_m_s=jnp.where(still, 0.0, moved.velocity_m_s),
        angular_velocity_rad_s=jnp.where(still, 0.0, moved.angular_velocity_rad_s),
    )
