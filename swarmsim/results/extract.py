"""One mission out of a batch, as the record on the host that files, figures and recordings are made from."""

from typing import Any

import jax
import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.missions.knowledge import errors_of_places
from swarmsim.missions.state import MissionState
from swarmsim.results.answer import answer_of
from swarmsim.results.departures import departures_of
from swarmsim.results.record import (
    Event,
    MissionRecord,
    Phase,
    Samples,
    Sought,
    VehicleRecord,
)
from swarmsim.results.samples import READ, measured_rows, samples_of, windows_of
from swarmsim.results.sources import gamma_constants, true_sources
from swarmsim.results.status import survey_doubts
from swarmsim.results.tracks import TRACK, losses, place_of, vehicle_record
from swarmsim.runtime.simulation import MissionBatch, Simulation

CROWDED = "more vehicles were in one place than the neighbour search holds: a collision may have gone unnoticed"


def mission_record(simulation: Simulation, batch: MissionBatch, index: int) -> MissionRecord:
    """Mission number ``index`` of a batch. Raises `InputError` where it has no such one."""
    if not 0 <= index < len(batch.seeds):
        numbers = f"0 to {len(batch.seeds) - 1}"
        raise InputError.of("there is no such mission in the batch", given=str(index), allowed=numbers)
    end = _row(batch.end, index)
    phases = _phases(simulation, end)
    tracks = [_tracks(batch, index, group) for group in range(len(simulation.world.groups))]
    vehicles = [_vehicle(simulation, tracks, end, number) for number in range(len(simulation.scenario.members))]
    world = batch.worlds.of(index)
    pose_std_m = batch.plans.part(
        index, lambda plan: None if plan.presumed is None else errors_of_places(plan.presumed)
    )
    sources = true_sources(simulation, world, vehicles)
    samples = _samples(simulation, batch, index, phases)
    events = sorted(_events(simulation, end, phases), key=lambda event: event.time_s)
    conclusion = None if batch.conclusion is None else _row(batch.conclusion, index)
    answer = answer_of(simulation, conclusion, samples, end, events)
    surveyed, final, verdict = answer.surveyed, answer.final, answer.verdict
    return MissionRecord(
        name=simulation.scenario.mission.name,
        site=simulation.site_model.name,
        seed=int(batch.seeds[index]),
        phases=tuple(phases),
        vehicles=tuple(vehicles),
        samples=samples,
        sought=_sought(simulation),
        map=answer.map,
        survey_estimate=next(iter(surveyed), None),
        survey_further=surveyed[1:],
        surveyed_s=_surveyed_s(simulation, end),
        estimate=next(iter(final), None),
        further=final[1:],
        spectrum=answer.spectrum,
        sources=sources,
        paths_m=_paths(simulation, end),
        events=tuple(events),
        finding=answer.finding,
        status="not_sought" if verdict is None else verdict.status,
        covered=None if verdict is None else verdict.covered,
        warnings=(*((CROWDED,) if bool(end.world.crowded) else ()), *survey_doubts(surveyed, final)),
        noticed_mbq=answer.noticed_mbq,
        examined=answer.examined,
        drawn=batch.draws.told(index),
        windows_kev=windows_of(simulation),
        at_1_m=gamma_constants(simulation, (*surveyed, *final, *sources)),
        departures=departures_of(simulation, world, pose_std_m, int(batch.seeds[index])),
    )


def _row(tree: Any, index: int) -> Any:
    """One mission's part of a pytree with the mission axis, on the host; keys of randomness are left out."""

    def take(leaf: Any) -> Any:
        return None if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key) else np.asarray(leaf)[index]

    return jax.tree.map(take, tree)


def _phases(simulation: Simulation, end: MissionState) -> list[Phase]:
    """The phases that began."""
    scenario, over = simulation.scenario, float(end.over_s)
    return [
        Phase(
            name=spec.name,
            policy=spec.policy,
            vehicles=tuple(members),
            start_s=float(state.began_s),
            end_s=float(state.ended_s) if np.isfinite(state.ended_s) else over,
            in_time=bool(state.in_time),
        )
        for spec, members, state in zip(scenario.mission.phases, scenario.phase_members, end.phases, strict=True)
        if np.isfinite(state.began_s)
    ]


