"""A stand-in for an AscTec Pelican: the serial interface of its low-level processor, on a pseudo-terminal.

Sources as in `swarmsim.autopilot.pelican.packets`. It has no waypoints, no camera, and no structures but those that are
polled here; the speed of the line is not reproduced.
"""

import contextlib
import math
import os
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from swarmsim.autopilot.frames import Geodetic, geodetic_of_enu, yaw_of_quaternion
from swarmsim.autopilot.outer_loop import GRAVITY_M_S2
from swarmsim.autopilot.pelican import packets
from swarmsim.autopilot.pelican.packets import STICK_MAX, THRUST_MAX, Control, FlightMode, Gps, Imu, Status
from swarmsim.autopilot.pelican.settings import Battery
from swarmsim.autopilot.standin.body import Body, Motion, Sensed
from swarmsim.autopilot.standin.tilting import Sticks, StickSettings, StickStandin
from swarmsim.config.autopilot import Origin
from swarmsim.config.base import Duration, Fraction, Length, NonNegative, Positive, Speed
from swarmsim.config.errors import InputError

_READ_BYTES = 4096
_MODES = {
    "attitude": FlightMode.ATTITUDE,
    "height": FlightMode.ATTITUDE | FlightMode.HEIGHT,
    "gps": FlightMode.ATTITUDE | FlightMode.HEIGHT | FlightMode.POSITION,
}


class PelicanStandinSettings(StickSettings):
    """The stand-in of a Pelican: ``configs/autopilots/standin_pelican.yaml``."""

    origin: Origin
    battery: Battery
    timeout_s: Duration
    motors_s: Duration
    tilt_deg: Positive
    turn_deg_s: Positive
    speed_m_s: Speed
    climb_m_s: Speed
    hover_thrust: Fraction
    sink_1_s: NonNegative
    accuracy_m: Length
    satellites: int = Field(ge=0, le=64)


@dataclass
class PelicanFaults:
    """What goes wrong; a test sets its fields."""

    silent: bool = False  # polls are not answered
    corrupt: bool = False  # every structure has a wrong checksum
    no_satellites: bool = False
    motors_stuck: bool = False  # the motors cannot be switched by the sticks


