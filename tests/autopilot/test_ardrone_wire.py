"""AT commands and navdata of the AR.Drone 2.0: the guide's examples, round trips, broken and hostile bytes."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.autopilot.ardrone import at, navdata
from swarmsim.autopilot.ardrone.navdata import Control, Demo, Navdata, State
from swarmsim.autopilot.ardrone.reckoning import Reckoning

HOVER = Demo(Control.HOVERING, 0.87, 0.1, -0.2, 1.5, 1.25, 0.5, -0.25)


@pytest.mark.parametrize(
    ("command", "data"),
    [
        # Parrot, AR.Drone Developer Guide, chapter 6
        (("PCMD", 21625, 1, 0, 0, 0, 0), b"AT*PCMD=21625,1,0,0,0,0\r"),
        (("REF", 21626, at.REF_BASE), b"AT*REF=21626,290717696\r"),
        (("REF", 101, at.REF_BASE | at.REF_START), b"AT*REF=101,290718208\r"),
        (("REF", 2, at.REF_BASE | at.REF_EMERGENCY), b"AT*REF=2,290717952\r"),
        (("PCMD", 1, 1, 0, 0, 0, 0.75), b"AT*PCMD=1,1,0,0,0,1061158912\r"),
        (("PCMD", 201, 1, -0.8, 0.0, 0.0, 0.0), b"AT*PCMD=201,1,-1085485875,0,0,0\r"),
        (("CONFIG", 605, "general:navdata_demo", "TRUE"), b'AT*CONFIG=605,"general:navdata_demo","TRUE"\r'),
        (("FTRIM", 7), b"AT*FTRIM=7\r"),
        (("COMWDG", 8), b"AT*COMWDG=8\r"),
    ],
)
def test_commands_are_as_the_guide_has_them(command, data):
    name, number, *arguments = command
    assert at.encode(name, number, *arguments) == data
    (found,) = at.decode(data)
    bits = tuple(at.bits_of_float(a) if isinstance(a, float) else a for a in arguments)
    assert (found.name, found.number, found.arguments) == (name, number, bits)


@given(st.floats(width=32, allow_nan=False))
def test_floats_keep_their_bits(value):
    assert at.float_of_bits(at.bits_of_float(value)) == value


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["REF", "PCMD_MAG", "CONFIG"]),
            st.integers(1, at.NUMBER_MAX),
            st.lists(
                st.integers(-(2**31), 2**31 - 1) | st.text(st.characters(codec="ascii", exclude_characters='"\r\n')),
                max_size=5,
            ),
        ),
        max_size=4,
    )
)
def test_commands_come_back(commands):
    data = b"".join(at.encode(name, number, *arguments) for name, number, arguments in commands)
    if len(data) <= at.DATAGRAM_MAX:
        found = [(c.name, c.number, list(c.arguments)) for c in at.decode(data)]
        assert found == [(name, number, arguments) for name, number, arguments in commands]


@pytest.mark.parametrize("text", ['a"b', "a\rb", "ä"])
def test_a_text_that_would_end_the_command_is_refused(text):
    with pytest.raises(ValueError, match="text"):
        at.encode("CONFIG", 1, text)


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\r\r", b"AT*", b"AT*REF=", b"AT*REF=1,2", b"REF=1,2\r", b"AT*ref=1\r", b"AT*REF=1,,2\r",
        b'AT*CONFIG=1,"a\r', b"AT*REF=1,2\r" + b"x" * at.DATAGRAM_MAX, b"AT*REF=99999999999,1\r", b"\xff" * 40,
    ],
)  # fmt: skip
def test_what_is_no_command_is_left_out(data):
    assert all(c.name == "REF" and len(data) < 20 for c in at.decode(data))
    assert len(at.decode(data)) <= 1


@given(st.binary(max_size=2000))
def test_no_bytes_break_the_parsers(data):
    at.decode(data)
    assert navdata.decode(data) is None


def test_sequence_numbers_begin_anew():
    numbers = at.Sequence()
    assert [numbers.take() for _ in range(3)] == [1, 2, 3]
    numbers.restart()
    assert numbers.take() == 1


def test_navdata_has_the_layout_of_the_guide():
    data = navdata.encode(Navdata(State.FLYING | State.DEMO, 42, HOVER))
    assert struct.unpack_from("<IIII", data) == (0x55667788, 0x401, 42, 0)
    assert struct.unpack_from("<HH", data, 16) == (0, 148)
    assert struct.unpack_from("<II", data, 20) == (4 << 16, 87)
    assert struct.unpack_from("<f", data, 28)[0] == pytest.approx(math.degrees(0.1) * 1e3)  # millidegrees
    assert struct.unpack_from("<i", data, 40)[0] == 1250  # mm
    assert struct.unpack_from("<HH", data, len(data) - 8) == (0xFFFF, 8)
    assert struct.unpack_from("<I", data, len(data) - 4)[0] == sum(data[:-8])


def test_navdata_come_back():
    found = navdata.decode(navdata.encode(Navdata(State.EMERGENCY | State.COM_LOST, 7, HOVER)))
    assert found is not None
    assert found.state == State.EMERGENCY | State.COM_LOST
    for name, value in vars(HOVER).items():
        assert getattr(found.demo, name) == pytest.approx(value, rel=1e-6)
    assert navdata.decode(navdata.encode(Navdata(State.BOOTSTRAP, 1, None))) == Navdata(State.BOOTSTRAP, 1, None)


@given(st.integers(0, 175), st.integers(1, 255))
def test_a_changed_or_cut_datagram_is_refused(place, change):
    data = bytearray(navdata.encode(Navdata(State.FLYING, 42, HOVER)))
    assert navdata.decode(bytes(data[:place])) is None
    if place < len(data):
        data[place] = (data[place] + change) % 256
        assert navdata.decode(bytes(data)) is None


def test_an_unknown_option_is_passed_over():
    data = navdata.encode(Navdata(State.FLYING, 42, HOVER))
    body = data[:-8] + struct.pack("<HH", 27, 12) + b"12345678"
    whole = body + struct.pack("<HHI", 0xFFFF, 8, sum(body))
    assert navdata.decode(whole) == navdata.decode(data)


def test_numbers_that_are_none_are_refused():
    assert (
        navdata.decode(navdata.encode(Navdata(State.FLYING, 1, Demo(Control.FLYING, 1, 0, 0, math.nan, 1, 0, 0))))
        is None
    )


def reckoned(samples, yaw=0.0, gap=0.5):
    reckoning = Reckoning(yaw, gap)
    for at_s, heading, forward, right, height in samples:
        reckoning.add(at_s, Demo(Control.FLYING, 1.0, 0.0, 0.0, heading, height, forward, right))
    return reckoning


def test_dead_reckoning_integrates_in_the_heading():
    east = reckoned([(0.1 * i, 0.0, 1.0, 0.0, 2.0) for i in range(11)])
    assert east.position_m == pytest.approx((1.0, 0.0, 2.0))
    # the nose at north by the settings, and a velocity to the right: east
    north = reckoned([(0.1 * i, 0.7, 0.0, 1.0, 2.0) for i in range(11)], yaw=0.5 * math.pi)
    assert north.position_m == pytest.approx((1.0, 0.0, 2.0))
    # turned clockwise by a quarter since it began: forward is south
    south = reckoned([(0.1 * i, 0.0 if i == 0 else 0.5 * math.pi, 0.0 if i == 0 else 1.0, 0.0, 2.0) for i in range(12)])
    assert south.position_m == pytest.approx((0.0, -1.05, 2.0), abs=1e-9)


def test_the_climb_rate_is_that_of_the_height():
    rising = reckoned([(0.05 * i, 0.0, 0.0, 0.0, 0.025 * i) for i in range(60)])
    assert rising.velocity_m_s == pytest.approx((0.0, 0.0, 0.5), abs=1e-3)


def test_a_long_gap_breaks_the_reckoning_until_it_begins_anew():
    reckoning = reckoned([(0.0, 0.0, 1.0, 0.0, 1.0), (0.8, 0.0, 1.0, 0.0, 1.0)])
    assert reckoning.broken
    reckoning.begin()
    assert not reckoning.broken
    assert reckoning.position_m == (0.0, 0.0, 1.0)
