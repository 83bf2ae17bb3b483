"""MAVLink telemetry logs (``.tlog``): before each message the time of its reception, 8 bytes, microseconds since 1970.

A log holds what several systems said, each with several components: gimbals and companion computers tell attitudes by
clocks of their own. Positions and attitudes are put on the vehicle's own clock
(``time_boot_ms``), which radio links do not delay: their offset from the times of reception is taken as its median
since the vehicle was switched on. What is told without a time is put there by the median offset around its reception,
which a simulator that does not keep the pace changes.
"""

import math
import mmap
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.frames import Geodetic, enu_of_ned, enu_of_places, geodetic_of_enu, ned_of_enu
from swarmsim.autopilot.logs.flight_log import (
    UNKNOWN,
    Collected,
    FlightLog,
    Floats,
    Series,
    assembled,
    empty,
    profile_of,
)
from swarmsim.autopilot.logs.rotations import quaternion_of_euler
from swarmsim.autopilot.mavlink.profile import Profile
from swarmsim.autopilot.mavlink.words import Words
from swarmsim.config.errors import InputError

Data = bytes | mmap.mmap
_STAMP = struct.Struct(">Q")
_EPOCHS_US = (631_152_000_000_000, 4_102_444_800_000_000)  # 1990 to 2100: another time stamp is none
_RESTART_S, _YOUNG_S = 30.0, 10.0  # a clock so far back, or back and so young, began anew; else it is an old message
_BACK_S = 1.0
_DENSE, _SPARSE_S = 1.5, 0.4  # global positions are taken where they are so many times as many, and local ones so rare
_AROUND_S = 5.0  # before and after a reception, of which the offset between the clocks is the median
_PAIR_S = 1.1  # longest time between two local positions about a global one
_POSITION_IGNORED = 0x7  # of SET_POSITION_TARGET_LOCAL_NED.type_mask
_LOCAL_FRAME = mavlink.MAV_FRAME_LOCAL_NED
_V1, _V2 = mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2
_SIGNATURE_BYTES = 13
_AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1


@dataclass
class _Scan:
    """What framing the file found wrong."""

    skipped: int = 0  # bytes that are no message
    wrong: int = 0  # messages with a wrong checksum


@dataclass
class _Told:
    """What one system has told; times in s: of reception, or since it was switched on with the number of the start."""

    clock: list[tuple[float, float]] = field(default_factory=list)  # reception, its own
    latest: float = -math.inf  # of its own times since it was switched on
    starts: list[int] = field(default_factory=list)  # rows of clock at which it was switched on anew
    local: list[tuple[float, ...]] = field(default_factory=list)  # row of clock, position and velocity NED
    globe: list[tuple[float, ...]] = field(default_factory=list)  # row, latitude, longitude, altitude, velocity NED
    attitude: list[tuple[float, ...]] = field(default_factory=list)  # row, quaternion
    euler: list[tuple[float, ...]] = field(default_factory=list)
    setpoints: list[tuple[float, ...]] = field(default_factory=list)  # reception, position NED
    modes: list[tuple[float, str]] = field(default_factory=list)
    armed: list[tuple[float, bool]] = field(default_factory=list)
    messages: list[tuple[float, str]] = field(default_factory=list)
    battery: list[tuple[float, float]] = field(default_factory=list)
    words: Words = field(default_factory=Words)
    origin: Geodetic | None = None
    kind: tuple[int, int] | None = None  # MAV_AUTOPILOT, MAV_TYPE
    autopilot: str = UNKNOWN
    profile: Profile | None = None


def read_tlog(data: Data, system: int | None) -> FlightLog:
    """The flight of the only vehicle in a log, or of that with the id ``system``.

    Raises `InputError` where there is no such one, where there are several and none is chosen, and where it told no
    position.
    """
    scan, heard = _Scan(), dict[tuple[int, int], _Told]()
    commanded: dict[int, list[tuple[float, ...]]] = {}
    parser = mavlink.MAVLink(None)
    for when, sender, message in _messages(data, scan, parser):
        _hear(heard, commanded, when, sender, message)
    known = _vehicles(heard)
    chosen = _chosen(known, system)
    told = known[chosen]
    notes = []
    if scan.skipped or scan.wrong:
        notes.append(f"{scan.skipped} bytes are no messages, {scan.wrong} messages have a wrong checksum: skipped")
    found = _collected(told, commanded.get(chosen, []), notes)
    if not np.isfinite(found.position_ned_m).all(axis=1).any():
        raise InputError.of(f"system {chosen} told no position in this log")
    return assembled(found, "tlog", told.profile, told.autopilot, chosen, notes)


