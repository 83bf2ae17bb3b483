"""What ``swarmsim sitl`` does."""

import os
import shutil
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from swarmsim.config.errors import InputError

if TYPE_CHECKING:
    from swarmsim.config.scenario import Scenario
    from swarmsim.sitl.link import FirmwareLink
    from swarmsim.sitl.lockstep import Lockstep
    from swarmsim.sitl.settings import SitlSettings

EXIT_FIRMWARE = 4


def run_sitl(
    name: str, autopilot: str, names: Sequence[str], count: int | None, speed: float, duration_s: float,
    start: str | None, seed: int | None, overrides: Sequence[str], out: Path | None, force: bool,
) -> int:  # fmt: skip
    """Fly vehicles of a mission by firmware in our physics, until Ctrl-C or the duration; the exit code."""
    from swarmsim.config.scenario import load_scenario
    from swarmsim.sitl.link import FirmwareError
    from swarmsim.sitl.settings import load_sitl_settings

    settings = load_sitl_settings(autopilot)
    whole = load_scenario(name, overrides, seed)
    numbers = _chosen(whole, names, count)
    folder = out if out is not None else Path("runs") / f"{whole.mission.name}_sitl"
    _make(folder, force)
    try:
        return _run(whole, numbers, settings, speed, duration_s, start, folder, Console())
    except FirmwareError as error:
        sys.stderr.write(f"{error}\n")
        return EXIT_FIRMWARE


def _chosen(whole: "Scenario", names: Sequence[str], count: int | None) -> list[int]:
    """Numbers of the vehicles in the team."""
    known = [member.name for member in whole.members]
    for name in names:
        if name not in known:
            raise InputError.of(
                "the mission has no such vehicle", path="--vehicle", given=name, allowed=", ".join(known)
            )
    if names and count is not None:
        raise InputError.of("give either --vehicle or --vehicles", given=f"both {', '.join(names)} and {count}")
    if names:
        return [known.index(name) for name in dict.fromkeys(names)]
    if count is not None and count > len(known):
        raise InputError.of(
            "the mission has fewer vehicles", path="--vehicles", given=str(count), allowed=str(len(known))
        )
    return list(range(1 if count is None else count))


def _run(
    whole: "Scenario", numbers: Sequence[int], settings: "SitlSettings", speed: float, duration_s: float,
    start: str | None, folder: Path, console: Console,
) -> int:  # fmt: skip
    from swarmsim.atomic_folder import claimed
    from swarmsim.autopilot.frames import Geodetic
    from swarmsim.config.bare import bare_scenario
    from swarmsim.config.sensors import Place
    from swarmsim.runtime.devices import use_all_cores
    from swarmsim.sitl.firmware import STARTS, Firmware, check_all
    from swarmsim.sitl.link import FirmwareError, seat_of
    from swarmsim.sitl.lockstep import Lockstep
    from swarmsim.sitl.opening import open_link
    from swarmsim.sitl.plant import Plant
    from swarmsim.sitl.report import summary_of, write

    scenario = bare_scenario(whole, numbers, "sitl", settings.timing)
    place = whole.mission.autopilot.origin or settings.origin
    origin = Geodetic(**place.model_dump())
    seats = [
        seat_of(member.name, k, vehicle, settings, origin)
        for k, (member, vehicle) in enumerate(zip(scenario.members, scenario.vehicles, strict=True))
    ]
    command = start if start is not None else os.environ.get(STARTS[settings.autopilot])
    with claimed(folder), ExitStack() as stack:
        links = []
        for seat in seats:
            links.append(open_link(seat, settings))
            stack.callback(links[-1].close)
        use_all_cores()
        with console.status("load or compile the physics"):
            plant = Plant(scenario, Place(altitude_m=place.altitude_m), settings.sensors, whole.mission.seed)
        lockstep = Lockstep(plant, links, settings, speed)
        _introduce(links, settings, command, console)
        processes = []
        for seat, vehicle in zip(seats, scenario.vehicles, strict=True):
            if command:
                one = Firmware(command, settings.autopilot, seat, vehicle, (folder / seat.name).absolute())
                processes.append(one)
                stack.callback(one.stop)
        try:
            lockstep.connect(lambda: check_all(processes))
            console.print("all connected")
            lockstep.run(lockstep.time_s + duration_s, lambda: _tell(lockstep, console))
        except FirmwareError:
            check_all(processes)  # one that ended tells more than its silence
            raise
        finally:
            if lockstep.began_s is not None:
                summary = summary_of(lockstep, settings.autopilot, scenario.mission.engine)
                write(folder, lockstep, summary)
                _tell(lockstep, console)
                console.print(f"Results: {folder}", highlight=False, soft_wrap=True)
    return 0


def _make(folder: Path, force: bool) -> None:
    """Make the folder; with ``force`` an earlier session's is emptied. Raises `InputError`."""
    from swarmsim.config.errors import file_errors_told

    with file_errors_told("the folder of the results cannot be used", file=folder):
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            if not force or not _is_session(folder):
                raise InputError.of(
                    "there is something already", path="--out", given=str(folder),
                    suggestion="choose another folder, or --force to replace an earlier session",
                )  # fmt: skip
            shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)


def _is_session(folder: Path) -> bool:
    """Whether a folder is an earlier session's: with its report, or broken off before there was one."""
    from swarmsim.sitl.firmware import PRINTED
    from swarmsim.sitl.report import REPORT

    return folder.is_dir() and (
        (folder / REPORT).is_file() or all((inside / PRINTED).is_file() for inside in folder.iterdir())
    )


def _introduce(
    links: "Sequence[FirmwareLink]", settings: "SitlSettings", command: str | None, console: Console
) -> None:
    table = Table("vehicle", "physics at", "fly it with", title_justify="left")
    for link in links:
        table.add_row(escape(link.seat.name), link.address, f"--link {settings.link_of(link.seat.number)}")
    console.print(table)
    if not command:
        console.print("waiting for the firmware of each vehicle; Ctrl-C ends", highlight=False)


def _tell(lockstep: "Lockstep", console: Console) -> None:
    stalls, missed = (sum(getattr(w, kind) for w in lockstep.waits) for kind in ("stalls", "missed"))
    longest = max(w.longest_s for w in lockstep.waits)
    console.print(
        f"{lockstep.time_s:8.1f} s  {lockstep.factor:5.2f} x real time, {stalls} stalls, {missed} missed answers, "
        f"longest wait {1e3 * longest:.0f} ms",
        highlight=False,
    )
    truth = lockstep.plant.truth
    for link, place, intact in zip(lockstep.links, truth.position_m, truth.intact, strict=True):
        where = ", ".join(f"{x:.1f}" for x in place)
        told = "" if intact else ", crashed"
        told += f", its firmware has begun anew {link.restarts} times" if link.restarts else ""
        console.print(f"            {escape(link.seat.name)} at ({where}) m{told}", highlight=False)
