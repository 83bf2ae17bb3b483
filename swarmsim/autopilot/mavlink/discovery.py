"""Which vehicle is at the other end: by the heartbeats of autopilots."""

import threading
import time
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.link import LinkError
from swarmsim.autopilot.mavlink.connection import Connection
from swarmsim.autopilot.mavlink.wire import Message

_LISTEN_S = 1.2  # heartbeats come once a second: long enough to hear a second vehicle


@dataclass(frozen=True)
class Found:
    """An autopilot that was heard."""

    system: int
    component: int
    autopilot: int  # MAV_AUTOPILOT
    vehicle_type: int  # MAV_TYPE


class Discovery:
    """Collects heartbeats; `hear` is called in the reader thread."""

    def __init__(self, system: int | None, component: int):
        self._system, self._component = system, component
        self._changed = threading.Condition()
        self._found: dict[tuple[int, int], Found] = {}

    def hear(self, message: Message) -> None:
        """Take a heartbeat."""
        if message.get_type() == "HEARTBEAT":
            key = (message.get_srcSystem(), message.get_srcComponent())
            with self._changed:
                self._found[key] = Found(*key, message.autopilot, message.type)
                self._changed.notify_all()

    def _candidates(self) -> list[Found]:
        return [
            found
            for found in self._found.values()
            if found.component == self._component
            and found.autopilot != mavlink.MAV_AUTOPILOT_INVALID
            and self._system in (None, found.system)
        ]

    def wait(self, connection: Connection, timeout_s: float) -> Found:
        """The vehicle; raises `LinkError` when it is not heard, or when several are and none was named."""
        end = time.monotonic() + timeout_s
        with self._changed:
            while not self._candidates() and (left := end - time.monotonic()) > 0:
                self._changed.wait(left)
            if self._system is None and self._candidates():
                self._changed.wait_for(lambda: len(self._candidates()) > 1, _LISTEN_S)
            found = self._candidates()
            heard = sorted(self._found)
        if len(found) == 1:
            return found[0]
        if found:
            systems = ", ".join(str(one.system) for one in found)
            raise LinkError(
                f"several vehicles are heard on {connection.link}, systems {systems}: say which, or give each a port"
            )
        counts = connection.statistics
        if heard:
            others = ", ".join(f"system {system} component {component}" for system, component in heard)
            wanted = f"system {self._system or 'any'} component {self._component}"
            raise LinkError(f"no heartbeat of an autopilot with {wanted} on {connection.link}; heard: {others}")
        what = "nothing at all" if not counts.bytes_received else f"{counts.bytes_received} bytes, no valid heartbeat"
        advice = (
            "check that the autopilot runs and sends here"
            if not counts.bytes_received
            else "check baud rate and signing key"
        )
        raise LinkError(f"no vehicle is heard on {connection.link} in {timeout_s:g} s ({what}): {advice}")