def _vehicles(heard: dict[tuple[int, int], _Told]) -> dict[int, _Told]:
    """Of each system the component that flies it: that with an autopilot's heartbeat, else the one with positions."""
    known: dict[int, _Told] = {}
    for (system, _), told in sorted(heard.items(), key=lambda pair: (pair[0][1] != _AUTOPILOT, pair[0])):
        if told.kind is None and not (told.local or told.globe):
            continue
        if system not in known or (known[system].kind is None and told.kind is not None):
            known[system] = told
    return known


def _chosen(known: dict[int, _Told], system: int | None) -> int:
    there = ", ".join(
        f"{number} ({told.autopilot} {'vehicle' if told.profile is None else told.profile.vehicle})"
        for number, told in sorted(known.items())
    )
    if not known:
        raise InputError.of("there is no vehicle in this log: no message of an autopilot could be read")
    if system is not None and system not in known:
        raise InputError.of("the log has no such system", path="--system", given=str(system), allowed=there)
    if system is None and len(known) > 1:
        raise InputError.of("there are several vehicles in this log: choose one", path="--system", allowed=there)
    return system if system is not None else next(iter(known))


def _messages(data: Data, scan: _Scan, parser: Any) -> Iterator[tuple[float, tuple[int, int], Any]]:
    """Time of reception in s, ids of system and component, and message, for the messages that are understood here."""
    position, size = 0, len(data)
    while position + 8 < size:
        length = _frame(data, position, size)
        if length == 0:
            found = _next_frame(data, position + 1, size)
            scan.skipped += found - position
            position = found
            continue
        start, position = position + 8, position + 8 + length
        two = data[start] == _V2
        number = int.from_bytes(data[start + 7 : start + 10], "little") if two else data[start + 5]
        if number not in _READERS_BY_ID:
            continue
        try:
            message = parser.decode(bytearray(data[start:position]))
        except mavlink.MAVError:
            scan.wrong += 1
            continue
        except Exception:  # whatever hostile bytes do to pymavlink, the reading goes on
            scan.wrong += 1
            continue
        sender = start + (5 if two else 3)
        yield _STAMP.unpack_from(data, start - 8)[0] * 1e-6, (data[sender], data[sender + 1]), message
    scan.skipped += max(0, size - position)


def _frame(data: Data, position: int, size: int) -> int:
    """Bytes of the message after the time stamp at ``position``; 0 where there is no whole one."""
    if position + 8 + 12 > size and position + 8 + 8 > size:
        return 0
    start = position + 8
    marker = data[start]
    if marker == _V2 and start + 3 <= size:
        length = 12 + data[start + 1] + (_SIGNATURE_BYTES if data[start + 2] & 1 else 0)
    elif marker == _V1:
        length = 8 + data[start + 1]
    else:
        return 0
    stamp = _STAMP.unpack_from(data, position)[0]
    return length if _EPOCHS_US[0] < stamp < _EPOCHS_US[1] and start + length <= size else 0


def _next_frame(data: Data, position: int, size: int) -> int:
    """Where the next whole message begins that is followed by another one, or by the end."""
    at = dict.fromkeys((_V1, _V2), -1)  # where each marker comes next: it is looked for once
    while True:
        for marker, place in at.items():
            if place < position + 8:
                found = data.find(bytes([marker]), position + 8)
                at[marker] = found if found >= 0 else size
        if min(at.values()) == size:
            return size
        position = min(at.values()) - 8
        length = _frame(data, position, size)
        after = position + 8 + length
        if length and (after == size or _frame(data, after, size)):
            return position
        position += 1


