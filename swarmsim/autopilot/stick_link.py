"""What the links to vehicles that are flown by sticks have in common: `StickLink`.

Such a vehicle takes tilt, climb rate and turn rate. The loop from setpoints to those runs here, in a thread of its own
that sends at a fixed rate whatever the rate of the setpoints is; without a fresh setpoint the vehicle is told to hover.
"""

import contextlib
import math
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import BinaryIO

from swarmsim.autopilot.frames import yaw_of_quaternion
from swarmsim.autopilot.link import Identity, LinkError, Mode, Setpoint, Telemetry, Vector
from swarmsim.autopilot.outer_loop import Demand, LoopSettings, OuterLoop
from swarmsim.autopilot.pulse import since_boot_s
from swarmsim.config.errors import file_errors_told

FRESH_S = 0.5  # an older position is not flown on
PAUSE_S = 1.0  # between two periods: nothing was sent meanwhile, whatever the clocks say
CLIMBED = 0.9  # of the height, from which on it has taken off
_KEPT = 200  # messages


class Phase(Enum):
    """What this side is doing."""

    RELEASED = (
        "released"  # nothing that moves the vehicle is sent: before a flight, and when somebody else has taken it
    )
    READY = "ready"  # it is to follow, and stands on the ground
    TAKE_OFF = "take off"
    FOLLOW = "follow"
    HOLD = "hold"
    LAND = "land"


FOLLOWING = frozenset((Phase.READY, Phase.TAKE_OFF, Phase.FOLLOW))


