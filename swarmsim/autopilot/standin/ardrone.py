"""A stand-in for an AR.Drone 2.0: AT commands, navdata, watchdogs and emergencies as its developer guide has them.

Source: Parrot, AR.Drone Developer Guide, SDK 2.0 (2012), chapters 6 and 7. It has no video, no configuration port, no
profiles (AT*CONFIG_IDS) and no animations.
"""

import contextlib
import math
import socket
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from swarmsim.autopilot.ardrone import at, navdata
from swarmsim.autopilot.ardrone.navdata import AIRBORNE, Control, Demo, Navdata, State
from swarmsim.autopilot.frames import yaw_of_quaternion
from swarmsim.autopilot.outer_loop import Angle, TurnRate
from swarmsim.autopilot.standin.body import Body, Motion, Sensed
from swarmsim.autopilot.standin.tilting import Sticks, StickSettings, StickStandin
from swarmsim.config.base import Duration, Length, Speed
from swarmsim.config.errors import InputError

_DATAGRAMS_MAX = 64  # in one step
_ACKNOWLEDGEMENTS = (0, at.CTRL_ACKNOWLEDGED)  # modes of AT*CTRL that clear the COMMAND bit


class ArdroneStandinSettings(StickSettings):
    """The stand-in of an AR.Drone 2.0: ``configs/autopilots/standin_ardrone2.yaml``."""

    navdata_hz: float = Field(ge=1, le=50)
    watchdog_s: Duration
    lost_s: Duration
    hover_m: Length
    take_off_m_s: Speed
    land_m_s: Speed
    tilt_deg: Angle
    climb_m_s: Speed
    turn_deg_s: TurnRate


@dataclass
class ArdroneFaults:
    """What goes wrong; a test sets its fields."""

    silent: bool = False  # no navdata are sent
    deaf: bool = False  # no command is heard
    unacknowledged: bool = False  # CONFIG is ignored
    grounded: bool = False  # it does not take off


