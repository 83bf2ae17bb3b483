"""What the vehicles of a mission are to each other: right of way, collisions and downwash, in one look.

The groups' vehicles stand in one array here, whatever their kinds; axis V.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.physics.rotations import rotate
from swarmsim.pytree import pytree
from swarmsim.world import events
from swarmsim.world.collisions import Bodies, collide
from swarmsim.world.downwash import Rotorcraft, downwash, reach_m
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import World
from swarmsim.world.neighbours import DENSE_MAX, WINDOW, Candidates, candidates, cleared, norm
from swarmsim.world.right_of_way import Traffic, kept_aside, reach_of, right_of_way
from swarmsim.world.state import GroupState, moving

Groups = tuple[GroupState, ...]


@pytree
class _Fleet:
    """All vehicles of a mission."""

    position_m: jax.Array  # [V, 3] world; at the origin where it is not usable
    velocity_m_s: jax.Array  # [V, 3] world
    usable: jax.Array  # [V] bool: its state is made of numbers
    flies: jax.Array  # [V] bool
    active: jax.Array  # [V] bool
    radius_m: jax.Array  # [V]
    half_height_m: jax.Array  # [V]
    thrust_n: jax.Array  # [V]
    span_m: jax.Array  # [V]


def in_traffic(world: World, groups: Groups, running: jax.Array) -> tuple[Groups, list[jax.Array], jax.Array]:
    """The groups after collisions and with what others ask of each, and the air that others push down onto them.

    Also returns which vehicles [U] of each group have collided, and whether [] the search overflowed. ``running`` [G]
    tells which groups are stepped.
    """
    fleet, dt = _fleet(world, groups), world.timing.judge_period_s
    near = _near(world, fleet, dt)
    traffic = _traffic(world, groups, fleet, near)
    mass = jnp.concatenate([group.params.mass_kg for group in world.groups])
    met = collide(
        Bodies(
            position_m=fleet.position_m,
            velocity_m_s=fleet.velocity_m_s,
            rate_rad_s=_rates(groups, fleet),
            radius_m=fleet.radius_m,
            half_height_m=fleet.half_height_m,
            mass_kg=jnp.where(fleet.active, mass, jnp.inf),
            inertia_kg_m2=jnp.concatenate([_least_inertia(group.params.inertia_kg_m2) for group in world.groups]),
            flies=fleet.flies,
            active=fleet.active,
        ),
        near,
        dt,
    )
    wind = jnp.concatenate([g.around.wind_m_s for g in groups])
    craft = Rotorcraft(
        position_m=fleet.position_m,
        velocity_m_s=fleet.velocity_m_s,
        wind_m_s=jnp.where(fleet.usable[:, None], wind, 0.0),
        thrust_n=fleet.thrust_n,
        span_m=fleet.span_m,
    )
    stepped = jnp.concatenate([jnp.full(group.size, running[k]) for k, group in enumerate(world.groups)])
    down = jnp.where(stepped & fleet.flies, downwash(craft, near), 0.0)  # what is not stepped has its wind from before
    wind = wind.at[:, 2].add(-down)
    height = jnp.concatenate([g.around.height_m for g in groups])
    before = jnp.concatenate([g.around.push_m for g in groups])
    push, aside = kept_aside(before, traffic.push_m, height, fleet.flies, world.traffic.separation_m, dt)
    hold = traffic.hold | aside
    told, collided, first = [], [], 0
    for group, g in zip(world.groups, groups, strict=True):
        part = slice(first, first + group.size)
        around = replace(
            g.around, hold=hold[part], push_m=push[part], nearest_m=traffic.nearest_m[part], wind_m_s=wind[part]
        )
        knocked = jax.vmap(KINDS[group.kind].knocked)(
            group.params, g.vehicle, met.velocity_m_s[part], met.spin_nms[part]
        )
        told.append(replace(g, around=around, vehicle=knocked))
        collided.append(met.hit[part] & fleet.active[part])
        first += group.size
    return tuple(told), collided, traffic.overflow


def _rates(groups: Groups, fleet: _Fleet) -> jax.Array:
    """Turn rates [V, 3] rad/s, world, of those that are stepped."""
    bodies = [g.vehicle.body for g in groups]
    rate = jnp.concatenate([rotate(b.quaternion, b.angular_velocity_rad_s) for b in bodies])
    return jnp.where(jnp.isfinite(rate) & (fleet.usable & fleet.active)[:, None], rate, 0.0)


def _least_inertia(inertia: jax.Array) -> jax.Array:
    """Least moment [U] of principal moments [U, 3], or of the diagonal of tensors [U, 3, 3]."""
    moments = inertia if inertia.ndim == 2 else jnp.diagonal(inertia, axis1=-2, axis2=-1)
    return jnp.min(moments, axis=-1)


def _fleet(world: World, groups: Groups) -> _Fleet:
    velocity = jnp.concatenate([g.vehicle.body.velocity_m_s for g in groups])
    position = jnp.concatenate([g.vehicle.body.position_m for g in groups])
    place, usable = cleared(jnp.where(jnp.isfinite(velocity), position, jnp.inf))
    jets = [
        jax.vmap(KINDS[group.kind].jet)(group.params, g.vehicle) for group, g in zip(world.groups, groups, strict=True)
    ]
    thrust, span = (jnp.concatenate(x) for x in zip(*jets, strict=True))
    stepped = jnp.concatenate([moving(g) for g in groups])
    return _Fleet(
        position_m=place,
        velocity_m_s=jnp.where(usable[:, None], velocity, 0.0),
        usable=usable,
        flies=jnp.concatenate([jnp.full(group.size, KINDS[group.kind].FLIES) for group in world.groups]),
        active=jnp.concatenate([g.active for g in groups]),
        radius_m=jnp.concatenate([group.limits.radius_m for group in world.groups]),
        half_height_m=jnp.concatenate([group.limits.half_height_m for group in world.groups]),
        thrust_n=jnp.where(usable & stepped, thrust, 0.0),  # one that only rests keeps the rotor speeds it had
        span_m=span,
    )


def _near(world: World, fleet: _Fleet, dt: float) -> Candidates:
    """Pairs that may have to do with each other until the next look."""
    rules = world.traffic
    gap = jnp.where(fleet.flies, rules.separation_m, rules.ground_separation_m)
    reach = jnp.maximum(reach_of(fleet.usable, fleet.radius_m, gap), reach_m(fleet.span_m))
    reach += 2.0 * dt * jnp.max(norm(fleet.velocity_m_s))
    return candidates(fleet.position_m, fleet.usable, fleet.usable, reach, WINDOW, DENSE_MAX)


def _traffic(world: World, groups: Groups, fleet: _Fleet, near: Candidates) -> Traffic:
    rules = world.traffic
    able = fleet.active & jnp.concatenate([events.intact(g.event_time_s) for g in groups])
    return right_of_way(
        jnp.concatenate([g.vehicle.body.position_m for g in groups]),
        jnp.concatenate([g.vehicle.body.velocity_m_s for g in groups]),
        height_m=jnp.concatenate([g.around.height_m for g in groups]),
        flies=fleet.flies,
        active=able,
        rank=jnp.concatenate([group.member for group in world.groups]),
        radius_m=fleet.radius_m,
        separation_m=rules.separation_m,
        ground_separation_m=rules.ground_separation_m,
        held=jnp.concatenate([g.around.hold for g in groups]),
        near=near,
    )
