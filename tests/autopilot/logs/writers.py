"""Logs of a known flight, written byte by byte as the vehicles do."""

import struct
from dataclasses import dataclass

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.frames import Geodetic, geodetic_of_enu, ned_of_enu, quaternion_ned_of_enu

ORIGIN = Geodetic(49.2275, 16.5747, 280.0)
EPOCH_S = 1_700_000_000.0
ARMED_S, LEFT_S = 5.0, 25.0  # armed and following setpoints from the first to the second


@dataclass
class Truth:
    """A flight at 10 Hz for 30 s: a circle with a climb, heading along it."""

    time_s: np.ndarray
    position_m: np.ndarray  # ENU
    velocity_m_s: np.ndarray
    quaternion: np.ndarray  # FLU to ENU


def flight() -> Truth:
    time_s = np.arange(0.0, 30.0, 0.1)
    angle = 0.2 * time_s
    position = np.stack([12.0 * np.cos(angle), 12.0 * np.sin(angle), 0.3 * time_s], axis=1)
    velocity = np.stack([-2.4 * np.sin(angle), 2.4 * np.cos(angle), np.full(len(angle), 0.3)], axis=1)
    yaw = angle + 0.5 * np.pi
    nothing = np.zeros(len(yaw))
    quaternion = np.stack([np.cos(0.5 * yaw), nothing, nothing, np.sin(0.5 * yaw)], axis=1)
    return Truth(time_s, position, velocity, quaternion)


def ned_euler(quaternion: np.ndarray) -> tuple[float, float, float]:
    """Roll, pitch and yaw of FRD in NED."""
    w, x, y, z = quaternion_ned_of_enu(quaternion)
    return (
        float(np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))),
        float(np.arcsin(2.0 * (w * y - z * x))),
        float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))),
    )


class Tlog:
    """Bytes of a .tlog."""

    def __init__(self, system: int = 1, delay=lambda k: 0.0):
        self.data = bytearray()
        self.link = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
        self._delay, self._count = delay, 0

    def put(self, time_s: float, message) -> None:
        self._count += 1
        when = EPOCH_S + time_s + self._delay(self._count)
        self.data += struct.pack(">Q", round(when * 1e6)) + message.pack(self.link)
        self.link.seq = (self.link.seq + 1) % 256


def tlog(truth: Truth, *, system: int = 1, autopilot: int = 12, boot_s: float = 100.0, delay=lambda k: 0.0) -> bytes:
    """What a PX4 (or, by ``autopilot``, an ArduPilot) copter tells, and the setpoints that are sent to it."""
    log = Tlog(system, delay)
    place = (round(ORIGIN.latitude_deg * 1e7), round(ORIGIN.longitude_deg * 1e7), round(ORIGIN.altitude_m * 1e3))
    log.put(0.0, mavlink.MAVLink_gps_global_origin_message(*place))
    for k, t in enumerate(truth.time_s):
        ms = round((t + boot_s) * 1e3)
        follows = ARMED_S <= t < LEFT_S
        if k % 5 == 0:
            mode = {12: (6 << 16, 4 << 16 | 3 << 24), 3: (4, 5)}[autopilot][0 if follows else 1]
            base = 1 | (128 if follows else 0)
            log.put(t, mavlink.MAVLink_heartbeat_message(2, autopilot, base, mode, 4, 3))
            share = round(100 - t)
            log.put(t, mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 12000, 0, share, 0, 0, 0, 0, 0, 0))
        if k == 50:
            log.put(t, mavlink.MAVLink_statustext_message(6, b"Takeoff detected"))
        log.put(
            t, mavlink.MAVLink_attitude_quaternion_message(ms, *quaternion_ned_of_enu(truth.quaternion[k]), 0, 0, 0)
        )
        log.put(t, mavlink.MAVLink_local_position_ned_message(
            ms, *ned_of_enu(truth.position_m[k]), *ned_of_enu(truth.velocity_m_s[k])))  # fmt: skip
        if follows:
            wanted = (0b1101_1111_1000, *ned_of_enu(truth.position_m[k]), *[0.0] * 8)
            log.put(t, mavlink.MAVLink_set_position_target_local_ned_message(ms, system, 1, 1, *wanted))
    return bytes(log.data)


