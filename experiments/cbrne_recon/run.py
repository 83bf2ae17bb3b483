"""Fly the reconnaissance mission over many seeds with both detectors; write measured against published figures."""

import argparse
import csv
import sys
from dataclasses import dataclass
from pathlib import Path

import swarmsim  # isort: skip - before jax, whose log it quiets
import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from swarmsim.radiation import net_rate
from swarmsim.results.batch import batch_row
from swarmsim.runtime.progress import RichProgress
from swarmsim.site import crossed

HEIGHT_M = 20.0  # height above the source at which the net rate is stated


@dataclass(frozen=True)
class Figure:
    """A published figure, where it stands in a mission's row, and how close it must be met."""

    name: str
    key: str
    published: str
    low: float
    high: float


# Published: the Gazebo reconnaissance mission; the bounds are this project's acceptance bars.
PAPER = (
    Figure("aerial count rate, least [cps]", "survey_count_rate_min_cps", "67", 61.0, 73.0),
    Figure("aerial count rate, greatest [cps]", "survey_count_rate_max_cps", "245", 233.0, 257.0),
    Figure("aerial measurements", "survey_measurements", "> 10,000", 10_000.0, np.inf),
    Figure("aerial path, total [m]", "survey_path_length_m", "2,100", 1890.0, 2310.0),
    Figure("aerial duration [s]", "survey_duration_s", "308", 261.8, 354.2),
    Figure("ground path [m]", "search_path_length_m", "180", 135.0, 225.0),
    Figure("ground measurements", "search_measurements", "about 200", 150.0, 250.0),
    Figure("ground duration [s]", "search_duration_s", "210", 157.5, 262.5),
    Figure("ground count rate, least [cps]", "search_count_rate_min_cps", "169", -np.inf, np.inf),
    Figure("ground count rate, greatest [cps]", "search_count_rate_max_cps", "3,688", -np.inf, np.inf),
    Figure("real-time factor", "real_time_factor", "0.88", 0.88, np.inf),
)
OWN = (
    Figure("net uncollided rate 20 m above the source [cps]", "net_at_20_m_cps", "34 to 35 (physics)", 34.0, 35.0),
    Figure("source error [m]", "source_error_m", "", 0.0, 1.0),
    Figure("activity error [%]", "source_activity_error_percent", "", 0.0, 15.0),
)


def fly(name: str, seeds: int, overrides: list[str]) -> list[dict[str, object]]:
    """One row for each mission of a scenario, with the batch's real-time factor and the net rate above the source."""
    scenario = swarmsim.load(name, overrides)
    simulation = swarmsim.build(scenario)
    first = scenario.mission.seed
    with RichProgress(missions=seeds) as progress:
        batch = simulation.rollout(range(first, first + seeds), progress=progress)
    factor = batch.simulated_s / batch.clock.run_s
    rate = net_rate_above_source(simulation)
    rows = []
    for index in range(seeds):
        row = batch_row(swarmsim.mission_record(simulation, batch, index))
        rows.append(row | {"real_time_factor": factor, "net_at_20_m_cps": rate})
    return rows


def net_rate_above_source(simulation: swarmsim.Simulation) -> float:
    """Net uncollided rate [cps] of a survey UAV hovering level, 20 m above the first source."""
    world = simulation.world
    counter = world.groups[0].counter
    assert counter is not None  # the survey UAVs carry detectors
    source = jax.tree.map(lambda leaf: leaf[0], world.sources)
    place = source.position_m + jnp.array([0.0, 0.0, HEIGHT_M])
    way = crossed(world.site, source.position_m, place)
    return float(net_rate(counter.detector, source, way, place, counter.mount_axis[0], uncollided=True))


def compare(rows: list[dict[str, object]], figures: tuple[Figure, ...]) -> list[list[str]]:
    """Median, 5th and 95th percentile of each figure, beside the published one and whether the median meets the bar."""
    table = []
    for figure in figures:
        values = np.array([row[figure.key] for row in rows if row.get(figure.key) is not None], float)
        if not len(values):
            table.append([figure.name, figure.published, "none", "", "no"])
            continue
        low, middle, high = np.percentile(values, [5, 50, 95])
        bounded = np.isfinite(figure.low) or np.isfinite(figure.high)
        met = "" if not bounded else "yes" if figure.low <= middle <= figure.high else "no"
        table.append([figure.name, figure.published, f"{middle:.4g}", f"{low:.4g} to {high:.4g}", met])
    return table


def main(arguments: list[str] | None = None) -> int:
    """Fly both scenarios and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/cbrne_recon"), help="folder for the tables")
    parser.add_argument("--seeds", type=int, default=32, help="missions of each scenario (default 32)")
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="override of both scenarios")
    options = parser.parse_args(arguments)
    if options.seeds < 1:
        parser.error("--seeds must be at least 1")
    swarmsim.use_all_cores()
    header = ["figure", "published", "median", "5 % to 95 %", "bar met"]
    lines, flat = [], []
    for name, figures in (("recon_paper", PAPER), ("recon", OWN)):
        rows = fly(name, options.seeds, options.set)
        options.out.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(rows), options.out / f"missions_{name}.parquet")
        table = compare(rows, figures)
        lines += [f"## {name}, {options.seeds} seeds", "", _row(header), _row(["---"] * len(header))]
        lines += [*map(_row, table), ""]
        flat += [[name, *row] for row in table]
    (options.out / "table.md").write_text("\n".join(lines), encoding="utf-8")
    with (options.out / "table.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([["scenario", *header], *flat])
    print("\n".join(lines))
    return 0


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    try:
        sys.exit(main())
    except swarmsim.InputError as error:
        sys.exit("\n".join(str(problem) for problem in error.problems))
