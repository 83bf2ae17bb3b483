"""The gamepad: events of the kernel out of a named pipe, codes, lost and found again."""

import contextlib
import errno
import os
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.autopilot.manual.gamepad import AGAIN_S, FULL, Gamepad, shaped
from swarmsim.autopilot.manual.sticks import CENTRED, Event
from swarmsim.config.errors import InputError
from swarmsim.config.manual import AXES, BUTTONS, GamepadMap, Manual

# what Linux's xpad tells of an Xbox gamepad: sticks, triggers, directional pad; A B X Y LB RB back start guide LS RS
CODES = ((0, 1, 2, 3, 4, 5, 16, 17), (0x130, 0x131, 0x133, 0x134, 0x136, 0x137, 0x13A, 0x13B, 0x13C, 0x13D, 0x13E))
AXIS, BUTTON, INIT = 2, 1, 0x80
LEFT_X, LEFT_Y, RIGHT_X, RIGHT_Y = 0, 1, 3, 4
A, B, BACK, START = 0, 1, 6, 7


def event(kind, number, value):
    return struct.pack("=IhBB", 1234, value, kind, number)


class Pad:
    """A gamepad's device as a named pipe."""

    def __init__(self, path):
        self.path = path
        os.mkfifo(path)
        self._hold = os.open(path, os.O_RDWR | os.O_NONBLOCK)

    def gives(self, data):
        os.write(self._hold, data)

    def unplug(self):
        os.close(self._hold)
        os.unlink(self.path)


def manual(path, **fields):
    return Manual(device=str(path), dead_zone=0.1, expo=0.0).model_copy(update=fields)


@pytest.fixture
def pad(tmp_path):
    made = Pad(tmp_path / "js0")
    yield made
    with contextlib.suppress(OSError):  # a test has unplugged it
        made.unplug()


@pytest.fixture
def gamepad(pad):
    with Gamepad(manual(pad.path), lambda fd: CODES) as opened:
        yield opened


@pytest.mark.parametrize(
    ("axis", "value", "name", "sign"),
    [
        (RIGHT_Y, -32767, "forward", 1),  # pushed away from the pilot
        (RIGHT_Y, 32767, "forward", -1),
        (RIGHT_X, -32767, "left", 1),
        (RIGHT_X, 32767, "left", -1),
        (LEFT_Y, -32767, "up", 1),
        (LEFT_X, -32767, "turn", 1),  # to the left: counter-clockwise
        (LEFT_X, 32767, "turn", -1),
        (LEFT_X, -32768, "turn", 1),
    ],
)
def test_sticks_are_those_of_a_remote_control(pad, gamepad, axis, value, name, sign):
    pad.gives(event(AXIS, axis, value))
    sticks = gamepad.read(0.0).sticks
    assert getattr(sticks, name) == sign
    assert sum(abs(x) for x in vars(sticks).values()) == 1.0


def test_a_stick_stays_where_it_was_told_to_be(pad, gamepad):
    pad.gives(event(AXIS, RIGHT_Y, -20000) + event(AXIS, 2, 32767) + event(AXIS, 99, 5))  # a trigger, an unknown axis
    first = gamepad.read(0.0)
    assert first.sticks.forward == pytest.approx((20000 / FULL - 0.1) / 0.9)
    assert gamepad.read(5.0).sticks == first.sticks
    pad.gives(event(AXIS, RIGHT_Y, 1500))  # in its dead zone
    assert gamepad.read(5.1).sticks == CENTRED


def test_buttons_ask_when_they_are_pressed(pad, gamepad):
    pad.gives(event(BUTTON | INIT, A, 1))  # held when it was opened
    assert gamepad.read(0.0).events == ()
    pad.gives(event(BUTTON, A, 0) + event(BUTTON, A, 1) + event(BUTTON, B, 1) + event(BUTTON, 2, 1))
    assert gamepad.read(0.1).events == (Event.TAKE_OVER, Event.HOLD)
    pad.gives(event(BUTTON, START, 1) + event(BUTTON, BACK, 1) + event(BUTTON, 200, 1))
    assert gamepad.read(0.2).events == (Event.LAND, Event.RETURN)


