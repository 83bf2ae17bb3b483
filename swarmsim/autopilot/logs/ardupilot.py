"""Flights from ArduPilot's dataflash logs (``.bin``)."""

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.frames import Geodetic, enu_of_places, ned_of_enu
from swarmsim.autopilot.logs.dataflash import Data, Messages, read_messages
from swarmsim.autopilot.logs.flight_log import Collected, FlightLog, Floats, Series, assembled, empty, profile_of
from swarmsim.autopilot.logs.rotations import quaternion_of_euler
from swarmsim.autopilot.mavlink.profile import Profile
from swarmsim.config.errors import InputError

_ESTIMATES = ("XKF1", "NKF1")  # of EKF3 and EKF2: position, velocity
_PRIMARY = {"XKF1": "XKF4", "NKF1": "NKF4"}  # where the core that is flown by is told
_ORIGIN_OF_ESTIMATE = 0  # ORGN.Type
_MOTION = ("PN", "PE", "PD", "VN", "VE", "VD")
_NUMBERS: dict[str, tuple[str, ...]] = {  # columns that a message must have to be used, beside TimeUS
    "XKF1": _MOTION,
    "NKF1": _MOTION,
    "XKF4": ("PI",),
    "NKF4": ("PI",),
    "POS": ("Lat", "Lng", "Alt"),
    "ORGN": ("Type", "Lat", "Lng", "Alt"),
    "ATT": ("Roll", "Pitch", "Yaw"),
    "MODE": ("Mode",),
    "ARM": ("ArmState",),
    "EV": ("Id",),
    "BAT": ("RemPct",),
    "PSCN": ("TPN",),
    "PSCE": ("TPE",),
    "PSCD": ("TPD",),
    "PARM": ("Value",),
    "MSG": (),
}
_TEXTS = {"PARM": ("Name",), "MSG": ("Message",)}
_ARMED, _DISARMED = 10, 11  # EV.Id, older than the message ARM
_TYPES = {"copter": mavlink.MAV_TYPE_QUADROTOR, "rover": mavlink.MAV_TYPE_GROUND_ROVER}
_SYSTEM = ("SYSID_THISMAV", "MAV_SYSID")


def read_dataflash(data: Data, system: int | None) -> FlightLog:
    """The flight in a log; raises `InputError` where it tells no position, or is not that of ``system``."""
    messages, skipped = read_messages(data, set(_NUMBERS))
    messages = {
        name: rows
        for name, rows in messages.items()
        if rows.has("TimeUS", *_NUMBERS[name]) and rows.has_texts(*_TEXTS.get(name, ()))
    }
    if not messages:
        raise InputError.of("this is no dataflash log: no message could be read")
    notes = [f"{skipped} of {len(data)} bytes are no messages: skipped"] if skipped else []
    autopilot, profile = _profile(messages)
    number = _system(messages)
    if system is not None and system != number:
        allowed = "the log does not tell its system" if number is None else f"{number} alone"
        raise InputError.of("the log has no such system", path="--system", given=str(system), allowed=allowed)
    track = _track(messages, notes)
    if track is None:
        raise InputError.of(
            "the log holds no position (messages XKF1, NKF1 or POS)",
            suggestion="the vehicle had no position fix, or LOG_BITMASK leaves positions out",
        )
    return assembled(_with_the_rest(track, messages, profile), "bin", profile, autopilot, number, notes)


def _seconds(messages: Messages) -> Floats:
    return messages.numbers("TimeUS") * 1e-6


def _profile(messages: dict[str, Messages]) -> tuple[str, Profile | None]:
    """By the name that the firmware tells when it starts."""
    texts = " ".join(messages["MSG"].texts("Message")) if "MSG" in messages else ""
    vehicle = next((v for name, v in (("Copter", "copter"), ("Rover", "rover")) if f"Ardu{name} V" in texts), None)
    vehicle = "rover" if vehicle is None and "APMrover" in texts else vehicle
    kind = mavlink.MAV_TYPE_GENERIC if vehicle is None else _TYPES[vehicle]
    return profile_of(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, kind)


def _system(messages: dict[str, Messages]) -> int | None:
    if "PARM" not in messages:
        return None
    parameters = messages["PARM"]
    values = dict(zip(parameters.texts("Name"), parameters.numbers("Value"), strict=True))
    return next((int(values[name]) for name in _SYSTEM if 1.0 <= values.get(name, 0.0) <= 255.0), None)


