"""Policies in the loop: views of the vehicles, calls of their policies, and the commands of every group."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim import randomness
from swarmsim.control.commands import PositionCommand, multirotor_command
from swarmsim.missions.plan import Phase, Place, Plan
from swarmsim.missions.state import MissionState, PhaseState
from swarmsim.policies.follow import FollowByAir, FollowByGround
from swarmsim.policies.view import Belief, Task, View
from swarmsim.scalars import over_vehicles
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import World
from swarmsim.world.radio import heard
from swarmsim.world.state import WorldState


def policy_of(world: World, phase: Phase) -> Any:
    """The policy that the phase's vehicles run: its own, or the follower of a planner's paths."""
    if not phase.plans:
        return phase.policy.object
    flies = KINDS[world.groups[phase.places[0].group].kind].FLIES
    follower = FollowByAir if flies else FollowByGround
    return follower(control_period_s=world.timing.control_period_s)


def period_ticks(world: World, policy: Any) -> int:
    """Control periods between two calls of a policy."""
    return max(1, round((getattr(policy, "period_s", None) or 0.0) / world.timing.control_period_s))


def rows(tree: Any, indices: Sequence[int], axis: int = 0) -> Any:
    """Rows ``indices`` of every array; the whole where they are all rows in order."""
    size = jax.tree.leaves(tree)[0].shape[axis] if jax.tree.leaves(tree) else 0
    if tuple(indices) == tuple(range(size)):
        return tree
    index = np.asarray(indices)
    return jax.tree.map(lambda x: jnp.take(x, index, axis=axis), tree)


def views(world: World, plan: Plan, state: WorldState, belief: Any) -> tuple[View, ...]:
    """What the vehicles of each group know; leading axis U on all but the time and the belief."""
    now = state.clock.tick * jnp.float32(world.timing.control_period_s)
    shared = None if belief is None or plan.mapping is None else Belief(params=plan.mapping, binned=belief)
    made, first = [], 0
    for group, g in zip(world.groups, state.groups, strict=True):
        kind = KINDS[group.kind]
        body, around = g.vehicle.body, g.around
        made.append(
            View(
                time_s=now,
                position_m=body.position_m,
                quaternion=body.quaternion,
                velocity_m_s=body.velocity_m_s,
                angular_velocity_rad_s=body.angular_velocity_rad_s,
                battery=1.0 - g.vehicle.energy_j / group.limits.battery_j,
                height_m=jax.vmap(kind.height)(group.params, g.vehicle, around.ground),
                hold=around.hold,
                push_m=around.push_m,
                nearest_m=around.nearest_m,
                reading=None if g.counter is None else g.counter.reading,
                heard=heard(world, state.radio, first, group.size),
                belief=shared,
            )
        )
        first += group.size
    return tuple(made)


_SHARED = ("time_s", "belief", "settings", "site")  # of a view or a task: the same for all vehicles of a group


def _axes(cls: Any) -> Any:
    """The axes of a view or a task, in its own shape: integers stand where the arrays are."""
    return cls(**{name: None if name in _SHARED else 0 for name in cls.__dataclass_fields__})


VIEW_AXES = _axes(View)
"""Which parts of a group's view are each vehicle's own."""
TASK_AXES = _axes(Task)
"""Which parts of a phase's tasks are each vehicle's own."""


def tasks(world: World, plan: Plan, phase: Phase, place: Place, path: Any) -> Task:
    """Tasks of a phase's vehicles in one group; axes as `TASK_AXES`."""
    return Task(
        settings=phase.settings,
        site=plan.site,
        home_m=rows(phase.home_m, place.rank),
        yaw_rad=rows(phase.yaw_rad, place.rank),
        params=rows(world.groups[place.group].params, place.local),
        rank=jnp.asarray(place.rank, jnp.int32),
        path=None if path is None else rows(path, place.rank),
    )


def phase_keys(world: World, phase: Phase, place: Place, key: jax.Array, number: jax.Array) -> jax.Array:
    """Keys [m] of a phase's vehicles in one group, at one occasion."""
    member = jnp.asarray(world.groups[place.group].member)[np.asarray(place.local)]
    return randomness.per_vehicle(randomness.consumer(key, f"policy {phase.name}"), number, member)


