"""A scenario built at its site: rolled out as whole missions, or stepped by hand."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim import randomness
from swarmsim.config.errors import InputError, Problem, raise_if_any
from swarmsim.config.family import CAN_VARY, canonical, ends_of
from swarmsim.config.scenario import Scenario
from swarmsim.config.site_checks import check_site
from swarmsim.config.values import with_values
from swarmsim.families.draw import Drawer, Draws, with_given
from swarmsim.missions.begin import begin_mission, begin_phase
from swarmsim.missions.knowledge import Conclusion, conclude, gathered, survey
from swarmsim.missions.plan import Plan
from swarmsim.missions.plan_build import build_plan, listens
from swarmsim.missions.segment import segment
from swarmsim.missions.state import Log, MissionState, Signals
from swarmsim.runtime.batch import Again, Batch, Spread, filled, layout_for
from swarmsim.runtime.clock import Clock
from swarmsim.runtime.progress import Progress, SilentProgress
from swarmsim.scalars import Layout
from swarmsim.site import SiteModel
from swarmsim.world.build import build_world
from swarmsim.world.model import World
from swarmsim.world.state import Clock as WorldClock
from swarmsim.world.state import WorldState, moving
from swarmsim.world.step import reset

AT_ONCE = 8  # decision periods that one call runs: each call costs the host 2 ms


@dataclass(frozen=True)
class Segment:
    """What some decision periods in a row left."""

    log: Log  # arrays [B, periods or more, …] of the groups that ran, None for the others
    periods: int  # how many were simulated; what follows is void

    def of(self, mission: int, logged: Any) -> np.ndarray:
        """One mission's rows [T, …] of an array of the log, all periods in one axis."""
        rows = np.asarray(logged)[mission, : self.periods]
        return rows.reshape(-1, *rows.shape[2:])


@dataclass(frozen=True)
class MissionBatch:
    """B missions as they were flown."""

    seeds: np.ndarray  # [B]
    worlds: Spread
    plans: Spread
    end: MissionState  # [B, …] at the end, its clock left out
    segments: tuple[Segment, ...]
    conclusion: Conclusion | None  # [B, …]; None where the mission estimates no source
    clock: Clock
    draws: Draws  # what differs between them besides their seeds

    @property
    def simulated_s(self) -> float:
        """Simulated seconds of all missions."""
        return float(np.sum(np.asarray(self.end.over_s)[: len(self.seeds)]))