class WireLog:
    """Everything that was sent and received, a line each: seconds since 1970, ``>`` or ``<``, the bytes in hexadecimal.

    A full disk ends the log, not the flight.
    """

    def __init__(self, path: Path | None):
        """Begin a file; nothing is written without a ``path``. Raises `InputError` where it cannot be written."""
        self._lock = threading.Lock()
        self._file: BinaryIO | None = None
        if path is not None:
            with file_errors_told("the log cannot be written", file=path):
                path.parent.mkdir(parents=True, exist_ok=True)
                self._file = path.open("wb")

    def note(self, direction: str, data: bytes) -> None:
        """Add a line."""
        with self._lock:
            if self._file is not None:
                try:
                    self._file.write(f"{time.time():.6f} {direction} {data.hex()}\n".encode())
                except OSError:
                    self._end()

    def close(self) -> None:
        """End the file."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None


class StickLink(ABC):
    """The common part of a `VehicleLink`; what a vehicle says and takes is in the subclasses.

    A subclass calls `_begin` when its wire is open and `_refresh` whenever it has heard something. It gives `_snapshot`
    (relative to the vehicle's own origin), `_tick` (what is sent in a period) and the commands of the interface that
    differ.
    """

    streams_first = False
    arms = True

    def __init__(self, identity: Identity, loop: LoopSettings, rate_hz: float, stale_s: float, dry: bool):
        """``stale_s`` is how old a setpoint may be; with ``dry`` nothing is sent that moves the vehicle."""
        self.identity, self.dry = identity, dry
        self._loop, self._period_s, self._stale_s = OuterLoop(loop), 1.0 / rate_hz, stale_s
        self._lock = threading.RLock()
        self._changed = threading.Condition()
        self._phase, self._phase_s = Phase.RELEASED, 0.0
        self._goal: tuple[float, Setpoint] | None = None  # until when it is fresh
        self._offset: Vector | None = None  # from the vehicle's own origin to the world's
        self._telemetry = Telemetry()
        self._listeners: list[Callable[[Telemetry], None]] = []
        self._words: deque[str] = deque(maxlen=_KEPT)
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []

    # what a subclass gives

    @abstractmethod
    def _snapshot(self) -> Telemetry:
        """What is known, positions relative to the vehicle's own origin."""

    @abstractmethod
    def _tick(self, now_s: float, dt_s: float) -> None:
        """Send what is due in this period."""

    @abstractmethod
    def _why_not_follow(self) -> str | None:
        """Why it cannot be flown from here now; None if it can."""

    # what it tells

    def telemetry(self) -> Telemetry:
        """The latest snapshot, in the world once aligned; any thread may ask."""
        return self._telemetry

    def messages(self) -> list[str]:
        """Notes of the link since the last call."""
        with self._lock:
            told = list(self._words)
            self._words.clear()
        return told

    def on_mode(self, callback: Callable[[Telemetry], None]) -> None:
        """Call ``callback`` in the thread that reads, at once, when the mode, the arming or the failsafe changes."""
        self._listeners.append(callback)

    def align(self, world_m: Vector) -> None:
        """The place where the vehicle is now is ``world_m`` (ENU); raises `LinkError` without a fresh position."""
        with self._lock:
            t = self._snapshot()
            if t.position_m is None or t.pose_s is None or time.monotonic() - t.pose_s > FRESH_S:
                raise LinkError("the vehicle tells no position to align: wait for the preflight checks")
            dx, dy, dz = (float(w) - p for w, p in zip(world_m, t.position_m, strict=True))
            self._offset = dx, dy, dz
        self._refresh()

    # what it is told

    def send(self, setpoint: Setpoint) -> None:
        """Fly to this setpoint from now on; it is taken in flight only, and returns at once.

        Raises `LinkError` for a position before `align`.
        """
        with self._lock:
            if setpoint.position_m is not None and self._offset is None:
                raise LinkError("positions are not aligned: call align first")
            if self._phase in (Phase.TAKE_OFF, Phase.FOLLOW):
                self._phase = Phase.FOLLOW
                self._goal = time.monotonic() + self._stale_s, setpoint

    def follow(self, timeout_s: float) -> None:
        """Have it follow setpoints; on the ground that begins with take-off."""
        self._wait_for("follow", lambda t: self._why_not_follow() is None, timeout_s, self._why_not_follow)
        with self._lock:
            self._loop.reset()
            self._goal = None
            self._phase = Phase.FOLLOW if self._telemetry.armed else Phase.READY
        self._refresh()

    def take_off(self, height_m: float, timeout_s: float) -> None:
        """Climb to ``height_m`` above where it stands, and wait for nine tenths of it."""
        if not 0.1 <= height_m <= 1e4:
            raise ValueError(f"height_m must lie between 0.1 and 10000 m, not {height_m}")
        if self.dry:
            self._note("dry run: take off was not sent")
            return
        t = self._telemetry
        if t.position_m is None or self._offset is None:
            raise LinkError(
                "the vehicle tells no position, or it is not aligned: it cannot be told when it has climbed"
            )
        x, y, z = t.position_m
        with self._lock:
            if self._phase not in FOLLOWING:
                raise LinkError("it does not follow from here: call follow before take_off")
            self._loop.reset()
            self._goal = math.inf, Setpoint(position_m=(x, y, z + height_m), velocity_m_s=(0.0, 0.0, 0.0))
            self._phase = Phase.TAKE_OFF

        def climbed(now: Telemetry) -> bool:
            return now.position_m is not None and now.position_m[2] >= z + CLIMBED * height_m

        try:
            self._wait_for("take off", climbed, timeout_s, self._why_not_follow)
        except LinkError:
            if not self._telemetry.armed:  # it must not take off later
                self._set_phase(Phase.LAND)
            raise

    def enter(self, mode: Mode, timeout_s: float) -> None:
        """Change to HOLD or LAND, confirmed by the vehicle's state where it tells one; it has no RETURN."""
        if mode is Mode.RETURN:
            raise LinkError(
                f"{self.identity.autopilot} has no return of its own: set autopilot.at_end and watchdogs.then to land"
            )
        if mode not in (Mode.HOLD, Mode.LAND):
            raise ValueError(f"enter takes HOLD, LAND or RETURN, not {mode}")
        if self.dry:
            self._note(f"dry run: {mode.value} was not sent")
            return
        begin = time.monotonic()
        self._set_phase(Phase.HOLD if mode is Mode.HOLD else Phase.LAND)

        def entered(t: Telemetry) -> bool:
            fresh = t.heard_s is not None and t.heard_s >= begin
            return fresh and (t.mode is mode or (mode is Mode.LAND and t.armed is False))

        self._wait_for(mode.value, entered, timeout_s, None)

    def request(self, mode: Mode) -> None:
        """Ask for HOLD or LAND without waiting, for an emergency; what it has not is LAND."""
        if mode is not Mode.HOLD and mode is not Mode.LAND:
            self._note(f"{self.identity.autopilot} has no {mode.value} of its own: it is told to land")
        self._set_phase(Phase.HOLD if mode is Mode.HOLD else Phase.LAND)

    def close(self) -> None:
        """End the threads; the vehicle is left as it is. May be called twice."""
        self._over.set()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(2.0)

    # inside

    def _begin(self, *readers: Callable[[], None]) -> None:
        """Start the thread that sends, and one for each reader."""
        for target in (self._run, *readers):
            name = f"{self.identity.autopilot}-{target.__name__.strip('_')}"
            self._threads.append(threading.Thread(target=target, name=name, daemon=True))
            self._threads[-1].start()

    def _run(self) -> None:
        due = last = time.monotonic()
        ran_s = since_boot_s()
        while not self._over.wait(max(0.0, due - time.monotonic())):
            now, ran_before_s, ran_s = time.monotonic(), ran_s, since_boot_s()
            if ran_s - ran_before_s > PAUSE_S:
                self._forget_goal()
            self._tick(now, now - last)
            last = now
            due = max(due + self._period_s, now - self._period_s)

    def _forget_goal(self) -> None:
        """The program was stopped, or its computer suspended: where the vehicle was to go is long past."""
        with self._lock:
            self._goal = None

    def _demand(self, now_s: float, dt_s: float) -> tuple[Demand, float] | None:
        """What the setpoint demands, and the heading; None where there is no fresh one, or no fresh position."""
        with self._lock:
            t, goal = self._telemetry, self._goal
            if goal is None or now_s > goal[0]:
                return None
            if t.pose_s is None or now_s - t.pose_s > FRESH_S or t.quaternion is None or t.velocity_m_s is None:
                return None
            yaw = yaw_of_quaternion(t.quaternion)
            return self._loop.step(goal[1], t, yaw, dt_s), yaw

    def _set_phase(self, phase: Phase) -> None:
        with self._lock:
            self._phase, self._goal, self._phase_s = phase, None, time.monotonic()
        self._refresh()

    def _release(self, reason: str) -> None:
        """Somebody else has taken the vehicle: nothing that moves it is sent from now on."""
        with self._lock:
            if self._phase is not Phase.RELEASED:
                self._phase, self._goal = Phase.RELEASED, None
                self._note(reason)

    def _note(self, text: str) -> None:
        with self._lock:
            self._words.append(text)

    def _refresh(self) -> None:
        """Take over what is known; tell those who wait, and those who listen where the mode or the arming changed."""
        with self._lock:
            before, after = self._telemetry, self._snapshot()
            if after.position_m is not None and self._offset is not None:
                x, y, z = (p + d for p, d in zip(after.position_m, self._offset, strict=True))
                after = replace(after, position_m=(x, y, z))
            self._telemetry = after
        with self._changed:
            self._changed.notify_all()
        if before.heard_s is not None and _state(before) != _state(after):
            for listener in list(self._listeners):
                listener(after)

    def _wait_ready(self, timeout_s: float, why_not: Callable[[], str | None]) -> None:
        """Wait until it is ready by data that come from now on."""
        begin = time.monotonic()

        def ready(t: Telemetry) -> bool:
            return bool(t.ready_to_arm) and min(t.heard_s or 0.0, t.pose_s or 0.0) >= begin

        self._wait_for("get ready", ready, timeout_s, why_not)

    def _wait_for(
        self,
        what: str,
        reached: Callable[[Telemetry], bool],
        timeout_s: float,
        why_not: Callable[[], str | None] | None,
    ) -> None:
        """Wait until the vehicle's state is reached; raises `LinkError` with what is known when the time is up.

        It gives up at once where the vehicle was taken by somebody else meanwhile.
        """
        end = time.monotonic() + timeout_s
        began = self._phase
        while not reached(self._telemetry):
            taken = self._phase is Phase.RELEASED and began is not Phase.RELEASED
            if taken or time.monotonic() >= end:
                raise LinkError(self._why(what, timeout_s, taken, None if why_not is None else why_not()))
            with self._changed:
                self._changed.wait(0.05)

    def _why(self, what: str, timeout_s: float, taken: bool, reason: str | None) -> str:
        t, now = self._telemetry, time.monotonic()
        lines = [
            f"the vehicle did not {what}: it was taken over meanwhile, and nothing more is sent"
            if taken
            else f"the vehicle did not {what} within {timeout_s:g} s"
        ]
        if t.heard_s is None or now - t.heard_s > 1.0:
            lines.append("nothing is heard of it any more: the link is lost")
        lines.append(f"it is in state {t.mode_name}, its motors {'run' if t.armed else 'stand'}")
        lines += [reason] if reason else []
        lines += [f"note: {text}" for text in self.messages()[-5:]]
        return "\n  ".join(lines)


def _state(t: Telemetry) -> tuple[Mode, bool | None, bool]:
    return t.mode, t.armed, t.failsafe