def _origin(messages: dict[str, Messages]) -> Geodetic | None:
    if "ORGN" not in messages:
        return None
    told = messages["ORGN"].where(messages["ORGN"].numbers("Type") == _ORIGIN_OF_ESTIMATE)
    if not len(told):
        return None
    return Geodetic(*(float(told.numbers(name)[-1]) for name in ("Lat", "Lng", "Alt")))


def _track(messages: dict[str, Messages], notes: list[str]) -> Collected | None:
    origin = _origin(messages)
    for name in _ESTIMATES:
        if name in messages:
            rows = _of_primary(messages, name)
            position, velocity = (
                np.stack([rows.numbers(f"{letter}{axis}") for axis in "NED"], axis=1) for letter in "PV"
            )
            return Collected(_seconds(rows), position, velocity, empty(4), origin=origin)
    if "POS" not in messages:
        return None
    rows = messages["POS"]
    places = np.stack([rows.numbers(name) for name in ("Lat", "Lng", "Alt")], axis=1)
    known = np.isfinite(places).all(axis=1) & (np.abs(places[:, :2]).sum(axis=1) > 0.0)  # before its first fix
    if not known.any():
        return None
    rows, places = rows.where(known), places[known]
    origin = origin or Geodetic(*(float(value) for value in places[0]))
    notes.append("the log has no messages of the state estimate (XKF1): positions are those of POS, to about 1 cm")
    position = ned_of_enu(enu_of_places(places, origin))
    return Collected(_seconds(rows), position, np.full(position.shape, np.nan), empty(4), origin=origin)


def _of_primary(messages: dict[str, Messages], name: str) -> Messages:
    """The rows of the core that the vehicle is flown by at their time."""
    rows, told = messages[name], messages.get(_PRIMARY[name])
    if not rows.has("C"):
        return rows
    if told is None:
        return rows.where(rows.numbers("C") == rows.numbers("C")[0])
    last = np.maximum(np.searchsorted(_seconds(told), _seconds(rows), "right") - 1, 0)
    return rows.where(rows.numbers("C") == told.numbers("PI")[last])


def _with_the_rest(found: Collected, messages: dict[str, Messages], profile: Profile | None) -> Collected:
    """Attitude, modes, arming, battery, words and setpoints added."""
    if "ATT" in messages:
        att = messages["ATT"]
        angles = np.radians(np.stack([att.numbers(name) for name in ("Roll", "Pitch", "Yaw")], axis=1))
        found.attitude = Series(_seconds(att), quaternion_of_euler(angles))
    if "MODE" in messages:
        modes = messages["MODE"]
        numbers = modes.numbers("ModeNum" if modes.has("ModeNum") else "Mode")
        names = [f"mode {n:g}" if profile is None or not n >= 0 else profile.mode_of(int(n))[1] for n in numbers]
        found.modes = list(zip(_seconds(modes), names, strict=True))
    if "ARM" in messages:
        arm = messages["ARM"]
        found.armed = list(zip(_seconds(arm), (arm.numbers("ArmState") == 1).tolist(), strict=True))
    if "EV" in messages:
        events = messages["EV"].where(np.isin(messages["EV"].numbers("Id"), (_ARMED, _DISARMED)))
        more = zip(_seconds(events), (events.numbers("Id") == _ARMED).tolist(), strict=True)
        found.armed = [*found.armed, *more]
    if "MSG" in messages:
        found.messages = list(zip(_seconds(messages["MSG"]), messages["MSG"].texts("Message"), strict=True))
    if "BAT" in messages:
        battery = messages["BAT"]
        battery = battery.where(battery.numbers("Inst") == 0) if battery.has("Inst") else battery
        left = battery.numbers("RemPct")
        battery = battery.where((left >= 0.0) & (left <= 100.0))  # 255 where it is not known
        found.battery = Series(_seconds(battery), battery.numbers("RemPct") / 100.0)
    found.setpoints_ned_m = _targets(messages)
    return found


def _targets(messages: dict[str, Messages]) -> Series | None:
    """Targets of the position controller, which logs its three axes at the same times."""
    rows = [messages[f"PSC{axis}"] for axis in "NED" if f"PSC{axis}" in messages]
    if len(rows) < 3:
        return None
    count = min(map(len, rows))
    values = np.stack([each.numbers(f"TP{axis}")[:count] for each, axis in zip(rows, "NED", strict=True)], axis=1)
    return Series(_seconds(rows[0])[:count], values)
