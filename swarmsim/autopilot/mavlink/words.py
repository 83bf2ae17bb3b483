"""What the vehicle tells in words (STATUSTEXT), put together from its parts and kept for those who ask why."""

import threading
import time
from collections import deque

from swarmsim.autopilot.mavlink.wire import Message

_WARNING = 4  # MAV_SEVERITY: lower is worse
_KEPT = 200
_PARTS_MAX = 16


class Words:
    """Statements of the vehicle, and notes of the link on it. Any thread may add and ask."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._untold: deque[str] = deque(maxlen=_KEPT)
        self._said: deque[tuple[float, int, str]] = deque(maxlen=_KEPT)  # time, severity, text
        self._parts: dict[int, str] = {}  # unfinished statements by id

    def hear(self, message: Message) -> None:
        """Take a STATUSTEXT; one of 50 characters or more comes in parts with an id."""
        text = "".join(c if c.isprintable() else "?" for c in message.text)
        if message.id:
            text = (self._parts.pop(message.id, "") if message.chunk_seq else "") + text
            if len(message.text) >= 50:
                if len(self._parts) >= _PARTS_MAX:
                    self._parts.clear()
                self._parts[message.id] = text[: 50 * _PARTS_MAX]
                return
        self.note(text, message.severity)

    def note(self, text: str, severity: int = 6) -> None:
        """Add a statement."""
        if text:
            with self._lock:
                self._untold.append(text)
                self._said.append((time.monotonic(), severity, text))

    def take(self) -> list[str]:
        """Statements since the last call."""
        with self._lock:
            told = list(self._untold)
            self._untold.clear()
        return told

    def warnings_since(self, since_s: float) -> list[str]:
        """Warnings and worse since then, each once, the newest last."""
        with self._lock:
            found = [text for at, severity, text in self._said if at >= since_s and severity <= _WARNING]
        return list(dict.fromkeys(found))
