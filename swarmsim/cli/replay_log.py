"""What ``swarmsim replay-log`` does."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from swarmsim.config.errors import InputError, file_errors_told
from swarmsim.results.names import FIGURES, FLIGHT, LOG, RECORDING, SCENARIO
from swarmsim.results.out_folder import READ_LOG, check_folder, check_space, told_of

if TYPE_CHECKING:
    from swarmsim.autopilot.compare import Comparison, Planned, Simulated
    from swarmsim.autopilot.frames import Geodetic
    from swarmsim.autopilot.logs.flight_log import FlightLog
    from swarmsim.site.model import SiteModel

TRACK = "track.parquet"
_MODES = 12  # lines of the table
_FAR_M = 1000.0  # from the mission, which is told


@dataclass(frozen=True)
class _Mission:
    """What a log is compared with."""

    vehicle: str
    site_model: "SiteModel"
    simulated: "Simulated"
    planned: "tuple[Planned, ...]"


def replay_log(
    file: Path, run: Path | None, mission: str | None, vehicle: str | None, seed: int | None,
    overrides: Sequence[str], system: int | None, origin: str | None, out: Path | None, force: bool,
) -> None:  # fmt: skip
    """Read a log, compare it with the mission if one is named, tell the errors and write a folder with all of it."""
    from swarmsim.autopilot.logs.reading import read_log

    console = Console()
    place = None if origin is None else _geodetic(origin)
    folder = out if out is not None else Path("runs") / f"log_{file.stem}"
    with told_of(folder):
        check_folder(folder, force, READ_LOG)
        check_space(folder)
    source = _source(run, mission, vehicle, seed, overrides)
    log = read_log(file, system)
    if place is not None and log.origin is None:
        raise InputError.of(
            "the log does not tell where on the Earth its positions are", path="--origin",
            suggestion="leave --origin out: the tracks are then laid over one another where the flight began",
        )  # fmt: skip
    for note in log.notes:
        console.print(f"note: {escape(note)}", highlight=False, soft_wrap=True)
    log = log if place is None else log.moved_to(place)
    found = None if source is None else _mission(*source, seed, overrides, run, console)
    if found is not None and place is not None:
        _tell_far(log, found, console)
    aligned = "the log's origin" if place is None else f"--origin {origin}"
    if found is not None and place is None:
        log, aligned = _aligned(log, found), "where the flight began"
    _write(file, folder, force, log, found, aligned, console)


def _geodetic(text: str) -> "Geodetic":
    from swarmsim.autopilot.frames import Geodetic

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    latitude, longitude, altitude = numbers if len(numbers) == 3 else (np.nan, np.nan, np.nan)
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and abs(altitude) <= 20_000.0):
        raise InputError.of(
            "this is no place on the Earth", path="--origin", given=text, allowed="LAT,LON,ALT in degrees and metres"
        )
    return Geodetic(latitude, longitude, altitude)


def _source(
    run: Path | None, mission: str | None, vehicle: str | None, seed: int | None, overrides: Sequence[str]
) -> tuple[str, str] | None:
    """Mission file or name, and vehicle, that the log is compared with; None where none is named."""
    if run is not None and mission is not None:
        raise InputError.of("name a run or a mission, not both", path="--run")
    if run is None and mission is None:
        for option, given in (("--vehicle", vehicle), ("--seed", seed), ("--set", overrides or None)):
            if given is not None:
                raise InputError.of("of which mission?", path=option, suggestion="add --mission or --run")
        return None
    if run is not None:
        with file_errors_told("cannot be read", path="--run", given=str(run)):
            whole = (run / SCENARIO).is_file()
        if not whole:
            raise InputError.of(f"is not the folder of a run (no {SCENARIO} in it)", path="--run", given=str(run))
        vehicle = vehicle or _flown_vehicle(run)
        mission = str(run / SCENARIO)
    if vehicle is None:
        raise InputError.of("say which vehicle of the mission the log is of", path="--vehicle")
    return str(mission), vehicle


def _flown_vehicle(run: Path) -> str | None:
    """The vehicle that was flown outside in a run."""
    try:
        name = json.loads((run / FLIGHT).read_text(encoding="utf-8"))["vehicle"]
        if not isinstance(name, str):
            raise TypeError(name)
        return name
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError.of("is damaged", file=run / FLIGHT, suggestion="name the vehicle with --vehicle") from error


def _flew(run: Path, vehicle: str, console: Console) -> bool:
    """Whether the run tells that it is this vehicle's; where it cannot tell, a note, and the mission is flown anew."""
    try:
        return vehicle == _flown_vehicle(run)
    except InputError:
        console.print(f"note: {FLIGHT} of the run is damaged: the mission is simulated anew", highlight=False)
        return False


def _mission(
    name: str, vehicle: str, seed: int | None, overrides: Sequence[str], run: Path | None, console: Console
) -> _Mission:
    from swarmsim.autopilot.simulated_track import has_simulated, read_simulated, simulate_vehicle
    from swarmsim.config.scenario import load_scenario
    from swarmsim.runtime.devices import use_all_cores
    from swarmsim.runtime.run import build

    scenario = load_scenario(name, overrides, seed)
    names = [member.name for member in scenario.members]
    if vehicle not in names:
        raise InputError.of(
            "the mission has no such vehicle", path="--vehicle", given=vehicle, allowed=", ".join(names)
        )
    use_all_cores()
    simulation = build(scenario)
    if run is not None and not overrides and seed is None and has_simulated(run) and _flew(run, vehicle, console):
        simulated, planned = read_simulated(run)
    else:
        with console.status("fly the mission in simulation"):
            simulated, planned = simulate_vehicle(simulation, vehicle)
    return _Mission(vehicle, simulation.site_model, simulated, planned)


