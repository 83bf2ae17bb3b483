"""One mission out of a batch, as the record on the host that files, figures and recordings are made from."""

from typing import Any

import jax
import numpy as np

from swarmsim.estimation import SourceFit
from swarmsim.missions import events
from swarmsim.missions.measure import Log
from swarmsim.missions.record import (
    Estimate,
    Event,
    MissionRecord,
    Phase,
    RadiationMap,
    Samples,
    Spectrum,
    TrueSource,
    VehicleRecord,
)
from swarmsim.missions.rollout import Ground, MissionBatch, Simulation
from swarmsim.missions.shape import shape_of

NOTHING_FOUND = "no source above background"


def mission_record(simulation: Simulation, batch: MissionBatch, index: int) -> MissionRecord:
    """Mission number ``index`` of a batch."""
    aerial, ground = (
        jax.tree.map(lambda leaf: np.asarray(leaf[index]), jax.device_get(_arrays(part)))
        for part in (batch.aerial, batch.ground)
    )
    mission = simulation.scenario.mission
    members = [mission.vehicles[i] for i in simulation.roles.uavs]
    found = bool(aerial["knowledge"].found)
    vehicles = [
        _vehicle(simulation, i, jax.tree.map(lambda x, u=u: x[:, u], aerial["log"]), aerial["flights"].event_time_s[u])
        for u, i in enumerate(simulation.roles.uavs)
    ]
    happened = _events([m.name for m in members], aerial["flights"].event_time_s, float(aerial["end_s"]))
    phases = [Phase("aerial survey", 0.0, float(aerial["end_s"]))]
    samples = [_samples(u, "aerial", aerial["measurements"], u) for u in range(len(members))]
    route = np.zeros((0, 3))
    if batch.ground is not None and simulation.roles.rover is not None:
        name = mission.vehicles[simulation.roles.rover].name
        times = ground["rover"].event_time_s
        vehicles.append(_vehicle(simulation, simulation.roles.rover, ground["log"], times))
        phases.append(Phase("ground search", float(aerial["end_s"]), float(ground["end_s"])))
        if found:
            happened += _events([name], times[None], float(ground["end_s"]))
            samples.append(_samples(len(members), "ground", ground["measurements"], None))
            route = ground["route"].points_m
    learned = ground["knowledge"] if batch.ground is not None and found else None
    aerial_estimate = (
        _estimate(simulation, aerial["knowledge"].fit, simulation.world.presumed_nuclide) if found else None
    )
    estimate = _estimate(simulation, learned.fit, learned.nuclide) if learned is not None else aerial_estimate
    spectrum = _spectrum(simulation, learned) if learned is not None else None
    return MissionRecord(
        name=mission.name,
        site=simulation.site_model.name,
        seed=int(batch.seeds[index]),
        phases=tuple(phases),
        vehicles=tuple(vehicles),
        samples=_in_time_order(samples),
        map=_map(simulation, aerial["knowledge"]),
        aerial_estimate=aerial_estimate,
        estimate=estimate,
        spectrum=spectrum,
        sources=_truth(simulation),
        route_m=route,
        events=tuple(sorted(happened, key=lambda event: event.time_s)),
        finding=_finding(estimate, spectrum, batch.ground, route),
    )


def _arrays(part: Any) -> dict[str, Any]:
    return {} if part is None else dict(vars(part))


def _vehicle(simulation: Simulation, index: int, log: Log, event_time_s: np.ndarray) -> VehicleRecord:
    member, spec = simulation.scenario.mission.vehicles[index], simulation.scenario.vehicles[index]
    end = np.min(event_time_s)
    # after its end a vehicle only rests: one more pose shows where, except after a crash, which has a fall to show
    crashed = bool(events.crashed(event_time_s))
    last = log.time_s.shape[0] if crashed else min(np.searchsorted(log.time_s, end) + 2, log.time_s.shape[0])
    kept = jax.tree.map(lambda x: x[:last], log)
    energy = kept.energy_j / 3600.0
    return VehicleRecord(
        name=member.name,
        type=member.type,
        kind=spec.kind,
        time_s=kept.time_s,
        position_m=kept.position_m,
        quaternion=kept.quaternion,
        velocity_m_s=kept.velocity_m_s,
        energy_wh=energy,
        battery_fraction=np.clip(1.0 - energy / spec.battery.capacity_wh, 0.0, 1.0),
        crashed=crashed,
        shape=shape_of(spec),
    )


