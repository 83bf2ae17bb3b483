"""What judges vehicles, at a rate of its own: the ground below, the wind, the traffic, the radio, and events."""

import math
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim import randomness
from swarmsim.physics.wind import GUST_DRAWS, gust_noise, gust_scales, gust_step, gust_velocity, steady_wind
from swarmsim.scalars import over_vehicles
from swarmsim.site import sample
from swarmsim.world import events
from swarmsim.world.decks import on_decks
from swarmsim.world.failsafes import failing, rescue_of
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import Group, Limits, World
from swarmsim.world.multirotor import ground_below, wall_beside
from swarmsim.world.radio import broadcast
from swarmsim.world.state import GroupState, Surroundings, WorldState
from swarmsim.world.traffic import in_traffic

MOTOR_NOISE_S = 0.1
"""Correlation time of the errors of rotors' speeds: an estimate of how fast motor controllers hunt."""
AT_REST_M_S = 0.05
"""Speed below which a vehicle that a failsafe has landed has come to rest."""
AIRBORNE_M = 0.5
"""Height of its feet above which a multirotor's failsafes are on."""


def look_around(world: World, state: WorldState, number: jax.Array) -> tuple[WorldState, list[jax.Array]]:
    """The state with ground, wind, traffic and radio refreshed, and which vehicles [U] of each group have collided.

    ``number`` [] int32 is the judging period's, which gusts and the radio's losses are drawn for.
    """
    around = [
        _refreshed(world, group, noise, running, g)
        for noise, running, group, g in zip(
            _noise(world, state, number), state.clock.running, world.groups, state.groups, strict=True
        )
    ]
    groups = tuple(replace(g, around=new) for g, new in zip(state.groups, around, strict=True))
    groups, collided, crowded = in_traffic(world, on_decks(world, groups), state.clock.running)
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
        rescue = rescue_of(
            world.failsafes, rescue, times, now_s, body.position_m, height, state.around.push_m, world.site,
            limits.home_m,
        )  # fmt: skip
        still = jnp.sum(body.velocity_m_s**2) < AT_REST_M_S**2  # it may slide on a little with its motors off
        active = active & ~(events.rescued(times) & kind.landed(state.control) & still)
    around = replace(state.around, rescue=rescue)
    return replace(state, event_time_s=times, around=around, active=active, impact_m_s=jnp.zeros_like(impact))


def _flying_height(world: World, groups: tuple[GroupState, ...]) -> jax.Array:
    """Mean height [] m above ground of what flies, which the scales of the gusts between them are taken for."""
    heights = [g.around.height_m for group, g in zip(world.groups, groups, strict=True) if KINDS[group.kind].FLIES]
    if not heights:
        return jnp.zeros(())
    height = jnp.concatenate(heights)
    known = jnp.isfinite(height)
    return jnp.sum(jnp.where(known, height, 0.0)) / jnp.maximum(jnp.sum(known), 1)


def _noise(world: World, state: WorldState, number: jax.Array) -> list[Any]:
    """White noise of each group's gusts [U, …] and rotors [U, R] in a judging period; None for what does not fly.

    All of it is one draw: on a GPU each costs microseconds, however small it is.
    """
    rotors = [KINDS[group.kind].rotors(group.params) if KINDS[group.kind].FLIES else 0 for group in world.groups]
    flying = [k for k, group in enumerate(world.groups) if KINDS[group.kind].FLIES]
    if not flying:
        return [None] * len(world.groups)
    ends = np.cumsum([GUST_DRAWS, *(group.size * count for group, count in zip(world.groups, rotors, strict=True))])
    key = jax.random.fold_in(randomness.consumer(state.key, "air"), number)
    runs = jnp.any(jnp.stack([state.clock.running[k] for k in flying]))
    size = (int(ends[-1]),)
    draws = jax.lax.cond(runs, lambda: jax.random.normal(key, size), lambda: jnp.zeros(size))
    lengths = gust_scales(world.air.speed_m_s, _flying_height(world, state.groups))[1]
    found: list[Any] = [None] * len(world.groups)
    for k in flying:
        motors = draws[ends[k] : ends[k + 1]].reshape(world.groups[k].size, rotors[k])
        found[k] = gust_noise(draws[:GUST_DRAWS], state.groups[k].vehicle.body.position_m, lengths), motors
    return found


def _refreshed(world: World, group: Group, noise: Any, running: jax.Array, state: GroupState) -> Surroundings:
    """What is around a group's vehicles, with ground, height and wind where they are now if it is running."""
    kind = KINDS[group.kind]

    period = world.timing.judge_period_s

    def anew(noise: Any, params: Any, limits: Limits, vehicle: Any, around: Surroundings) -> Surroundings:
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
            noise[0], around.gust, speed_m_s=air.speed_m_s, height_m=above, airspeed_m_s=airspeed, dt=period
        )
        assert around.motor_noise is not None
        kept = math.exp(-period / MOTOR_NOISE_S)
        motors = kept * around.motor_noise + math.sqrt(1.0 - kept * kept) * noise[1]
        wind = steady + air.gusts * gust_velocity(gust, air.speed_m_s, air.from_rad, above)
        return replace(around, ground=ground, wall=wall, height_m=height, gust=gust, wind_m_s=wind, motor_noise=motors)

    def one(noise: Any, params: Any, limits: Limits, vehicle: Any, around: Surroundings) -> Surroundings:
        return jax.lax.cond(running, anew, lambda *given: given[-1], noise, params, limits, vehicle, around)

    every = over_vehicles(one, layout=world.layout, unroll=1)
    refreshed: Surroundings = every(noise, group.params, group.limits, state.vehicle, state.around)
    return refreshed