class ArdroneStandin(StickStandin):
    """The drone; it listens at two UDP ports of ``host``.

    Without commands for ``watchdog_s`` it hovers until the next one; the bit of that watchdog stays until COMWDG. It
    leaves the bootstrap mode when the CONFIG that asks for navdata is acknowledged.
    """

    def __init__(
        self, body: Body, settings: ArdroneStandinSettings, host: str = "127.0.0.1",
        ports: tuple[int, int] = (5556, 5554), speed: float = 1.0,
    ):  # fmt: skip
        """``ports`` for commands and navdata; raises `InputError` where they are taken."""
        super().__init__(body, settings, speed)
        self.settings, self.faults = settings, ArdroneFaults()
        self.control = Control.LANDED
        self.config: dict[str, str] = {}
        self.ignored = 0  # commands that were too old
        self.faulty = State(0)  # reasons of an emergency
        self.emergency = False
        self._bootstrap, self._acknowledging, self._watchdog, self._lost = True, False, True, True
        self._heard_s, self._number, self._told, self._told_s = -math.inf, 0, 0, -math.inf
        self._client: tuple[str, int] | None = None
        self._wants_air = self._emergency_bit = False
        self._sticks: Sticks | None = None  # None: hover
        self._start_yaw_rad = self.tilting.yaw_rad
        self._sockets: list[socket.socket] = []
        try:
            for port in ports:
                wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                self._sockets.append(wire)
                wire.setblocking(False)
                wire.bind((host, port))
        except (OSError, UnicodeError, OverflowError) as error:
            self.close()
            raise InputError.of(
                f"the ports cannot be opened ({error})", path="--link", given=f"{host}:{ports}"
            ) from error
        self.address = f"ardrone:{host}:" + ":".join(str(s.getsockname()[1]) for s in self._sockets)

    def close(self) -> None:
        """Close the sockets."""
        for wire in self._sockets:
            wire.close()

    @property
    def mode(self) -> str:
        """Name of the control state."""
        return "EMERGENCY" if self.emergency else self.control.name

    @property
    def armed(self) -> bool:
        """Whether its motors run."""
        return not self.emergency and self.control is not Control.LANDED

    # what a test or an operator does

    def operator_lands(self) -> None:
        """The operator presses the land button of another application."""
        self._wants_air = False

    def cut(self, why: State) -> None:
        """It goes into its emergency state."""
        self.emergency, self.faulty = True, why
        self.log.append(f"emergency: {why!r}")

    # the wire

    def receive(self) -> None:
        """Take the datagrams that have come."""
        commands, wakes = self._sockets
        for data, client in _datagrams(wakes):
            if data:
                self._client = client
        for data, _ in _datagrams(commands):
            if not self.faults.deaf:
                self.hear(data)

    def hear(self, data: bytes) -> None:
        """One datagram with commands; those that are older than the last are ignored, except number 1."""
        for command in at.decode(data):
            if command.number != 1 and command.number <= self._number:
                self.ignored += 1
                continue
            self._number = command.number
            self._heard_s, self._lost = self.time_s, False
            self._obey(command)

    def _obey(self, command: at.Command) -> None:
        match command.name, command.arguments:
            case "COMWDG", ():
                self._watchdog = False
            case "REF", (int(bits),):
                self._ref(bits)
            case ("PCMD", (int(flag), int(roll), int(pitch), int(gaz), int(yaw))) | (
                "PCMD_MAG",
                (int(flag), int(roll), int(pitch), int(gaz), int(yaw), int(), int()),
            ):
                self._progress(flag, *(at.float_of_bits(x) for x in (roll, pitch, gaz, yaw)))
            case "CONFIG", (str(key), str(value)):
                if not self._acknowledging and not self.faults.unacknowledged:
                    self.config[key] = value
                    self._acknowledging = True
            case "CTRL", (int(mode), *_) if mode in _ACKNOWLEDGEMENTS:
                if self._acknowledging and "general:navdata_demo" in self.config:
                    self._bootstrap = False
                self._acknowledging = False
            case _:
                return

    def _ref(self, bits: int) -> None:
        emergency = bool(bits & at.REF_EMERGENCY)
        if emergency and not self._emergency_bit:
            if self.emergency:
                self.emergency, self.faulty, self._wants_air = False, State(0), False
                self.control = Control.LANDED
            else:
                self.cut(State(0))
        self._emergency_bit = emergency
        self._wants_air = bool(bits & at.REF_START)

    def _progress(self, flag: int, roll: float, pitch: float, gaz: float, yaw: float) -> None:
        shares = (roll, pitch, gaz, yaw)
        if not flag & at.PROGRESSIVE or not all(math.isfinite(x) and abs(x) <= 1.0 for x in shares):
            self._sticks = None
            return
        tilt, climb, turn = self._limits()
        self._sticks = Sticks(-pitch * tilt, -roll * tilt, gaz * climb, -yaw * turn)

    def _limits(self) -> tuple[float, float, float]:
        s = self.settings
        found = []
        for key, default, unit in (
            ("control:euler_angle_max", math.radians(s.tilt_deg), 1.0),
            ("control:control_vz_max", s.climb_m_s, 1e-3),
            ("control:control_yaw", math.radians(s.turn_deg_s), 1.0),
        ):
            value = default
            with contextlib.suppress(ValueError):
                value = unit * float(self.config[key]) if key in self.config else default
            found.append(value)
        return found[0], found[1], found[2]

    # the controller

    def command(self, sensed: Sensed, dt: float) -> Motion:
        """The control state's motion; a lost link means hovering."""
        silent = self.time_s - self._heard_s
        self._watchdog = self._watchdog or silent > self.settings.watchdog_s
        self._lost = self._lost or silent > self.settings.lost_s
        if silent > self.settings.watchdog_s:
            self._sticks = None
        self._change(sensed)
        s, tilting = self.settings, self.tilting
        if self.emergency or self.control is Control.LANDED:
            return tilting.stand()
        if self.control is Control.TAKING_OFF:
            return tilting.move(0.0, 0.0, s.take_off_m_s, 0.0, dt)
        if self.control is Control.LANDING:
            return tilting.move(0.0, 0.0, -s.land_m_s, 0.0, dt)
        if self.control is Control.FLYING and self._sticks is not None:
            return tilting.fly(self._sticks, dt)
        return tilting.move(0.0, 0.0, 0.0, 0.0, dt)

    def _change(self, sensed: Sensed) -> None:
        before = self.control
        if not sensed.intact and not self.emergency:
            self.cut(State.CUTOUT)
        if self.emergency:
            self.control = Control.DEFAULT
        elif before is Control.LANDED and self._wants_air and not self.faults.grounded:
            self.control = Control.TAKING_OFF
        elif before is Control.TAKING_OFF and sensed.height_m >= self.settings.hover_m:
            self.control = Control.HOVERING
        elif before is Control.LANDING and sensed.landed:
            self.control = Control.LANDED
        elif before in AIRBORNE or before is Control.TAKING_OFF:
            if not self._wants_air:
                self.control = Control.LANDING
            elif before is not Control.TAKING_OFF:
                self.control = Control.HOVERING if self._sticks is None else Control.FLYING

    # the navdata

    def state(self) -> State:
        """The bits of its state."""
        bits = State(self.faulty)
        for bit, set_ in (
            (State.FLYING, self.armed), (State.COMMAND, self._acknowledging), (State.BOOTSTRAP, self._bootstrap),
            (State.DEMO, self.config.get("general:navdata_demo") == "TRUE"), (State.COM_WATCHDOG, self._watchdog),
            (State.COM_LOST, self._lost), (State.EMERGENCY, self.emergency),
        ):  # fmt: skip
            bits |= bit if set_ else State(0)
        return bits

    def tell(self) -> None:
        """Send navdata to whom asked last, when they are due."""
        rate = self.settings.navdata_hz if self.config.get("general:navdata_demo", "TRUE") == "TRUE" else math.inf
        if self._client is None or self.faults.silent or self.time_s - self._told_s < 1.0 / rate - 1e-6:
            return
        self._told_s = self.time_s
        self._told += 1
        found = Navdata(self.state(), self._told, None if self._bootstrap else self.demo())
        with contextlib.suppress(OSError):
            self._sockets[1].sendto(navdata.encode(found), self._client)

    def demo(self) -> Demo:
        """What its sensors tell."""
        sensed = self.body.sensed
        yaw = yaw_of_quaternion(sensed.quaternion)
        east, north = sensed.velocity_m_s[:2]
        turned = self._start_yaw_rad - yaw
        return Demo(
            control=self.control,
            battery=float(np.clip(sensed.charge, 0.0, 1.0)),
            pitch_rad=-float(self.tilting.tilt_rad[0]),
            roll_rad=-float(self.tilting.tilt_rad[1]),
            heading_rad=math.atan2(math.sin(turned), math.cos(turned)),
            height_m=max(0.0, sensed.height_m),
            forward_m_s=float(math.cos(yaw) * east + math.sin(yaw) * north),
            right_m_s=float(math.sin(yaw) * east - math.cos(yaw) * north),
        )


def _datagrams(wire: socket.socket) -> list[tuple[bytes, tuple[str, int]]]:
    found: list[tuple[bytes, tuple[str, int]]] = []
    with contextlib.suppress(OSError):  # nothing more has come
        while len(found) < _DATAGRAMS_MAX:
            data, client = wire.recvfrom(65_536)
            found.append((data, client))
    return found