def test_events_split_between_reads(pad, gamepad):
    whole = event(AXIS, LEFT_Y, -32767) + event(BUTTON, B, 1)
    pad.gives(whole[:5])
    assert gamepad.read(0.0).sticks == CENTRED
    pad.gives(whole[5:11])
    assert gamepad.read(0.1).sticks.up == 1.0
    pad.gives(whole[11:])
    assert gamepad.read(0.2).events == (Event.HOLD,)


def test_one_that_is_unplugged_centres_the_sticks_until_it_is_back(pad, gamepad):
    pad.gives(event(AXIS, RIGHT_Y, -32767))
    assert gamepad.read(0.0).sticks.forward == 1.0
    pad.unplug()
    for now in (0.1, 0.2, 0.2 + AGAIN_S, 0.3 + 2 * AGAIN_S):
        reading = gamepad.read(now)
        assert reading.sticks == CENTRED
        assert "gone" in reading.lost
    again = Pad(pad.path)
    assert gamepad.read(0.4 + 2 * AGAIN_S).lost is not None  # not yet looked for
    reading = gamepad.read(0.5 + 4 * AGAIN_S)
    assert reading.lost is None
    assert reading.sticks == CENTRED  # what it was before counts no more
    again.gives(event(AXIS | INIT, RIGHT_Y, 32767))
    assert gamepad.read(9.0).sticks.forward == -1.0
    again.unplug()


def test_a_device_that_cannot_be_read_is_told(tmp_path, pad):
    with pytest.raises(InputError, match="cannot be read"), Gamepad(manual(tmp_path / "js7")):
        pass
    with pytest.raises(InputError, match="cannot be read"), Gamepad(manual(pad.path)):  # a pipe is no joystick
        pass
    with (
        pytest.raises(InputError, match="no ABS_RY, BTN_START"),
        Gamepad(manual(pad.path), lambda fd: ((0, 1, 3), (0x130, 0x131, 0x13A))),
    ):
        pass
    with pytest.raises(InputError, match="gamepad_wheel"):
        Gamepad(manual(pad.path, gamepad="wheel"))


def test_one_that_is_no_joystick_any_more_stays_lost(pad):
    answers = iter([CODES])

    def codes(fd):
        try:
            return next(answers)
        except StopIteration:
            raise OSError(errno.ENOTTY, "not a joystick") from None

    with Gamepad(manual(pad.path), codes) as gamepad:
        pad.unplug()
        assert gamepad.read(0.0).lost is not None
        again = Pad(pad.path)
        assert "not a joystick" in gamepad.read(5.0).lost
        again.unplug()


@given(st.binary(max_size=400))
def test_whatever_it_gives_sticks_stay_within_their_ends(tmp_path_factory, data):
    pad = Pad(tmp_path_factory.mktemp("pad") / "js")
    with Gamepad(manual(pad.path), lambda fd: CODES) as gamepad:
        if data:
            pad.gives(data)
        assert all(-1.0 <= x <= 1.0 for x in vars(gamepad.read(0.0).sticks).values())
    pad.unplug()


@given(st.floats(-1, 1), st.floats(0, 0.9), st.floats(0, 1))
def test_shaping_keeps_signs_and_ends(value, dead_zone, expo):
    out = shaped(value, dead_zone, expo)
    assert abs(out) <= 1.0 + 1e-12
    assert out == 0.0 or (out > 0.0) == (value > 0.0)
    assert shaped(1.0, dead_zone, expo) == pytest.approx(1.0)
    assert shaped(0.99 * dead_zone, dead_zone, expo) == 0.0
    assert abs(out) <= max(0.0, abs(value) - dead_zone) / (1.0 - dead_zone) + 1e-12


def test_a_map_names_known_things_once():
    one = {name: {"axis": axis} for name, axis in zip(("forward", "left", "up", "turn"), AXES, strict=False)}
    one |= dict(zip(("take_over", "hold", "land", "return_home"), BUTTONS, strict=False))
    GamepadMap.model_validate(one)
    with pytest.raises(ValueError, match="no 'ABS_NOSE'"):
        GamepadMap.model_validate(one | {"up": {"axis": "ABS_NOSE"}})
    with pytest.raises(ValueError, match="twice"):
        GamepadMap.model_validate(one | {"up": one["left"]})


def test_what_can_be_done_is_told(gamepad):
    assert "south: take over" in gamepad.told(False)
    assert "south: hand back" in gamepad.told(True)
