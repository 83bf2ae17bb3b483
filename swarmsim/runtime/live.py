"""A mission in real time with one of its vehicles outside: a judging period at a time, its pose in, its command out."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim import randomness
from swarmsim.config.errors import InputError
from swarmsim.missions.external import Measured, Seat, external_frame, joined, lost, rank_of
from swarmsim.missions.plan import Plan
from swarmsim.missions.segment import decided
from swarmsim.missions.state import MissionState, Signals
from swarmsim.runtime.mission_run import MissionRun, Segment, with_clock, without_clock
from swarmsim.runtime.progress import Progress, SilentProgress
from swarmsim.runtime.simulation import MissionBatch, Simulation
from swarmsim.runtime.uninterrupted import uninterrupted
from swarmsim.vehicles.state import RigidState
from swarmsim.world.build import grouped
from swarmsim.world.model import World


@dataclass(frozen=True)
class LiveStep:
    """What a judging period brought."""

    time_s: float  # of the mission, at its beginning
    command: Any  # full command of the vehicle's policy then (`swarmsim.control.commands`), as arrays of numpy
    begins: tuple[str, ...]  # phases that are to begin: `LiveMission.begin_phases`
    over: bool  # whether the mission has ended
    in_phase: bool  # whether the vehicle is in a phase that it has not done


class LiveMission:
    """One mission whose vehicle ``name`` is flown outside.

    Call `prepare`, then `start`, then `step` once in each ``period_s`` of real time; begin the phases that it names.
    """

    def __init__(self, simulation: Simulation, seed: int, name: str, progress: Progress | None = None):
        """Compile nothing yet; raises `InputError` where the mission has no such vehicle."""
        names = [member.name for member in simulation.scenario.members]
        if name not in names:
            raise InputError.of("the mission has no such vehicle", given=name, allowed=", ".join(names))
        self._simulation, self._seed, self._tell = simulation, seed, progress or SilentProgress()
        groups = grouped(simulation.scenario)
        number = names.index(name)
        group = next(k for k, members in enumerate(groups) if number in members)
        self.seat = Seat(group=group, local=groups[group].index(number))
        self.kind = simulation.world.groups[group].kind
        self.speed_max_m_s = float(simulation.scenario.vehicles[number].control.speed_max_m_s)
        self._draws, self._batch, worlds, plans = simulation.alone(seed)
        self._inputs = (worlds, plans)
        self._run = MissionRun(self._batch, worlds, plans, simulation.plan, self._tell)
        self._keys = self._batch.put(randomness.mission_keys(np.array([seed])))
        self._timing = simulation.world.timing
        self.period_s = self._timing.judge_period_s
        self._mission: MissionState

    def prepare(self) -> None:
        """Load or compile all programs, and run each of them once: no setpoint then waits for a compiler."""
        self.start()
        self._run.prepare(self._mission, segments=False)
        for number in range(len(self._simulation.plan.phases)):  # for no mission
            self._mission = self._run.begin(number, self._mission, 0, np.zeros(1, bool))
        self.start()
        body = self.body()
        for _ in range(self._timing.decision_ticks // self._timing.judge_ticks):
            self.step(body, 1.0)
        self.join(body, 0.0)
        self.leave()
        self.start()

    def start(self) -> None:
        """The beginning of the mission: every vehicle at rest at its start, the phases due not begun."""
        self._tick = 0
        self._records: list[np.ndarray] = []
        self._segments: list[Segment] = []
        self._mission, signals = self._run.reset(self._keys)
        self._due = np.flatnonzero(np.asarray(signals.begin)[0])

    @property
    def time_s(self) -> float:
        """Simulated time since the mission began."""
        return self._tick * self._timing.control_period_s

    def begin_phases(self) -> tuple[str, ...]:
        """Begin the phases that are due, and return their names; one that estimates a source takes seconds."""
        begun = []
        for number in self._due:
            with uninterrupted():
                self._mission = self._run.begin(int(number), self._mission, self._tick, np.ones(1, bool))
            begun.append(self._simulation.plan.phases[number].name)
        self._due = np.array([], int)
        return tuple(begun)

    def phase(self) -> int | None:
        """Number of the phase that the vehicle is in, if its part there is not done."""
        for number, rank in self._ranks():
            here = int(np.asarray(self._mission.phase_of[self.seat.group])[0, self.seat.local]) == number
            if here and np.isinf(np.asarray(self._mission.phases[number].done_s)[0, rank]):
                return number
        return None

    @property
    def has_part(self) -> bool:
        """Whether any phase has the vehicle."""
        return bool(self._ranks())

    def has_phase_to_come(self) -> bool:
        """Whether a phase with the vehicle has not begun yet."""
        return any(np.isinf(np.asarray(self._mission.phases[number].began_s)[0]) for number, _ in self._ranks())

    def _ranks(self) -> list[tuple[int, int]]:
        """The phases with the vehicle, and its number in each of them."""
        seat, phases = self.seat, enumerate(self._simulation.plan.phases)
        ranks = ((number, rank_of(phase, seat)) for number, phase in phases)
        return [(number, rank) for number, rank in ranks if rank is not None]

    def body(self) -> RigidState:
        """Pose and twist of the vehicle in the mission, as arrays of numpy."""
        k, body = self.seat.local, self._mission.world.groups[self.seat.group].vehicle.body
        return jax.tree.map(lambda x: np.array(x)[0, k], body)  # a copy: the next step takes the arrays over

    def team(self) -> tuple[tuple[str, np.ndarray, np.ndarray], ...]:
        """Name, position [3] and attitude [4] (w x y z) of every vehicle, in the order of the mission's."""
        names = [member.name for member in self._simulation.scenario.members]
        found: list[tuple[str, np.ndarray, np.ndarray] | None] = [None] * len(names)
        for group, state in zip(self._simulation.world.groups, self._mission.world.groups, strict=True):
            body = state.vehicle.body
            poses = zip(
                np.asarray(group.member), np.array(body.position_m)[0], np.array(body.quaternion)[0], strict=True
            )
            for number, position, quaternion in poses:
                found[number] = names[number], position, quaternion
        return tuple(each for each in found if each is not None)

    def count_rates_cps(self) -> dict[str, float]:
        """Count rate of the last exposure of every vehicle with a detector, by its name."""
        names = [member.name for member in self._simulation.scenario.members]
        rates: dict[str, float] = {}
        for group, state in zip(self._simulation.world.groups, self._mission.world.groups, strict=True):
            if state.counter is not None:
                values = np.array(state.counter.reading.rate_cps)[0]
                rates |= {names[n]: float(v) for n, v in zip(np.asarray(group.member), values, strict=True)}
        return rates

    def path_m(self) -> np.ndarray | None:
        """The path [P, 3] of the phase that the vehicle is in, if that follows one."""
        number = int(np.asarray(self._mission.phase_of[self.seat.group])[0, self.seat.local])
        if number < 0 or self._mission.phases[number].path is None:
            return None
        rank = rank_of(self._simulation.plan.phases[number], self.seat)
        return None if rank is None else np.array(self._mission.phases[number].path.points_m)[0, rank]  # type: ignore[union-attr]

    @uninterrupted()
    def step(self, body: RigidState, battery: float) -> LiveStep:
        """The mission one judging period later, with the vehicle where it was measured (``body``)."""
        measured = jax.tree.map(partial(np.asarray, dtype=np.float32), Measured(body=body, battery=battery))
        before = self.time_s
        self._mission, record, command, inside = self._batch.run(
            self._of_seat("live step"), partial(_step, self.seat.group, self.seat.local), self._inputs, self._mission,
            (measured, np.int32(self._tick)), donate=True,
        )  # fmt: skip
        self._tick += self._timing.judge_ticks
        self._records.append(np.asarray(record)[0])
        over, begins = False, tuple[str, ...]()
        ended = self._tick % self._timing.decision_ticks == 0
        if ended:
            rows, self._records = np.stack(self._records), []
            self._mission, log, signals = self._batch.run(
                "live decision", _decide, self._inputs, self._mission, (rows, np.int32(self._tick)), donate=True
            )
            self._segments.append(Segment(log=jax.tree.map(lambda x: np.asarray(x)[:, None], log), periods=1))
            over, self._due = bool(np.asarray(signals.over)[0]), np.flatnonzero(np.asarray(signals.begin)[0])
            begins = tuple(self._simulation.plan.phases[number].name for number in self._due)
        return LiveStep(
            time_s=before,
            command=jax.tree.map(lambda x: np.asarray(x)[0], command),
            begins=begins,
            over=over,
            in_phase=bool(np.asarray(inside)[0]),
        )

    @uninterrupted()
    def join(self, body: RigidState, within_m: float) -> None:
        """Let the vehicle's references go on from where its paths pass ``body``, within that length from now."""
        self._mission = self._batch.run(
            self._of_seat("live join"), partial(_join, self.seat.group, self.seat.local), self._inputs, self._mission,
            (np.asarray(body.position_m, np.float32), np.float32(within_m), np.int32(self._tick)), donate=True,
        )  # fmt: skip

    @uninterrupted()
    def leave(self) -> None:
        """The vehicle has no further part in the mission; the rest of the team goes on."""
        self._mission = self._batch.run(
            self._of_seat("live leave"), partial(_leave, self.seat.group, self.seat.local), self._inputs, self._mission,
            (np.int32(self._tick),), donate=True,
        )  # fmt: skip

    def over_without_vehicle(self) -> bool:
        """Whether every phase that has begun and not ended has no other vehicle than this one, and none is to come."""
        others = False
        for phase, state in zip(self._simulation.plan.phases, self._mission.phases, strict=True):
            ended = np.isfinite(np.asarray(state.ended_s)[0])
            alone = all(place.group == self.seat.group and place.local == (self.seat.local,) for place in phase.places)
            others = others or (not ended and not alone)
        return not others

    def _of_seat(self, name: str) -> str:
        """The name of a program that is made for this vehicle: a batch tells its programs apart by their names."""
        return f"{name} {self.seat.group} {self.seat.local}"

    def result(self) -> MissionBatch:
        """What was flown so far, as of a rollout."""
        end, over_s = self._mission, np.asarray(self._mission.over_s)
        end = replace(end, over_s=jnp.where(np.isfinite(over_s), over_s, np.float32(self.time_s)))
        return MissionBatch(
            seeds=np.array([self._seed]),
            worlds=self._inputs[0],
            plans=self._inputs[1],
            end=end,
            segments=tuple(self._segments),
            conclusion=self._run.conclude(end),
            clock=self._simulation.clock.copy(),
            draws=self._draws,
        )


