"""How often missions notice a source that is so many times as strong as the detection limit that they tell.

    python -m experiments.validation.detection --missions 32 --out out/detection
    python -m experiments.validation.detection --nuclide Cs-137 --set phases.0.settings.altitude_m=30 --out out/high

The missions of ``recon``, with one source in the open. Each is flown without it, which tells the limit that holds at
95 % of the survey area (`swarmsim.estimation.detection_limit`), and with it at several times that limit. Places are
drawn all over the site, or, with ``--weakest``, the tenth of them that is farthest from where anything was measured.
Writes ``detection.csv`` (a row for each mission and activity) and ``summary.json``.
"""

import argparse
import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

import swarmsim
from swarmsim.results.record import MissionRecord

TIMES = (0.5, 0.7, 1.0, 1.4)  # the limit
NEAR_M = 25.0  # an estimate farther away is of no source
BACKGROUND = "vary.background.scale={uniform: [0.8, 1.2]}"
PLACE = "vary.sources.0.position_m={place: {region: [open], margin_m: 0.5}}"
POOL, WEAK_SHARE = 500, 0.1  # places that are drawn, and those of them that are farthest from where was measured


def main(arguments: Sequence[str] | None = None) -> None:
    """Fly the missions and write what they noticed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--missions", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--nuclide", default="Co-60")
    parser.add_argument("--weakest", action="store_true", help="sources where least would be noticed")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE")
    options = parser.parse_args(arguments)
    if options.missions < 1:
        parser.error(f"argument --missions: {options.missions} is too few, give 1 or more")
    nuclide = f"sources.0.nuclide={options.nuclide}"
    simulation = swarmsim.build(swarmsim.load("recon", (PLACE, BACKGROUND, nuclide, *options.set)))
    seeds = range(options.seed, options.seed + options.missions)
    silent = _flown(simulation, seeds, {"sources.0.activity_mbq": [0.0] * len(seeds)})
    limits = np.array([record.noticed_mbq.get(options.nuclide, np.inf) for record in silent])
    if not np.all(np.isfinite(limits)):
        parser.error(f"argument --nuclide: {options.nuclide} of no activity would be noticed in these missions")
    places = {}
    if options.weakest:
        places = {"sources.0.position_m": _weak_places(simulation, silent)}
    rows = []
    for times in TIMES:
        flown = _flown(simulation, seeds, {"sources.0.activity_mbq": (times * limits).tolist()} | places)
        rows += [row_of(record, times, limit) for record, limit in zip(flown, limits, strict=True)]
    options.out.mkdir(parents=True, exist_ok=True)
    with (options.out / "detection.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    summary = summarised(rows, limits) | {"false": sum(bool(record.estimates) for record in silent)}
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1))
    print(json.dumps(summary))


def _flown(simulation: Any, seeds: range, values: dict[str, Any]) -> list[MissionRecord]:
    batch = simulation.rollout(seeds, values=values)
    return [swarmsim.mission_record(simulation, batch, i) for i in range(len(seeds))]


def _weak_places(simulation: Any, silent: Sequence[MissionRecord]) -> list[list[float]]:
    """A place [2] for each mission, of those drawn in the open the ones farthest from its measurements."""
    drawn = simulation.draw(range(POOL)).values["sources.0.position_m"]
    pool = np.array([np.asarray(place, float)[:2] for place in drawn])
    places = []
    for number, record in enumerate(silent):
        apart = cKDTree(np.asarray(record.samples.position_m, float)[:, :2]).query(pool)[0]
        far = np.argsort(-apart)[: max(1, int(WEAK_SHARE * POOL))]
        places.append(pool[far[number % len(far)]].tolist())
    return places


def row_of(record: MissionRecord, times: float, limit_mbq: float) -> dict[str, Any]:
    """What a mission told of its source."""
    (source,) = record.sources
    place = np.asarray(source.position_m, float)[:2]
    apart = [float(np.linalg.norm(np.asarray(one.position_m, float)[:2] - place)) for one in record.estimates]
    return {
        "seed": record.seed,
        "times": times,
        "limit_mbq": round(float(limit_mbq), 2),
        "east_m": round(float(place[0]), 2),
        "north_m": round(float(place[1]), 2),
        "noticed": min(apart, default=np.inf) < NEAR_M,
        "error_m": round(min(apart), 3) if apart else None,
        "status": record.status,
    }


def summarised(rows: Sequence[dict[str, Any]], limits: np.ndarray) -> dict[str, Any]:
    """Shares noticed by how many times the limit the source had."""
    shares = {}
    for times in sorted({row["times"] for row in rows}):
        own = [row["noticed"] for row in rows if row["times"] == times]
        shares[str(times)] = {"missions": len(own), "noticed": sum(own), "share": round(float(np.mean(own)), 3)}
    return {"limit_mbq": {"median": round(float(np.median(limits)), 1), "max": round(float(np.max(limits)), 1)}} | {
        "by_times_the_limit": shares
    }


if __name__ == "__main__":
    main()
