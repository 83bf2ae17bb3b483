"""A Parrot AR.Drone 2.0 over its wireless network: `ArdroneVehicle`."""

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path

from swarmsim.autopilot.ardrone import at, navdata
from swarmsim.autopilot.ardrone.navdata import AIRBORNE, Control, Demo, Navdata, State
from swarmsim.autopilot.ardrone.reckoning import Reckoning
from swarmsim.autopilot.ardrone.settings import ArdroneSettings
from swarmsim.autopilot.frames import quaternion_of_euler
from swarmsim.autopilot.link import Identity, LinkError, Mode, Telemetry, Vector
from swarmsim.autopilot.mavlink.transport import LinkAddress, open_transport
from swarmsim.autopilot.stick_link import FOLLOWING, FRESH_S, Phase, StickLink, WireLog

_READ_S = 0.05
_AGAIN_S = 0.1  # until a command that is to be acknowledged is repeated
_WAKE_S = 0.5
_SURE_S = 0.5  # for so long at least it is told to stay on the ground
_OLDER = 50  # navdata with a number so far back or less are late; farther back the drone has restarted
_FAULTS = {
    State.MOTORS: "a motor has failed",
    State.SOFTWARE: "its software has failed",
    State.BATTERY_LOW: "its battery is low",
    State.ANGLES: "it is tilted out of range",
    State.CUTOUT: "a propeller is blocked",
    State.USER_EMERGENCY: "the operator pressed the emergency button",
}


