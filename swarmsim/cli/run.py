"""What ``swarmsim run`` does."""

import json
import shlex
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from swarmsim.config.errors import InputError
from swarmsim.results.names import RECORDING, SUMMARY

VEHICLES_SHOWN, EVENTS_SHOWN = 12, 12  # a larger team is summed up; later events stand in the summary's file

_PHASE_ROWS = (
    ("duration", "duration_s", "s"),
    ("path, all vehicles", "path_length_m", "m"),
    ("measurements", "measurements", ""),
    ("count rate, least", "count_rate_min_cps", "cps"),
    ("count rate, greatest", "count_rate_max_cps", "cps"),
)
_FOUND_ROWS = (
    ("Hotspot", "hotspot.position_m", "m"),
    ("Hotspot error", "hotspot.error_m", "m"),
    ("Source", "source.position_m", "m"),
    ("Source, standard deviation", "source.position_std_m", "m"),
    ("Source error", "source.error_m", "m"),
    ("Activity", "source.activity_mbq", "MBq"),
    ("Activity, standard deviation", "source.activity_std_mbq", "MBq"),
    ("Activity error", "source.activity_error_percent", "%"),
    ("Dose rate 1 m from the source", "source.dose_rate_1m_usv_h", "uSv/h"),
    ("Dose rate, standard deviation", "source.dose_rate_1m_std_usv_h", "uSv/h"),
    ("Greatest dose rate, by counts", "dose_rate.greatest_usv_h", "uSv/h"),
    ("Nuclide", "nuclide.name", ""),
    ("Confidence", "nuclide.confidence", ""),
)
_TIME_ROWS = (
    ("Real-time factor", "real_time_factor", ""),
    ("Compilation", "timing.compile_s", "s"),
    ("Rollout", "timing.run_s", "s"),
    ("Writing", "timing.write_s", "s"),
)


def run_scenario(
    name: str, out: Path | None, seed: int | None, missions: int, overrides: Sequence[str], force: bool
) -> bool:
    """Fly ``missions`` missions of the scenario and print their summary; nothing is written when the input is wrong.

    Returns whether every mission has an answer that it stands behind (`swarmsim.results.status.CERTAIN`).
    """
    from swarmsim.config.scenario import load_scenario

    scenario = load_scenario(name, overrides, seed)
    last_seed = scenario.mission.seed + missions - 1
    if last_seed >= 2**31:
        raise InputError.of(
            "the seeds of the batch grow too large", given=f"the last is {last_seed}", allowed="less than 2147483648"
        )
    for sentence in scenario.changes():
        sys.stderr.write(f"warning: {sentence}\n")
    folder = out if out is not None else Path("runs") / scenario.mission.name

    from swarmsim.results.out_folder import check_out

    check_out(folder, force)

    from swarmsim.runtime.devices import use_all_cores
    from swarmsim.runtime.progress import RichProgress
    from swarmsim.runtime.run import run

    use_all_cores()

    with RichProgress(Console(stderr=True), missions) as progress:
        run(scenario, folder, missions, progress, force=force)
    console = Console()
    summary = read_summary(folder)
    if missions > 1:
        console.print(*batch_tables(summary, scenario.mission.name))
    else:
        console.print(summary_table(summary, scenario.mission.name))
    console.print(f"Results: {folder}", highlight=False, soft_wrap=True)
    if (folder / RECORDING).is_file():
        console.print(f"Watch:   swarmsim view {shlex.quote(str(folder))}", highlight=False, soft_wrap=True)
    from swarmsim.results.status import CERTAIN

    statuses = summary.get("statuses", {summary.get("status"): 1})
    return all(status in CERTAIN for status in statuses)


def bench_scenario(name: str, missions: int, repeats: int, overrides: Sequence[str]) -> None:
    """Print the speed of one mission and of a batch, and their ratio."""
    from swarmsim.config.scenario import load_scenario
    from swarmsim.runtime.benchmark import measure
    from swarmsim.runtime.devices import use_all_cores
    from swarmsim.runtime.progress import RichProgress
    from swarmsim.runtime.run import build

    use_all_cores()
    simulation = build(load_scenario(name, overrides))
    with RichProgress(Console(stderr=True)) as progress:
        alone = measure(simulation, 1, repeats, progress)
    with RichProgress(Console(stderr=True), missions) as progress:
        together = measure(simulation, missions, repeats, progress)
    table = Table("what", "one mission", f"{missions} missions", title=name, title_justify="left")
    for column in table.columns[1:]:
        column.justify = "right"
    for program in dict.fromkeys((*together.programs_s, *alone.programs_s)):
        times = (speed.programs_s.get(program) for speed in (alone, together))
        table.add_row(escape(f"{program} [s]"), *("" if time is None else f"{time:.3f}" for time in times))
    for label, one, all_ in (
        ("simulated [s]", alone.simulated_s, together.simulated_s),
        ("rollout [s]", alone.run_s, together.run_s),
        ("compilation [s]", alone.compile_s, together.compile_s),
        ("real-time factor", alone.real_time_factor, together.real_time_factor),
        ("throughput against one at a time", 1.0, together.real_time_factor / alone.real_time_factor),
    ):
        table.add_row(escape(label), f"{one:,.2f}", f"{all_:,.2f}")
    Console().print(table)


