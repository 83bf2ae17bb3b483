"""What ``swarmsim fly`` does."""

import gc
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from swarmsim.config.errors import InputError

if TYPE_CHECKING:
    from swarmsim.autopilot.guard import Guard
    from swarmsim.autopilot.link import VehicleLink
    from swarmsim.autopilot.manual.status import StatusLine
    from swarmsim.autopilot.manual.sticks import Source
    from swarmsim.autopilot.under_way import Mark
    from swarmsim.config.autopilot import Autopilot
    from swarmsim.config.scenario import Scenario
    from swarmsim.runtime.live import LiveMission
    from swarmsim.runtime.simulation import Simulation

EXIT_FLIGHT = 4  # the vehicle or the link did not do what the flight needed
SWITCH_S = 0.0005  # Python's threads take turns this often: the stream must not wait for the mission
ROWS = 30  # of the table of a dry run


def fly_mission(
    name: str,
    vehicle: str,
    link: str,
    profile: str,
    system: int | None,
    seed: int | None,
    overrides: Sequence[str],
    out: Path | None,
    force: bool,
    signing_key: Path | None,
    recover: str | None,
    dry_run: bool,
    watch: bool = False,
    watch_url: str | None = None,
    manual: str | None = None,
) -> int:
    """Fly a vehicle of the mission on a real or a simulated autopilot, or tell what would be sent; the exit code.

    ``watch`` shows the flight in a viewer on this desktop, ``watch_url`` in one that runs there; a pilot may take the
    vehicle over with ``manual``.
    """
    from swarmsim.autopilot.link import LinkError
    from swarmsim.autopilot.under_way import Mark
    from swarmsim.config.scenario import load_scenario
    from swarmsim.results.out_folder import check_out

    scenario = load_scenario(name, overrides, seed)
    names = [member.name for member in scenario.members]
    if vehicle not in names:
        raise InputError.of(
            "the mission has no such vehicle", path="--vehicle", given=vehicle, allowed=", ".join(names)
        )
    if not dry_run:
        from swarmsim.autopilot.opening import parse

        parse(link)  # a wrong one is told before anything is compiled
    if manual is not None and (dry_run or recover is not None):
        raise InputError.of("nobody flies in a dry run or to recover a vehicle: leave out --manual", path="--manual")
    console = Console()
    if dry_run:
        return _rehearsed(scenario, vehicle, console)
    folder = out if out is not None else Path("runs") / f"{scenario.mission.name}_{vehicle}"
    mark = Mark(folder, vehicle, link)
    if recover is not None:
        return _recovered(link, profile, system, signing_key, recover, scenario, mark, console)
    try:
        mark.refuse()
    except LinkError as error:
        return _failed(error)
    check_out(folder, force)
    viewer = None
    if watch or watch_url is not None:
        from swarmsim.playback.viewer import live_address

        viewer = live_address(watch_url)
    with _device(manual, scenario) as pilot:
        return _flown(
            scenario, vehicle, link, profile, system, signing_key, folder, force, viewer, console, pilot, mark
        )


def _device(manual: str | None, scenario: "Scenario") -> "AbstractContextManager[Source | None]":
    """What the pilot flies with: the keyboard, a gamepad, or nothing."""
    from swarmsim.autopilot.manual.gamepad import Gamepad
    from swarmsim.autopilot.manual.keyboard import Keyboard

    if manual is None:
        return nullcontext()
    kinds: dict[str, Callable[[Any], AbstractContextManager[Source | None]]] = {
        "keyboard": Keyboard,
        "gamepad": Gamepad,
    }
    return kinds[manual](scenario.mission.autopilot.manual)


def _recovered(
    link: str, profile: str, system: int | None, key: Path | None, how: str, scenario: "Scenario", mark: "Mark",
    console: Console,
) -> int:  # fmt: skip
    """Have a vehicle that is under way land or return, whoever left it there."""
    from swarmsim.autopilot.link import LinkError
    from swarmsim.autopilot.opening import open_vehicle
    from swarmsim.autopilot.under_way import recover

    try:
        vehicle = open_vehicle(link, profile=profile, system=system, key_file=key)
        try:
            recover(vehicle, how, scenario.mission.autopilot, partial(console.print, highlight=False))
            mark.clear()
        finally:
            vehicle.close()
    except LinkError as error:
        return _failed(error)
    return 0


def _built(scenario: "Scenario", vehicle: str) -> "tuple[Simulation, LiveMission]":
    from swarmsim.runtime.devices import use_all_cores
    from swarmsim.runtime.live import LiveMission
    from swarmsim.runtime.run import build

    use_all_cores()
    simulation = build(scenario)
    live = LiveMission(simulation, scenario.mission.seed, vehicle)
    if not live.has_part:
        raise InputError.of("the vehicle has no part in the mission: no phase names it under 'who'", given=vehicle)
    return simulation, live


