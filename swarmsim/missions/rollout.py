"""The reconnaissance mission, B missions at once: survey, map, estimate, route, drive, identify, refine."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.scenario import Scenario
from swarmsim.estimation import Measurements
from swarmsim.missions import events, keys
from swarmsim.missions.batching import Axes, shards_of
from swarmsim.missions.drive import Drive
from swarmsim.missions.flight import Flight
from swarmsim.missions.knowledge import AerialKnowledge, GroundKnowledge
from swarmsim.missions.measure import Log
from swarmsim.missions.progress import Progress, SilentProgress
from swarmsim.missions.simulation import Dynamics
from swarmsim.missions.stage import Clock, Stage
from swarmsim.missions.stages import Stages, batch_stage
from swarmsim.missions.world import Roles, World, build_timing, build_world, roles_of
from swarmsim.policies.path import Path
from swarmsim.site import SiteModel

SEGMENT_TICKS = 256  # ticks of the UAVs between two looks at the progress
ROVER_SEGMENT_S = 12.0  # the same for the rover, in simulated time


@dataclass(frozen=True)
class Aerial:
    """Phase 1 and what was learned from it; every array has the leading axis B."""

    paths: Path  # [B, U, …]
    flights: Flight  # [B, U, …] at the end
    log: Log  # [B, T, U, …]
    measurements: Measurements  # [B, U, T]
    knowledge: AerialKnowledge
    end_s: jax.Array  # [B] when the last UAV of the mission had ended its flight


@dataclass(frozen=True)
class Ground:
    """Phase 3 and what was learned from it; every array has the leading axis B."""

    route: Path
    rover: Drive
    log: Log  # [B, T, …]
    measurements: Measurements  # [B, n]
    knowledge: GroundKnowledge
    end_s: jax.Array  # [B]


@dataclass(frozen=True)
class MissionBatch:
    """B missions as they were flown."""

    seeds: np.ndarray  # [B]
    aerial: Aerial
    ground: Ground | None
    clock: Clock

    @property
    def simulated_s(self) -> float:
        """Simulated seconds of all phases of all missions."""
        end = self.aerial.end_s if self.ground is None else self.ground.end_s
        return float(jnp.sum(end[: len(self.seeds)]))


class Simulation:
    """A scenario built at its site, ready to be rolled out or stepped by hand.

    Build once, roll out as often as you like: what has been compiled is kept.
    """

    def __init__(self, scenario: Scenario, site_model: SiteModel):
        """Build the world's arrays and the functions of one mission; nothing is compiled yet.

        Raises `InputError` where the team, its detectors and the time step do not go together.
        """
        self.scenario, self.site_model = scenario, site_model
        self.roles: Roles = roles_of(scenario)
        self.timing = build_timing(scenario, self.roles)
        self.world: World = build_world(scenario, site_model, self.roles)
        self.dynamics = Dynamics(scenario, self.roles, self.timing)
        self.clock = Clock()
        self._stages: dict[int, Stages] = {}
        self._single: dict[tuple[str, int], Stage] = {}

    @property
    def nuclide_names(self) -> tuple[str, ...]:
        """The library's nuclides, in the order of their indices."""
        return self.world.team.detector.nuclide_names

    @property
    def per_window(self) -> int:
        """The UAVs' samples in one window of the estimate."""
        return max(1, round(self.scenario.mission.localisation.window_s / self.timing.uav_tick_s))

    def rollout(self, seeds: Any, progress: Progress | None = None) -> MissionBatch:
        """Fly the missions of ``seeds`` (a number, or a sequence of B) to their end."""
        tell = progress or SilentProgress()
        seeds = np.atleast_1d(np.asarray(seeds, np.int64))
        self.clock.reset()
        # every device flies as many: the last seed fills up, and its copies are not looked at
        filled = np.append(seeds, np.repeat(seeds[-1], -len(seeds) % shards_of(len(seeds))))
        mission_keys = keys.mission_keys(filled)
        do = self.stages(len(filled))
        aerial = self._survey(do, mission_keys, tell)
        ground = None if self.world.rover is None else self._search(do, mission_keys, aerial, tell)
        return MissionBatch(seeds=seeds, aerial=aerial, ground=ground, clock=self.clock.copy())

    def _survey(self, do: Stages, key: jax.Array, tell: Progress) -> Aerial:
        """Phase 1: plan, fly until every UAV has landed, map the counts and estimate the source."""
        world = self.world
        limit = self.scenario.mission.aerial.time_limit_s
        paths = do.plan_survey(world)
        flights, log = self._until_ended(
            "aerial survey", tell, limit, self.timing.uav_tick_s, SEGMENT_TICKS,
            lambda flights, ticks: do.fly(key, world, paths, flights, ticks), do.ready_to_fly(key, world),
        )  # fmt: skip
        tell.phase("map and estimate", 0.0)
        counts = do.count_from_air(key, world, log)
        known = do.learn_from_air(world, counts)
        end = _end(flights.event_time_s, log.time_s).max(axis=1)
        return Aerial(paths=paths, flights=flights, log=log, measurements=counts, knowledge=known, end_s=end)

    def _search(self, do: Stages, key: jax.Array, aerial: Aerial, tell: Progress) -> Ground:
        """Phase 3: route the rover to the estimate, drive, identify the nuclide and refine the estimate."""
        world, timing, known = self.world, self.timing, aerial.knowledge
        limit = self.scenario.mission.ground.time_limit_s
        samples = max(1, round(ROVER_SEGMENT_S / (timing.rover_ticks * timing.rover_tick_s)))
        tell.phase("plan the route", 0.0)
        route = do.plan_route(world, known.fit.position_m[:, :2], known.found)
        rover, log = self._until_ended(
            "ground search", tell, limit, timing.rover_tick_s, samples * timing.rover_ticks,
            lambda rover, ticks: do.drive(world, route, rover, ticks), do.ready_to_drive(world, aerial.end_s),
        )  # fmt: skip
        tell.phase("identify and refine", 0.0)
        counts = do.count_on_ground(key, world, log)
        learned = do.learn_from_ground(key, world, known, aerial.measurements, counts)
        end = _end(rover.event_time_s, log.time_s)
        return Ground(route=route, rover=rover, log=log, measurements=counts, knowledge=learned, end_s=end)

    def _until_ended(
        self, name: str, tell: Progress, limit_s: float, tick_s: float, ticks: int, advance: Any, state: Any
    ) -> tuple[Any, Log]:
        """Advance by segments until every vehicle of every mission has ended its part, or the time is up."""
        tell.phase(name, limit_s)
        total, logs, done = int(np.ceil(limit_s / (tick_s * ticks))), [], 0
        while done < total:
            state, log = advance(state, jnp.arange(done * ticks, (done + 1) * ticks))
            logs.append(log)
            done += 1
            tell.advance(done * ticks * tick_s, done, total)
            if not bool(jnp.any(events.under_way(state.event_time_s))):
                break
        return state, jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=1), *logs)

    def stages(self, missions: int) -> Stages:
        """The compiled steps of a batch of so many missions, kept for the life of the simulation."""
        if missions not in self._stages:
            starts = self.scenario.mission.localisation.starts
            self._stages[missions] = Stages(self.dynamics, missions, starts, self.per_window, self.clock)
        return self._stages[missions]

    def stage(self, name: str, function: Any, axes: Axes, missions: int, out_axes: Any = 0) -> Stage:
        """One more compiled function of a batch, kept under its name (see `batch_stage`)."""
        if (name, missions) not in self._single:
            self._single[name, missions] = batch_stage(name, function, axes, missions, self.clock, out_axes=out_axes)
        return self._single[name, missions]


def _end(event_time_s: jax.Array, log_time_s: jax.Array) -> jax.Array:
    """When each vehicle ended its part; the end of the log for one that never did."""
    first = jnp.min(event_time_s, axis=-1)
    return jnp.where(jnp.isfinite(first), first, log_time_s[:, -1])