def _tell_far(log: "FlightLog", mission: _Mission, console: Console) -> None:
    """A note where the flight with its given origin lies elsewhere than the mission."""
    apart = log.position_m[0] - mission.simulated.track.position_m[0]
    far = float(np.hypot(apart[0], apart[1]))
    if far > _FAR_M:
        console.print(
            f"note: the flight begins {far / 1e3:,.1f} km from the vehicle's start in the mission: is --origin right "
            "(latitude, longitude, altitude of the site's origin)?", highlight=False, soft_wrap=True,
        )  # fmt: skip


def _aligned(log: "FlightLog", mission: _Mission) -> "FlightLog":
    """The log with the place where it was armed, or else where its flight began, laid on its start in the mission."""
    began_s = log.spans_s()[0][0]
    began_s = max((c.time_s for c in log.armed if c.name == "armed" and c.time_s <= began_s), default=began_s)
    began = int(np.searchsorted(log.time_s, began_s))
    start = log.position_m[min(began, len(log.time_s) - 1)]
    return log.shifted(mission.simulated.track.position_m[0] - start)


def _write(
    file: Path, folder: Path, force: bool, log: "FlightLog", mission: _Mission | None, aligned: str, console: Console
) -> None:
    import pyarrow.parquet as pq

    from swarmsim.atomic_folder import atomic_folder
    from swarmsim.autopilot.compare import Track, compare
    from swarmsim.autopilot.logs.tables import report, track_table
    from swarmsim.playback.flown_figure import write_figure
    from swarmsim.playback.overlay import Overlay
    from swarmsim.playback.recording import write_track_recording

    flown, spans = Track(log.time_s, log.position_m), log.spans_s()
    made = compare(flown, mission.planned, mission.simulated, spans) if mission else compare(flown, spans_s=spans)
    overlay = Overlay(
        vehicle=mission.vehicle if mission else f"{log.autopilot} {log.vehicle}",
        flown=flown,
        judged=flown.within(spans),
        comparison=made,
        planned=mission.planned if mission else (),
        simulated=mission.simulated if mission else None,
        marks=tuple(sorted((c.time_s, c.name) for c in (*log.modes, *log.armed, *log.messages))),
    )
    site_model = mission.site_model if mission else None
    summary = {"file": file.name} | report(log) | {"aligned": aligned}
    summary |= {"vehicle_of_mission": mission.vehicle, "comparison": made.report()} if mission else {}
    told = file_errors_told("the results cannot be written there", path="--out", given=str(folder))
    with told, atomic_folder(folder, lambda target: check_folder(target, force, READ_LOG)) as new:
        origin = "the log's origin" if mission is None else f"the mission's origin, laid over it by {aligned}"
        pq.write_table(track_table(log, origin), new / TRACK, compression="zstd")
        (new / LOG).write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        write_track_recording(overlay, site_model, new / RECORDING)
        write_figure(overlay, site_model, new / FIGURES)
    _print(log, made if mission else None, console)
    console.print(f"Results: {folder}", highlight=False, soft_wrap=True)


def _print(log: "FlightLog", made: "Comparison | None", console: Console) -> None:
    table = Table("flight", "value", title_justify="left")
    who = f"{log.autopilot} {log.vehicle}" + ("" if log.system is None else f", system {log.system}")
    table.add_row("Vehicle", escape(who))
    table.add_row("Log", f"{log.time_s[-1]:.1f} s, {len(log.time_s):,} positions")
    table.add_row("Judged", ", ".join(f"{a:.1f} s to {b:.1f} s" for a, b in log.spans_s()[:_MODES]))
    modes = [f"{change.time_s:.1f} s {change.name}" for change in log.modes]
    table.add_row("Modes", escape("\n".join(modes[:_MODES] + ["…"] * (len(modes) > _MODES))))
    low, high = log.position_m.min(axis=0), log.position_m.max(axis=0)
    table.add_row("Extent", " x ".join(f"{v:.1f} m" for v in high - low))
    console.print(table)
    if made is not None:
        print_comparison(made.report(), console)


def print_comparison(summary: dict[str, Any], console: Console) -> None:
    """Print the errors of a comparison, as `Comparison.report` sums them up."""
    shift = summary["time_shift_s"]
    title = "errors in m" + ("" if shift is None else f", simulated times shifted by {shift:.2f} s")
    table = Table("error", "where", "rms", "95 %", "greatest", title=title, title_justify="left")
    for name, label in (
        ("cross_track", "Horizontal, from the planned path"),
        ("synchronised", "Horizontal, from the simulated vehicle at the same time"),
        ("from_simulated_track", "Horizontal, from the simulated track"),
        ("above_simulated", "Vertical, from the simulated vehicle at the same time"),
    ):
        for key, where in (("whole", "all"), ("on_lines", "on the lines")):
            told = summary[key][name]
            if told is not None:
                table.add_row(label, where, *(f"{told[each]:.2f}" for each in ("rms_m", "p95_m", "max_m")))
    if table.row_count:
        console.print(table)
    else:
        console.print(
            "nothing of the flight can be compared with the mission: see 'Judged', and whether positions are rare",
            highlight=False,
        )