def bench_fleet(name: str, vehicles: int, repeats: int, overrides: Sequence[str]) -> None:
    """Print how fast a fleet of the mission's first type of UAV flies, by the layout of vehicles in memory."""
    from swarmsim.config.scenario import load_scenario
    from swarmsim.config.vehicles import Multirotor
    from swarmsim.runtime.fleet import TICKS, measure_fleet
    from swarmsim.scalars import LAYOUTS

    scenario = load_scenario(name, overrides)
    spec = next((spec for spec in scenario.vehicles if isinstance(spec, Multirotor)), None)
    if spec is None:
        raise InputError.of("has no UAV, of which a fleet could be made", path="vehicles", given=name)
    engine = scenario.mission.engine
    title = f"{vehicles:,} x {spec.name}, engine {engine}"
    table = Table("parameters", "layout", "steps/s", "compilation [s]", "apart [m]", title=title, title_justify="left")
    for column in table.columns[2:]:
        column.justify = "right"
    for own in (True, False):
        for layout in LAYOUTS:
            speed = measure_fleet(spec, engine, vehicles, layout, own_parameters=own, ticks=TICKS, repeats=repeats)
            table.add_row(
                "each its own" if own else "shared", layout, f"{speed.steps_per_s:,.0f}", f"{speed.compile_s:.1f}",
                f"{speed.apart_m:.1e}",
            )  # fmt: skip
    Console().print(table)


def read_summary(folder: Path) -> dict[str, Any]:
    """The content of a run's summary."""
    summary: dict[str, Any] = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    return summary


def batch_tables(summary: dict[str, Any], name: str) -> tuple[Table, Table]:
    """What a batch came to, and its numbers: a row for each, over the missions that have it."""
    facts = Table("what", "value", title=f"{name}, {summary['missions']} missions", title_justify="left")
    numbers = Table("number", "median", "least", "greatest", "missions")
    for column in (facts.columns[1], *numbers.columns[1:]):
        column.justify = "right"
    for path, number in _leaves({key: summary[key] for key in summary if key not in ("metrics", "versions")}, ""):
        facts.add_row(escape(path), value_text(number))
    for key, row in summary["metrics"].items():
        numbers.add_row(escape(key), *(value_text(row[of]) for of in ("median", "min", "max", "found")))
    return facts, numbers


def summary_table(summary: dict[str, Any], name: str) -> Table:
    """The known rows of one mission's summary."""
    table = Table("what", "value", "unit", title=name, title_justify="left")
    table.columns[1].justify = "right"
    table.add_row("Status", summary["status"].replace("_", " "))
    table.add_row("Finding", summary["finding"])
    for warning in summary["warnings"]:
        table.add_row("Warning", warning)
    for phase, content in summary["phases"].items():
        table.add_section()
        _add_rows(table, content, _PHASE_ROWS, f"{phase}: ")
        if not content["in_time"]:
            table.add_row(f"{phase}: ended", "by its time limit")
    table.add_section()
    _add_rows(table, summary, _FOUND_ROWS)
    if summary.get("source"):  # without one, the finding tells them
        _add_limits(table, summary.get("noticed_mbq", {}))
    table.add_section()
    _add_rows(table, summary, _TIME_ROWS)
    table.add_section()
    _add_vehicles(table, summary["vehicles"])
    events = [event for event in summary["events"] if event["kind"] != "finished"]
    for event in events[:EVENTS_SHOWN]:
        table.add_row(f"{event['vehicle']} at {event['time_s']:.0f} s", f"{event['kind']}: {event['detail']}", "")
    if len(events) > EVENTS_SHOWN:
        table.add_row(f"{len(events) - EVENTS_SHOWN} more events", f"in {SUMMARY}", "")
    return table


def _add_rows(table: Table, content: dict[str, Any], rows: Sequence[tuple[str, str, str]], prefix: str = "") -> None:
    """The rows (label, path, unit) whose values ``content`` has."""
    for label, path, unit in rows:
        value: Any = content
        for step in path.split("."):
            value = value.get(step) if isinstance(value, dict) else None
        if value is not None:
            table.add_row(prefix + label, value_text(value), unit)


def _add_limits(table: Table, noticed_mbq: dict[str, float | None]) -> None:
    """From which activities on other sources would have been noticed, if that is known."""
    from swarmsim.results.finding import noticed_from

    if noticed_mbq:
        limits = noticed_from(noticed_mbq)
        table.add_row("Others, in free view", f"noticed from {limits}" if limits else "not noticed", "")


def _add_vehicles(table: Table, vehicles: Sequence[dict[str, Any]]) -> None:
    """State and energy of each vehicle; of a large team, how many are in each state and the energy of all."""
    if len(vehicles) > VEHICLES_SHOWN:
        for state, count in Counter(vehicle["state"] for vehicle in vehicles).most_common():
            table.add_row(f"Vehicles {state}", value_text(count), "")
        table.add_row("Energy, all vehicles", value_text(float(sum(v["energy_wh"] for v in vehicles))), "Wh")
        return
    for vehicle in vehicles:
        table.add_row(f"Vehicle {vehicle['name']}", f"{vehicle['state']}, {value_text(vehicle['energy_wh'])}", "Wh")


def _leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, f"{path}.{key}" if path else key)
    elif not isinstance(value, list) or len(value) <= 4:
        yield path, value


def value_text(value: Any) -> str:
    """A value as it stands in a table: four digits, thousands apart."""
    if isinstance(value, list):
        if not value:
            return "none"
        return "[" + ", ".join(map(value_text, value)) + "]"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
