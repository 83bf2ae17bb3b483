"""The physics that firmware flies: some vehicles of a mission in one world, stepped by their actuators."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.scenario import Scenario
from swarmsim.control.commands import RotorSpeedCommand, WheelSpeedCommand
from swarmsim.physics.rotations import rotation_matrix, to_body
from swarmsim.vehicles.state import GRAVITY_M_S2, RigidState
from swarmsim.world import events
from swarmsim.world.build import grouped
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import Group, World
from swarmsim.world.state import GroupState, WorldState
from swarmsim.world.step import step

Array = NDArray[np.float64]

ACTUATORS = 8
"""Length of a vehicle's actuator vector: rotor speeds over the largest one, or a rover's left and right wheels."""


@dataclass(frozen=True)
class Truth:
    """True states of all vehicles [K, ...] after a step; world ENU, body FLU."""

    time_s: float
    position_m: Array  # [K, 3]
    velocity_m_s: Array  # [K, 3]
    quaternion: Array  # [K, 4] w x y z, body to world
    angular_velocity_rad_s: Array  # [K, 3] body
    specific_force_m_s2: Array  # [K, 3] body: mean over the step, what an ideal accelerometer reads
    air_velocity_m_s: Array  # [K, 3] body: of the vehicle through the air
    height_m: Array  # [K] of the lowest contact point above the ground
    voltage_v: Array  # [K] of the battery; NaN of a rover
    charge: Array  # [K] share of the battery left
    intact: NDArray[np.bool_]  # [K] it has not crashed or collided


class Plant:
    """A world whose vehicles do what their actuators are told."""

    def __init__(self, scenario: Scenario, seed: int = 0):
        """Build the world and compile its step; a step is a control period of ``scenario``."""
        from swarmsim.runtime.clock import Clock
        from swarmsim.runtime.programs import Program
        from swarmsim.runtime.run import build

        simulation = build(scenario)
        self.names = [member.name for member in scenario.members]
        self.period_s = simulation.world.timing.control_period_s
        self._order = np.argsort(np.concatenate([np.array(members) for members in grouped(scenario)]))
        self._world = jax.device_put(simulation.world)
        groups = self._world.groups
        self.flies = np.repeat([bool(KINDS[g.kind].FLIES) for g in groups], [g.size for g in groups])[self._order]
        start = jax.device_put(simulation.reset(seed))
        program = Program("firmware step", _stepped, clock=Clock())
        self._call, _ = program.executable(self._world, start, self._given(np.zeros((len(self.names), ACTUATORS))))
        self._of_world, self._start = jax.tree.leaves(self._world), jax.tree.leaves(start)
        self.reset()

    def reset(self) -> Truth:
        """Every vehicle at rest at its start again, at time zero."""
        self._state, self.tick = self._start, 0
        self.truth = self.step(np.zeros((len(self.names), ACTUATORS)))
        return self.truth

    def step(self, actuators: NDArray[np.floating]) -> Truth:
        """One period later. ``actuators`` [K, 8]: -1 to 1; a rotor that is told zero or less runs down."""
        *self._state, numbers = self._call(*self._of_world, *self._state, self._given(actuators))
        self.tick += 1
        self.truth = _truth(self.tick * self.period_s, np.asarray(numbers, np.float64)[self._order])
        return self.truth

    def _given(self, actuators: NDArray[np.floating]) -> NDArray[np.float32]:
        """The actuators in the order of the groups."""
        given = np.empty((len(self.names), ACTUATORS), np.float32)
        given[np.argsort(self._order)] = actuators
        return given


def _stepped(world: World, state: WorldState, actuators: jax.Array) -> tuple[WorldState, jax.Array]:
    commands, first = [], 0
    for group in world.groups:
        commands.append(jax.vmap(_COMMANDS[group.kind])(group.params, actuators[first : first + group.size]))
        first += group.size
    before = state
    state, _ = step(world, state, commands, 1)
    dt = world.timing.control_period_s
    rows = [_numbers(*both, dt) for both in zip(world.groups, before.groups, state.groups, strict=True)]
    return state, jnp.concatenate(rows)


def _rotors(params: Any, actuators: jax.Array) -> RotorSpeedCommand:
    count = params.rotor_spin.shape[-1]
    return RotorSpeedCommand(rotor_speed_rad_s=jnp.clip(actuators[:count], 0.0, 1.0) * params.speed_max_rad_s)


def _wheels(params: Any, actuators: jax.Array) -> WheelSpeedCommand:
    sides = jnp.clip(actuators[:2], -1.0, 1.0) * params.speed_max_m_s / params.wheel_radius_m
    return WheelSpeedCommand(wheel_speed_rad_s=jnp.tile(sides, 2))


_COMMANDS: dict[str, Callable[..., Any]] = {"multirotor": _rotors, "skid_steer": _wheels}


def _numbers(group: Group, before: GroupState, after: GroupState, dt: float) -> jax.Array:
    """States [U, 23] of a group's vehicles, in the order of `_truth`."""
    flies = KINDS[group.kind].FLIES
    voltage = after.vehicle.voltage_v if flies else jnp.full(group.size, jnp.nan)
    body = after.vehicle.body

    def one(old: RigidState, new: RigidState, wind_m_s: jax.Array) -> tuple[jax.Array, jax.Array]:
        turn = rotation_matrix(new.quaternion)
        rise = jnp.array([0.0, 0.0, GRAVITY_M_S2])
        return (
            to_body(turn, (new.velocity_m_s - old.velocity_m_s) / dt + rise),
            to_body(turn, new.velocity_m_s - wind_m_s),
        )

    force, air = jax.vmap(one)(before.vehicle.body, body, after.around.wind_m_s)
    last = [
        after.around.height_m,
        voltage,
        1.0 - after.vehicle.energy_j / group.limits.battery_j,
        jax.vmap(events.intact)(after.event_time_s),
    ]
    vectors = [body.position_m, body.velocity_m_s, body.quaternion, body.angular_velocity_rad_s, force, air]
    return jnp.concatenate([*vectors, jnp.stack(last, axis=-1).astype(jnp.float32)], axis=-1)


def _truth(time_s: float, x: Array) -> Truth:
    return Truth(
        time_s=time_s,
        position_m=x[:, 0:3],
        velocity_m_s=x[:, 3:6],
        quaternion=x[:, 6:10],
        angular_velocity_rad_s=x[:, 10:13],
        specific_force_m_s2=x[:, 13:16],
        air_velocity_m_s=x[:, 16:19],
        height_m=x[:, 19],
        voltage_v=x[:, 20],
        charge=x[:, 21],
        intact=x[:, 22] > 0.5,
    )
