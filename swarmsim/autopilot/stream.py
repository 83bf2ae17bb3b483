"""The stream of setpoints: a thread of its own, so that nothing the mission computes delays it."""

import contextlib
import os
import threading
import time
from collections.abc import Callable

import numpy as np

from swarmsim.autopilot.guard import Guard, RefusedError
from swarmsim.autopilot.link import Setpoint
from swarmsim.autopilot.pulse import Pulse

PAUSE_S = 1.0  # that the thread is late by, or ``stale_s`` if that is more: the program was stopped meanwhile
PRIORITY = -10  # nice value of the thread; it needs a few microseconds in each period


class SetpointStream:
    """Sends the latest setpoint at a fixed rate until it is halted.

    A setpoint that is not renewed for ``stale_s`` is not sent again: then ``on_stale`` is called, once, with its age in
    s, and the stream is silent until a new one is offered. One that is to be kept lasts ``kept_s``. None outlasts a
    pause of the program, which `pulse` notices: then ``on_stale`` is called as well. `halt` takes effect before it
    returns: no byte leaves afterwards.
    """

    def __init__(
        self, send: Callable[[Setpoint], None], guard: Guard, rate_hz: float, stale_s: float, kept_s: float,
        on_stale: Callable[[float], None], on_error: Callable[[Exception], None],
    ):  # fmt: skip
        """Nothing is sent yet.

        ``on_stale`` and ``on_error`` (``send`` failed; the stream has ended) are called in the stream's thread.
        """
        self._send, self._guard, self._period_s = send, guard, 1.0 / rate_hz
        self._lasts_s = {False: stale_s, True: kept_s}
        self.pulse = Pulse(max(PAUSE_S, stale_s))
        self._pauses = 0  # that were seen here
        self._on_stale, self._on_error = on_stale, on_error
        self._lock = threading.Lock()  # held while a setpoint is sent
        self._latest: tuple[float, Setpoint] | None = None
        self._kept = False
        self._halted = True
        self._over = threading.Event()
        self._sent_s: list[float] = []
        self._thread = threading.Thread(target=self._run, name="setpoints", daemon=True)

    def start(self) -> None:
        """Begin the thread; the stream is halted until `resume`."""
        self._thread.start()

    def offer(self, setpoint: Setpoint, *, keep: bool = False) -> None:
        """The setpoint to send from now on; with ``keep`` it holds the vehicle for longer, while the mission plans.

        Raises `RefusedError` where it must not be sent; the one before stays.
        """
        now = time.monotonic()
        with self._lock:
            self._latest, self._kept = (now, self._guard.check(setpoint, now)), keep

    def renew(self) -> None:
        """A setpoint that is kept lasts as long again: whoever offered it is still there."""
        with self._lock:
            if self._kept and self._latest is not None:
                self._latest = time.monotonic(), self._latest[1]

    def halt(self) -> None:
        """Send nothing more. When it returns nothing is under way either."""
        with self._lock:
            self._halted, self._latest = True, None

    def resume(self) -> None:
        """Send again what is offered from now on."""
        with self._lock:
            self._halted, self._latest = False, None
            self._guard.forget()

    @property
    def halted(self) -> bool:
        """Whether nothing is sent."""
        return self._halted

    def close(self) -> None:
        """Halt, and end the thread."""
        self.halt()
        self._over.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(2.0)

    def gaps_s(self) -> np.ndarray:
        """Times [n] between one setpoint and the next; pauses while the stream was halted are left out."""
        times = np.asarray(self._sent_s)
        gaps = np.diff(times)
        return gaps[np.isfinite(gaps)]

    def _run(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # where the system lets it, before what only computes
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), PRIORITY)
        due = time.monotonic()
        self.pulse.beat()
        while not self._over.wait(max(0.0, due - time.monotonic())):
            self.pulse.beat()
            try:
                age_s = self._once()
            except Exception as error:  # a link may fail in any way; the flight is told
                self._halted = True
                self.pulse.end()
                self._on_error(error)
                return
            if age_s is not None:
                self._on_stale(age_s)
            now = time.monotonic()
            due += self._period_s
            if due < now - self._period_s:  # the process was suspended: what is missed is not made up for
                due = now
        self.pulse.end()

    def _once(self) -> float | None:
        """Send what is due; the age of one that has just become stale, s."""
        with self._lock:
            (pauses, paused_s), seen = self.pulse.pauses(), self._pauses
            self._pauses = pauses
            if self._halted or self._latest is None:
                if self._sent_s and np.isfinite(self._sent_s[-1]):
                    self._sent_s.append(np.nan)  # a pause
                return None
            offered_s, setpoint = self._latest
            now = time.monotonic()
            if pauses > seen:  # one that was offered since knows the vehicle's state from before
                self._latest = None
                return max(paused_s, now - offered_s)
            if now - offered_s > self._lasts_s[self._kept]:
                self._latest = None
                return now - offered_s
            self._send(setpoint)
            self._sent_s.append(now)
            return None


__all__ = ["RefusedError", "SetpointStream"]
