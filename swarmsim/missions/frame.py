"""One judging period of a mission: vehicles are judged, then each group goes its control periods by itself.

Between two judgements vehicles know nothing new of each other, so all that one does (its policies, its controller, its
motion) is a function of that vehicle alone and is compiled as one. Its detector's rate is computed afterwards, where
the vehicle was when it was due; policies therefore get a reading at the end of the judging period in which its exposure
ended.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.missions.acting import (
    TASK_AXES,
    ask,
    at_frames,
    chosen,
    heard_by,
    period_ticks,
    phase_key,
    policy_of,
    rows,
    set_rows,
    shared_belief,
    tasks,
    view_of,
)
from swarmsim.missions.plan import Phase, Place, Plan
from swarmsim.missions.state import MissionState, PhaseState
from swarmsim.policies.view import View
from swarmsim.pytree import pytree
from swarmsim.scalars import over_vehicles
from swarmsim.sensors.radiation import Counter, CounterState, count, unread
from swarmsim.vehicles.state import RigidState
from swarmsim.world import events
from swarmsim.world.judge import look_around, now_s, record_events
from swarmsim.world.model import Group, Limits, World
from swarmsim.world.state import GroupState
from swarmsim.world.step import move, with_move

RESTING_HEIGHT_M = 0.1  # a vehicle whose part is done rests if it stands on the ground, else it hovers


@pytree
class _Part:
    """A phase's part in one group, as the group's vehicles [U] carry it; those of other phases carry a copy of one."""

    memory: Any  # of the policy
    held: Any  # last command of a policy that acts less often than the vehicles are controlled; else None


@pytree
class _Flown:
    """A group's vehicles [U] after the control periods of a judging period."""

    state: GroupState
    parts: tuple[_Part, ...]
    done: tuple[jax.Array, ...]  # for each part: whether [U] the vehicle's part in the phase is done
    seen: tuple[RigidState, ...]  # where the detectors' rates were due


@dataclass(frozen=True)
class _Role:
    """What is known of a part while tracing."""

    number: int  # of the phase
    phase: Phase
    place: Place
    policy: Any
    period: int  # control periods between two calls
    waits: bool  # it was called before the judging period and is not called in it


def frame(world: World, plan: Plan, mission: MissionState) -> MissionState:
    """The mission one judging period later."""
    seen, collided = look_around(world, mission.world)
    mission = replace(mission, world=seen)
    mission = replace(mission, phases=ask(world, plan, mission))
    groups, phases = list(mission.world.groups), list(mission.phases)
    clock = mission.world.clock
    for number in range(len(groups)):
        roles = _roles(world, plan, number)
        mine = tuple(replace(phases[role.number], path=None) for role in roles)  # a branch would copy the paths
        go = partial(_group, world, plan, mission, number, roles, collided[number])
        groups[number], after = jax.lax.cond(clock.running[number], go, lambda *x: x, groups[number], mine)
        for role, phase in zip(roles, after, strict=True):
            phases[role.number] = replace(phase, path=phases[role.number].path)
    clock = replace(clock, tick=clock.tick + world.timing.judge_ticks)
    return replace(mission, phases=tuple(phases), world=replace(mission.world, groups=tuple(groups), clock=clock))


def _roles(world: World, plan: Plan, group: int) -> tuple[_Role, ...]:
    """The phases' parts in a group."""
    found = []
    for number, phase in enumerate(plan.phases):
        policy = policy_of(world, phase)
        period, waits = period_ticks(world, policy), at_frames(world, policy)
        found += [_Role(number, phase, p, policy, period, waits) for p in phase.places if p.group == group]
    return tuple(found)


