"""What a flight leaves: the track that was flown against the one that was asked for, and what happened when."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from swarmsim.autopilot.along_track import nearest
from swarmsim.autopilot.compare import on_lines
from swarmsim.autopilot.link import Identity, Setpoint, Telemetry
from swarmsim.results.names import FLIGHT, FLOWN

_NOTHING = (np.nan, np.nan, np.nan)


@dataclass
class FlownLog:
    """Rows of a flight as they come, a judging period apart, and its events."""

    rows: list[tuple[float, ...]] = field(default_factory=list)
    modes: list[str] = field(default_factory=list)
    by_hand: list[bool] = field(default_factory=list)  # of each row: a pilot flew, or it was on its way back
    events: list[tuple[float, str]] = field(default_factory=list)
    ended: str = ""  # why the vehicle's part ended before its time; empty if it did not
    paths: list[np.ndarray] = field(default_factory=list)
    _start: float = field(default_factory=time.monotonic)
    _path: Any = None

    def event(self, text: str) -> None:
        """Something happened now."""
        self.events.append((time.monotonic() - self._start, text))

    def row(
        self, time_s: float, s: Setpoint, t: Telemetry, path_m: Callable[[], np.ndarray | None], by_hand: bool = False
    ) -> None:
        """What was asked for and measured at the mission's time ``time_s``."""
        if not self.rows or time_s - self.rows[-1][0] > 1.0 or len(self.rows) % 100 == 0:
            path = path_m()
            if path is not None and not any(np.array_equal(path, known) for known in self.paths):
                self.paths.append(path)
        self.modes.append(t.mode_name)
        self.by_hand.append(by_hand)
        self.rows.append(
            (
                time_s,
                time.monotonic() - self._start,
                *(s.position_m or _NOTHING),
                *(s.velocity_m_s or _NOTHING),
                *(t.position_m or _NOTHING),
                *(t.velocity_m_s or _NOTHING),
                np.nan if t.battery is None else t.battery,
            )
        )

    def table(self) -> pa.Table:
        """One row for each judging period: time s, positions m and velocities m/s (world ENU), mode, battery.

        ``by_hand``: a pilot flew, or it was on its way back. Setpoints of a rover are in its body frame.
        """
        names = ["time_s", "wall_s"]
        names += [f"{what}_{axis}_{unit}" for what, unit in _COLUMNS for axis in "xyz"]
        columns = np.asarray(self.rows, np.float64).reshape(-1, len(names) + 1).T
        table = dict(zip([*names, "battery"], columns, strict=True))
        return pa.table(
            {**table, "mode": pa.array(self.modes, pa.string()), "by_hand": pa.array(self.by_hand, pa.bool_())}
        )

    def cross_track_m(self) -> np.ndarray:
        """Horizontal distances [n] from the planned path, where the vehicle was to fly at nearly full speed."""
        rows = np.asarray(self.rows, np.float64)
        rows = rows[~np.asarray(self.by_hand, bool)]
        if not len(rows) or not self.paths:
            return np.zeros(0)
        fast = on_lines(np.hypot(rows[:, 5], rows[:, 6])) & np.isfinite(rows[:, 8])
        places = rows[fast, 8:10]
        return np.min([nearest(places, path)[0] for path in self.paths], axis=0) if len(places) else np.zeros(0)


_COLUMNS = (("setpoint", "m"), ("setpoint_velocity", "m_s"), ("measured", "m"), ("measured_velocity", "m_s"))


def report(
    log: FlownLog, gaps_s: np.ndarray, identity: Identity, vehicle: str, takeover_s: tuple[float, float] | None
) -> dict[str, Any]:
    """What a flight is summed up by; times in s, lengths in m."""
    error = log.cross_track_m()
    gaps = {
        "setpoints": len(gaps_s) + 1 if len(gaps_s) else 0,
        **{f"gap_p{p:g}_s": float(np.percentile(gaps_s, p)) if len(gaps_s) else None for p in (50, 99, 99.9)},
        "gap_max_s": float(np.max(gaps_s)) if len(gaps_s) else None,
    }
    return {
        "vehicle": vehicle,
        "autopilot": vars(identity) | {},
        "ended": log.ended or "as planned",
        "stream": gaps,
        "cross_track": {
            "samples": len(error),
            "rms_m": float(np.sqrt(np.mean(error**2))) if len(error) else None,
            "max_m": float(np.max(error)) if len(error) else None,
        },
        "takeover_to_silence_s": None if takeover_s is None else takeover_s[1] - takeover_s[0],
        "events": [{"wall_s": round(when, 3), "what": what} for when, what in log.events],
    }


def write(folder: Path, log: FlownLog, summary: dict[str, Any]) -> None:
    """Write the track and the report into the run's folder."""
    pq.write_table(log.table(), folder / FLOWN)
    (folder / FLIGHT).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