def _hear(
    heard: dict[tuple[int, int], _Told], commanded: dict[int, list[tuple[float, ...]]], when: float,
    sender: tuple[int, int], m: Any,
) -> None:  # fmt: skip
    if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
        if m.coordinate_frame == _LOCAL_FRAME and not m.type_mask & _POSITION_IGNORED:
            commanded.setdefault(m.target_system, []).append((when, m.x, m.y, m.z))
        return
    _READERS[m.get_type()](heard.setdefault(sender, _Told()), when, m)


def _tick(told: _Told, when: float, boot_ms: int) -> float:
    """Note both clocks; the row that they are noted in."""
    own = boot_ms * 1e-3
    since = told.latest - own
    if not told.clock or since > _RESTART_S or (since > _BACK_S and own < _YOUNG_S):
        told.starts.append(len(told.clock))
        told.latest = own
    told.latest = max(told.latest, own)
    told.clock.append((when, own))
    return float(len(told.clock) - 1)


def _heartbeat(told: _Told, when: float, m: Any) -> None:
    if m.autopilot == mavlink.MAV_AUTOPILOT_INVALID or m.type == mavlink.MAV_TYPE_GCS:
        return
    if told.kind != (m.autopilot, m.type):
        told.kind = m.autopilot, m.type
        told.autopilot, told.profile = profile_of(m.autopilot, m.type)
    name = f"mode {m.custom_mode}" if told.profile is None else told.profile.mode_of(m.custom_mode)[1]
    told.modes.append((when, name))
    told.armed.append((when, bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)))


def _local(told: _Told, when: float, m: Any) -> None:
    told.local.append((_tick(told, when, m.time_boot_ms), m.x, m.y, m.z, m.vx, m.vy, m.vz))


def _globe(told: _Told, when: float, m: Any) -> None:
    if m.lat or m.lon:
        place = (m.lat * 1e-7, m.lon * 1e-7, m.alt * 1e-3)
        told.globe.append((_tick(told, when, m.time_boot_ms), *place, m.vx * 1e-2, m.vy * 1e-2, m.vz * 1e-2))


def _attitude(told: _Told, when: float, m: Any) -> None:
    if 0.9 < math.hypot(m.q1, m.q2, m.q3, m.q4) < 1.1:
        told.attitude.append((_tick(told, when, m.time_boot_ms), m.q1, m.q2, m.q3, m.q4))


def _euler(told: _Told, when: float, m: Any) -> None:
    told.euler.append((_tick(told, when, m.time_boot_ms), m.roll, m.pitch, m.yaw))


def _status(told: _Told, when: float, m: Any) -> None:
    if 0 <= m.battery_remaining <= 100:
        told.battery.append((when, m.battery_remaining / 100.0))


def _text(told: _Told, when: float, m: Any) -> None:
    told.words.hear(m)
    told.messages += [(when, text) for text in told.words.take()]


def _origin(told: _Told, when: float, m: Any) -> None:
    told.origin = Geodetic(m.latitude * 1e-7, m.longitude * 1e-7, m.altitude * 1e-3)


_READERS: dict[str, Callable[[_Told, float, Any], None]] = {
    "HEARTBEAT": _heartbeat,
    "LOCAL_POSITION_NED": _local,
    "GLOBAL_POSITION_INT": _globe,
    "ATTITUDE_QUATERNION": _attitude,
    "ATTITUDE": _euler,
    "SYS_STATUS": _status,
    "STATUSTEXT": _text,
    "GPS_GLOBAL_ORIGIN": _origin,
}
_READERS_BY_ID = {
    number
    for number, kind in mavlink.mavlink_map.items()
    if kind.msgname in (*_READERS, "SET_POSITION_TARGET_LOCAL_NED")
}


def _rows(rows: list[tuple[float, ...]], width: int) -> Floats:
    return np.asarray(rows, np.float64).reshape(-1, width)


