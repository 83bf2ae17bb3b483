"""What a mission found and how far it was from the truth, in plain numbers (`swarmsim.results.batch` has many)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmsim.results.record import (
    Estimate,
    Event,
    MissionRecord,
    Phase,
    RadiationMap,
    TrueSource,
    VehicleRecord,
)
from swarmsim.versions import package_versions
from swarmsim.world.events import FAILSAFES, LOSSES

SURE_SIGMA = 2.0  # the greatest dose rate is that of the reading that is greatest less so many standard deviations
_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "optax", "rerun-sdk")
_ESTIMATE_KEYS = (
    "nuclide",
    "position_m",
    "position_std_m",
    "position_covariance_m2",
    "error_m",
    "error_horizontal_m",
    "true_nuclide",
    "activity_mbq",
    "activity_std_mbq",
    "activity_error_percent",
    "background_scale",
    "several_within_m",
    "beside_noticed_mbq",
    "dose_rate_1m_usv_h",
    "dose_rate_1m_std_usv_h",
    "kerma_rate_1m_ugy_h",
    "kerma_rate_1m_std_ugy_h",
)
INTACT = "intact"
STATES = {
    "crash": "crashed",
    "obstacle": "collided with an obstacle",
    "vehicle": "collided with a vehicle",
    "battery_empty": "battery empty",
    "non_finite": "numerically unstable",
    "fence": "failsafe at the fence",
    "wind": "failsafe in the wind",
    "battery_low": "failsafe of a low battery",
    "link_lost": "failsafe of a lost link",
}
"""State of a vehicle in which an event of each kind leaves it."""


@dataclass(frozen=True)
class Timings:
    """Wall-clock seconds: compilation, the rollouts of the whole batch, and writing the files."""

    compile_s: float = 0.0
    run_s: float = 0.0
    write_s: float = 0.0


def summary(record: MissionRecord, timings: Timings) -> dict[str, Any]:
    """One mission's summary as plain JSON values; None where the mission found nothing or looked for nothing.

    Errors are distances to the nearest true source: of the hotspot on the map (horizontal), of the source in space. A
    line or an area counts by its centre of activity, a source on a vehicle by where it was at the start; activities are
    those of the start. ``noticed_mbq`` is the activity by nuclide from which on a source in free view, beside those
    found, would have been noticed (`MissionRecord.noticed_mbq`; None: none would). ``nuclide`` is what the spectrum
    names (None: nothing that the mission is sure enough of), taken near source number ``of_source`` (0: ``source``,
    from 1 on ``further_sources``; None: near none of them). ``departures`` is what was drawn for the mission within its
    knowledge (`departures_summary`).
    """
    record = record.finite()
    hotspot = hotspot_of(record.map)
    return {
        "name": record.name,
        "site": record.site,
        "seed": int(record.seed),
        "status": record.status,
        "finding": record.finding,
        "covered": record.covered,
        "warnings": list(record.warnings),
        "success": succeeded(record),
        "phases": {phase.name: phase_summary(record, phase) for phase in record.phases},
        "hotspot": {
            "position_m": None if hotspot is None else plain(hotspot),
            "error_m": None if hotspot is None else nearest_of(hotspot, record.sources)[1],
        },
        "survey_estimate": estimate_summary(record.survey_estimate, record),
        "source": estimate_summary(record.estimate, record),
        "further_sources": [estimate_summary(one, record) for one in record.further],
        "noticed_mbq": {name: value if np.isfinite(value) else None for name, value in record.noticed_mbq.items()},
        "nuclide": {
            "name": named(record),
            "confidence": confidence_of_name(record),
            "of_source": record.examined,
        },
        "dose_rate": dose_summary(record),
        "drawn": dict(record.drawn),
        "true_sources": [
            {"nuclide": s.nuclide, "position_m": plain(s.position_m), "activity_mbq": float(s.activity_mbq)}
            | _form(record, s)
            | _true_dose(record, s)
            for s in record.sources
        ],
        "departures": departures_summary(record),
        "vehicles": [
            {
                "name": v.name,
                "type": v.type,
                "state": state_of(record, v),
                "crashed": bool(v.crashed),
                "energy_wh": energy_wh(v),
            }
            for v in record.vehicles
        ],
        "events": [event_summary(e) for e in record.events],
        "real_time_factor": real_time_factor([record], timings),
        "timing": timing_summary(timings),
        "versions": versions(),
    }


def departures_summary(record: MissionRecord) -> dict[str, dict[str, Any]] | None:
    """Truth that was drawn for the mission, for validation; None where no vehicle has a detector.

    ``thickness_factor``: true over presumed thickness, by material of the walls (none where walls are presumed exactly
    or not at all). ``sensitivity_factor``: true over presumed sensitivity, by detector model. ``pose_error_m``:
    measured less true place (east, north, up) by vehicle, the same throughout, with the error of the site's geometry
    that all have in common; it is in what the estimate of sources
    works on (none without one), and not in the places of ``measurements.parquet``, which are true.
    """
    made = record.departures
    if made is None:
        return None
    return {
        "thickness_factor": dict(made.thickness_factor),
        "sensitivity_factor": dict(made.sensitivity_factor),
        "pose_error_m": {name: plain(error) for name, error in made.pose_error_m.items()},
    }


def _form(record: MissionRecord, source: TrueSource) -> dict[str, Any]:
    """What a source that is no point at rest has besides: its form, corners, or carrier and where it came to."""
    if source.corners_m is not None:
        return {"form": source.form, "corners_m": np.asarray(source.corners_m, float).tolist()}
    if source.carrier is None:
        return {}
    carrier, last = record.vehicles[source.carrier], record.track_of(source)[-1]
    return {"form": source.form, "on": carrier.name, "end_position_m": plain(last)}


def event_summary(event: Event) -> dict[str, Any]:
    """An event as plain JSON values; no time where it has none of its own."""
    time_s = float(event.time_s) if np.isfinite(event.time_s) else None
    return {"time_s": time_s, "vehicle": event.vehicle, "kind": event.kind, "detail": event.detail}


def state_of(record: MissionRecord, vehicle: VehicleRecord) -> str:
    """State of a vehicle at the end: `INTACT`, or one of `STATES`."""
    kinds = [event.kind for event in record.events if event.vehicle == vehicle.name and event.kind in STATES]
    lost = [kind for kind in kinds if kind in LOSSES]  # whatever failsafe was on before
    return next((STATES[kind] for kind in lost + kinds), INTACT)


def phase_summary(record: MissionRecord, phase: Phase) -> dict[str, Any]:
    """A phase as plain JSON values: how far its vehicles went together (m) during it, and what they counted in it."""
    return {
        "policy": phase.policy,
        "vehicles": [record.vehicles[number].name for number in phase.vehicles],
        "start_s": float(phase.start_s),
    } | measured(record, phase)


def measured(record: MissionRecord, phase: Phase) -> dict[str, Any]:
    """The numbers of a phase that missions of a batch may differ in."""
    rates = record.samples.of_phase(phase.name).count_rate_cps
    return {
        "duration_s": float(phase.end_s - phase.start_s),
        "in_time": bool(phase.in_time),
        "path_length_m": sum(_length(record.vehicles[number], phase) for number in phase.vehicles),
        "measurements": len(rates),
        "count_rate_min_cps": float(rates.min()) if len(rates) else None,
        "count_rate_max_cps": float(rates.max()) if len(rates) else None,
    }


def _length(vehicle: VehicleRecord, phase: Phase) -> float:
    """Length of a vehicle's track during a phase, in m."""
    inside = (vehicle.time_s >= phase.start_s) & (vehicle.time_s <= phase.end_s)
    track = np.asarray(vehicle.position_m[inside], float)
    return float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum())


