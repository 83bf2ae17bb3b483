"""What the policies of a mission are given: views of the vehicles, their tasks, and keys."""

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
from swarmsim.missions.state import MissionState, PhaseState, Sensing
from swarmsim.policies.follow import FollowByAir, FollowByGround
from swarmsim.policies.view import Belief, Task, View
from swarmsim.scalars import over_vehicles
from swarmsim.sensors.radiation import Reading
from swarmsim.sensors.suite import Readings
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import Group, World
from swarmsim.world.radio import Heard, heard
from swarmsim.world.sensing import Sensed, Sensors, by_group, sense
from swarmsim.world.state import GroupState, WorldState, now_s


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


def set_rows(tree: Any, indices: Sequence[int], values: Any) -> Any:
    """Every array with its rows ``indices`` replaced by those of ``values``."""
    leaves = jax.tree.leaves(tree)
    if leaves and tuple(indices) == tuple(range(leaves[0].shape[0])):
        return values
    index = np.asarray(indices)
    return jax.tree.map(lambda x, v: x.at[index].set(v), tree, values)


def view_of(
    group: Group, params: Any, battery_j: jax.Array, g: GroupState, reading: Reading | None, told: Heard | None,
    sensors: Readings | None,
) -> View:  # fmt: skip
    """What one vehicle knows, but for the time and the team's belief; arguments are its rows of the group's."""
    body, around = g.vehicle.body, g.around
    return View(
        time_s=None,  # type: ignore[arg-type]
        position_m=body.position_m,
        quaternion=body.quaternion,
        velocity_m_s=body.velocity_m_s,
        angular_velocity_rad_s=body.angular_velocity_rad_s,
        battery=1.0 - g.vehicle.energy_j / battery_j,
        height_m=KINDS[group.kind].height(params, g.vehicle, around.ground),
        hold=around.hold,
        push_m=around.push_m,
        nearest_m=around.nearest_m,
        reading=reading,
        heard=told,
        belief=None,
        sensors=sensors,
    )


def shared_belief(plan: Plan, belief: Any) -> Belief | None:
    """The team's belief as policies see it."""
    return None if belief is None or plan.mapping is None else Belief(params=plan.mapping, binned=belief)


def heard_by(world: World, state: WorldState, number: int) -> Heard | None:
    """What the vehicles [U] of a group heard."""
    first = sum(group.size for group in world.groups[:number])
    return heard(world, state.radio, state.clock.tick, first, world.groups[number].size)


def views(world: World, plan: Plan, state: WorldState, belief: Any, sensing: Sensing | None) -> tuple[View, ...]:
    """What the vehicles of each group know; leading axis U on all but the time and the belief."""
    now = now_s(world, state)
    shared, made = shared_belief(plan, belief), []
    for number, (group, g) in enumerate(zip(world.groups, state.groups, strict=True)):
        reading, seen = None if g.counter is None else g.counter.reading, replace(g, counter=None)
        told = heard_by(world, state, number)
        sensors = None if sensing is None else sensing.readings[number]
        own = jax.vmap(partial(view_of, group))(group.params, group.limits.battery_j, seen, reading, told, sensors)
        made.append(replace(own, time_s=now, belief=shared))
    return tuple(made)


def sensing_of(world: World, sensors: Sensors, sensed: Sensed, state: WorldState) -> Sensing:
    """The team's navigation sensors after they were read in ``state``."""
    sensed, readings = sense(sensors, sensed, state)
    return Sensing(sensed=sensed, readings=by_group(sensors, world, readings))


_SHARED = ("time_s", "belief", "settings", "site", "known")  # of a view or a task: the same for all vehicles of a group


def _axes(cls: Any) -> Any:
    """The axes of a view or a task, in its own shape: integers stand where the arrays are."""
    return cls(**{name: None if name in _SHARED else 0 for name in cls.__dataclass_fields__})


VIEW_AXES = _axes(View)
"""Which parts of a group's view are each vehicle's own."""
TASK_AXES = _axes(Task)
"""Which parts of a phase's tasks are each vehicle's own."""