def _prepared(live: "LiveMission", console: Console) -> None:
    with console.status("load or compile the mission's programs"):
        live.prepare()


def _flies(live: "LiveMission") -> bool:
    from swarmsim.world.kinds import KINDS

    return bool(KINDS[live.kind].FLIES)


def _guard(simulation: "Simulation", live: "LiveMission", scenario: "Scenario") -> "Guard":
    from swarmsim.autopilot.guard import Guard, outline_of

    return Guard(
        limits=scenario.mission.autopilot.limits,
        outline_m=outline_of(simulation.site_model.site),
        ground_m=float(live.body().position_m[2]),
        flies=_flies(live),
    )


def _rehearsed(scenario: "Scenario", vehicle: str, console: Console) -> int:
    """Print the setpoints that a flight would send, as a table and on a map."""
    from swarmsim.autopilot.link import LinkError
    from swarmsim.autopilot.rehearsal import cells, drawn, picked, rehearse

    simulation, live = _built(scenario, vehicle)
    _prepared(live, console)
    guard = _guard(simulation, live, scenario)
    limit = float(sum(phase.time_limit_s for phase in scenario.mission.phases))
    try:
        rows = rehearse(live, guard, limit)
    except LinkError as error:
        return _failed(error)
    columns = ("time s", "position ENU m", "velocity ENU m/s", "position NED m", "heading deg", "refused")
    table = Table(title=f"{vehicle}: setpoints that would be sent", title_justify="left")
    for column in columns:
        table.add_column(column, no_wrap=column != "refused")
    for row in picked(rows, ROWS):
        table.add_row(*map(escape, cells(row)))
    console.print(table)
    console.print(drawn(rows, guard.outline_m), markup=False, highlight=False)
    refused = sum(bool(row.refused) for row in rows)
    console.print(f"{len(rows)} setpoints, {refused} refused by autopilot.limits; nothing was sent", highlight=False)
    return 0 if rows and not refused else EXIT_FLIGHT


def _flown(
    scenario: "Scenario", name: str, link: str, profile: str, system: int | None, key: Path | None, folder: Path,
    force: bool, viewer: str | None, console: Console, pilot: "Source | None", mark: "Mark",
) -> int:  # fmt: skip
    from swarmsim.atomic_folder import claimed
    from swarmsim.autopilot.flight import Flight
    from swarmsim.autopilot.guard import outline_of
    from swarmsim.autopilot.link import LinkError
    from swarmsim.autopilot.manual.status import StatusLine
    from swarmsim.autopilot.opening import log_suffix, open_vehicle
    from swarmsim.autopilot.state import ARMS
    from swarmsim.playback.live import LiveView

    simulation, live = _built(scenario, name)
    sys.setswitchinterval(SWITCH_S)
    folder.parent.mkdir(parents=True, exist_ok=True)
    log = _free(folder.parent / f"{folder.name}{log_suffix(link)}")  # whatever happens, what was said stays

    flight: Flight | None = None
    screen = StatusLine(sys.stdout, lambda: "" if flight is None or flight.helm is None else flight.helm.line())

    def tell(text: str) -> None:
        if text == ARMS:
            mark.set()
        screen.tell(text)

    with claimed(folder):
        try:
            vehicle = open_vehicle(
                link, profile=profile, system=system, log=log, key_file=key, simulated=(scenario, name)
            )
        except LinkError as error:
            return _failed(error)
        stopped: BaseException | None = None
        view: LiveView | None = None
        code = EXIT_FLIGHT
        try:
            settings = _settings_for(vehicle, live, scenario, name, screen)
            _prepared(live, console)
            outline = outline_of(simulation.site_model.site)
            if viewer is not None:
                view = LiveView(simulation, live, name, viewer)
            observer = None if view is None else view.observe
            flight = Flight(vehicle, live, settings, outline, _flies(live), tell, observer, pilot)
            vehicle.on_mode(flight.on_telemetry)
            # a collection of the garbage among all that was compiled would stop the stream for half a second
            gc.collect()
            gc.freeze()
            gc.disable()
            code, stopped = _outcome(flight, screen)
        except LinkError as error:
            _failed(error)
        finally:
            gc.enable()
            gc.unfreeze()
            vehicle.close()
            mark.clear()
            if view is not None:
                view.close()
        if flight is not None and flight.log.rows:
            _write(simulation, live, flight, vehicle, name, folder, log, force, console)
    if stopped is not None:
        raise stopped
    return code


