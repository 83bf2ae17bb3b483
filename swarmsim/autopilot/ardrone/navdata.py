"""Navigation data of the AR.Drone 2.0: a header, options, and a checksum; to and from bytes.

Source: Parrot, AR.Drone Developer Guide, SDK 2.0 (2012), chapter 7, and the layout of the options as public drivers
name it (navdata_common.h; AutonomyLab/ardrone_autonomy, afg984/pyardrone). Little-endian throughout.
"""

import math
import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final

HEADER: Final = 0x55667788
TAG_DEMO, TAG_CHECKSUM = 0, 0xFFFF
_HEAD = struct.Struct("<IIII")  # header, state, sequence number, vision
_OPTION = struct.Struct("<HH")  # tag, size with these four bytes
_DEMO = struct.Struct("<IIfffifff")  # what is read of the demo option
_DEMO_BYTES = 148  # of the whole option: frames and cameras follow
_CHECKSUM_BYTES = 8
WAKE: Final = b"\x01\x00\x00\x00"  # sent to the navdata port, it asks for data by unicast


class State(IntFlag):
    """Bits of the drone's state that are used here."""

    FLYING = 1 << 0
    COMMAND = 1 << 6  # a CONFIG was received, and waits for its acknowledgement
    DEMO = 1 << 10  # only the demo option is sent
    BOOTSTRAP = 1 << 11  # no options are sent
    MOTORS = 1 << 12  # motor fault
    COM_LOST = 1 << 13  # nothing was heard from us for 2 s
    SOFTWARE = 1 << 14
    BATTERY_LOW = 1 << 15
    USER_EMERGENCY = 1 << 16
    ANGLES = 1 << 19  # tilted out of range
    WIND = 1 << 20
    ULTRASOUND = 1 << 21  # the altimeter hears nothing
    CUTOUT = 1 << 22  # a propeller is blocked
    COM_WATCHDOG = 1 << 30  # nothing was heard from us for 50 ms
    EMERGENCY = 1 << 31


class Control(IntEnum):
    """Major state of the controller, the upper half of ctrl_state."""

    DEFAULT = 0
    INIT = 1
    LANDED = 2
    FLYING = 3
    HOVERING = 4
    TEST = 5
    TAKING_OFF = 6
    GOTO_FIX = 7
    LANDING = 8
    LOOPING = 9


AIRBORNE: Final = frozenset((Control.FLYING, Control.HOVERING, Control.GOTO_FIX, Control.LOOPING))


@dataclass(frozen=True)
class Demo:
    """The demo option. Angles as forward-right-down has them, heading clockwise from where it was at start."""

    control: Control
    battery: float  # share of the capacity
    pitch_rad: float  # positive with the nose up
    roll_rad: float  # positive to the right
    heading_rad: float
    height_m: float
    forward_m_s: float
    right_m_s: float


@dataclass(frozen=True)
class Navdata:
    """One datagram; ``demo`` is None in bootstrap mode."""

    state: State
    number: int
    demo: Demo | None


def decode(data: bytes) -> Navdata | None:
    """One datagram; None for anything that is not a whole one with the right checksum."""
    if len(data) < _HEAD.size + _CHECKSUM_BYTES:
        return None
    header, state, number, _ = _HEAD.unpack_from(data)
    if header != HEADER:
        return None
    demo: Demo | None = None
    at = _HEAD.size
    while at + _OPTION.size <= len(data):
        tag, size = _OPTION.unpack_from(data, at)
        if size < _OPTION.size or at + size > len(data):
            return None
        if tag == TAG_CHECKSUM:
            if size != _CHECKSUM_BYTES or struct.unpack_from("<I", data, at + 4)[0] != _sum(data[:at]):
                return None
            return Navdata(State(state), number, demo)
        if tag == TAG_DEMO:
            demo = _demo(data[at + _OPTION.size : at + size])
            if demo is None:
                return None
        at += size
    return None


def _sum(data: bytes) -> int:
    return sum(data) & 0xFFFFFFFF


def _demo(data: bytes) -> Demo | None:
    if len(data) < _DEMO.size:
        return None
    control, battery, theta, phi, psi, height, ahead, right, _ = _DEMO.unpack_from(data)
    numbers = (theta, phi, psi, ahead, right)
    if control >> 16 not in Control._value2member_map_ or not all(math.isfinite(x) for x in numbers):
        return None
    return Demo(
        control=Control(control >> 16),
        battery=min(battery, 100) / 100.0,
        pitch_rad=math.radians(theta * 1e-3),
        roll_rad=math.radians(phi * 1e-3),
        heading_rad=math.radians(psi * 1e-3),
        height_m=height * 1e-3,
        forward_m_s=ahead * 1e-3,
        right_m_s=right * 1e-3,
    )


def encode(navdata: Navdata) -> bytes:
    """The datagram of a drone, for peers of ours."""
    data = _HEAD.pack(HEADER, int(navdata.state), navdata.number & 0xFFFFFFFF, 0)
    if navdata.demo is not None:
        d = navdata.demo
        angles = (math.degrees(x) * 1e3 for x in (d.pitch_rad, d.roll_rad, d.heading_rad))
        fields = _DEMO.pack(
            int(d.control) << 16, round(100.0 * d.battery), *angles, round(1e3 * d.height_m), 1e3 * d.forward_m_s,
            1e3 * d.right_m_s, 0.0,
        )  # fmt: skip
        data += _OPTION.pack(TAG_DEMO, _DEMO_BYTES) + fields.ljust(_DEMO_BYTES - _OPTION.size, b"\0")
    return data + _OPTION.pack(TAG_CHECKSUM, _CHECKSUM_BYTES) + struct.pack("<I", _sum(data))
