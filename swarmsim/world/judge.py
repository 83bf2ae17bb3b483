"""What judges vehicles, at a rate of its own: the ground below, the wind, the traffic, the radio, and events."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim import randomness
from swarmsim.physics.wind import GUST_NOISE, gust_noise, gust_step, gust_velocity, steady_wind
from swarmsim.scalars import over_vehicles
from swarmsim.site import sample
from swarmsim.world import events
from swarmsim.world.collisions import Bodies, collide
from swarmsim.world.decks import on_decks
from swarmsim.world.failsafes import failing, rescue_of
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import Group, Limits, World
from swarmsim.world.multirotor import ground_below, wall_beside
from swarmsim.world.neighbours import DENSE_MAX, WINDOW, candidates, cleared, norm
from swarmsim.world.radio import broadcast
from swarmsim.world.right_of_way import kept_aside, reach_of, right_of_way
from swarmsim.world.state import GroupState, Surroundings, WorldState

AIRBORNE_M = 0.5
"""Height of its feet above which a multirotor's failsafes are on."""


def look_around(world: World, state: WorldState, number: jax.Array) -> tuple[WorldState, list[jax.Array]]:
    """The state with ground, wind, traffic and radio refreshed, and which vehicles [U] of each group have collided.

    ``number`` [] int32 is the judging period's, which gusts and the radio's losses are drawn for.
    """
    gusts = randomness.consumer(state.key, "gusts")
    around = [
        _refreshed(world, group, gusts, number, running, g)
        for running, group, g in zip(state.clock.running, world.groups, state.groups, strict=True)
    ]
    groups = tuple(replace(g, around=new) for g, new in zip(state.groups, around, strict=True))
    groups, collided, crowded = _in_traffic(world, on_decks(world, groups))
    state = replace(state, groups=groups, crowded=state.crowded | crowded)
    return replace(state, radio=broadcast(world, state, number)), collided


def record_events(
    world: World, kind_name: str, now_s: jax.Array, params: Any, limits: Limits, state: GroupState, collided: jax.Array
) -> GroupState:
    """One vehicle with the events of the judging period that ends at ``now_s`` [] recorded."""
    kind = KINDS[kind_name]
    height, impact = state.around.height_m, state.impact_m_s
    crash = kind.crashed(params, state.vehicle, height, impact, limits)
    obstacle = kind.obstructed(params, state.vehicle, state.around.wall, impact, limits, world.site)
    empty = state.vehicle.energy_j > limits.battery_j
    lost = jnp.stack([crash, obstacle, collided, empty, jnp.array(False)]) & state.finite
    lost = lost.at[events.NON_FINITE].set(~state.finite)
    rescue, body, dt = state.around.rescue, state.vehicle.body, world.timing.judge_period_s
    failing_now = jnp.zeros(len(events.FAILSAFES), bool)
    if rescue is not None:
        flies = state.active & (height > AIRBORNE_M) & state.finite
        failing_now, rescue = failing(
            world.failsafes, rescue, position_m=body.position_m, velocity_m_s=body.velocity_m_s,
            brake_m_s2=params.control.acceleration_max_m_s2,
            carried_m_s=kind.carried(params, state.vehicle, world.failsafes.wind_share),
            above_m=body.position_m[2] - sample(world.site.terrain_m, world.site, body.position_m[:2]),
            charge=1.0 - state.vehicle.energy_j / limits.battery_j, home_m=limits.home_m, dt=dt,
        )  # fmt: skip
        failing_now = failing_now & flies & ~jnp.any(lost)  # one that returns may yet have to land
    happened = jnp.concatenate([lost, failing_now]) & state.active
    times = events.record(state.event_time_s, happened, now_s)
    active = state.active
    if rescue is not None:
        rescue = rescue_of(world.failsafes, rescue, times, body.position_m, height, world.site, limits.home_m)
        active = active & ~(events.rescued(times) & kind.landed(state.control))
    around = replace(state.around, rescue=rescue)
    return replace(state, event_time_s=times, around=around, active=active, impact_m_s=jnp.zeros_like(impact))


