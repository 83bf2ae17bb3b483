"""Ports for tests that run side by side."""

import itertools
import os
import socket

LOWEST, COUNT = 20_000, 12_000  # below those that systems give away by themselves, which would take one in between
_next = itertools.count(os.getpid() * 37)


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    """A port of the loopback interface that nobody has; other processes begin to look elsewhere."""
    for number in _next:
        port = LOWEST + number % COUNT
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise AssertionError
