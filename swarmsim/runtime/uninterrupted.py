"""Ctrl-C waits for what must not be left half done."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Let signals that end a command wait until the block is left.

    A program that takes over the buffers of its input leaves nothing to go on from, or to write, where it is broken off
    before its result has a name. Only Python's own handlers wait, and only in the main thread, which alone runs them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before: dict[int, Any] = {}
    try:
        for name in _NAMES:
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            handler = None if number is None else signal.getsignal(number)
            if number is not None and callable(handler):
                before[number] = handler
                signal.signal(number, lambda number, frame: came.append(number))
        yield
    finally:
        for number, handler in reversed(before.items()):  # that of Ctrl-C last: nothing breaks this off
            signal.signal(number, handler)
        for number in came[:1]:
            signal.raise_signal(number)
