"""Where bytes come from and go to: link strings, UDP and TCP sockets, serial ports."""

import contextlib
import select
import socket
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol

from swarmsim.autopilot.link import LinkError
from swarmsim.config.errors import InputError

LOOPBACK = "127.0.0.1"
ALLOWED = (
    "udpin:[HOST:]PORT (listen), udpout:[HOST:]PORT (send first), tcp:[HOST:]PORT, tcpin:[HOST:]PORT (listen), "
    f"serial:DEVICE[:BAUD]; HOST is {LOOPBACK} where none is given, and udpin:0.0.0.0:PORT listens on every interface"
)
_READ_BYTES = 65_536
_BUFFER_BYTES = 1 << 20  # of the socket: half a second of everything that a PX4 tells
_RECONNECT_S = 1.0
_CONNECT_S = 2.0
_REFUSED_S = 0.25
_STUCK_S = 0.5  # a TCP peer that takes nothing for this long is given up
_BAUD = 57_600

Source = Any
"""Where a datagram came from, (host, port); None on a TCP or serial link."""


@dataclass(frozen=True)
class LinkAddress:
    """A parsed link string: ``kind`` udpin, udpout, tcp, tcpin (host and port) or serial (device and baud rate)."""

    kind: str
    host: str
    number: int  # port, or baud rate

    def __str__(self) -> str:
        return f"{self.kind}:{self.host}:{self.number}"


def parse_link(text: str) -> LinkAddress:
    """The address that a link string means; raises `InputError` with the allowed forms."""
    kind, _, rest = text.strip().partition(":")
    if kind == "serial":
        device, colon, baud = rest.rpartition(":")
        device, number = (device, baud) if colon else (rest, str(_BAUD))
        if device and number.isascii() and number.isdigit() and 0 < int(number) <= 10_000_000:
            return LinkAddress(kind, device, int(number))
    elif kind in ("udpin", "udpout", "tcp", "tcpin"):
        host, colon, port = rest.rpartition(":")
        host = host.strip("[]") if colon else LOOPBACK
        if host and " " not in host and port.isascii() and port.isdigit() and 0 < int(port[:6]) <= 65_535:
            return LinkAddress(kind, host, int(port))
    raise InputError.of("this is no link to a vehicle", given=text, allowed=ALLOWED)


class Transport(Protocol):
    """Bytes to and from a vehicle; `read` is called by one thread, `write` by any."""

    def read(self, timeout_s: float) -> tuple[bytes, Source]:
        """What came, empty where nothing did within the time."""

    def write(self, data: bytes, to: Source) -> bool:
        """Send; whether it was handed over. Never raises for a link that is down."""

    def close(self) -> None:
        """Close for good."""


def open_transport(address: LinkAddress, refused_s: float = 0.0) -> Transport:
    """Open the link; raises `LinkError` that says what to do when it cannot be opened.

    A TCP server that does not listen yet is tried for ``refused_s``: an autopilot takes seconds to start.
    """
    end = time.monotonic() + refused_s
    while True:
        try:
            return _opened(address)
        except ConnectionRefusedError as error:
            if time.monotonic() > end:
                raise _cannot_open(address, error) from error
            time.sleep(_REFUSED_S)
        except (OSError, UnicodeError) as error:  # the latter for a name that no host can have
            raise _cannot_open(address, error) from error


def _opened(address: LinkAddress) -> Transport:
    if address.kind in ("udpin", "udpout"):
        return _Udp(address)
    if address.kind == "tcp":
        return _TcpClient(address)
    if address.kind == "tcpin":
        return _TcpServer(address)
    return _Serial(address)


def _cannot_open(address: LinkAddress, error: OSError | UnicodeError) -> LinkError:
    advice = {
        "udpin": "another program may listen there already: give this vehicle a port of its own",
        "tcpin": "another program may listen there already: give this vehicle a port of its own",
        "udpout": "check the host name",
        "tcp": "start the autopilot, and check that no other client is connected to this port",
        "serial": "check that the device is plugged in and that you may read it (group dialout)",
    }[address.kind]
    return LinkError(f"{address} cannot be opened ({getattr(error, 'strerror', None) or error}): {advice}")


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


