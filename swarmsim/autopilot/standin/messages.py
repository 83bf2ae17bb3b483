"""Telemetry of the stand-in: what each message says, and how often each is sent."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from swarmsim.autopilot.frames import (
    frd_of_flu,
    ned_of_enu,
    quaternion_ned_of_enu,
    yaw_ned_of_enu,
    yaw_of_quaternion,
)
from swarmsim.autopilot.standin.core import Autopilot

UNKNOWN_16, LIMIT_16 = 65535, 32767
EKF_GOOD = 0x33F
"""EKF_STATUS_REPORT: attitude, velocities, positions relative and absolute, height, predicted positions."""
EKF_STARTING = 0x0A7
"""The same without absolute position: 0x10 is missing."""
ESTIMATOR_GOOD, ESTIMATOR_LOST = 0x33F, 0x025
SENSORS = (
    mav.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mav.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mav.MAV_SYS_STATUS_SENSOR_GPS
    | mav.MAV_SYS_STATUS_AHRS
    | mav.MAV_SYS_STATUS_SENSOR_BATTERY
)
PREARM = mav.MAV_SYS_STATUS_PREARM_CHECK
CAPABILITIES = (
    mav.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mav.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mav.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | mav.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
    | mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)

BYTEWISE = 16
"""MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE: integer parameters travel as the bits of a float."""
INTERVAL_MAX_US = 2**31 - 1
"""What MESSAGE_INTERVAL can say."""

Build = Callable[[Autopilot], Any]


def _ms(pilot: Autopilot) -> int:
    return round(pilot.time_s * 1e3) & 0xFFFFFFFF


def _us(pilot: Autopilot) -> int:
    return round(pilot.time_s * 1e6)


def _short(value: float) -> int:
    return int(max(-LIMIT_16, min(LIMIT_16, round(value))))


def heartbeat(pilot: Autopilot) -> Any:
    """HEARTBEAT: mode, armed, state."""
    kind = mav.MAV_TYPE_QUADROTOR if pilot.flies else mav.MAV_TYPE_GROUND_ROVER
    base = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    base |= {"manual": mav.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED, "follow": mav.MAV_MODE_FLAG_GUIDED_ENABLED}.get(
        pilot.role, mav.MAV_MODE_FLAG_GUIDED_ENABLED | mav.MAV_MODE_FLAG_AUTO_ENABLED
    )
    base |= mav.MAV_MODE_FLAG_STABILIZE_ENABLED
    base |= mav.MAV_MODE_FLAG_SAFETY_ARMED if pilot.armed else 0
    state = mav.MAV_STATE_ACTIVE if pilot.armed else mav.MAV_STATE_STANDBY
    if pilot.time_s < pilot.settings.ready_s:
        state = mav.MAV_STATE_CALIBRATING
    if pilot.failsafe:
        state = mav.MAV_STATE_CRITICAL
    return mav.MAVLink_heartbeat_message(kind, pilot.type_number, base, pilot.modes[pilot.mode], state, 3)


def sys_status(pilot: Autopilot) -> Any:
    """SYS_STATUS: which sensors are well, and the pre-arm check."""
    healthy = SENSORS | PREARM | mav.MAV_SYS_STATUS_GEOFENCE  # which has not failed, used or not
    if not pilot.ready:
        healthy &= ~PREARM
    if not pilot.estimate_ok:
        healthy &= ~mav.MAV_SYS_STATUS_AHRS
    if pilot.faults.gnss_lost:
        healthy &= ~mav.MAV_SYS_STATUS_SENSOR_GPS
    volts = pilot.sensed.voltage_v
    return mav.MAVLink_sys_status_message(
        SENSORS | PREARM, SENSORS | PREARM, healthy, 300, round(volts * 1e3) if math.isfinite(volts) else UNKNOWN_16,
        -1, _percent(pilot), 0, 0, 0, 0, 0, 0,
    )  # fmt: skip


def _percent(pilot: Autopilot) -> int:
    return round(100.0 * min(1.0, max(0.0, pilot.charge)))


def battery_status(pilot: Autopilot) -> Any:
    """BATTERY_STATUS of the one battery."""
    volts = pilot.sensed.voltage_v
    cells = [round(volts * 1e3) if math.isfinite(volts) else UNKNOWN_16, *[UNKNOWN_16] * 9]
    return mav.MAVLink_battery_status_message(0, 0, 1, LIMIT_16, cells, -1, -1, -1, _percent(pilot))


def attitude(pilot: Autopilot) -> Any:
    """ATTITUDE: Euler angles and rates."""
    w, x, y, z = quaternion_ned_of_enu(pilot.sensed.quaternion)
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return mav.MAVLink_attitude_message(_ms(pilot), roll, pitch, yaw, *frd_of_flu(pilot.sensed.angular_velocity_rad_s))


def attitude_quaternion(pilot: Autopilot) -> Any:
    """ATTITUDE_QUATERNION: FRD in NED."""
    rates = frd_of_flu(pilot.sensed.angular_velocity_rad_s)
    return mav.MAVLink_attitude_quaternion_message(
        _ms(pilot), *quaternion_ned_of_enu(pilot.sensed.quaternion), *rates, [1.0, 0.0, 0.0, 0.0]
    )


def local_position(pilot: Autopilot) -> Any:
    """LOCAL_POSITION_NED, from where it was switched on; none without an estimate."""
    if not pilot.estimate_ok:
        return None
    position, velocity = pilot.local.to_local(pilot.sensed.position_m), ned_of_enu(pilot.sensed.velocity_m_s)
    return mav.MAVLink_local_position_ned_message(_ms(pilot), *map(float, position), *map(float, velocity))


def global_position(pilot: Autopilot) -> Any:
    """GLOBAL_POSITION_INT; none without an estimate."""
    if not pilot.estimate_ok:
        return None
    place, velocity = pilot.place(), ned_of_enu(pilot.sensed.velocity_m_s)
    return mav.MAVLink_global_position_int_message(
        _ms(pilot), round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7), round(place.altitude_m * 1e3),
        round((place.altitude_m - pilot.home_altitude_m) * 1e3), *(_short(v * 100.0) for v in velocity),
        _heading_cdeg(pilot),
    )  # fmt: skip


def _heading_cdeg(pilot: Autopilot) -> int:
    heading = math.degrees(yaw_ned_of_enu(yaw_of_quaternion(pilot.sensed.quaternion)))
    return round(heading * 100.0) % 36000


def gps_raw(pilot: Autopilot) -> Any:
    """GPS_RAW_INT: a 3D fix, or none."""
    place = pilot.place()
    fixed = not pilot.faults.gnss_lost
    speed = float(np.hypot(*pilot.sensed.velocity_m_s[:2]))
    return mav.MAVLink_gps_raw_int_message(
        _us(pilot), 3 if fixed else 1, round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7),
        round(place.altitude_m * 1e3), 90 if fixed else 9999, 120 if fixed else 9999, min(65534, round(speed * 100.0)),
        UNKNOWN_16, 14 if fixed else 0,
    )  # fmt: skip


def extended_sys_state(pilot: Autopilot) -> Any:
    """EXTENDED_SYS_STATE: on the ground, taking off, in the air, landing."""
    landed = mav.MAV_LANDED_STATE_ON_GROUND
    if pilot.airborne:
        landed = {"takeoff": mav.MAV_LANDED_STATE_TAKEOFF, "land": mav.MAV_LANDED_STATE_LANDING}.get(
            pilot.role, mav.MAV_LANDED_STATE_IN_AIR
        )
    return mav.MAVLink_extended_sys_state_message(mav.MAV_VTOL_STATE_UNDEFINED, landed)


def home_position(pilot: Autopilot) -> Any:
    """HOME_POSITION, known once the estimate is."""
    if pilot.time_s < pilot.settings.ready_s:
        return None
    place = pilot.origin_of(pilot.home_m)
    position = pilot.local.to_local(pilot.home_m)
    return mav.MAVLink_home_position_message(
        round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7), round(place.altitude_m * 1e3),
        *map(float, position), [1.0, 0.0, 0.0, 0.0], math.nan, math.nan, math.nan,
    )  # fmt: skip


def gps_global_origin(pilot: Autopilot) -> Any:
    """GPS_GLOBAL_ORIGIN: where the local frame begins."""
    if pilot.time_s < pilot.settings.ready_s:
        return None
    place = pilot.origin
    return mav.MAVLink_gps_global_origin_message(
        round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7), round(place.altitude_m * 1e3), _us(pilot)
    )


def estimator_status(pilot: Autopilot) -> Any:
    """ESTIMATOR_STATUS of PX4."""
    flags = ESTIMATOR_GOOD if pilot.estimate_ok else ESTIMATOR_LOST
    return mav.MAVLink_estimator_status_message(_us(pilot), flags, 0.05, 0.05, 0.05, 0.05, 0.0, 0.0, 0.3, 0.4)


def ekf_status(pilot: Autopilot) -> Any:
    """EKF_STATUS_REPORT of ArduPilot."""
    flags = EKF_GOOD if pilot.estimate_ok else EKF_STARTING
    return mav.MAVLink_ekf_status_report_message(flags, 0.05, 0.05, 0.05, 0.05, 0.0)


def autopilot_version(pilot: Autopilot) -> Any:
    """AUTOPILOT_VERSION."""
    major, minor, patch = pilot.settings.version
    number = major << 24 | minor << 16 | patch << 8 | 255
    zeros = bytes(8)
    return mav.MAVLink_autopilot_version_message(
        CAPABILITIES | (BYTEWISE if pilot.bit_patterns else 0),
        number,
        0,
        0,
        0,
        zeros,
        zeros,
        zeros,
        0,
        0,
        0x5357 << 8 | pilot.system,
    )


def system_time(pilot: Autopilot) -> Any:
    """SYSTEM_TIME; the date is not known."""
    return mav.MAVLink_system_time_message(0, _ms(pilot))


def vfr_hud(pilot: Autopilot) -> Any:
    """VFR_HUD."""
    velocity = pilot.sensed.velocity_m_s
    speed = float(np.hypot(*velocity[:2]))
    return mav.MAVLink_vfr_hud_message(
        speed, speed, _heading_cdeg(pilot) // 100, 0, pilot.place().altitude_m, float(velocity[2])
    )


COMMON: dict[str, Build] = {
    "HEARTBEAT": heartbeat,
    "SYS_STATUS": sys_status,
    "BATTERY_STATUS": battery_status,
    "ATTITUDE": attitude,
    "ATTITUDE_QUATERNION": attitude_quaternion,
    "LOCAL_POSITION_NED": local_position,
    "GLOBAL_POSITION_INT": global_position,
    "GPS_RAW_INT": gps_raw,
    "EXTENDED_SYS_STATE": extended_sys_state,
    "HOME_POSITION": home_position,
    "GPS_GLOBAL_ORIGIN": gps_global_origin,
    "AUTOPILOT_VERSION": autopilot_version,
    "SYSTEM_TIME": system_time,
    "VFR_HUD": vfr_hud,
}


class Streams:
    """Which messages are sent, and how often."""

    def __init__(self, pilot: Autopilot):
        """The streams that the autopilot sends without being asked."""
        self._pilot = pilot
        own = pilot.type_number == mav.MAV_AUTOPILOT_PX4
        estimate: dict[str, Build] = (
            {"ESTIMATOR_STATUS": estimator_status} if own else {"EKF_STATUS_REPORT": ekf_status}
        )
        self.builds = COMMON | estimate
        self._names = {getattr(mav, f"MAVLINK_MSG_ID_{name}"): name for name in self.builds}
        self._own = {name: 1.0 / hz for name, hz in pilot.settings.streams.items()}
        self._period = dict(self._own)
        self._due = dict.fromkeys(self._period, 0.0)

    def name_of(self, number: int) -> str | None:
        """Name of a message that can be sent, by its number."""
        return self._names.get(number)

    def set(self, number: int, interval_us: float) -> bool:
        """Send a message at an interval; 0 is the default rate, below that never. Whether there is such a message."""
        name = self._names.get(number)
        if name is None or not math.isfinite(interval_us):
            return False
        if interval_us < 0 or (interval_us == 0 and name not in self._own):
            self._period.pop(name, None)
        else:
            self._period[name] = min(interval_us, INTERVAL_MAX_US) * 1e-6 if interval_us > 0 else self._own[name]
            self._due[name] = self._pilot.time_s
        return True

    def interval_us(self, number: int) -> int:
        """Interval of a message, -1 where it is not sent and 0 where there is none of it."""
        name = self._names.get(number)
        if name is None:
            return 0
        period = self._period.get(name)
        return -1 if period is None else round(period * 1e6)

    def send(self, name: str) -> bool:
        """Send one message now; whether there is something to say."""
        message = self.builds[name](self._pilot)
        if message is not None:
            self._pilot.send(message)
        return message is not None

    def tick(self) -> None:
        """Send what is due."""
        now = self._pilot.time_s
        for name, period in self._period.items():
            if now + 1e-9 >= self._due[name]:
                self.send(name)
                self._due[name] = max(self._due[name] + period, now)
