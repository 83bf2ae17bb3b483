"""Walls: a rover's outline never enters them, whatever its speed.

A wall is where ``site.clearance_m`` is negative. Contact is inelastic, without friction, and acts at the height of the
centre of mass: after the forces of a step, impulses on the outline take off the speed that would carry a contact point
into the wall within the step. They are found by projected Jacobi iterations in which the contacts share the mass
(Tonge, Benevolenski and Voroshilov, "Mass splitting for jitter-free parallel rigid body simulation", ACM Trans. Graph.
31(4), 2012).
"""

import jax
import jax.numpy as jnp

from swarmsim.physics.rotations import rotation_matrix
from swarmsim.pytree import pytree
from swarmsim.site import Site, sample_with_gradient
from swarmsim.vehicles.skid_steer import SkidSteerParams
from swarmsim.vehicles.state import RigidState, SkidSteerState

SWEEPS = 8
PIECES = 2  # of each side, so that one between the ends of two fences touches both
PROBES = 2  # for the nearest point of a piece
NOT_NEAR_M = 1e3  # clearance of a piece whose nearest point is one of its ends
STEEPNESS_MIN = 0.3  # of the interpolated clearance, which is 1 but for the raster
REACH_M_S = 0.5  # contacts that need more change of speed than this to be touched do not share the impulses
RECOVERY = 0.2  # share of a penetration that one step takes back
RECOVERY_MAX_M_S = 0.2
_ROUND = (0, 1, 3, 2)  # front left, front right, rear right, rear left: the corners in their order round the outline


@pytree
class OutlineContacts:
    """Points of the outline that can touch a wall: the ends of the pieces of its sides, the nearest point of each."""

    clearance_m: jax.Array  # [C] distance to the wall along its normal, < 0 in the wall; C = 8 PIECES
    outward: jax.Array  # [C, 2] unit, world: out of the wall
    arm_m: jax.Array  # [C, 2] world, from the centre of mass


def near_walls(params: SkidSteerParams, body: RigidState, rotation: jax.Array, site: Site) -> OutlineContacts:
    """Contacts of the outline; ``rotation`` [3, 3]: body to world.

    The clearance along a piece of a side is convex where the wall is, so its least value is sought where tangents meet
    (cutting planes). Where the convex corner of a wall touches a side, the direction of contact is that side's normal.
    """
    corner = jnp.sum(rotation[:2, :2] * params.corner_m[:, None, :], axis=-1)[jnp.array(_ROUND)]
    side = jnp.repeat((jnp.roll(corner, -1, axis=0) - corner) / PIECES, PIECES, axis=0)
    ends = jnp.repeat(corner, PIECES, axis=0) + (jnp.arange(4 * PIECES) % PIECES)[:, None] * side
    clearance, gradient = sample_with_gradient(site.clearance_m, site, body.position_m[:2] + ends)
    slope = jnp.sum(gradient * side, axis=-1), jnp.sum(jnp.roll(gradient, -1, axis=0) * side, axis=-1)
    low, high = jnp.zeros(len(ends)), jnp.ones(len(ends))
    value = clearance, jnp.roll(clearance, -1)
    within = (slope[0] < 0.0) & (slope[1] > 0.0)
    for _ in range(PROBES):
        place = _where_tangents_meet(low, high, value, slope)
        arm = ends + jax.lax.stop_gradient(place)[:, None] * side
        between, normal = sample_with_gradient(site.clearance_m, site, body.position_m[:2] + arm)
        along = jnp.sum(normal * side, axis=-1)
        falls = along < 0.0  # the least value lies beyond
        low, high = jnp.where(falls, place, low), jnp.where(falls, high, place)
        value = jnp.where(falls, between, value[0]), jnp.where(falls, value[1], between)
        slope = jnp.where(falls, along, slope[0]), jnp.where(falls, slope[1], along)
    normal = jnp.concatenate([gradient, jnp.stack([side[:, 1], -side[:, 0]], axis=-1)])
    steepness = jnp.maximum(jnp.sqrt(jnp.sum(gradient * gradient, axis=-1) + 1e-12), STEEPNESS_MIN)
    return OutlineContacts(
        clearance_m=jnp.concatenate([clearance / steepness, jnp.where(within, between, NOT_NEAR_M)]),
        outward=normal * jax.lax.rsqrt(jnp.sum(normal * normal, axis=-1, keepdims=True) + 1e-12),
        arm_m=jnp.concatenate([ends, arm]),
    )


