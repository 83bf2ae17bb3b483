"""One mission's functions: its vehicles batched, its engines and policies chosen.

Everything below is written for one vehicle; `swarmsim.missions.stages` batches these functions over missions.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.config.scenario import Scenario
from swarmsim.config.vehicles import Multirotor, SkidSteer
from swarmsim.control.multirotor import Setpoint, control_start
from swarmsim.control.skid_steer import pursue
from swarmsim.missions import drive as driving
from swarmsim.missions import events, keys
from swarmsim.missions import flight as flying
from swarmsim.missions.drive import Drive
from swarmsim.missions.flight import Flight, Traffic
from swarmsim.missions.measure import Log
from swarmsim.missions.world import Roles, Timing, World, embodied
from swarmsim.physics import multirotor, skid_steer
from swarmsim.physics.wind import gust_start
from swarmsim.policies import get
from swarmsim.policies.path import Path
from swarmsim.vehicles.state import MultirotorState, SkidSteerState


class Dynamics:
    """The compiled-in choices of a scenario (engines, policies, periods) and one mission's functions made of them."""

    def __init__(self, scenario: Scenario, roles: Roles, timing: Timing):
        """Make the step functions of the scenario's engine.

        Raises `InputError` where the time step does not suit a vehicle.
        """
        mission = scenario.mission
        self.timing = timing
        self.aerial_policy = get("aerial", mission.aerial.policy)
        self.ground_policy = get("ground", mission.ground.policy)
        uav = scenario.vehicles[roles.uavs[0]]
        assert isinstance(uav, Multirotor)
        self.fly_step = multirotor.make_multirotor_step(embodied(uav), mission.engine, timing.dt_s)
        self.drive_step: skid_steer.Step | None = None
        if roles.rover is not None:
            rover = scenario.vehicles[roles.rover]
            assert isinstance(rover, SkidSteer)
            self.drive_step = skid_steer.make_skid_steer_step(rover, mission.engine, timing.dt_s)

    # -- phase 1 ------------------------------------------------------------------------------------------------------

    def plan_survey(self, world: World) -> Path:
        """One path per UAV (leading axis U)."""
        return self.aerial_policy(world.survey, world.site)

    def ready_to_fly(self, key: jax.Array, world: World) -> Flight:
        """The UAVs at rest on their pads (leading axis U)."""
        gusts = keys.consumer(key, "gust start")

        def one(index: jax.Array, params: Any, home: jax.Array, yaw: jax.Array) -> Flight:
            ground = flying.ground_below(world.site, jnp.append(home, 0.0))
            return Flight(
                vehicle=multirotor.rest_state(params, ground, yaw),
                memory=control_start(),
                gust=gust_start(jax.random.fold_in(gusts, index)),
                progress_m=jnp.zeros(()),
                event_time_s=events.none_yet(),
            )

        team = world.team
        return jax.vmap(one)(jnp.arange(team.home_m.shape[0]), team.params, team.home_m, team.yaw_rad)

    def fly(self, key: jax.Array, world: World, paths: Path, flights: Flight, ticks: jax.Array) -> tuple[Flight, Log]:
        """Fly the UAVs along their paths for the ticks numbered ``ticks`` [T]; logs have the axes [T, U]."""
        period = self.timing.dt_s * self.timing.substeps

        def guide_of(guided: tuple[Path, jax.Array], traffic: Traffic) -> flying.Guide:
            path, yaw = guided
            return lambda progress, position: flying.follow(path, progress, position, traffic, yaw, period)

        return self._fly_guided(key, world, flights, ticks, guide_of, (paths, world.team.yaw_rad), paths.length_m)

    def steer(
        self, key: jax.Array, world: World, flights: Flight, ticks: jax.Array, setpoints: Setpoint
    ) -> tuple[Flight, Log]:
        """Fly the UAVs towards fixed setpoints (leading axis U) instead of along paths; no right of way is kept."""

        def guide_of(setpoint: Setpoint, traffic: Traffic) -> flying.Guide:
            return lambda progress, position: (setpoint, progress)

        endless = jnp.full(world.team.home_m.shape[0], jnp.inf)
        return self._fly_guided(key, world, flights, ticks, guide_of, setpoints, endless)

    def _fly_guided(
        self,
        key: jax.Array,
        world: World,
        flights: Flight,
        ticks: jax.Array,
        guide_of: Callable[[Any, Traffic], flying.Guide],
        guided: Any,
        length_m: jax.Array,
    ) -> tuple[Flight, Log]:
        """Ticks of all UAVs, each guided by ``guide_of`` its part of ``guided`` (leading axis U) and the traffic."""
        team, timing, site = world.team, self.timing, world.site
        gust_keys = keys.per_tick(keys.consumer(key, "gusts"), ticks, team.home_m.shape[0])

        def one(
            traffic: Traffic,
            now: jax.Array,
            params: Any,
            limits: Any,
            flight: Flight,
            guided: Any,
            length: Any,
            gust_key: Any,
        ) -> Flight:
            flown = flying.fly_tick(
                params, flight, guide_of(guided, traffic), world.air, site, gust_key,
                step=self.fly_step, periods=timing.uav_periods, substeps=timing.substeps, dt=timing.dt_s,
            )  # fmt: skip
            return flying.judge(params, limits, flight, flown, length - flown.progress_m, traffic, site, now)

        def tick(flights: Flight, inputs: tuple[jax.Array, jax.Array]) -> tuple[Flight, Log]:
            number, gust_key = inputs
            now = (number + 1) * timing.uav_tick_s
            active = events.under_way(flights.event_time_s)
            position = flights.vehicle.body.position_m
            traffic = flying.keep_apart(position, active, team.limits[:, 0], team.separation_m)
            each = jax.vmap(one, in_axes=(0, None, 0, 0, 0, 0, 0, 0))
            flights = each(traffic, now, team.params, team.limits, flights, guided, length_m, gust_key)
            return flights, _log(flights.vehicle, flights.event_time_s, now)

        return jax.lax.scan(tick, flights, (ticks, gust_keys))

    # -- phase 3 ------------------------------------------------------------------------------------------------------

    def plan_route(self, world: World, target_m: jax.Array, found: jax.Array) -> Path:
        """The rover's path to and round a target [2]; of length zero if nothing was ``found`` []."""
        assert world.search is not None
        path = self.ground_policy(replace(world.search, target_m=target_m), world.site)
        stay = replace(path, points_m=jnp.broadcast_to(path.points_m[0], path.points_m.shape), length_m=jnp.zeros(()))
        return jax.tree.map(lambda go, no: jnp.where(found, go, no), path, stay)

    def ready_to_drive(self, world: World, site_time_s: jax.Array) -> Drive:
        """The rover at rest at its start."""
        rover = world.rover
        assert rover is not None
        return Drive(
            vehicle=skid_steer.rest_state(rover.params, world.site, rover.start_m, rover.yaw_rad),
            progress_m=jnp.zeros(()),
            start_s=site_time_s,
            event_time_s=events.none_yet(),
        )

    def drive(self, world: World, path: Path, rover: Drive, ticks: jax.Array) -> tuple[Drive, Log]:
        """Drive the rover along its path for the ticks numbered ``ticks`` [T]; the log has the axis [T]."""
        assert world.rover is not None
        params, period = world.rover.params, self.timing.dt_s * self.timing.substeps

        def guide(vehicle: SkidSteerState, progress: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            position = vehicle.body.position_m
            target, limit, progress = driving.carrot(path, params.lookahead_m, progress, position, period)
            return *pursue(params, vehicle, target, limit), progress

        return self._drive_guided(
            world, rover, ticks, self.timing.rover_periods, guide, path.length_m, path.points_m[-1]
        )

    def steer_rover(
        self, world: World, rover: Drive, ticks: jax.Array, speed_m_s: jax.Array, yaw_rate_rad_s: jax.Array
    ) -> tuple[Drive, Log]:
        """Drive the rover at a speed and a yaw rate instead of along a path, in ticks of the UAVs."""
        nowhere = jnp.full(3, jnp.inf)
        return self._drive_guided(
            world, rover, ticks, self.timing.uav_periods,
            lambda vehicle, progress: (speed_m_s, yaw_rate_rad_s, progress), jnp.inf, nowhere,
        )  # fmt: skip

    def _drive_guided(
        self,
        world: World,
        rover: Drive,
        ticks: jax.Array,
        periods: int,
        guide: driving.Guide,
        length_m: jax.Array | float,
        end_m: jax.Array,
    ) -> tuple[Drive, Log]:
        assert world.rover is not None
        assert self.drive_step is not None
        params, timing, step = world.rover.params, self.timing, self.drive_step
        tick_s = timing.dt_s * timing.substeps * periods

        def tick(rover: Drive, number: jax.Array) -> tuple[Drive, Log]:
            now = rover.start_s + (number + 1) * tick_s
            moved = driving.drive_tick(
                params, rover, guide, world.site, step=step, periods=periods, substeps=timing.substeps, dt=timing.dt_s
            )
            remaining = length_m - moved.progress_m
            rover = driving.judge(params, rover, moved, end_m, remaining, world.site, now)
            return rover, _log(rover.vehicle, rover.event_time_s, now)

        return jax.lax.scan(tick, rover, ticks)


def _log(vehicle: MultirotorState | SkidSteerState, event_time_s: jax.Array, now: jax.Array) -> Log:
    """Log of this tick; an event that came at its end still counts as under way during it."""
    body = vehicle.body
    return Log(
        time_s=jnp.broadcast_to(now, vehicle.energy_j.shape),
        position_m=body.position_m,
        quaternion=body.quaternion,
        velocity_m_s=body.velocity_m_s,
        energy_j=vehicle.energy_j,
        active=jnp.all(event_time_s >= now, axis=-1),
    )
