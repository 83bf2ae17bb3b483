"""Flights from PX4's logs (``.ulg``), read with pyulog."""

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pyulog import ULog

from swarmsim.autopilot.frames import Geodetic, enu_of_ned, moved_origin, ned_of_enu
from swarmsim.autopilot.logs.flight_log import Collected, FlightLog, Floats, Series, assembled, empty, profile_of
from swarmsim.autopilot.mavlink.profile import Profile
from swarmsim.config.errors import InputError

MAGIC = ULog.HEADER_BYTES
_TOPICS = [
    "vehicle_local_position",
    "vehicle_attitude",
    "vehicle_status",
    "battery_status",
    "trajectory_setpoint",
]
_FIELDS_MAX = 5000  # of a topic, arrays counted in full; those of PX4 have fewer than 300
_WHOLE_MAX = 2.0**31
_DEPTH_MAX = 10  # of topics in topics
_HEADER_BYTES = 3  # of a message
_ARMED = 2  # vehicle_status.arming_state

Topic = dict[str, Any]
"""Columns of a topic by name, arrays [n]."""


class _Kept(io.BufferedReader):
    """A file that remembers how far it was read when pyulog closes it."""

    def __init__(self, path: Path):
        super().__init__(io.FileIO(path))
        self.read_to = 0
        self.cut = False  # the last message is not whole

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        asked = -1 if size is None else size
        self.cut = len(data) < asked and (asked != _HEADER_BYTES or len(data) > 0)
        return data

    def close(self) -> None:
        if not self.closed:
            self.read_to = self.tell()
        super().close()


def read_ulog(path: Path, size: int, system: int | None) -> FlightLog:
    """The flight in a log of ``size`` bytes; raises `InputError` where it has no position, or is not of ``system``."""
    log, file = _loaded(path)
    topics: dict[str, Topic] = {}
    for data in reversed(log.data_list):  # of several estimators or batteries the first
        topics[data.name] = data.data
    status = topics.get("vehicle_status", {})
    number = _whole(status["system_id"][-1:])[0] if "system_id" in status else None
    if system is not None and system != number:
        allowed = "the log does not tell its system" if number is None else f"{number} alone"
        raise InputError.of("the log has no such system", path="--system", given=str(system), allowed=allowed)
    kind = _whole(status["system_type"][-1:])[0] if "system_type" in status else mavlink.MAV_TYPE_GENERIC
    autopilot, profile = profile_of(mavlink.MAV_AUTOPILOT_PX4, kind)
    track = _track(topics.get("vehicle_local_position", {}))
    if track is None:
        raise InputError.of(
            "the log holds no position (topic vehicle_local_position)",
            suggestion="the vehicle had no position estimate, or SDLOG_PROFILE leaves it out",
        )
    notes = []
    if file.read_to < size:
        notes.append(f"the log is damaged: {size - file.read_to} of {size} bytes at its end were not read")
    elif file.cut:
        notes.append("the log breaks off in the middle of a message")
    if log.file_corruption:
        notes.append("parts of the log are damaged: left out")
    lost = sum(dropout.duration for dropout in log.dropouts)
    if lost:
        notes.append(f"the vehicle could not write its log for {lost / 1e3:.1f} s in all")
    _add(track, topics, log, profile)
    return assembled(track, "ulg", profile, autopilot, number, notes)


def _loaded(path: Path) -> tuple[ULog, _Kept]:
    """The log, and the file as it was left. pyulog prints what it finds damaged."""
    try:
        with contextlib.redirect_stdout(io.StringIO()), _Kept(path) as head, _Kept(path) as whole:
            _check_formats(ULog(head, parse_header_only=True))
            log = ULog(whole, _TOPICS)
    except (InputError, OSError):
        raise
    except Exception as error:  # whatever hostile bytes do to pyulog, it is a file that cannot be read
        raise InputError.of(f"this PX4 log cannot be read ({error})") from error
    return log, whole


