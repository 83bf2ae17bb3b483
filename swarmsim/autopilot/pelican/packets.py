"""Packets of the AscTec AutoPilot's low-level processor, over a serial line: to and from bytes.

Sources: Ascending Technologies, AscTec Hummingbird with AutoPilot User's Manual, section 4 and appendix C; AscTec wiki,
"Communicating with the Low Level Processor"; bits of the flight mode and acknowledgements also from
ethz-asl/asctec_mav_framework (HL_interface.h) and ccny-ros-pkg/asctec_drivers (telemetry.h). Little-endian throughout.
"""

import struct
from dataclasses import dataclass
from enum import IntFlag

START, STOP = b">*>", b"<#<"
_HEAD = struct.Struct("<HB")  # length of the structure, its descriptor
_TAIL_BYTES = 2 + len(STOP)
_LENGTH_MAX = 256  # of a structure; the longest has 92 bytes
_BUFFER_MAX = 4096

LL_STATUS, IMU_CALCDATA, GPS_DATA_ADVANCED, CTRL_INPUT = 0x02, 0x03, 0x29, 0x17  # packet descriptors
POLL_STATUS, POLL_IMU, POLL_GPS = 0x0001, 0x0004, 0x0200  # bits of a poll

_STATUS = struct.Struct("<4h4b2h")
_IMU = struct.Struct("<6i6h14i")
_GPS = struct.Struct("<6i4I5i")
_CONTROL = struct.Struct("<5hH")
_CONTROL_START, _POLL_START = b">*>di", b">*>p"
_CHECK = 0xAAAA

STICK_MAX, THRUST_MAX = 2047, 4095
PITCH, ROLL, YAW, THRUST = 1, 2, 4, 8  # axes of CTRL_INPUT.ctrl that are commanded


class FlightMode(IntFlag):
    """Bits of LL_STATUS.flightMode."""

    ATTITUDE = 0x01
    HEIGHT = 0x02
    POSITION = 0x04
    COMPASS_FAILURE = 0x10
    SERIAL_ENABLED = 0x20  # the operator's switch lets serial commands through
    SERIAL_ACTIVE = 0x40  # serial commands are being followed
    EMERGENCY = 0x80  # the remote control is lost: serial commands are shut out
    CALIBRATION_ERROR = 0x100
    GYRO_ERROR = 0x200


@dataclass(frozen=True)
class Status:
    """LL_STATUS, what is used of it."""

    battery_v: float
    motors_on: bool
    mode: FlightMode


@dataclass(frozen=True)
class Imu:
    """IMU_CALCDATA, what is used of it. Angles in the autopilot's own signs, heading clockwise from magnetic north."""

    nick_deg: float
    roll_deg: float
    heading_deg: float
    height_m: float  # by air pressure, after data fusion
    climb_m_s: float


@dataclass(frozen=True)
class Gps:
    """GPS_DATA_ADVANCED, what is used of it: place and velocity after data fusion."""

    latitude_deg: float
    longitude_deg: float
    east_m_s: float
    north_m_s: float
    accuracy_m: float  # horizontal
    satellites: int
    locked: bool


@dataclass(frozen=True)
class Control:
    """CTRL_INPUT: sticks within ±2047 (thrust 0 to 4095), and which of them are commanded."""

    pitch: int = 0
    roll: int = 0
    yaw: int = 0
    thrust: int = 0
    ctrl: int = PITCH | ROLL | YAW | THRUST


@dataclass(frozen=True)
class Poll:
    """A request for structures, by their bits."""

    packets: int


Packet = Status | Imu | Gps


def crc16(data: bytes) -> int:
    """Checksum of a structure, as the manual computes it."""
    crc = 0xFF
    for byte in data:
        x = byte ^ (crc & 0xFF)
        x = (x ^ x << 4) & 0xFF
        crc = (x << 8 | crc >> 8) ^ x >> 4 ^ x << 3
        crc &= 0xFFFF
    return crc


def frame(descriptor: int, payload: bytes) -> bytes:
    """A structure as the vehicle sends it."""
    return START + _HEAD.pack(len(payload), descriptor) + payload + struct.pack("<H", crc16(payload)) + STOP


def acknowledgement(descriptor: int) -> bytes:
    """What the vehicle answers to a command that it took."""
    return b">a" + bytes([descriptor]) + b"a<"


def encode_poll(packets: int) -> bytes:
    """The request for structures."""
    return _POLL_START + struct.pack("<H", packets)


def encode_control(c: Control) -> bytes:
    """The command with its checksum; raises ValueError for a stick out of range."""
    if max(abs(c.pitch), abs(c.roll), abs(c.yaw)) > STICK_MAX or not 0 <= c.thrust <= THRUST_MAX:
        raise ValueError(f"a stick is out of range: {c}")
    sticks = c.pitch, c.roll, c.yaw, c.thrust, c.ctrl
    return _CONTROL_START + _CONTROL.pack(*sticks, sum(sticks) + _CHECK & 0xFFFF)


