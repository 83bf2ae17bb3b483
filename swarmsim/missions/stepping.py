"""A team stepped by hand: the caller says where each vehicle should go, a tick at a time, for B missions at once."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.control.multirotor import Setpoint
from swarmsim.missions import events, keys, knowledge
from swarmsim.missions.drive import Drive
from swarmsim.missions.flight import Flight
from swarmsim.missions.rollout import Simulation
from swarmsim.missions.world import World
from swarmsim.pytree import pytree


@pytree
class TeamState:
    """All vehicles of B missions."""

    key: jax.Array  # [B] randomness of each mission
    tick: jax.Array  # [] int32, ticks since the start
    flights: Flight  # [B, U, …]
    rover: Drive | None  # [B, …]


@pytree
class Command:
    """Where the vehicles should go until the next command."""

    position_m: jax.Array  # [B, U, 3] ENU
    velocity_m_s: jax.Array  # [B, U, 3] ENU, fed forward
    yaw_rad: jax.Array  # [B, U] counter-clockwise from east
    rover_speed_m_s: jax.Array  # [B] ahead
    rover_yaw_rate_rad_s: jax.Array  # [B] counter-clockwise


@pytree
class Observation:
    """What is seen at the end of a tick."""

    time_s: jax.Array  # [] since the start
    position_m: jax.Array  # [B, U, 3] ENU
    velocity_m_s: jax.Array  # [B, U, 3] ENU
    count_rate_cps: jax.Array  # [B, U] counts of the tick over its exposure
    active: jax.Array  # [B, U] bool: nothing has ended the vehicle's flight
    rover_position_m: jax.Array  # [B, 3] ENU; zero without a rover
    rover_count_rate_cps: jax.Array  # [B]; zero without a rover


class Stepper:
    """Steps a simulation's team by hand, in ticks of the UAVs' sample period.

    Gusts, collisions, batteries and counts are those of a rollout; no policy, and no right of way.
    """

    def __init__(self, simulation: Simulation):
        """Compile nothing yet."""
        self._simulation = simulation

    @property
    def tick_s(self) -> float:
        """Length of a tick [s]."""
        return self._simulation.timing.uav_tick_s

    def reset(self, seeds: Any) -> TeamState:
        """The teams of the missions ``seeds`` (a number, or a sequence of B) at rest at their starts."""
        simulation, world = self._simulation, self._simulation.world
        mission_keys = keys.mission_keys(np.atleast_1d(np.asarray(seeds, np.int64)))
        missions = len(mission_keys)
        do = simulation.stages(missions)
        flights = do.ready_to_fly(mission_keys, world)
        rover = None if world.rover is None else do.ready_to_drive(world, jnp.zeros(missions))
        return TeamState(key=mission_keys, tick=jnp.int32(0), flights=flights, rover=rover)

    def hold(self, state: TeamState) -> Command:
        """The command that keeps every vehicle where it is."""
        body = state.flights.vehicle.body
        missions, uavs = body.position_m.shape[:2]
        return Command(
            position_m=body.position_m,
            velocity_m_s=jnp.zeros_like(body.position_m),
            yaw_rad=jnp.broadcast_to(self._simulation.world.team.yaw_rad, (missions, uavs)),
            rover_speed_m_s=jnp.zeros(missions),
            rover_yaw_rate_rad_s=jnp.zeros(missions),
        )

    def step(self, state: TeamState, command: Command) -> tuple[TeamState, Observation]:
        """The teams one tick later, and what is seen then.

        Raises ValueError where the command's shapes are not those of the teams.
        """
        wanted = jax.tree.map(jnp.shape, self.hold(state))
        given = jax.tree.map(jnp.shape, command)
        if wanted != given:
            raise ValueError(f"the command's shapes are {given}, they must be {wanted}")
        axes = (TeamState(key=0, tick=None, flights=0, rover=0), None, 0)  # type: ignore[arg-type]
        missions = state.key.shape[0]
        stage = self._simulation.stage("step by hand", self._tick, axes, missions, out_axes=(axes[0], _OBSERVED))
        return stage(state, self._simulation.world, command)

    def _tick(self, state: TeamState, world: World, command: Command) -> tuple[TeamState, Observation]:
        """One mission's tick."""
        simulation, dynamics = self._simulation, self._simulation.dynamics
        ticks = state.tick[None]
        setpoints = Setpoint(
            position_m=command.position_m,
            velocity_m_s=command.velocity_m_s,
            acceleration_m_s2=jnp.zeros_like(command.velocity_m_s),
            yaw_rad=command.yaw_rad,
        )
        flights, log = dynamics.steer(state.key, world, state.flights, ticks, setpoints)
        air = knowledge.count_from_air(state.key, world, log, first=state.tick)
        rover = state.rover
        rover_rate, rover_position = jnp.zeros(()), jnp.zeros(3)
        if rover is not None:
            speed, yaw_rate = command.rover_speed_m_s, command.rover_yaw_rate_rad_s
            rover, rover_log = dynamics.steer_rover(world, rover, ticks, speed, yaw_rate)
            counted = knowledge.count_on_ground(
                state.key, world, rover_log, 1, first=state.tick, live_s=simulation.timing.uav_tick_s
            )
            rover_rate = counted.counts[0] / counted.exposure_s[0]
            rover_position = rover.vehicle.body.position_m
        body = flights.vehicle.body
        seen = Observation(
            time_s=(state.tick + 1) * simulation.timing.uav_tick_s,
            position_m=body.position_m,
            velocity_m_s=body.velocity_m_s,
            count_rate_cps=air.counts[:, 0] / air.exposure_s[:, 0],
            active=events.under_way(flights.event_time_s),
            rover_position_m=rover_position,
            rover_count_rate_cps=rover_rate,
        )
        return TeamState(key=state.key, tick=state.tick + 1, flights=flights, rover=rover), seen


# vmap wants the tree of axes in the shape of the value: integers stand where the arrays will
_OBSERVED: Any = Observation(
    **{field.name: None if field.name == "time_s" else 0 for field in dataclasses.fields(Observation)}  # type: ignore[arg-type]
)
