"""Tables of cases as files."""

import csv
from collections.abc import Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any


def write_table(path: Path, cases: Sequence[Any]) -> None:
    """Write ``cases``, instances of one dataclass and at least one of them, as a CSV file with a row for each."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(field.name for field in fields(cases[0]))
        writer.writerows([f"{v:.4g}" if isinstance(v, float) else v for v in astuple(case)] for case in cases)
