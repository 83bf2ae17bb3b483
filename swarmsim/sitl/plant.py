"""The physics that firmware flies: some vehicles of a mission in one world, stepped by their actuators."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.load import load_named
from swarmsim.config.scenario import Scenario
from swarmsim.config.sensors import Place
from swarmsim.control.commands import RotorSpeedCommand, WheelSpeedCommand
from swarmsim.sensors.suite import Readings, sensors_of
from swarmsim.world import events
from swarmsim.world.build import grouped
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import Group, World
from swarmsim.world.sensing import Sensed as Sensing
from swarmsim.world.sensing import Sensors, fit_sensors, sense, switch_on, truth_of
from swarmsim.world.state import GroupState, WorldState
from swarmsim.world.step import step

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_TRUTH = 21  # numbers of the truth in a vehicle's row; its readings follow
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
    charge: Array  # [K] share of the battery left
    intact: Bools  # [K] it has not crashed or collided


@dataclass(frozen=True)
class Sensed:
    """What the sensors of all vehicles [K, ...] read, as `swarmsim.sensors.suite.Readings`.

    NaN for what a vehicle lacks, and its ``fresh`` False.
    """

    imu_fresh: Bools
    gyro_rad_s: Array
    accel_m_s2: Array
    gnss_fresh: Bools
    gnss_position_m: Array
    gnss_velocity_m_s: Array
    gnss_eph_m: Array
    gnss_epv_m: Array
    gnss_fix: Array
    barometer_fresh: Bools
    pressure_pa: Array
    temperature_k: Array
    magnetometer_fresh: Bools
    magnetic_field_t: Array
    rangefinder_fresh: Bools
    range_m: Array
    range_valid: Bools
    airspeed_fresh: Bools
    differential_pressure_pa: Array


class Plant:
    """A world whose vehicles do what their actuators are told, and what their sensors read."""

    def __init__(self, scenario: Scenario, place: Place, default: Sequence[str], seed: int = 0):
        """Build the world and compile its step; a step is a control period of ``scenario``.

        ``place`` is where its origin lies; ``default`` are sensors of the kinds that a vehicle does not name itself.
        """
        from swarmsim.runtime.clock import Clock
        from swarmsim.runtime.programs import Program
        from swarmsim.runtime.run import build

        simulation = build(scenario)
        self.names = [member.name for member in scenario.members]
        self.period_s = simulation.world.timing.control_period_s
        order = np.concatenate([np.array(members) for members in grouped(scenario)])
        self._grouped, self._order = order, np.argsort(order)
        world, start = simulation.world, simulation.reset(seed)
        groups = world.groups
        self.flies = np.repeat([bool(KINDS[g.kind].FLIES) for g in groups], [g.size for g in groups])[self._order]
        sensors = fit_sensors(scenario, world, place=place, others=_with_default(scenario, default))
        fixed, begun = jax.device_put((world, sensors)), jax.device_put((start, switch_on(sensors, start)))
        program = Program("firmware step", _stepped, clock=Clock())
        self._call, _ = program.executable(fixed, begun, self._given(np.zeros((len(order), ACTUATORS))))
        self._fixed, self._start = jax.tree.leaves(fixed), jax.tree.leaves(begun)
        self.reset()

    def reset(self) -> Truth:
        """Every vehicle at rest at its start again, a period after time zero."""
        self._state, self.tick = self._start, 0
        return self.step(np.zeros((len(self.names), ACTUATORS)))

    def step(self, actuators: NDArray[np.floating]) -> Truth:
        """One period later. ``actuators`` [K, 8]: -1 to 1; a rotor that is told zero or less runs down."""
        *self._state, numbers = self._call(*self._fixed, *self._state, self._given(actuators))
        self.tick += 1
        rows = np.asarray(numbers, np.float64)[self._order]
        self.truth = _truth(self.tick * self.period_s, rows)
        self.sensed = _sensed(rows[:, _TRUTH:])
        return self.truth

    def _given(self, actuators: NDArray[np.floating]) -> NDArray[np.float32]:
        """The actuators in the order of the groups."""
        return np.asarray(actuators, np.float32)[self._grouped]


def _with_default(scenario: Scenario, default: Sequence[str]) -> dict[str, Sequence[str]]:
    """Names of each vehicle's own sensors, and those of ``default`` of the kinds that it lacks."""
    others = [load_named("sensors", name) for name in default]
    names: dict[str, Sequence[str]] = {}
    for member, vehicle in zip(scenario.members, scenario.vehicles, strict=True):
        kinds = {sensor.kind for sensor in sensors_of(vehicle, scenario.sensors)}
        names[member.name] = [*vehicle.sensors, *(s.name for s in others if s.kind not in kinds)]
    return names


