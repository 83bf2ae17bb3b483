"""How a vehicle is flown by hand (``swarmsim fly --manual``): speeds, keys, axes and buttons of a gamepad."""

from collections import Counter
from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from swarmsim.config.base import Acceleration, Delay, Duration, Model, Name, Speed

NAMED_KEYS = (
    "space", "enter", "tab", "escape", "backspace", "up", "down", "left", "right", "home", "end", "insert", "delete",
    "pageup", "pagedown",
)  # fmt: skip


def _key(name: str) -> str:
    """A key's name: one printable character, in lower case, or one of `NAMED_KEYS`."""
    if name in NAMED_KEYS or (len(name) == 1 and name.isascii() and name.isprintable() and name != " "):
        return name.lower()
    raise ValueError(f"'{name}' is no key: give one character, or one of {', '.join(NAMED_KEYS)}")


Key = Annotated[str, Field(min_length=1, max_length=20), AfterValidator(_key)]


class Keys(Model):
    """Key of each thing that a pilot does; letters stand for their capitals too.

    As with two sticks: the right hand moves it over the ground, the left one climbs and turns. A rover turns by
    ``left`` and ``right`` as well.
    """

    forward: Key = "up"
    back: Key = "down"
    left: Key = "left"
    right: Key = "right"
    climb: Key = "w"
    sink: Key = "s"
    turn_left: Key = "a"
    turn_right: Key = "d"
    faster: Key = "+"
    slower: Key = "-"
    take_over: Key = "space"
    hold: Key = "h"
    land: Key = "l"
    return_home: Key = "r"

    @model_validator(mode="after")
    def _are_different(self) -> "Keys":
        twice = [key for key, count in Counter(vars(self).values()).items() if count > 1]
        if twice:
            raise ValueError(f"each key does one thing: '{twice[0]}' is given twice")
        return self


class Manual(Model):
    """How a vehicle is flown by hand, within the limits of its setpoints.

    A full stick commands ``speed_m_s``, ``climb_m_s`` and ``yaw_rate_deg_s``; commands change with
    ``acceleration_m_s2`` and ``yaw_acceleration_deg_s2``. With its sticks released a vehicle brakes, and holds its
    place once it is slower than ``still_m_s``, or ``brake_s`` after. Handed back, a copter
    flies to where its policy has it with ``speed_m_s``.

    A terminal tells of no released key: a key counts for ``first_s`` after it was pressed, which bridges the time until
    it repeats, and for ``repeat_s`` after each repetition. A key commands ``key_share`` of a full stick.

    Of a gamepad's axes ``dead_zone`` is taken away, and ``expo`` (0 to 1) makes the rest finer near the middle.
    """

    speed_m_s: Speed = 3.0
    climb_m_s: Speed = 1.0
    yaw_rate_deg_s: Annotated[float, Field(ge=1, le=720)] = 60.0
    acceleration_m_s2: Acceleration = 2.5
    yaw_acceleration_deg_s2: Annotated[float, Field(ge=1, le=7200)] = 240.0
    still_m_s: Speed = 0.3
    brake_s: Delay = 3.0
    key_share: Annotated[float, Field(ge=0.1, le=1)] = 0.5
    first_s: Duration = 0.7
    repeat_s: Duration = 0.25
    keys: Keys = Keys()
    gamepad: Name = "xbox"
    device: Annotated[str, Field(min_length=1, max_length=200)] = "/dev/input/js0"
    dead_zone: Annotated[float, Field(ge=0, le=0.9)] = 0.1
    expo: Annotated[float, Field(ge=0, le=1)] = 0.3


# Names and numbers of linux/input-event-codes.h.
AXES = {
    "ABS_X": 0x00, "ABS_Y": 0x01, "ABS_Z": 0x02, "ABS_RX": 0x03, "ABS_RY": 0x04, "ABS_RZ": 0x05, "ABS_THROTTLE": 0x06,
    "ABS_RUDDER": 0x07, "ABS_WHEEL": 0x08, "ABS_GAS": 0x09, "ABS_BRAKE": 0x0A, "ABS_HAT0X": 0x10, "ABS_HAT0Y": 0x11,
}  # fmt: skip
BUTTONS = {
    "BTN_TRIGGER": 0x120, "BTN_THUMB": 0x121, "BTN_THUMB2": 0x122, "BTN_TOP": 0x123, "BTN_TOP2": 0x124,
    "BTN_PINKIE": 0x125, "BTN_BASE": 0x126, "BTN_BASE2": 0x127, "BTN_BASE3": 0x128, "BTN_BASE4": 0x129,
    "BTN_BASE5": 0x12A, "BTN_BASE6": 0x12B, "BTN_SOUTH": 0x130, "BTN_EAST": 0x131, "BTN_C": 0x132, "BTN_NORTH": 0x133,
    "BTN_WEST": 0x134, "BTN_Z": 0x135, "BTN_TL": 0x136, "BTN_TR": 0x137, "BTN_TL2": 0x138, "BTN_TR2": 0x139,
    "BTN_SELECT": 0x13A, "BTN_START": 0x13B, "BTN_MODE": 0x13C, "BTN_THUMBL": 0x13D, "BTN_THUMBR": 0x13E,
}  # fmt: skip


def _known(table: dict[str, int]) -> AfterValidator:
    def check(name: str) -> str:
        if name not in table:
            raise ValueError(f"there is no '{name}': it is one of {', '.join(table)}")
        return name

    return AfterValidator(check)


Button = Annotated[str, _known(BUTTONS)]


class Axis(Model):
    """An axis of a gamepad by its name in Linux; to the right and towards the pilot are its positive ends."""

    axis: Annotated[str, _known(AXES)]
    reversed: bool = False


class GamepadMap(Model):
    """What the axes and buttons of a kind of gamepad do: ``configs/autopilots/gamepad_NAME.yaml``.

    Names are those of linux/input-event-codes.h.
    """

    forward: Axis
    left: Axis
    up: Axis
    turn: Axis
    take_over: Button
    hold: Button
    land: Button
    return_home: Button

    @model_validator(mode="after")
    def _are_different(self) -> "GamepadMap":
        axes = Counter(axis.axis for axis in (self.forward, self.left, self.up, self.turn))
        buttons = Counter((self.take_over, self.hold, self.land, self.return_home))
        twice = [name for name, count in (axes + buttons).items() if count > 1]
        if twice:
            raise ValueError(f"each axis and button does one thing: {twice[0]} is given twice")
        return self
