"""A run on disk: ``runs/<name>/`` is complete or absent, whatever happens while it is written."""

import json
import math
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from swarmsim.missions.out_folder import SCENARIO, SUMMARY, check_out
from swarmsim.missions.record import MissionRecord
from swarmsim.missions.summary import Timings, batch_row, batch_summary, summary
from swarmsim.playback import figures
from swarmsim.playback.recording import write_recording
from swarmsim.site.model import SiteModel

MISSIONS = "missions.parquet"
MEASUREMENTS, TRAJECTORIES = "measurements.parquet", "trajectories.parquet"
MAP, RECORDING, FIGURES = "radiation_map.npz", "mission.rrd", "figures"
_FRAME = "ENU: east, north, up in metres from the site's origin; quaternion w x y z, body (forward left up) to world"


def write_run(
    records: Sequence[MissionRecord],
    scenario_yaml: str,
    site_model: SiteModel,
    out: Path,
    timings: Timings,
    force: bool = False,
) -> dict[str, Any]:
    """Write all files of a run to the folder ``out`` and return its summary.

    Of a batch, every mission has a row in ``missions.parquet``; tables, map, recording and figures are the first
    mission's (any other can be flown again from its seed). ``timings.write_s`` is measured here. Raises `InputError`
    where ``out`` cannot be used; on any error or Ctrl-C nothing of the new run is left, and an
    earlier one still stands.
    """
    check_out(out, force)
    with _complete_or_absent(out, force) as folder:
        started = time.perf_counter()
        (folder / SCENARIO).write_text(scenario_yaml, encoding="utf-8")
        first = records[0]
        pq.write_table(measurements_table(first), folder / MEASUREMENTS, compression="zstd")
        pq.write_table(trajectories_table(first), folder / TRAJECTORIES, compression="zstd")
        _write_map(first, folder / MAP)
        write_recording(first, site_model, folder / RECORDING)
        figures.write(first, site_model, folder / FIGURES)
        rows = [batch_row(record) for record in records] if len(records) > 1 else []
        if rows:
            pq.write_table(missions_table(rows), folder / MISSIONS, compression="zstd")
        timed = replace(timings, write_s=time.perf_counter() - started)
        content = batch_summary(rows, list(records), timed) if rows else summary(first, timed)
        content = _finite(content)
        text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
        (folder / SUMMARY).write_text(text + "\n", encoding="utf-8")
    return content


@contextmanager
def _complete_or_absent(out: Path, force: bool) -> Iterator[Path]:
    """A new folder beside ``out`` that takes its place when the block ends well, and vanishes when it does not.

    An earlier run is moved aside first and brought back if the new one cannot take its place. Both happen on one file
    system, where a rename is one step.
    """
    out = out.absolute()
    out.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    new, old = work / "new", work / "old"
    try:
        new.mkdir()
        yield new
        check_out(out, force)  # once more: another run may have come to the same place meanwhile
        try:
            if out.exists():
                out.rename(old)
            new.rename(out)
        except BaseException:
            if old.exists() and not out.exists():
                old.rename(out)
            raise
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _finite(value: Any) -> Any:
    """``value`` with None for numbers that are not finite, which JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _metadata(record: MissionRecord, what: str) -> dict[str, str]:
    return {"content": what, "mission": record.name, "site": record.site, "seed": str(record.seed), "frame": _FRAME}


def _names(names: Sequence[str], index: np.ndarray) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(index, pa.int32()), pa.array(list(names), pa.string()))


def measurements_table(record: MissionRecord) -> pa.Table:
    """Every detector sample, in time order: one row each, units in the column names."""
    samples = record.samples
    phases, index = np.unique(samples.phase, return_inverse=True)
    columns = {
        "vehicle": _names([v.name for v in record.vehicles], samples.vehicle),
        "phase": _names([str(p) for p in phases], index),
        "time_s": samples.time_s.astype(np.float64),
        "east_m": samples.position_m[:, 0].astype(np.float32),
        "north_m": samples.position_m[:, 1].astype(np.float32),
        "up_m": samples.position_m[:, 2].astype(np.float32),
        "counts": samples.counts.astype(np.float32),
        "exposure_s": samples.exposure_s.astype(np.float32),
        "count_rate_cps": samples.count_rate_cps.astype(np.float32),
    }
    return pa.table(
        columns, metadata=_metadata(record, "detector samples; position is the crystal's, time the end of a count")
    )


def trajectories_table(record: MissionRecord) -> pa.Table:
    """The tracks of all vehicles, one after the other: one row for each logged time."""
    vehicles = record.vehicles
    lengths = [len(v.time_s) for v in vehicles]

    def column(values: list[np.ndarray], kind: type = np.float32) -> np.ndarray:
        return np.concatenate(values).astype(kind)

    columns: dict[str, Any] = {
        "vehicle": _names([v.name for v in vehicles], np.repeat(np.arange(len(vehicles)), lengths)),
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


def missions_table(rows: list[dict[str, Any]]) -> pa.Table:
    """One row a mission. A number that no mission has is still a column of numbers, all null."""
    columns = {}
    for key in rows[0]:
        values = [row[key] for row in rows]
        empty = all(v is None for v in values)
        columns[key] = (
            pa.array(values, pa.string() if key == "nuclide" else pa.float64()) if empty else pa.array(values)
        )
    return pa.table(columns)


def _write_map(record: MissionRecord, path: Path) -> None:
    """The radiation map with its axes; row 0 is the south edge."""
    made = record.map
    ny, nx = made.mean_cps.shape
    np.savez_compressed(
        path,
        mean_cps=made.mean_cps,
        std_cps=made.std_cps,
        east_m=made.origin_m[0] + made.cell_m * np.arange(nx),
        north_m=made.origin_m[1] + made.cell_m * np.arange(ny),
        cell_m=made.cell_m,
        hotspots_m=made.hotspots_m,
    )