_Moving = tuple[WorldState, Sensing]


def _stepped(fixed: tuple[World, Sensors], moving: _Moving, actuators: jax.Array) -> tuple[_Moving, jax.Array]:
    (world, sensors), (before, sensing) = fixed, moving
    commands, first = [], 0
    for group in world.groups:
        commands.append(jax.vmap(_COMMANDS[group.kind])(group.params, actuators[first : first + group.size]))
        first += group.size
    state, _ = step(world, before, commands, 1)
    sensing, readings = sense(sensors, sensing, state)
    groups = zip(world.groups, before.groups, state.groups, strict=True)
    truth = jnp.concatenate([_numbers(*both, world.timing.control_period_s) for both in groups])
    return (state, sensing), jnp.concatenate([truth, _told(world, sensors, readings)], axis=1)


def _told(world: World, sensors: Sensors, readings: Sequence[Readings]) -> jax.Array:
    """Readings [K, R] of all vehicles in the order of the groups."""
    firsts = np.cumsum([0, *(group.size for group in world.groups)])
    rows = np.concatenate([firsts[fitted.group] + np.array(fitted.local) for fitted in sensors.fitted])
    return jnp.concatenate([jax.vmap(_row)(reading) for reading in readings])[np.argsort(rows)]


_VECTORS = ("gyro_rad_s", "accel_m_s2", "gnss_position_m", "gnss_velocity_m_s", "magnetic_field_t")
_WIDTHS = {field.name: 3 if field.name in _VECTORS else 1 for field in fields(Sensed)}


def _row(readings: Readings) -> jax.Array:
    """Readings of one vehicle as one vector; NaN for what it lacks."""
    parts = []
    for name, width in _WIDTHS.items():
        value = getattr(readings, name)
        parts.append(jnp.full(width, jnp.nan) if value is None else jnp.reshape(value, width).astype(jnp.float32))
    return jnp.concatenate(parts)


def _sensed(rows: Array) -> Sensed:
    found: dict[str, Any] = {}
    first = 0
    for name, width in _WIDTHS.items():
        value = rows[:, first] if width == 1 else rows[:, first : first + width]
        found[name] = value > 0.5 if name.endswith(("fresh", "valid")) else value
        first += width
    return Sensed(**found)


def _rotors(params: Any, actuators: jax.Array) -> RotorSpeedCommand:
    count = params.rotor_spin.shape[-1]
    return RotorSpeedCommand(rotor_speed_rad_s=jnp.clip(actuators[:count], 0.0, 1.0) * params.speed_max_rad_s)


def _wheels(params: Any, actuators: jax.Array) -> WheelSpeedCommand:
    sides = jnp.clip(actuators[:2], -1.0, 1.0) * params.speed_max_m_s / params.wheel_radius_m
    return WheelSpeedCommand(wheel_speed_rad_s=jnp.tile(sides, 2))


_COMMANDS: dict[str, Callable[..., Any]] = {"multirotor": _rotors, "skid_steer": _wheels}


def _numbers(group: Group, before: GroupState, after: GroupState, dt: float) -> jax.Array:
    """States [U, 21] of a group's vehicles, in the order of `_truth`."""
    period_s = jnp.float32(dt)
    t = jax.vmap(partial(truth_of, period_s))(before.vehicle.body, replace(after, counter=None))
    last = [1.0 - after.vehicle.energy_j / group.limits.battery_j, jax.vmap(events.intact)(after.event_time_s)]
    vectors = [t.position_m, t.velocity_m_s, t.quaternion, t.angular_velocity_rad_s, t.specific_force_m_s2]
    return jnp.concatenate([*vectors, t.air_velocity_m_s, jnp.stack(last, axis=-1).astype(jnp.float32)], axis=-1)


def _truth(time_s: float, x: Array) -> Truth:
    return Truth(
        time_s=time_s,
        position_m=x[:, 0:3],
        velocity_m_s=x[:, 3:6],
        quaternion=x[:, 6:10],
        angular_velocity_rad_s=x[:, 10:13],
        specific_force_m_s2=x[:, 13:16],
        air_velocity_m_s=x[:, 16:19],
        charge=x[:, 19],
        intact=x[:, 20] > 0.5,
    )
