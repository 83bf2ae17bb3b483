"""Notices that this program did not run for a while: it was stopped, or the computer was suspended."""

import threading
import time
from collections.abc import Callable

SETTLED_S = 0.5  # after a pause: what had queued up in the link has been heard
POLL_S = 0.05
_BOOT = getattr(time, "CLOCK_BOOTTIME", None)  # Linux


def since_boot_s() -> float:
    """Seconds that go on while the computer is suspended; those of `time.monotonic` stand still on Linux then."""
    return time.monotonic() if _BOOT is None else time.clock_gettime(_BOOT)


class Pulse:
    """Told by a thread that always runs (`beat`) that the program runs; any thread may ask whether it did not.

    After a pause nothing that is known of the vehicle can be trusted: ages by `time.monotonic` may be too small, and
    what had queued up in the link is heard first.
    """

    def __init__(self, most_s: float, clock: Callable[[], float] = since_boot_s):
        """A beat that is late by more than ``most_s`` is a pause. Nothing is noticed before the first one."""
        self._most_s, self._clock, self._lock = most_s, clock, threading.Lock()
        self._last: float | None = None
        self._pauses = 0
        self._paused_s = 0.0
        self._woke_s: float | None = None

    def beat(self) -> None:
        """The program runs."""
        with self._lock:
            self._look()
            self._last = self._clock()

    def end(self) -> None:
        """Nobody tells any more."""
        with self._lock:
            self._look()
            self._last = None

    def pauses(self) -> tuple[int, float]:
        """How many there were until now, and how long the last one was, s."""
        with self._lock:
            self._look()
            return self._pauses, self._paused_s

    def just_woke(self) -> bool:
        """Whether what is heard may still be from before the last pause, or from its beginning."""
        with self._lock:
            self._look()
            return self._woke_s is not None and time.monotonic() - self._woke_s < SETTLED_S

    def settle(self, heard_s: Callable[[], float | None], timeout_s: float) -> None:
        """After a pause wait for a heartbeat of now, for ``timeout_s`` at most; at once where it has come already.

        ``heard_s`` tells when the last one came, by `time.monotonic`.
        """
        with self._lock:
            self._look()
            since = None if self._woke_s is None else self._woke_s + SETTLED_S
        if since is not None:
            while (heard_s() or 0.0) < since and time.monotonic() < since + timeout_s:
                time.sleep(POLL_S)

    def _look(self) -> None:
        now = self._clock()
        if self._last is not None and now - self._last > self._most_s:
            self._pauses += 1
            self._paused_s, self._woke_s, self._last = now - self._last, time.monotonic(), now


def stopped(for_s: float) -> str:
    """What is told of a pause."""
    return f"this program was stopped, or its computer suspended, for {for_s:.0f} s: nothing was sent meanwhile"


__all__ = ["Pulse", "since_boot_s", "stopped"]