def act(
    world: World, plan: Plan, mission: MissionState, seen: tuple[View, ...]
) -> tuple[tuple[PhaseState, ...], tuple[Any, ...]]:
    """Phases after their policies were called, where it is time, and the commands of every group."""
    tick = mission.world.clock.tick
    phases: list[PhaseState] = []
    given: list[list[tuple[jax.Array, Any]]] = [[] for _ in world.groups]
    for number, (phase, state) in enumerate(zip(plan.phases, mission.phases, strict=True)):
        policy = policy_of(world, phase)
        call = partial(_call, world, plan, phase, policy, number, mission, seen)
        period = period_ticks(world, policy)
        if state.held is None:
            memory, commands = call(state)
        else:
            held = state.held
            memory, commands = jax.lax.cond(tick % period == 0, call, lambda s, held=held: (s.memory, held), state)
            state = replace(state, held=commands)
        phases.append(replace(state, memory=memory))
        for place, command in zip(phase.places, commands, strict=True):
            follows = mission.phase_of[place.group] == number
            given[place.group].append((follows, _placed(world, place, command)))
    chosen = tuple(_chosen(world, i, mission.world, each) for i, each in enumerate(given))
    return tuple(phases), chosen


def _call(
    world: World, plan: Plan, phase: Phase, policy: Any, number: int, mission: MissionState, seen: tuple[View, ...],
    state: PhaseState,
) -> tuple[Any, tuple[Any, ...]]:  # fmt: skip
    """Memory [M] and commands (for each place) of a phase's vehicles after a call of the policy."""
    memory, commands = state.memory, []
    for place in phase.places:
        task = tasks(world, plan, phase, place, state.path)
        view = _rows_of_view(seen[place.group], place.local)
        mine = rows(memory, place.rank)
        keys = phase_keys(world, phase, place, mission.world.key, mission.world.clock.tick)
        act = over_vehicles(policy.act, in_axes=(TASK_AXES, 0, VIEW_AXES, 0), layout=world.layout)
        after, command = act(task, mine, view, keys)
        inside = rows(mission.phase_of[place.group], place.local) == number
        kept = jax.tree.map(partial(_where, inside), after, mine)
        memory = _set_rows(memory, place.rank, kept)
        commands.append(command)
    return memory, tuple(commands)


def _rows_of_view(view: View, local: Sequence[int]) -> View:
    own = replace(view, time_s=None, belief=None)  # type: ignore[arg-type]
    return replace(rows(own, local), time_s=view.time_s, belief=view.belief)


def _where(mask: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
    return jnp.where(mask.reshape(mask.shape + (1,) * (new.ndim - 1)), new, old)


def _set_rows(tree: Any, indices: Sequence[int], values: Any) -> Any:
    leaves = jax.tree.leaves(tree)
    if leaves and tuple(indices) == tuple(range(leaves[0].shape[0])):
        return values
    index = np.asarray(indices)
    return jax.tree.map(lambda x, v: x.at[index].set(v), tree, values)


def _placed(world: World, place: Place, command: Any) -> Any:
    """The commands of a phase's vehicles [m] at their places in the group [U]; other rows repeat the first."""
    size = world.groups[place.group].size
    if place.local == tuple(range(size)):
        return command
    at = np.zeros(size, int)
    at[np.asarray(place.local)] = np.arange(len(place.local))
    return jax.tree.map(lambda x: jnp.take(x, at, axis=0), command)


def _chosen(world: World, number: int, state: WorldState, given: list[tuple[jax.Array, Any]]) -> Any:
    """Commands of a group: each vehicle's by the phase that it is in; one in no phase stays where it is."""
    group = world.groups[number]
    kind = KINDS[group.kind]
    stay = jax.vmap(kind.stay)(group.params, state.groups[number].vehicle)
    options = [(mask, _full(kind, group.params, command)) for mask, command in given]
    if any(type(command) is not type(stay) for _, command in options) and isinstance(stay, PositionCommand):
        rotors = group.params.rotor_spin.shape[-1]
        full = jax.vmap(partial(multirotor_command, rotors=rotors))
        stay, options = full(stay), [(mask, full(command)) for mask, command in options]
    chosen = stay
    for mask, command in options:
        chosen = jax.tree.map(partial(_where, mask), command, chosen)
    return chosen


def _full(kind: Any, params: Any, command: Any) -> Any:
    size = jax.tree.leaves(params)[0].shape[0]
    every = jax.tree.map(lambda x: x if jnp.ndim(x) else jnp.full(size, x, jnp.float32), command)
    one = jax.tree.map(lambda x: x[0], params)
    return jax.vmap(partial(kind.full_command, one))(every)
