"""One mission out of a batch, as the record on the host that files, figures and recordings are made from."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.estimation import Estimated
from swarmsim.missions.state import MissionState
from swarmsim.radiation.dose import gamma_constant
from swarmsim.radiation.identify import NONE, UNKNOWN
from swarmsim.radiation.rate import highest_rate
from swarmsim.results.departures import departures_of
from swarmsim.results.finding import NO_SPECTRUM, NO_WAY, finding
from swarmsim.results.record import (
    Estimate,
    Event,
    GammaConstant,
    MissionRecord,
    Phase,
    RadiationMap,
    Samples,
    Sought,
    Spectrum,
    TrueSource,
    VehicleRecord,
)
from swarmsim.results.samples import READ, measured_rows, samples_of, windows_of
from swarmsim.results.sources import true_sources
from swarmsim.results.status import Fit, Verdict, assess, source_of_spectrum, survey_doubts
from swarmsim.results.tracks import TRACK, losses, place_of, vehicle_record
from swarmsim.runtime.simulation import MissionBatch, Simulation
from swarmsim.site.model import height_at
from swarmsim.world.build import detector_models
from swarmsim.world.events import KINDS

LEAST_STD_M, LEAST_STD_SHARE = 0.01, 0.002
"""Errors that no statistics tell of: of a measured position and of a detector's constants, even ideal ones."""
LIKELY = 0.5  # probability above which the finding says which stranger an unknown source is like
UNNAMED = {NONE: "none", UNKNOWN: "unknown"}
"""What a spectrum is said to show where no nuclide is named."""
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
    conclusion = None if batch.conclusion is None else _row(batch.conclusion, index)
    nuclides = _nuclides(simulation)
    surveyed: tuple[Estimate, ...] = ()
    final: tuple[Estimate, ...] = ()
    noticed: dict[str, float] = {}
    spectrum = None
    if conclusion is not None:
        surveyed = _estimates(conclusion.survey.estimated, nuclides)
        final = _estimates(conclusion.estimated, nuclides)
        noticed = _noticed(simulation, conclusion.estimated)
        spectrum = _spectrum(simulation, conclusion)
    examined = _examined(simulation, spectrum, surveyed, final)
    telling = None if examined is None else spectrum
    world = batch.worlds.of(index)
    pose_std_m = batch.plans.part(index, lambda plan: None if plan.presumed is None else plan.presumed.pose_std_m)
    sources = true_sources(simulation, world, vehicles)
    samples = _samples(simulation, batch, index, phases)
    chart = None if conclusion is None else _map(simulation, conclusion.survey)
    verdict = None
    if conclusion is not None and chart is not None:
        verdict = _verdict(simulation, samples, chart, conclusion, surveyed, final, telling, examined or 0, end)
        if verdict.status == "saturated":
            surveyed, final = (
                tuple(replace(one, errors_known=False) for one in several) for several in (surveyed, final)
            )
    events = sorted(_events(simulation, end, phases), key=lambda event: event.time_s)
    return MissionRecord(
        name=simulation.scenario.mission.name,
        site=simulation.site_model.name,
        seed=int(batch.seeds[index]),
        phases=tuple(phases),
        vehicles=tuple(vehicles),
        samples=samples,
        sought=_sought(simulation),
        map=chart,
        survey_estimate=next(iter(surveyed), None),
        survey_further=surveyed[1:],
        surveyed_s=_surveyed_s(simulation, end),
        estimate=next(iter(final), None),
        further=final[1:],
        spectrum=spectrum,
        sources=sources,
        paths_m=_paths(simulation, end),
        events=tuple(events),
        finding=finding(
            verdict,
            final,
            telling,
            _hindrance(simulation, end, events),
            _one_nuclide(simulation),
            examined or 0,
            noticed,
        ),
        status="not_sought" if verdict is None else verdict.status,
        covered=None if verdict is None else verdict.covered,
        warnings=(*((CROWDED,) if bool(end.world.crowded) else ()), *survey_doubts(surveyed, final)),
        noticed_mbq=noticed,
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


def _map(simulation: Simulation, survey: Any) -> RadiationMap:
    mapping = simulation.plan.mapping
    assert mapping is not None
    return RadiationMap(
        origin_m=np.asarray(mapping.origin_m),
        cell_m=float(mapping.cell_m),
        mean_cps=survey.map.mean_cps,
        std_cps=survey.map.std_cps,
        hotspots_m=survey.hotspots.position_m[survey.hotspots.valid],
    )


def _nuclides(simulation: Simulation) -> tuple[str, ...]:
    """The library's nuclides, in the order of their indices."""
    return simulation.plan.detectors[0].nuclide_names if simulation.plan.detectors else ()


def _estimates(estimated: Estimated, nuclides: tuple[str, ...]) -> tuple[Estimate, ...]:
    """The sources found, the surest first."""
    fits = estimated.fits
    return tuple(
        Estimate(
            position_m=np.asarray(fits.position_m[k]),
            covariance_m2=np.asarray(fits.covariance_m2[k]) + LEAST_STD_M**2 * np.eye(3),
            activity_mbq=float(fits.activity_bq[k]) * 1e-6,
            activity_std_mbq=float(np.hypot(fits.activity_std_bq[k], LEAST_STD_SHARE * fits.activity_bq[k])) * 1e-6,
            background_scale=float(estimated.background_scale),
            nuclide=nuclides[int(fits.nuclide[k])],
            nuclide_confidence=float(fits.nuclide_confidence[k]),
            detection=float(fits.detection[k]),
            effective_samples=float(fits.effective_samples[k]),
            converged=bool(fits.converged[k]),
            joined_m=float(fits.joined_m[k]),
            beside_mbq=float(fits.beside_bq[k]) * 1e-6,
        )
        for k in np.flatnonzero(np.asarray(fits.present))
    )


def _noticed(simulation: Simulation, estimated: Estimated) -> dict[str, float]:
    """Detection limits of the nuclides in question (`MissionRecord.noticed_mbq`)."""
    presumed = simulation.plan.presumed
    assert presumed is not None
    names = _nuclides(simulation)
    return {names[k]: float(estimated.noticed_bq[k]) * 1e-6 for k in np.flatnonzero(np.asarray(presumed.nuclides))}


def _spectrum(simulation: Simulation, conclusion: Any) -> Spectrum | None:
    """The spectrum of the source, where one was taken; none was if nobody measured near it."""
    answer = conclusion.identification
    if answer is None or float(conclusion.spectrum.live_s) <= 0.0:
        return None
    model, names = simulation.plan.spectrometer, _nuclides(simulation)
    detector = simulation.plan.detectors[model]
    live, index = float(conclusion.spectrum.live_s), int(answer.nuclide)
    lines = simulation.scenario.nuclides[names[index]].lines if index >= 0 else ()
    return Spectrum(
        energy_kev=np.asarray(detector.energy_kev),
        counts=conclusion.spectrum.counts,
        background=np.asarray(detector.background_spectrum) * live,
        fit=answer.fit,
        live_time_s=live,
        nuclide=names[index] if index >= 0 else UNNAMED[index],
        confidence=float(answer.confidence),
        unknown=float(answer.unknown),
        goodness=float(answer.goodness),
        scores=dict(zip(names, map(float, answer.posterior), strict=True)),
        lines_kev=np.array([line.energy_kev for line in lines]),
        detector=detector_models(simulation.scenario)[model],
        begin_s=max(float(conclusion.spectrum.begin_s), 0.0),
        alike=detector.known_names[int(answer.stranger)] if index == UNKNOWN and float(answer.alike) > LIKELY else "",
    )


def gamma_constants(simulation: Simulation, sources: tuple[Estimate | TrueSource, ...]) -> dict[str, GammaConstant]:
    """Gamma constants of the nuclides of ``sources``."""
    nuclides = {source.nuclide: simulation.scenario.nuclides[source.nuclide] for source in sources}
    return {
        name: GammaConstant(gamma_constant(nuclide), gamma_constant(nuclide, "air_kerma"))
        for name, nuclide in sorted(nuclides.items())
    }


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


def _hindrance(simulation: Simulation, end: MissionState, events: list[Event]) -> str | None:
    """What kept rovers from the source: no drivable way there, or what happened to the first of them that was lost."""
    if _no_way(simulation, end):
        return NO_WAY
    scenario = simulation.scenario
    sent = {
        scenario.members[number].name
        for phase, members in zip(simulation.plan.phases, scenario.phase_members, strict=True)
        if phase.target == "source"
        for number in members
    }
    lost = [event for event in events if event.kind in KINDS and event.vehicle in sent]
    return f"{NO_SPECTRUM} ({lost[0].vehicle}: {lost[0].detail})" if lost else None


def _no_way(simulation: Simulation, end: MissionState) -> bool:
    """Whether rovers were sent to the source, and none had a drivable way there: their paths have no extent."""
    scenario = simulation.scenario
    drives = [
        bool(np.ptp(points[:, :2], axis=0).max() > 0.0)
        for phase, members, state in zip(simulation.plan.phases, scenario.phase_members, end.phases, strict=True)
        if phase.target == "source" and state.path is not None and np.isfinite(state.began_s)
        for number, points in zip(members, state.path.points_m, strict=True)
        if scenario.vehicles[number].kind == "skid_steer"
    ]
    return bool(drives) and not any(drives)


def _verdict(
    simulation: Simulation,
    samples: Samples,
    chart: RadiationMap,
    conclusion: Any,
    aerial: tuple[Estimate, ...],
    final: tuple[Estimate, ...],
    spectrum: Spectrum | None,
    examined: int,
    end: MissionState,
) -> Verdict:
    """Status of the mission's answer."""
    estimated, detectors, presumed = conclusion.estimated, simulation.plan.detectors, simulation.plan.presumed
    assert presumed is not None
    used = np.full(len(simulation.scenario.members), -1)
    for group in simulation.world.groups:
        if group.counter is not None:
            used[list(group.member)] = group.counter.index
    of_vehicle = used[samples.vehicle]
    highest = np.array([highest_rate(detector) for detector in detectors])
    background = np.array([float(detector.background_cps) for detector in detectors])
    suggested = ""
    if spectrum is not None and spectrum.nuclide != UNNAMED[NONE] and not _no_way(simulation, end):
        suggested = spectrum.nuclide if spectrum.confidence >= float(simulation.plan.confidence_min) else ""
    fit = Fit(
        misfit=float(estimated.misfit), chi_squared=float(estimated.chi_squared), strain=float(estimated.strain)
    )  # fmt: skip
    ground = height_at(simulation.site_model.site, np.asarray(samples.position_m, float)[:, :2])
    return assess(
        samples,
        chart,
        (highest[of_vehicle], background[of_vehicle]),
        ground,
        fit,
        aerial,
        final,
        float(presumed.background_std),
        (float(np.exp(presumed.log_activity)) * 1e-6, float(presumed.log_activity_std)),
        gamma_constants(simulation, final),
        {} if spectrum is None else spectrum.scores,
        suggested,
        examined,
    )


def _examined(
    simulation: Simulation, spectrum: Spectrum | None, surveyed: tuple[Estimate, ...], final: tuple[Estimate, ...]
) -> int | None:
    """Number of the source of ``final`` that the spectrum is of; None where there is none."""
    taken_at = None if spectrum is None else next(iter(surveyed), None)
    return source_of_spectrum(taken_at, final, float(simulation.plan.spectrum_radius_m))


def _one_nuclide(simulation: Simulation) -> bool:
    presumed = simulation.plan.presumed
    return presumed is not None and int(np.sum(np.asarray(presumed.nuclides))) == 1
