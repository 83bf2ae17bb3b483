"""What a family of missions finds, against the truth: coverage, gross errors, numbers of sources, false alarms.

    python -m experiments.validation.missions random_recon --missions 256 --out out/works_yard
    python -m experiments.validation.missions random_recon --set site=meadows --missions 64 --out out/meadows
    python -m experiments.validation.missions random_recon --without-sources --missions 256 --out out/none
    python -m experiments.validation.missions experiments/validation/near_starts.yaml --survey --out out/starts

Writes ``sources.csv`` (a row for each true source and each false one), ``summary.json`` and ``errors.png``. A true
source counts as found by the estimate next to it, up to 25 m away. It is detectable where the same likelihood, with all
sources at their true places, misses it by more than the mission asks of a source (of one beside others it asks more).
"""

import argparse
import csv
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import swarmsim
from swarmsim.estimation.localise import problem_of
from swarmsim.estimation.state import no_sources, ratios, settled, signals
from swarmsim.missions.knowledge import gathered
from swarmsim.results.record import Estimate, MissionRecord, TrueSource
from swarmsim.site.model import height_at

matplotlib.use("Agg")
NEAR_M = 25.0
INSIDE_95 = 2.4477  # Mahalanobis distance in two dimensions that holds 95 %
GROSS = 5.2565  # the same of 5 standard deviations: as rare as those are in one dimension
RESOLVED_M = 25.0


def main(arguments: Sequence[str] | None = None) -> None:
    """Fly the missions and write what they found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mission")
    parser.add_argument("--missions", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE")
    parser.add_argument("--without-sources", action="store_true", help="fly the mission without any source")
    parser.add_argument("--survey", action="store_true", help="judge what the survey found, not all counts together")
    options = parser.parse_args(arguments)
    settings = options.set + (without_sources(options.mission, options.set) if options.without_sources else [])
    simulation = swarmsim.build(swarmsim.load(options.mission, settings))
    seeds = range(options.seed, options.seed + options.missions)
    batch = simulation.rollout(seeds)
    detectable = detectable_ratios(simulation, batch)
    records = [swarmsim.mission_record(simulation, batch, i) for i in range(options.missions)]
    if options.survey:
        records = [by_survey(record) for record in records]
    mission = simulation.scenario.mission
    assert mission.localisation is not None
    asked = (mission.localisation.detection_sigma**2, mission.localisation.further_sigma**2)
    rows = [row for record, seen in zip(records, detectable, strict=True) for row in rows_of(record, seen, asked)]
    summary = summarised(records, rows) | {"clock_s": {name: round(s, 2) for name, s in batch.clock.ran.items()}}
    options.out.mkdir(parents=True, exist_ok=True)
    with (options.out / "sources.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else ["seed"])
        writer.writeheader()
        writer.writerows(rows)
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1))
    _figure(rows, options.out / "errors.png")
    print(json.dumps(summary))


def by_survey(record: MissionRecord) -> MissionRecord:
    """The record with the survey's sources in the place of those by all counts; its status stays."""
    return replace(record, estimate=record.survey_estimate, further=record.survey_further)


def without_sources(mission: str, settings: list[str]) -> list[str]:
    """Settings that take all sources, and what is drawn of them, out of a mission."""
    drawn = swarmsim.load(mission, settings).mission.vary
    return ["sources=[]", *(f"vary.{path}=null" for path in drawn if path.split(".")[0] == "sources")]


def detectable_ratios(simulation: Any, batch: Any) -> list[np.ndarray]:
    """For each mission the likelihood ratio of every true source, in their order, all of them at their true places."""
    plan, world, site = simulation.plan, simulation.world, simulation.site_model.site

    @jax.jit
    def of(windows: Any, key: jax.Array, plan: Any, place: Any, nuclide: Any, activity: Any) -> jax.Array:
        problem = problem_of(plan.presumed, gathered(world, plan, windows, key), plan.spans)
        state = no_sources(problem, place.shape[0], plan.presumed.nuclides.shape[0])
        sources = replace(state.sources, place=place, nuclide=nuclide, activity_bq=activity, present=activity > 0.0)
        added = signals(problem, sources, state.unknowns.lengths)
        return ratios(problem, settled(problem, replace(state, sources=sources, added=added)))

    found = []
    for i, seed in enumerate(np.asarray(batch.seeds)[: len(batch.seeds)]):
        sources = batch.worlds.of(i).sources
        position = np.asarray(sources.position_m, float)
        place = position.copy()
        place[:, 2] -= height_at(site, position[:, :2])
        windows = jax.tree.map(lambda x, i=i: jnp.asarray(np.asarray(x)[i]), batch.end.windows)
        key = jax.random.key(int(seed))
        activity = np.asarray(sources.activity_bq)
        ratio = of(windows, key, plan, jnp.float32(place), jnp.asarray(sources.nuclide), jnp.asarray(activity))
        found.append(np.asarray(ratio)[activity > 0.0])
    return found


def rows_of(record: MissionRecord, ratio: np.ndarray, asked: tuple[float, float]) -> list[dict[str, Any]]:
    """A row for each true source of a mission, and for each false one.

    ``ratio`` is twice the logarithm of the likelihood ratio of each true source, ``asked`` what the mission asks of one
    that is alone and of one beside others.
    """
    active = record.sources
    least = asked[len(active) > 1]
    seen = [float(r) for r in ratio] + [0.0] * len(active)
    matched = matches(active, record.estimates)
    rows = []
    for number, source in enumerate(active):
        places = [np.linalg.norm(source.position_m[:2] - o.position_m[:2]) for o in active if o is not source]
        row = {"seed": record.seed, "status": record.status, "true": source.nuclide, "mbq": source.activity_mbq,
               "region": record.drawn.get(f"sources.{number}.region"), "apart_m": min(places, default=np.inf),
               "true_ratio": seen[number], "detectable": seen[number] > least, "finding": record.finding,
               "found": None}  # fmt: skip
        rows.append(row | _judged(matched.get(number), source))
    for k, estimate in enumerate(record.estimates):
        if k not in {id_ for id_, _ in matched.values()}:
            row = {"seed": record.seed, "status": record.status, "true": None, "mbq": 0.0, "region": None,
                   "apart_m": None, "true_ratio": None, "detectable": None, "finding": record.finding}  # fmt: skip
            rows.append(row | _judged((k, estimate), None))
    return rows


