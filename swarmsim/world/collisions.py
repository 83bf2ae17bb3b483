"""What vehicles do to each other when they meet: impulses between upright cylinders.

A pair is looked at once in a judging period, and its way to the next look is swept, so that fast vehicles do not pass
through each other between two looks. Both partners compute the same impulse with opposite signs: momentum is conserved.
"""

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree
from swarmsim.world.neighbours import Candidates, dot, norm, root

RESTITUTION = 0.2
"""Speed of parting over that of approach: an estimate for light frames, propellers and bumpers that give way."""
FRICTION = 0.3
"""Coulomb coefficient between vehicles: an estimate for plastic, carbon fibre and aluminium."""
PART_M_S = 0.8
"""Speed at which vehicles that overlap are moved apart; a slower one would only strain the feet of two that lie on the
ground."""
TOUCH_M = 0.02
"""Cylinders closer than this touch."""


@pytree
class Bodies:
    """Vehicles as upright cylinders; axis V."""

    position_m: jax.Array  # [V, 3] world, middle of the cylinder
    velocity_m_s: jax.Array  # [V, 3] world
    rate_rad_s: jax.Array  # [V, 3] world
    radius_m: jax.Array  # [V]
    half_height_m: jax.Array  # [V]
    mass_kg: jax.Array  # [V] inf: does not give way
    inertia_kg_m2: jax.Array  # [V] least moment of inertia about the centre of mass
    flies: jax.Array  # [V] bool: a rover stands on the ground, which takes vertical impulses
    active: jax.Array  # [V] bool: of two that are not, none moves


@pytree
class Collisions:
    """What collisions did; axis V."""

    velocity_m_s: jax.Array  # [V, 3] change of the velocity, world
    spin_nms: jax.Array  # [V, 3] angular impulse about the centre of mass, world
    hit: jax.Array  # [V] bool: has met another one


def collide(bodies: Bodies, near: Candidates, dt: float) -> Collisions:
    """Impulses of the pairs of ``near`` that touch now or will within ``dt`` s at their present velocities.

    Newton's restitution along the normal, which is that of the faces that meet last (rim to rim, or top to bottom), and
    Coulomb friction across it. Where a vehicle meets several at once, each pair's impulse is shared by their number,
    equal for both partners. A multirotor above a rover is left to its feet, which stand on the rover's deck.
    """
    of = near.of
    apart = bodies.position_m[:, None] - of(bodies.position_m)
    closing = bodies.velocity_m_s[:, None] - of(bodies.velocity_m_s)
    reach = bodies.radius_m[:, None] + of(bodies.radius_m)
    tall = bodies.half_height_m[:, None] + of(bodies.half_height_m)
    rim_from, rim_to = _rims_overlap(apart, closing, reach)
    top_from, top_to = _heights_overlap(apart, closing, tall)
    begin, end = jnp.maximum(rim_from, top_from), jnp.minimum(rim_to, top_to)
    meets = near.pair & (begin < end) & (begin < dt) & (end > 0.0)
    at = jnp.clip(begin, 0.0, dt)[..., None] * closing + apart
    inside = begin <= 0.0
    level = norm(at[..., :2])
    beside = reach - level < tall - jnp.abs(at[..., 2])  # of two that overlap already: the shorter way out
    flies = bodies.flies[:, None], of(bodies.flies)
    both_fly, none_flies = flies[0] & flies[1], ~(flies[0] | flies[1])
    upright = jnp.where(inside, ~beside, top_from > rim_from) & ~none_flies
    number = jnp.arange(len(bodies.mass_kg))
    normal = _normal(at, level, upright, jnp.sign(number[:, None] - of(number)).astype(jnp.float32))
    meets &= ~(upright & ~both_fly) & (bodies.active[:, None] | of(bodies.active))
    depth = jnp.where(inside, jnp.where(upright, tall - jnp.abs(at[..., 2]), reach - level), 0.0)
    radius, half = bodies.radius_m, bodies.half_height_m
    arm = _arm(radius[:, None], half[:, None], of(half), at, normal, upright)
    others = _arm(of(radius), of(half), half[:, None], -at, -normal, upright)
    # Of the points that touch: what spins already is not turned on and on by what it lies on.
    closing = closing + jnp.cross(bodies.rate_rad_s[:, None], arm) - jnp.cross(of(bodies.rate_rad_s), others)
    impulse = _impulses(bodies, near, meets, closing, normal, (arm, others), jnp.maximum(depth - TOUCH_M, 0.0))
    touched = meets & (dot(impulse, impulse) > 0.0)
    number = jnp.sum(touched, axis=1).astype(jnp.float32)
    impulse = impulse / jnp.maximum(jnp.maximum(number[:, None], of(number)), 1.0)[..., None]
    moves = jnp.isfinite(bodies.mass_kg)[:, None]
    return Collisions(
        velocity_m_s=jnp.sum(impulse, axis=1) / bodies.mass_kg[:, None],
        spin_nms=jnp.where(moves, jnp.sum(jnp.cross(arm, impulse), axis=1), 0.0),
        hit=jnp.any(meets, axis=1),
    )


