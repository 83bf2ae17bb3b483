"""AT commands of the AR.Drone 2.0: text in UDP datagrams, and back.

Source: Parrot, AR.Drone Developer Guide, SDK 2.0 (19 December 2012), chapter 6.
"""

import re
import struct
from dataclasses import dataclass
from typing import Final

DATAGRAM_MAX: Final = 1024  # bytes of a command line; a longer one is rejected as a whole
NUMBER_MAX: Final = 2**31 - 1  # of sequence numbers, which the drone reads as integers

REF_BASE: Final = 1 << 18 | 1 << 20 | 1 << 22 | 1 << 24 | 1 << 28  # bits that are always set
REF_START: Final = 1 << 9  # take off, or stay in the air; land without it
REF_EMERGENCY: Final = 1 << 8  # its rising edge cuts the motors, or ends the emergency state

PROGRESSIVE: Final = 1  # flag of PCMD: without it the drone hovers, and the other arguments are not read
CTRL_ACKNOWLEDGED: Final = 5  # ACK_CONTROL_MODE: clears the bit that acknowledges a CONFIG

Argument = int | float | str
_LINE = re.compile(r'AT\*([A-Z_]{1,20})=(-?\d{1,10})((?:,(?:-?\d{1,10}|"[^"\r\n]*"))*)\Z')
_ARGUMENT = re.compile(r'-?\d{1,10}|"[^"\r\n]*"')


@dataclass(frozen=True)
class Command:
    """A command as it comes over the wire: floating-point arguments are integers with the same bits."""

    name: str
    number: int
    arguments: tuple[int | str, ...]


def bits_of_float(value: float) -> int:
    """The signed integer with the bits of ``value`` in single precision: -0.8 is -1085485875."""
    return int(struct.unpack("<i", struct.pack("<f", value))[0])


def float_of_bits(bits: int) -> float:
    """The number in single precision that has these bits."""
    return float(struct.unpack("<f", struct.pack("<I", bits & 0xFFFFFFFF))[0])


def encode(name: str, number: int, *arguments: Argument) -> bytes:
    """One command with its sequence number, ended by a carriage return."""
    words = [_word(argument) for argument in arguments]
    return ("AT*" + name + "=" + ",".join([str(number), *words]) + "\r").encode("ascii")


def _word(argument: Argument) -> str:
    if isinstance(argument, str):
        if any(c in argument for c in '"\r\n') or not argument.isascii():
            raise ValueError(f"an AT command cannot carry the text {argument!r}")
        return f'"{argument}"'
    return str(bits_of_float(argument)) if isinstance(argument, float) else str(argument)


def decode(data: bytes) -> list[Command]:
    """The commands of a datagram; what is no command is left out, a line that is too long rejects all of it."""
    if len(data) > DATAGRAM_MAX:
        return []
    found = []
    for line in re.split(r"[\r\n]", data.decode("ascii", "replace")):
        match = _LINE.match(line)
        if match is not None:
            words = _ARGUMENT.findall(match[3])
            arguments = tuple(w[1:-1] if w.startswith('"') else int(w) for w in words)
            found.append(Command(match[1], int(match[2]), arguments))
    return found


class Sequence:
    """Sequence numbers. The drone ignores a command that is older than the last one, except number 1, which resets."""

    def __init__(self) -> None:
        self._next = 1

    def restart(self) -> None:
        """The next number is 1: the drone has lost the link."""
        self._next = 1

    def take(self) -> int:
        """The next number."""
        number = self._next
        self._next = number + 1 if number < NUMBER_MAX else 1
        return number