def _refreshed(
    world: World, group: Group, gusts: jax.Array, number: jax.Array, running: jax.Array, state: GroupState
) -> Surroundings:
    """What is around a group's vehicles, with ground, height and wind where they are now if it is running."""
    kind = KINDS[group.kind]

    def anew(noise: jax.Array | None, params: Any, limits: Limits, vehicle: Any, around: Surroundings) -> Surroundings:
        body = vehicle.body
        ground = ground_below(world.site, body.position_m)
        height = kind.height(params, vehicle, ground)
        if noise is None:
            return replace(around, ground=ground, height_m=height)
        wall = wall_beside(world.site, world.walls, body.position_m, limits.half_height_m)
        air = world.air
        above = jnp.maximum(body.position_m[2] - sample(world.site.terrain_m, world.site, body.position_m[:2]), 0.0)
        steady = steady_wind(air.speed_m_s, air.from_rad, above)
        through = body.velocity_m_s - steady
        airspeed = jnp.sqrt(jnp.sum(through * through) + 1e-12)
        gust = gust_step(
            noise, around.gust, speed_m_s=air.speed_m_s, height_m=above, airspeed_m_s=airspeed,
            dt=world.timing.judge_period_s,
        )  # fmt: skip
        wind = steady + air.gusts * gust_velocity(gust, air.speed_m_s, air.from_rad, above)
        return replace(around, ground=ground, wall=wall, height_m=height, gust=gust, wind_m_s=wind)

    def one(noise: jax.Array | None, params: Any, limits: Limits, vehicle: Any, around: Surroundings) -> Surroundings:
        return jax.lax.cond(running, anew, lambda *given: given[-1], noise, params, limits, vehicle, around)

    def draw() -> jax.Array:
        return jax.vmap(gust_noise)(randomness.per_vehicle(gusts, number, group.member))

    noise = jax.lax.cond(running, draw, lambda: jnp.zeros((group.size, GUST_NOISE))) if kind.FLIES else None
    every = over_vehicles(one, layout=world.layout, unroll=1)
    refreshed: Surroundings = every(noise, group.params, group.limits, state.vehicle, state.around)
    return refreshed


def _in_traffic(
    world: World, groups: tuple[GroupState, ...]
) -> tuple[tuple[GroupState, ...], list[jax.Array], jax.Array]:
    """Groups after collisions, with what others ask of each; who has collided [U]; whether the search overflowed."""
    flies = jnp.concatenate([jnp.full(group.size, KINDS[group.kind].FLIES) for group in world.groups])
    active = jnp.concatenate([g.active for g in groups])
    able = active & jnp.concatenate([events.intact(g.event_time_s) for g in groups])
    height = jnp.concatenate([g.around.height_m for g in groups])
    position = jnp.concatenate([g.vehicle.body.position_m for g in groups])
    velocity = jnp.concatenate([g.vehicle.body.velocity_m_s for g in groups])
    radius = jnp.concatenate([group.limits.radius_m for group in world.groups])
    half_height = jnp.concatenate([group.limits.half_height_m for group in world.groups])
    rules, dt = world.traffic, world.timing.judge_period_s
    place, usable = cleared(jnp.where(jnp.isfinite(velocity), position, jnp.inf))
    pace = jnp.where(usable[:, None], velocity, 0.0)
    reach = reach_of(usable, radius, jnp.where(flies, rules.separation_m, rules.ground_separation_m))
    near = candidates(place, usable, usable, reach + 2.0 * dt * jnp.max(norm(pace)), WINDOW, DENSE_MAX)
    traffic = right_of_way(
        position,
        velocity,
        height_m=height,
        flies=flies,
        active=able,
        rank=jnp.concatenate([group.member for group in world.groups]),
        radius_m=radius,
        half_height_m=half_height,
        separation_m=rules.separation_m,
        ground_separation_m=rules.ground_separation_m,
        held=jnp.concatenate([g.around.hold for g in groups]),
        near=near,
    )
    mass = jnp.concatenate([group.params.mass_kg for group in world.groups])
    bodies = Bodies(
        position_m=place,
        velocity_m_s=pace,
        radius_m=radius,
        half_height_m=half_height,
        mass_kg=jnp.where(active, mass, jnp.inf),
        flies=flies,
        active=active,
    )
    met = collide(bodies, near, dt)
    before = jnp.concatenate([g.around.push_m for g in groups])
    push, aside = kept_aside(before, traffic.push_m, height, flies, rules.separation_m, dt)
    hold = traffic.hold | aside
    told, collided, first = [], [], 0
    for group, g in zip(world.groups, groups, strict=True):
        part = slice(first, first + group.size)
        around = replace(g.around, hold=hold[part], push_m=push[part], nearest_m=traffic.nearest_m[part])
        knocked = jax.vmap(KINDS[group.kind].knocked)(
            group.params, g.vehicle, met.velocity_m_s[part], met.spin_nms[part]
        )
        told.append(replace(g, around=around, vehicle=knocked))
        collided.append(met.hit[part] & active[part])
        first += group.size
    return tuple(told), collided, traffic.overflow