def _where_tangents_meet(
    low: jax.Array, high: jax.Array, value: tuple[jax.Array, jax.Array], slope: tuple[jax.Array, jax.Array]
) -> jax.Array:
    """Place [P] between ``low`` and ``high`` [P] where the tangents at both meet; the middle if they do not."""
    bend = slope[1] - slope[0]
    convex = bend > 1e-3
    meet = (slope[1] * high - slope[0] * low - value[1] + value[0]) / jnp.where(convex, bend, 1.0)
    return jnp.where(convex, jnp.clip(meet, low, high), 0.5 * (low + high))


def stopped_by(
    walls: OutlineContacts, params: SkidSteerParams, velocity: jax.Array, yaw_rate: jax.Array, dt: float
) -> tuple[jax.Array, jax.Array]:
    """Velocity [2] (m/s, world) and yaw rate [] (rad/s, about the vertical) that enter no wall within ``dt`` seconds.

    Each impulse pushes only. A point that is in a wall already comes out slowly, without gaining more speed than that.
    """
    inverse_mass, inverse_inertia = 1.0 / params.mass_kg, 1.0 / params.inertia_kg_m2[2, 2]
    slowest = jnp.where(
        walls.clearance_m > 0.0,
        -walls.clearance_m / dt,
        jnp.minimum(-walls.clearance_m * RECOVERY / dt, RECOVERY_MAX_M_S),
    )
    lever = walls.arm_m[:, 0] * walls.outward[:, 1] - walls.arm_m[:, 1] * walls.outward[:, 0]
    rows = jnp.concatenate([walls.outward, lever[:, None]], axis=-1)
    inverse = jnp.stack([inverse_mass, inverse_mass, inverse_inertia])
    start = jnp.append(velocity, yaw_rate)
    near = jnp.sum(rows * start, axis=-1) < slowest + REACH_M_S
    share = jnp.where(near, 1.0, 0.0) / jnp.maximum(jnp.sum(jnp.where(near, 1.0, 0.0)), 1.0)
    mass = share / jnp.maximum(jnp.sum(rows * rows * inverse, axis=-1), 1e-9)

    def sweep(carry: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], None]:
        motion, impulse = carry
        total = jnp.maximum(impulse + mass * (slowest - jnp.sum(rows * motion, axis=-1)), 0.0)
        return (motion + inverse * jnp.sum(rows * (total - impulse)[:, None], axis=0), total), None

    motion, _ = jax.lax.scan(sweep, (start, jnp.zeros_like(lever)), None, length=SWEEPS)[0]
    return motion[:2], motion[2]


def impact_speed(params: SkidSteerParams, state: SkidSteerState, site: Site, horizon_s: float) -> jax.Array:
    """Largest speed [] (m/s) at which the outline meets a wall within ``horizon_s`` seconds; 0 without contact.

    A value above ``params.impact_speed_max_m_s`` is a collision.
    """
    body = state.body
    rotation = rotation_matrix(body.quaternion)
    walls = near_walls(params, body, rotation, site)
    spin, arm = jnp.sum(rotation[2] * body.angular_velocity_rad_s), walls.arm_m
    velocity = body.velocity_m_s[:2] + spin * jnp.stack([-arm[:, 1], arm[:, 0]], axis=-1)
    approach = -jnp.sum(velocity * walls.outward, axis=-1)
    return jnp.max(jnp.where(walls.clearance_m < horizon_s * approach, approach, 0.0))
