"""A MAVLink connection: a reader thread, a filter by source, our heartbeat, a log of both directions, statistics."""

import contextlib
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.mavlink.transport import Source, open_transport, parse_link
from swarmsim.autopilot.mavlink.wire import Message, Protocol, is_unknown, origin_of
from swarmsim.config.errors import file_errors_told

ONBOARD_COMPUTER = 18  # MAV_TYPE
SYSTEM, COMPONENT = 245, 191  # ours: a system of its own, MAV_COMP_ID_ONBOARD_COMPUTER
_READ_S = 0.05
_PEER_SILENT_S = 3.0  # then the vehicle may come from another address
_PARSERS_MAX = 16
_NOBODY_S = 0.05  # until the next try where there is nobody to send a heartbeat to


@dataclass(frozen=True)
class LinkStatistics:
    """Counts since the link was opened; ``lost`` by gaps in the vehicle's sequence numbers."""

    received: int = 0  # messages of the vehicle
    sent: int = 0
    unsent: int = 0  # there was nobody to send to yet, or the link was down
    lost: int = 0
    bad: int = 0  # stretches of bytes that are no valid message, those with a wrong signature included
    foreign: int = 0  # messages of other systems, or of the same one from another address
    errors: int = 0  # messages that a listener failed on
    bytes_received: int = 0
    bytes_sent: int = 0


class Connection:
    """An open link. ``on_message`` is called in the reader thread with each message that passes the filter.

    Before `select` every system passes; afterwards the selected one alone, from the address that it was first heard
    from (until that is silent for 3 s), so that two vehicles with one system id on one port are not mixed up.
    """

    def __init__(
        self,
        link: str,
        on_message: Callable[[Message], None],
        *,
        own: tuple[int, int] = (SYSTEM, COMPONENT),
        own_type: int = ONBOARD_COMPUTER,
        heartbeat_hz: float = 1.0,
        log: Path | None = None,
        key: bytes | None = None,
        refused_s: float = 0.0,
    ):
        """Open ``link`` and begin to read and to send heartbeats as system and component ``own``.

        ``log`` is the .tlog file to write, ``key`` the signing key [32 bytes]. Raises `InputError` for a wrong link
        string or a log that cannot be written, `LinkError` where the link cannot be opened.
        """
        address = parse_link(link)
        self.link = str(address)
        self._datagrams = address.kind.startswith("udp")
        self._on_message = on_message
        self._own, self._own_type, self._key = own, own_type, key
        self._heartbeat_s = 1.0 / heartbeat_hz
        self._packer = Protocol(*own, key)
        self._parsers: dict[Source, Protocol] = {}
        self._signing = Protocol(*own, key).signing  # shared: a message replayed from another address is old there too
        self._selected: tuple[int, int] | None = None
        self._peer: Source = None
        self._peer_s = 0.0
        self._sources: dict[tuple[int, int], Source] = {}  # where each was heard from before one is selected
        self._sequence: int | None = None
        self._counts = LinkStatistics()
        self._count_lock, self._send_lock, self._log_lock = threading.Lock(), threading.Lock(), threading.Lock()
        self._log: BinaryIO | None = None
        self._closed = threading.Event()
        self._transport = open_transport(address, refused_s)
        if log is not None:
            try:
                with file_errors_told("the log cannot be written", file=log):
                    log.parent.mkdir(parents=True, exist_ok=True)
                    self._log = log.open("wb")
            except BaseException:
                self._transport.close()
                raise
        self._threads = [
            threading.Thread(target=target, name=f"mavlink-{name} {self.link}", daemon=True)
            for name, target in (("read", self._read), ("heartbeat", self._beat))
        ]
        for thread in self._threads:
            thread.start()

    @property
    def statistics(self) -> LinkStatistics:
        """The counts until now; any thread may ask."""
        return self._counts

    def select(self, system: int, component: int) -> None:
        """From now on only messages of this system and component pass."""
        self._sequence = None
        self._peer, self._peer_s = self._sources.get((system, component), self._peer), time.monotonic()
        self._selected = (system, component)

    def send(self, message: Message) -> bool:
        """Send a message; whether it went out. Any thread may call; never waits for the vehicle."""
        with self._send_lock:
            data = self._packer.bytes_of(message)
            went = not self._closed.is_set() and self._transport.write(data, self._peer)
            if went:
                self._note(data)
                self._count(sent=1, bytes_sent=len(data))
            elif message.get_msgId() != mavlink.MAVLINK_MSG_ID_HEARTBEAT:
                self._count(unsent=1)
        return went

    def close(self) -> None:
        """Stop the threads and close link and log; may be called twice."""
        self._closed.set()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(2.0)
        self._transport.close()
        with self._log_lock:
            if self._log is not None:
                self._log.close()
                self._log = None

    def _count(self, **more: int) -> None:
        with self._count_lock:
            self._counts = replace(self._counts, **{k: getattr(self._counts, k) + n for k, n in more.items()})

    def _note(self, data: bytes) -> None:
        """Append to the log as .tlog files have it: microseconds since 1970, big-endian, then the message."""
        with self._log_lock:
            if self._log is None:
                return
            try:
                self._log.write(struct.pack(">Q", int(time.time() * 1e6)) + data)
            except OSError:  # a full disk ends the log, not the flight
                with contextlib.suppress(OSError):
                    self._log.close()
                self._log = None

    def _flush(self) -> None:
        with self._log_lock:
            if self._log is not None:
                with contextlib.suppress(OSError):
                    self._log.flush()

    def _beat(self) -> None:
        kind = (self._own_type, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)
        while True:
            sent = self.send(mavlink.MAVLink_heartbeat_message(*kind))
            self._flush()
            if self._closed.wait(self._heartbeat_s if sent else min(self._heartbeat_s, _NOBODY_S)):
                return

    def _read(self) -> None:
        while not self._closed.is_set():
            data, source = self._transport.read(_READ_S)
            if data:
                self._take(data, source)

    def _take(self, data: bytes, source: Source) -> None:
        parser = self._parsers.get(source)
        if parser is None:
            if len(self._parsers) >= _PARSERS_MAX:
                self._parsers.clear()
            parser = self._parsers[source] = Protocol(*self._own)
            parser.signing = self._signing
        messages, bad = parser.messages_of(data, self._datagrams)
        self._count(bytes_received=len(data), bad=bad)
        for message in messages:
            system, component, number = origin_of(message)
            if not self._passes((system, component), source):
                self._count(foreign=1)
                continue
            self._note(bytes(message.get_msgbuf()))
            self._count(received=1, lost=self._gap(number))
            if is_unknown(message):
                continue
            try:
                self._on_message(message)
            except Exception:  # a listener's fault must not end the reading
                self._count(errors=1)

    def _passes(self, origin: tuple[int, int], source: Source) -> bool:
        selected = self._selected
        now = time.monotonic()
        if selected is None:
            self._peer = self._sources[origin] = source
            return True
        if origin != selected:
            return False
        if self._peer is not None and source != self._peer and now - self._peer_s < _PEER_SILENT_S:
            return False
        self._peer, self._peer_s = source, now
        return True

    def _gap(self, number: int) -> int:
        """Messages lost since the last one, by the sequence number; 0 before a vehicle is selected."""
        if self._selected is None:
            return 0
        gap = 0 if self._sequence is None else (number - self._sequence - 1) % 256
        self._sequence = number
        return gap if gap < 128 else 0  # more is a restart, or an older message
