"""What a session with firmware leaves: true tracks of all vehicles, and how well the lockstep held."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from swarmsim.sitl.lockstep import Lockstep
from swarmsim.sitl.plant import ACTUATORS

TRACKS, REPORT = "sitl.parquet", "sitl.json"


def summary_of(lockstep: Lockstep, autopilot: str, engine: str) -> dict[str, Any]:
    """Real-time factor and waits of a session; times in s."""
    return {
        "autopilot": autopilot,
        "engine": engine,
        "period_s": lockstep.plant.period_s,
        "simulated_s": lockstep.time_s,
        "wall_s": lockstep.wall_s,
        "real_time_factor": lockstep.factor,
        "vehicles": [
            {
                "name": link.seat.name,
                "answers": waits.answers,
                "stalls": waits.stalls,
                "missed": waits.missed,
                "longest_wait_s": waits.longest_s,
                "mean_wait_s": waits.total_s / waits.answers if waits.answers else None,
                "restarts": link.restarts,
                "battery_left": float(lockstep.plant.truth.charge[link.seat.number]),
                "intact": bool(lockstep.plant.truth.intact[link.seat.number]),
            }
            for link, waits in zip(lockstep.links, lockstep.waits, strict=True)
        ],
    }


def table_of(lockstep: Lockstep) -> pa.Table:
    """A row for each vehicle and time: true position m, velocity m/s (world ENU), quaternion, battery, actuators."""
    names = [link.seat.name for link in lockstep.links]
    rows = np.asarray(lockstep.tracks.rows, np.float64).reshape(-1, 11 + ACTUATORS)
    columns = [f"position_{a}_m" for a in "xyz"] + [f"velocity_{a}_m_s" for a in "xyz"]
    columns += [f"quaternion_{a}" for a in "wxyz"] + ["battery_left"]
    columns += [f"actuator_{n}" for n in range(ACTUATORS)]
    times = np.repeat(np.asarray(lockstep.tracks.time_s, np.float64), len(names))
    own = {"time_s": times, "vehicle": names * len(lockstep.tracks.time_s)}
    return pa.table(own | dict(zip(columns, rows.T, strict=True)))


def write(folder: Path, lockstep: Lockstep, summary: dict[str, Any]) -> None:
    """Write both into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    pq.write_table(table_of(lockstep), folder / TRACKS)
    (folder / REPORT).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
