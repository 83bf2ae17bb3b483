"""PX4's HIL link: our physics is the TCP server, sends HIL_SENSOR, and waits for HIL_ACTUATOR_CONTROLS.

Messages as in MAVLink's common.xml, frames NED and FRD; what PX4 makes of them was seen on PX4 1.17 in software.
"""

import contextlib
import math
import select
import socket
import time

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.frames import frd_of_flu, ned_of_enu, quaternion_ned_of_enu
from swarmsim.autopilot.mavlink.wire import Message, Protocol
from swarmsim.sitl.link import Array, FirmwareError, Seat, ordered, place_of
from swarmsim.sitl.plant import ACTUATORS, Sensed, Truth
from swarmsim.sitl.settings import SitlSettings

LOOPBACK = "127.0.0.1"
SYSTEM, COMPONENT = 1, 51
_IMU, _MAGNETOMETER, _BAROMETER, _AIRSPEED = (
    0x3F,
    0x1C0,
    0x1A00,
    0x400,
)  # bits of fields_updated: pressure, height, temperature
_UNKNOWN = 65535
_TESLA_TO_GAUSS = 1e4
_CELSIUS_K = 273.15
_START_US = 1_000_000  # PX4 takes a time of zero for none


class Px4Link:
    """The HIL link of one vehicle."""

    def __init__(self, seat: Seat, settings: SitlSettings):
        """Listen; raises `FirmwareError` where another program does already."""
        self.seat, self._settings = seat, settings
        port = settings.port + seat.number * settings.port_step
        self.address = f"tcp {LOOPBACK}:{port}"
        self.actuators: Array = np.zeros(ACTUATORS)
        self.restarts = 0  # its link does not outlast PX4: one that begins anew ends the session
        self.armed = False
        self._protocol = Protocol(SYSTEM, COMPONENT)
        self._told_us = 0
        self._wire: socket.socket | None = None
        self._every = max(1, round(1.0 / (settings.state_hz * settings.period_s)))
        self._server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._server.bind((LOOPBACK, port))
        except OSError as error:
            self._server.close()
            raise FirmwareError(
                f"port {port} for {seat.name} cannot be opened ({error.strerror}): another simulator may run already"
            ) from error
        self._server.listen(1)
        self._server.setblocking(False)

    def connected(self) -> bool:
        """Whether PX4 has connected; never waits."""
        if self._wire is None:
            with contextlib.suppress(BlockingIOError):
                self._wire, _ = self._server.accept()
                self._wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._wire.settimeout(self._settings.lost_s)
        return self._wire is not None

    def tell(self, truth: Truth, sensed: Sensed, tick: int) -> None:
        """Send HIL_SENSOR, and HIL_GPS and HIL_STATE_QUATERNION when they are due."""
        k = self.seat.number
        time_us = _START_US + round(truth.time_s * 1e6)
        messages = [hil_sensor(sensed, k, time_us)]
        if sensed.gnss_fresh[k]:
            messages.append(hil_gps(self.seat, sensed, k, time_us, self._settings.satellites))
        if sensed.rangefinder_fresh[k]:
            messages.append(distance_sensor(sensed, k, time_us))
        if tick % self._every == 0:
            messages.append(hil_state(self.seat, truth, k, time_us))
        self._told_us = time_us
        assert self._wire is not None
        try:
            self._wire.sendall(b"".join(self._protocol.bytes_of(m) for m in messages))
        except OSError as error:
            raise self._ended() from error

    def hear(self, timeout_s: float) -> bool:
        """Wait for the HIL_ACTUATOR_CONTROLS of the time that was told last."""
        assert self._wire is not None
        end = time.monotonic() + timeout_s
        while True:
            ready, _, _ = select.select([self._wire], [], [], max(0.0, end - time.monotonic()))
            if not ready:
                return False
            try:
                data = self._wire.recv(65536)
            except OSError as error:
                raise self._ended() from error
            if not data:
                raise self._ended()
            if self._take(self._protocol.messages_of(data, datagram=False)[0]):
                return True
            if time.monotonic() > end:  # it talks without end, and does not answer
                return False

    def _take(self, messages: list[Message]) -> bool:
        """Whether the answer was among them; an earlier one is taken over too, but it is none to what was told last."""
        answered = False
        for message in messages:
            if message.get_type() != "HIL_ACTUATOR_CONTROLS":
                continue
            self.armed = bool(message.mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            outputs = np.asarray(message.controls) if self.armed else np.zeros(len(message.controls))
            self.actuators = ordered(self.seat, np.clip(np.nan_to_num(outputs), -1.0, 1.0))
            answered = answered or message.time_usec >= self._told_us
        return answered

    def close(self) -> None:
        """Close the link."""
        for wire in (self._wire, self._server):
            if wire is not None:
                wire.close()

    def _ended(self) -> FirmwareError:
        return FirmwareError(f"PX4 of {self.seat.name} has closed its link: see what it printed, and start both again")


def hil_sensor(sensed: Sensed, k: int, time_us: int) -> Message:
    """HIL_SENSOR of what vehicle ``k`` of ``sensed`` [K, ...] has read."""
    force, rate = frd_of_flu(sensed.accel_m_s2[k]), frd_of_flu(sensed.gyro_rad_s[k])
    fields = _IMU
    field = _TESLA_TO_GAUSS * frd_of_flu(sensed.magnetic_field_t[k])
    pressure, celsius = sensed.pressure_pa[k], sensed.temperature_k[k] - _CELSIUS_K
    difference = sensed.differential_pressure_pa[k]
    if sensed.magnetometer_fresh[k]:
        fields |= _MAGNETOMETER
    if sensed.barometer_fresh[k]:
        fields |= _BAROMETER
    if sensed.airspeed_fresh[k]:
        fields |= _AIRSPEED
    height = pressure_height_m(pressure)
    numbers = (*force, *rate, *field, pressure / 100.0, difference / 100.0, height, celsius)
    return mavlink.MAVLink_hil_sensor_message(time_us, *map(_told, numbers), fields)


def hil_gps(seat: Seat, sensed: Sensed, k: int, time_us: int, satellites: int) -> Message:
    """HIL_GPS of the receiver's latest message."""
    place = place_of(seat, sensed.gnss_position_m[k])
    north, east, down = 100.0 * ned_of_enu(sensed.gnss_velocity_m_s[k])
    course = math.degrees(math.atan2(east, north)) % 360.0
    eph, epv = (min(100.0 * float(e[k]), _UNKNOWN - 1.0) for e in (sensed.gnss_eph_m, sensed.gnss_epv_m))
    return mavlink.MAVLink_hil_gps_message(
        time_us, int(sensed.gnss_fix[k]), round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7),
        round(place.altitude_m * 1e3), round(eph), round(epv), round(math.hypot(north, east)), _short(north),
        _short(east), _short(down), round(100.0 * course) % 36000, satellites,
    )  # fmt: skip