def _group(
    world: World,
    plan: Plan,
    mission: MissionState,
    number: int,
    roles: Sequence[_Role],
    collided: jax.Array,
    before: GroupState,
    phases: tuple[PhaseState, ...],
) -> tuple[GroupState, tuple[PhaseState, ...]]:
    """A group and the phases that it has a part in, after the control periods of a judging period."""
    group, timing = world.groups[number], world.timing
    first = mission.world.clock.tick
    flown = _fly(world, plan, mission, number, roles, collided, before, phases)
    now = (first + timing.judge_ticks) * jnp.float32(timing.control_period_s)
    able, states = events.able(flown.state.event_time_s), list[PhaseState]()
    active = before.active
    for role, state, part, done in zip(roles, phases, flown.parts, flown.done, strict=True):
        done = done & able & (mission.phase_of[number] == role.number)
        active = active & ~(done & (before.around.height_m < RESTING_HEIGHT_M))
        local, rank = jnp.asarray(role.place.local), jnp.asarray(role.place.rank)
        done_s = state.done_s.at[rank].min(jnp.where(done[local], now, jnp.inf))
        states.append(replace(_with_part(state, role, part), done_s=done_s))
    after = replace(flown.state, active=active)
    if group.counter is not None and before.counter is not None:
        counter = _counted(world, group.counter, group, mission.world.key, first, flown)
        after = replace(after, counter=counter)
    return after, tuple(states)


def _fly(
    world: World,
    plan: Plan,
    mission: MissionState,
    number: int,
    roles: Sequence[_Role],
    collided: jax.Array,
    before: GroupState,
    phases: tuple[PhaseState, ...],
) -> _Flown:
    """The vehicles of a group, each by itself."""
    group, timing, first = world.groups[number], world.timing, mission.world.clock.tick
    reading = None if before.counter is None else before.counter.reading
    belief = shared_belief(plan, mission.belief)
    keys, now = tuple(phase_key(role.phase, mission.world.key) for role in roles), now_s(world, mission.world)

    def one(
        params: Any, limits: Limits, state: GroupState, collided: jax.Array, reading: Any, told: Any,
        member: jax.Array, in_phase: jax.Array, given: tuple[Any, ...], parts: tuple[_Part, ...],
    ) -> _Flown:  # fmt: skip
        state = record_events(world, group.kind, now, params, limits, state, collided)

        def view(state: GroupState, tick: jax.Array, latest: Any) -> View:
            own = view_of(group, params, limits.battery_j, state, latest, told)
            return replace(own, time_s=tick * jnp.float32(timing.control_period_s), belief=belief)

        def tick(carry: Any, _: None) -> tuple[Any, None]:
            step, state, parts, seen = carry
            at = first + step
            latest = None if reading is None else replace(reading, fresh=reading.fresh & (step == 0))
            known, commands, kept = view(state, at, latest), [], []
            for role, task, part, key in zip(roles, given, parts, keys, strict=True):
                follows = in_phase == role.number
                key = jax.random.fold_in(jax.random.fold_in(key, at), member)
                part, command = _act(role, task, part, known, key, at, follows)
                commands.append((follows, command))
                kept.append(part)
            command = chosen(group, params, state.vehicle, commands)
            state = with_move(state, move(world, group.kind, params, state, command))
            seen = _noted(group, first, at + 1, seen, state.vehicle.body)
            return (step + 1, state, tuple(kept), seen), None

        seen = tuple(state.vehicle.body for _ in range(_evaluations(group, timing.judge_ticks)))
        start = (jnp.int32(0), state, parts, seen)
        (_, state, parts, seen), _ = jax.lax.scan(tick, start, None, length=timing.judge_ticks)
        last = view(state, first + timing.judge_ticks, reading)
        done = tuple(_done(role, task, part, last) for role, task, part in zip(roles, given, parts, strict=True))
        return _Flown(state=state, parts=parts, done=done, seen=seen)

    # what a place leaves out is filled with a copy of one of its vehicles: a phase's arrays then have the group's size
    spread = [partial(_spread, group.size, role.place) for role in roles]
    given, parts = [], []
    for role, state, fill in zip(roles, phases, spread, strict=True):
        task = tasks(world, plan, role.phase, role.place, mission.phases[role.number].path)
        own = replace(task, settings=None, site=None, params=None)  # type: ignore[arg-type]
        given.append(replace(fill(own), settings=task.settings, site=task.site, params=group.params))
        held = None if state.held is None else fill(state.held[role.phase.places.index(role.place)])
        parts.append(_Part(memory=fill(rows(state.memory, role.place.rank)), held=held))
    every = over_vehicles(
        one, in_axes=(0, 0, 0, 0, 0, 0, 0, 0, (TASK_AXES,) * len(roles), 0), layout=world.layout, unroll=1
    )
    seen = replace(before, counter=None)  # the counter is of no concern to the motion
    flown: _Flown = every(
        group.params, group.limits, seen, collided, reading, heard_by(world, mission.world, number), group.member,
        mission.phase_of[number], tuple(given), tuple(parts),
    )  # fmt: skip
    return replace(flown, state=replace(flown.state, counter=before.counter))


