"""Rovers as ground: a multirotor above a rover's deck stands on it, and rides along."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.physics.contact import Plane
from swarmsim.physics.rotations import rotation_matrix
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import Group, World
from swarmsim.world.state import GroupState, moving

BELOW_M = 0.15
"""Feet that are no further below a deck than this stand on it; a lower vehicle is beside the rover."""
RIDES_BELOW_M = 0.1
"""Height of its feet below which a multirotor over a deck is carried along."""


def on_decks(world: World, groups: tuple[GroupState, ...]) -> tuple[GroupState, ...]:
    """The groups with the deck of a rover as ground of the multirotors that are over it."""
    rovers = [(group, g) for group, g in zip(world.groups, groups, strict=True) if not KINDS[group.kind].FLIES]
    if not rovers:
        return groups
    pose = [jnp.concatenate(x) for x in zip(*(_decks(group, g) for group, g in rovers), strict=True)]
    return tuple(
        _over(group, g, *pose) if KINDS[group.kind].FLIES else g for group, g in zip(world.groups, groups, strict=True)
    )


def _decks(group: Group, g: GroupState) -> tuple[jax.Array, ...]:
    """Middle [U, 3], attitude [U, 3, 3], velocity, turn rate [U, 3], half length and width [U, 2] of rovers' decks."""
    body, deck = g.vehicle.body, group.limits.deck_m
    moves = moving(g)[:, None]  # the state of one that is not moved on keeps its last velocity
    attitude = jax.vmap(rotation_matrix)(body.quaternion)
    lift = attitude[:, :, 2] * deck[:, 2:]
    rate = jnp.sum(attitude * body.angular_velocity_rad_s[:, None, :], axis=-1)
    velocity = jnp.where(moves, body.velocity_m_s + jnp.cross(rate, lift), 0.0)
    return body.position_m + lift, attitude, velocity, jnp.where(moves, rate, 0.0), deck[:, :2]


def _over(
    group: Group, g: GroupState, middle: jax.Array, attitude: jax.Array, velocity: jax.Array, rate: jax.Array,
    half: jax.Array,
) -> GroupState:  # fmt: skip
    """Multirotors with the highest deck below them as their ground, which moves as the deck does where they are."""
    kind = KINDS[group.kind]
    offset = g.vehicle.body.position_m[:, None] - middle
    within = jnp.all(jnp.abs(jnp.sum(offset[..., None] * attitude[None, :, :, :2], axis=-2)) < half, axis=-1)
    planes = Plane(point_m=middle, normal=attitude[:, :, 2], velocity_m_s=velocity)
    one = jax.vmap(kind.height, in_axes=(None, None, 0))
    height = jax.vmap(one, in_axes=(0, 0, None))(group.params, g.vehicle, planes)
    held = jnp.where(within & (height > -BELOW_M), middle[:, 2], -jnp.inf)
    best = jnp.argmax(held, axis=1)
    over = jnp.isfinite(jnp.max(held, axis=1))
    one_hot = best[:, None] == jnp.arange(len(middle))  # sums over it fuse, where gathers are a kernel each

    def of_best(each: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(one_hot.reshape(one_hot.shape + (1,) * (each.ndim - 2)), each, 0.0), axis=1)

    there = velocity + jnp.cross(jnp.broadcast_to(rate, offset.shape), offset)
    deck = Plane(
        point_m=of_best(planes.point_m[None]),
        normal=of_best(planes.normal[None]),
        velocity_m_s=of_best(there),
    )

    def chosen(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(over.reshape(over.shape + (1,) * (new.ndim - 1)), new, old)

    ground = jax.tree.map(chosen, deck, g.around.ground)
    feet = of_best(height)
    around = replace(g.around, ground=ground, height_m=chosen(feet, g.around.height_m))
    return replace(g, around=replace(around, rides=over & (feet < RIDES_BELOW_M)))
