"""A flight that was read from a log, as a table and as a report."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from swarmsim.autopilot.logs.flight_log import Change, FlightLog, Floats

MESSAGES_MAX = 1000  # in a report


def track_table(log: FlightLog, origin: str = "the log's origin") -> pa.Table:
    """One row for each position: time s, position m, velocity m/s, attitude, mode, arming, battery, setpoint m.

    ``origin`` says in words what the positions are relative to.
    """
    time_s = log.time_s
    columns: dict[str, Any] = {"time_s": time_s}
    for name, unit, values in (("", "_m", log.position_m), ("velocity_", "_m_s", log.velocity_m_s)):
        columns |= {f"{name}{axis}{unit}": values[:, k] for k, axis in enumerate(("east", "north", "up"))}
    columns |= {f"q{axis}": log.quaternion[:, k] for k, axis in enumerate("wxyz")}
    columns["mode"] = pa.array(_held(log.modes, time_s), pa.string())
    columns["armed"] = pa.array([None if a is None else a == "armed" for a in _held(log.armed, time_s)], pa.bool_())
    columns["battery"] = _latest(log.battery.time_s, log.battery.values[:, None], time_s)[:, 0]
    setpoint = _latest(log.setpoints.time_s, log.setpoints.values, time_s)
    columns |= {f"setpoint_{axis}_m": setpoint[:, k] for k, axis in enumerate(("east", "north", "up"))}
    frame = "quaternion w x y z, body (forward left up) to world; time from the first position"
    return pa.table(columns, metadata={"frame": f"ENU about {origin}; {frame}"})


def report(log: FlightLog) -> dict[str, Any]:
    """What the log is and tells, but for the track; times in s."""
    return {
        "format": log.format,
        "autopilot": log.autopilot,
        "vehicle": log.vehicle,
        "system": log.system,
        "origin": None if log.origin is None else vars(log.origin),
        "duration_s": float(log.time_s[-1]),
        "positions": len(log.time_s),
        "flown_s": [list(span) for span in log.spans_s()],
        "modes": _listed(log.modes),
        "armed": _listed(log.armed),
        "messages": _listed(log.messages[:MESSAGES_MAX]),
        "battery": [float(v) for v in log.battery.values[[0, -1]]] if len(log.battery.values) else None,
        "notes": list(log.notes),
    }


def _listed(changes: Sequence[Change]) -> list[dict[str, Any]]:
    return [{"time_s": round(change.time_s, 3), "what": change.name} for change in changes]


def _held(changes: Sequence[Change], time_s: Floats) -> list[str | None]:
    """What held at each time; None before the first."""
    last = np.searchsorted([change.time_s for change in changes], time_s, "right") - 1
    return [changes[k].name if k >= 0 else None for k in last]


def _latest(at_s: Floats, values: Floats, time_s: Floats) -> Floats:
    """The latest value [n, k] at each time; NaN before the first."""
    if not len(at_s):
        return np.full((len(time_s), values.shape[1]), np.nan)
    last = np.searchsorted(at_s, time_s, "right") - 1
    return np.where((last >= 0)[:, None], values[np.maximum(last, 0)], np.nan)