class ArdroneVehicle(StickLink):
    """An AR.Drone 2.0; a `VehicleLink`. The drone is heard once it is made.

    Its position is dead reckoning from where it was aligned (see `Reckoning`), its heading counts from there as well:
    it has no receiver of satellites and tells no north, so that ``gnss_fix`` and the angular velocity stay None. It has
    no arming: the motors start with take-off. Its operator takes over with the land or emergency button of another
    application; what it then says stops this side at once.
    """

    arms = False

    def __init__(
        self, host: str, settings: ArdroneSettings, *, log: Path | None = None, dry: bool = False,
        timeout_s: float = 10.0,
    ):  # fmt: skip
        """Ask the drone at ``host`` for its navdata; raises `LinkError` when none come within ``timeout_s``."""
        super().__init__(
            Identity("ardrone2", "copter", 1, 1), settings.loop, settings.rate_hz, settings.stale_s, dry
        )  # fmt: skip
        self.settings = settings
        self._host = host
        self._navdata: Navdata | None = None
        self._demo: Demo | None = None
        self._heard_s: float | None = None
        self._pose_s: float | None = None
        self._reckoning = Reckoning(math.radians(settings.start_heading_deg), settings.gap_s)
        self._sequence = at.Sequence()
        self._wire = threading.Lock()
        self._woken_s = -math.inf
        self._log = WireLog(log)
        self._commands = open_transport(LinkAddress("udpout", host, settings.command_port))
        try:
            self._data = open_transport(LinkAddress("udpout", host, settings.navdata_port))
        except LinkError:
            self._commands.close()
            raise
        self._begin(self._read)
        try:
            self._wait_for("answer", lambda t: t.heard_s is not None, timeout_s, self._why_silent)
        except LinkError:
            self.close()
            raise

    def close(self) -> None:
        """Close the link; the drone then hovers by itself."""
        super().close()
        self._commands.close()
        self._data.close()
        self._log.close()

    def align(self, world_m: Vector) -> None:
        """The place where the drone is now is ``world_m`` (ENU), and its nose points as the settings say."""
        with self._lock:
            self._reckoning.begin()
        super().align(world_m)

    # preflight

    def preflight(self, tell: Callable[[str], None], timeout_s: float) -> None:
        """Configure it and wait until it can take off; raises `LinkError` with every reason when the time is up."""
        end = time.monotonic() + timeout_s
        s, limits = self.settings, self.settings.limits
        self._configure("general:navdata_demo", _truth(s.demo))
        self._wait_for("send navdata", lambda t: t.pose_s is not None, max(0.1, end - time.monotonic()), None)
        if self._in_emergency():
            self._clear_emergency(s.acknowledge_s)
            tell("its emergency state was cleared")
        for key, value in (
            ("control:outdoor", _truth(limits.outdoor)),
            ("control:flight_without_shell", _truth(limits.without_hull)),
            ("control:altitude_max", str(round(1e3 * limits.height_m))),
            ("control:euler_angle_max", f"{math.radians(limits.tilt_deg):.6f}"),
            ("control:control_vz_max", str(round(1e3 * limits.climb_m_s))),
            ("control:control_yaw", f"{math.radians(limits.turn_deg_s):.6f}"),
        ):
            self._configure(key, value)
            tell(f"{key} is {value}")
        tell(
            f"its nose has to point {s.start_heading_deg:g} deg counter-clockwise from east: it knows no north, and "
            "its position is dead reckoning"
        )
        self._wait_ready(max(0.2, end - time.monotonic()), self._not_ready)
        self._transmit(("FTRIM",), moves=True)

    def _configure(self, key: str, value: str) -> None:
        """Write one value and see it acknowledged: the COMMAND bit rises, and falls when we have acknowledged that."""
        self._until(lambda: not self._has(State.COMMAND), ("CTRL", at.CTRL_ACKNOWLEDGED, 0), f"leave {key} free")
        self._until(lambda: self._has(State.COMMAND), ("CONFIG", key, value), f"take {key}")
        self._until(lambda: not self._has(State.COMMAND), ("CTRL", at.CTRL_ACKNOWLEDGED, 0), f"finish {key}")

    def _until(self, reached: Callable[[], bool], command: tuple[at.Argument, ...], what: str) -> None:
        end = time.monotonic() + self.settings.acknowledge_s
        sent_s = -math.inf
        while not reached():
            now = time.monotonic()
            if now >= end:
                raise LinkError(self._why(what, self.settings.acknowledge_s, False, self._why_silent()))
            if now - sent_s >= _AGAIN_S:
                self._transmit(command)
                sent_s = now
            with self._changed:
                self._changed.wait(0.02)

    def _clear_emergency(self, timeout_s: float) -> None:
        """End the emergency state of a drone that lies on the ground: the bit's rising edge toggles it."""
        self._transmit(("REF", at.REF_BASE), ("REF", at.REF_BASE | at.REF_EMERGENCY), ("REF", at.REF_BASE), moves=True)
        self._wait_for("leave its emergency state", lambda _: not self._in_emergency(), timeout_s, self._not_ready)

    def arm(self, timeout_s: float) -> None:
        """Nothing: it has no arming, its motors start with take-off."""
        del timeout_s
        self._note("the AR.Drone has no arming: its motors start with take-off")

    def disarm(self, timeout_s: float) -> None:
        """Call a take-off off that has not begun; raises `LinkError` in the air, where it has to land instead."""
        if self._telemetry.armed:
            raise LinkError("it is in the air, and has no disarming: land it")
        if self._phase is not Phase.RELEASED:
            self._set_phase(Phase.LAND)
        self._wait_for("stay on the ground", lambda _: self._phase is Phase.RELEASED, timeout_s, None)

    # inside

    def _has(self, bits: State) -> bool:
        return self._navdata is not None and bool(self._navdata.state & bits)

    def _in_emergency(self) -> bool:
        return self._has(State.EMERGENCY)

    def _control(self) -> Control | None:
        return None if self._demo is None else self._demo.control

    def _faults(self) -> list[str]:
        return [text for bit, text in _FAULTS.items() if self._has(bit)]

    def _why_silent(self) -> str | None:
        if self._heard_s is not None:
            return None
        return f"no navdata come from {self._host}: join the drone's wireless network, and check its address"

    def _not_ready(self) -> str | None:
        s = self.settings
        if self._demo is None:
            return "it sends no navdata: it is still in bootstrap mode"
        reasons = self._faults()
        reasons += ["it is in its emergency state"] if self._in_emergency() else []
        reasons += [f"it is {self._demo.control.name}"] if self._demo.control is not Control.LANDED else []
        if self._demo.battery < s.battery_min:
            reasons.append(
                f"its battery is at {100 * self._demo.battery:.0f} %, battery_min is {100 * s.battery_min:.0f} %"
            )
        return "; ".join(reasons) or None

    def _why_not_follow(self) -> str | None:
        if self._demo is None or self._pose_s is None or time.monotonic() - self._pose_s > FRESH_S:
            return "it sends no navdata"
        if self._in_emergency():
            return "it is in its emergency state: " + ("; ".join(self._faults()) or "it does not say why")
        if self._demo.control is Control.LANDING and self._phase is not Phase.LAND:
            return "it is landing"
        return None

    def _snapshot(self) -> Telemetry:
        demo, control = self._demo, self._control()
        if self._navdata is None or demo is None:
            return Telemetry(heard_s=self._heard_s, mode_name="BOOTSTRAP" if self._navdata else "unknown")
        emergency = self._in_emergency()
        armed = not emergency and control not in (Control.DEFAULT, Control.INIT, Control.LANDED, Control.TEST)
        mode, name = self._mode(demo.control, emergency)
        attitude = quaternion_of_euler(demo.roll_rad, -demo.pitch_rad, self._reckoning.yaw_rad(demo))
        return Telemetry(
            heard_s=self._heard_s,
            pose_s=self._pose_s,
            position_m=self._reckoning.position_m,
            velocity_m_s=self._reckoning.velocity_m_s,
            quaternion=attitude,
            armed=armed,
            mode=mode,
            mode_name=name,
            on_ground=control is Control.LANDED,
            battery=demo.battery,
            estimate_ok=not self._reckoning.broken,
            ready_to_arm=self._not_ready() is None,
            failsafe=emergency,
        )

    def _mode(self, control: Control, emergency: bool) -> tuple[Mode, str]:
        if emergency:
            return Mode.OTHER, "EMERGENCY" + "".join(f", {fault}" for fault in self._faults())
        if control is Control.LANDING or self._phase is Phase.LAND:
            return Mode.LAND, control.name
        if self._phase in FOLLOWING:
            return Mode.FOLLOW, control.name
        return (Mode.HOLD if self._phase is Phase.HOLD else Mode.OTHER), control.name

    def _read(self) -> None:
        while not self._over.is_set():
            data, _ = self._data.read(_READ_S)
            found = navdata.decode(data) if data else None
            if found is not None:
                self._log.note("<", data)
                self._hear(found)

    def _hear(self, found: Navdata) -> None:
        now = time.monotonic()
        with self._lock:
            before = self._navdata
            if before is not None and 0 <= before.number - found.number <= _OLDER and found.number > 1:
                return
            self._navdata, self._heard_s = found, now
            if found.demo is not None:
                self._demo, self._pose_s = found.demo, now
                self._reckoning.add(now, found.demo)
                self._watch_operator(found.demo.control)
        self._refresh()

    def _watch_operator(self, control: Control) -> None:
        """Release the drone where it does what was not asked for here."""
        phase = self._phase
        if self._in_emergency():
            self._release("emergency: " + ("; ".join(self._faults()) or "its motors were cut"))
        elif control is Control.LANDING and phase in (Phase.TAKE_OFF, Phase.FOLLOW, Phase.HOLD):
            self._release("it lands, and not by our command")
        elif control is Control.LANDED and phase in (Phase.FOLLOW, Phase.HOLD):
            self._release("it has landed, and not by our command")
        elif control is Control.LANDED and phase is Phase.LAND and time.monotonic() - self._phase_s > _SURE_S:
            self._phase = Phase.RELEASED

    def _tick(self, now_s: float, dt_s: float) -> None:
        if now_s - max(self._heard_s or -math.inf, self._woken_s) > _WAKE_S:
            self._woken_s = now_s
            self._data.write(navdata.WAKE, None)
        if self._has(State.COM_LOST):
            with self._wire:
                self._sequence.restart()
        with self._lock:  # until it is sent: a takeover that is seen meanwhile would be followed by a command
            self._command(now_s, dt_s)

    def _command(self, now_s: float, dt_s: float) -> None:
        """Send what this phase asks for."""
        phase, airborne = self._phase, self._control() in AIRBORNE
        keep: list[tuple[at.Argument, ...]] = [("COMWDG",)] if self._has(State.COM_WATCHDOG) else []
        if phase is Phase.LAND:
            self._transmit(*keep, ("REF", at.REF_BASE), moves=True)
        elif phase is Phase.TAKE_OFF and not airborne:
            self._transmit(*keep, ("REF", at.REF_BASE | at.REF_START), moves=True)
        elif phase in (Phase.TAKE_OFF, Phase.FOLLOW, Phase.HOLD):
            self._transmit(*keep, self._progress(now_s, dt_s), moves=True)
        elif not self._telemetry.armed:  # on the ground the watchdog is kept quiet; in the air somebody else flies it
            self._transmit(("COMWDG",))

    def _progress(self, now_s: float, dt_s: float) -> tuple[at.Argument, ...]:
        """The PCMD of this period; hovering where there is no fresh setpoint."""
        found = self._demand(now_s, dt_s)
        if found is None:
            return "PCMD", 0, 0.0, 0.0, 0.0, 0.0
        demand, yaw = found
        limits = self.settings.limits
        forward, left = demand.tilt(yaw)
        tilt, turn = math.radians(limits.tilt_deg), math.radians(limits.turn_deg_s)
        roll, pitch = _share(-left, tilt), _share(-forward, tilt)
        climb, spin = _share(demand.velocity_m_s[2], limits.climb_m_s), _share(-demand.turn_rad_s, turn)
        return "PCMD", at.PROGRESSIVE, roll, pitch, climb, spin

    def _transmit(self, *commands: tuple[at.Argument, ...], moves: bool = False) -> None:
        """Send commands in one datagram; in a dry run what ``moves`` the drone ends here."""
        if moves and self.dry:
            return
        with self._wire:
            data = b"".join(at.encode(str(name), self._sequence.take(), *rest) for name, *rest in commands)
            if self._commands.write(data, None):
                self._log.note(">", data)


def _share(value: float, limit: float) -> float:
    return max(-1.0, min(1.0, value / limit))


def _truth(value: bool) -> str:
    return "TRUE" if value else "FALSE"
