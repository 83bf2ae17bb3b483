"""Messages of the vehicle to what is known of it: `Heard` in its own frames, and `Telemetry` in the world's."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.frames import Alignment, Geodetic, enu_of_ned, flu_of_frd, quaternion_enu_of_ned
from swarmsim.autopilot.link import Mode, Telemetry, Vector
from swarmsim.autopilot.mavlink.profile import Profile
from swarmsim.autopilot.mavlink.wire import Message

Quaternion = tuple[float, float, float, float]
OWN_FRAME = Alignment((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
_PREARM_CHECK = mavlink.MAV_SYS_STATUS_PREARM_CHECK
_SENSORS = {
    bit: entry.name.removeprefix("MAV_SYS_STATUS_").removeprefix("SENSOR_").replace("_", " ").lower()
    for bit, entry in mavlink.enums["MAV_SYS_STATUS_SENSOR"].items()
    if bit != _PREARM_CHECK and not entry.name.endswith(("ENUM_END", "EXTENSION_USED"))
}
_ACTING = (mavlink.MAV_STATE_CRITICAL, mavlink.MAV_STATE_EMERGENCY, mavlink.MAV_STATE_FLIGHT_TERMINATION)
_RESTART_MS = 1000


@dataclass(frozen=True)
class Heard:
    """What the vehicle told, as it told it: NED, FRD. Times of `time.monotonic`; None for what has not come."""

    heard_s: float | None = None
    pose_s: float | None = None
    position_ned_m: Vector | None = None
    velocity_ned_m_s: Vector | None = None
    place: Geodetic | None = None
    quaternion_ned: Quaternion | None = None  # w x y z, FRD to NED
    rates_frd_rad_s: Vector | None = None
    custom_mode: int | None = None
    mode: Mode = Mode.OTHER
    mode_name: str = "unknown"
    armed: bool | None = None
    failsafe: bool = False
    on_ground: bool | None = None
    battery: float | None = None
    estimator_flags: int | None = None
    estimate_ok: bool | None = None
    ready_to_arm: bool | None = None
    unhealthy: tuple[str, ...] = ()  # sensors that are switched on and not healthy
    gnss_fix: int | None = None
    satellites: int | None = None
    home_s: float | None = None
    version: str | None = None
    boot_ms: int | None = None
    restarts: int = 0


def _finite(*values: float) -> bool:
    return all(map(math.isfinite, values))


def _heartbeat(m: Message, now: float, profile: Profile, heard: Heard) -> dict[str, Any]:
    mode, name = profile.mode_of(m.custom_mode)
    return {
        "heard_s": now,
        "custom_mode": m.custom_mode,
        "mode": mode,
        "mode_name": name,
        "armed": bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED),
        "failsafe": m.system_status in _ACTING,
    }


def _local_position(m: Message, now: float, profile: Profile, heard: Heard) -> dict[str, Any]:
    if not _finite(m.x, m.y, m.z, m.vx, m.vy, m.vz):
        return {}
    return _clock(m, heard) | {
        "pose_s": now,
        "position_ned_m": (m.x, m.y, m.z),
        "velocity_ned_m_s": (m.vx, m.vy, m.vz),
    }


def _global_position(m: Message, now: float, profile: Profile, heard: Heard) -> dict[str, Any]:
    if m.lat == 0 and m.lon == 0:  # so it is told before there is a position
        return {}
    return {"place": Geodetic(m.lat * 1e-7, m.lon * 1e-7, m.alt * 1e-3)}


def _clock(m: Message, heard: Heard) -> dict[str, Any]:
    """The vehicle's time since it was switched on: where it goes back, it has restarted, and knows no place yet."""
    if heard.boot_ms is None or m.time_boot_ms + _RESTART_MS >= heard.boot_ms:
        return {"boot_ms": m.time_boot_ms}
    forgotten = {"pose_s": None, "position_ned_m": None, "velocity_ned_m_s": None, "place": None, "home_s": None}
    return {"boot_ms": m.time_boot_ms, "restarts": heard.restarts + 1, **forgotten}


def _attitude(m: Message, now: float, profile: Profile, heard: Heard) -> dict[str, Any]:
    rates = (m.rollspeed, m.pitchspeed, m.yawspeed)
    q = (m.q1, m.q2, m.q3, m.q4)
    if not _finite(*q, *rates) or not 0.9 < math.hypot(*q) < 1.1:
        return {}
    return _clock(m, heard) | {"quaternion_ned": q, "rates_frd_rad_s": rates}


