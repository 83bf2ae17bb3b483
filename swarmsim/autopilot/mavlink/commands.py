"""Commands with their answers: COMMAND_LONG out, COMMAND_ACK back, parameters read."""

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.mavlink.wire import Message

RETRY_S = 0.7
_KEPT = 100
_VAIN_ROUNDS = 3


@dataclass(frozen=True)
class Answer:
    """A COMMAND_ACK: when it came, the command and its MAV_RESULT."""

    at_s: float
    command: int
    result: int

    @property
    def name(self) -> str:
        """As in ``TEMPORARILY_REJECTED``."""
        entry = mavlink.enums["MAV_RESULT"].get(self.result)
        return entry.name.removeprefix("MAV_RESULT_") if entry is not None else f"result {self.result}"


class Commands:
    """Sends commands to one vehicle and collects its answers; `hear` is called in the reader thread."""

    def __init__(self, send: Callable[[Message], bool], target: tuple[int, int], own: tuple[int, int], integers: str):
        """``integers`` is how integer parameters come: ``value`` or ``bits``."""
        self._send, self._target, self._own, self._integers = send, target, own, integers
        self._changed = threading.Condition()
        self._answers: dict[int, deque[Answer]] = {}
        self._parameters: dict[str, float] = {}

    def hear(self, message: Message) -> None:
        """Take a COMMAND_ACK that is meant for us, or a PARAM_VALUE."""
        kind = message.get_type()
        with self._changed:
            if kind == "COMMAND_ACK":
                for_us = (0, self._own[0]), (0, self._own[1])
                if message.target_system in for_us[0] and message.target_component in for_us[1]:
                    answer = Answer(time.monotonic(), message.command, message.result)
                    self._answers.setdefault(message.command, deque(maxlen=_KEPT)).append(answer)
            elif kind == "PARAM_VALUE":
                self._parameters[message.param_id] = self._value(message)
            self._changed.notify_all()

    def _value(self, message: Message) -> float:
        if self._integers == "bits" and message.param_type <= mavlink.MAV_PARAM_TYPE_INT32:
            # from the bytes: a float that is no number would not keep its bits
            data = message.get_msgbuf()
            start = 10 if data[0] == mavlink.PROTOCOL_MARKER_V2 else 6
            return float(struct.unpack_from("<i", data, start)[0])
        return float(message.param_value)

    def send(self, command: int, *parameters: float, confirmation: int = 0) -> bool:
        """Send a command with its parameters, the missing ones zero; whether it went out."""
        padded = [*parameters, *[0.0] * (7 - len(parameters))]
        return self._send(mavlink.MAVLink_command_long_message(*self._target, command, confirmation, *padded))

    def answers(self, command: int, since_s: float) -> list[Answer]:
        """Answers to a command since a time of `time.monotonic`."""
        with self._changed:
            return [answer for answer in self._answers.get(command, ()) if answer.at_s >= since_s]

    def ask(self, command: int, *parameters: float, timeout_s: float) -> Answer | None:
        """Send until it is answered, and return the final answer; None where none came in time.

        IN_PROGRESS is no final answer; the command is not repeated after it.
        """
        begin, sent_s, confirmation = time.monotonic(), -1e9, 0
        while (now := time.monotonic()) < begin + timeout_s:
            answers = self.answers(command, begin)
            final = [a for a in answers if a.result != mavlink.MAV_RESULT_IN_PROGRESS]
            if final:
                return final[0]
            if not answers and now - sent_s >= RETRY_S:
                self.send(command, *parameters, confirmation=confirmation)
                sent_s, confirmation = now, min(confirmation + 1, 255)
            with self._changed:
                self._changed.wait(0.05)
        return None

    def parameters(self, names: Sequence[str], timeout_s: float) -> dict[str, float]:
        """Values of these parameters, without those that the vehicle does not tell (or does not have).

        It gives up when the time is over, or when three rounds in a row brought nothing.
        """
        end = time.monotonic() + timeout_s
        with self._changed:
            for name in names:
                self._parameters.pop(name, None)
        missing, vain = list(names), 0
        while missing and vain < _VAIN_ROUNDS and time.monotonic() < end:
            before = len(missing)
            for name in missing:
                self._send(mavlink.MAVLink_param_request_read_message(*self._target, name.encode(), -1))
                time.sleep(0.005)  # a burst overruns slow links
            retry = min(time.monotonic() + RETRY_S, end)
            with self._changed:
                while missing and (left := retry - time.monotonic()) > 0:
                    self._changed.wait(left)
                    missing = [name for name in missing if name not in self._parameters]
            vain = vain + 1 if len(missing) == before else 0
        with self._changed:
            return {name: self._parameters[name] for name in names if name in self._parameters}
