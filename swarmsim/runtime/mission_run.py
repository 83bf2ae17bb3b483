"""One rollout: its programs, and the host's part between them."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.estimation import Measurements
from swarmsim.missions.begin import begin_mission, begin_phase
from swarmsim.missions.knowledge import (
    Accumulated,
    Conclusion,
    Inquiry,
    gathered,
    learn,
    named,
    premises_of,
)
from swarmsim.missions.plan import Plan
from swarmsim.missions.segment import segment
from swarmsim.missions.state import Log, MissionState, Signals, Survey
from swarmsim.radiation.identify import Identification
from swarmsim.runtime.batch import Again, Batch, Spread
from swarmsim.runtime.progress import Progress
from swarmsim.world.model import World
from swarmsim.world.state import Clock as WorldClock
from swarmsim.world.state import moving

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


class MissionRun:
    """One rollout: the host's side of it."""

    def __init__(self, batch: Batch, worlds: Spread, plans: Spread, plan: Plan, tell: Progress):
        self._batch, self._plan, self._tell = batch, plan, tell
        self._inputs = (worlds, plans)

    def fly(self, keys: Any) -> tuple[MissionState, list[Segment]]:
        """All missions to their end, a decision period at a time."""
        batch, names = self._batch, [phase.name for phase in self._plan.phases]
        mission, signals = self.reset(keys)
        self.prepare(mission)
        world = self._first_world()
        timing, tick = world.timing, 0
        segments: list[Segment] = []
        horizon = float(sum(float(np.max(phase.time_limit_s)) for phase in self._plan.phases))
        told: tuple[str, ...] = ()
        begin, active = np.asarray(signals.begin), np.asarray(signals.active)
        while True:
            for number in np.flatnonzero(begin.any(axis=0)):
                self._tell.phase(f"plan {names[number]}", 0.0)
                mission = self.begin(int(number), mission, tick, begin[:, number])
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
        self._tell.phase("prepare", 0.0)
        begun: tuple[MissionState, Signals] = self._batch.run("reset", _begin_mission, self._inputs, keys)
        return begun

    def begin(self, number: int, mission: MissionState, tick: int, begin: np.ndarray) -> MissionState:
        """Begin a phase in the missions ``begin`` [B]; what it is to know of the sources is estimated before."""
        if self._plan.phases[number].target == "source":
            assert mission.survey is not None
            survey = self._learned(self._measured(mission), mission.survey, begin, afresh=True)
            mission = replace(mission, survey=survey)
        begun: MissionState = self._batch.run(**self._beginning(number, mission, tick, begin))
        return begun

    def _beginning(self, number: int, mission: MissionState, tick: int, begin: np.ndarray) -> dict[str, Any]:
        """The call that begins a phase in the missions ``begin`` [B]."""
        return {
            "name": f"begin {self._plan.phases[number].name}",
            "function": partial(_begin_phase, number),
            "inputs": self._inputs,
            "carried": mission,
            "common": (np.int32(tick),),
            "only": self._batch.put(begin),
            "donate": True,
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

    def _measured(self, mission: MissionState) -> Measurements:
        """All counts so far."""
        carried = mission.world.key, mission.windows
        measured: Measurements = self._batch.run("gather", _gathered, self._inputs, carried)
        return measured

    def _estimate(self, measured: Measurements, known: Survey, only: np.ndarray, afresh: bool) -> dict[str, Any]:
        """The call that estimates the sources from the counts ``measured``, in the missions ``only`` [B].

        One program makes all estimates of a mission, with what is known by then or ``afresh``: it takes longer to
        compile than all others together, and asks for nothing but what an estimate depends on, so that missions with
        other phases, policies and limits of time have the same.
        """
        forget = self._batch.put(np.full(self._batch.missions, afresh))
        return {
            "name": "estimate",
            "function": learn,
            "inputs": (self._inputs[1].chosen(premises_of),),
            "carried": Inquiry(measurements=measured, survey=known, afresh=forget),
            "only": self._batch.put(only),
            "shared": True,
        }

    def _learned(self, measured: Measurements, known: Survey, only: np.ndarray, afresh: bool) -> Survey:
        inquiry: Inquiry = self._batch.run(**self._estimate(measured, known, only, afresh))
        return inquiry.survey

    def _naming(self, mission: MissionState, measured: Measurements, known: Survey) -> dict[str, Any]:
        """The call that identifies the nuclide of the first source."""
        return {
            "name": "identify",
            "function": _named,
            "inputs": self._inputs,
            "carried": (mission.world.key, known, measured, mission.trail),
            "in_turn": True,
        }

    def prepare(self, mission: MissionState, *, segments: bool = True) -> None:
        """Begin to load or compile all programs of the mission, in the order that they are needed.

        The estimate, which takes longest, begins early beside the others. A mission with a vehicle outside goes on
        otherwise than in ``segments``.
        """
        nobody, groups = np.zeros(self._batch.missions, bool), len(mission.world.groups)
        beginnings = [self._beginning(number, mission, 0, nobody) for number in range(len(self._plan.phases))]
        estimate, naming = list[dict[str, Any]](), list[dict[str, Any]]()
        if mission.survey is not None:
            measured = self._measured(mission)
            estimate = [self._estimate(measured, mission.survey, nobody, afresh=True)]
            naming = [self._naming(mission, measured, mission.survey)] if self._plan.spectrometer >= 0 else []
        run = [self._advance(mission, 0, np.ones(groups, bool))] if segments else []
        calls = [*beginnings[:1], *estimate, *run, *beginnings[1:], *naming]
        self._batch.prepare(calls)

    def _first_world(self) -> World:
        structure = self._inputs[0].structure
        return jax.tree.unflatten(structure, [None] * structure.num_leaves)

    def _running(self, mission: MissionState) -> np.ndarray:
        """Groups [G] with a vehicle that is moved on in any mission."""
        return np.array([bool(np.asarray(moving(g)).any()) for g in mission.world.groups])

    def conclude(self, mission: MissionState) -> Conclusion | None:
        """What the missions found in the end."""
        known = mission.survey
        if known is None:
            return None
        self._tell.phase("estimate and identify", 0.0)
        everyone, measured = np.ones(self._batch.missions, bool), self._measured(mission)
        unasked = ~self._plan.asked(mission.phases) if self._plan.asks else everyone
        if unasked.any():  # what there is to know of their counts is not known yet
            known = self._learned(measured, known, unasked, afresh=True)
        spectrum: Accumulated | None = None
        identification: Identification | None = None
        guided = known
        if self._plan.spectrometer >= 0:
            guided, spectrum, identification = self._batch.run(**self._naming(mission, measured, known))
        end = self._learned(measured, guided, everyone, afresh=False)
        return Conclusion(survey=known, spectrum=spectrum, identification=identification, estimated=end.estimated)


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


def _named(world: World, plan: Plan, carried: tuple[Any, ...]) -> tuple[Survey, Accumulated, Identification]:
    key, known, measured, trail = carried
    return named(jax.random.wrap_key_data(key), world, plan, known, measured, trail)


def _gathered(world: World, plan: Plan, carried: tuple[Any, ...]) -> Measurements:
    key, windows = carried
    return gathered(world, plan, windows, jax.random.wrap_key_data(key))


def _segment_of(log: Log, ran: np.ndarray, periods: int) -> Segment:
    """The segment without the groups that rested throughout; ``ran`` [periods or more, G]."""
    kept = [bool(np.any(group)) for group in ran[:periods].T]
    tracks = tuple(t if k else None for t, k in zip(log.tracks, kept, strict=True))
    samples = tuple(s if k else None for s, k in zip(log.samples, kept, strict=True))
    return Segment(log=replace(log, tracks=tracks, samples=samples), periods=periods)  # type: ignore[arg-type]


__all__ = ["MissionRun", "Segment"]