def _vehicle(
    simulation: Simulation, tracks: list[dict[str, np.ndarray]], end: MissionState, number: int
) -> VehicleRecord:
    """One vehicle; its track has a pose before it first moved, and one after it came to rest, or all until the end."""
    group, local = place_of(simulation, number)
    times = end.world.groups[group].event_time_s[local]
    of_group = tracks[group]
    if not of_group:
        return vehicle_record(simulation, number, _never_moved(end, group, local), times)
    track = {name: values if name == "time_s" else values[:, local] for name, values in of_group.items()}
    rows = np.flatnonzero(track.pop("active"))
    first, last = (0, 1) if not len(rows) else (rows[0], rows[-1] + 2)
    if np.isfinite(times).any():
        last = int(np.searchsorted(track["time_s"], end.over_s)) + 1  # other missions of the batch may go on
    span = slice(first, last)
    return vehicle_record(simulation, number, {name: values[span] for name, values in track.items()}, times)


def _tracks(batch: MissionBatch, index: int, group: int) -> dict[str, np.ndarray]:
    """Times [T] and tracks [T, U, …] of a group; empty where it was never stepped."""
    logged = [(s, track) for s in batch.segments if (track := s.log.tracks[group]) is not None]
    if not logged:
        return {}
    found = {"time_s": np.concatenate([s.of(index, s.log.time_s) for s, _ in logged])}
    for name in (*TRACK, "active"):
        found[name] = np.concatenate([s.of(index, getattr(track, name)) for s, track in logged])
    return found


def _never_moved(end: MissionState, group: int, local: int) -> dict[str, np.ndarray]:
    """The track of a vehicle whose group was never stepped: one pose."""
    vehicle = end.world.groups[group].vehicle
    pose = {name: getattr(vehicle.body, name)[local][None] for name in ("position_m", "quaternion", "velocity_m_s")}
    return pose | {"time_s": np.zeros(1), "energy_j": vehicle.energy_j[local][None]}


def _samples(simulation: Simulation, batch: MissionBatch, index: int, phases: list[Phase]) -> Samples:
    """All valid readings in the order of time."""
    found: list[dict[str, np.ndarray]] = []
    for g, group in enumerate(simulation.world.groups):
        for segment in batch.segments:
            if (sampled := segment.log.samples[g]) is None:
                continue
            new = segment.of(index, sampled.new)
            rows = {name: segment.of(index, getattr(sampled, name))[new] for name in READ}
            rows["vehicle"] = np.broadcast_to(np.asarray(group.member, np.int32), new.shape)[new]
            found.append(measured_rows(simulation, group, rows))
    return samples_of(found, phases)


def _events(simulation: Simulation, end: MissionState, phases: list[Phase]) -> list[Event]:
    """What ended vehicles, what each phase's vehicles finished, and who ran out of time."""
    members = simulation.scenario.members
    found, lost = [], set()
    for number, member in enumerate(members):
        group, local = place_of(simulation, number)
        ended = losses(member.name, end.world.groups[group].event_time_s[local])
        found += ended
        if ended:
            lost.add(number)
    states = dict(zip((p.name for p in simulation.scenario.mission.phases), end.phases, strict=True))
    for phase in phases:
        for number, done_s in zip(phase.vehicles, states[phase.name].done_s, strict=True):
            name = members[number].name
            if np.isfinite(done_s):
                found.append(Event(float(done_s), name, "finished", f"had done its part of phase {phase.name}"))
            elif number not in lost and not phase.in_time:
                found.append(Event(phase.end_s, name, "time_limit", f"had not done its part of phase {phase.name}"))
    return found


def _paths(simulation: Simulation, end: MissionState) -> dict[int, np.ndarray]:
    found: dict[int, np.ndarray] = {}
    for members, state in zip(simulation.scenario.phase_members, end.phases, strict=True):
        if state.path is not None and np.isfinite(state.began_s):
            found |= dict(zip(members, state.path.points_m, strict=True))
    return found


def _sought(simulation: Simulation) -> Sought:
    plan = simulation.plan
    if plan.mapping is None or plan.localisation is None:
        return "nothing"
    return "source" if plan.spectrometer < 0 else "nuclide"


def _surveyed_s(simulation: Simulation, end: MissionState) -> float:
    """When the last phase that went by the survey's estimate asked for it; else the end, when all counts are in it."""
    asked = [
        float(state.asked_s)
        for phase, state in zip(simulation.plan.phases, end.phases, strict=True)
        if phase.target == "source" and np.isfinite(state.asked_s)
    ]
    return max(asked, default=float(end.over_s))