def _rims_overlap(apart: jax.Array, closing: jax.Array, reach: jax.Array) -> tuple[jax.Array, jax.Array]:
    """From when to when [V, C] s the horizontal distance is below ``reach`` [V, C], at constant velocities."""
    a = dot(closing[..., :2], closing[..., :2])
    b = dot(apart[..., :2], closing[..., :2])
    c = dot(apart[..., :2], apart[..., :2]) - reach * reach
    discriminant = b * b - a * c
    spread = root(discriminant)
    still = a < 1e-8
    speed = jnp.where(still, 1.0, a)
    never = jnp.where(still, c >= 0.0, discriminant <= 0.0)
    first = jnp.where(still, -jnp.inf, (-b - spread) / speed)
    last = jnp.where(still, jnp.inf, (-b + spread) / speed)
    return jnp.where(never, jnp.inf, first), jnp.where(never, -jnp.inf, last)


def _heights_overlap(apart: jax.Array, closing: jax.Array, tall: jax.Array) -> tuple[jax.Array, jax.Array]:
    """From when to when [V, C] s the difference in height is below ``tall`` [V, C]."""
    gap, rate = apart[..., 2], closing[..., 2]
    still = jnp.abs(rate) < 1e-4
    speed = jnp.where(still, 1.0, rate)
    one, other = (-tall - gap) / speed, (tall - gap) / speed
    within = jnp.abs(gap) < tall
    first = jnp.where(still, jnp.where(within, -jnp.inf, jnp.inf), jnp.minimum(one, other))
    last = jnp.where(still, jnp.where(within, jnp.inf, -jnp.inf), jnp.maximum(one, other))
    return first, last


def _normal(at: jax.Array, level: jax.Array, upright: jax.Array, order: jax.Array) -> jax.Array:
    """Unit vector [V, C, 3] from the other one; exactly opposite for the two of a pair.

    Two in one place are parted along the east or upwards, by their ``order`` [V, C], 1 or -1.
    """
    apart = (level > 1e-6)[..., None]
    side = jnp.where(apart, at[..., :2] / jnp.maximum(level, 1e-6)[..., None], 0.0)
    side = jnp.where(apart, side, order[..., None] * jnp.array([1.0, 0.0]))
    flat = jnp.concatenate([side, jnp.zeros_like(level)[..., None]], axis=-1)
    over = jnp.where(at[..., 2] == 0.0, order, jnp.sign(at[..., 2]))
    up = jnp.stack([jnp.zeros_like(level), jnp.zeros_like(level), over], axis=-1)
    return jnp.where(upright[..., None], up, flat)


def _impulses(
    bodies: Bodies, near: Candidates, meets: jax.Array, closing: jax.Array, normal: jax.Array,
    arms: tuple[jax.Array, jax.Array], depth: jax.Array,
) -> jax.Array:  # fmt: skip
    """Impulse [V, C, 3] N s on each from each that it meets, at the ``arms`` [V, C, 3] about both centres.

    An impulse moves less than the masses because it also turns them: without that, spin would come from nowhere. It is
    taken with the least moment of inertia, that of friction with the whole arm, so that no energy is gained.
    """
    of, fixed = near.of, ~jnp.isfinite(bodies.mass_kg)
    inverse, turning = 1.0 / bodies.mass_kg, jnp.where(fixed, 0.0, 1.0 / bodies.inertia_kg_m2)

    def effective_mass(mine: jax.Array, others: jax.Array) -> jax.Array:
        """Of the pairs [V, C], from the squares [V, C] of the lever arms."""
        gives = inverse[:, None] + turning[:, None] * mine + (of(inverse) + of(turning) * others)
        return 1.0 / jnp.maximum(gives, 1e-9)

    long = [dot(arm, arm) for arm in arms]
    lever = [jnp.maximum(whole - dot(arm, normal) ** 2, 0.0) for whole, arm in zip(long, arms, strict=True)]
    effective = effective_mass(*lever)
    along = dot(closing, normal)
    wanted = jnp.where(depth > 0.0, PART_M_S, 0.0)
    parting = wanted - jnp.where(along < 0.0, 1.0 + RESTITUTION, 1.0) * along
    push = jnp.where(meets, effective * jnp.maximum(parting, 0.0), 0.0)
    across = closing - along[..., None] * normal
    slip = norm(across)
    rub = jnp.minimum(FRICTION * push, effective_mass(*long) * slip) / jnp.maximum(slip, 1e-6)
    return push[..., None] * normal - rub[..., None] * across


def _arm(
    radius: jax.Array, half: jax.Array, other_half: jax.Array, at: jax.Array, normal: jax.Array, upright: jax.Array
) -> jax.Array:
    """Place [V, C, 3] m where two touch, from the centre of one: on its rim, in the middle of the heights they share.

    ``radius`` and ``half`` are its own, ``at`` is its offset from the other one and ``normal`` points that way.
    """
    middle = -at[..., 2]  # height of the other's centre over the own one
    top, bottom = jnp.minimum(half, middle + other_half), jnp.maximum(-half, middle - other_half)
    rim = -radius[..., None] * normal + 0.5 * (top + bottom)[..., None] * jnp.array([0.0, 0.0, 1.0])
    face = -0.5 * at * jnp.array([1.0, 1.0, 0.0]) - half[..., None] * normal
    return jnp.where(upright[..., None], face, rim)
