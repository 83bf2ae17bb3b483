"""The body of the stand-in: one vehicle of a mission, alone on its site, stepped by the simulator's own physics."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.bare import bare_scenario
from swarmsim.config.errors import InputError
from swarmsim.config.mission import Mission, Phase, TeamMember, Timing
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.scenario import Scenario, load_scenario, scenario_of
from swarmsim.control.commands import POSITION, ROTOR_SPEED, MultirotorCommand, SkidSteerCommand
from swarmsim.world import events
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import World
from swarmsim.world.state import WorldState
from swarmsim.world.step import step

Array = NDArray[np.float64]

AT_REST_M_S = 0.2
"""Speed below which a vehicle with its motors off, on the ground, is no longer moved."""
DRIVE_LEVEL, DRIVE_TO_LEVEL = 1.0, 0.0


@dataclass(frozen=True)
class Motion:
    """What the body is commanded to do: a copter's position with feed-forward, or a rover's drive. World ENU."""

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    acceleration_m_s2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_rad: float = 0.0
    hold_position: bool = False  # copter: correct the position error; rover: drive to the position
    speed_m_s: float = 0.0  # rover: ahead, or the limit on the way to a position
    yaw_rate_rad_s: float = 0.0  # rover

    def numbers(self) -> NDArray[np.float32]:
        """All of it as one vector, which the compiled step takes."""
        return np.array(
            [
                *self.position_m, *self.velocity_m_s, *self.acceleration_m_s2, self.yaw_rad, self.hold_position,
                self.speed_m_s, self.yaw_rate_rad_s,
            ],
            np.float32,
        )  # fmt: skip


@dataclass(frozen=True)
class Sensed:
    """True state of the body; world ENU, body FLU."""

    position_m: Array
    velocity_m_s: Array
    quaternion: Array  # w x y z, body to world
    angular_velocity_rad_s: Array  # body
    height_m: float  # of the feet above the ground
    landed: bool  # its controller has stopped the motors on the ground; a rover always stands on it
    intact: bool  # it has not crashed or collided
    charge: float  # share of the battery left
    voltage_v: float


class Body(Protocol):
    """What the autopilot moves."""

    flies: bool
    step_s: float
    speed_max_m_s: float
    sensed: Sensed

    def step(self, motion: Motion, armed: bool) -> Sensed:
        """The state ``step_s`` later."""


class SimulatedBody:
    """One vehicle of a built world."""

    def __init__(self, scenario: Scenario, seed: int = 0):
        """Build the world and compile its step, or load that from the cache; ``scenario`` has one vehicle."""
        from swarmsim.runtime.clock import Clock
        from swarmsim.runtime.programs import Program
        from swarmsim.runtime.run import build

        simulation = build(scenario)
        self.name = scenario.members[0].name
        self._world = jax.device_put(simulation.world)  # or every step would carry it over
        self._state = jax.device_put(simulation.reset(seed))
        group = self._world.groups[0]
        self.flies = bool(KINDS[group.kind].FLIES)
        self.step_s = self._world.timing.judge_period_s
        self.speed_max_m_s = float(scenario.vehicles[0].control.speed_max_m_s)
        self._program = Program("stand-in step", _stepped(group.kind), clock=Clock())
        self.sensed = self.step(Motion(), armed=False)

    def step(self, motion: Motion, armed: bool) -> Sensed:
        """The state one step later under a command; motors are off when it is not armed."""
        self._state, numbers = self._program(self._world, self._state, motion.numbers(), np.array(armed))
        self.sensed = _sensed(np.asarray(numbers, np.float64))
        return self.sensed


def _stepped(kind: str) -> Callable[..., Any]:
    """The function of a step: world, state, command [13] and whether it is armed, to the state and its numbers."""
    command_of = _copter_command if KINDS[kind].FLIES else _rover_command

    def stepped(world: World, state: WorldState, motion: jax.Array, armed: jax.Array) -> tuple[WorldState, jax.Array]:
        group = state.groups[0]
        still = jnp.sum(group.vehicle.body.velocity_m_s**2) < AT_REST_M_S**2
        rests = ~armed & still & (group.around.height_m < 0.1)
        group = replace(group, active=jnp.full_like(group.active, True) & ~rests)
        state = replace(state, groups=(group,))
        one = command_of(world, motion, armed)
        command = jax.tree.map(lambda x: x[None], one)
        state, _ = step(world, state, (command,), world.timing.judge_ticks)
        return state, _numbers(world, state)

    return stepped


def _copter_command(world: World, motion: jax.Array, armed: jax.Array) -> MultirotorCommand:
    rotors = KINDS["multirotor"].rotors(world.groups[0].params)
    return MultirotorCommand(
        level=jnp.where(armed, POSITION, ROTOR_SPEED).astype(jnp.int32),
        position_m=motion[0:3],
        velocity_m_s=motion[3:6],
        acceleration_m_s2=motion[6:9],
        yaw_rad=motion[9],
        hold_position=motion[10],
        quaternion=jnp.array([1.0, 0.0, 0.0, 0.0]),
        body_rate_rad_s=jnp.zeros(3),
        thrust_n=jnp.zeros(()),
        rotor_speed_rad_s=jnp.zeros(rotors),
    )


def _rover_command(world: World, motion: jax.Array, armed: jax.Array) -> SkidSteerCommand:
    to_point = (motion[10] > 0.5) & armed
    return SkidSteerCommand(
        level=jnp.where(to_point, DRIVE_TO_LEVEL, DRIVE_LEVEL).astype(jnp.int32),
        position_m=motion[0:2],
        speed_m_s=jnp.where(armed, motion[11], 0.0),
        yaw_rate_rad_s=jnp.where(armed, motion[12], 0.0),
        wheel_speed_rad_s=jnp.zeros(4),
    )


def _numbers(world: World, state: WorldState) -> jax.Array:
    """State of the one vehicle as one vector, in the order of `_sensed`."""
    group, kind = world.groups[0], KINDS[world.groups[0].kind]
    vehicle = jax.tree.map(lambda x: x[0], state.groups[0])
    body = vehicle.vehicle.body
    landed = kind.landed(vehicle.control) if kind.FLIES else jnp.array(True)
    voltage = vehicle.vehicle.voltage_v if kind.FLIES else jnp.float32(jnp.nan)
    charge = 1.0 - vehicle.vehicle.energy_j / group.limits.battery_j[0]
    last = jnp.stack(
        [
            vehicle.around.height_m,
            landed.astype(jnp.float32),
            events.intact(vehicle.event_time_s).astype(jnp.float32),
            charge,
            voltage,
        ]
    )
    return jnp.concatenate([body.position_m, body.velocity_m_s, body.quaternion, body.angular_velocity_rad_s, last])


def _sensed(x: Array) -> Sensed:
    return Sensed(
        position_m=x[0:3],
        velocity_m_s=x[3:6],
        quaternion=x[6:10],
        angular_velocity_rad_s=x[10:13],
        height_m=float(x[13]),
        landed=bool(x[14] > 0.5),
        intact=bool(x[15] > 0.5),
        charge=float(x[16]),
        voltage_v=float(x[17]),
    )


def scenario_alone(mission: str | None, vehicle: str | None, step_s: float, default: dict[str, Any]) -> Scenario:
    """The scenario of one vehicle of a mission without its detector, sources and failsafes: those are the autopilot's.

    ``default`` is the site, type and position of the vehicle when no ``mission`` is given. Raises `InputError`.
    """
    if mission is not None:
        return alone_of(load_scenario(mission), vehicle, step_s)
    member = TeamMember(name=vehicle or "vehicle", type=default["type"], position_m=tuple(default["position_m"]))
    holds = Phase(name="hold", who=(member.name,), policy="hold", time_limit_s=60.0)
    whole = Mission(name="standin", site=default["site"], sources=(), vehicles=(member,), phases=(holds,))
    return alone_of(scenario_of(whole), vehicle, step_s)


def alone_of(whole: Scenario, vehicle: str | None, step_s: float) -> Scenario:
    """The scenario of one vehicle of a loaded mission, the first one by default, as `scenario_alone`."""
    names = [member.name for member in whole.members]
    chosen = vehicle if vehicle is not None else names[0]
    if chosen not in names:
        raise InputError.of(
            f"mission '{whole.mission.name}' has no vehicle '{chosen}'",
            given=chosen,
            allowed=one_of(names),
            suggestion=did_you_mean(chosen, names),
        )
    return bare_scenario(whole, [names.index(chosen)], "standin", Timing(judge_period_s=step_s))
