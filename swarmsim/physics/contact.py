"""Contact of a free body with the ground: spring-damper points with Coulomb friction, as a wrench.

The ground below a vehicle is its tangent plane, so that the terrain can have any resolution and the body stays free of
constraints.
"""

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree

SLIP_M_S = 0.1
"""Slip along a wall at which its friction is 71 % of that of Coulomb."""

PART_M_S = 1.0
"""Largest speed at which a spring makes a body part from what it touches: frames and feet do not throw it back."""


@pytree
class Plane:
    """Tangent plane of the ground below a vehicle, or of a wall beside it."""

    point_m: jax.Array  # [3] m, world: any point of it
    normal: jax.Array  # [3] unit vector, world, out of the ground or the wall
    velocity_m_s: jax.Array | None = None  # [3] world, of a rover's deck; None: stands still


@pytree
class ContactPoints:
    """Points of a body that can touch the ground, alike in all but place."""

    position_m: jax.Array  # [C, 3] m, body
    stiffness_n_m: jax.Array  # [] N/m, normal
    tangential_n_m: jax.Array  # [] N/m, tangential, while the point sticks
    damping_n_s_m: jax.Array  # [] N s/m, normal
    friction: jax.Array  # [] Coulomb coefficient
    mass_kg: jax.Array  # [] of the body


def contact_wrench(
    points: ContactPoints,
    *,
    slip_m: jax.Array,
    height_m: jax.Array,
    normal: jax.Array,
    velocity_m_s: jax.Array,
    angular_velocity_rad_s: jax.Array,
    dt: float,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Force [3] N, torque [3] N m about the body's origin and the new slip [C, 3] m, all in the body frame.

    ``height_m`` [C] are the points' heights above the plane (negative inside), ``normal`` [3] the plane's normal,
    ``velocity_m_s`` [3] and ``angular_velocity_rad_s`` [3] those of the body, all body frame; ``slip_m`` [C, 3] is the
    elastic give of each point along the plane, which a step of ``dt`` s moves on.

    Normal: a spring with a damper that never pulls. Tangential: Coulomb friction regularised by a spring that gives way
    at the friction cone (Cundall and Strack, "A discrete numerical model for granular assemblies", Géotechnique 29(1),
    1979), so that a vehicle on a slope rests and does not creep, as it would on a viscous regularisation. The
    tangential damper is the normal one times the ratio of the stiffnesses.
    """
    w = angular_velocity_rad_s
    velocity = velocity_m_s + _cross(w, points.position_m)
    closing = jnp.sum(velocity * normal, axis=-1)
    touching = height_m < 0.0
    most = points.mass_kg / jnp.maximum(jnp.sum(touching), 1) / dt
    push = jnp.where(touching, _push(points, -height_m, closing, most), 0.0)
    along = velocity - closing[:, None] * normal
    give = slip_m - jnp.sum(slip_m * normal, axis=-1, keepdims=True) * normal + dt * along
    ratio = points.tangential_n_m / points.stiffness_n_m
    stick = -points.tangential_n_m * give - ratio * points.damping_n_s_m * along
    cone = points.friction * push
    # The small term keeps the gradient finite where nothing pulls; a force of 1 mN is far below any cone that matters.
    share = jnp.minimum(1.0, cone * jax.lax.rsqrt(jnp.sum(stick * stick, axis=-1) + 1e-6))[:, None]
    force = share * stick + push[:, None] * normal
    return jnp.sum(force, axis=0), jnp.sum(_cross(points.position_m, force), axis=0), share * give


def wall_wrench(
    points: ContactPoints,
    *,
    radius_m: jax.Array,
    distance_m: jax.Array,
    normal: jax.Array,
    velocity_m_s: jax.Array,
    angular_velocity_rad_s: jax.Array,
    inertia_kg_m2: jax.Array,
    dt: float,
) -> tuple[jax.Array, jax.Array]:
    """Force [3] N and torque [3] N m about the body's origin (body frame) of an upright wall on the body's rim.

    The rim is a circle of ``radius_m`` [] about the body's origin; its point nearest to the wall meets a spring and
    damper as stiff as a contact point, and Coulomb friction that grows with the slip up to `SLIP_M_S`, but takes no
    more than the slip off within a step. ``distance_m`` [] is that of the origin from the wall, ``normal`` [3] points
    out of it (body frame), ``inertia_kg_m2`` [3] are the principal moments.
    """
    arm = -radius_m * normal
    velocity = velocity_m_s + _cross(angular_velocity_rad_s, arm)
    closing = jnp.sum(velocity * normal)
    depth = radius_m - distance_m
    push = jnp.where(depth > 0.0, _push(points, depth, closing, points.mass_kg / dt), 0.0)
    along = velocity - closing * normal
    slip = jax.lax.rsqrt(jnp.sum(along * along) + SLIP_M_S * SLIP_M_S)
    inertia = jnp.min(inertia_kg_m2)
    stops = points.mass_kg * inertia / (inertia + points.mass_kg * radius_m * radius_m) / dt
    force = push * normal - jnp.minimum(points.friction * slip * push, stops) * along
    return force, _cross(arm, force)


def _push(points: ContactPoints, depth_m: jax.Array, parting_m_s: jax.Array, stops_n_s_m: jax.Array) -> jax.Array:
    """Normal force [...] N of a point ``depth_m`` [...] deep that moves out by ``parting_m_s`` [...].

    Within a step, in which ``stops_n_s_m`` [] N take a speed of 1 m/s off, nothing is made to part faster than
    `PART_M_S`: at the edge of a roof a vehicle can be deep in what has just become its wall or its ground, and would be
    thrown.
    """
    most = stops_n_s_m * jnp.maximum(PART_M_S - parting_m_s, 0.0)
    return jnp.clip(points.stiffness_n_m * depth_m - points.damping_n_s_m * parting_m_s, 0.0, most)


def _cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross product of vectors [..., 3], as rolls that XLA fuses into what uses them."""
    return jnp.roll(a, -1, -1) * jnp.roll(b, -2, -1) - jnp.roll(a, -2, -1) * jnp.roll(b, -1, -1)
