"""What missions tell of two sources beside one another, of one nuclide or of two.

    python -m experiments.validation.pairs --missions 64 --out out/pairs
    python -m experiments.validation.pairs --mixed --missions 64 --out out/mixed

Two sources on the site of ``recon``, 1 to 14 m apart, 20 to 400 MBq each, in no solid obstacle but in buildings too.
With ``--mixed`` they are of different nuclides, and a third of them in one place.

Writes ``pairs.csv`` (a row for each mission) and ``summary.json``: by distance, how many are told as two, as one that
may be several, or as one; how many of those answers that say that they are sure have both sources in the 95 % region of
a place that they tell for their nuclide. And, of one nuclide, of the weaker sources 3 to 12 m from the stronger, by
their activity over the one from which on the answer says that it would have noticed them: how many it told, or told of
one with a doubt of any kind.
"""

import argparse
import csv
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import swarmsim
from experiments.validation.missions import INSIDE_95
from swarmsim.estimation.pairs import COMPANION_M, ONE_M
from swarmsim.results.record import MissionRecord

NUCLIDES = ("Co-60", "Cs-137", "Na-22", "I-131", "Eu-152")
APART_M = (1.0, 2.0, 3.0, 6.0, 14.0)
IN_ONE_PLACE = 1.0 / 3.0  # of the mixed ones
ACTIVITY_MBQ = (20.0, 400.0)
PLACE_M = ((-50.0, 50.0), (20.0, 40.0))  # x, and y to either side of the road in the middle of ``works_yard``
HEIGHT_M = 1.0
OF_LIMIT = (0.0, 0.25, 0.5, 1.0, 2.0, np.inf)  # activity over the detection limit
TRIES = 20  # pairs that are drawn for one in no obstacle


