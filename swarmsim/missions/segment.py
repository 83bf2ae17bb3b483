"""One segment of a mission: from one decision to the next, and what was decided."""

import itertools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.estimation import Measurements, extract_hotspots, recursive_map
from swarmsim.estimation.windows import gather
from swarmsim.missions.frame import frame
from swarmsim.missions.plan import Phase, Plan, Trigger
from swarmsim.missions.state import NO_PHASE, Log, MissionState, PhaseState, Sampled, Signals, Track
from swarmsim.missions.trail import followed
from swarmsim.sensors.radiation import Counter
from swarmsim.world import events
from swarmsim.world.model import Timing, World
from swarmsim.world.state import moving, now_s


def segment(world: World, plan: Plan, mission: MissionState) -> tuple[MissionState, Log, Signals]:
    """Run one mission for one decision period, then decide which phases end and begin.

    The policies see what the team knew at the beginning of the period; what was counted in it is added at its end.
    """
    timing = world.timing

    def judged(moving: MissionState, _: None) -> tuple[MissionState, jax.Array]:
        after, record = judged_frame(world, plan, _whole(mission, moving))
        return _moving(after), record

    # one loop, or the arrays that all passes share would be copied at the beginning of every inner one
    passes = timing.decision_ticks // timing.judge_ticks
    moved, record = jax.lax.scan(judged, _moving(mission), None, length=passes)
    return decided(world, plan, _whole(mission, moved), record)


def judged_frame(world: World, plan: Plan, mission: MissionState) -> tuple[MissionState, jax.Array]:
    """The mission one judging period later, and the record of that period for `decided`."""
    began = now_s(world, mission.world)
    mission = frame(world, plan, mission)
    return mission, _packed((_poses(mission), _samples(mission, began + 0.5 * world.timing.control_period_s)))


def decided(
    world: World, plan: Plan, mission: MissionState, record: jax.Array
) -> tuple[MissionState, Log, Signals]:  # fmt: skip
    """What is learned and decided at the end of a decision period; ``record`` has a row for each judging period."""
    timing = world.timing
    period_s = jnp.float32(timing.control_period_s)
    every, logs = timing.log_ticks // timing.judge_ticks, timing.decision_ticks // timing.log_ticks
    first = mission.world.clock.tick - timing.decision_ticks
    tracks, samples = _unpacked(record, jax.eval_shape(lambda: (_poses(mission), _samples(mission, period_s))))
    tracks = jax.tree.map(lambda x: x[every - 1 :: every], tracks)
    mission = _learned(world, plan, mission, samples)
    runs = [jnp.isfinite(phase.began_s) & ~jnp.isfinite(phase.ended_s) for phase in mission.phases]
    mission = replace(mission, trail=followed(world, mission.trail, mission.world, jnp.any(jnp.stack(runs))))
    mission, signals = decide(world, plan, mission)
    ends = first + timing.log_ticks * (1 + jnp.arange(logs))
    samples = tuple(
        None if s is None or g.counter is None else _ended_within(s, g.counter, world.timing, first)
        for s, g in zip(samples, world.groups, strict=True)
    )
    return mission, Log(time_s=ends * period_s, tracks=tracks, samples=samples), signals


def _packed(tree: Any) -> jax.Array:
    """All that is logged at a time, in one array: a loop writes each array of its record by itself."""
    return jnp.concatenate([x.reshape(-1).astype(jnp.float32) for x in jax.tree.leaves(tree)])


def _unpacked(record: jax.Array, tree: Any) -> Any:
    """What was packed, with the leading axis of times; ``tree`` has the shapes and types at one time."""
    leaves, structure = jax.tree.flatten(tree)
    ends = [0, *itertools.accumulate(leaf.size for leaf in leaves)]
    parts = [
        record[:, first:last].reshape(-1, *leaf.shape).astype(leaf.dtype)
        for first, last, leaf in zip(ends, ends[1:], leaves, strict=False)
    ]
    return jax.tree.unflatten(structure, parts)


def _moving(mission: MissionState) -> MissionState:
    """The mission without what decisions alone change: a loop would copy it from pass to pass."""
    phases = tuple(replace(phase, path=None) for phase in mission.phases)
    return replace(mission, phases=phases, phase_of=(), belief=None, windows=(), survey=None, trail=None)


def _whole(mission: MissionState, moving: MissionState) -> MissionState:
    """The mission with what moves in it."""
    phases = tuple(replace(new, path=old.path) for new, old in zip(moving.phases, mission.phases, strict=True))
    return replace(mission, phases=phases, world=moving.world, sensing=moving.sensing)