def hotspot_of(made: RadiationMap | None) -> NDArray[np.floating] | None:
    """The strongest hotspot [2] of a map."""
    return None if made is None or not len(made.hotspots_m) else np.asarray(made.hotspots_m[0], float)


def estimate_summary(estimate: Estimate | None, record: MissionRecord) -> dict[str, Any]:
    """An estimate with its standard deviations and its errors against the nearest true source of the mission.

    ``position_covariance_m2`` is that of the place (east, north, up). ``error_m`` is the distance in space,
    ``error_horizontal_m`` the distance on the map, ``true_nuclide`` the nuclide of that source, and
    ``activity_error_percent`` the size of the error over its activity. ``several_within_m`` is there where it may be
    several sources, so near to one another; ``beside_noticed_mbq`` is the activity from which on another one of its
    nuclide, 3 to 12 m off, would have been noticed (`Estimate.beside_mbq`). Dose rates 1 m from the source are those of
    its activity with nothing around it; their standard deviations are the activity's, for the nuclide that was
    estimated. Where a counter was saturated no standard deviation can be stated: they are None.
    """
    if estimate is None:
        return dict.fromkeys(_ESTIMATE_KEYS)
    sources, at_1_m = record.sources, record.at_1_m.get(estimate.nuclide)
    position = np.asarray(estimate.position_m, float)
    nearest, error = nearest_of(position, sources)
    activity = float(estimate.activity_mbq)
    known = estimate.errors_known
    values = (
        estimate.nuclide,
        plain(position),
        plain(np.sqrt(np.maximum(np.diag(estimate.covariance_m2), 0.0))) if known else None,
        np.asarray(estimate.covariance_m2, float).tolist() if known else None,
        error,
        nearest_of(position[:2], sources)[1],
        None if nearest is None else nearest.nuclide,
        activity,
        float(estimate.activity_std_mbq) if known else None,
        None
        if nearest is None or nearest.activity_mbq <= 0.0
        else 100.0 * abs(activity - float(nearest.activity_mbq)) / float(nearest.activity_mbq),
        float(estimate.background_scale),
        float(estimate.joined_m) or None,
        float(estimate.beside_mbq) if known and np.isfinite(estimate.beside_mbq) else None,
        None if at_1_m is None else at_1_m.ambient_usv_h * activity,
        None if at_1_m is None or not known else at_1_m.ambient_usv_h * float(estimate.activity_std_mbq),
        None if at_1_m is None else at_1_m.kerma_ugy_h * activity,
        None if at_1_m is None or not known else at_1_m.kerma_ugy_h * float(estimate.activity_std_mbq),
    )
    return dict(zip(_ESTIMATE_KEYS, values, strict=True))