def _check_formats(header: ULog) -> None:
    """Raise `InputError` for topics so large, or nested in themselves, that reading them would never end."""
    sizes: dict[str, int] = {}

    def size_of(name: str, depth: int) -> int:
        if depth > _DEPTH_MAX or name not in header.message_formats:
            return _FIELDS_MAX + 1 if depth > _DEPTH_MAX else 1
        if name not in sizes:
            fields = header.message_formats[name].fields
            size = sum(max(1, count) * size_of(kind, depth + 1) for kind, count, _ in fields)
            sizes[name] = min(size, _FIELDS_MAX + 1)
        return sizes[name]

    for name in header.message_formats:
        if size_of(name, 0) > _FIELDS_MAX:
            raise InputError.of(f"this log cannot be read: its topic {name[:60]} has no end")


def _seconds(topic: Topic) -> Floats:
    return np.asarray(topic["timestamp"], np.float64) * 1e-6


def _whole(values: Any) -> list[int]:
    """Whole numbers; -1 where a damaged log has none."""
    numbers = np.asarray(values, np.float64)
    return [int(v) for v in np.where(np.abs(numbers) < _WHOLE_MAX, numbers, -1.0)]


def _vectors(topic: Topic, *names: str) -> Floats:
    return np.stack([np.asarray(topic[name], np.float64) for name in names], axis=1)


def _has(topic: Topic, *names: str) -> bool:
    return set(names) <= set(topic)


def _track(topic: Topic) -> Collected | None:
    """Positions that the estimator holds for valid, about the last origin."""
    if not _has(topic, "timestamp", "x", "y", "z", "vx", "vy", "vz"):
        return None
    valid = np.ones(len(topic["timestamp"]), bool)
    for name in ("xy_valid", "z_valid"):
        if name in topic:
            valid &= np.asarray(topic[name]) == 1
    if not valid.any():
        return None
    position, origin = _vectors(topic, "x", "y", "z"), None
    position[~(valid & np.isfinite(position).all(axis=1))] = np.nan
    if _has(topic, "ref_lat", "ref_lon", "ref_alt"):
        places = _vectors(topic, "ref_lat", "ref_lon", "ref_alt")
        known = np.isfinite(places).all(axis=1) & (np.abs(places[:, :2]).sum(axis=1) > 0.0)
        if known.any():
            origin = Geodetic(*(float(v) for v in places[known][-1]))
            for place in np.unique(places[known], axis=0)[:100]:
                rows = known & (places == place).all(axis=1)
                before = Geodetic(*(float(v) for v in place))
                position[rows] = ned_of_enu(moved_origin(enu_of_ned(position[rows]), before, origin))
    return Collected(_seconds(topic), position, _vectors(topic, "vx", "vy", "vz"), empty(4), origin=origin)


def _add(found: Collected, topics: dict[str, Topic], log: ULog, profile: Profile | None) -> None:
    """Attitude, modes, arming, battery, words and setpoints."""
    attitude = topics.get("vehicle_attitude", {})
    if _has(attitude, "timestamp", "q[0]", "q[1]", "q[2]", "q[3]"):
        found.attitude = Series(_seconds(attitude), _vectors(attitude, "q[0]", "q[1]", "q[2]", "q[3]"))
    status = topics.get("vehicle_status", {})
    if _has(status, "timestamp", "nav_state"):
        names = {} if profile is None else profile.autopilot.nav_states
        modes = [names.get(n, f"nav_state {n}") for n in _whole(status["nav_state"])]
        found.modes = list(zip(_seconds(status), modes, strict=True))
    if _has(status, "timestamp", "arming_state"):
        found.armed = list(zip(_seconds(status), (status["arming_state"] == _ARMED).tolist(), strict=True))
    battery = topics.get("battery_status", {})
    if _has(battery, "timestamp", "remaining"):
        share = np.asarray(battery["remaining"], np.float64)
        known = (share >= 0.0) & (share <= 1.0)
        found.battery = Series(_seconds(battery)[known], share[known])
    wanted = topics.get("trajectory_setpoint", {})
    columns = ("position[0]", "position[1]", "position[2]")
    if _has(wanted, "timestamp", *columns):
        found.setpoints_ned_m = Series(_seconds(wanted), _vectors(wanted, *columns))
    found.messages = [(m.timestamp * 1e-6, m.message.strip()) for m in log.logged_messages]
