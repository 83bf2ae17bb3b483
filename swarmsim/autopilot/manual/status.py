"""A line at the bottom of the terminal that says who flies, below what is printed meanwhile."""

import queue
import shutil
import threading
from collections.abc import Callable
from typing import TextIO

PERIOD_S = 0.25
_CLEAR = "\r\x1b[2K"


class StatusLine:
    """Prints lines and keeps a status below them, in a thread of its own: a slow terminal delays nobody who flies."""

    def __init__(self, out: TextIO, status: Callable[[], str]):
        """Without a terminal lines are printed, and no status."""
        self._out, self._status = out, status
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._shows, self._broken = out.isatty(), False
        self._thread = threading.Thread(target=self._run, name="status line", daemon=True)

    def __enter__(self) -> "StatusLine":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._lines.put(None)
        self._thread.join(2.0)

    def tell(self, text: str) -> None:
        """Print a line, below the ones before; returns at once while the status is shown."""
        text = "".join(c if c.isprintable() else "?" for c in text)  # a terminal would obey what a vehicle tells
        if self._thread.is_alive():
            self._lines.put(text)
        else:
            self._write(text + "\n")

    def _run(self) -> None:
        shown = ""
        while True:
            try:
                text: str | None = self._lines.get(timeout=PERIOD_S)
            except queue.Empty:
                status = self._cut(self._status()) if self._shows else ""
                if status != shown:
                    self._write(_CLEAR + status)
                    shown = status
                continue
            if shown:
                self._write(_CLEAR)
                shown = ""
            if text is None:
                return
            self._write(text + "\n")

    def _cut(self, text: str) -> str:
        """As much as fits in the line: a longer one would wrap, and could not be cleared."""
        width = shutil.get_terminal_size().columns - 1
        return text if len(text) <= width else text[: max(0, width - 1)] + "…"

    def _write(self, text: str) -> None:
        if not self._broken:
            try:
                self._out.write(text)
                self._out.flush()
            except (OSError, ValueError):  # nobody reads any more: the flight goes on
                self._broken = True