def _sys_status(m: Message, now: float, profile: Profile, heard: Heard) -> dict[str, Any]:
    ill = m.onboard_control_sensors_enabled & ~m.onboard_control_sensors_health
    told: dict[str, Any] = {"unhealthy": tuple(name for bit, name in _SENSORS.items() if ill & bit)}
    if m.onboard_control_sensors_present & _PREARM_CHECK or not profile.autopilot.prearm_is_present:
        told["ready_to_arm"] = bool(m.onboard_control_sensors_health & _PREARM_CHECK)
    return told | _share(m.battery_remaining)


def _battery(m: Message, now: float, profile: Profile, heard: Heard) -> dict[str, Any]:
    return _share(m.battery_remaining) if m.id == 0 else {}


def _share(percent: int) -> dict[str, Any]:
    return {"battery": percent / 100.0} if 0 <= percent <= 100 else {}


def _landed(m: Message, now: float, profile: Profile, heard: Heard) -> dict[str, Any]:
    if m.landed_state == mavlink.MAV_LANDED_STATE_UNDEFINED:
        return {}
    return {"on_ground": m.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND}


def _gnss(m: Message, now: float, profile: Profile, heard: Heard) -> dict[str, Any]:
    satellites = m.satellites_visible if m.satellites_visible < 255 else None
    return {"gnss_fix": m.fix_type, "satellites": satellites}


def _estimator(m: Message, now: float, profile: Profile, heard: Heard) -> dict[str, Any]:
    rules = profile.autopilot.estimator
    if m.get_type() != rules.message:
        return {}
    ok = m.flags & rules.needed == rules.needed and not m.flags & rules.forbidden
    return {"estimator_flags": m.flags, "estimate_ok": ok}


def _home(m: Message, now: float, profile: Profile, heard: Heard) -> dict[str, Any]:
    return {"home_s": now}


def _version(m: Message, now: float, profile: Profile, heard: Heard) -> dict[str, Any]:
    major, minor, patch, kind = m.flight_sw_version.to_bytes(4, "big")
    names = ((255, ""), (192, "-rc"), (128, "-beta"), (64, "-alpha"), (0, "-dev"))
    return {"version": f"{major}.{minor}.{patch}" + next(name for bound, name in names if kind >= bound)}


_READERS: dict[str, Callable[[Message, float, Profile, Heard], dict[str, Any]]] = {
    "HEARTBEAT": _heartbeat,
    "LOCAL_POSITION_NED": _local_position,
    "GLOBAL_POSITION_INT": _global_position,
    "ATTITUDE_QUATERNION": _attitude,
    "SYS_STATUS": _sys_status,
    "BATTERY_STATUS": _battery,
    "EXTENDED_SYS_STATE": _landed,
    "GPS_RAW_INT": _gnss,
    "ESTIMATOR_STATUS": _estimator,
    "EKF_STATUS_REPORT": _estimator,
    "HOME_POSITION": _home,
    "AUTOPILOT_VERSION": _version,
}


def hear(heard: Heard, message: Message, profile: Profile, now: float) -> Heard:
    """What is known after ``message``; the same object where it tells nothing new or is not finite."""
    reader = _READERS.get(message.get_type())
    told = reader(message, now, profile, heard) if reader is not None else {}
    return replace(heard, **told) if told else heard


def telemetry_of(heard: Heard, alignment: Alignment | None) -> Telemetry:
    """The snapshot in the world's frame; relative to the vehicle's own origin where there is no alignment."""
    position, velocity = heard.position_ned_m, heard.velocity_ned_m_s
    rates, quaternion = heard.rates_frd_rad_s, heard.quaternion_ned
    return Telemetry(
        heard_s=heard.heard_s,
        pose_s=heard.pose_s,
        position_m=None if position is None else _tuple(*(alignment or OWN_FRAME).to_world(position)),
        velocity_m_s=None if velocity is None else _tuple(*enu_of_ned(velocity)),
        quaternion=None if quaternion is None else _quaternion(quaternion),
        angular_velocity_rad_s=None if rates is None else _tuple(*flu_of_frd(rates)),
        armed=heard.armed,
        mode=heard.mode,
        mode_name=heard.mode_name,
        on_ground=heard.on_ground,
        battery=heard.battery,
        estimate_ok=heard.estimate_ok,
        ready_to_arm=heard.ready_to_arm,
        failsafe=heard.failsafe,
        place=heard.place,
        gnss_fix=heard.gnss_fix,
    )


def _tuple(x: float, y: float, z: float) -> Vector:
    return float(x), float(y), float(z)


def _quaternion(quaternion: Quaternion) -> Quaternion:
    w, x, y, z = (float(value) for value in quaternion_enu_of_ned(quaternion))
    return w, x, y, z
