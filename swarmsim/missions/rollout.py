"""The reconnaissance mission, B missions at once: survey, map, estimate, route, drive, identify, refine."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.scenario import Scenario
from swarmsim.estimation import Measurements
from swarmsim.missions import events, keys, knowledge
from swarmsim.missions.batching import Axes, batched, one_by_one, shards_of, spread
from swarmsim.missions.drive import Drive
from swarmsim.missions.flight import Flight
from swarmsim.missions.knowledge import AerialKnowledge, GroundKnowledge, learn_from_ground
from swarmsim.missions.measure import Log
from swarmsim.missions.progress import Progress, SilentProgress
from swarmsim.missions.simulation import Dynamics
from swarmsim.missions.stage import Clock, Stage
from swarmsim.missions.world import Roles, World, build_timing, build_world, roles_of
from swarmsim.policies.path import Path
from swarmsim.site import SiteModel

SEGMENT_TICKS = 256  # between two looks at the progress
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
        self._stages: dict[tuple[str, int], Stage] = {}
        self._per_window = max(1, round(scenario.mission.localisation.window_s / self.timing.uav_tick_s))

    @property
    def nuclide_names(self) -> tuple[str, ...]:
        """The library's nuclides, in the order of their indices."""
        return self.world.team.detector.nuclide_names

    def rollout(self, seeds: Any, progress: Progress | None = None) -> MissionBatch:
        """Fly the missions of ``seeds`` (a number, or a sequence of B) to their end."""
        tell = progress or SilentProgress()
        seeds = np.atleast_1d(np.asarray(seeds, np.int64))
        self.clock.reset()
        # every device flies as many: the last seed fills up, and its copies are not looked at
        shards = shards_of(len(seeds))
        filled = np.append(seeds, np.repeat(seeds[-1], -len(seeds) % shards))
        mission_keys = keys.mission_keys(filled)
        aerial = self._survey(mission_keys, tell)
        ground = None if self.world.rover is None else self._search(mission_keys, aerial, tell)
        return MissionBatch(seeds=seeds, aerial=aerial, ground=ground, clock=self.clock)

    def _survey(self, mission_keys: jax.Array, tell: Progress) -> Aerial:
        missions, per_window = len(mission_keys), self._per_window
        starts = self.scenario.mission.localisation.starts
        plan = self.stage("plan the survey", self.dynamics.plan_survey, (None,), missions)
        ready = self.stage("take off", self.dynamics.ready_to_fly, (0, None), missions)
        fly = self.stage("fly", self.dynamics.fly, (0, None, 0, 0, None), missions)
        count = self.stage("count", knowledge.count_from_air, (0, None, 0), missions, in_step=False)
        learn = self.stage(
            "learn from the air",
            lambda world, counts: knowledge.learn_from_air(world, counts, per_window, starts),
            (None, 0), missions, in_step=False,
        )  # fmt: skip
        paths = plan(self.world)
        flights, log = self._segments(
            "aerial survey", tell, self.scenario.mission.aerial.time_limit_s, self.timing.uav_tick_s, SEGMENT_TICKS,
            lambda state, ticks: fly(mission_keys, self.world, paths, state, ticks), ready(mission_keys, self.world),
        )  # fmt: skip
        tell.phase("map and estimate", 0.0)
        measurements = count(mission_keys, self.world, log)
        learned = learn(self.world, measurements)
        return Aerial(
            paths=paths,
            flights=flights,
            log=log,
            measurements=measurements,
            knowledge=learned,
            end_s=_end(flights.event_time_s, log.time_s).max(axis=1),
        )

    def _search(self, mission_keys: jax.Array, aerial: Aerial, tell: Progress) -> Ground:
        missions, per_window, per_sample = len(mission_keys), self._per_window, self.timing.rover_ticks
        plan = self.stage("plan the route", self.dynamics.plan_route, (None, 0, 0), missions, in_step=False)
        ready = self.stage("set out", self.dynamics.ready_to_drive, (None, 0), missions)
        drive = self.stage("drive", self.dynamics.drive, (None, 0, 0, None), missions)
        count = self.stage(
            "count on the ground",
            lambda key, world, log: knowledge.count_on_ground(key, world, log, per_sample),
            (0, None, 0), missions, in_step=False,
        )  # fmt: skip
        learn = self.stage(
            "learn from the ground",
            lambda key, world, known, air, counts: learn_from_ground(key, world, known, air, counts, per_window),
            (0, None, 0, 0, 0), missions, in_step=False,
        )  # fmt: skip
        tell.phase("plan the route", 0.0)
        route = plan(self.world, aerial.knowledge.fit.position_m[:, :2], aerial.knowledge.found)
        segment = per_sample * max(1, round(ROVER_SEGMENT_S / (per_sample * self.timing.rover_tick_s)))
        rover, log = self._segments(
            "ground search", tell, self.scenario.mission.ground.time_limit_s, self.timing.rover_tick_s, segment,
            lambda state, ticks: drive(self.world, route, state, ticks), ready(self.world, aerial.end_s),
        )  # fmt: skip
        tell.phase("identify and refine", 0.0)
        measurements = count(mission_keys, self.world, log)
        learned = learn(mission_keys, self.world, aerial.knowledge, aerial.measurements, measurements)
        return Ground(
            route=route,
            rover=rover,
            log=log,
            measurements=measurements,
            knowledge=learned,
            end_s=_end(rover.event_time_s, log.time_s),
        )

    def _segments(
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

    def stage(
        self, name: str, function: Any, axes: Axes, missions: int, *, in_step: bool = True, out_axes: Any = 0
    ) -> Stage:
        """The compiled form for a number of missions of a function of one: ``axes`` tells which arguments are theirs.

        ``in_step`` missions are vmapped, else they run one after the other. What is compiled is kept for the life of
        the simulation.
        """
        if (name, missions) not in self._stages:
            shards = shards_of(missions) if out_axes == 0 else 1
            part = batched(function, axes, missions // shards, out_axes) if in_step else one_by_one(function, axes)
            self._stages[name, missions] = Stage(name, spread(part, axes, shards), self.clock)
        return self._stages[name, missions]


def _end(event_time_s: jax.Array, log_time_s: jax.Array) -> jax.Array:
    """When each vehicle ended its part; the end of the log for one that never did."""
    first = jnp.min(event_time_s, axis=-1)
    return jnp.where(jnp.isfinite(first), first, log_time_s[:, -1])
