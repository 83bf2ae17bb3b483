"""One step of one world: every vehicle of one mission, one control period.

Pure and without a host call, so that `jax.jit`, `jax.vmap`, `jax.lax.scan` and `jax.grad` work on it.
"""

from collections.abc import Callable, Sequence
from dataclasses import is_dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim import randomness
from swarmsim.device import either
from swarmsim.physics.wind import GUST_DRAWS, gust_noise, gust_scales, gust_start
from swarmsim.pytree import pytree
from swarmsim.scalars import over_vehicles
from swarmsim.sensors.radiation import counter_start
from swarmsim.vehicles.state import RigidState
from swarmsim.world import events
from swarmsim.world.counting import counted, not_seen, noted
from swarmsim.world.emission import poses_of
from swarmsim.world.failsafes import no_rescue
from swarmsim.world.judge import look_around, record_events
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import Group, Limits, World
from swarmsim.world.multirotor import ground_below, wall_beside
from swarmsim.world.radio import radio_start
from swarmsim.world.state import Clock, GroupState, Readings, Surroundings, WorldState, moving, now_s


def reset(world: World, key: jax.Array, *, active: bool = True) -> WorldState:
    """Every vehicle at rest at its start.

    Args:
        world: of one mission.
        key: randomness of the mission (`jax.random.key` of its seed).
        active: whether the vehicles have a part in the mission from the beginning; those that have none rest.
    """
    groups = tuple(_group_start(world, group, key, active) for group in world.groups)
    clock = Clock(tick=jnp.int32(0), running=jnp.ones(len(groups), bool))
    return WorldState(clock=clock, key=key, groups=groups, radio=radio_start(world, groups), crowded=jnp.array(False))


def _group_start(world: World, group: Group, key: jax.Array, active: bool) -> GroupState:
    kind = KINDS[group.kind]
    vehicle = jax.vmap(kind.rest, in_axes=(0, None, 0, 0))(group.params, world.site, group.start_m, group.yaw_rad)
    position = vehicle.body.position_m
    size = group.size
    draws = jax.random.normal(randomness.consumer(key, "gust start"), (GUST_DRAWS,))
    noise = gust_noise(draws, position, gust_scales(jnp.zeros(()), jnp.zeros(()))[1])
    motors = (size, kind.rotors(group.params)) if kind.FLIES else None
    around = Surroundings(
        ground=jax.vmap(ground_below, in_axes=(None, 0))(world.site, position),
        wall=jax.vmap(partial(wall_beside, world.site, world.walls))(position, group.limits.half_height_m),
        wind_m_s=jnp.zeros((size, 3)),
        gust=jax.vmap(gust_start)(noise),
        motor_noise=jnp.zeros(motors) if motors else None,
        height_m=jnp.zeros(size),
        rides=jnp.zeros(size, bool),
        hold=jnp.zeros(size, bool),
        push_m=jnp.zeros((size, 3)),
        nearest_m=jnp.full(size, jnp.inf, jnp.float32),
        rescue=jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), no_rescue()) if kind.FLIES else None,
    )
    memory = kind.control_start()
    return GroupState(
        vehicle=vehicle,
        control=jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), memory),
        around=around,
        active=jnp.full(size, active),
        impact_m_s=jnp.zeros(size),
        finite=jnp.ones(size, bool),
        event_time_s=jnp.broadcast_to(events.none_yet(), (size, len(events.KINDS))),
        counter=None if group.counter is None else counter_start(size, group.counter.detector.background_rois.shape[0]),
    )