def _collected(told: _Told, commanded: list[tuple[float, ...]], notes: list[str]) -> Collected:
    """All times on the clock of reception, as the vehicle's own clock gives it."""
    clock = _rows([*told.clock], 2)
    own = np.zeros(len(clock))
    for a, b in pairwise([*told.starts, len(clock)]):
        # what came over a second, slower link was told before
        first = clock[a:b, 1] >= np.maximum.accumulate(clock[a:b, 1])
        own[a:b] = clock[a:b, 1] + np.median((clock[a:b, 0] - clock[a:b, 1])[first])
    if len(told.starts) > 1:
        notes.append(f"the vehicle was switched on {len(told.starts)} times")

    def at(rows: Floats) -> Floats:
        return own[rows[:, 0].astype(int)] if len(rows) else np.zeros(0)

    def once(rows: Floats) -> Floats:
        """Finite positions in the order of the vehicle's clock, each once, whichever link told it first."""
        rows = rows[np.isfinite(rows[:, 1:4]).all(axis=1)]
        return rows[np.unique(at(rows), return_index=True)[1]]

    local, globe = once(_rows(told.local, 7)), once(_rows(told.globe, 7))
    origin = told.origin or _derived_origin(at(local), local, at(globe), globe)
    rare = len(local) < 2 or float(np.median(np.diff(at(local)))) > _SPARSE_S
    if len(globe) and rare and len(globe) > _DENSE * len(local):
        few = "there are no local positions" if not len(local) else "local positions are rare"
        notes.append(f"{few}: global ones are taken")
        origin = origin or Geodetic(*(float(v) for v in globe[0, 1:4]))
        position = ned_of_enu(enu_of_places(globe[:, 1:4], origin))
        local = np.concatenate([globe[:, :1], position, globe[:, 4:]], axis=1)
    quaternions, euler = _rows(told.attitude, 5), _rows(told.euler, 4)
    if not len(quaternions) and len(euler):
        quaternions = np.concatenate([euler[:, :1], quaternion_of_euler(euler[:, 1:])], axis=1)
    battery, sent = _rows([*told.battery], 2), _rows(commanded, 4)
    drift = _drift(clock, own)

    def heard(rows: list[tuple[float, Any]]) -> list[tuple[float, Any]]:
        return list(zip(drift(np.array([when for when, _ in rows])).tolist(), (what for _, what in rows), strict=True))

    return Collected(
        time_s=at(local),
        position_ned_m=local[:, 1:4],
        velocity_ned_m_s=local[:, 4:],
        attitude=Series(at(quaternions), quaternions[:, 1:]) if len(quaternions) else empty(4),
        modes=heard(told.modes),
        armed=heard(told.armed),
        messages=heard(told.messages),
        battery=Series(drift(battery[:, 0]), battery[:, 1]),
        setpoints_ned_m=Series(drift(sent[:, 0]), sent[:, 1:]),
        origin=origin,
    )


def _drift(clock: Floats, own: Floats) -> Callable[[Floats], Floats]:
    """From times of reception to the vehicle's clock: ``own`` [n] are times on it of rows (reception, told) [n, 2]."""
    if not len(clock):
        return lambda when: when
    order = np.argsort(clock[:, 0], kind="stable")
    heard, late = clock[order, 0], (clock[:, 0] - own)[order]
    knots = np.arange(heard[0], heard[-1] + _AROUND_S, _AROUND_S)
    parts = np.searchsorted(heard, np.stack([knots - _AROUND_S, knots + _AROUND_S]))
    known = parts[1] > parts[0]
    medians = [float(np.median(late[a:b])) for a, b in parts.T[known]]
    return lambda when: when - np.interp(when, knots[known], medians)


def _derived_origin(local_s: Floats, local: Floats, globe_s: Floats, globe: Floats) -> Geodetic | None:
    """The origin of the local frame, from global positions and what lies between the local ones about each."""
    if not len(local) or not len(globe):
        return None
    after = np.searchsorted(local_s, globe_s).clip(0, len(local_s) - 1)
    before = np.maximum(after - (local_s[after] > globe_s), 0)
    near = np.maximum(np.abs(local_s[after] - globe_s), np.abs(local_s[before] - globe_s)) <= _PAIR_S
    if not near.any():
        return None
    apart = np.maximum(local_s[after] - local_s[before], 1e-9)
    share = np.clip((globe_s - local_s[before]) / apart, 0.0, 1.0)[:, None]
    there = (1.0 - share) * local[before, 1:4] + share * local[after, 1:4]
    place = Geodetic(*(float(v) for v in globe[near][0, 1:4]))
    # of all of them, since each is rounded to a centimetre and a millisecond
    offset = np.median(enu_of_places(globe[near, 1:4], place) - enu_of_ned(there[near]), axis=0)
    return geodetic_of_enu(offset, place)
