"""A small autopilot at the other end of a loopback link, for the tests of the MAVLink link; and a test of itself."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as mavlink

PX4, ARDUPILOT = 12, 3
COPTER, ROVER = 2, 10
OFFBOARD, LOITER, LAND, POSITION = 6 << 16, 4 << 16 | 3 << 24, 4 << 16 | 6 << 24, 3 << 16
TICK_S = 0.02
PREARM = mavlink.MAV_SYS_STATUS_PREARM_CHECK


class Peer:
    """Tells its state every 20 ms and answers commands; what it does wrong is set by its fields."""

    def __init__(self, port: int, autopilot=PX4, kind=COPTER, system=7, component=1, key: bytes | None = None):
        self.autopilot, self.kind, self.system, self.component = autopilot, kind, system, component
        self.address = ("127.0.0.1", port)
        self.custom_mode, self.armed, self.status = LOITER, False, mavlink.MAV_STATE_STANDBY
        self.position = [1.0, -2.0, 0.5]  # NED
        self.battery, self.flags, self.ready, self.fix, self.ill, self.landed = 80, 0x3FF, True, 3, 0, 1
        self.boot_ms = 100_000
        self.parameters: dict[str, tuple[float, int]] = {}
        self.answers: dict[int, list[int]] = {}  # MAV_RESULT of each command; empty for none, two for two
        self.obeys: set[int] = {176, 400, 22}
        self.deaf: set[str] = set()  # kinds of messages that it does not send
        self.ack_target = (0, 0)
        self.heard: list = []
        self._lock = threading.RLock()
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._ears = mavlink.MAVLink(None)
        self._ears.robust_parsing = True
        if key is not None:
            now = int((time.time() - 1_420_070_400) * 1e5)
            for one in (self._mav, self._ears):
                one.signing.secret_key, one.signing.timestamp = key, now
            self._mav.signing.sign_outgoing = True
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(TICK_S)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close()

    def send(self, message) -> None:
        if message.get_type() not in self.deaf:
            with self._lock:
                self.raw(message.pack(self._mav))
                self._mav.seq = (self._mav.seq + 1) % 256

    def raw(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            self._socket.sendto(data, self.address)

    def say(self, text: str, severity: int = 4) -> None:
        self.send(mavlink.MAVLink_statustext_message(severity, text.encode()))

    def of(self, kind: str) -> list:
        return [m for m in list(self.heard) if m.get_type() == kind]

    def commands(self, number: int) -> list:
        return [m for m in self.of("COMMAND_LONG") if m.command == number]

    def _run(self) -> None:
        next_s = 0.0
        while not self._stop.is_set():
            if time.monotonic() >= next_s:
                next_s = time.monotonic() + TICK_S
                self._tell()
            try:
                data = self._socket.recv(4096)
            except OSError:
                continue
            for message in self._ears.parse_buffer(data) or []:
                self.heard.append(message)
                if message.get_type() == "COMMAND_LONG":
                    self._obey(message)
                elif message.get_type() == "PARAM_REQUEST_READ" and message.param_id in self.parameters:
                    value, kind = self.parameters[message.param_id]
                    self.send(mavlink.MAVLink_param_value_message(message.param_id.encode(), value, kind, 9, 0))

    def _tell(self) -> None:
        self.boot_ms += 20
        mode = 0x81 if self.armed else 0x01
        starved = self.autopilot == PX4 and self.custom_mode == OFFBOARD and not self.armed  # of setpoints
        health = (PREARM if self.ready and not starved else 0) | 0xFF & ~self.ill
        self.send(mavlink.MAVLink_heartbeat_message(self.kind, self.autopilot, mode, self.custom_mode, self.status, 3))
        self.send(mavlink.MAVLink_local_position_ned_message(self.boot_ms, *self.position, 0.1, 0.2, 0.3))
        self.send(mavlink.MAVLink_attitude_quaternion_message(self.boot_ms, 1.0, 0.0, 0.0, 0.0, 0.01, 0.02, 0.03))
        self.send(mavlink.MAVLink_sys_status_message(PREARM | 0xFF, 0xFF, health, 0, 0, 0, self.battery, *[0] * 6))
        self.send(mavlink.MAVLink_extended_sys_state_message(0, self.landed))
        self.send(mavlink.MAVLink_gps_raw_int_message(0, self.fix, 0, 0, 0, 0, 0, 0, 0, 12))
        self.send(mavlink.MAVLink_home_position_message(0, 0, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0))
        if self.autopilot == PX4:
            self.send(mavlink.MAVLink_estimator_status_message(0, self.flags, *[0.0] * 8))
        else:
            self.send(mavlink.MAVLink_ekf_status_report_message(self.flags, *[0.0] * 5))

    def _obey(self, command) -> None:
        number = command.command
        results = self.answers.get(number, [0])
        if number == mavlink.MAV_CMD_REQUEST_MESSAGE and command.param1 == 148 and results:
            custom = [bytes(8)] * 3
            self.send(mavlink.MAVLink_autopilot_version_message(0, 0x011101FF, 0, 0, 0, *custom, 0, 0, 0))
        if number in self.obeys:
            if number == 176:
                main, sub = int(command.param2), int(command.param3)
                self.custom_mode = main << 16 | sub << 24 if self.autopilot == PX4 else main
            elif number == 400:
                self.armed = bool(command.param1)
            elif number == 22:
                self.position[2] -= command.param7
        for result in results:
            self.send(mavlink.MAVLink_command_ack_message(number, result, 0, 0, *self.ack_target))


@contextlib.contextmanager
def peer_on(port: int, **how) -> Iterator[Peer]:
    peer = Peer(port, **how)
    try:
        yield peer
    finally:
        peer.close()


def eventually(holds, within_s: float = 3.0) -> bool:
    end = time.monotonic() + within_s
    while not holds():
        if time.monotonic() > end:
            return False
        time.sleep(0.005)
    return True


def test_the_peer_speaks():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(3.0)
        parser = mavlink.MAVLink(None)
        with peer_on(ear.getsockname()[1]):
            heard = set()
            while len(heard) < 8:
                heard |= {m.get_type() for m in parser.parse_buffer(ear.recv(4096))}
    assert {"HEARTBEAT", "LOCAL_POSITION_NED", "ESTIMATOR_STATUS"} <= heard