def matches(sources: Sequence[TrueSource], estimates: Sequence[Estimate]) -> dict[int, tuple[int, Estimate]]:
    """Which estimate stands for which true source: the nearest pairs first, up to 25 m apart."""
    pairs = sorted(
        (float(np.linalg.norm(s.position_m[:2] - e.position_m[:2])), i, k)
        for i, s in enumerate(sources)
        for k, e in enumerate(estimates)
    )
    found: dict[int, tuple[int, Estimate]] = {}
    for distance, i, k in pairs:
        if distance <= NEAR_M and i not in found and k not in {used for used, _ in found.values()}:
            found[i] = (k, estimates[k])
    return found


def _judged(matched: tuple[int, Estimate] | None, source: TrueSource | None) -> dict[str, Any]:
    if matched is None:
        return dict.fromkeys(
            ("found", "error_m", "std_m", "sigmas", "activity", "activity_sigmas", "ratio", "effective", "converged")
        )
    one = matched[1]
    covariance = np.asarray(one.covariance_m2, float)[:2, :2]
    judged: dict[str, Any] = {
        "found": one.nuclide, "std_m": float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])), "activity": one.activity_mbq,
        "ratio": one.detection, "effective": one.effective_samples, "converged": one.converged,
        "error_m": None, "sigmas": None, "activity_sigmas": None,
    }  # fmt: skip
    if source is not None:
        apart = np.asarray(source.position_m, float)[:2] - np.asarray(one.position_m, float)[:2]
        judged["error_m"] = float(np.linalg.norm(apart))
        judged["sigmas"] = float(np.sqrt(apart @ np.linalg.solve(covariance, apart)))
        share = one.activity_std_mbq / max(one.activity_mbq, 1e-9)
        judged["activity_sigmas"] = float(np.log(one.activity_mbq / source.activity_mbq) / share)
    return judged


def summarised(records: Sequence[MissionRecord], rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The rows in numbers."""
    located = [r for r in rows if r["status"] == "located" and r["sigmas"] is not None]
    matched = [r for r in rows if r["sigmas"] is not None]
    false = [r for r in rows if r["true"] is None]
    resolved, right, sure = 0, 0, 0
    for record in records:
        own = [r for r in rows if r["seed"] == record.seed and r["true"] is not None]
        if own and all(r["detectable"] for r in own) and all(r["apart_m"] >= RESOLVED_M for r in own):
            resolved += 1
            right += len(record.estimates) == len(own)
            sure += record.status == "located"
    return {
        "site": records[0].site,
        "missions": len(records),
        "statuses": dict(Counter(record.status for record in records)),
        "true": sum(r["true"] is not None for r in rows),
        "found": len(matched),
        "false": len(false),
        "false_alarms": _share([bool(record.estimates) for record in records if not record.sources]),
        "false_located": sum(r["status"] == "located" for r in false),
        "located_sources": len(located),
        "located_inside_95": _share([r["sigmas"] < INSIDE_95 for r in located]),
        "located_beyond_5_sigma": _share([r["sigmas"] > GROSS for r in located]),
        "all_inside_95": _share([r["sigmas"] < INSIDE_95 for r in matched]),
        "all_beyond_5_sigma": _share([r["sigmas"] > GROSS for r in matched]),
        "activity_within_2": _share([abs(r["activity_sigmas"]) < 2 for r in located]),
        "nuclide_right": _share([r["found"] == r["true"] for r in matched]),
        "detectable_and_resolved": resolved,
        "of_those_number_right": right / max(resolved, 1),
        "of_those_located": sure / max(resolved, 1),
        "median_error_m": float(np.median([r["error_m"] for r in located])) if located else None,
    }


def _share(values: Sequence[bool]) -> float | None:
    return float(np.mean(values)) if values else None


def _figure(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Errors against stated standard deviations, and the distribution of their ratio."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.0), layout="constrained")
    for status, colour in (("located", "#0072B2"), ("other", "#D55E00")):
        own = [r for r in rows if r["sigmas"] is not None and (r["status"] == "located") == (status == "located")]
        if not own:
            continue
        left.loglog(
            [r["std_m"] for r in own], [max(r["error_m"], 1e-3) for r in own], "o", ms=3, c=colour, label=status
        )
        sigmas = np.sort([r["sigmas"] for r in own])
        right.plot(sigmas, np.arange(1, len(sigmas) + 1) / len(sigmas), c=colour, label=status)
    span = np.array([0.01, 30.0])
    left.plot(span, span, "k-", lw=0.8)
    left.plot(span, 3 * span, "k:", lw=0.8)
    left.set(xlabel="stated standard deviation (m)", ylabel="horizontal error (m)")
    r = np.linspace(0, 6, 200)
    right.plot(r, 1 - np.exp(-0.5 * r * r), "k-", lw=0.8, label="normal")
    right.set(xlim=(0, 8), xlabel="error over stated standard deviation (2-D)", ylabel="share of sources")
    for axes in (left, right):
        if axes.get_legend_handles_labels()[0]:
            axes.legend()
    figure.savefig(path, dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    main()