def _running(world: World) -> jax.Array:
    return jnp.ones(len(world.groups), bool)


def _step(
    group: int, local: int, world: World, plan: Plan, mission: MissionState, measured: Measured, tick: jax.Array
) -> tuple[MissionState, jax.Array, Any, jax.Array]:
    seat = Seat(group=group, local=local)
    mission, record, command = external_frame(
        world, plan, with_clock(mission, tick, _running(world)), seat, measured
    )  # fmt: skip
    inside = mission.phase_of[group][local] >= 0
    for number, phase in enumerate(plan.phases):
        rank = rank_of(phase, seat)
        if rank is not None:
            done = jnp.isfinite(mission.phases[number].done_s[rank])
            inside = inside & ~(done & (mission.phase_of[group][local] == number))
    return without_clock(mission), record, command, inside


def _decide(
    world: World, plan: Plan, mission: MissionState, record: jax.Array, tick: jax.Array
) -> tuple[MissionState, Any, Signals]:
    mission, log, signals = decided(world, plan, with_clock(mission, tick, _running(world)), record)
    return without_clock(mission), log, signals


def _join(
    group: int, local: int, world: World, plan: Plan, mission: MissionState,
    position_m: jax.Array, within_m: jax.Array, tick: jax.Array,
) -> MissionState:  # fmt: skip
    mission = with_clock(mission, tick, _running(world))
    return without_clock(joined(plan, mission, Seat(group=group, local=local), position_m, within_m))


def _leave(
    group: int, local: int, world: World, plan: Plan, mission: MissionState, tick: jax.Array
) -> MissionState:  # fmt: skip
    mission = with_clock(mission, tick, _running(world))
    return without_clock(lost(world, mission, Seat(group=group, local=local)))