def _spread(size: int, place: Place, tree: Any) -> Any:
    """Rows [m] of a place as rows [U] of its group; vehicles that are not in the place get those of its first."""
    if place.local == tuple(range(size)):
        return tree
    at = np.zeros(size, int)
    at[np.asarray(place.local)] = np.arange(len(place.local))
    return jax.tree.map(lambda x: jnp.take(x, at, axis=0), tree)


def _act(
    role: _Role, task: Any, part: _Part, view: View, key: jax.Array, tick: jax.Array, follows: jax.Array
) -> tuple[_Part, Any]:
    """A vehicle's part after a control period began, and its command in the phase."""
    if role.waits:
        return part, part.held

    def call(part: _Part) -> tuple[Any, Any]:
        memory, command = role.policy.act(task, part.memory, view, key)
        return jax.tree.map(partial(jnp.where, follows), memory, part.memory), jax.tree.map(jnp.asarray, command)

    if part.held is None:
        memory, command = call(part)
        return replace(part, memory=memory), command
    memory, command = jax.lax.cond(tick % role.period == 0, call, lambda p: (p.memory, p.held), part)
    return _Part(memory=memory, held=command), command


def _done(role: _Role, task: Any, part: _Part, view: View) -> jax.Array:
    """Whether [] a vehicle's part in a phase is done."""
    return role.policy.done(task, part.memory, view) if hasattr(role.policy, "done") else jnp.array(False)


def _with_part(state: PhaseState, role: _Role, part: _Part) -> PhaseState:
    """The phase with what its vehicles in one group carry."""
    if role.waits:
        return state
    local, held = role.place.local, state.held
    memory = set_rows(state.memory, role.place.rank, rows(part.memory, local))
    if held is not None:
        here = role.phase.places.index(role.place)
        held = (*held[:here], rows(part.held, local), *held[here + 1 :])
    return replace(state, memory=memory, held=held)


def _evaluations(group: Group, ticks: int) -> int:
    """How often a detector's rate can be due in so many control periods."""
    return 0 if group.counter is None else -(-ticks // group.counter.ticks)


def _noted(
    group: Group, first: jax.Array, tick: jax.Array, seen: tuple[RigidState, ...], body: RigidState
) -> tuple[RigidState, ...]:
    """Where the rates were due since control period ``first``, after control period ``tick``."""
    if group.counter is None:
        return seen
    ticks = group.counter.ticks
    due, place = tick % ticks == 0, tick // ticks - first // ticks - 1
    return tuple(jax.tree.map(partial(jnp.where, due & (place == k)), body, before) for k, before in enumerate(seen))


def _counted(
    world: World,
    counter: Counter,
    group: Group,
    key: jax.Array,
    first: jax.Array,
    flown: _Flown,
) -> CounterState:
    """The group's counters with the evaluations of a judging period that began after control period ``first``."""
    timing, state = world.timing, flown.state.counter
    assert state is not None
    measuring = flown.state.active & events.able(flown.state.event_time_s)
    state = unread(state)
    for place, body in enumerate(flown.seen):
        tick = (first // counter.ticks + 1 + place) * counter.ticks
        state = count(
            counter, state, body, measuring, group.member, world.site, world.sources, key, tick,
            timing.control_period_s, tick <= first + timing.judge_ticks,
        )  # fmt: skip
    return state


__all__ = ["frame"]
