"""The physics that firmware flies: some vehicles of a mission in one world, stepped by their actuators."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim import randomness
from swarmsim.config.load import load_named
from swarmsim.config.scenario import Scenario
from swarmsim.config.sensors import Place
from swarmsim.control.commands import RotorSpeedCommand, WheelSpeedCommand
from swarmsim.physics.rotations import rotation_matrix, to_body
from swarmsim.sensors.suite import Readings, Suite, SuiteState, begin, read, suite_of
from swarmsim.sensors.truth import Truth as SensorTruth
from swarmsim.vehicles.state import GRAVITY_M_S2, RigidState
from swarmsim.world import events
from swarmsim.world.build import grouped
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import Group, World
from swarmsim.world.state import GroupState, WorldState
from swarmsim.world.step import step

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_TRUTH = 23  # numbers of the truth in a vehicle's row; its readings follow
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

        ``place`` is where its origin lies; a vehicle that names no sensors has those of ``default``.
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
        suites = tuple(self._suite(scenario, k, place, default) for k in order)
        keys = jax.random.split(randomness.consumer(start.key, "firmware sensors"), len(order))
        sensed = tuple(map(begin, suites, keys))
        fixed, begun = jax.device_put((world, suites)), jax.device_put((start, sensed))
        program = Program("firmware step", _stepped, clock=Clock())
        self._call, _ = program.executable(fixed, begun, self._given(np.zeros((len(order), ACTUATORS))))
        self._fixed, self._start = jax.tree.leaves(fixed), jax.tree.leaves(begun)
        self.reset()

    def _suite(self, scenario: Scenario, number: int, place: Place, default: Sequence[str]) -> Suite:
        vehicle = scenario.vehicles[number]
        if vehicle.sensors:
            return suite_of(vehicle, self.period_s, place=place, known=scenario.sensors)
        return suite_of([load_named("sensors", name) for name in default], self.period_s, place=place)

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


_Fixed = tuple[World, tuple[Suite, ...]]
_Moving = tuple[WorldState, tuple[SuiteState, ...]]


def _stepped(fixed: _Fixed, moving: _Moving, actuators: jax.Array) -> tuple[_Moving, jax.Array]:
    (world, suites), (before, sensed) = fixed, moving
    commands, first = [], 0
    for group in world.groups:
        commands.append(jax.vmap(_COMMANDS[group.kind])(group.params, actuators[first : first + group.size]))
        first += group.size
    tick = before.clock.tick
    state, _ = step(world, before, commands, 1)
    dt = world.timing.control_period_s
    groups = zip(world.groups, before.groups, state.groups, strict=True)
    rows = jnp.concatenate([_numbers(*both, dt) for both in groups])
    keys = jax.random.split(randomness.consumer(before.key, "firmware sensors"), len(suites))
    read_all = [
        read(s, x, _sensor_truth(row), k, tick) for s, x, row, k in zip(suites, sensed, rows, keys, strict=True)
    ]
    told = jnp.stack([_row(readings) for _, readings in read_all])
    return (state, tuple(x for x, _ in read_all)), jnp.concatenate([rows, told], axis=1)


def _sensor_truth(row: jax.Array) -> SensorTruth:
    return SensorTruth(
        position_m=row[0:3],
        velocity_m_s=row[3:6],
        quaternion=row[6:10],
        angular_velocity_rad_s=row[10:13],
        specific_force_m_s2=row[13:16],
        air_velocity_m_s=row[16:19],
        height_m=row[19],
    )


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
