"""A vehicle that is under way without a flight of ours: it is refused, or brought down (``--recover``)."""

import time
from collections.abc import Callable

import numpy as np

from swarmsim.autopilot.control import MODES, POLL_S, RESTS_M_S, RESTS_S
from swarmsim.autopilot.link import LinkError, Mode, VehicleLink
from swarmsim.config.autopilot import Autopilot


def refuse_under_way(link: VehicleLink) -> None:
    """Raise `LinkError` if the vehicle is armed: somebody flies it, or a flight of ours was interrupted."""
    if link.telemetry().armed:
        raise LinkError(
            "the vehicle is armed: somebody else flies it, or an earlier flight was interrupted. Have it disarmed (the "
            "operator, or swarmsim fly MISSION --vehicle NAME --recover land), then start again"
        )


def recover(link: VehicleLink, how: str, settings: Autopilot, tell: Callable[[str], None]) -> None:
    """Have a vehicle that is under way land or return (``how``), whoever left it there, until it is disarmed."""
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