def _true_dose(record: MissionRecord, source: TrueSource) -> dict[str, float]:
    """Dose rates 1 m from a true source; nothing where its nuclide's constant is not recorded."""
    constant = record.at_1_m.get(source.nuclide)
    if constant is None:
        return {}
    activity = float(source.activity_mbq)
    return {
        "dose_rate_1m_usv_h": constant.ambient_usv_h * activity,
        "kerma_rate_1m_ugy_h": constant.kerma_ugy_h * activity,
    }


def dose_summary(record: MissionRecord) -> dict[str, Any] | None:
    """The greatest dose rate that a detector showed, by its counts, and where; None where none is recorded.

    Natural background is included. It is the reading that is greatest less two standard deviations: of thousands of
    readings of a few counts each, the greatest one is chance. The standard deviation is that of counting alone, without
    the error of the conversion (see `swarmsim.radiation.dose_operator`). Where a counter was saturated there is none,
    and the rates are ``lower_bounds``, two standard deviations below the reading: a paralysed counter shows little
    where there is much.
    """
    samples = record.samples
    ambient, std, kerma = samples.dose_rate_usv_h, samples.dose_rate_std_usv_h, samples.kerma_rate_ugy_h
    if ambient is None or std is None or kerma is None or not len(ambient):
        return None
    sure = np.maximum(ambient - SURE_SIGMA * std, 0.0)
    best = int(np.argmax(sure))
    bounds = record.status == "saturated" or (samples.saturated is not None and bool(np.any(samples.saturated)))
    share = float(sure[best] / ambient[best]) if bounds and ambient[best] > 0.0 else 1.0
    return {
        "basis": "counts",
        "greatest_usv_h": share * float(ambient[best]),
        "greatest_std_usv_h": None if bounds else float(std[best]),
        "lower_bounds": bounds,
        "greatest_kerma_ugy_h": share * float(kerma[best]),
        "vehicle": record.vehicles[int(samples.vehicle[best])].name,
        "time_s": float(samples.time_s[best]),
        "position_m": plain(samples.position_m[best]),
    }


