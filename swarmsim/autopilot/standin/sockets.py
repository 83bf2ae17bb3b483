"""Links of the stand-in: UDP that calls, UDP that waits, TCP that waits. Loopback unless an address is given."""

import select
import socket
from typing import Protocol

from swarmsim.config.errors import InputError

ALLOWED = "udpout:HOST:PORT, udpin:HOST:PORT or tcpin:HOST:PORT"
DATAGRAM_MAX = 65536
CLIENTS_MAX = 16
Peer = tuple[str, int]


class Link(Protocol):
    """A way to exchange bytes with others."""

    address: str  # what a client connects to or listens at

    def receive(self, timeout_s: float) -> list[tuple[Peer, bytes]]:
        """What has come, after waiting no longer than the time-out; empty bytes say that a peer has gone."""

    def send(self, data: bytes) -> None:
        """Send to every peer; what cannot be sent is lost."""

    def close(self) -> None:
        """Close all sockets."""


class Udp:
    """Datagrams: to a fixed peer, or to whoever has sent some."""

    def __init__(self, kind: str, host: str, port: int):
        """Bind; of ``udpout`` to any free port of the loopback interface, or of any where the peer is elsewhere."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._peers: dict[Peer, None] = {}
        try:
            if kind == "udpout":
                near = host == "localhost" or host.startswith("127.")
                self._socket.bind(("127.0.0.1" if near else "", 0))
                self._peers[socket.gethostbyname(host), port] = None
                self.address = f"udp:{host}:{port}"
            else:
                self._socket.bind((host, port))
                self.address = f"udp:{host}:{self._socket.getsockname()[1]}"
        except BaseException:
            self._socket.close()
            raise
        self._learns = kind == "udpin"

    def receive(self, timeout_s: float) -> list[tuple[Peer, bytes]]:
        """Datagrams that have come."""
        found: list[tuple[Peer, bytes]] = []
        while select.select([self._socket], [], [], 0.0 if found else timeout_s)[0]:
            try:
                data, peer = self._socket.recvfrom(DATAGRAM_MAX)
            except OSError:  # an earlier datagram met a closed port
                break
            if self._learns and peer not in self._peers:
                self._peers[peer] = None
                if len(self._peers) > CLIENTS_MAX:
                    self._peers.pop(next(iter(self._peers)))
            if data:
                found.append((peer, data))
            if len(found) >= CLIENTS_MAX:
                break
        return found

    def send(self, data: bytes) -> None:
        """To all peers."""
        for peer in tuple(self._peers):
            try:
                self._socket.sendto(data, peer)
            except OSError:
                continue

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpServer:
    """A server of streams."""

    def __init__(self, host: str, port: int):
        """Listen."""
        self._server = socket.create_server((host, port))
        self._clients: dict[Peer, socket.socket] = {}
        self.address = f"tcp:{host}:{self._server.getsockname()[1]}"

    def receive(self, timeout_s: float) -> list[tuple[Peer, bytes]]:
        """Bytes that have come; new clients are let in."""
        clients = dict(self._clients)
        try:
            ready = select.select([self._server, *clients.values()], [], [], timeout_s)[0]
        except (OSError, ValueError):  # a client was dropped meanwhile, in sending
            return []
        found = []
        for peer, client in clients.items():
            if client in ready:
                try:
                    data = client.recv(DATAGRAM_MAX)
                except OSError:
                    data = b""
                if not data:
                    self._drop(peer)
                found.append((peer, data))
        if self._server in ready:
            try:
                client, peer = self._server.accept()
            except OSError:  # it has gone already
                return found
            if len(self._clients) < CLIENTS_MAX:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                client.settimeout(0.2)
                self._clients[peer] = client
            else:
                client.close()
        return found

    def send(self, data: bytes) -> None:
        """To all clients; one that does not read is dropped."""
        for peer, client in tuple(self._clients.items()):
            try:
                client.sendall(data)
            except OSError:
                self._drop(peer)

    def _drop(self, peer: Peer) -> None:
        client = self._clients.pop(peer, None)
        if client is not None:
            client.close()

    def close(self) -> None:
        """Close the server and its clients."""
        for peer in tuple(self._clients):
            self._drop(peer)
        self._server.close()


def open_link(text: str) -> Link:
    """The link that ``text`` names, e.g. ``udpout:127.0.0.1:14540``; raises `InputError`. Port 0 takes a free one."""
    kind, _, rest = text.partition(":")
    host, _, digits = rest.rpartition(":")
    host = host or "127.0.0.1"
    port = int(digits) if digits.isascii() and digits.isdecimal() and len(digits) <= 5 else -1
    if kind not in ("udpout", "udpin", "tcpin") or not 0 <= port <= 65535 or (kind == "udpout" and port == 0):
        raise InputError.of("the link cannot be understood", path="--link", given=text, allowed=ALLOWED)
    try:
        return TcpServer(host, port) if kind == "tcpin" else Udp(kind, host, port)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError.of(f"the link cannot be opened: {reason}", path="--link", given=text) from error
