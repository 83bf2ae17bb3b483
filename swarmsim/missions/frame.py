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
    sensing_of,
    set_rows,
    shared_belief,
    tasks,
    view_of,
)
from swarmsim.missions.plan import Phase, Place, Plan
from swarmsim.missions.state import MissionState, PhaseState
from swarmsim.policies.view import Belief, Task, View
from swarmsim.pytree import pytree
from swarmsim.scalars import over_vehicles
from swarmsim.sensors.radiation import Reading
from swarmsim.sensors.suite import Readings, stale
from swarmsim.vehicles.state import RigidState
from swarmsim.world import events
from swarmsim.world.counting import counted, not_seen, noted
from swarmsim.world.emission import poses_of
from swarmsim.world.judge import look_around, record_events
from swarmsim.world.model import Group, Limits, World
from swarmsim.world.radio import Heard
from swarmsim.world.state import GroupState, now_s
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
    done_s: tuple[jax.Array, ...]  # for each part: when [U] the vehicle's part in the phase was done; inf: it is not
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
    seen, collided = look_around(world, mission.world, mission.world.clock.tick // world.timing.judge_ticks)
    mission = replace(mission, world=seen)
    mission = replace(mission, phases=ask(world, plan, mission))
    tick, running = mission.world.clock.tick, mission.world.clock.running
    before, phases = mission.world.groups, list(mission.phases)
    gone: list[_Flown] = []
    for number in range(len(before)):
        roles = _roles(world, plan, number)
        gone.append(_fly(world, plan, mission, number, roles, collided[number]))
        for role, part, done_s in zip(roles, gone[-1].parts, gone[-1].done_s, strict=True):
            phases[role.number] = _with_part(phases[role.number], role, part, done_s)
    poses = partial(poses_of, world.emission)
    carriers = poses([g.vehicle.body for g in before]), poses([flown.state.vehicle.body for flown in gone])
    groups = [
        counted(
            world, world.groups[number], mission.world.key, tick, world.timing.judge_ticks, running[number],
            before[number], flown.state, flown.seen, carriers=carriers,
        )
        for number, flown in enumerate(gone)
    ]  # fmt: skip
    clock = replace(mission.world.clock, tick=tick + world.timing.judge_ticks)
    after, sensing = replace(mission.world, groups=tuple(groups), clock=clock), mission.sensing
    if plan.sensors is not None and sensing is not None:
        sensing = sensing_of(world, plan.sensors, sensing.sensed, after)
    return replace(mission, phases=tuple(phases), world=after, sensing=sensing)


def _roles(world: World, plan: Plan, group: int) -> tuple[_Role, ...]:
    """The phases' parts in a group."""
    found = []
    for number, phase in enumerate(plan.phases):
        policy = policy_of(world, phase)
        period, waits = period_ticks(world, policy), at_frames(world, policy)
        found += [_Role(number, phase, p, policy, period, waits) for p in phase.places if p.group == group]
    return tuple(found)


def _fly(
    world: World, plan: Plan, mission: MissionState, number: int, roles: Sequence[_Role], collided: jax.Array
) -> _Flown:
    """The vehicles of a group, each by itself."""
    group, before, timing = world.groups[number], mission.world.groups[number], world.timing
    reading = None if before.counter is None else before.counter.reading
    sensors = None if mission.sensing is None else mission.sensing.readings[number]
    first, running = mission.world.clock.tick, mission.world.clock.running[number]
    shared = _Shared(
        first=first,
        now_s=now_s(world, mission.world),
        belief=shared_belief(plan, mission.belief),
        keys=tuple(phase_key(role.phase, mission.world.key) for role in roles),
    )
    given, parts = [], []
    for role in roles:
        phase = mission.phases[role.number]
        # what a place leaves out is filled with a copy of one of its vehicles: arrays then have the group's size
        fill = partial(_spread, group.size, role.place)
        task = tasks(world, plan, role.phase, role.place, phase.path)
        own = replace(task, settings=None, site=None, known=None, params=None)  # type: ignore[arg-type]
        shared_by_all = {"settings": task.settings, "site": task.site, "known": task.known}
        given.append(replace(fill(own), params=group.params, **shared_by_all))
        held = None if phase.held is None else fill(phase.held[role.phase.places.index(role.place)])
        parts.append(_Part(memory=fill(rows(phase.memory, role.place.rank)), held=held))

    def one(*vehicle: Any) -> _Flown:
        rests = partial(_rests, group, timing.judge_ticks)
        flies = partial(_one, world, group, roles, shared)
        return jax.lax.cond(running, flies, rests, *vehicle)  # inside, where a kernel branches at no cost

    every = over_vehicles(
        one, in_axes=(0, 0, 0, 0, 0, 0, 0, 0, 0, (TASK_AXES,) * len(roles), 0), layout=world.layout, unroll=1,
        returned=(2, 10),
    )  # fmt: skip
    seen = replace(before, counter=None)  # the counter is of no concern to the motion
    flown: _Flown = every(
        group.params, group.limits, seen, collided, reading, heard_by(world, mission.world, number), sensors,
        group.member, mission.phase_of[number], tuple(given), tuple(parts),
    )  # fmt: skip
    return flown


@pytree
class _Shared:
    """What all vehicles of a group share in a judging period."""

    first: jax.Array  # [] int32: control periods before it
    now_s: jax.Array  # [] at its beginning
    belief: Belief | None
    keys: tuple[jax.Array, ...]  # of the phases' policies


def _rests(group: Group, ticks: int, params: Any, limits: Limits, state: GroupState, *others: Any) -> _Flown:
    """One vehicle of a group that has no part in the mission now."""
    *_, parts = others
    never = tuple(jnp.float32(jnp.inf) for _ in parts)
    return _Flown(state=state, parts=parts, done_s=never, seen=not_seen(group, ticks, state.vehicle.body))


def _one(
    world: World, group: Group, roles: Sequence[_Role], shared: _Shared,
    params: Any, limits: Limits, state: GroupState, collided: jax.Array, reading: Reading | None, told: Heard | None,
    sensors: Readings | None, member: jax.Array, in_phase: jax.Array, given: tuple[Task, ...], parts: tuple[_Part, ...],
) -> _Flown:  # fmt: skip
    """One vehicle through the control periods of a judging period."""
    timing = world.timing
    period_s = jnp.float32(timing.control_period_s)
    state = record_events(world, group.kind, shared.now_s, params, limits, state, collided)

    def view(state: GroupState, tick: jax.Array, latest: Reading | None, sensors: Readings | None) -> View:
        aged = None if told is None else replace(told, age_s=told.age_s + (tick - shared.first) * period_s)
        own = view_of(group, params, limits.battery_j, state, latest, aged, sensors)
        return replace(own, time_s=tick * period_s, belief=shared.belief)

    def tick(carry: Any, _: None) -> tuple[Any, None]:
        step, state, parts, seen = carry
        at = shared.first + step
        latest = None if reading is None else replace(reading, fresh=reading.fresh & (step == 0))
        known, commands, kept = view(state, at, latest, stale(sensors, step > 0)), [], []
        for role, task, part, key in zip(roles, given, parts, shared.keys, strict=True):
            follows = in_phase == role.number
            key = jax.random.fold_in(jax.random.fold_in(key, at), member)
            part, command = _act(role, task, part, known, key, at, follows)
            commands.append((follows, command))
            kept.append(part)
        command = chosen(group, params, state.vehicle, commands)
        state = with_move(state, move(world, group.kind, params, state, command))
        seen = noted(group, shared.first, at + 1, seen, state.vehicle.body)
        return (step + 1, state, tuple(kept), seen), None

    start = (jnp.int32(0), state, parts, not_seen(group, timing.judge_ticks, state.vehicle.body))
    (_, state, parts, seen), _ = jax.lax.scan(tick, start, None, length=timing.judge_ticks)
    after = shared.first + timing.judge_ticks
    last, able = view(state, after, reading, stale(sensors, jnp.array(True))), events.able(state.event_time_s)
    active, done_s = state.active, []
    for role, task, part in zip(roles, given, parts, strict=True):
        done = _done(role, task, part, last) & able & (in_phase == role.number)
        active = active & ~(done & (state.around.height_m < RESTING_HEIGHT_M))
        done_s.append(jnp.where(done, after * period_s, jnp.inf))
    return _Flown(state=replace(state, active=active), parts=parts, done_s=tuple(done_s), seen=seen)


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


def _with_part(state: PhaseState, role: _Role, part: _Part, done_s: jax.Array) -> PhaseState:
    """The phase with what its vehicles in one group carry."""
    local, rank = role.place.local, role.place.rank
    done = jnp.minimum(rows(state.done_s, rank), rows(done_s, local))
    state = replace(state, done_s=set_rows(state.done_s, rank, done))
    if role.waits:
        return state
    memory, held = set_rows(state.memory, rank, rows(part.memory, local)), state.held
    if held is not None:
        here = role.phase.places.index(role.place)
        held = (*held[:here], rows(part.held, local), *held[here + 1 :])
    return replace(state, memory=memory, held=held)


__all__ = ["frame"]