def nearest_of(
    position_m: NDArray[np.floating], sources: tuple[TrueSource, ...]
) -> tuple[TrueSource | None, float | None]:
    """The true source nearest to ``position_m`` [2 or 3] and its distance; None where the mission has no source."""
    if not sources:
        return None, None
    size = len(position_m)
    distances = [float(np.linalg.norm(np.asarray(s.position_m, float)[:size] - position_m)) for s in sources]
    best = int(np.argmin(distances))
    return sources[best], distances[best]


def energy_wh(vehicle: VehicleRecord) -> float:
    """Energy that a vehicle used in all, 0 where it has no track."""
    return float(vehicle.energy_wh[-1]) if len(vehicle.energy_wh) else 0.0


def named(record: MissionRecord) -> str | None:
    """The nuclide that the spectrum names, if it names one: near a source that was found, as sure as is asked for."""
    spectrum = record.spectrum
    if spectrum is None or record.examined is None or not spectrum.sure:
        return None
    return None if spectrum.nuclide in ("none", "unknown") else spectrum.nuclide


def confidence_of_name(record: MissionRecord) -> float | None:
    """Probability of the nuclide that the spectrum names; None where it names none."""
    return None if record.spectrum is None or named(record) is None else float(record.spectrum.confidence)


def plain(values: NDArray[np.floating]) -> list[float]:
    """The values of a vector as a table or JSON has them."""
    return [float(v) for v in values]


def real_time_factor(records: Sequence[MissionRecord], timings: Timings) -> float | None:
    """Simulated seconds of all missions over the wall seconds of their rollouts."""
    simulated = sum(record.end_s for record in records)
    return float(simulated / timings.run_s) if timings.run_s > 0.0 else None


def timing_summary(timings: Timings) -> dict[str, float]:
    """The timings as plain JSON values."""
    return {"compile_s": float(timings.compile_s), "run_s": float(timings.run_s), "write_s": float(timings.write_s)}


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on."""
    return package_versions(_PACKAGES)


def succeeded(record: MissionRecord) -> bool:
    """Whether the mission did what it was for: no crash, no failsafe, no phase out of time, and the answer is right.

    Right is a source located, with that status, and, where the mission identifies nuclides, that of the source named
    near which the spectrum was taken; or, where there is no source, the status "none". A mission that looks for nothing
    has no answer to give.
    """
    if any(v.crashed for v in record.vehicles) or not all(phase.in_time for phase in record.phases):
        return False
    if any(event.kind in FAILSAFES for event in record.events):
        return False
    if record.sought == "nothing":
        return True
    active = tuple(s for s in record.sources if s.activity_mbq > 0.0)
    if not active or record.estimate is None:
        return not active and record.status == "none"
    if record.status != "located":
        return False
    if record.sought == "source":
        return True
    if record.examined is None:
        return False
    nearest, _ = nearest_of(np.asarray(record.estimates[record.examined].position_m, float), active)
    return nearest is not None and named(record) == nearest.nuclide