class Replies:
    """Structures out of the bytes that the vehicle sends; what is broken is skipped."""

    def __init__(self) -> None:
        self._data = bytearray()
        self.bad = 0
        """Structures with a wrong checksum, length or end."""

    def feed(self, data: bytes) -> list[Packet]:
        """The structures that are whole now; ones of other kinds and acknowledgements are left out."""
        self._data += data
        found: list[Packet] = []
        while (begin := self._data.find(START)) >= 0:
            del self._data[:begin]
            if len(self._data) < len(START) + _HEAD.size:
                break
            length, descriptor = _HEAD.unpack_from(self._data, len(START))
            body = len(START) + _HEAD.size
            if length > _LENGTH_MAX:
                self._skip()
                continue
            if len(self._data) < body + length + _TAIL_BYTES:
                break
            payload = bytes(self._data[body : body + length])
            check, stop = struct.unpack_from("<H3s", self._data, body + length)
            if stop != STOP or check != crc16(payload):
                self._skip()
                continue
            del self._data[: body + length + _TAIL_BYTES]
            packet = _decode(descriptor, payload)
            if packet is not None:
                found.append(packet)
        if len(self._data) > _BUFFER_MAX:
            del self._data[:-_BUFFER_MAX]
        return found

    def _skip(self) -> None:
        self.bad += 1
        del self._data[:1]


def _decode(descriptor: int, payload: bytes) -> Packet | None:
    if descriptor == LL_STATUS and len(payload) == _STATUS.size:
        voltage, _, _, _, _, _, flying, motors, mode, _ = _STATUS.unpack(payload)
        return Status(voltage / 1e3, bool(motors or flying), FlightMode(mode & 0xFFFF))
    if descriptor == IMU_CALCDATA and len(payload) == _IMU.size:
        x = _IMU.unpack(payload)
        return Imu(x[0] / 1e3, x[1] / 1e3, x[2] / 1e3, x[22] / 1e3, x[23] / 1e3)
    if descriptor == GPS_DATA_ADVANCED and len(payload) == _GPS.size:
        x = _GPS.unpack(payload)
        locked = x[10] & 0x03 == 0x03
        return Gps(x[11] / 1e7, x[12] / 1e7, x[13] / 1e3, x[14] / 1e3, x[6] / 1e3, x[9], locked)
    return None


def encode(packet: Packet) -> bytes:
    """A structure of the vehicle, for peers of ours; what is not used here is zero."""
    if isinstance(packet, Status):
        motors = int(packet.motors_on)
        voltage = round(1e3 * packet.battery_v)
        mode = int(packet.mode) - (0x10000 if packet.mode & 0x8000 else 0)
        return frame(LL_STATUS, _STATUS.pack(voltage, 0, 0, 1000, 1, 0, motors, motors, mode, 0))
    if isinstance(packet, Imu):
        angles = (round(1e3 * x) for x in (packet.nick_deg, packet.roll_deg, packet.heading_deg))
        heights = round(1e3 * packet.height_m), round(1e3 * packet.climb_m_s)
        return frame(IMU_CALCDATA, _IMU.pack(*angles, *[0] * 19, *heights, 0, 0))
    place = round(1e7 * packet.latitude_deg), round(1e7 * packet.longitude_deg)
    speed = round(1e3 * packet.east_m_s), round(1e3 * packet.north_m_s)
    accuracy, status = round(1e3 * packet.accuracy_m), 0x03 if packet.locked else 0
    fields = *place, 0, *speed, 0, accuracy, accuracy, 0, packet.satellites, status, *place, *speed
    return frame(GPS_DATA_ADVANCED, _GPS.pack(*fields))


class Requests:
    """Polls and commands out of the bytes that come to the vehicle, for peers of ours."""

    def __init__(self) -> None:
        self._data = bytearray()
        self.bad = 0
        """Commands with a wrong checksum."""

    def feed(self, data: bytes) -> list[Poll | Control]:
        """What is whole now."""
        self._data += data
        found: list[Poll | Control] = []
        while (begin := self._data.find(START)) >= 0:
            del self._data[:begin]
            rest = bytes(self._data)
            if rest.startswith(_POLL_START):
                size = len(_POLL_START) + 2
                if len(rest) < size:
                    break
                found.append(Poll(struct.unpack_from("<H", rest, len(_POLL_START))[0]))
            elif rest.startswith(_CONTROL_START):
                size = len(_CONTROL_START) + _CONTROL.size
                if len(rest) < size:
                    break
                *sticks, check = _CONTROL.unpack_from(rest, len(_CONTROL_START))
                if sum(sticks) + _CHECK & 0xFFFF == check:
                    found.append(Control(*sticks))
                else:
                    self.bad += 1
                    size = 1
            elif len(rest) < len(_CONTROL_START):
                break
            else:
                size = 1
            del self._data[:size]
        if len(self._data) > _BUFFER_MAX:
            del self._data[:-_BUFFER_MAX]
        return found
