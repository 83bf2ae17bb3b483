"""Tables of a run directory: units in the names of columns, what they mean in the schema's metadata."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from swarmsim.results.batch import all_keys
from swarmsim.results.record import MissionRecord, Spectrum, Window

AXES = ("east", "north", "up")
DOSES = ("live_s", "dose_rate_usv_h", "dose_rate_std_usv_h", "kerma_rate_ugy_h")
WINDOWS_KEY = "windows_kev"
"""Metadata of the measurements: lower and upper ends of the energy windows, as JSON."""
_FRAME = "ENU: east, north, up in metres from the site's origin; quaternion w x y z, body (forward left up) to world"
_MEASURED = (
    "detector samples; position is the crystal's (mean of the count), time the end of a count; counts_A_B_kev are the "
    "counts by energy window (the lowest and the highest window hold what lies beyond, null: the detector has no such "
    "window); exposure_s is the real time that counts stand for, dead time included (1 s for an idealised one), and "
    "count_rate_cps the counts over it; live_s is the live time, the exposure less the dead time by the detector's "
    "law; dose rates are ambient dose equivalent H*(10) and air kerma by the counts over the live time, background "
    "included, and doubtful where the counter was saturated: near the highest rate that it can show, or, of one that "
    "dead time paralyses, showing less than a tenth of its background"
)
_SPECTRUM = (
    "spectrum that the nuclide was identified by, summed over samples near the source (energy: centre of the channel) "
    "with the expected background and the fit; drawn by itself and without dead time: its total exceeds the samples' "
    "counts by what the counter missed, and differs by statistics; live_time_s is the real time of its "
    "samples, all of which is live"
)
_MISSIONS = (
    "missions of a batch, a row each: seed, status and finding; drawn_ what was drawn for it; PHASE_ what that phase "
    "measured; survey_estimate_ and source_ the surest source after the survey and in the end, by all counts (nuclide "
    "that it was estimated as; std_ the standard deviations, covariance_ the covariances of the place, error_m the "
    "distance to the nearest true source, true_nuclide that one's); true_thickness_factor_MATERIAL and "
    "true_sensitivity_factor_DETECTOR true over presumed, as drawn for it; sources_found how many; nuclide and "
    "nuclide_confidence of the spectrum taken near it; noticed_least_mbq and noticed_most_mbq the activities from "
    "which on the nuclides in question that are noticed first and last would have been (null: never); success whether "
    "the answer is right and nothing went wrong"
)


_SOURCES = (
    "sources that the missions of a batch found, a row each: seed and status of the mission; number from 0, the surest "
    "first; nuclide that it was estimated as; std_ the standard deviations, covariance_ the covariances of the place; "
    "error_m the distance to the nearest true source, true_nuclide that one's, activity_error_percent against it"
)


def _metadata(record: MissionRecord, what: str) -> dict[str, str]:
    return {"content": what, "mission": record.name, "site": record.site, "seed": str(record.seed), "frame": _FRAME}


def _dictionary(texts: Sequence[str], index: np.ndarray) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(index, pa.int32()), pa.array(list(texts), pa.string()))


def measurements_table(record: MissionRecord) -> pa.Table:
    """Every detector sample, in time order: one row each, units in the column names."""
    samples = record.samples
    phases, index = np.unique(samples.phase, return_inverse=True)
    columns = {
        "vehicle": _dictionary([v.name for v in record.vehicles], samples.vehicle),
        "phase": _dictionary([str(p) for p in phases], index),
        "time_s": samples.time_s.astype(np.float64),
        "east_m": samples.position_m[:, 0].astype(np.float32),
        "north_m": samples.position_m[:, 1].astype(np.float32),
        "up_m": samples.position_m[:, 2].astype(np.float32),
        "counts": samples.counts.astype(np.float32),
        "exposure_s": samples.exposure_s.astype(np.float32),
        "count_rate_cps": samples.count_rate_cps.astype(np.float32),
    } | _instrument_columns(record)
    told = {WINDOWS_KEY: json.dumps(record.windows_kev)} if samples.windows is not None else {}
    return pa.table(columns, metadata=_metadata(record, _MEASURED) | told)


def _instrument_columns(record: MissionRecord) -> dict[str, Any]:
    """What else was recorded of samples: the crystal's axis, live time, dose rates and counts by energy window."""
    samples = record.samples
    columns: dict[str, Any] = {}
    if samples.axis is not None:
        columns |= {f"axis_{name}": samples.axis[:, k].astype(np.float32) for k, name in enumerate(AXES)}
    for name in DOSES:
        if (values := getattr(samples, name)) is not None:
            columns[name] = values.astype(np.float32)
    if samples.saturated is not None:
        columns["saturated"] = samples.saturated
    if samples.windows is not None:
        for k, window in enumerate(record.windows_kev):
            counts = samples.windows[:, k]
            other = np.isnan(counts)
            columns[window_column(window)] = pa.array(np.where(other, 0.0, counts).astype(np.int64), mask=other)
    return columns


