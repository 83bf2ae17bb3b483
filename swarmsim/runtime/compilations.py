"""What is being compiled in this process now: for whoever waits for it."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Compilations:
    """Programs that threads are compiling, by name, and since when without a pause."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._names: dict[object, str] = {}
        self._since_s = 0.0
        self._listeners: list[Callable[[], None]] = []

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """A program is compiled inside the ``with``."""
        token = object()
        with self._lock:
            if not self._names:
                self._since_s = time.monotonic()
            self._names[token] = name
            told = tuple(self._listeners)
        for tell in told:
            tell()
        try:
            yield
        finally:
            with self._lock:
                del self._names[token]

    def under_way(self) -> tuple[tuple[str, ...], float]:
        """Names of the programs, the one that began first before the others, and for how long (s) any has been."""
        with self._lock:
            names = tuple(dict.fromkeys(self._names.values()))
            return names, time.monotonic() - self._since_s if names else 0.0

    @contextmanager
    def listened_to(self, tell: Callable[[], None]) -> Iterator[None]:
        """``tell`` is called, from whatever thread, when a program begins to be compiled inside the ``with``."""
        with self._lock:
            self._listeners.append(tell)
        try:
            yield
        finally:
            with self._lock:
                self._listeners.remove(tell)


COMPILATIONS = Compilations()
"""Those of this process."""