def _poses(mission: MissionState) -> tuple[Track, ...]:
    return tuple(
        Track(
            position_m=g.vehicle.body.position_m,
            quaternion=g.vehicle.body.quaternion,
            velocity_m_s=g.vehicle.body.velocity_m_s,
            energy_j=g.vehicle.energy_j,
            active=g.active | (g.around.rides & ~jnp.isfinite(mission.over_s)),
        )
        for g in mission.world.groups
    )


def _samples(mission: MissionState, after_s: jax.Array) -> tuple[Sampled | None, ...]:
    """Exposures that ended after ``after_s`` []."""
    found: list[Sampled | None] = []
    for g in mission.world.groups:
        if g.counter is None:
            found.append(None)
            continue
        reading = g.counter.reading
        found.append(
            Sampled(
                time_s=reading.time_s,
                position_m=reading.position_m,
                travel_m=reading.travel_m,
                axis=reading.axis,
                counts=reading.counts,
                exposure_s=reading.exposure_s,
                rois=reading.rois,
                new=reading.valid & (reading.time_s > after_s),
            )
        )
    return tuple(found)


def _ended_within(sampled: Sampled, counter: Counter, timing: Timing, first: jax.Array) -> Sampled:
    """The rows of a segment, which began after control period ``first`` [], in which exposures ended: E of the F.

    All counters of a group end their exposures together, after whole multiples of the exposure, so that the log needs
    no rows for the judging periods between.
    """
    exposure = counter.ticks * counter.evaluations
    at_most = -(-timing.decision_ticks // exposure)
    ends = (first // exposure + 1 + jnp.arange(at_most)) * exposure - first  # control periods into the segment, from 1
    rows = (ends - 1) // timing.judge_ticks
    inside = ends <= timing.decision_ticks
    kept = jax.tree.map(lambda x: jnp.take(x, rows, axis=0, mode="clip"), sampled)
    return replace(kept, new=kept.new & inside[:, None])


def _learned(world: World, plan: Plan, mission: MissionState, samples: tuple[Sampled | None, ...]) -> MissionState:
    """The mission with the segment's counts in its windows and in the team's belief."""
    windows, belief = list(mission.windows), mission.belief
    for number, (group, sampled) in enumerate(zip(world.groups, samples, strict=True)):
        if sampled is None or group.counter is None:
            continue
        held = windows[number]
        if held is not None:
            windows[number] = gather(held, _measurements(sampled), sampled.new, plan.per_window[number])
        if belief is not None and plan.mapping is not None:
            reference, own = (plan.detectors[k].background_cps for k in (0, group.counter.index))
            size = jnp.where(reference > 0.0, own / jnp.maximum(reference, 1e-9), 1.0)
            flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), sampled)
            belief = recursive_map.update(
                plan.mapping, belief, flat.position_m, flat.counts, flat.exposure_s, flat.new,
                jnp.broadcast_to(size, flat.counts.shape),
            )  # fmt: skip
    return replace(mission, windows=tuple(windows), belief=belief)


def _measurements(sampled: Sampled) -> Measurements:
    return Measurements(
        time_s=sampled.time_s,
        position_m=sampled.position_m,
        travel_m=sampled.travel_m,
        axis=sampled.axis,
        counts=sampled.counts,
        exposure_s=sampled.exposure_s,
        rois=sampled.rois,
        valid=sampled.new,
        detector=jnp.zeros(sampled.counts.shape, jnp.int32),
    )


def decide(world: World, plan: Plan, mission: MissionState) -> tuple[MissionState, Signals]:
    """End phases, tell which ones are to begin, and whether the mission is over."""
    now = now_s(world, mission.world)
    hotspot = _hotspot_known(plan, mission)
    states = [_ended(world, plan, mission, number, now, hotspot) for number in range(len(plan.phases))]
    phase_of = list(mission.phase_of)
    for number, (phase, state) in enumerate(zip(plan.phases, states, strict=True)):
        for place in phase.places:
            leaves = jnp.isfinite(state.ended_s) & (phase_of[place.group] == number)
            phase_of[place.group] = jnp.where(leaves, NO_PHASE, phase_of[place.group])
    waiting = [~jnp.isfinite(state.began_s) for state in states]
    first = [
        wait & (now >= _trigger_time(phase.start, phase.start_s, states, hotspot, now))
        for phase, wait, state in zip(plan.phases, waiting, states, strict=True)
    ]
    again = [_ask_again(world, phase, state, now) for phase, state in zip(plan.phases, states, strict=True)]
    running = [~w & ~jnp.isfinite(s.ended_s) for w, s in zip(waiting, states, strict=True)]
    to_come = [
        w & jnp.isfinite(_trigger_time(p.start, p.start_s, states, hotspot, now))
        for p, w in zip(plan.phases, waiting, strict=True)
    ]
    over = ~jnp.any(jnp.stack([*running, *to_come]))
    over_s = jnp.where(over, jnp.minimum(mission.over_s, _last_end(states, now)), mission.over_s)
    groups = tuple(replace(g, active=g.active & ~over) for g in mission.world.groups)
    mission = replace(
        mission,
        phases=tuple(states),
        phase_of=tuple(phase_of),
        over_s=over_s,
        world=replace(mission.world, groups=groups),
    )
    begin = jnp.stack([(f | a) & ~over for f, a in zip(first, again, strict=True)])
    active = jnp.stack([jnp.any(moving(g)) & ~over for g in groups])
    return mission, Signals(begin=begin, running=jnp.stack(running), active=active, over=over)