def window_column(window: Window) -> str:
    """Name of the column of the counts in an energy window, such as ``counts_30_60_kev``."""
    return f"counts_{window[0]:g}_{window[1]:g}_kev"


def spectrum_table(record: MissionRecord, spectrum: Spectrum) -> pa.Table:
    """The spectrum that the nuclide was identified by: one row for each channel."""
    columns = {
        "energy_kev": spectrum.energy_kev.astype(np.float64),
        "counts": spectrum.counts.astype(np.int64),
        "background_counts": spectrum.background.astype(np.float64),
        "fit_counts": spectrum.fit.astype(np.float64),
    }
    told = {
        "live_time_s": repr(float(spectrum.live_time_s)),
        "begin_s": repr(float(spectrum.begin_s)),
        "detector": spectrum.detector,
        "nuclide": spectrum.nuclide,
        "confidence": repr(float(spectrum.confidence)),
        "sure": repr(bool(spectrum.sure)),
    }
    return pa.table(columns, metadata=_metadata(record, _SPECTRUM) | told)


def trajectories_table(record: MissionRecord) -> pa.Table:
    """The tracks of all vehicles, one after the other: one row for each logged time."""
    vehicles = record.vehicles
    lengths = [len(v.time_s) for v in vehicles]

    def column(values: list[np.ndarray], kind: type = np.float32) -> np.ndarray:
        return np.concatenate(values).astype(kind)

    columns: dict[str, Any] = {
        "vehicle": _dictionary([v.name for v in vehicles], np.repeat(np.arange(len(vehicles)), lengths)),
        "time_s": column([v.time_s for v in vehicles], np.float64),
    }
    for k, axis in enumerate(("east", "north", "up")):
        columns[f"{axis}_m"] = column([v.position_m[:, k] for v in vehicles])
    for k, part in enumerate("wxyz"):
        columns[f"quaternion_{part}"] = column([v.quaternion[:, k] for v in vehicles])
    for k, axis in enumerate(("east", "north", "up")):
        columns[f"velocity_{axis}_m_s"] = column([v.velocity_m_s[:, k] for v in vehicles])
    columns["energy_wh"] = column([v.energy_wh for v in vehicles])
    columns["battery_fraction"] = column([v.battery_fraction for v in vehicles])
    return pa.table(columns, metadata=_metadata(record, "vehicle tracks"))


def missions_table(rows: Sequence[dict[str, Any]]) -> pa.Table:
    """One row for each mission (`swarmsim.results.batch.batch_row`)."""
    return _table_of(rows, _MISSIONS)


def sources_table(rows: Sequence[dict[str, Any]]) -> pa.Table:
    """One row for each source that missions found (`swarmsim.results.batch.source_rows`), one at least."""
    return _table_of(rows, _SOURCES)


def _table_of(rows: Sequence[dict[str, Any]], content: str) -> pa.Table:
    """The rows with the columns of all; all-null columns stay numeric."""
    columns = {}
    for key in all_keys(rows):
        values = [row.get(key) for row in rows]
        empty = all(v is None for v in values)
        columns[key] = (
            pa.array(values, pa.string() if key.endswith("nuclide") else pa.float64()) if empty else pa.array(values)
        )
    return pa.table(columns, metadata={"content": content, "frame": _FRAME})