class _Udp:
    def __init__(self, address: LinkAddress):
        self._socket = socket.socket(_family(address.host), socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        self._remote: Source = None
        try:
            if address.kind == "udpin":
                self._socket.bind((address.host, address.number))
            else:
                # the numeric form, so that what comes can be compared with it
                found = socket.getaddrinfo(address.host, address.number, self._socket.family, socket.SOCK_DGRAM)
                self._remote = found[0][4]
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)

    def read(self, timeout_s: float) -> tuple[bytes, Source]:
        try:
            if not select.select([self._socket], [], [], timeout_s)[0]:
                return b"", None
            data, source = self._socket.recvfrom(_READ_BYTES)
        except (OSError, ValueError):  # closed meanwhile, or the peer's port is not open yet
            time.sleep(0.01)
            return b"", None
        if self._remote is not None and source[:2] != self._remote[:2]:
            return b"", None
        return data, source

    def write(self, data: bytes, to: Source) -> bool:
        to = self._remote if self._remote is not None else to
        if to is None:
            return False
        try:
            self._socket.sendto(data, to)
        except OSError:
            return False
        return True

    def close(self) -> None:
        self._socket.close()


class _Stream(ABC):
    """A TCP connection that is made anew when it is lost."""

    def __init__(self) -> None:
        self._peer: socket.socket | None = None
        self._tried_s = 0.0

    @abstractmethod
    def _connect(self) -> socket.socket | None:
        """A new connection; None where there is none yet."""

    def read(self, timeout_s: float) -> tuple[bytes, Source]:
        peer = self._peer
        if peer is None:
            if time.monotonic() - self._tried_s < _RECONNECT_S:
                time.sleep(min(timeout_s, 0.05))
                return b"", None
            self._tried_s = time.monotonic()
            with contextlib.suppress(OSError):
                self._peer = self._connect()
            return b"", None
        try:
            if not select.select([peer], [], [], timeout_s)[0]:
                return b"", None
            data = peer.recv(_READ_BYTES)
        except (OSError, ValueError):
            data = b""
        if not data:
            self._peer = None
            peer.close()
        return data, None

    def write(self, data: bytes, to: Source) -> bool:
        del to
        peer = self._peer
        if peer is None:
            return False
        try:
            peer.sendall(data)
        except OSError:  # lost, or stuck for so long that a part of the message may have gone: made anew by `read`
            with contextlib.suppress(OSError):
                peer.shutdown(socket.SHUT_RDWR)
            return False
        return True

    def close(self) -> None:
        self._tried_s = float("inf")
        if self._peer is not None:
            self._peer.close()


class _TcpClient(_Stream):
    def __init__(self, address: LinkAddress):
        super().__init__()
        self._address = (address.host, address.number)
        self._peer = self._connect()

    def _connect(self) -> socket.socket:
        peer = socket.create_connection(self._address, timeout=_CONNECT_S)
        peer.settimeout(_STUCK_S)
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return peer


class _TcpServer(_Stream):
    def __init__(self, address: LinkAddress):
        super().__init__()
        self._listener = socket.create_server((address.host, address.number), family=_family(address.host), backlog=1)
        self._listener.settimeout(0.05)

    def _connect(self) -> socket.socket:
        self._tried_s = 0.0
        peer, _ = self._listener.accept()
        peer.settimeout(_STUCK_S)
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return peer

    def close(self) -> None:
        super().close()
        self._listener.close()


class _Serial:
    """A serial port, opened anew when the device was unplugged and comes back."""

    def __init__(self, address: LinkAddress):
        import serial

        self._port = serial.Serial(address.host, address.number, timeout=0.05, write_timeout=0.5)
        self._closed = False

    def read(self, timeout_s: float) -> tuple[bytes, Source]:
        try:
            if self._port.is_open:
                return self._port.read(max(1, self._port.in_waiting)), None
            if not self._closed:
                self._port.open()
        except (OSError, TypeError):  # unplugged, or closed meanwhile
            with contextlib.suppress(OSError):
                self._port.close()
        time.sleep(timeout_s)
        return b"", None

    def write(self, data: bytes, to: Source) -> bool:
        del to
        try:
            self._port.write(data)
        except (OSError, TypeError):
            return False
        return True

    def close(self) -> None:
        self._closed = True
        self._port.close()