class Simulation:
    """A scenario built at its site.

    ``world`` and ``plan`` are one mission's, for use with the pure functions of `swarmsim.world.step`; of a family
    (`vary` of the mission) those of the scenario's own seed. Roll out as often as you like, with whatever values: what
    has been compiled is kept, also for other simulations that differ from this one in values only.
    """

    def __init__(self, scenario: Scenario, site_model: SiteModel):
        """Build the arrays; nothing is compiled yet.

        Raises `InputError` where periods, detectors and vehicles do not go together, or nothing can be drawn.
        """
        self.scenario, self.site_model = scenario, site_model
        self._drawer = Drawer(scenario, site_model)
        seed = scenario.mission.seed
        self.draws = self._drawer.draw([seed])
        self.world, self.plan = self._drawn(seed, {path: value for path, (value,) in self.draws.values.items()})
        self._batches: dict[int, Batch] = {}
        self.clock = Clock()

    def reset(self, seed: int) -> WorldState:
        """One mission's world at its start, to be stepped by hand with `swarmsim.step`: every vehicle is active."""
        return reset(self.world, jax.random.key(seed))

    def draw(self, seeds: int | Sequence[int] | np.ndarray) -> Draws:
        """What the missions ``seeds`` of a family draw; ``values`` of it can be changed and given to `rollout`."""
        return self._drawer.draw(np.atleast_1d(np.asarray(seeds, np.int64)))

    def world_of(self, seed: int) -> World:
        """The world of the mission ``seed`` of a family, to be stepped by hand; of the shapes of ``world``."""
        world, plan = self._drawn(seed, {path: value for path, (value,) in self.draw(seed).values.items()})
        self._check_alike((world, plan), self.draws.values)
        return world

    def check_family(self) -> None:
        """Build the mission at the ends of every distribution, one at a time; raises `InputError` where that fails."""
        own = {path: value for path, (value,) in self.draws.values.items()}
        first = {varied.key: varied for varied in reversed(self.scenario.family)}
        problems: list[Problem] = []
        for key, varied in first.items():
            for value in ends_of(varied):
                try:
                    built = _built(with_values(self.scenario, own | {varied.path: value}), self.site_model)
                    self._check_alike(built, [key])
                except InputError as error:
                    told, place = error.problems[0], ("vary", key, varied.distribution.kind)
                    hints = {"allowed": told.allowed or CAN_VARY, "suggestion": told.suggestion}
                    message = f"draws a value with which the mission is wrong: {told.message}"
                    problems.append(self.scenario.problem(place, message, given=str(value), **hints))
                    break
        raise_if_any(problems)

    def rollout(
        self,
        seeds: int | Sequence[int] | np.ndarray,
        values: Mapping[str, Sequence[Any]] | None = None,
        progress: Progress | None = None,
    ) -> MissionBatch:
        """Run the missions of ``seeds`` to their end, in one batch.

        Args:
            seeds: a number, or a sequence of B.
            values: for each path of the scenario (``"sources.0.activity_mbq"``) a value for each of the B missions,
                in the stead of what a family draws there.
            progress: is told how far the missions are.

        Raises:
            InputError: a path or a value is wrong, or changes more than values (a count, a policy, a period).
        """
        tell = progress or SilentProgress()
        numbers = np.atleast_1d(np.asarray(seeds, np.int64))
        padded = filled(numbers)
        batch = self._batches.setdefault(len(padded), Batch(len(padded), self.clock))
        self.clock.reset()
        layout = layout_for(self.world.vehicles * batch.missions // batch.shards)
        draws = self._given(self.draw(numbers), values or {})
        worlds, plans = self._spread(batch, draws, layout)
        run = MissionRun(batch, worlds, plans, self.plan, tell)
        keys = batch.put(randomness.mission_keys(padded))
        end, segments = run.fly(keys)
        return MissionBatch(
            seeds=numbers,
            worlds=worlds,
            plans=plans,
            end=end,
            segments=tuple(segments),
            conclusion=run.conclude(end, keys),
            clock=self.clock.copy(),
            draws=draws,
        )

    def alone(self, seed: int) -> "tuple[Draws, Batch, Spread, Spread]":
        """One mission's draws, and what its programs work on: for a host that runs them one by one."""
        draws = self.draw(seed)
        batch = self._batches.setdefault(1, Batch(1, self.clock))
        return draws, batch, *self._spread(batch, draws, layout_for(self.world.vehicles))

    def _given(self, draws: Draws, values: Mapping[str, Sequence[Any]]) -> Draws:
        """The draws with ``values`` in their stead."""
        missions = len(draws.seeds)
        for path, each in values.items():
            if len(each) != missions:
                raise InputError.of(
                    "needs a value for each mission", path=path, given=f"{len(each)} values", allowed=str(missions)
                )
        scenario = self.scenario
        named = {canonical(scenario.document, path, scenario.mission_file): each for path, each in values.items()}
        return with_given(draws, named)

    def _drawn(self, seed: int, row: Mapping[str, Any]) -> tuple[World, Plan]:
        """World and plan of a mission with these values; raises `InputError`, which tells the seed, for wrong ones."""
        scenario = self.scenario
        if not row:
            return _built(scenario, self.site_model)
        try:
            scenario = with_values(scenario, row)
            if self.scenario.family:
                raise_if_any(check_site(scenario, self.site_model))
            return _built(scenario, self.site_model)
        except InputError as error:
            if not self.scenario.family:
                raise
            drawn = [replace(p, message=f"{p.message} (in the mission of seed {seed})") for p in error.problems]
            raise InputError(drawn) from None

    def _spread(self, batch: Batch, draws: Draws, layout: Layout) -> tuple[Spread, Spread]:
        """World and plan of every mission."""
        values = draws.values
        if not values:
            return batch.spread([replace(self.world, layout=layout)]), batch.spread([self.plan])
        built: dict[tuple[Any, ...], tuple[World, Plan]] = {}
        pairs = []
        for seed, row in zip(draws.seeds, zip(*values.values(), strict=True), strict=True):
            key = tuple(map(repr, row))
            if key not in built:
                built[key] = self._drawn(seed, dict(zip(values, row, strict=True)))
                self._check_alike(built[key], values)
            pairs.append(built[key])
        worlds = [replace(world, layout=layout) for world, _ in pairs]
        return batch.spread(worlds), batch.spread([plan for _, plan in pairs])

    def _check_alike(self, built: tuple[World, Plan], values: Iterable[str]) -> None:
        """Refuse what would need another program: other sizes, or other static choices."""
        for own, other in zip((self.world, self.plan), built, strict=True):
            leaves, structure = jax.tree.flatten(own)
            others, other_structure = jax.tree.flatten(other)
            if str(structure) != str(other_structure) or [*map(np.shape, leaves)] != [*map(np.shape, others)]:
                raise InputError.of(
                    "changes more than a value (a number of things, a policy, a period, a size): missions of one batch "
                    "must agree in those",
                    path=", ".join(values),
                    suggestion="roll out a simulation of its own for each",
                )


def _built(scenario: Scenario, site_model: SiteModel) -> tuple[World, Plan]:
    mates = scenario.mission.radio.mates if listens(scenario) else 0
    world = build_world(scenario, site_model, mates)
    return world, build_plan(scenario, site_model, world)


class MissionRun:
    """One rollout: the host's side of it."""

    def __init__(self, batch: Batch, worlds: Spread, plans: Spread, plan: Plan, tell: Progress):
        self._batch, self._plan, self._tell = batch, plan, tell
        self._inputs = (worlds, plans)
        self._estimates = plan.localisation is not None and plan.mapping is not None

    def fly(self, keys: Any) -> tuple[MissionState, list[Segment]]:
        """All missions to their end, a decision period at a time."""
        batch, names = self._batch, [phase.name for phase in self._plan.phases]
        mission, signals = self.reset(keys)
        self._prepare(keys, mission)
        world = self._first_world()
        timing, tick = world.timing, 0
        segments: list[Segment] = []
        horizon = float(sum(float(np.max(phase.time_limit_s)) for phase in self._plan.phases))
        told: tuple[str, ...] = ()
        begin, active = np.asarray(signals.begin), np.asarray(signals.active)
        while True:
            for number in np.flatnonzero(begin.any(axis=0)):
                self._tell.phase(f"plan {names[number]}", 0.0)
                mission = batch.run(**self.beginning(int(number), mission, tick, begin[:, number]))
                told = ()
            running = self._running(mission) if begin.any() else np.asarray(active.any(axis=0))
            mission, (log, ran), (signals, ticks), periods = batch.run(**self._advance(mission, tick, running))
            tick = int(np.asarray(ticks)[0])
            segments.append(_segment_of(log, np.asarray(ran)[0], int(np.asarray(periods)[0])))
            begin, active = np.asarray(signals.begin), np.asarray(signals.active)
            running_phases = np.flatnonzero(np.asarray(signals.running).any(axis=0))
            under_way = tuple(names[number] for number in running_phases)
            if under_way and under_way != told:
                self._tell.phase(" + ".join(under_way), horizon)
                told = under_way
            seconds = tick * timing.control_period_s
            if told:
                self._tell.advance(seconds, tick, max(tick, int(horizon / timing.control_period_s)))
            if bool(np.asarray(signals.over).all()):
                return mission, segments

    def reset(self, keys: Any) -> tuple[MissionState, Signals]:
        """All missions at their beginning."""
        self._tell.phase("compile", 0.0)
        begun: tuple[MissionState, Signals] = self._batch.run("reset", _begin_mission, self._inputs, keys)
        return begun

    def beginning(self, number: int, mission: MissionState, tick: int, begin: np.ndarray) -> dict[str, Any]:
        """The call that begins a phase in the missions ``begin`` [B]."""
        return {
            "name": f"begin {self._plan.phases[number].name}",
            "function": partial(_begin_phase, number),
            "inputs": self._inputs,
            "carried": mission,
            "common": (np.int32(tick),),
            "only": self._batch.put(begin),
            "donate": True,
            "shared": True,
        }

    def _advance(self, mission: MissionState, tick: int, running: np.ndarray) -> dict[str, Any]:
        """The call that runs a segment."""
        common = (np.int32(tick), np.asarray(running, bool))
        return {
            "name": "run",
            "function": _segment,
            "inputs": self._inputs,
            "carried": mission,
            "common": common,
            "donate": True,
            "again": Again(AT_ONCE, _onward),
        }

    def _conclusion(self, mission: MissionState, keys: Any) -> dict[str, Any]:
        """The call that concludes the missions."""
        carried = (jax.random.key_data(keys), mission)
        return {
            "name": "conclude",
            "function": _conclude,
            "inputs": self._inputs,
            "carried": carried,
            "in_turn": True,
            "shared": True,
        }

    def _prepare(self, keys: Any, mission: MissionState) -> None:
        """Begin to load or compile all programs of the mission, in the order that they are needed."""
        nobody, groups = np.zeros(self._batch.missions, bool), len(mission.world.groups)
        beginnings = [self.beginning(number, mission, 0, nobody) for number in range(len(self._plan.phases))]
        calls = [*beginnings[:1], self._advance(mission, 0, np.ones(groups, bool)), *beginnings[1:]]
        calls += [self._conclusion(mission, keys)] if self._estimates else []
        self._batch.prepare(calls)

    def _first_world(self) -> World:
        structure = self._inputs[0].structure
        return jax.tree.unflatten(structure, [None] * structure.num_leaves)

    def _running(self, mission: MissionState) -> np.ndarray:
        """Groups [G] with a vehicle that is moved on in any mission."""
        return np.array([bool(np.asarray(moving(g)).any()) for g in mission.world.groups])

    def conclude(self, mission: MissionState, keys: Any) -> Conclusion | None:
        """What the missions found in the end."""
        if not self._estimates:
            return None
        self._tell.phase("estimate and identify", 0.0)
        return self._batch.run(**self._conclusion(mission, keys))


def with_clock(mission: MissionState, tick: jax.Array, running: jax.Array) -> MissionState:
    world = mission.world
    clock, key = WorldClock(tick=tick, running=running), jax.random.wrap_key_data(world.key)
    return replace(mission, world=replace(world, clock=clock, key=key))


def without_clock(mission: MissionState) -> MissionState:
    """The mission without what all missions have in common, so that every leaf has the mission axis.

    Its key goes as plain numbers: JAX calls a program that returns keys in Python, 1 ms each time.
    """
    world = mission.world
    bare = replace(world, clock=None, key=jax.random.key_data(world.key))  # type: ignore[arg-type]
    return replace(mission, world=bare)


def _begin_mission(world: World, plan: Plan, key: jax.Array) -> tuple[MissionState, Signals]:
    mission, signals = begin_mission(key, world, plan)
    return without_clock(mission), signals


def _begin_phase(number: int, world: World, plan: Plan, mission: MissionState, tick: jax.Array) -> MissionState:
    running = jnp.ones(len(world.groups), bool)
    return without_clock(begin_phase(world, plan, with_clock(mission, tick, running), number))


def _segment(
    world: World, plan: Plan, mission: MissionState, tick: jax.Array, running: jax.Array
) -> tuple[MissionState, tuple[Log, jax.Array], tuple[Signals, jax.Array]]:
    mission, log, signals = segment(world, plan, with_clock(mission, tick, running))
    return without_clock(mission), (log, running), (signals, tick + world.timing.decision_ticks)


def _onward(verdict: tuple[Signals, jax.Array], _: Any) -> tuple[jax.Array, Any]:
    """Whether all missions go on without the host, and with which clock."""
    signals, ticks = verdict
    return ~jnp.any(signals.begin) & ~jnp.all(signals.over), (ticks[0], jnp.any(signals.active, axis=0))


def _conclude(world: World, plan: Plan, carried: tuple[jax.Array, MissionState]) -> Conclusion:
    key, mission = jax.random.wrap_key_data(carried[0]), carried[1]
    measurements = gathered(world, plan, mission.windows, key)
    known = survey(plan, *measurements) if mission.survey is None else mission.survey
    return conclude(key, world, plan, known, *measurements, mission.trail)


def _segment_of(log: Log, ran: np.ndarray, periods: int) -> Segment:
    """The segment without the groups that rested throughout; ``ran`` [periods or more, G]."""
    kept = [bool(np.any(group)) for group in ran[:periods].T]
    tracks = tuple(t if k else None for t, k in zip(log.tracks, kept, strict=True))
    samples = tuple(s if k else None for s, k in zip(log.samples, kept, strict=True))
    return Segment(log=replace(log, tracks=tracks, samples=samples), periods=periods)  # type: ignore[arg-type]


__all__ = ["MissionBatch", "MissionRun", "Segment", "Simulation"]
