"""One vehicle of a mission that is flown outside: its measured pose goes in, the command of its policy comes out.

The rest of the team is simulated around it. Between two measurements it moves as its model does; what the simulation
would have happen to it (a crash, a failsafe) does not happen: that is for the real vehicle to tell.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.control.commands import DRIVE, DRIVE_TO, SkidSteerCommand
from swarmsim.control.skid_steer import pursue
from swarmsim.missions.acting import (
    TASK_AXES,
    VIEW_AXES,
    ask,
    at_frames,
    chosen,
    phase_keys,
    policy_of,
    rows,
    tasks,
    view_rows,
    views,
)
from swarmsim.missions.plan import Phase, Plan
from swarmsim.missions.segment import judged_frame
from swarmsim.missions.state import MissionState
from swarmsim.policies.follow import Progress
from swarmsim.policies.path import Path, reference
from swarmsim.pytree import pytree, static
from swarmsim.vehicles.state import RigidState
from swarmsim.world import events
from swarmsim.world.failsafes import no_rescue
from swarmsim.world.judge import look_around
from swarmsim.world.model import World

JOINED_AT = 256  # places along a path, of which the nearest to the vehicle is where it joins


@pytree
class Seat:
    """Which vehicle is the one outside."""

    group: int = static()
    local: int = static()  # its number in the group


@pytree
class Measured:
    """What is measured of the vehicle outside."""

    body: RigidState
    battery: jax.Array | float  # [] share of the capacity that is left


def external_frame(
    world: World, plan: Plan, mission: MissionState, seat: Seat, measured: Measured
) -> tuple[MissionState, jax.Array, Any]:
    """The mission one judging period later, its record, and the full command of the vehicle's policy at its beginning.

    The record is that of `swarmsim.missions.segment.judged_frame`.
    """
    mission = with_measured(world, mission, seat, measured)
    before = mission.world.groups[seat.group].event_time_s[seat.local]
    command = command_of(world, plan, mission, seat)
    mission, record = judged_frame(world, plan, mission)
    group = mission.world.groups[seat.group]
    group = replace(
        group,
        event_time_s=group.event_time_s.at[seat.local].set(before),
        finite=group.finite.at[seat.local].set(True),
        impact_m_s=group.impact_m_s.at[seat.local].set(0.0),
    )
    if group.around.rescue is not None:
        rescue = jax.tree.map(lambda x, own: x.at[seat.local].set(own), group.around.rescue, no_rescue())
        group = replace(group, around=replace(group.around, rescue=rescue))
    return _with_group(mission, seat.group, group), record, command


def lost(world: World, mission: MissionState, seat: Seat) -> MissionState:
    """The mission when its vehicle outside has no further part in it: for the rest of the team it lost the link."""
    group, now = mission.world.groups[seat.group], mission.world.clock.tick * world.timing.control_period_s
    times = group.event_time_s.at[seat.local, events.LINK_LOST].min(now)
    group = replace(group, event_time_s=times, active=group.active.at[seat.local].set(False))
    return _with_group(mission, seat.group, group)


def with_measured(world: World, mission: MissionState, seat: Seat, measured: Measured) -> MissionState:
    """The mission with the vehicle where it was measured."""
    group, k = mission.world.groups[seat.group], seat.local
    body = jax.tree.map(lambda x, own: x.at[k].set(own), group.vehicle.body, measured.body)
    capacity = world.groups[seat.group].limits.battery_j[k]
    energy = group.vehicle.energy_j.at[k].set((1.0 - measured.battery) * capacity)
    return _with_group(mission, seat.group, replace(group, vehicle=replace(group.vehicle, body=body, energy_j=energy)))


def command_of(world: World, plan: Plan, mission: MissionState, seat: Seat) -> Any:
    """The full command that the vehicle's policy gives at the beginning of the judging period.

    A rover's is a speed and a yaw rate, or wheel speeds: autopilots end a pursuit metres before the point pursued.
    """
    seen, _ = look_around(world, mission.world, mission.world.clock.tick // world.timing.judge_ticks)
    mission = replace(mission, world=seen)
    mission = replace(mission, phases=ask(world, plan, mission))
    group, state = world.groups[seat.group], mission.world.groups[seat.group]
    view = views(world, plan, mission.world, mission.belief, mission.sensing)[seat.group]
    given = []
    for number, phase in enumerate(plan.phases):
        place = next((p for p in phase.places if p.group == seat.group and seat.local in p.local), None)
        if place is None:
            continue
        here, policy = place.local.index(seat.local), policy_of(world, phase)
        held, memory = mission.phases[number].held, mission.phases[number].memory
        if at_frames(world, policy) and held is not None:
            command = rows(held[phase.places.index(place)], (here,))
        else:
            task = tasks(world, plan, phase, place, mission.phases[number].path)
            keys = phase_keys(world, phase, place, mission.world.key, mission.world.clock.tick)
            act = jax.vmap(policy.act, in_axes=(TASK_AXES, 0, VIEW_AXES, 0))
            every = act(task, rows(memory, place.rank), view_rows(view, place.local), keys)[1]
            command = rows(every, (here,))
        given.append((mission.phase_of[seat.group][seat.local] == number, jax.tree.map(lambda x: x[0], command)))
    params, vehicle = jax.tree.map(lambda x: x[seat.local], (group.params, state.vehicle))
    command = chosen(group, params, vehicle, given)
    return _driven(params, vehicle, command) if isinstance(command, SkidSteerCommand) else command


def _driven(params: Any, vehicle: Any, command: SkidSteerCommand) -> SkidSteerCommand:
    """The command with a pursuit as the speed and the turn that our own controller makes of it."""
    speed, turn = pursue(params, vehicle, command.position_m, command.speed_m_s)
    pursues = command.level == DRIVE_TO
    return replace(
        command,
        level=jnp.where(pursues, DRIVE, command.level),
        speed_m_s=jnp.where(pursues, jnp.maximum(speed, 0.0), command.speed_m_s),
        yaw_rate_rad_s=jnp.where(pursues, turn, command.yaw_rate_rad_s),
    )


def joined(plan: Plan, mission: MissionState, seat: Seat, here: jax.Array, within_m: jax.Array) -> MissionState:
    """The mission with the vehicle's references where its paths pass ``here`` [3]: it took off by other means.

    Looked for along the next ``within_m`` [] of each path: what it has flown of it already stays flown.
    """
    phases = list(mission.phases)
    for number, phase in enumerate(plan.phases):
        state, rank = phases[number], rank_of(phase, seat)
        if rank is None or state.path is None or not isinstance(state.memory, Progress):
            continue
        path = jax.tree.map(lambda x, rank=rank: x[rank], state.path)
        progress = state.memory.progress_m.at[rank].set(_nearest(path, state.memory.progress_m[rank], here, within_m))
        phases[number] = replace(state, memory=replace(state.memory, progress_m=progress))
    return replace(mission, phases=tuple(phases))


def _nearest(path: Path, from_m: jax.Array, place_m: jax.Array, within_m: jax.Array) -> jax.Array:
    arc = from_m + jnp.linspace(0.0, 1.0, JOINED_AT) * jnp.clip(path.length_m - from_m, 0.0, within_m)
    apart = jax.vmap(lambda s: reference(path, s).position_m)(arc) - place_m
    return arc[jnp.argmin(jnp.sum(apart * apart, axis=1))]


def rank_of(phase: Phase, seat: Seat) -> int | None:
    """The vehicle's number among those of the phase; None where it has no part in it."""
    for place in phase.places:
        if place.group == seat.group and seat.local in place.local:
            return place.rank[place.local.index(seat.local)]
    return None


def _with_group(mission: MissionState, number: int, group: Any) -> MissionState:
    groups = tuple(group if i == number else other for i, other in enumerate(mission.world.groups))
    return replace(mission, world=replace(mission.world, groups=groups))


__all__ = ["Measured", "Seat", "command_of", "external_frame", "joined", "lost", "rank_of", "with_measured"]
