"""The simulated track that a flight is compared with: the same mission flown by its own simulated vehicle."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from swarmsim.autopilot.compare import Planned, Simulated, Track
from swarmsim.autopilot.link import LinkError
from swarmsim.autopilot.rehearsal import rehearse
from swarmsim.config.errors import InputError, file_errors_told
from swarmsim.runtime.live import LiveMission, LiveStep
from swarmsim.runtime.simulation import Simulation
from swarmsim.vehicles.state import RigidState

SIMULATED, PLANNED = "simulated.parquet", "planned.parquet"
_AXES = ("east_m", "north_m", "up_m")
_CHECK_STEPS = 100  # between two looks at the path, which a phase may plan anew


@dataclass
class _Seen:
    """Rows of a rehearsal, and the paths of its phases."""

    live: LiveMission
    names: Sequence[str]  # of the mission's phases
    rows: list[tuple[float, ...]] = field(default_factory=list)
    phases: list[int] = field(default_factory=list)
    planned: list[Planned] = field(default_factory=list)
    _name: str | None = None

    def __call__(self, step: LiveStep, body: RigidState) -> None:
        number = self.live.phase()
        name = None if number is None else self.names[number]
        if name != self._name or len(self.rows) % _CHECK_STEPS == 0:
            self._name = name
            self._look(name)
        self.rows.append((step.time_s, *(float(v) for v in body.position_m)))
        self.phases.append(len(self.planned) - 1 if self.planned and self.planned[-1].phase == name else -1)

    def _look(self, name: str | None) -> None:
        path = None if name is None else self.live.path_m()
        known = [p.points_m for p in self.planned if p.phase == name]
        if path is not None and not any(np.array_equal(path, each) for each in known):
            self.planned.append(Planned(str(name), np.asarray(path, np.float64)))


def simulate(simulation: Simulation, live: LiveMission) -> tuple[Simulated, tuple[Planned, ...]]:
    """The track of the simulated vehicle in the prepared mission, while it is commanded, and the paths that it plans.

    Takes the mission back to its beginning. Raises `LinkError` as `rehearse` does.
    """
    mission = simulation.scenario.mission
    seen = _Seen(live, [phase.name for phase in simulation.plan.phases])
    rehearse(live, None, float(sum(phase.time_limit_s for phase in mission.phases)), seen)
    rows = np.asarray(seen.rows, np.float64).reshape(-1, 4)
    return Simulated(Track(rows[:, 0], rows[:, 1:]), np.array(seen.phases, int), mission.seed), tuple(seen.planned)


def write_simulated(folder: Path, simulated: Simulated, planned: tuple[Planned, ...]) -> None:
    """Write both as tables: one row for each judging period, and for each point of a path."""
    track = simulated.track
    columns = {"time_s": track.time_s} | dict(zip(_AXES, track.position_m.T, strict=True))
    table = pa.table(columns | {"path": simulated.phase}, metadata={"seed": str(simulated.seed)})
    pq.write_table(table, folder / SIMULATED, compression="zstd")
    points = np.concatenate([path.points_m for path in planned]) if planned else np.zeros((0, 3))
    number = np.repeat(np.arange(len(planned)), [len(path.points_m) for path in planned])
    names = pa.array([planned[k].phase for k in number], pa.string())
    paths = {"path": number, "phase": names} | dict(zip(_AXES, points.T, strict=True))
    pq.write_table(pa.table(paths), folder / PLANNED, compression="zstd")


def has_simulated(folder: Path) -> bool:
    """Whether a run's folder has what `write_simulated` writes."""
    return (folder / SIMULATED).is_file() and (folder / PLANNED).is_file()


def read_simulated(folder: Path) -> tuple[Simulated, tuple[Planned, ...]]:
    """What `write_simulated` wrote; raises `InputError` where it cannot be read."""
    try:
        with file_errors_told("cannot be read", file=folder / SIMULATED):
            table, paths = pq.read_table(folder / SIMULATED), pq.read_table(folder / PLANNED)
        seed = int((table.schema.metadata or {}).get(b"seed", b"0"))
        time_s, points = np.asarray(table["time_s"]), np.stack([np.asarray(paths[name]) for name in _AXES], axis=1)
        position = np.stack([np.asarray(table[name]) for name in _AXES], axis=1)
        number, names = np.asarray(paths["path"]), paths["phase"].to_pylist()
        phase = np.asarray(table["path"], np.int64)
        track = np.column_stack([time_s, position]).astype(np.float64)
        points = points.astype(np.float64)
        whole = (
            len(track) > 1 and np.isfinite(track).all() and np.isfinite(points).all() and (np.diff(time_s) > 0).all()
        )
        if not whole or not all(isinstance(name, str) for name in names) or phase.max() >= len(set(number.tolist())):
            raise ValueError("no track")
    except (pa.ArrowException, KeyError, ValueError, TypeError) as error:
        hint = "write the run anew, or name the mission with --mission and --vehicle"
        raise InputError.of(f"is damaged, or {PLANNED} beside it", file=folder / SIMULATED, suggestion=hint) from error
    starts = [int(np.flatnonzero(number == k)[0]) for k in np.unique(number)]
    planned = tuple(Planned(str(names[start]), points[number == number[start]]) for start in starts)
    return Simulated(Track(track[:, 0], track[:, 1:]), phase, seed), planned


def simulate_vehicle(simulation: Simulation, vehicle: str) -> tuple[Simulated, tuple[Planned, ...]]:
    """As `simulate`, for the vehicle of this name in the scenario's mission; compiles its programs.

    Raises `InputError` where its policy commands what cannot be sent to a real vehicle.
    """
    live = LiveMission(simulation, simulation.scenario.mission.seed, vehicle)
    if not live.has_part:
        raise InputError.of("the vehicle has no part in the mission", path="--vehicle", given=vehicle)
    live.prepare()
    try:
        return simulate(simulation, live)
    except LinkError as error:
        raise InputError.of(f"the mission cannot be flown outside: {error}", path="--vehicle", given=vehicle) from error