def distance_sensor(sensed: Sensed, k: int, time_us: int) -> Message:
    """DISTANCE_SENSOR of a rangefinder that looks down; 0 is no valid distance."""
    distance = round(100.0 * float(sensed.range_m[k])) if sensed.range_valid[k] else 0
    down = mavlink.MAV_SENSOR_ROTATION_PITCH_270
    return mavlink.MAVLink_distance_sensor_message(
        time_us // 1000, 5, _UNKNOWN - 1, distance, mavlink.MAV_DISTANCE_SENSOR_LASER, 0, down, 255
    )


def hil_state(seat: Seat, truth: Truth, k: int, time_us: int) -> Message:
    """HIL_STATE_QUATERNION: the truth, which PX4 logs beside its estimate."""
    place = place_of(seat, truth.position_m[k])
    velocity = 100.0 * ned_of_enu(truth.velocity_m_s[k])
    force = 1000.0 / 9.80665 * frd_of_flu(truth.specific_force_m_s2[k])
    airspeed = round(min(100.0 * float(np.linalg.norm(truth.air_velocity_m_s[k])), _UNKNOWN))
    return mavlink.MAVLink_hil_state_quaternion_message(
        time_us, quaternion_ned_of_enu(truth.quaternion[k]).tolist(),
        *map(float, frd_of_flu(truth.angular_velocity_rad_s[k])), round(place.latitude_deg * 1e7),
        round(place.longitude_deg * 1e7), round(place.altitude_m * 1e3), *map(_short, velocity), airspeed, airspeed,
        *map(_short, force),
    )  # fmt: skip


def pressure_height_m(pressure_pa: float) -> float:
    """Pressure altitude in the standard atmosphere (ICAO Doc 7488): 44330.77 (1 - (p / 101325)^0.190263)."""
    return 44330.77 * (1.0 - (max(float(pressure_pa), 1.0) / 101_325.0) ** 0.190263)


def _told(value: float) -> float:
    return float(value) if math.isfinite(value) else 0.0  # of a sensor that is absent: its bit says so


def _short(value: float) -> int:
    return int(np.clip(round(float(value)), -32768, 32767))