def _events(names: list[str], times_s: np.ndarray, limit_s: float) -> list[Event]:
    found = []
    for name, times in zip(names, times_s, strict=True):
        if not np.isfinite(times).any():
            found.append(
                Event(time_s=limit_s, vehicle=name, kind="time_limit", detail="had not ended its path in time")
            )
        for kind, time in zip(events.KINDS, times, strict=True):
            if np.isfinite(time):
                found.append(Event(time_s=float(time), vehicle=name, kind=kind, detail=events.DESCRIPTIONS[kind]))
    return found


def _samples(vehicle: int, phase: str, measurements: Any, row: int | None) -> Samples:
    m = measurements if row is None else jax.tree.map(lambda x: x[row], measurements)
    valid = np.asarray(m.valid)
    count = int(valid.sum())
    return Samples(
        vehicle=np.full(count, vehicle, np.int32),
        phase=np.full(count, phase),
        time_s=m.time_s[valid],
        position_m=m.position_m[valid],
        counts=m.counts[valid],
        exposure_s=m.exposure_s[valid],
        count_rate_cps=m.counts[valid] / m.exposure_s[valid],
    )


def _in_time_order(parts: list[Samples]) -> Samples:
    fields = list(Samples.__dataclass_fields__)
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in fields}
    order = np.argsort(joined["time_s"], kind="stable")
    return Samples(**{name: values[order] for name, values in joined.items()})


def _map(simulation: Simulation, learned: Any) -> RadiationMap:
    mapping = simulation.world.mapping
    return RadiationMap(
        origin_m=np.asarray(mapping.origin_m),
        cell_m=float(mapping.cell_m),
        mean_cps=learned.map.mean_cps,
        std_cps=learned.map.std_cps,
        hotspots_m=learned.hotspots.position_m[learned.hotspots.valid],
    )


def _estimate(simulation: Simulation, fit: SourceFit, nuclide: Any) -> Estimate:
    return Estimate(
        position_m=np.asarray(fit.position_m),
        covariance_m2=np.asarray(fit.covariance_m2),
        activity_mbq=float(fit.activity_bq) * 1e-6,
        activity_std_mbq=float(fit.activity_std_bq) * 1e-6,
        background_scale=float(fit.background_scale),
        nuclide=simulation.nuclide_names[int(nuclide)],
    )


def _spectrum(simulation: Simulation, learned: Any) -> Spectrum:
    assert simulation.world.rover is not None
    detector, answer = simulation.world.rover.detector, learned.identification
    names = simulation.nuclide_names
    live = float(learned.spectrum.live_s)
    index = int(answer.nuclide)
    return Spectrum(
        energy_kev=np.asarray(detector.energy_kev),
        counts=learned.spectrum.counts,
        background=np.asarray(detector.background_spectrum) * live,
        fit=answer.fit,
        live_time_s=live,
        nuclide=names[index] if index >= 0 else "none",
        confidence=float(answer.confidence),
        scores=dict(zip(names, map(float, answer.posterior), strict=True)),
        lines_kev=_lines(simulation, names[index]) if index >= 0 else np.zeros(0),
    )


def _lines(simulation: Simulation, nuclide: str) -> np.ndarray:
    return np.array([line.energy_kev for line in simulation.scenario.nuclides[nuclide].lines])


def _truth(simulation: Simulation) -> tuple[TrueSource, ...]:
    positions = np.asarray(simulation.world.sources.position_m)
    return tuple(
        TrueSource(nuclide=s.nuclide, position_m=position, activity_mbq=s.activity_mbq)
        for s, position in zip(simulation.scenario.mission.sources, positions, strict=False)
    )


def _finding(estimate: Estimate | None, spectrum: Spectrum | None, ground: Ground | None, route: np.ndarray) -> str:
    if estimate is None:
        return NOTHING_FOUND
    x, y = estimate.position_m[:2]
    place = f"a source of {estimate.activity_mbq:.0f} MBq {estimate.nuclide} at ({x:.1f}, {y:.1f}) m"
    if ground is None:
        return f"{place}; nuclide presumed, no rover to identify it"
    if np.ptp(route[:, :2], axis=0).max(initial=0.0) == 0.0:
        return f"{place}; nuclide presumed, no drivable way for the rover to reach it"
    if spectrum is None or spectrum.nuclide == "none":
        return f"{place}; nuclide presumed, the spectrum shows none"
    if spectrum.nuclide != estimate.nuclide:
        return f"{place}; nuclide presumed, the spectrum suggests {spectrum.nuclide} with {spectrum.confidence:.0%}"
    return f"{place}; identified with {spectrum.confidence:.1%}"
