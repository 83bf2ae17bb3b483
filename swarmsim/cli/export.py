"""What ``swarmsim export-n42`` does."""

import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from swarmsim.config.errors import InputError
from swarmsim.results.names import SCENARIO

FOLDER = "n42"  # in the run's


def export_run(run: Path, out: Path | None, vehicles: Sequence[str], start: datetime | None, force: bool) -> None:
    """Write the N42.42 documents of a run and tell their names."""
    if not (run / SCENARIO).is_file():
        raise InputError.of(f"is not the folder of a run (no {SCENARIO} in it)", given=str(run))
    from swarmsim.results.counted import read_counts

    counted = read_counts(run)
    folder = run / FOLDER if out is None else out

    from swarmsim.config.scenario import load_scenario
    from swarmsim.results.n42 import START, check_export, write_n42
    from swarmsim.runtime.run import build

    check_export(folder, force)
    began = START if start is None else start
    simulation = build(load_scenario(run / SCENARIO))
    written = write_n42(simulation, counted, folder, vehicles=vehicles or None, start=began, force=force)
    for path in written:
        sys.stdout.write(f"{path}  {path.stat().st_size / 1e6:.1f} MB\n")
