"""What a mission found and how far it was from the truth, in plain numbers: one mission's summary, and a batch's."""

import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmsim.missions.record import Estimate, Event, MissionRecord, Spectrum, TrueSource, VehicleRecord

_PACKAGES = ("swarmsim", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "optax", "rerun-sdk")
_ESTIMATE_KEYS = (
    "position_m",
    "position_std_m",
    "error_m",
    "error_horizontal_m",
    "activity_mbq",
    "activity_std_mbq",
    "activity_error_percent",
    "background_scale",
)
_KIND_OF_PHASE = {"aerial": "multirotor", "ground": "skid_steer"}


@dataclass(frozen=True)
class Timings:
    """Wall-clock seconds: compilation, the rollouts of the whole batch, and writing the files."""

    compile_s: float
    run_s: float
    write_s: float = 0.0


def summary(record: MissionRecord, timings: Timings) -> dict[str, Any]:
    """One mission's summary as plain JSON values; None where the mission found nothing.

    Errors are distances to the nearest true source: of the hotspot on the map (horizontal), of the source in space.
    """
    record = record.finite()
    hotspots = record.map.hotspots_m
    hotspot = np.asarray(hotspots[0], float) if len(hotspots) else None
    spectrum = record.spectrum
    return {
        "name": record.name,
        "site": record.site,
        "seed": int(record.seed),
        "finding": record.finding,
        "aerial": phase_summary(record, "aerial"),
        "ground": phase_summary(record, "ground"),
        "hotspot": {
            "position_m": None if hotspot is None else _plain(hotspot),
            "error_m": None if hotspot is None else _nearest(hotspot, record.sources)[1],
        },
        "aerial_estimate": estimate_summary(record.aerial_estimate, record.sources),
        "source": estimate_summary(record.estimate, record.sources),
        "nuclide": {
            "name": named(spectrum),
            "confidence": None if spectrum is None else float(spectrum.confidence),
        },
        "true_sources": [
            {"nuclide": s.nuclide, "position_m": _plain(s.position_m), "activity_mbq": float(s.activity_mbq)}
            for s in record.sources
        ],
        "vehicles": [
            {"name": v.name, "type": v.type, "crashed": bool(v.crashed), "energy_wh": energy_wh(v)}
            for v in record.vehicles
        ],
        "events": [event_summary(e) for e in record.events],
        "real_time_factor": real_time_factor([record], timings),
        "timing": timing_summary(timings),
        "versions": versions(),
    }


def event_summary(event: Event) -> dict[str, Any]:
    """An event as plain JSON values; no time where it has none of its own."""
    time_s = float(event.time_s) if np.isfinite(event.time_s) else None
    return {"time_s": time_s, "vehicle": event.vehicle, "kind": event.kind, "detail": event.detail}


def phase_summary(record: MissionRecord, phase: str) -> dict[str, Any]:
    """How long a phase took, how far its vehicles went together (m), and what they counted; zeros where not flown."""
    start, end = record.span(phase) or (0.0, 0.0)
    length = 0.0
    for vehicle in record.vehicles:
        if vehicle.kind == _KIND_OF_PHASE[phase]:
            inside = (vehicle.time_s >= start) & (vehicle.time_s <= end)
            track = np.asarray(vehicle.position_m[inside], float)
            length += float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum())
    rates = record.samples.of_phase(phase).count_rate_cps
    return {
        "duration_s": float(end - start),
        "path_length_m": length,
        "measurements": len(rates),
        "count_rate_min_cps": float(rates.min()) if len(rates) else None,
        "count_rate_max_cps": float(rates.max()) if len(rates) else None,
    }


def estimate_summary(estimate: Estimate | None, sources: tuple[TrueSource, ...]) -> dict[str, Any]:
    """An estimate with its standard deviations and its errors against the nearest true source.

    ``error_m`` is the distance in space, ``error_horizontal_m`` the distance on the map; ``activity_error_percent`` is
    the size of the error over the true activity.
    """
    if estimate is None:
        return dict.fromkeys(_ESTIMATE_KEYS)
    position = np.asarray(estimate.position_m, float)
    nearest, error = _nearest(position, sources)
    activity = float(estimate.activity_mbq)
    values = (
        _plain(position),
        _plain(np.sqrt(np.maximum(np.diag(estimate.covariance_m2), 0.0))),
        error,
        _nearest(position[:2], sources)[1],
        activity,
        float(estimate.activity_std_mbq),
        None
        if nearest is None or nearest.activity_mbq <= 0.0
        else 100.0 * abs(activity - float(nearest.activity_mbq)) / float(nearest.activity_mbq),
        float(estimate.background_scale),
    )
    return dict(zip(_ESTIMATE_KEYS, values, strict=True))