def main(arguments: Sequence[str] | None = None) -> None:
    """Fly the missions and write what they told."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--missions", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mixed", action="store_true", help="of two nuclides, also in one place")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE")
    options = parser.parse_args(arguments)
    if options.missions < 1:
        parser.error(f"argument --missions: {options.missions} is too few, give 1 or more")
    rng = np.random.default_rng(options.seed)
    rows = []
    for number in range(options.missions):
        drawn, simulation = _built(rng, options.mixed, options.set)
        record = swarmsim.mission_record(simulation, simulation.rollout(options.seed + number), 0)
        rows.append(row_of(drawn, record))
        print(f"{number + 1} of {options.missions}: {json.dumps(rows[-1])}", flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    with (options.out / "pairs.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    summary = summarised(rows)
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1))
    print(json.dumps(summary))


def _built(
    rng: np.random.Generator, mixed: bool, settings: Sequence[str]
) -> tuple[dict[str, Any], swarmsim.Simulation]:
    """A pair that is drawn, and the simulation with it; another one where a source would lie in a solid obstacle."""
    for _ in range(TRIES):
        drawn = _drawn(rng, mixed)
        own = ["engine=analytic", "knowledge.nuclides=unknown", f"sources={_sources(drawn)}", *settings]
        scenario = swarmsim.load("recon", own)
        try:
            return drawn, swarmsim.build(scenario)
        except swarmsim.InputError:
            continue
    raise RuntimeError(f"of {TRIES} pairs each lies in an obstacle")


def _drawn(rng: np.random.Generator, mixed: bool) -> dict[str, Any]:
    """Nuclides [2], places [2, 2] and activities [2] of a pair."""
    apart, turn = np.exp(rng.uniform(*np.log([APART_M[0], APART_M[-1]]))), rng.uniform(0.0, 2.0 * np.pi)
    first = np.array([rng.uniform(*PLACE_M[0]), rng.choice([-1.0, 1.0]) * rng.uniform(*PLACE_M[1])])
    nuclides = [str(rng.choice(NUCLIDES))] * 2
    if mixed:
        nuclides = [str(name) for name in rng.choice(NUCLIDES, 2, replace=False)]
        apart = 0.0 if rng.uniform() < IN_ONE_PLACE else apart
    return {
        "nuclides": nuclides,
        "places": np.array([first, first + apart * np.array([np.cos(turn), np.sin(turn)])]),
        "mbq": np.exp(rng.uniform(*np.log(ACTIVITY_MBQ), 2)),
    }


def _sources(drawn: dict[str, Any]) -> str:
    one = "{{nuclide: {}, activity_mbq: {:.2f}, position_m: [{:.3f}, {:.3f}], height_m: {}}}"
    pair = zip(drawn["nuclides"], drawn["mbq"], drawn["places"], strict=True)
    return f"[{', '.join(one.format(name, a, *p, HEIGHT_M) for name, a, p in pair)}]"


def row_of(drawn: dict[str, Any], record: MissionRecord) -> dict[str, Any]:
    """What a mission told of a pair; ``sigmas`` are how far both are from the next place, in standard deviations.

    Of the places that are told for their nuclide.
    """
    sigmas = [
        min((_sigmas(place, one) for one in record.estimates if one.nuclide == name), default=np.inf)
        for name, place in zip(drawn["nuclides"], drawn["places"], strict=True)
    ]
    if any(one.joined_m > 0.0 for one in record.estimates):
        told = "may be several"
    else:
        told = {0: "none", 1: "one", 2: "two"}.get(len(record.estimates), "more")
    return {
        "seed": record.seed,
        "nuclides": drawn["nuclides"],
        "apart_m": round(float(np.linalg.norm(drawn["places"][1] - drawn["places"][0])), 2),
        "mbq": [round(float(a), 1) for a in drawn["mbq"]],
        "status": record.status,
        "told": told,
        "sigmas": [round(float(x), 2) for x in sigmas],
        "beside_mbq": _beside_mbq(drawn, record),
    }


def _beside_mbq(drawn: dict[str, Any], record: MissionRecord) -> float | None:
    """What the answer says that a source beside the stronger one of the pair must have to be noticed; None: nothing."""
    stronger = drawn["places"][int(np.argmax(drawn["mbq"]))]
    apart = [float(np.linalg.norm(np.asarray(one.position_m)[:2] - stronger)) for one in record.estimates]
    if not apart:
        return None
    limit = float(record.estimates[int(np.argmin(apart))].beside_mbq)
    return round(limit, 1) if np.isfinite(limit) else None


def _sigmas(place: np.ndarray, estimate: Any) -> float:
    apart = place - np.asarray(estimate.position_m, float)[:2]
    return float(np.sqrt(apart @ np.linalg.solve(np.asarray(estimate.covariance_m2, float)[:2, :2], apart)))


def summarised(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The rows in numbers, by distance."""
    found = {}
    for low, high in itertools.pairwise((0.0, *APART_M)):
        own = [row for row in rows if low <= row["apart_m"] < high]
        sure = [row for row in own if row["status"] == "located"]
        inside = [max(row["sigmas"]) < INSIDE_95 for row in sure]
        found[f"{low:g} to {high:g} m"] = {
            "missions": len(own),
            "located": len(sure),
            "told": {told: sum(row["told"] == told for row in sure) for told in ("two", "may be several", "one")},
            "both_inside_95": sum(inside),
        }
    one_nuclide = [row for row in rows if len(set(row["nuclides"])) == 1]
    return found | ({"by_limit": _by_limit(one_nuclide)} if one_nuclide else {})


def _by_limit(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """How many weaker sources were noticed, by their activity over the limit beside the stronger one."""
    near = [row for row in rows if ONE_M <= row["apart_m"] <= COMPANION_M and row["told"] != "none"]
    limits = [np.inf if row["beside_mbq"] is None else max(row["beside_mbq"], 0.1) for row in near]
    share = np.array([min(row["mbq"]) for row in near]) / np.array(limits)
    told = np.array([row["told"] != "one" for row in near], bool)
    doubted = np.array([row["told"] == "one" and row["status"] != "located" for row in near], bool)
    found = {}
    for low, high in itertools.pairwise(OF_LIMIT):
        own = (share >= low) & (share < high)
        found[f"{low:g} to {high:g}"] = {
            "sources": int(np.sum(own)), "told": int(np.sum(own & told)), "doubted": int(np.sum(own & doubted)),
        }  # fmt: skip
    return found


if __name__ == "__main__":
    main()
