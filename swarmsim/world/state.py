"""The state of one mission's world, and what its sensors read. Leading axis U: the vehicles of a group."""

from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.physics.contact import Plane
from swarmsim.physics.wind import GustState
from swarmsim.pytree import pytree
from swarmsim.sensors.radiation import CounterState, Reading
from swarmsim.world.failsafes import Rescue
from swarmsim.world.model import World


@pytree
class Clock:
    """What all missions of a batch have in common: they advance together. It carries no mission axis."""

    tick: jax.Array  # [] int32: control periods since the start
    running: jax.Array  # [G] bool: groups that are stepped; one that waits or has ended is not


@pytree
class Surroundings:
    """What is around a vehicle, refreshed once in a judging period."""

    ground: Plane  # tangent plane of what is below it: terrain, or a roof that it is over
    wall: Plane  # upright plane of the nearest wall at its height; far away where there is none
    wind_m_s: jax.Array  # [U, 3] velocity of the air, world
    gust: GustState
    motor_noise: jax.Array | None  # [U, R] unit variance: errors of the rotors' speeds; None for what has no rotors
    height_m: jax.Array  # [U] of the lowest contact point above the ground
    rides: jax.Array  # [U] bool: it stands on the deck of a rover, which carries it along
    hold: jax.Array  # [U] bool: another vehicle has the right of way
    push_m: jax.Array  # [U, 3] displacement that keeps apart from it, world
    nearest_m: jax.Array  # [U] distance of the nearest other vehicle
    rescue: Rescue | None  # what its autopilot does by itself; None for what drives


@pytree
class GroupState:
    """All vehicles of one group."""

    vehicle: Any  # state of the group's kind
    control: Any  # memory of its controller
    around: Surroundings
    active: jax.Array  # [U] bool: has a part in the mission now; the others rest on what they stand on, motors off
    impact_m_s: jax.Array  # [U] largest speed at which it met the ground or a wall since it was last judged
    finite: jax.Array  # [U] bool: its state is still made of numbers
    event_time_s: jax.Array  # [U, kinds] first time of each kind of event, inf where there was none
    counter: CounterState | None  # of its radiation detector


def moving(state: GroupState) -> jax.Array:
    """Which vehicles [...] are moved on: those with a part in the mission, and those that a rover carries along."""
    return state.active | state.around.rides


@pytree
class RadioState:
    """Broadcasts that are still under way. V: all vehicles of the mission, D: judging periods of delay, plus one."""

    position_m: jax.Array  # [D, V, 3] world; slot 0 was sent last
    velocity_m_s: jax.Array  # [D, V, 3] world
    yaw_rad: jax.Array  # [D, V]
    count_rate_cps: jax.Array  # [D, V]
    tick: jax.Array  # [] int32: when slot 0 was sent, in control periods
    heard_index: jax.Array  # [V, K] int32: team mates of whom a message came
    heard: jax.Array  # [V, K] bool


@pytree
class WorldState:
    """One mission's world."""

    clock: Clock
    key: jax.Array  # [] randomness of the mission
    groups: tuple[GroupState, ...]
    radio: RadioState
    crowded: jax.Array  # [] bool: more vehicles in one place than the neighbour search can hold, at any time


def now_s(world: World, state: WorldState) -> jax.Array:
    """The time [] of a world in s."""
    return state.clock.tick * jnp.float32(world.timing.control_period_s)


def mission_axes() -> WorldState:
    """Axes of `jax.vmap` over missions (axis 0 of every state) that share their clock, as ``in_axes`` and ``out_axes``.

    What is due at a period, a sample or a look at the traffic, is then done at its period; with a clock of its own each
    mission does all of it at every tick, because a condition that differs by mission evaluates both branches.
    """
    return WorldState(clock=None, key=0, groups=0, radio=0, crowded=0)  # type: ignore[arg-type]


Readings = tuple[Reading | None, ...]
"""For each group what its detectors read; None for a group without."""
