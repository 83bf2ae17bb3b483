"""A vehicle that is under way without a flight of ours: it is refused, or brought down (``--recover``)."""

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from swarmsim.autopilot.control import MODES, POLL_S, RESTS_M_S, RESTS_S
from swarmsim.autopilot.link import LinkError, Mode, VehicleLink
from swarmsim.config.autopilot import Autopilot


class Mark:
    """A file beside the folder of a flight's results, there from arming until the program has seen the flight's end.

    It outlives a program that is killed, and with it what the next one must know: it may have been its vehicle's pilot.
    """

    def __init__(self, folder: Path, vehicle: str, link: str):
        """Of a flight of ``vehicle`` over ``link`` whose results go to ``folder``."""
        self._path = folder.with_name(f".{folder.name}.under-way")
        self._vehicle, self._link, self._folder = vehicle, link, folder

    def set(self) -> None:
        """The vehicle is about to be armed."""
        at = time.strftime("%Y-%m-%d %H:%M:%S")
        self._path.write_text(json.dumps({"vehicle": self._vehicle, "link": self._link, "armed": at}), encoding="utf-8")

    def clear(self) -> None:
        """The flight has ended, or its vehicle was brought down."""
        self._path.unlink(missing_ok=True)

    def refuse(self) -> None:
        """Raise `LinkError` if an earlier flight was broken off."""
        if not self._path.exists():
            return
        try:
            told = json.loads(self._path.read_text(encoding="utf-8"))
            which = f"of {told['vehicle']}, armed at {told['armed']} over {told['link']},"
        except (OSError, ValueError, KeyError, TypeError):
            which = "into this folder"
        raise LinkError(
            f"an earlier flight {which} was broken off: its program ended without bringing the vehicle down. See where "
            "the vehicle is, then have it land, or be found disarmed, by the same command with --recover land; after "
            f"that it may fly again ({self._path} says so)"
        )


def refuse_under_way(link: VehicleLink) -> None:
    """Raise `LinkError` if the vehicle is armed: somebody flies it, or a flight of ours was interrupted."""
    if link.telemetry().armed:
        raise LinkError(
            "the vehicle is armed: somebody else flies it, or an earlier flight was interrupted. Have it disarmed (the "
            "operator, or swarmsim fly MISSION --vehicle NAME --recover land), then start again"
        )


def recover(link: VehicleLink, how: str, settings: Autopilot, tell: Callable[[str], None]) -> None:
    """Have a vehicle that is under way land or return (``how``), whoever left it there, until it is disarmed."""
    if not link.telemetry().armed:
        tell("it stands, disarmed")
        return
    drives = link.identity.vehicle == "rover"
    mode = Mode.HOLD if drives and how == "land" else MODES[how]
    link.enter(mode, settings.answer_s)
    kept = {mode, Mode.LAND} if mode is Mode.RETURN else {mode}
    tell(f"it does: {mode.value}")
    end, slow = time.monotonic() + settings.land_s, time.monotonic()
    while (t := link.telemetry()).armed:
        now = time.monotonic()
        if t.mode not in kept and not t.failsafe:
            raise LinkError(f"the operator took over with mode {t.mode_name}: nothing more is asked of it")
        if t.velocity_m_s is None or float(np.hypot(*t.velocity_m_s[:2])) > RESTS_M_S:
            slow = now
        if drives and now - slow > RESTS_S:
            link.disarm(settings.answer_s)
        if now > end:
            raise LinkError(f"it is still armed after {settings.land_s:g} s (autopilot.land_s)")
        time.sleep(POLL_S)
    tell("it stands, disarmed")
