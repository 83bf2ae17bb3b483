"""A vehicle over MAVLink: `MavlinkVehicle`, the `VehicleLink` of PX4 and ArduPilot."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.frames import Alignment
from swarmsim.autopilot.link import Identity, LinkError, Mode, Setpoint, Telemetry, Vector
from swarmsim.autopilot.mavlink import preflight as checks
from swarmsim.autopilot.mavlink.commands import Commands
from swarmsim.autopilot.mavlink.connection import COMPONENT, SYSTEM, Connection, LinkStatistics
from swarmsim.autopilot.mavlink.decode import Heard, hear, telemetry_of
from swarmsim.autopilot.mavlink.discovery import Discovery
from swarmsim.autopilot.mavlink.encode import encode
from swarmsim.autopilot.mavlink.profile import detect_profile
from swarmsim.autopilot.mavlink.rates import Rates
from swarmsim.autopilot.mavlink.wire import Message, read_key
from swarmsim.autopilot.mavlink.words import Words

_ASK_AGAIN_S = 0.7  # less than the period of heartbeats: the next one tells whether to ask again
_CUSTOM_MODE_ENABLED = 1
_HARMLESS = {  # what is sent in a dry run: nothing of it moves the vehicle
    mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ: None,
    mavlink.MAVLINK_MSG_ID_COMMAND_LONG: {
        mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
        mavlink.MAV_CMD_REQUEST_MESSAGE,
        mavlink.MAV_CMD_RUN_PREARM_CHECKS,
    },
}


def moves(message: Message) -> bool:
    """Whether a message could move the vehicle: all but the requests for data."""
    commands = _HARMLESS.get(message.get_msgId(), set())
    return commands is not None and getattr(message, "command", None) not in commands


class MavlinkVehicle:
    """A PX4 or ArduPilot vehicle; a `VehicleLink`. The link is open, and the vehicle known, once it is made."""

    arms = True

    def __init__(
        self,
        link: str,
        *,
        autopilot: str = "auto",
        vehicle: str = "auto",
        system: int | None = None,
        component: int = 1,
        own: tuple[int, int] = (SYSTEM, COMPONENT),
        heartbeat_hz: float = 1.0,
        log: Path | None = None,
        key_file: Path | None = None,
        dry: bool = False,
        timeout_s: float = 10.0,
    ):
        """Open ``link`` (see `swarmsim.autopilot.mavlink.transport.ALLOWED`) and find the vehicle.

        ``autopilot`` is px4, ardupilot or auto, ``vehicle`` copter, rover or auto. ``system`` is the vehicle's
        system id, which must be given where several are heard. ``log`` is the .tlog to write, ``key_file`` the
        signing key. Raises `InputError` for what cannot be meant, `LinkError` when no such vehicle is heard.
        """
        key = None if key_file is None else read_key(key_file)
        self.dry = dry
        self.withheld = 0
        """Messages that were not sent because the run is dry."""
        self._own = own
        self._lock = threading.Lock()
        self._changed = threading.Condition()
        self._heard = Heard()
        self._alignment: Alignment | None = None
        self._astray = False  # it was aligned, and has restarted: nobody knows where its new origin lies
        self._telemetry = Telemetry()
        self._begin_s = time.monotonic()
        self._listeners: list[Callable[[Telemetry], None]] = []
        self._words = Words()
        discovery = Discovery(system, component)
        self._receive: Callable[[Message], None] = discovery.hear
        self._connection = Connection(
            link,
            lambda message: self._receive(message),
            own=own,
            heartbeat_hz=heartbeat_hz,
            log=log,
            key=key,
            refused_s=timeout_s,
        )
        try:
            found = discovery.wait(self._connection, timeout_s)
            self._profile = detect_profile(found.autopilot, found.vehicle_type, autopilot, vehicle)
            self.streams_first = self._profile.kind.command.stream_first_s > 0.0
            target = (found.system, found.component)
            reverses = self._profile.kind.setpoints.reverse
            self.identity = Identity(self._profile.autopilot.name, self._profile.vehicle, *target, reverses=reverses)
            self._commands = Commands(self._transmit, target, own, self._profile.autopilot.integer_parameters)
            self._rates = Rates(self._profile.autopilot, self._commands)
            self._connection.select(*target)
            self._receive = self._take
            self._rates.start()
            self._learn_version()
        except BaseException:
            self.close()
            raise

    # what it tells

    def telemetry(self) -> Telemetry:
        """The latest snapshot, in the world once aligned; any thread may ask.

        After a restart that voids the alignment there is no position in it until the vehicle is aligned again.
        """
        return self._telemetry

    @property
    def statistics(self) -> LinkStatistics:
        """Counts of the link."""
        return self._connection.statistics

    def messages(self) -> list[str]:
        """What the vehicle has told in words since the last call, notes of the link included."""
        return self._words.take()

    def on_mode(self, callback: Callable[[Telemetry], None]) -> None:
        """Call ``callback`` in the reader thread, at once, whenever the mode, armed or the failsafe state changes.

        It must return quickly and must not wait for the vehicle.
        """
        self._listeners.append(callback)

    def align(self, world_m: Vector) -> None:
        """The place where the vehicle is now is ``world_m`` (ENU); raises `LinkError` without a position."""
        with self._lock:
            local = self._heard.position_ned_m
            if local is None or self._heard.pose_s is None or time.monotonic() - self._heard.pose_s > checks.FRESH_S:
                raise LinkError("the vehicle tells no position to align: wait for the preflight checks")
            x, y, z = map(float, world_m)
            self._alignment, self._astray = Alignment((x, y, z), local), False
            self._telemetry = telemetry_of(self._heard, self._alignment)

    # what it is told

    def preflight(self, tell: Callable[[str], None], timeout_s: float) -> None:
        """Wait until it can be armed, telling what passes; raises `LinkError` with every reason when time is up.

        A PX4 goes back to OFFBOARD when it has landed, and passes no pre-arm check there while nothing is streamed.
        """
        before = self._heard
        if self.streams_first and before.armed is False and before.mode is Mode.FOLLOW:
            tell(f"it stands in {before.mode_name} since an earlier flight: asking for hold")
            self.request(Mode.HOLD)

        def check_now() -> None:
            if self._profile.autopilot.runs_prearm_checks:
                self._commands.send(mavlink.MAV_CMD_RUN_PREARM_CHECKS)

        checks.preflight(
            lambda: self._heard,
            self._profile,
            self._commands.parameters,
            check_now,
            self._words.warnings_since,
            self._own[0],
            tell,
            timeout_s,
        )

    def send(self, setpoint: Setpoint) -> None:
        """Send one setpoint; returns at once.

        Raises ValueError, before anything is sent, for a setpoint that `encode` refuses, and `LinkError` where a
        place is given before `align`, or after the autopilot has restarted.
        """
        alignment = self._alignment
        if setpoint.position_m is not None and alignment is None:
            raise LinkError("positions are not aligned (or the autopilot has restarted): call align first")
        t = encode(setpoint, self._profile, alignment or Alignment((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        boot_ms = int((time.monotonic() - self._begin_s) * 1e3) & 0xFFFFFFFF
        target = (self.identity.system, self.identity.component)
        fields = (*t.position, *t.velocity, *t.acceleration, t.yaw, t.yaw_rate)
        self._transmit(
            mavlink.MAVLink_set_position_target_local_ned_message(boot_ms, *target, t.frame, t.mask, *fields)
        )

    def follow(self, timeout_s: float) -> None:
        """Have it follow setpoints, confirmed by its heartbeat; PX4 needs the stream for a second already."""
        self._enter(Mode.FOLLOW, timeout_s)

    def arm(self, timeout_s: float) -> None:
        """Arm, confirmed by the heartbeat; raises `LinkError` with what the vehicle said when it refuses."""
        arm = (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
        self._bring_about("arm", arm, lambda heard: bool(heard.armed), timeout_s)

    def disarm(self, timeout_s: float) -> None:
        """Disarm, confirmed by the heartbeat; the vehicle refuses it in the air."""
        disarm = (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0)
        self._bring_about("disarm", disarm, lambda heard: heard.armed is False, timeout_s)

    def take_off(self, height_m: float, timeout_s: float) -> None:
        """Climb to ``height_m`` above where it stands and wait for nine tenths of it.

        Nothing for a rover, and for PX4, which setpoints lift off. Raises `LinkError` when it does not climb.
        """
        if not 0.1 <= height_m <= 1e4:
            raise ValueError(f"height_m must lie between 0.1 and 10000 m, not {height_m}")
        if not self._profile.kind.command.takeoff or self.dry:
            return
        if (start := self._heard.position_ned_m) is None:
            raise LinkError("the vehicle tells no position: it cannot be told when it has taken off")
        wanted = start[2] - 0.9 * height_m
        takeoff = (mavlink.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, height_m)

        def climbed(heard: Heard) -> bool:
            return heard.position_ned_m is not None and heard.position_ned_m[2] <= wanted

        self._bring_about("take off", takeoff, climbed, timeout_s, once=True)

    def enter(self, mode: Mode, timeout_s: float) -> None:
        """Change to HOLD, LAND or RETURN, confirmed by the heartbeat."""
        self._enter(mode, timeout_s)

    def request(self, mode: Mode) -> None:
        """Ask for a mode without waiting, for an emergency, in three copies; never raises for the vehicle's sake."""
        _, _, numbers = self._profile.command_of(mode)
        for copy in range(3):
            parameters = (float(_CUSTOM_MODE_ENABLED), *map(float, numbers))
            self._commands.send(mavlink.MAV_CMD_DO_SET_MODE, *parameters, confirmation=copy)

    def close(self) -> None:
        """Close the link; the vehicle is left as it is."""
        if hasattr(self, "_rates"):
            self._rates.close()
        self._connection.close()

    # inside

    def _transmit(self, message: Message) -> bool:
        """The one way out: in a dry run what moves the vehicle ends here."""
        if self.dry and moves(message):
            self.withheld += 1
            return False
        return self._connection.send(message)

    def _take(self, message: Message) -> None:
        """One message, in the reader thread."""
        kind = message.get_type()
        now = time.monotonic()
        self._rates.hear(kind, now)
        if kind == "STATUSTEXT":
            self._words.hear(message)
        elif kind in ("COMMAND_ACK", "PARAM_VALUE"):
            self._commands.hear(message)
        with self._lock:
            before, after = self._heard, hear(self._heard, message, self._profile, now)
            if after is before:
                return
            if after.restarts != before.restarts:
                self._astray = self._astray or self._alignment is not None
                self._alignment = None
                self._words.note("the autopilot has restarted: its origin is another, align again", 2)
            self._heard = after
            telemetry = telemetry_of(after, self._alignment)
            self._telemetry = telemetry = replace(telemetry, position_m=None) if self._astray else telemetry
        with self._changed:
            self._changed.notify_all()
        state = (after.custom_mode, after.armed, after.failsafe)
        if before.custom_mode is not None and state != (before.custom_mode, before.armed, before.failsafe):
            self._announce(telemetry)

    def _announce(self, telemetry: Telemetry) -> None:
        """Call every listener, even where one fails; then raise its error."""
        errors = []
        for listener in list(self._listeners):
            try:
                listener(telemetry)
            except Exception as error:
                errors.append(error)
        if errors:
            raise errors[0]

    def _learn_version(self) -> None:
        """Ask for the version, for a second and a half; a vehicle that does not tell it can be flown all the same."""
        for _ in range(3):
            self._commands.send(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            if self._wait(
                lambda heard: heard.version is not None and heard.heard_s is not None, time.monotonic() + 0.6
            ):
                break
        self.identity = replace(self.identity, version=self._heard.version or self.identity.version)

    def _enter(self, mode: Mode, timeout_s: float) -> None:
        name, custom, numbers = self._profile.command_of(mode)
        command = (mavlink.MAV_CMD_DO_SET_MODE, float(_CUSTOM_MODE_ENABLED), *map(float, numbers))
        self._bring_about(mode.value, command, lambda heard: heard.custom_mode == custom, timeout_s, name)

    def _wait(self, reached: Callable[[Heard], bool], end_s: float) -> bool:
        with self._changed:
            while not reached(self._heard):
                if (left := end_s - time.monotonic()) <= 0.0:
                    return False
                self._changed.wait(min(left, 0.1))
        return True

    def _bring_about(
        self,
        what: str,
        command: tuple[float, ...],
        reached: Callable[[Heard], bool],
        timeout_s: float,
        name: str = "",
        once: bool = False,
    ) -> None:
        """Send a command again and again until the vehicle's state shows it; nothing else is believed.

        It is repeated only on a heartbeat that came since the last attempt and still tells the mode from before: while
        nothing is heard, an operator may have taken over. ``once`` stops sending when it was accepted: the state takes
        its time. Raises `LinkError` with the answers, the words and the sensors that may say why not; at once where the
        mode becomes another one meanwhile, which an operator or a failsafe chose: it must not be overruled.
        """
        if self.dry:
            self._words.note(f"dry run: {what} was not sent")
            return
        begin = sent_s = time.monotonic()
        number, parameters = int(command[0]), command[1:]
        tries = 0
        mode = self._heard.custom_mode

        def done(heard: Heard) -> bool:  # by a heartbeat from now, not by one from before the link was lost
            return reached(heard) and heard.heard_s is not None and heard.heard_s >= begin

        def settled(heard: Heard) -> bool:
            return done(heard) or (mode is not None and heard.custom_mode != mode and not reached(heard))

        def in_vain(heard: Heard) -> bool:
            return settled(heard) or (heard.heard_s is not None and heard.heard_s >= sent_s + _ASK_AGAIN_S)

        while True:
            accepted = any(a.result == mavlink.MAV_RESULT_ACCEPTED for a in self._commands.answers(number, begin))
            if not (once and accepted):
                self._commands.send(number, *parameters, confirmation=min(tries, 255))
                tries += 1
            sent_s = time.monotonic()
            self._wait(in_vain, begin + timeout_s)
            heard = self._heard
            mode = heard.custom_mode if mode is None else mode
            if done(heard):
                return
            if settled(heard):
                raise LinkError(
                    f"the vehicle did not {what}: its mode became {heard.mode_name} meanwhile, by an operator or a "
                    "failsafe; nothing more was sent"
                )
            if time.monotonic() >= begin + timeout_s:
                raise LinkError(self._why_not(what, name, number, begin, tries))

    def _why_not(self, what: str, name: str, number: int, begin_s: float, tries: int) -> str:
        heard = self._heard
        now = time.monotonic()
        answers = list(dict.fromkeys(a.name for a in self._commands.answers(number, begin_s)))
        lines = [
            f"the vehicle did not {what}{f' ({name})' if name else ''} in {now - begin_s:.1f} s, asked "
            + ("once" if tries == 1 else f"{tries} times")
        ]
        if heard.heard_s is None or now - heard.heard_s > checks.FRESH_S:
            lines.append("no heartbeat comes any more: the link is lost")
        lines.append("it answered " + (" and ".join(answers) if answers else "nothing"))
        lines.append(f"it is in mode {heard.mode_name}, {'armed' if heard.armed else 'disarmed'}")
        lines += [f"{s.name}: {s.reason}" for s in checks.stages(heard, self._profile, now) if s.reason]
        lines += [f"it says: {text}" for text in self._words.warnings_since(begin_s - 1.0)]
        advice = self._profile.autopilot.advice.get(what)
        lines += [f"what to do: {advice}"] if advice else []
        return "\n  ".join(lines)