def _nearest(
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


def named(spectrum: Spectrum | None) -> str | None:
    """The nuclide that a spectrum names, if it names one."""
    return None if spectrum is None or spectrum.nuclide == "none" else spectrum.nuclide


def _plain(values: NDArray[np.floating]) -> list[float]:
    return [float(v) for v in values]


def real_time_factor(records: list[MissionRecord], timings: Timings) -> float | None:
    """Simulated seconds of all phases of all missions over the wall seconds of their rollouts."""
    simulated = sum(p.end_s - p.start_s for record in records for p in record.phases)
    return float(simulated / timings.run_s) if timings.run_s > 0.0 else None


def timing_summary(timings: Timings) -> dict[str, float]:
    """The timings as plain JSON values."""
    return {"compile_s": float(timings.compile_s), "run_s": float(timings.run_s), "write_s": float(timings.write_s)}


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def batch_row(record: MissionRecord) -> dict[str, Any]:
    """One mission as a flat row of ``missions.parquet``, units in the names: what `batch_summary` sums up."""
    record = record.finite()
    row: dict[str, Any] = {"seed": int(record.seed), "finding": record.finding}
    for phase in ("aerial", "ground"):
        row |= {f"{phase}_{key}": value for key, value in phase_summary(record, phase).items()}
    hotspots = record.map.hotspots_m
    hotspot = np.asarray(hotspots[0], float) if len(hotspots) else None
    row |= _axes("hotspot", None if hotspot is None else _plain(hotspot), ("east_m", "north_m"))
    row["hotspot_error_m"] = None if hotspot is None else _nearest(hotspot, record.sources)[1]
    for name, estimate in (("aerial_estimate", record.aerial_estimate), ("source", record.estimate)):
        values = estimate_summary(estimate, record.sources)
        row |= _axes(name, values.pop("position_m"), ("east_m", "north_m", "up_m"))
        row |= _axes(name, values.pop("position_std_m"), ("std_east_m", "std_north_m", "std_up_m"))
        row |= {f"{name}_{key}": value for key, value in values.items()}
    row["nuclide"] = named(record.spectrum)
    row["nuclide_confidence"] = None if record.spectrum is None else float(record.spectrum.confidence)
    row["crashed"] = sum(bool(v.crashed) for v in record.vehicles)
    row["energy_wh"] = sum(energy_wh(v) for v in record.vehicles)
    row["success"] = succeeded(record)
    return row


def _axes(name: str, values: list[float] | None, axes: tuple[str, ...]) -> dict[str, float | None]:
    return {f"{name}_{axis}": None if values is None else values[k] for k, axis in enumerate(axes)}


def succeeded(record: MissionRecord) -> bool:
    """Whether the mission did what it was for: nobody crashed, and the answer is right.

    Right is a source located and the nuclide of the nearest true source named; or, where there is no source, none
    located.
    """
    if any(v.crashed for v in record.vehicles):
        return False
    active = tuple(s for s in record.sources if s.activity_mbq > 0.0)
    if not active:
        return record.estimate is None
    if record.estimate is None or record.spectrum is None:
        return False
    nearest, _ = _nearest(np.asarray(record.estimate.position_m, float), active)
    return nearest is not None and record.spectrum.nuclide == nearest.nuclide


def batch_summary(rows: list[dict[str, Any]], records: list[MissionRecord], timings: Timings) -> dict[str, Any]:
    """A batch in numbers: median, least and greatest of each numeric column of ``rows``, over the missions with one.

    ``found`` says in how many missions the column has a value at all.
    """
    numbers = {}
    for key in rows[0]:
        values = [row[key] for row in rows if isinstance(row[key], int | float) and not isinstance(row[key], bool)]
        if key != "seed" and values:
            spread = (("median", np.median), ("min", np.min), ("max", np.max))
            numbers[key] = {name: float(of(values)) for name, of in spread} | {"found": len(values)}
    seeds = [row["seed"] for row in rows]
    return {
        "name": records[0].name,
        "site": records[0].site,
        "missions": len(rows),
        "seed_first": min(seeds),
        "seed_last": max(seeds),
        "success_rate": float(np.mean([row["success"] for row in rows])),
        "crashed_vehicles": int(sum(row["crashed"] for row in rows)),
        "metrics": numbers,
        "real_time_factor": real_time_factor(records, timings),
        "timing": timing_summary(timings),
        "versions": versions(),
    }
