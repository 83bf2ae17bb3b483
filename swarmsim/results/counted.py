"""What was counted in a mission, read back from its run directory."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from swarmsim.config.errors import InputError
from swarmsim.results import names
from swarmsim.results.record import Samples, Spectrum, Window
from swarmsim.results.tables import AXES, DOSES, WINDOWS_KEY, window_column


class Counted(Protocol):
    """The counts of one mission; a `MissionRecord` has them, too."""

    @property
    def name(self) -> str:
        """Name of the mission."""

    @property
    def seed(self) -> int:
        """Its seed."""

    @property
    def samples(self) -> Samples:
        """Detector samples of all vehicles."""

    @property
    def windows_kev(self) -> tuple[Window, ...]:
        """The energy windows of the samples."""

    @property
    def spectrum(self) -> Spectrum | None:
        """The spectrum that the nuclide was identified by."""


@dataclass(frozen=True)
class CountedRun:
    """The counts of the mission that a run directory has tables of."""

    name: str
    seed: int
    vehicles: tuple[str, ...]
    samples: Samples
    windows_kev: tuple[Window, ...]
    spectrum: Spectrum | None


def read_counts(run: Path | str) -> CountedRun:
    """Read the counts of a run directory; of a batch, those of its first mission.

    Raises `InputError` where that is no run, or one of an older swarmsim that has no counts by energy window.
    """
    run = Path(run)
    path = run / names.MEASUREMENTS
    if not path.is_file():
        raise InputError.of(f"is not the folder of a run (no {names.MEASUREMENTS} in it)", given=str(run))
    table = _read(path)
    metadata = _metadata(table)
    if WINDOWS_KEY not in metadata or "dose_rate_usv_h" not in table.column_names:
        raise InputError.of(
            "has no counts by energy window: its mission has no detectors, or an older swarmsim wrote it",
            given=str(path),
            suggestion=f"fly it again: swarmsim run {run / names.SCENARIO}",
        )
    windows = tuple((float(low), float(high)) for low, high in json.loads(metadata[WINDOWS_KEY]))
    vehicles = table["vehicle"].combine_chunks()
    spectrum = run / names.SPECTRUM
    return CountedRun(
        name=metadata["mission"],
        seed=int(metadata["seed"]),
        vehicles=tuple(vehicles.dictionary.to_pylist()),
        samples=_samples(table, windows),
        windows_kev=windows,
        spectrum=_spectrum(_read(spectrum)) if spectrum.is_file() else None,
    )


def _read(path: Path) -> pa.Table:
    try:
        return pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        reason = str(error).splitlines()[0]
        raise InputError.of(f"cannot be read as a table ({reason})", given=str(path)) from error


def _metadata(table: pa.Table) -> dict[str, str]:
    return {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}


def _samples(table: pa.Table, windows: tuple[Window, ...]) -> Samples:
    def column(name: str) -> np.ndarray:
        return np.asarray(table[name].to_numpy(), float)

    vehicle = table["vehicle"].combine_chunks().indices
    by_window = [column(window_column(window)) for window in windows]
    return Samples(
        vehicle=np.asarray(vehicle.to_numpy(zero_copy_only=False), np.int32),
        phase=np.array(table["phase"].to_pylist(), str),
        time_s=column("time_s"),
        position_m=np.stack([column(f"{axis}_m") for axis in AXES], axis=1),
        counts=column("counts"),
        exposure_s=column("exposure_s"),
        count_rate_cps=column("count_rate_cps"),
        axis=np.stack([column(f"axis_{axis}") for axis in AXES], axis=1),
        windows=np.stack(by_window, axis=1) if by_window else np.zeros((table.num_rows, 0)),
        **{name: column(name) for name in DOSES},
        saturated=None if "saturated" not in table.column_names else column("saturated") > 0.5,
    )


def _spectrum(table: pa.Table) -> Spectrum:
    metadata = _metadata(table)
    energy, counts, background, fit = (np.asarray(column, float) for column in table.columns)
    return Spectrum(
        energy_kev=energy,
        counts=counts,
        background=background,
        fit=fit,
        live_time_s=float(metadata["live_time_s"]),
        nuclide=metadata["nuclide"],
        confidence=float(metadata["confidence"]),
        scores={},
        detector=metadata["detector"],
        begin_s=float(metadata.get("begin_s", 0.0)),
        sure=metadata.get("sure", "True") == "True",
    )
