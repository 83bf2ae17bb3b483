"""A gamepad by Linux's joystick interface (Documentation/input/joydev/joystick-api.rst), without a library.

The kernel gives events of eight bytes, and by two requests the names of axes and buttons, so that one map suits every
gamepad that follows Documentation/input/gamepad.rst. (evdev has to be compiled, pygame-ce brings 15 MB of SDL and wants
its own event loop, inputs was last released in 2018.)
"""

import contextlib
import fcntl
import os
import struct
from collections.abc import Callable
from pathlib import Path

from swarmsim.autopilot.manual.sticks import Event, Reading, Sticks
from swarmsim.autopilot.settings import load_settings
from swarmsim.config.errors import InputError
from swarmsim.config.manual import AXES, BUTTONS, Axis, GamepadMap, Manual

AGAIN_S = 1.0  # between attempts to open one that was lost
FULL = 32767.0
_EVENT = struct.Struct("=IhBB")  # js_event: time in ms, value, type, number
_READ_EVENTS = 256
_BUTTON, _AXIS, _INIT = 0x01, 0x02, 0x80
_AXES_MAX, _BUTTONS_MAX = 0x40, 0x200  # ABS_CNT; KEY_MAX - BTN_MISC + 1

Codes = tuple[tuple[int, ...], tuple[int, ...]]
"""Codes (linux/input-event-codes.h) of each axis and of each button, in the order of their numbers."""


def _request(number: int, size: int) -> int:
    """``_IOR('j', number, size)`` of asm-generic/ioctl.h."""
    return 2 << 30 | size << 16 | ord("j") << 8 | number


def codes_of(fd: int) -> Codes:
    """The codes that a joystick device tells; OSError where it is none."""
    count = bytearray(1)
    fcntl.ioctl(fd, _request(0x11, 1), count)  # JSIOCGAXES
    axes = count[0]
    fcntl.ioctl(fd, _request(0x12, 1), count)  # JSIOCGBUTTONS
    buttons = count[0]
    of_axes, of_buttons = bytearray(_AXES_MAX), bytearray(2 * _BUTTONS_MAX)
    fcntl.ioctl(fd, _request(0x32, len(of_axes)), of_axes)  # JSIOCGAXMAP
    fcntl.ioctl(fd, _request(0x34, len(of_buttons)), of_buttons)  # JSIOCGBTNMAP
    return tuple(of_axes[:axes]), struct.unpack(f"={_BUTTONS_MAX}H", of_buttons)[:buttons]


class Gamepad:
    """The gamepad ``manual.device`` with the map ``manual.gamepad``; a `Source`.

    One that is unplugged is looked for again; buttons that are held when it comes back ask for nothing.
    """

    def __init__(self, manual: Manual, codes: Callable[[int], Codes] = codes_of):
        """Nothing is opened yet; ``codes`` asks the open device for its codes."""
        self._manual, self._codes_of = manual, codes
        self.map = load_settings(f"gamepad_{manual.gamepad}", GamepadMap)
        self._fd: int | None = None
        self._lost, self._again_s = "", 0.0
        self._rest = b""
        self._codes: Codes = ((), ())
        self._values: dict[int, float] = {}  # of each axis by its code
        of = self.map
        self._events = {
            BUTTONS[of.take_over]: Event.TAKE_OVER, BUTTONS[of.hold]: Event.HOLD, BUTTONS[of.land]: Event.LAND,
            BUTTONS[of.return_home]: Event.RETURN,
        }  # fmt: skip

    def __enter__(self) -> "Gamepad":
        try:
            self._open()
        except OSError as error:
            found = ", ".join(str(path) for path in sorted(Path("/dev/input").glob("js*"))) or "none"
            raise InputError.of(
                f"the gamepad {self._manual.device} cannot be read ({error.strerror or error})",
                path="autopilot.manual.device",
                given=self._manual.device,
                suggestion=f"plug it in, and give its device; found: {found}. Linux's module joydev makes them",
            ) from error
        missing = self._missing()
        if missing:
            self._close()
            raise InputError.of(
                f"the gamepad {self._manual.device} has no {', '.join(missing)}",
                path="autopilot.manual.gamepad",
                given=self._manual.gamepad,
                suggestion="write configs/autopilots/gamepad_NAME.yaml with what it has, and name it",
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def read(self, now_s: float) -> Reading:
        """See `Source.read`."""
        if self._fd is None:
            if now_s < self._again_s:
                return Reading(lost=self._lost)
            try:
                self._open()
            except OSError as error:
                return self._without(error, now_s)
        try:
            events = self._take()
        except OSError as error:
            self._close()
            return self._without(error, now_s)
        return Reading(self._sticks(), events)

    def told(self, flies: bool) -> str:
        """See `Source.told`."""
        of = self.map
        end = f"{_spoken(of.land)}: land  {_spoken(of.return_home)}: return"
        if not flies:
            return f"{_spoken(of.take_over)}: take over  {end}"
        return f"sticks: fly  {_spoken(of.hold)}: hold  {_spoken(of.take_over)}: hand back  {end}"

    def _open(self) -> None:
        fd = os.open(self._manual.device, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            self._codes = self._codes_of(fd)
        except OSError:
            os.close(fd)
            raise
        self._fd, self._rest = fd, b""
        self._values = {}

    def _close(self) -> None:
        if self._fd is not None:
            with contextlib.suppress(OSError):
                os.close(self._fd)
        self._fd, self._values = None, {}

    def _missing(self) -> list[str]:
        axes, buttons, of = *self._codes, self.map
        missing = [a.axis for a in (of.forward, of.left, of.up, of.turn) if AXES[a.axis] not in axes]
        return missing + [name for name in BUTTONS if BUTTONS[name] in self._events and BUTTONS[name] not in buttons]

    def _without(self, error: OSError, now_s: float) -> Reading:
        self._again_s = now_s + AGAIN_S
        self._lost = f"the gamepad {self._manual.device} has gone ({error.strerror or error})"
        return Reading(lost=self._lost)

    def _take(self) -> tuple[Event, ...]:
        """Read all that has come; OSError where the device has gone."""
        assert self._fd is not None
        try:
            data = os.read(self._fd, _READ_EVENTS * _EVENT.size)
        except BlockingIOError:
            return ()
        if not data:
            raise OSError("it gives nothing more")
        data = self._rest + data
        whole = len(data) - len(data) % _EVENT.size
        self._rest = data[whole:]
        asked = []
        for _, value, kind, number in _EVENT.iter_unpack(data[:whole]):
            axes, buttons = self._codes
            if kind & ~_INIT == _AXIS and number < len(axes):
                self._values[axes[number]] = max(-1.0, value / FULL)
            elif kind == _BUTTON and value and number < len(buttons) and buttons[number] in self._events:
                asked.append(self._events[buttons[number]])
        return tuple(asked)

    def _sticks(self) -> Sticks:
        return Sticks(*(self._value(axis) for axis in (self.map.forward, self.map.left, self.map.up, self.map.turn)))

    def _value(self, axis: Axis) -> float:
        value = shaped(self._values.get(AXES[axis.axis], 0.0), self._manual.dead_zone, self._manual.expo)
        return -value if axis.reversed else value


def shaped(value: float, dead_zone: float, expo: float) -> float:
    """A deflection without its dead zone, with (1 - e) x + e x³ for the rest, as remote controls have it."""
    size = max(0.0, abs(value) - dead_zone) / (1.0 - dead_zone)
    size = (1.0 - expo) * size + expo * size**3
    return size if value >= 0.0 else -size


def _spoken(button: str) -> str:
    return button.removeprefix("BTN_").lower()
