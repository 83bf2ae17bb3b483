"""Firmware without a flight controller: it answers as PX4 and ArduPilot do, with outputs that a test chooses."""

import json
import socket
import struct
import threading
import time
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.mavlink.wire import Protocol


class Px4Peer:
    """Connects, and answers each HIL_SENSOR with the outputs of ``law`` (its messages so far by their kind)."""

    def __init__(self, port: int, law: Callable[[dict], list[float]], *, armed: bool = True, silent_at: int = -1):
        self.heard: dict[str, list] = {}
        self.law, self.armed, self.silent_at = law, armed, silent_at
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(port,), daemon=True)
        self._thread.start()

    def _run(self, port: int) -> None:
        wire = _connected(port, self._over)
        if wire is None:
            return
        protocol = Protocol(1, 1)
        wire.settimeout(0.1)
        while not self._over.is_set():
            try:
                data = wire.recv(65536)
            except TimeoutError:
                continue
            except OSError:
                break
            if not data:
                break
            for message in protocol.messages_of(data, datagram=False)[0]:
                self.heard.setdefault(message.get_type(), []).append(message)
                if message.get_type() == "HIL_SENSOR" and len(self.heard["HIL_SENSOR"]) != self.silent_at:
                    wire.sendall(protocol.bytes_of(self._answer(message.time_usec)))
        wire.close()

    def _answer(self, time_us: int) -> object:
        outputs = self.law(self.heard)
        controls = [*outputs, *[0.0] * (16 - len(outputs))]
        mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        return mavlink.MAVLink_hil_actuator_controls_message(time_us, controls, mode, 1)

    def close(self) -> None:
        """End it."""
        self._over.set()
        self._thread.join(5.0)


class ArdupilotPeer:
    """Asks for states with the servo pulses of ``law`` (the states so far); each frame ``repeats`` times."""

    def __init__(self, port: int, law: Callable[[list], list[int]], *, repeats: int = 1, channels: int = 16):
        self.states: list[dict] = []
        self.raw: list[bytes] = []
        self.law, self.repeats, self.channels = law, repeats, channels
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(port,), daemon=True)
        self._thread.start()

    def _run(self, port: int) -> None:
        magic = {16: 18458, 32: 29569}[self.channels]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            frame = 0
            while not self._over.is_set():
                # only before the first answer may nobody listen; later a frame asked for twice is answered twice
                wire.settimeout(2.0 if frame else 0.2)
                pulses = self.law(self.states)
                pulses = [*pulses, *[0] * (self.channels - len(pulses))]
                packet = struct.pack(f"<HHI{self.channels}H", magic, 400, frame, *pulses)
                for _ in range(self.repeats):
                    wire.sendto(packet, ("127.0.0.1", port))
                try:
                    for _ in range(self.repeats if frame else 1):
                        self.raw.append(wire.recv(4096))
                except (TimeoutError, OSError):
                    continue
                self.states.append(json.loads(self.raw[-1]))
                frame += 1

    def close(self) -> None:
        """End it."""
        self._over.set()
        self._thread.join(5.0)


def _connected(port: int, over: threading.Event) -> socket.socket | None:
    while not over.is_set():
        try:
            return socket.create_connection(("127.0.0.1", port), 1.0)
        except OSError:
            time.sleep(0.02)
    return None
