"""A terminal that gives every key at once, and is as it was whenever swarmsim does not run in it."""

import contextlib
import os
import select
import signal
import termios
import threading
from collections.abc import Callable
from typing import Any

from swarmsim.config.errors import InputError

READ_BYTES = 1024
_IFLAG, _LFLAG, _CC = 0, 3, 6  # places in the list of `termios.tcgetattr`


class Terminal:
    """The terminal of a file descriptor, between `open` and `close` without line editing and echo.

    Ctrl-C still interrupts. Ctrl-Z and Ctrl-\\ do nothing, as they would leave a vehicle without commands, nor does
    Ctrl-S, which would block whoever prints. Stopped by SIGTSTP from elsewhere, the terminal is given back until
    SIGCONT; in the background nothing is read of it.
    """

    def __init__(self, fd: int):
        """Nothing is changed yet."""
        self._fd = fd
        self._saved: list[Any] | None = None
        self._handlers: dict[int, Any] = {}

    def open(self) -> None:
        """Take the terminal; raises `InputError` where the descriptor is none."""
        try:
            self._saved = termios.tcgetattr(self._fd)
        except termios.error as error:
            raise InputError.of(
                "the keyboard is read from a terminal, and standard input is none",
                path="--manual",
                given="keyboard",
                suggestion="start swarmsim in a terminal, without a pipe or '<' in front of it; or use a gamepad",
            ) from error
        self._apply()
        if threading.current_thread() is threading.main_thread():  # where Python allows handlers
            self._handle(signal.SIGTSTP, self._stopped)
            self._handle(signal.SIGCONT, self._continued)

    def close(self) -> None:
        """Give it back as it was."""
        while self._handlers:
            number, before = self._handlers.popitem()
            signal.signal(number, before)
        self._restore()
        self._saved = None

    def read(self) -> bytes | None:
        """What was typed since the last call; None where nothing can be read: it has gone, or belongs to another."""
        try:
            if not self._foreground():
                return None
            ready, _, _ = select.select([self._fd], [], [], 0.0)
            if not ready:
                return b""
            return os.read(self._fd, READ_BYTES) or None  # ready and empty: hung up
        except OSError:
            return None

    def _foreground(self) -> bool:
        """Whether the terminal is ours to read; another process group would be stopped for it."""
        try:
            return os.tcgetpgrp(self._fd) == os.getpgrp()
        except OSError:  # not the terminal that controls us: nobody else reads it
            return True

    def _apply(self) -> None:
        attributes = termios.tcgetattr(self._fd)
        attributes[_IFLAG] &= ~termios.IXON
        attributes[_LFLAG] &= ~(termios.ICANON | termios.ECHO)
        cc = attributes[_CC]
        cc[termios.VMIN], cc[termios.VTIME] = 0, 0
        off = bytes([os.fpathconf(self._fd, "PC_VDISABLE")])
        cc[termios.VSUSP], cc[termios.VQUIT] = off, off
        termios.tcsetattr(self._fd, termios.TCSANOW, attributes)

    def _restore(self) -> None:
        if self._saved is None or not self._foreground():  # the shell restores what it has in the foreground
            return
        with contextlib.suppress(termios.error):  # it has gone
            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._saved)
            termios.tcflush(self._fd, termios.TCIFLUSH)

    def _handle(self, number: signal.Signals, handler: Callable[[int, object], None]) -> None:
        before = signal.signal(number, handler)
        self._handlers.setdefault(number, signal.SIG_DFL if before is None else before)

    def _stopped(self, number: int, frame: object) -> None:
        self._restore()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTSTP)  # goes on here after SIGCONT

    def _continued(self, number: int, frame: object) -> None:
        signal.signal(signal.SIGTSTP, self._stopped)
        if self._saved is not None and self._foreground():
            with contextlib.suppress(termios.error):
                self._apply()