def view_rows(view: View, local: Sequence[int]) -> View:
    """The views of some vehicles of a group."""
    own = replace(view, time_s=None, belief=None)  # type: ignore[arg-type]
    return replace(rows(own, local), time_s=view.time_s, belief=view.belief)


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
        known=None if phase.plans else phase.task,
    )


def phase_key(phase: Phase, key: jax.Array) -> jax.Array:
    """Key of a phase's policy in a mission."""
    return randomness.consumer(key, f"policy {phase.name}")


def phase_keys(world: World, phase: Phase, place: Place, key: jax.Array, number: jax.Array) -> jax.Array:
    """Keys [m] of a phase's vehicles in one group, at one occasion."""
    member = jnp.asarray(world.groups[place.group].member)[np.asarray(place.local)]
    return randomness.per_vehicle(phase_key(phase, key), number, member)


def at_frames(world: World, policy: Any) -> bool:
    """Whether a policy is called at the beginning of judging periods only, and not between control periods."""
    period = period_ticks(world, policy)
    return period > 1 and period % world.timing.judge_ticks == 0


def ask(world: World, plan: Plan, mission: MissionState) -> tuple[PhaseState, ...]:
    """Phases after the policies that are called at the beginning of judging periods were, where it is time."""
    if not any(at_frames(world, policy_of(world, phase)) for phase in plan.phases):
        return mission.phases
    tick, phases = mission.world.clock.tick, []
    seen = views(world, plan, mission.world, mission.belief, mission.sensing)
    for number, (phase, state) in enumerate(zip(plan.phases, mission.phases, strict=True)):
        policy = policy_of(world, phase)
        if at_frames(world, policy):
            call = partial(_call, world, plan, number, policy, mission, seen)
            due = tick % period_ticks(world, policy) == 0
            memory, held = jax.lax.cond(due, call, lambda s: (s.memory, s.held), state)
            state = replace(state, memory=memory, held=held)
        phases.append(state)
    return tuple(phases)


def _call(
    world: World, plan: Plan, number: int, policy: Any, mission: MissionState, seen: tuple[View, ...], state: PhaseState
) -> tuple[Any, tuple[Any, ...]]:
    """Memory [M] and commands (for each place) of a phase's vehicles after a call of the policy."""
    phase, memory, commands = plan.phases[number], state.memory, []
    for place in phase.places:
        task = tasks(world, plan, phase, place, state.path)
        view = view_rows(seen[place.group], place.local)
        mine = rows(memory, place.rank)
        keys = phase_keys(world, phase, place, mission.world.key, mission.world.clock.tick)
        act = over_vehicles(policy.act, in_axes=(TASK_AXES, 0, VIEW_AXES, 0), layout=world.layout)
        after, command = act(task, mine, view, keys)
        inside = rows(mission.phase_of[place.group], place.local) == number
        memory = set_rows(memory, place.rank, jax.tree.map(partial(_where, inside), after, mine))
        commands.append(command)
    return memory, tuple(commands)


def _where(mask: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
    return jnp.where(mask.reshape(mask.shape + (1,) * (new.ndim - 1)), new, old)


def chosen(group: Group, params: Any, vehicle: Any, given: Sequence[tuple[jax.Array, Any]]) -> Any:
    """Full command of one vehicle: that of the phase that it is in; one in no phase stays where it is.

    ``given`` has for each phase of the group whether [] the vehicle is in it, and its command there.
    """
    kind = KINDS[group.kind]
    stay = kind.full_command(params, kind.stay(params, vehicle))
    options = [(mask, kind.full_command(params, command)) for mask, command in given]
    if any(type(command) is not type(stay) for _, command in options) and isinstance(stay, PositionCommand):
        full = partial(multirotor_command, rotors=params.rotor_spin.shape[-1])
        stay, options = full(stay), [(mask, full(command)) for mask, command in options]
    command = stay
    for mask, other in options:
        command = jax.tree.map(partial(jnp.where, mask), other, command)
    return command
