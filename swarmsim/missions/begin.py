"""The beginning of a mission and of its phases."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.estimation import extract_hotspots, recursive_map
from swarmsim.estimation.windows import windows_start
from swarmsim.missions import knowledge
from swarmsim.missions.acting import (
    TASK_AXES,
    VIEW_AXES,
    period_ticks,
    phase_keys,
    policy_of,
    rows,
    sensing_of,
    tasks,
    view_rows,
    views,
)
from swarmsim.missions.plan import Phase, Plan
from swarmsim.missions.state import NO_PHASE, MissionState, PhaseState, Signals
from swarmsim.missions.trail import trail_start
from swarmsim.policies.path import Path
from swarmsim.policies.protocol import Situation
from swarmsim.world import events
from swarmsim.world.model import World
from swarmsim.world.sensing import switch_on
from swarmsim.world.state import now_s
from swarmsim.world.step import reset


def begin_mission(key: jax.Array, world: World, plan: Plan) -> tuple[MissionState, Signals]:
    """Every vehicle at rest at its start, no phase begun."""
    state = reset(world, key, active=False)
    windows = tuple(
        windows_start(group.size, size, group.counter.detector.background_rois.shape[0])
        if size and group.counter is not None
        else None
        for group, size in zip(world.groups, plan.windows, strict=True)
    )
    mission = MissionState(
        world=state,
        phases=(),
        phase_of=tuple(jnp.full(group.size, NO_PHASE, jnp.int32) for group in world.groups),
        belief=None if plan.mapping is None else recursive_map.start(plan.mapping, plan.bin_cells),
        windows=windows,
        survey=knowledge.nothing_learned(world, plan, windows, key),
        over_s=jnp.asarray(jnp.inf, jnp.float32),
        sensing=None
        if plan.sensors is None
        else sensing_of(world, plan.sensors, switch_on(plan.sensors, state), state),
        trail=trail_start(world, state, plan.trail) if plan.trail else None,
    )
    seen = views(world, plan, state, mission.belief, mission.sensing)
    mission = replace(mission, phases=tuple(_idle(world, plan, phase, mission, seen) for phase in plan.phases))
    begin = jnp.stack([jnp.asarray((phase.start.kind == "at") & (phase.start_s <= 0.0)) for phase in plan.phases])
    active = jnp.zeros(len(world.groups), bool)
    running = jnp.zeros(len(plan.phases), bool)
    return mission, Signals(begin=begin, running=running, active=active, over=jnp.array(False))


def _idle(world: World, plan: Plan, phase: Phase, mission: MissionState, seen: Any) -> PhaseState:
    """A phase that has not begun: its arrays have their sizes, their contents are not looked at."""
    never = jnp.asarray(jnp.inf, jnp.float32)
    path = None
    if phase.plans:
        situation = _situation(world, phase, mission, jnp.zeros(2), jnp.array(False))
        shape = jax.eval_shape(lambda: phase.policy.object.plan(phase.task, plan.site, situation))
        path = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)
    policy = policy_of(world, phase)
    memory = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(lambda: _memory(world, plan, phase, mission, path))
    )
    held = None
    if period_ticks(world, policy) > 1:
        held = jax.tree.map(
            lambda x: jnp.zeros(x.shape, x.dtype),
            jax.eval_shape(lambda: _first_commands(world, plan, phase, mission, seen, path, memory)),
        )
    return PhaseState(
        began_s=never,
        asked_s=never,
        ended_s=never,
        done_s=jnp.full(phase.size, jnp.inf),
        in_time=jnp.array(True),
        memory=memory,
        held=held,
        path=path,
    )


def _memory(world: World, plan: Plan, phase: Phase, mission: MissionState, path: Path | None) -> Any:
    """Memories [M] at the beginning of the phase."""
    policy, parts, ranks = policy_of(world, phase), [], list[int]()
    for place in phase.places:
        task = tasks(world, plan, phase, place, path)
        keys = phase_keys(world, phase, place, mission.world.key, mission.world.clock.tick)
        parts.append(jax.vmap(policy.start, in_axes=(TASK_AXES, 0))(task, keys))
        ranks += place.rank
    order = jnp.argsort(jnp.asarray(ranks))
    return jax.tree.map(lambda *x: jnp.concatenate(x)[order], *parts)


def _first_commands(
    world: World, plan: Plan, phase: Phase, mission: MissionState, seen: Any, path: Path | None, memory: Any
) -> tuple[Any, ...]:
    policy, commands = policy_of(world, phase), []
    for place in phase.places:
        task = tasks(world, plan, phase, place, path)
        view = view_rows(seen[place.group], place.local)
        keys = phase_keys(world, phase, place, mission.world.key, mission.world.clock.tick)
        call = jax.vmap(policy.act, in_axes=(TASK_AXES, 0, VIEW_AXES, 0))
        commands.append(call(task, rows(memory, place.rank), view, keys)[1])
    return tuple(commands)


def begin_phase(world: World, plan: Plan, mission: MissionState, number: int) -> MissionState:
    """The mission with phase ``number`` begun now, or its planner asked again if it has begun already.

    One that goes to the source goes where the mission's survey has it.
    Its vehicles leave the phase that they were in. A vehicle whose part in the mission has ended stays out.
    """
    phase, state = plan.phases[number], mission.phases[number]
    now = now_s(world, mission.world)
    target, found = _target(plan, phase, mission)
    path = state.path
    if phase.plans:
        situation = _situation(world, phase, mission, target, found)
        path = phase.policy.object.plan(phase.task, plan.site, situation)
    groups, phase_of = list(mission.world.groups), list(mission.phase_of)
    for place in phase.places:
        local = jnp.asarray(place.local)
        group = groups[place.group]
        times = group.event_time_s[local]
        flies_home = group.active[local] & events.rescued(times)
        active = group.active.at[local].set(events.able(times) | flies_home)
        groups[place.group] = replace(group, active=active)
        phase_of[place.group] = phase_of[place.group].at[local].set(number)
    mission = replace(mission, world=replace(mission.world, groups=tuple(groups)), phase_of=tuple(phase_of))
    begun = replace(
        state,
        began_s=jnp.minimum(state.began_s, now),
        asked_s=now,
        memory=_memory(world, plan, phase, mission, path),
        path=path,
    )
    phases = tuple(begun if i == number else other for i, other in enumerate(mission.phases))
    return replace(mission, phases=phases)


def _situation(world: World, phase: Phase, mission: MissionState, target_m: jax.Array, found: jax.Array) -> Situation:
    """Where the phase's vehicles are, in their order."""
    position = jnp.zeros((phase.size, 3))
    for place in phase.places:
        here = mission.world.groups[place.group].vehicle.body.position_m
        position = position.at[jnp.asarray(place.rank)].set(here[jnp.asarray(place.local)])
    return Situation(position_m=position, target_m=target_m, found=found)


def _target(plan: Plan, phase: Phase, mission: MissionState) -> tuple[jax.Array, jax.Array]:
    """The place [2] that the phase goes to, and whether [] there is one."""
    if phase.target == "source":
        assert mission.survey is not None
        return mission.survey.estimated.fits.position_m[0, :2], mission.survey.found
    if phase.target == "hotspot":
        assert plan.mapping is not None
        assert mission.belief is not None
        chart = recursive_map.read(plan.mapping, mission.belief)
        hotspots = extract_hotspots(plan.mapping, chart)
        return hotspots.position_m[0], hotspots.valid[0]
    return phase.target_m, jnp.array(phase.target == "point")
