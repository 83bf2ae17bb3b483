"""A batch of missions in plain numbers: a row of each, and what they come to."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from swarmsim.families.draw import columns
from swarmsim.results.record import Estimate, MissionRecord
from swarmsim.results.summary import (
    Timings,
    confidence_of_name,
    dose_summary,
    energy_wh,
    estimate_summary,
    hotspot_of,
    measured,
    named,
    nearest_of,
    plain,
    real_time_factor,
    succeeded,
    timing_summary,
    versions,
)
from swarmsim.world.events import FAILSAFES, KINDS

_NOT_SUMMED_UP = ("true_", "source_covariance_", "survey_estimate_covariance_")
"""Beginnings of the columns of a batch's missions that have no median worth telling."""


def batch_row(record: MissionRecord) -> dict[str, Any]:
    """One mission as a flat row of ``missions.parquet``, units in the names: what `batch_summary` sums up.

    A phase that did not begin has no columns.
    """
    record = record.finite()
    row: dict[str, Any] = {"seed": int(record.seed), "status": record.status, "finding": record.finding}
    row["covered"] = record.covered
    row |= columns(record.drawn)
    for phase in record.phases:
        row |= {f"{phase.name}_{key}": value for key, value in measured(record, phase).items()}
    row["duration_s"] = float(record.end_s)
    hotspot = hotspot_of(record.map)
    row |= _axes("hotspot_", None if hotspot is None else plain(hotspot), ("east_m", "north_m"))
    row["hotspot_error_m"] = None if hotspot is None else nearest_of(hotspot, record.sources)[1]
    for name, estimate in (("survey_estimate", record.survey_estimate), ("source", record.estimate)):
        row |= _of_estimate(f"{name}_", estimate, record)
    if record.departures is not None:
        row |= {f"true_thickness_factor_{key}": value for key, value in record.departures.thickness_factor.items()}
        row |= {f"true_sensitivity_factor_{key}": value for key, value in record.departures.sensitivity_factor.items()}
    row["sources_found"] = len(record.estimates)
    # of the nuclide in question that is noticed first, and of the one that is last; None where it never is
    limits = [value if np.isfinite(value) else None for value in sorted(record.noticed_mbq.values())]
    row |= {"noticed_least_mbq": next(iter(limits), None), "noticed_most_mbq": next(reversed(limits), None)}
    row["nuclide"] = named(record)
    row["nuclide_confidence"] = confidence_of_name(record)
    dose = dose_summary(record)
    row["dose_rate_greatest_usv_h"] = None if dose is None else dose["greatest_usv_h"]
    row["crashed"] = sum(bool(v.crashed) for v in record.vehicles)
    saved = {e.vehicle for e in record.events if e.kind in FAILSAFES}
    row["failsafes"] = sum(v.name in saved for v in record.vehicles)
    row["incidents"] = ", ".join(f"{e.vehicle}: {e.kind}" for e in record.events if e.kind in KINDS)
    row["energy_wh"] = sum(energy_wh(v) for v in record.vehicles)
    row["success"] = succeeded(record)
    return row


def source_rows(record: MissionRecord) -> list[dict[str, Any]]:
    """The sources that one mission found as flat rows of ``sources.parquet``, the surest first; none if it found none.

    ``error_m`` and ``true_nuclide`` are against the nearest true source, which may be that of another row too.
    """
    record = record.finite()
    about = {"seed": int(record.seed), "status": record.status}
    return [
        about | {"number": number} | _of_estimate("", estimate, record)
        for number, estimate in enumerate(record.estimates)
    ]


def _of_estimate(before: str, estimate: Estimate | None, record: MissionRecord) -> dict[str, Any]:
    """An estimate as columns whose names begin with ``before``."""
    values = estimate_summary(estimate, record)
    row: dict[str, Any] = _axes(before, values.pop("position_m"), ("east_m", "north_m", "up_m"))
    row |= _axes(before, values.pop("position_std_m"), ("std_east_m", "std_north_m", "std_up_m"))
    row |= _covariances(before, values.pop("position_covariance_m2"))
    return row | {f"{before}{key}": value for key, value in values.items()}


def _axes(before: str, values: list[float] | None, axes: tuple[str, ...]) -> dict[str, float | None]:
    return {f"{before}{axis}": None if values is None else values[k] for k, axis in enumerate(axes)}


def _covariances(before: str, matrix: list[list[float]] | None) -> dict[str, float | None]:
    """The covariances [m2] of a place between axes; its variances follow from the standard deviations."""
    pairs = {"east_north": (0, 1), "east_up": (0, 2), "north_up": (1, 2)}
    return {f"{before}covariance_{axes}_m2": None if matrix is None else matrix[i][j] for axes, (i, j) in pairs.items()}


def all_keys(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Columns of all rows, in the order of the first row that has most of them."""
    longest = max(rows, key=len)
    return list(dict.fromkeys(key for row in (longest, *rows) for key in row))


def batch_summary(rows: Sequence[dict[str, Any]], records: Sequence[MissionRecord], timings: Timings) -> dict[str, Any]:
    """A batch in numbers: median, least and greatest of each numeric column of ``rows``, over the missions with one.

    ``found`` says in how many missions the column has a value at all.
    """
    numbers = {}
    for key in all_keys(rows):
        found = (row.get(key) for row in rows)
        values = [value for value in found if isinstance(value, int | float) and not isinstance(value, bool)]
        if key != "seed" and values and not key.startswith(_NOT_SUMMED_UP):
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
        "statuses": dict(Counter(row["status"] for row in rows)),
        "crashed_vehicles": int(sum(row["crashed"] for row in rows)),
        "failsafe_vehicles": int(sum(row["failsafes"] for row in rows)),
        "metrics": numbers,
        "real_time_factor": real_time_factor(records, timings),
        "timing": timing_summary(timings),
        "versions": versions(),
    }
