"""Detectors of vehicles that go several control periods at once: where their rates were due, and the counts there."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.sensors.radiation import count, unread
from swarmsim.vehicles.state import RigidState
from swarmsim.world import events
from swarmsim.world.emission import Poses, between, sources_at
from swarmsim.world.model import Group, World
from swarmsim.world.state import GroupState


def not_seen(group: Group, ticks: int, body: RigidState) -> tuple[RigidState, ...]:
    """Room for where a vehicle is when its detector's rate is due in so many control periods."""
    times = 0 if group.counter is None else -(-ticks // group.counter.ticks)
    return tuple(body for _ in range(times))


def noted(
    group: Group, first: jax.Array, tick: jax.Array, seen: tuple[RigidState, ...], body: RigidState
) -> tuple[RigidState, ...]:
    """Where the rates were due since control period ``first``, after control period ``tick``."""
    if group.counter is None:
        return seen
    ticks = group.counter.ticks
    due, place = tick % ticks == 0, tick // ticks - first // ticks - 1
    return tuple(jax.tree.map(partial(jnp.where, due & (place == k)), body, before) for k, before in enumerate(seen))


def counted(
    world: World, group: Group, key: jax.Array, first: jax.Array, ticks: int, running: jax.Array,
    before: GroupState, after: GroupState, seen: tuple[RigidState, ...], branch: Callable[..., Any] = jax.lax.cond,
    carriers: tuple[Poses | None, Poses | None] = (None, None),
) -> GroupState:  # fmt: skip
    """The group (axis U) ``ticks`` control periods after the one numbered ``first``, with its detectors.

    Args:
        world, group: of one mission.
        key: of the mission.
        first: [] int32, control periods since the start.
        ticks: that were gone.
        running: [] bool, whether the group was stepped.
        before, after: the group then and now; the counter is taken from ``before``.
        seen: from `noted`.
        branch: how to compute what is not always due.
        carriers: poses of the vehicles that carry sources, then and now.
    """
    counter, counter_state = group.counter, before.counter
    if counter is None or counter_state is None:
        return after
    measuring = before.active & events.intact(after.event_time_s)
    counter_state = unread(counter_state)
    for place, body in enumerate(seen):
        tick = (first // counter.ticks + 1 + place) * counter.ticks
        due = running & (tick <= first + ticks)
        poses = between(*carriers, (tick - first) / ticks)
        sources = sources_at(world.sources, world.emission, tick * jnp.float32(world.timing.control_period_s), poses)
        counter_state = count(
            counter, counter_state, body, measuring, group.member, world.site, sources, world.background,
            world.departures, key, tick, world.timing.control_period_s, due, branch,
        )  # fmt: skip
    return replace(after, counter=counter_state)
