"""An AscTec Pelican over its serial interface: `PelicanVehicle`."""

import math
import time
from collections.abc import Callable
from pathlib import Path

from swarmsim.autopilot.frames import Geodetic, enu_of_geodetic, quaternion_of_euler
from swarmsim.autopilot.link import Identity, LinkError, Mode, Setpoint, Telemetry, Vector
from swarmsim.autopilot.mavlink.transport import LinkAddress, open_transport
from swarmsim.autopilot.outer_loop import Demand
from swarmsim.autopilot.pelican import packets
from swarmsim.autopilot.pelican.packets import Control, FlightMode, Gps, Imu, Status
from swarmsim.autopilot.pelican.settings import PelicanSettings
from swarmsim.autopilot.pelican.sticks import Sticks
from swarmsim.autopilot.stick_link import FOLLOWING, FRESH_S, Phase, StickLink, WireLog

_READ_S = 0.05
_LOW_M = 0.3  # above where the motors were started
_STILL_M_S = 0.1  # slower than this while it is told to descend: it stands on the ground
_ERRORS = {
    FlightMode.COMPASS_FAILURE: "its compass has failed",
    FlightMode.CALIBRATION_ERROR: "its calibration has failed",
    FlightMode.GYRO_ERROR: "its gyroscopes are not calibrated",
    FlightMode.EMERGENCY: "the remote control is not heard: the autopilot shuts serial commands out",
}


