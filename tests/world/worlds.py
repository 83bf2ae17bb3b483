"""Small worlds to be stepped: quadrotors and rovers on flat ground, and short flights by held commands."""

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.load import load_named
from swarmsim.config.mission import Mission
from swarmsim.config.scenario import Scenario, scenario_of
from swarmsim.control.commands import go_to, multirotor_command, skid_steer_command
from swarmsim.pytree import pytree
from swarmsim.runtime.clock import Clock
from swarmsim.runtime.programs import Program
from swarmsim.world import events
from swarmsim.world.build import build_world
from swarmsim.world.model import World
from swarmsim.world.state import WorldState
from swarmsim.world.step import hold, reset, step
from tests.policies.sites import block_site

BLOCK = 10
"""Ticks that are compiled; longer flights repeat them."""
TICK_S = 0.01
BUILDING = (20.0, -10.0, 30.0, 10.0)  # west, south, east, north of the one house, 6 m high
SOURCE = {"nuclide": "Co-60", "position_m": (-10.0, 12.0), "height_m": 0.5, "activity_mbq": 100.0}


def scenario(vehicles: list[dict], sample_period_s: dict[str, float] | None = None, **mission: Any) -> Scenario:
    """A mission of ``vehicles`` that wait; detectors may be given another ``sample_period_s``."""
    detectors = {}
    for name, period in (sample_period_s or {}).items():
        detectors[name] = load_named("detectors", name).model_copy(update={"sample_period_s": period})
    given = {
        "name": "small",
        "site": "meadows",  # only its name is used: the ground is that of `world`
        "engine": "analytic",
        "sources": [SOURCE],
        "vehicles": vehicles,
        "phases": [{"name": "wait", "who": "all", "policy": "hold", "time_limit_s": 60.0}],
        "definitions": {"detectors": detectors},
    }
    return scenario_of(Mission(**given | mission))


def world(vehicles: list[dict], *, mates: int = 0, blocks: tuple = (BUILDING,), **mission: Any) -> World:
    """The world of a `scenario` on 80 m x 60 m of flat ground with one house."""
    made = scenario(vehicles, **mission)
    site = replace(block_site(blocks), material_names=tuple(made.materials))
    return build_world(made, SimpleNamespace(site=site), mates)  # type: ignore[arg-type]


def row(name: str, kind: str, count: int, at: tuple[float, float], spacing_m: float = 6.0) -> list[dict]:
    """Members of one type, side by side from ``at`` eastwards."""
    return [{"name": f"{name}{k}", "type": kind, "position_m": (at[0] + spacing_m * k, at[1])} for k in range(count)]


UAVS, ROVERS = 5, 2


@cache
def team(**mission: Any) -> World:
    """Five x500 with a detector of 1 Hz, and two Orpheus with one of 0.09 s."""
    uavs = row("uav", "x500", UAVS, (-30.0, -20.0))
    rovers = row("rover", "orpheus", ROVERS, (-30.0, 0.0))
    # the x500 carries the model that samples each 0.09 s, the rover the one of 1.05 s: here it is the other way round
    return world(uavs + rovers, sample_period_s={"nai_1p5x1p5": 1.0, "nai_2x2": 0.09}, **mission)


begin = jax.jit(reset, static_argnames="active")


@pytree
class Track:
    """What the vehicles of a group did, once a tick."""

    position_m: Any  # [T, U, 3]
    quaternion: Any  # [T, U, 4]
    velocity_m_s: Any  # [T, U, 3]
    angular_velocity_rad_s: Any  # [T, U, 3]


def _steps(world: World, state: WorldState, commands: tuple) -> tuple[WorldState, tuple[Track, ...]]:
    def tick(state: WorldState, _: None) -> tuple[WorldState, tuple[Track, ...]]:
        state, _ = step(world, state, commands)
        bodies = [g.vehicle.body for g in state.groups]
        return state, tuple(Track(**vars(body)) for body in bodies)

    return jax.lax.scan(tick, state, None, length=BLOCK)


def fly(world: World, state: WorldState, commands: tuple, seconds: float) -> tuple[WorldState, tuple[Track, ...]]:
    """State after ``seconds`` of held commands (whole blocks of 0.1 s), and the tracks (numpy) of the groups.

    All flights share one program: commands of any level are written out as full ones.
    """
    full = tuple(full_command(world, number, command) for number, command in enumerate(commands))
    block = Program("block of steps", _steps, clock=Clock())  # which other test files find compiled
    tracks = []
    for _ in range(round(seconds / BLOCK / TICK_S)):
        state, track = block(world, state, full)
        tracks.append(track)
    return state, jax.tree.map(lambda *parts: np.concatenate(parts), *tracks)


def full_command(world: World, group: int, command: Any) -> Any:
    """The command of a group with all its levels."""
    if world.groups[group].kind == "skid_steer":
        return jax.vmap(skid_steer_command)(command)
    rotors = world.groups[group].params.rotor_spin.shape[-1]
    return jax.vmap(partial(multirotor_command, rotors=rotors))(command)


def stay(world: World, state: WorldState) -> tuple:
    """Commands that keep all vehicles where they are; multirotors on the ground leave their motors off."""
    commands = list(hold(world, state))
    for number, (group, g) in enumerate(zip(world.groups, state.groups, strict=True)):
        if group.kind == "multirotor":
            commands[number] = jax.vmap(go_to)(g.vehicle.body.position_m, group.yaw_rad)
    return tuple(commands)


def airborne(world: World, state: WorldState, place_m: Any, velocity_m_s: Any = (0.0, 0.0, 0.0)) -> WorldState:
    """The state with the multirotors of group 0 hovering level at ``place_m`` [U, 3]."""
    group, g = world.groups[0], state.groups[0]
    body, params = g.vehicle.body, group.params
    hover = jnp.sqrt(params.mass_kg * 9.81 / params.rotor_spin.shape[-1] / params.thrust_coefficient_n_s2)
    body = replace(
        body,
        position_m=jnp.broadcast_to(jnp.asarray(place_m, jnp.float32), body.position_m.shape),
        velocity_m_s=jnp.broadcast_to(jnp.asarray(velocity_m_s, jnp.float32), body.velocity_m_s.shape),
    )
    vehicle = replace(
        g.vehicle,
        body=body,
        rotor_speed_rad_s=jnp.broadcast_to(hover[:, None], g.vehicle.rotor_speed_rad_s.shape),
        ground_force_n=jnp.zeros(group.size),
    )
    control = replace(g.control, stuck_s=jnp.zeros(group.size))
    return with_group(state, 0, vehicle=vehicle, control=control)


def with_group(state: WorldState, number: int, **changes: Any) -> WorldState:
    """The state with fields of one group changed."""
    groups = list(state.groups)
    groups[number] = replace(groups[number], **changes)
    return replace(state, groups=tuple(groups))


def at_tick(state: WorldState, tick: int) -> WorldState:
    """The state with another time on its clock."""
    return replace(state, clock=replace(state.clock, tick=jnp.int32(tick)))


def happened(state: WorldState, group: int = 0) -> list[set[str]]:
    """Kinds of events of each vehicle of a group."""
    times = np.asarray(state.groups[group].event_time_s)
    return [{kind for kind, time in zip(events.KINDS, row, strict=True) if np.isfinite(time)} for row in times]
