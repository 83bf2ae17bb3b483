"""Telemetry at the rates of the profile: asked for, and asked for again while it does not come."""

import threading
import time

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.mavlink.commands import Commands
from swarmsim.autopilot.mavlink.profile import Autopilot

_LOOK_S = 0.25  # where nothing is polled
_SPACING_S = 0.005


class Rates:
    """A thread that sends SET_MESSAGE_INTERVAL, and REQUEST_MESSAGE for what is polled.

    `hear` is called in the reader thread.
    """

    def __init__(self, autopilot: Autopilot, commands: Commands):
        self._hz = autopilot.messages_hz
        self._polled_s = {name: 1.0 / hz for name, hz in autopilot.polled_hz.items()}
        self._ids = {name: getattr(mavlink, f"MAVLINK_MSG_ID_{name}") for name in (*self._hz, *self._polled_s)}
        self._silent_s = autopilot.silent_s
        self._commands = commands
        self._heard_s: dict[str, float] = {}
        self._asked_s: dict[str, float] = {}
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mavlink-rates", daemon=True)

    def start(self) -> None:
        """Begin to ask."""
        self._thread.start()

    def hear(self, kind: str, now: float) -> None:
        """A message of this kind has come."""
        self._heard_s[kind] = now

    def close(self) -> None:
        """Stop asking."""
        self._closed.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(2.0)

    def due(self, now: float) -> list[str]:
        """Messages to ask for now: never asked for, or silent for too long since they last came or were asked for."""
        found = []
        for name, hz in self._hz.items():
            patience = max(self._silent_s, 2.5 / hz)
            known = max(self._heard_s.get(name, -1e9), self._asked_s.get(name, -1e9))
            if name not in self._asked_s or now - known > patience:
                found.append(name)
        return found

    def _run(self) -> None:
        next_s = dict.fromkeys(self._polled_s, time.monotonic())
        while True:
            for name, period_s in self._polled_s.items():
                if (now := time.monotonic()) >= next_s[name]:
                    self._commands.send(mavlink.MAV_CMD_REQUEST_MESSAGE, self._ids[name])
                    next_s[name] = max(next_s[name] + period_s, now)
            for name in self.due(time.monotonic()):
                interval_us = 1e6 / self._hz[name]
                self._commands.send(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, self._ids[name], interval_us)
                self._asked_s[name] = time.monotonic()
                if self._closed.wait(_SPACING_S):
                    return
            wait_s = min((at for at in next_s.values()), default=time.monotonic() + _LOOK_S) - time.monotonic()
            if self._closed.wait(max(wait_s, 0.001)):
                return
