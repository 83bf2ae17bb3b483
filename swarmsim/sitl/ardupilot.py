"""ArduPilot's JSON link: the autopilot sends its servo outputs by UDP, and our physics answers with the state.

Packets as in libraries/SITL/examples/JSON/readme.md of ArduPilot; frames NED and FRD.
"""

import json
import select
import socket
import struct
import time

import numpy as np

from swarmsim.autopilot.frames import frd_of_flu, ned_of_enu, quaternion_ned_of_enu
from swarmsim.sitl.link import Array, FirmwareError, Seat, ordered
from swarmsim.sitl.plant import ACTUATORS, Sensed, Truth
from swarmsim.sitl.settings import SitlSettings

LOOPBACK = "127.0.0.1"
_HEADER = struct.Struct("<HHI")
_CHANNELS = {18458: 16, 29569: 32}  # by the magic number
_STOP_US, _NEUTRAL_US, _SPAN_US = 1000.0, 1500.0, 500.0


class ArdupilotLink:
    """The JSON link of one vehicle."""

    def __init__(self, seat: Seat, settings: SitlSettings):
        """Listen; raises `FirmwareError` where another program does already."""
        self.seat, self._settings = seat, settings
        port = settings.port + seat.number * settings.port_step
        self.address = f"udp {LOOPBACK}:{port}"
        self.actuators: Array = np.zeros(ACTUATORS)
        self.restarts = 0
        self._asker: tuple[str, int] | None = None
        self._frame = -1
        self._reply = b""
        self._heard_s = time.monotonic()
        self._wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._wire.bind((LOOPBACK, port))
        except OSError as error:
            self._wire.close()
            raise FirmwareError(
                f"port {port} for {seat.name} cannot be opened ({error.strerror}): another simulator may run already"
            ) from error
        self._wire.setblocking(False)

    def connected(self) -> bool:
        """Whether the autopilot has asked for the first time; never waits."""
        return self._asker is not None or self.hear(0.0)

    def tell(self, truth: Truth, sensed: Sensed, tick: int) -> None:
        """Answer with the state and the IMU's sensed."""
        self._reply = state_line(truth, sensed, self.seat.number)
        self._answer()

    def hear(self, timeout_s: float) -> bool:
        """Wait until it asks for the next state; a request that it repeats is answered again."""
        end = time.monotonic() + timeout_s
        while True:
            ready, _, _ = select.select([self._wire], [], [], max(0.0, end - time.monotonic()))
            if not ready:
                if self._asker is not None and time.monotonic() - self._heard_s > self._settings.lost_s:
                    raise FirmwareError(
                        f"ArduPilot of {self.seat.name} asks for no state any more: see what it printed, and start "
                        "both again"
                    )
                return False
            try:
                data, asker = self._wire.recvfrom(256)
            except OSError:  # an answer to one that is gone comes back as an error
                continue
            if self._take(data, asker):
                return True
            if time.monotonic() > end:  # others send without end
                return False

    def _take(self, data: bytes, asker: tuple[str, int]) -> bool:
        """Whether this is a new request."""
        if len(data) < _HEADER.size:
            return False
        magic, _, frame = _HEADER.unpack_from(data)
        channels = _CHANNELS.get(magic)
        if channels is None or len(data) < _HEADER.size + 2 * channels:
            return False
        self._asker, self._heard_s = asker, time.monotonic()
        if frame == self._frame:
            self._answer()
            return False
        self.restarts += frame < self._frame
        self._frame = frame
        pulses = np.array(struct.unpack_from(f"<{channels}H", data, _HEADER.size), float)
        self.actuators = ordered(self.seat, outputs_of(pulses, self.seat.flies))
        return True

    def _answer(self) -> None:
        if self._reply and self._asker is not None:
            try:
                self._wire.sendto(self._reply, self._asker)
            except OSError:  # it is gone: it is asked for again, or taken as lost
                return

    def close(self) -> None:
        """Close the link."""
        self._wire.close()


def outputs_of(pulses_us: Array, flies: bool) -> Array:
    """Outputs [n], -1 to 1, of servo pulses [n] in microseconds; a pulse of 0 is none."""
    if flies:
        return np.clip((pulses_us - _STOP_US) / (2.0 * _SPAN_US), 0.0, 1.0)
    return np.where(pulses_us > 0.0, np.clip((pulses_us - _NEUTRAL_US) / _SPAN_US, -1.0, 1.0), 0.0)


def state_line(truth: Truth, sensed: Sensed, k: int) -> bytes:
    """The answer for vehicle ``k``: a line of JSON without spaces after its separators, which ArduPilot asks for."""
    state: dict[str, object] = {
        "timestamp": truth.time_s,
        "imu": {
            "gyro": _list(frd_of_flu(sensed.gyro_rad_s[k])),
            "accel_body": _list(frd_of_flu(sensed.accel_m_s2[k])),
        },
        "position": _list(ned_of_enu(truth.position_m[k])),
        "velocity": _list(ned_of_enu(truth.velocity_m_s[k])),
        "quaternion": _list(quaternion_ned_of_enu(truth.quaternion[k])),
    }
    if np.isfinite(sensed.range_m[k]):
        state["rng_1"] = round(float(sensed.range_m[k]), 3)
    if np.isfinite(sensed.differential_pressure_pa[k]):
        pressure = max(float(sensed.differential_pressure_pa[k]), 0.0)
        state["airspeed"] = round(float(np.sqrt(2.0 * pressure / 1.225)), 3)
    return b"\n" + json.dumps(state, separators=(",", ":")).encode() + b"\n"


def _list(values: Array) -> list[float]:
    return [round(float(v), 7) for v in values]
