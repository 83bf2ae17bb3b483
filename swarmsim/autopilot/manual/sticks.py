"""What every input device gives: where the sticks are, and what the pilot asked for since the last look."""

from dataclasses import dataclass
from enum import Enum
from typing import Protocol


@dataclass(frozen=True)
class Sticks:
    """Deflections between -1 and 1, in the frame of the vehicle (forward, left, up); turn is counter-clockwise."""

    forward: float = 0.0
    left: float = 0.0
    up: float = 0.0
    turn: float = 0.0

    @property
    def moves(self) -> bool:
        """Whether the vehicle is to leave its place."""
        return bool(self.forward or self.left or self.up)

    @property
    def centred(self) -> bool:
        """Whether no stick is deflected."""
        return not self.moves and not self.turn


CENTRED = Sticks()


class Event(Enum):
    """What the pilot asks for once."""

    TAKE_OVER = "take over"  # or hand back
    HOLD = "hold"
    LAND = "land"
    RETURN = "return"


@dataclass(frozen=True)
class Reading:
    """One look at an input device."""

    sticks: Sticks = CENTRED
    events: tuple[Event, ...] = ()
    lost: str | None = None  # why the device cannot be read now; its sticks are centred then


class Source(Protocol):
    """An input device."""

    def read(self, now_s: float) -> Reading:
        """Where the sticks are at the time ``now_s``; returns at once."""

    def told(self, flies: bool) -> str:
        """What can be done now, in a line, when the pilot flies and when not."""

    def __enter__(self) -> "Source":
        """Open the device; raises `InputError` where it cannot be used."""

    def __exit__(self, *_: object) -> None:
        """Close it, and leave everything as it was."""