def dataflash(truth: Truth, vehicle: str = "ArduCopter") -> bytes:
    """A dataflash log of ArduPilot with two cores of the estimator: the first one is 5 m off and not flown by."""
    kinds = {
        "MSG": (130, "QZ", "TimeUS,Message", struct.Struct("<Q64s")),
        "PARM": (131, "QNff", "TimeUS,Name,Value,Default", struct.Struct("<Q16sff")),
        "ORGN": (132, "QBLLe", "TimeUS,Type,Lat,Lng,Alt", struct.Struct("<QBiii")),
        "MODE": (133, "QMBB", "TimeUS,Mode,ModeNum,Rsn", struct.Struct("<QBBB")),
        "ARM": (134, "QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method", struct.Struct("<QBIBB")),
        "XKF4": (135, "QBb", "TimeUS,C,PI", struct.Struct("<QBb")),
        "XKF1": (136, "QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD", struct.Struct("<QBffffff")),
        "ATT": (137, "Qccc", "TimeUS,Roll,Pitch,Yaw", struct.Struct("<Qhhh")),
        "BAT": (138, "QBB", "TimeUS,Inst,RemPct", struct.Struct("<QBB")),
        "PSCN": (139, "Qff", "TimeUS,TPN,PN", struct.Struct("<Qff")),
        "PSCE": (140, "Qff", "TimeUS,TPE,PE", struct.Struct("<Qff")),
        "PSCD": (141, "Qff", "TimeUS,TPD,PD", struct.Struct("<Qff")),
    }
    data = bytearray()
    data += (
        b"\xa3\x95\x80\x80\x59FMT\0" + b"BBnNZ".ljust(16, b"\0") + b"Type,Length,Name,Format,Columns".ljust(64, b"\0")
    )
    for name, (number, chars, columns, body) in kinds.items():
        data += b"\xa3\x95\x80" + bytes([number, body.size + 3]) + name.encode().ljust(4, b"\0")
        data += chars.encode().ljust(16, b"\0") + columns.encode().ljust(64, b"\0")

    def put(name: str, time_s: float, *values) -> None:
        number, _, _, body = kinds[name]
        data.extend(b"\xa3\x95" + bytes([number]) + body.pack(round((time_s + 50.0) * 1e6), *values))

    put("MSG", 0.0, f"{vehicle} V4.6.0-dev (fbb78585)".encode())
    put("PARM", 0.0, b"SYSID_THISMAV", 7.0, 1.0)
    put("PARM", 0.0, b"BATT_MONITOR", 4.0, 0.0)
    put(
        "ORGN",
        0.0,
        0,
        round(ORIGIN.latitude_deg * 1e7),
        round(ORIGIN.longitude_deg * 1e7),
        round(ORIGIN.altitude_m * 100),
    )
    put("MODE", 0.0, 5, 5, 1)
    for k, t in enumerate(truth.time_s):
        if k == round(ARMED_S * 10):
            put("ARM", t, 1, 0, 0, 0)
            put("MODE", t, 4, 4, 2)
        if k == round(LEFT_S * 10):
            put("MODE", t, 9, 9, 2)
            put("ARM", t, 0, 0, 0, 0)
        place, speed = ned_of_enu(truth.position_m[k]), ned_of_enu(truth.velocity_m_s[k])
        put("XKF4", t, 0, 1)
        put("XKF1", t, 0, *speed, *(place + 5.0))
        put("XKF1", t, 1, *speed, *place)
        roll, pitch, yaw = np.degrees(ned_euler(truth.quaternion[k]))
        put("ATT", t, round(roll * 100), round(pitch * 100), round(yaw * 100))
        put("BAT", t, 0, round(100 - min(t, 30.0)))
        for axis, value in zip(("PSCN", "PSCE", "PSCD"), place, strict=True):
            put(axis, t, value, value)
    return bytes(data)


def ulog(truth: Truth, *, extra_formats: tuple[str, ...] = ()) -> bytes:
    """A log of PX4."""
    topics = {
        "vehicle_local_position": (
            "uint64_t timestamp;double ref_lat;double ref_lon;float ref_alt;float x;float y;float z;float vx;float vy;"
            "float vz;bool xy_valid;bool z_valid;uint8_t[2] _padding0;",
            struct.Struct("<Qddfffffff??"),
        ),
        "vehicle_attitude": ("uint64_t timestamp;float[4] q;", struct.Struct("<Qffff")),
        "vehicle_status": (
            "uint64_t timestamp;uint8_t arming_state;uint8_t nav_state;uint8_t system_type;uint8_t system_id;",
            struct.Struct("<QBBBB"),
        ),
        "battery_status": ("uint64_t timestamp;float remaining;", struct.Struct("<Qf")),
        "trajectory_setpoint": ("uint64_t timestamp;float[3] position;", struct.Struct("<Qfff")),
    }
    data = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 50_000_000))

    def message(kind: str, body: bytes) -> None:
        data.extend(struct.pack("<HB", len(body), ord(kind)) + body)

    message("B", bytes(40))
    for name, (fields, _) in topics.items():
        message("F", f"{name}:{fields}".encode())
    for text in extra_formats:
        message("F", text.encode())
    for number, name in enumerate(topics):
        message("A", struct.pack("<BH", 0, number) + name.encode())

    def put(name: str, time_s: float, *values) -> None:
        stamp = round((time_s + 50.0) * 1e6)
        message("D", struct.pack("<H", list(topics).index(name)) + topics[name][1].pack(stamp, *values))

    for k, t in enumerate(truth.time_s):
        follows = ARMED_S <= t < LEFT_S
        place, speed = ned_of_enu(truth.position_m[k]), ned_of_enu(truth.velocity_m_s[k])
        where = (ORIGIN.latitude_deg, ORIGIN.longitude_deg, ORIGIN.altitude_m)
        put("vehicle_local_position", t, *where, *place, *speed, True, True)
        put("vehicle_attitude", t, *quaternion_ned_of_enu(truth.quaternion[k]))
        if k % 5 == 0:
            put("vehicle_status", t, 2 if follows else 1, 14 if follows else 4, 2, 9)
            put("battery_status", t, (100.0 - t) / 100.0)
        put("trajectory_setpoint", t, *place)
        if k == 50:
            stamp = struct.pack("<BQ", ord("6"), round((t + 50.0) * 1e6))
            message("L", stamp + b"[commander] Takeoff detected\t")
    return bytes(data)


def at(place_m: np.ndarray) -> Geodetic:
    """The place on the Earth of a position about the origin."""
    return geodetic_of_enu(place_m, ORIGIN)
