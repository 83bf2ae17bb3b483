"""The keyboard of a terminal as two sticks.

A terminal tells of keys pressed and repeated, not of those released. So a key counts for a time that bridges its
repetition, as if it was held, and a vehicle stops when nobody types: where the terminal hangs or its connection is
lost as well. (Steps of speed that last until another key, as in teleop_twist_keyboard, would leave it moving.) Of keys
held together a terminal repeats the last one only: the others end, which stops what they command.
"""

import math
import os
import sys

from swarmsim.autopilot.manual.keys import KeyDecoder
from swarmsim.autopilot.manual.sticks import Event, Reading, Sticks
from swarmsim.autopilot.manual.terminal import Terminal
from swarmsim.config.errors import InputError
from swarmsim.config.manual import Manual

STEP = 0.1  # of a full stick, by the keys faster and slower
AGAIN_S = 1.0  # a key that asks once must have been up for so long: gaps of a slow connection are no second press
TYPED = 4  # different keys in one read: more were pasted, and are not obeyed

_PAIRS = (("forward", "back"), ("left", "right"), ("climb", "sink"), ("turn_left", "turn_right"))
_EVENTS = {"take_over": Event.TAKE_OVER, "hold": Event.HOLD, "land": Event.LAND, "return_home": Event.RETURN}


class Keyboard:
    """Keys as bound in ``manual.keys``; a `Source`."""

    def __init__(self, manual: Manual, fd: int | None = None):
        """``fd`` is a terminal; standard input by default."""
        self._manual = manual
        self._actions: dict[str, str] = {key: action for action, key in vars(manual.keys).items()}
        self._terminal = Terminal(_standard_input() if fd is None else fd)
        self._decoder = KeyDecoder()
        self._until: dict[str, float] = {}  # of each action whose key is held: until when
        self._seen_s: dict[str, float] = {}  # when each action's key was last seen
        self.share = manual.key_share
        """Deflection of a stick by a key."""

    def __enter__(self) -> "Keyboard":
        self._terminal.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._terminal.close()

    def read(self, now_s: float) -> Reading:
        """See `Source.read`."""
        data = self._terminal.read()
        if data is None:
            self._until.clear()
            return Reading(lost="the terminal has gone, or swarmsim is in its background")
        keys = self._decoder.feed(data, now_s)
        events = [] if len(set(keys)) > TYPED else [event for key in keys for event in self._pressed(key, now_s)]
        return Reading(self._sticks(now_s), tuple(events))

    def told(self, flies: bool) -> str:
        """See `Source.told`."""
        k = self._manual.keys
        if not flies:
            return f"{k.take_over}: take over  {k.land}: land  {k.return_home}: return"
        return (
            f"{k.take_over}: hand back  {k.hold}: hold  {k.land}: land  {k.return_home}: return  "
            f"{k.climb}/{k.sink}: climb  {k.turn_left}/{k.turn_right}: turn  "
            f"{k.faster}/{k.slower}: {100 * self.share:.0f} %  {k.forward}/{k.back}/{k.left}/{k.right}: move"
        )

    def _pressed(self, key: str, now_s: float) -> list[Event]:
        """What a key asks for; when it repeats, nothing more."""
        action = self._actions.get(key)
        if action is None:
            return []
        repeats = self._until.get(action, -1.0) >= now_s
        asks = action in _EVENTS and now_s - self._seen_s.get(action, -math.inf) >= AGAIN_S
        self._seen_s[action] = now_s
        self._until[action] = max(
            now_s + (self._manual.repeat_s if repeats else self._manual.first_s), self._until.get(action, -1.0)
        )
        for one, other in (*_PAIRS, *((b, a) for a, b in _PAIRS)):
            if action == one:
                self._until.pop(other, None)
        if action == "hold":
            for name in (name for pair in _PAIRS for name in pair):
                self._until.pop(name, None)
        if action in ("faster", "slower"):
            step = STEP if action == "faster" else -STEP
            self.share = min(1.0, max(STEP, round(self.share + step, 6)))
        return [_EVENTS[action]] if asks else []

    def _sticks(self, now_s: float) -> Sticks:
        self._until = {action: until for action, until in self._until.items() if until >= now_s}
        forward, left, up, turn = (self.share * ((a in self._until) - (b in self._until)) for a, b in _PAIRS)
        return Sticks(forward, left, up, turn)


def _standard_input() -> int:
    try:
        fd = sys.stdin.fileno()
        os.fstat(fd)
    except (AttributeError, OSError, ValueError) as error:  # None, closed or replaced
        raise InputError.of(
            "the keyboard is read from a terminal, and there is no standard input", path="--manual", given="keyboard"
        ) from error
    return fd
