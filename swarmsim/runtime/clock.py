"""Where the time of a simulation goes: loading, compiling and running its programs."""

import threading
from typing import Literal

Source = Literal["compiled", "loaded"]  # how an executable was obtained


class Clock:
    """Seconds spent on each program since the last reset, by name; threads may add to it at once."""

    compiled: dict[str, float]  # traced and compiled, because nowhere kept
    loaded: dict[str, float]  # found in this process or in the user's cache folder
    ran: dict[str, float]

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        """Begin again at zero."""
        self.compiled, self.loaded, self.ran = {}, {}, {}

    def copy(self) -> "Clock":
        """The times as they stand now."""
        taken = Clock()
        with self._lock:
            taken.compiled, taken.loaded, taken.ran = dict(self.compiled), dict(self.loaded), dict(self.ran)
        return taken

    def add(self, kind: Source | Literal["ran"], name: str, seconds: float) -> None:
        """Add seconds to a program's time."""
        with self._lock:
            table = getattr(self, kind)
            table[name] = table.get(name, 0.0) + seconds

    @property
    def compile_s(self) -> float:
        """Seconds spent compiling programs or loading compiled ones."""
        return sum(self.compiled.values()) + sum(self.loaded.values())

    @property
    def run_s(self) -> float:
        """Seconds spent running."""
        return sum(self.ran.values())
