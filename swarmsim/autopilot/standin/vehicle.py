"""The stand-in itself: body, autopilot and link put together, stepped by a test or in real time by threads."""

import random
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from swarmsim.autopilot.standin.ardupilot import ArduPilot
from swarmsim.autopilot.standin.body import Body
from swarmsim.autopilot.standin.core import Autopilot, Faults
from swarmsim.autopilot.standin.messages import Streams
from swarmsim.autopilot.standin.px4 import PX4
from swarmsim.autopilot.standin.requests import Requests
from swarmsim.autopilot.standin.settings import Settings
from swarmsim.autopilot.standin.sockets import Link, Peer
from swarmsim.autopilot.standin.targets import KilledError

KILLED_EXIT = 136
"""Exit code of a process that a floating-point exception (signal 8) has ended."""
WAIT_S = 0.05
"""How long the receiver waits before it looks whether it is to end."""
BEHIND_S = 1.0
"""How far the pacing may fall behind the clock before it gives up catching up."""
PARSERS_MAX = 64


class Standin:
    """A vehicle that speaks MAVLink.

    `advance` steps it as fast as it goes, which is deterministic; `start` runs it in real time, times ``speed``.
    Messages of a test may come by `deliver`, and ``sent`` takes what it says.
    """

    def __init__(
        self,
        body: Body,
        settings: Settings,
        link: Link | None = None,
        *,
        system: int = 1,
        speed: float = 1.0,
        seed: int = 0,
    ):
        """Put together; nothing is sent before the first step."""
        kind = PX4 if settings.autopilot == "px4" else ArduPilot
        self.body, self.link, self.speed = body, link, speed
        self.pilot: Autopilot = kind(settings, body.sensed, body.flies, system)
        self.streams = Streams(self.pilot)
        self.requests = Requests(self.pilot, self.streams)
        self.sent: Callable[[Any], None] | None = None
        self.exit_code: int | None = None
        self.lateness_s = 0.0  # the largest by which a step came late
        self._wire = mav.MAVLink(None, srcSystem=system, srcComponent=1)
        self._parsers: dict[Peer, mav.MAVLink] = {}
        self._random = random.Random(seed)
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._error: Exception | None = None
        self._until_s = 0.0  # to where `advance` has been asked to go

    # What a test asks and does

    @property
    def faults(self) -> Faults:
        """What goes wrong; a test sets its fields."""
        return self.pilot.faults

    @property
    def log(self) -> list[str]:
        """What has happened, in sentences."""
        return self.pilot.log

    @property
    def mode(self) -> str:
        """Name of the mode."""
        return self.pilot.mode

    @property
    def armed(self) -> bool:
        """Whether the motors are on."""
        return self.pilot.armed

    @property
    def time_s(self) -> float:
        """Simulated seconds since boot."""
        return self.pilot.time_s

    def operator_mode(self, name: str) -> None:
        """The operator changes the mode, as by a remote control."""
        with self._lock:
            self.pilot.operator_mode(name)

    def disarm_unexpectedly(self) -> None:
        """The motors stop, wherever it is."""
        with self._lock:
            self.pilot.disarm()

    def deliver(self, message: Any, system: int = 255, component: int = 190) -> None:
        """A message comes from another system, as over a link."""
        sender = mav.MAVLink(None, srcSystem=system, srcComponent=component)
        self.receive(("deliver", system), message.pack(sender))

    def advance(self, seconds: float) -> None:
        """Go on by simulated seconds, as fast as possible; only where `start` has not been called."""
        self._until_s += seconds
        while self.exit_code is None and self.pilot.time_s < self._until_s - 1e-6:
            self.step()

    def step(self) -> None:
        """One step: the autopilot, the body, the telemetry."""
        with self._lock:
            motion, armed = self.pilot.tick(self.body.sensed), self.pilot.armed
            self.streams.tick()
            self._flush()
        self.body.step(motion, armed)

    # The wire

    def receive(self, peer: Peer, data: bytes) -> None:
        """Bytes of a peer; whatever they are, they do no harm, unless they are a setpoint that kills ArduPilot."""
        with self._lock:
            if not data:
                self._parsers.pop(peer, None)
                return
            faults = self.faults
            if faults.silent or (faults.drop_share and self._random.random() < faults.drop_share):
                return
            for message in self._parsed(peer, data):
                try:
                    self.requests.receive(message)
                except KilledError as error:
                    self._killed(str(error))
                    return
            self._flush()

    def _parsed(self, peer: Peer, data: bytes) -> list[Any]:
        if peer not in self._parsers:
            if len(self._parsers) >= PARSERS_MAX:
                self._parsers.pop(next(iter(self._parsers)))
            self._parsers[peer] = self._parser()
        try:
            found = self._parsers[peer].parse_buffer(data) or []
        except (mav.MAVError, struct.error, ValueError, IndexError, KeyError, TypeError):
            self._parsers[peer] = self._parser()
            return []
        return [message for message in found if message.get_type() != "BAD_DATA"]

    @staticmethod
    def _parser() -> mav.MAVLink:
        parser = mav.MAVLink(None)
        parser.robust_parsing = True
        return parser

    def _flush(self) -> None:
        messages, self.pilot.outbox = self.pilot.outbox, []
        faults = self.faults
        for message in messages:
            if faults.silent or (faults.drop_share and self._random.random() < faults.drop_share):
                continue
            try:
                data = message.pack(self._wire)
            except struct.error:  # a value beyond what the message can carry, of a vehicle sent out of this world
                continue
            self._wire.seq = (self._wire.seq + 1) % 256
            if self.sent is not None:
                self.sent(message)
            if self.link is not None:
                self.link.send(data)

    def _killed(self, reason: str) -> None:
        self.pilot.log.append(reason)
        self.exit_code = KILLED_EXIT
        self._stop.set()

    # Real time

    def start(self) -> None:
        """Run in threads until `stop`; compile beforehand."""
        work = [self._pace] if self.link is None else [self._pace, self._listen]
        self._threads = [
            threading.Thread(target=self._guarded, args=(each,), name="swarmsim-standin", daemon=True) for each in work
        ]
        for thread in self._threads:
            thread.start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it ends by itself; whether it has."""
        return self._stop.wait(timeout_s)

    def stop(self) -> None:
        """End the threads and close the link; raises the error that one of them ended with."""
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._threads = []
        if self.link is not None:
            self.link.close()
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def __enter__(self) -> "Standin":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:
            self._error = error
            self._stop.set()

    def _pace(self) -> None:
        period = self.pilot.settings.step_s / self.speed
        due = time.monotonic()
        while not self._stop.is_set():
            self.step()
            due += period
            late = time.monotonic() - due
            self.lateness_s = max(self.lateness_s, late)
            if late < 0.0:
                self._stop.wait(-late)
            elif late > BEHIND_S:
                due = time.monotonic()

    def _listen(self) -> None:
        assert self.link is not None
        while not self._stop.is_set():
            for peer, data in self.link.receive(WAIT_S):
                self.receive(peer, data)