class PelicanVehicle(StickLink):
    """An AscTec Pelican; a `VehicleLink`. The vehicle is heard once it is made.

    The operator's switch for the serial interface decides who flies; switched off it is a takeover, which stops this
    side at once. The other switch selects what the sticks mean: attitude, attitude with height control, or velocity
    (GPS), and the sticks are sent for whatever it says. Landing is a descent from here, and the motors are stopped by
    the stick combination, as it has no command for either. Position and velocity are those of the autopilot's fusion
    of satellites and inertia, the height is by air pressure from where it was switched on.
    """

    def __init__(
        self, device: str, settings: PelicanSettings, *, baud: int = 57_600, log: Path | None = None,
        dry: bool = False, timeout_s: float = 10.0,
    ):  # fmt: skip
        """Open the serial ``device`` and poll; raises `LinkError` when no status comes within ``timeout_s``."""
        super().__init__(
            Identity("pelican", "copter", 1, 1), settings.loop, settings.rate_hz, settings.stale_s, dry
        )  # fmt: skip
        self.settings = settings
        self._device = device
        self._replies = packets.Replies()
        self._status: Status | None = None
        self._imu: Imu | None = None
        self._gps: Gps | None = None
        self._status_s = self._imu_s = self._gps_s = -math.inf
        self._origin: Geodetic | None = None
        self._level: tuple[float, float] | None = None  # east and north of the origin
        self._sticks = Sticks(settings)
        self._switching = False  # the motors, by the stick combination
        self._start_m: float | None = None  # height at which the motors were started
        self._ticks = 0
        self._still_s: float | None = None  # since when it has not sunk though it should
        self._log = WireLog(log)
        self._line = open_transport(LinkAddress("serial", device, baud))
        self._begin(self._read)
        try:
            self._wait_for("answer", lambda t: t.heard_s is not None, timeout_s, self._why_silent)
        except LinkError:
            self.close()
            raise

    def close(self) -> None:
        """Close the line; the sticks of the remote control then fly it."""
        super().close()
        self._line.close()
        self._log.close()

    # preflight and motors

    def preflight(self, tell: Callable[[str], None], timeout_s: float) -> None:
        """Wait until its motors can be started; raises `LinkError` with every reason when the time is up."""
        self._wait_ready(timeout_s, self._not_ready)
        status, gps = self._status, self._gps
        assert status is not None
        assert gps is not None
        tell(f"battery at {status.battery_v:.1f} V, switches at {_words(status.mode)}")
        tell(f"{gps.satellites} satellites, position known within {gps.accuracy_m:.1f} m")
        if not status.mode & FlightMode.POSITION:
            tell("with its switch at GPS the autopilot holds its place by itself when nothing comes from here")

    def arm(self, timeout_s: float) -> None:
        """Start the motors by the stick combination, confirmed by its status."""
        self._switch_motors("start its motors", True, timeout_s)

    def disarm(self, timeout_s: float) -> None:
        """Stop the motors by the stick combination; on the ground only. Raises `LinkError` where it flies."""
        t = self._telemetry
        if t.armed and t.on_ground is False:
            raise LinkError("it is in the air: its motors are stopped on the ground only; land it first")
        self._switch_motors("stop its motors", False, timeout_s)

    def _switch_motors(self, what: str, on: bool, timeout_s: float) -> None:
        """Hold the combination until the status tells it: held on it would switch them again."""
        if self.dry:
            self._note(f"dry run: {what} was not sent")
            return
        if self._telemetry.armed is on:
            return
        if not on:
            self._set_phase(Phase.READY)
        with self._lock:
            self._switching = True
        try:
            held = min(timeout_s, self.settings.motors_s)
            self._wait_for(what, lambda t: t.armed is on, held, self._why_not_follow)
        finally:
            with self._lock:
                self._switching = False

    # what is known

    def _why_silent(self) -> str | None:
        if self._status is not None:
            return None
        bad = f" ({self._replies.bad} broken structures came)" if self._replies.bad else ""
        return f"no status comes from {self._device}{bad}: check the line, its baud rate and that the vehicle is on"

    def _why_not_follow(self) -> str | None:
        status = self._status
        if status is None or time.monotonic() - self._status_s > FRESH_S:
            return "it sends no status"
        errors = [text for bit, text in _ERRORS.items() if status.mode & bit]
        if not status.mode & FlightMode.SERIAL_ENABLED:
            errors.append("the serial interface is off: the operator has to switch it on at the remote control")
        return "; ".join(errors) or None

    def _not_ready(self) -> str | None:
        reasons = [r for r in (self._why_not_follow(), self._no_place()) if r]
        charge, least = self._charge(), self.settings.battery_min
        if charge is not None and charge < least:
            reasons.append(f"its battery is at {100 * charge:.0f} %, battery_min is {100 * least:.0f} %")
        return "; ".join(reasons) or None

    def _no_place(self) -> str | None:
        gps, limit = self._gps, self.settings.accuracy_max_m
        if gps is None or self._imu is None or time.monotonic() - min(self._gps_s, self._imu_s) > FRESH_S:
            return "it sends no position"
        if not gps.locked:
            return f"it has no position by satellites yet ({gps.satellites} in use)"
        if gps.accuracy_m > limit:
            return f"its position is known within {gps.accuracy_m:.1f} m, accuracy_max_m is {limit:g}"
        return None

    def _charge(self) -> float | None:
        if self._status is None:
            return None
        b = self.settings.battery
        return max(0.0, min(1.0, (self._status.battery_v - b.empty_v) / (b.full_v - b.empty_v)))

    def _yaw_rad(self, imu: Imu) -> float:
        return 0.5 * math.pi - math.radians(imu.heading_deg + self.settings.declination_deg)

    def _snapshot(self) -> Telemetry:
        status, imu, gps = self._status, self._imu, self._gps
        if status is None:
            return Telemetry()
        mode, name = self._mode(status)
        position: Vector | None = None
        velocity: Vector | None = None
        attitude = None
        if imu is not None:
            signs = self.settings.signs
            roll, pitch = (math.radians(a) for a in (signs.roll_angle * imu.roll_deg, signs.nick_angle * imu.nick_deg))
            attitude = quaternion_of_euler(roll, pitch, self._yaw_rad(imu))
            if gps is not None and self._level is not None:
                position, velocity = (*self._level, imu.height_m), (gps.east_m_s, gps.north_m_s, imu.climb_m_s)
        return Telemetry(
            heard_s=self._status_s,
            pose_s=None if position is None else min(self._gps_s, self._imu_s),
            position_m=position,
            velocity_m_s=velocity,
            quaternion=attitude,
            armed=status.motors_on,
            mode=mode,
            mode_name=name,
            on_ground=not status.motors_on or self._is_low(),
            battery=self._charge(),
            estimate_ok=self._no_place() is None and not status.mode & FlightMode.COMPASS_FAILURE,
            ready_to_arm=self._not_ready() is None,
            failsafe=bool(status.mode & FlightMode.EMERGENCY),
            gnss_fix=None if gps is None else 3 if gps.locked else 1,
        )

    def _is_low(self) -> bool | None:
        """Whether it is about as high as when its motors started; None where it is not known."""
        if self._imu is None or self._start_m is None:
            return None
        return self._imu.height_m - self._start_m < _LOW_M

    def _mode(self, status: Status) -> tuple[Mode, str]:
        name = _words(status.mode)
        if not status.mode & FlightMode.SERIAL_ENABLED:
            return Mode.OTHER, name
        if self._phase in FOLLOWING:
            return Mode.FOLLOW, name
        return {Phase.HOLD: Mode.HOLD, Phase.LAND: Mode.LAND}.get(self._phase, Mode.OTHER), name

    # the line

    def _read(self) -> None:
        while not self._over.is_set():
            data, _ = self._line.read(_READ_S)
            if data:
                self._log.note("<", data)
                for packet in self._replies.feed(data):
                    self._hear(packet)

    def _hear(self, packet: packets.Packet) -> None:
        now = time.monotonic()
        with self._lock:
            if isinstance(packet, Status):
                if packet.motors_on and self._imu is not None and self._status and not self._status.motors_on:
                    self._start_m = self._imu.height_m
                self._status, self._status_s = packet, now
                if not packet.mode & FlightMode.SERIAL_ENABLED:
                    lost = bool(packet.mode & FlightMode.EMERGENCY)
                    self._release(
                        _ERRORS[FlightMode.EMERGENCY] if lost else "the operator switched the serial interface off"
                    )
                    self._switching = False
            elif isinstance(packet, Imu):
                self._imu, self._imu_s = packet, now
            else:
                self._gps, self._gps_s = packet, now
                if packet.locked:
                    place = Geodetic(packet.latitude_deg, packet.longitude_deg, 0.0)
                    self._origin = self._origin or place
                    east, north, _ = enu_of_geodetic(place, self._origin)
                    self._level = float(east), float(north)
        self._refresh()

    def _tick(self, now_s: float, dt_s: float) -> None:
        wanted = packets.POLL_IMU
        if self._ticks % self.settings.poll_every == 0:
            wanted |= packets.POLL_STATUS | packets.POLL_GPS
        self._ticks += 1
        self._write(packets.encode_poll(wanted))
        with self._lock:  # until it is written: a takeover that is seen meanwhile would be followed by a command
            command = self._command(now_s, dt_s)
            if command is not None and not self.dry:
                self._write(packets.encode_control(command))

    def _command(self, now_s: float, dt_s: float) -> Control | None:
        """The sticks of this period; None where the remote control has them."""
        with self._lock:
            status, phase, armed = self._status, self._phase, self._telemetry.armed
            if status is None:
                return None
            if self._switching:
                return Control(yaw=self.settings.motors, ctrl=packets.YAW | packets.THRUST)
            if phase is Phase.RELEASED:
                return None
            if phase is Phase.READY or not armed:
                self._sticks.reset()
                if phase is Phase.LAND:
                    self._phase, self._goal = Phase.RELEASED, None
                return Control(ctrl=packets.YAW | packets.THRUST)
            if phase is Phase.LAND:
                landing = self._landing(now_s)
                if landing is not None:
                    return landing
            found = self._demand(now_s, dt_s) or self._hovering(now_s, dt_s)
            climb = 0.0 if self._imu is None else self._imu.climb_m_s
            return self._sticks.of(*found, climb, status.mode, dt_s)

    def _hovering(self, now_s: float, dt_s: float) -> tuple[Demand, float]:
        """Hold the place where it is from now on, or descend there to land; level where the place is not known."""
        t = self._telemetry
        sink = -self.settings.land_m_s if self._phase is Phase.LAND else 0.0
        if t.position_m is not None:
            place = t.position_m if sink == 0.0 else None
            self._goal = math.inf, Setpoint(position_m=place, velocity_m_s=(0.0, 0.0, sink))
        return self._demand(now_s, dt_s) or (Demand((0.0, 0.0, sink), (0.0, 0.0), 0.0), 0.0)

    def _landing(self, now_s: float) -> Control | None:
        """The stick combination once it has stood still for long enough under a command to sink."""
        imu = self._imu
        if imu is None or abs(imu.climb_m_s) > _STILL_M_S or self._goal is None:
            self._still_s = None
            return None
        self._still_s = self._still_s or now_s
        if now_s - self._still_s < self.settings.landed_s:
            return None
        return Control(yaw=self.settings.motors, ctrl=packets.YAW | packets.THRUST)

    def _write(self, data: bytes) -> None:
        if self._line.write(data, None):
            self._log.note(">", data)


def _words(mode: FlightMode) -> str:
    held = "GPS" if mode & FlightMode.POSITION else "HEIGHT" if mode & FlightMode.HEIGHT else "ATTITUDE"
    flags = (FlightMode.SERIAL_ENABLED, "SERIAL"), (FlightMode.EMERGENCY, "EMERGENCY")
    return "+".join([held, *(name for bit, name in flags if mode & bit)])