def _settings_for(
    vehicle: "VehicleLink", live: "LiveMission", scenario: "Scenario", name: str, screen: "StatusLine"
) -> "Autopilot":
    """How the vehicle on the link is flown. Raises where it is of another kind than the mission's, or under way."""
    from swarmsim.autopilot.under_way import refuse_under_way

    known, flies = vehicle.identity, _flies(live)
    screen.tell(f"{known.autopilot} {known.vehicle} {known.version}, system {known.system}")
    if (known.vehicle == "rover") == flies:
        raise InputError.of(
            "the vehicle of the mission and that on the link are of different kinds",
            given=f"{name} {'flies' if flies else 'drives'}, the link has a {known.vehicle}",
        )
    refuse_under_way(vehicle)
    settings = scenario.mission.autopilot
    # a simulated vehicle has no receiver: it stands where the mission has it
    return settings.model_copy(update={"origin": None}) if known.autopilot == "sim" else settings


def _free(log: Path) -> Path:
    """This file, or one beside it with a number where there is one already: of an earlier flight, or somebody's."""
    path, number = log, 1
    while path.exists():
        number += 1
        path = log.with_name(f"{log.stem}-{number}{log.suffix}")
    return path


def _outcome(flight: Any, screen: "StatusLine") -> tuple[int, BaseException | None]:
    """The exit code of a flight, and what stopped it: to be raised when its results are written."""
    from swarmsim.autopilot.link import LinkError

    try:
        with screen:
            flight.fly()
    except LinkError as error:
        flight.log.event(str(error))
        flight.log.ended = flight.log.ended or str(error)
        return _failed(error), None
    except KeyboardInterrupt as stop:
        flight.log.ended = flight.log.ended or "stopped by the user"
        return 0, stop
    except Exception as error:
        flight.log.ended = flight.log.ended or f"an error of the program: {error!r}"
        return EXIT_FLIGHT, error
    return EXIT_FLIGHT if flight.control.alarm is not None else 0, None


def _write(
    simulation: "Simulation", live: "LiveMission", flight: Any, vehicle: "VehicleLink", name: str, folder: Path,
    log: Path, force: bool, console: Console,
) -> None:  # fmt: skip
    from swarmsim.atomic_folder import atomic_folder
    from swarmsim.autopilot import flown
    from swarmsim.autopilot.flown_overlay import write_overlay
    from swarmsim.autopilot.link import LinkError
    from swarmsim.cli.replay_log import print_comparison
    from swarmsim.results.extract import mission_record
    from swarmsim.results.names import FLIGHT_LOG
    from swarmsim.results.out_folder import check_out
    from swarmsim.results.run_directory import write_run
    from swarmsim.runtime.run import timings_of

    summary = flown.report(
        flight.log, flight.control.stream.gaps_s(), vehicle.identity, name, flight.control.takeover_s
    )
    record, written = None, False
    try:
        with console.status("estimate and write"):
            batch = live.result()
            if batch.segments:
                record = mission_record(simulation, batch, 0)
                write_run(simulation, (record,), folder, timings_of(batch), force=force)
                written = True
    finally:  # what was flown stays, whatever becomes of the estimate
        if not written and folder.is_dir() and any(folder.iterdir()):  # nothing of an earlier run stays beside it
            with atomic_folder(folder, partial(check_out, force=force)):
                pass
        folder.mkdir(parents=True, exist_ok=True)
        flown.write(folder, flight.log, summary)
        if log.exists():  # a simulated vehicle has none
            log.replace(folder / f"{FLIGHT_LOG}{log.suffix}")
    _print_summary(summary, console.print)
    if record is not None:
        try:
            with console.status("compare with the simulation"):
                summary["comparison"] = write_overlay(folder, simulation, live, record, name, flight.log)
        except LinkError as error:
            console.print(f"not compared with the simulation: {escape(str(error))}", highlight=False)
        else:
            flown.write(folder, flight.log, summary)
            print_comparison(summary["comparison"], console)
    console.print(f"Results: {folder}", highlight=False, soft_wrap=True)


def _print_summary(summary: dict[str, Any], print_: Callable[..., None]) -> None:
    table = Table("flight", "value", title_justify="left")
    table.add_row("Ended", escape(summary["ended"]))
    stream, track = summary["stream"], summary["cross_track"]
    table.add_row("Setpoints sent", f"{stream['setpoints']:,}")
    for label, value, unit in (
        ("Gap between setpoints, 99.9th percentile", stream["gap_p99.9_s"], "s"),
        ("Gap between setpoints, greatest", stream["gap_max_s"], "s"),
        ("Horizontal error on the lines, rms", track["rms_m"], "m"),
        ("Horizontal error on the lines, greatest", track["max_m"], "m"),
        ("Takeover seen to last setpoint", summary["takeover_to_silence_s"], "s"),
    ):
        if value is not None:
            table.add_row(label, f"{value:.3f} {unit}")
    print_(table)


def _failed(error: Exception) -> int:
    sys.stderr.write(f"{error}\n")
    return EXIT_FLIGHT
