"""A run on disk: ``runs/<name>/`` is complete or absent, whatever happens while it is written."""

import errno
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow.parquet as pq

from swarmsim.atomic_folder import atomic_folder
from swarmsim.config.errors import InputError
from swarmsim.config.scenario import Scenario
from swarmsim.playback import figures
from swarmsim.playback.recording import write_recording
from swarmsim.results import names
from swarmsim.results.batch import batch_row, batch_summary, source_rows
from swarmsim.results.out_folder import check_out, keep_elsewhere, told_of
from swarmsim.results.record import MissionRecord, RadiationMap
from swarmsim.results.summary import Timings, summary
from swarmsim.results.tables import (
    measurements_table,
    missions_table,
    sources_table,
    spectrum_table,
    trajectories_table,
)
from swarmsim.site.model import SiteModel

_FULL_BYTES = 2_000_000  # less is free where Rerun could not write its next chunk
_NO_ROOM = os.strerror(errno.ENOSPC)


class Built(Protocol):
    """What the files say of a simulation."""

    scenario: Scenario
    site_model: SiteModel


def write_run(
    simulation: Built,
    records: Sequence[MissionRecord],
    out: Path | str,
    timings: Timings | None = None,
    *,
    force: bool = False,
    keep: bool = False,
) -> dict[str, Any]:
    """Write all files of a run to the folder ``out`` and return its summary.

    Of a batch, every mission has a row in ``missions.parquet``, and every source that one found in ``sources.parquet``
    (which is not there if none did); tables, map, recording and figures are the first
    mission's (any other can be flown again from its seed). A mission that makes no map has no ``radiation_map.npz``.
    The time for writing is measured here.

    Args:
        simulation: whose missions these are.
        records: of one mission or more.
        out: folder, which must not exist unless ``force`` is given.
        timings: of compilation and rollouts; without them the summary has no real-time factor.
        force: replace an earlier run.
        keep: when anything fails, write what can be written to a temporary place, which the error tells.

    Raises:
        InputError: ``out`` cannot be used. On any error or Ctrl-C nothing of the new run is left there, and an earlier
            one still stands.
    """
    out = Path(out)
    parts = _parts(simulation, records, Timings() if timings is None else timings)
    content: dict[str, Any] = {}
    try:
        with told_of(out), atomic_folder(out, partial(check_out, force=force)) as folder:
            for part in parts:
                content = part(folder) or content
    except Exception as error:
        if keep:
            _keep(parts, out, error)
        raise
    return content


Part = Callable[[Path], dict[str, Any] | None]


def _parts(simulation: Built, records: Sequence[MissionRecord], timings: Timings) -> list[Part]:
    """Functions that each write a file of a run into a folder, the summary last, which is returned."""
    first, site, started = records[0], simulation.site_model, time.perf_counter()
    rows = [batch_row(record) for record in records] if len(records) > 1 else []
    sources = [row for record in records for row in source_rows(record)] if rows else []

    def write_scenario(folder: Path) -> None:
        (folder / names.SCENARIO).write_text(simulation.scenario.to_yaml(), encoding="utf-8")

    def write_tables(folder: Path) -> None:
        pq.write_table(measurements_table(first), folder / names.MEASUREMENTS, compression="zstd")
        pq.write_table(trajectories_table(first), folder / names.TRAJECTORIES, compression="zstd")
        if first.spectrum is not None:
            pq.write_table(spectrum_table(first, first.spectrum), folder / names.SPECTRUM, compression="zstd")
        if rows:
            pq.write_table(missions_table(rows), folder / names.MISSIONS, compression="zstd")
        if sources:
            pq.write_table(sources_table(sources), folder / names.SOURCES, compression="zstd")

    def write_map(folder: Path) -> None:
        if first.map is not None:
            _write_map(first.map, folder / names.MAP)

    def write_mission(folder: Path) -> None:
        try:
            write_recording(first, site, folder / names.RECORDING)
        except RuntimeError as error:  # Rerun's thread tells why on the standard error stream only
            full = shutil.disk_usage(folder).free < _FULL_BYTES
            raise OSError(errno.ENOSPC if full else errno.EIO, _NO_ROOM if full else f"recording: {error}") from error

    def write_figures(folder: Path) -> None:
        figures.write(first, site, folder / names.FIGURES)

    def write_summary(folder: Path) -> dict[str, Any]:
        timed = replace(timings, write_s=time.perf_counter() - started)
        content: dict[str, Any] = _finite(batch_summary(rows, records, timed) if rows else summary(first, timed))
        text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
        (folder / names.SUMMARY).write_text(text + "\n", encoding="utf-8")
        return content

    return [
        write_scenario,
        write_tables,
        write_map,
        write_mission,
        write_figures,
        write_summary,
    ]


def _keep(parts: Sequence[Part], out: Path, error: Exception) -> None:
    """Write what can be written to a temporary place; raises an `InputError` that tells it, or adds it to ``error``."""

    def write(folder: Path) -> int:
        return sum(_succeeds(part, folder) for part in parts)

    kept = keep_elsewhere(write, len(parts), out.name)
    text = "nothing of them could be kept" if kept is None else f"the results of the flight are kept in {kept}"
    if isinstance(error, InputError):
        told = [replace(problem, suggestion=text) for problem in error.problems]
        raise InputError(told) from error
    error.add_note(text)


def _succeeds(part: Part, folder: Path) -> bool:
    try:
        part(folder)
    except Exception:  # what failed in one place may fail in another, and the other parts do not
        return False
    return True


def _finite(value: Any) -> Any:
    """``value`` with None for numbers that are not finite, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _write_map(made: RadiationMap, path: Path) -> None:
    """The radiation map with its axes; row 0 is the south edge."""
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