def step(world: World, state: WorldState, commands: Sequence[Any], periods: int = 1) -> tuple[WorldState, Readings]:
    """The world one control period later, or a few under the same commands, and what its detectors read.

    Args:
        world: of one mission.
        state: at the start of the period.
        commands: one for each group, with leading axis U: a class of `swarmsim.control.commands` that suits its kind.
            Vehicles that are not active disregard it.
        periods: control periods that the commands are held for, at most those of a judging period. What judges the
            vehicles comes before the first of them; with one ``periods`` that divides a judging period throughout, the
            result is that of a call for each period, on a GPU in half the time or less.

    Returns:
        State and readings; ``fresh`` tells which exposures ended in these periods.

    Raises:
        TypeError, ValueError: while tracing, where a command does not suit its group, or ``periods`` are too many.
    """
    judging = world.timing.judge_ticks
    if not 1 <= periods <= judging:
        raise ValueError(
            f"periods is {periods}: commands can be held for 1 to {judging} control periods, which are a judging period"
        )
    first = state.clock.tick
    look = partial(look_around, world, state, (first + periods - 1) // judging)
    if periods == judging:
        due = jnp.array(True)
        state, collided = look()
    else:
        due = -first % judging < periods
        untouched = state, [jnp.zeros(group.size, bool) for group in world.groups]
        state, collided = either(due, look, lambda: untouched)
    go = partial(_go, world, state, due, periods)
    full = full_commands(world, commands)
    gone = [go(number, command, hit) for number, (command, hit) in enumerate(zip(full, collided, strict=True))]
    poses = partial(poses_of, world.emission)
    carriers = poses([g.vehicle.body for g in state.groups]), poses([g.vehicle.body for g, _ in gone])
    groups = tuple(
        counted(
            world, group, state.key, first, periods, state.clock.running[number], state.groups[number], *gone[number],
            branch=either, carriers=carriers,
        )
        for number, group in enumerate(world.groups)
    )  # fmt: skip
    clock = replace(state.clock, tick=first + periods)
    state = replace(state, clock=clock, groups=groups)
    return state, readings_of(state)


def readings_of(state: WorldState) -> Readings:
    """Latest reading of every group's detectors."""
    return tuple(None if g.counter is None else g.counter.reading for g in state.groups)


def hold(world: World, state: WorldState) -> tuple[Any, ...]:
    """Commands that keep every vehicle where it is: multirotors brake and hover, rovers stand."""
    return tuple(
        jax.vmap(KINDS[group.kind].stay)(group.params, g.vehicle)
        for group, g in zip(world.groups, state.groups, strict=True)
    )


def full_commands(world: World, commands: Sequence[Any]) -> tuple[Any, ...]:
    """Commands of all groups in the form that the step works on, their shapes checked."""
    if not isinstance(commands, Sequence):
        raise TypeError(f"commands are a sequence with one command for each group, not a {type(commands).__name__}")
    if len(commands) != len(world.groups):
        raise ValueError(f"there are {len(commands)} commands for {len(world.groups)} groups of vehicles")
    full = []
    for number, (group, command) in enumerate(zip(world.groups, commands, strict=True)):
        if not is_dataclass(command):
            raise TypeError(
                f"the command of group {number} is a {type(command).__name__}: it must be one of the classes of "
                "swarmsim.control.commands"
            )
        for name, leaf in vars(command).items():
            if jnp.ndim(leaf) and jnp.shape(leaf)[0] != group.size:
                raise ValueError(
                    f"{type(command).__name__}.{name} for group {number} has the shape {jnp.shape(leaf)}: the group "
                    f"has {group.size} vehicles, so its first axis must be {group.size}"
                )
        every = jax.tree.map(lambda x, n=group.size: x if jnp.ndim(x) else jnp.full(n, x, jnp.float32), command)
        full.append(jax.vmap(partial(KINDS[group.kind].full_command, _one(group.params)))(every))
    return tuple(full)


def _one(params: Any) -> Any:
    return jax.tree.map(lambda x: x[0], params)


@pytree
class Moved:
    """What a control period changes of a vehicle, its counter apart."""

    vehicle: Any
    control: Any
    impact_m_s: jax.Array  # []
    finite: jax.Array  # []


def move(world: World, kind: str, params: Any, state: GroupState, command: Any) -> Moved:
    """One vehicle after a control period under a full command; ``state`` is its row of the group's."""
    timing = world.timing
    armed = state.active & events.intact(state.event_time_s)
    if state.around.rescue is not None:
        command = KINDS[kind].rescued(command, state.around.rescue)
    vehicle, control, impact = KINDS[kind].tick(
        params, state.vehicle, state.control, command, armed, state.around.ground, state.around.wall,
        state.around.wind_m_s, state.around.motor_noise, world.site,
        engine=world.engine, dt=timing.time_step_s, substeps=timing.substeps, layout=world.layout,
    )  # fmt: skip
    # limits in the autopilot would make something of a command that is none
    total = sum(jnp.sum(leaf) for leaf in jax.tree.leaves((vehicle, command)))
    finite = jnp.isfinite(total)  # a sum is finite only if all of its parts are
    moves = moving(state) & finite & state.finite
    kept = jax.tree.map(lambda new, old: jnp.where(moves, new, old), (vehicle, control), (state.vehicle, state.control))
    impact = jnp.maximum(state.impact_m_s, jnp.where(moves, impact, 0.0))
    return Moved(vehicle=kept[0], control=kept[1], impact_m_s=impact, finite=state.finite & finite)


def with_move(state: GroupState, moved: Moved) -> GroupState:
    """The state after a move; of one vehicle, or of a group."""
    return replace(
        state, vehicle=moved.vehicle, control=moved.control, impact_m_s=moved.impact_m_s, finite=moved.finite
    )


def _go(
    world: World, state: WorldState, due: jax.Array, periods: int, number: int, command: Any, collided: jax.Array
) -> tuple[GroupState, tuple[RigidState, ...]]:
    """A group after control periods under one full command, each vehicle by itself; judged before them if ``due``.

    Its detectors are as before: what they count comes when all groups have gone. With it come the places where their
    rates were due.
    """
    group, before = world.groups[number], state.groups[number]
    first, running, now = state.clock.tick, state.clock.running[number], now_s(world, state)
    judged = partial(record_events, world, group.kind, now)

    def moved(params: Any, vehicle: GroupState, command: Any, seen: Any, done: jax.Array) -> Any:
        vehicle = with_move(vehicle, move(world, group.kind, params, vehicle, command))
        return vehicle, noted(group, first, first + done + 1, seen, vehicle.vehicle.body)

    over = partial(over_vehicles, layout=world.layout, unroll=1)
    if _in_kernels():
        go = over(partial(_all_periods, group, periods, running, due, judged, moved), returned=(2,))
    else:
        each = over(judged), over(moved, in_axes=(0, 0, 0, 0, None))
        go = partial(_all_periods, group, periods, running, due, *each)
    seen = replace(before, counter=None)  # the counter is of no concern to the motion
    after, places = go(group.params, group.limits, seen, collided, command)
    return after, places


def _in_kernels() -> bool:
    """Whether branches and loops stand inside what is done for each vehicle.

    In a kernel of a GPU they cost nothing; on a CPU, XLA makes less of scalars that pass through them than of arrays.
    """
    return jax.default_backend() == "gpu"


def _all_periods(
    group: Group, periods: int, running: jax.Array, due: jax.Array, judged: Callable[..., Any],
    moved: Callable[..., Any], params: Any, limits: Limits, vehicle: GroupState, collided: jax.Array, command: Any,
) -> Any:  # fmt: skip
    """Vehicles after control periods, and where the rates of their detectors were due.

    Of one vehicle or, with ``judged`` and ``moved`` of all, of a group.
    """

    def goes(vehicle: GroupState) -> Any:
        vehicle = jax.lax.cond(due, lambda v: judged(params, limits, v, collided), lambda v: v, vehicle)

        def tick(carry: Any, _: None) -> tuple[Any, None]:
            done, vehicle, seen = carry
            vehicle, seen = moved(params, vehicle, command, seen, done)
            return (done + 1, vehicle, seen), None

        start = (jnp.int32(0), *rests(vehicle))
        return jax.lax.scan(tick, start, None, length=periods)[0][1:]

    def rests(vehicle: GroupState) -> Any:
        return vehicle, not_seen(group, periods, vehicle.vehicle.body)

    return jax.lax.cond(running, goes, rests, vehicle)