def _hotspot_known(plan: Plan, mission: MissionState) -> jax.Array:
    """Whether [] the belief shows a hotspot; asked only if a phase waits for one."""
    triggers = [t for phase in plan.phases for t in (phase.start, phase.end) if t is not None]
    if not any(t.kind == "when" for t in triggers) or plan.mapping is None or mission.belief is None:
        return jnp.array(False)
    chart = recursive_map.read(plan.mapping, mission.belief)
    return extract_hotspots(plan.mapping, chart).valid[0]


def _trigger_time(
    trigger: Trigger, seconds: jax.Array, states: list[PhaseState], hotspot: jax.Array, now: jax.Array
) -> jax.Array:
    """When [] a trigger fires, as far as it is known now; inf: it depends on what has not happened."""
    if trigger.kind == "at":
        return seconds
    if trigger.kind == "after":
        return states[trigger.phase].ended_s + seconds
    return jnp.where(hotspot, now, jnp.inf) + seconds


def _ended(
    world: World, plan: Plan, mission: MissionState, number: int, now: jax.Array, hotspot: jax.Array
) -> PhaseState:
    """The phase, ended if each of its vehicles is done or lost, or its time is up, or its end was triggered."""
    phase, state = plan.phases[number], mission.phases[number]
    lost_s, taken = jnp.full(phase.size, jnp.inf), jnp.zeros(phase.size, bool)
    for place in phase.places:
        local, rank = jnp.asarray(place.local), jnp.asarray(place.rank)
        group = mission.world.groups[place.group]
        times = group.event_time_s[local]
        first = jnp.min(times[:, : len(events.LOSSES)], axis=-1)
        first = jnp.where(events.rescued(times) & ~group.active[local], jnp.minimum(first, now), first)
        lost_s = lost_s.at[rank].set(first)
        taken = taken.at[rank].set(mission.phase_of[place.group][local] != number)
    part_s = jnp.minimum(state.done_s, lost_s)
    part_s = jnp.where(taken & ~jnp.isfinite(part_s), now, part_s)
    complete = jnp.all(jnp.isfinite(part_s))
    late = now - state.began_s >= phase.time_limit_s
    cut = late
    if phase.end is not None:
        cut = cut | (now >= _trigger_time(phase.end, phase.end_s, list(mission.phases), hotspot, now))
    ends = jnp.isfinite(state.began_s) & ~jnp.isfinite(state.ended_s) & (complete | cut)
    when = jnp.where(complete, jnp.maximum(jnp.max(part_s), state.began_s), now)
    return replace(
        state,
        ended_s=jnp.where(ends, when, state.ended_s),
        in_time=state.in_time & ~(ends & late & ~complete),
    )


def _ask_again(world: World, phase: Phase, state: PhaseState, now: jax.Array) -> jax.Array:
    """Whether [] a planner with a period is to be asked again."""
    period = getattr(phase.policy.object, "period_s", None) if phase.plans else None
    if not period:
        return jnp.array(False)
    running = jnp.isfinite(state.began_s) & ~jnp.isfinite(state.ended_s)
    return running & (now - state.asked_s >= period - 0.5 * world.timing.control_period_s)


def _last_end(states: list[PhaseState], now: jax.Array) -> jax.Array:
    """When [] the last phase ended."""
    ends = jnp.stack([state.ended_s for state in states])
    ended = jnp.isfinite(ends)
    return jnp.where(jnp.any(ended), jnp.max(jnp.where(ended, ends, 0.0)), now)


__all__ = ["decide", "decided", "judged_frame", "segment"]