class PelicanStandin(StickStandin):
    """The vehicle; it answers at one end of a pseudo-terminal, whose other end is ``address``."""

    def __init__(self, body: Body, settings: PelicanStandinSettings, switch: str = "gps", speed: float = 1.0):
        """``switch`` is the position of the mode switch: attitude, height or gps."""
        super().__init__(body, settings, speed)
        self.settings, self.faults = settings, PelicanFaults()
        self.switch = switch
        self.serial_enabled = True
        """The operator's switch for the serial interface."""
        self.remote_lost = False
        self.motors_on = False
        self.battery_v: float | None = None
        """Overrides the voltage of the body's charge."""
        self._requests = packets.Requests()
        self._control: Control | None = None
        self._heard_s = -math.inf
        self._combined_s = 0.0  # for how long the stick combination has been held
        self._climb_m_s = 0.0  # in attitude mode
        self._start_m = body.sensed.position_m.copy()
        origin = settings.origin
        self._origin = Geodetic(origin.latitude_deg, origin.longitude_deg, origin.altitude_m)
        try:
            import tty

            self._line, self._other = os.openpty()
            tty.setraw(self._other)
            os.set_blocking(self._line, False)
        except (ImportError, OSError) as error:
            raise InputError.of(
                f"there are no pseudo-terminals on this system ({error})", path="--autopilot"
            ) from error
        self.address = f"pelican:{os.ttyname(self._other)}"

    def close(self) -> None:
        """Close the pseudo-terminal."""
        os.close(self._line)
        os.close(self._other)

    @property
    def flight_mode(self) -> FlightMode:
        """The bits of its status."""
        mode = _MODES[self.switch]
        if self.remote_lost:
            return mode | FlightMode.EMERGENCY
        if self.serial_enabled:
            mode |= FlightMode.SERIAL_ENABLED
            if self._fresh():
                mode |= FlightMode.SERIAL_ACTIVE
        return mode

    @property
    def mode(self) -> str:
        """Switches, in words."""
        return self.switch + (", serial" if self.flight_mode & FlightMode.SERIAL_ENABLED else ", remote control")

    @property
    def armed(self) -> bool:
        """Whether its motors run."""
        return self.motors_on

    @property
    def bad(self) -> int:
        """Commands with a wrong checksum."""
        return self._requests.bad

    def _fresh(self) -> bool:
        return self.time_s - self._heard_s <= self.settings.timeout_s

    # the line

    def receive(self) -> None:
        """Take what has come: commands are acknowledged, polls answered."""
        data = b""
        with contextlib.suppress(OSError):  # nothing has come
            data = os.read(self._line, _READ_BYTES)
        for request in self._requests.feed(data):
            if isinstance(request, Control):
                if self.flight_mode & FlightMode.SERIAL_ENABLED:
                    self._control, self._heard_s = request, self.time_s
                    self._write(packets.acknowledgement(packets.CTRL_INPUT))
            else:
                self._answer(request.packets)

    def _answer(self, wanted: int) -> None:
        if self.faults.silent:
            return
        for bit, make in (
            (packets.POLL_STATUS, self.status),
            (packets.POLL_IMU, self.imu),
            (packets.POLL_GPS, self.gps),
        ):
            if wanted & bit:
                data = packets.encode(make())
                self._write(data[:-5] + b"\0\0" + data[-3:] if self.faults.corrupt else data)

    def _write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody reads, and the buffer is full
            os.write(self._line, data)

    def tell(self) -> None:
        """Nothing: it speaks when it is polled."""

    def status(self) -> Status:
        """LL_STATUS."""
        b = self.settings.battery
        voltage = b.empty_v + (b.full_v - b.empty_v) * float(np.clip(self.body.sensed.charge, 0.0, 1.0))
        return Status(voltage if self.battery_v is None else self.battery_v, self.motors_on, self.flight_mode)

    def imu(self) -> Imu:
        """IMU_CALCDATA; angles as forward-right-down has them."""
        forward, left = (math.degrees(a) for a in self.tilting.tilt_rad)
        heading = 90.0 - math.degrees(yaw_of_quaternion(self.body.sensed.quaternion))
        sensed = self.body.sensed
        height = float(sensed.position_m[2] - self._start_m[2])
        return Imu(-forward, -left, heading % 360.0, height, float(sensed.velocity_m_s[2]))

    def gps(self) -> Gps:
        """GPS_DATA_ADVANCED."""
        s, sensed = self.settings, self.body.sensed
        place = geodetic_of_enu(sensed.position_m, self._origin)
        east, north = (float(v) for v in sensed.velocity_m_s[:2])
        locked = not self.faults.no_satellites
        satellites = s.satellites if locked else 0
        return Gps(place.latitude_deg, place.longitude_deg, east, north, s.accuracy_m, satellites, locked)

    # the controller

    def command(self, sensed: Sensed, dt: float) -> Motion:
        """The motion by the serial sticks where they are on and fresh, else by a remote control that is let go."""
        control = self._control if self._control is not None and self._fresh() and self._serial() else None
        self._switch_motors(control, dt)
        if not self.motors_on:
            self._climb_m_s = 0.0
            return self.tilting.stand()
        s = self.settings
        pitch, roll, yaw, thrust = self._axes(control)
        turn = -math.radians(yaw * s.turn_deg_s)
        if self.switch == "attitude":
            forward, left = (math.radians(x * s.tilt_deg) for x in (pitch, -roll))
            lift = GRAVITY_M_S2 * thrust / (s.hover_thrust * THRUST_MAX) * math.cos(forward) * math.cos(left)
            self._climb_m_s += dt * (lift - GRAVITY_M_S2 - s.sink_1_s * self._climb_m_s)
            climb = self._climb_m_s
        else:
            climb = s.climb_m_s * (thrust - STICK_MAX) / STICK_MAX
        if sensed.landed and climb <= 0.0:
            self._climb_m_s = 0.0
            return self.tilting.stand()
        if self.switch == "gps":
            speed = s.speed_m_s / STICK_MAX
            return self.tilting.move(pitch * speed, -roll * speed, climb, turn, dt)
        forward, left = (math.radians(x * s.tilt_deg) for x in (pitch, -roll))
        return self.tilting.fly(Sticks(forward, left, climb, turn), dt)

    def _serial(self) -> bool:
        return bool(self.flight_mode & FlightMode.SERIAL_ENABLED)

    def _axes(self, control: Control | None) -> tuple[int, int, int, int]:
        hover = STICK_MAX if self.switch != "attitude" else round(self.settings.hover_thrust * THRUST_MAX)
        given = Control(ctrl=0) if control is None else control
        return (
            given.pitch if given.ctrl & packets.PITCH else 0,
            given.roll if given.ctrl & packets.ROLL else 0,
            given.yaw if given.ctrl & packets.YAW else 0,
            given.thrust if given.ctrl & packets.THRUST else hover,
        )

    def _switch_motors(self, control: Control | None, dt: float) -> None:
        """The yaw stick at its end with the thrust at zero switches the motors, each time it was held long enough."""
        _, _, yaw, thrust = self._axes(control)
        if control is None or abs(yaw) < STICK_MAX or thrust > 0 or self.faults.motors_stuck:
            self._combined_s = 0.0
            return
        self._combined_s += dt
        if self._combined_s >= self.settings.motors_s:
            self._combined_s = 0.0
            self.motors_on = not self.motors_on
            self.log.append("motors on" if self.motors_on else "motors off")
