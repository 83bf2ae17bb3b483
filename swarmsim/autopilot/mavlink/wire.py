"""MAVLink 2 messages to bytes and back: a parser that survives everything, signing, keys."""

import hashlib
import time
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.config.errors import InputError, file_errors_told

Message = Any
"""A message of pymavlink, which ships without types."""

_KEY_BYTES = 32
_EPOCH_S = 1_420_070_400  # 2015-01-01, from which signatures count tens of microseconds
_MARKERS = (mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2)


def read_key(path: Path) -> bytes:
    """The signing key [32 bytes] of a file with 64 hexadecimal digits or 32 bytes; raises `InputError`."""
    with file_errors_told("the signing key cannot be read", file=path):
        if Path(path).exists() and not Path(path).is_file():
            raise InputError.of("the signing key is no regular file", file=path)  # a pipe would be waited for
        data = Path(path).read_bytes()
    if len(data) == _KEY_BYTES:
        return data
    try:
        key = bytes.fromhex(data.decode("ascii").strip())
    except ValueError:
        key = b""
    if len(key) != _KEY_BYTES:
        allowed = "64 hexadecimal digits, or 32 bytes; python -c 'import secrets; print(secrets.token_hex())' makes one"
        raise InputError.of("this is no signing key", file=path, allowed=allowed)
    return key


def signing_time() -> int:
    """Now, as signatures tell it: tens of microseconds since 2015."""
    return int((time.time() - _EPOCH_S) * 1e5)


def is_unknown(message: Message) -> bool:
    """Whether the kind of a message is not known, so that neither its checksum nor its signature could be checked."""
    return bool(message.get_type().startswith("UNKNOWN"))


def origin_of(message: Message) -> tuple[int, int, int]:
    """System id, component id and sequence number, from the bytes: unknown messages have them there alone."""
    data = message.get_msgbuf()
    system, component = (5, 6) if data[0] == mavlink.PROTOCOL_MARKER_V2 else (3, 4)
    return data[system], data[component], data[system - 1]


class Protocol(mavlink.MAVLink):
    """Packs or parses the messages of one direction of a link; one with a key signs, and accepts signed ones only."""

    def __init__(self, system: int, component: int, key: bytes | None = None):
        super().__init__(None, srcSystem=system, srcComponent=component)
        self.seq: int = 0
        self.robust_parsing = True
        self.signing.timestamp = signing_time()
        if key is not None:
            self.signing.secret_key = key
            self.signing.sign_outgoing = True

    def bytes_of(self, message: Message) -> bytes:
        """The bytes of a message, with its sequence number and its signature."""
        self.signing.timestamp = max(self.signing.timestamp, signing_time())
        data: bytes = message.pack(self)
        self.seq = (self.seq + 1) % 256
        return data

    def messages_of(self, data: bytes, datagram: bool) -> tuple[list[Message], int]:
        """Valid messages of what came, and how many stretches of bytes were none; never raises.

        Messages whose kind is not known (`is_unknown`) are among them, unchecked: they count for the losses.
        The beginning of a message that is left over is dropped when a datagram begins with a message of its own.
        """
        bad = 0
        self.signing.timestamp = max(self.signing.timestamp, signing_time())
        if datagram and self.buf_len() and data and data[0] in _MARKERS:
            self._forget()
            bad += 1
        try:
            found = self.parse_buffer(data) or []
        except Exception:  # whatever hostile bytes do to pymavlink, the link goes on
            self._forget()
            return [], bad + 1
        good = [m for m in found if m.get_type() != "BAD_DATA"]
        return good, bad + len(found) - len(good)

    def _forget(self) -> None:
        self.buf = bytearray()
        self.buf_index = 0
        self.expected_length = mavlink.HEADER_LEN_V1 + 2

    def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:
        """Whether a signature is right and new.

        pymavlink notes the time stamp before it checks the signature, so that one forged message with a time stamp
        of the future shuts a vehicle out: here the signature is checked first.
        """
        assert self.signing.secret_key is not None
        digest = hashlib.sha256(self.signing.secret_key + bytes(msgbuf[:-6])).digest()[:6]
        return digest == bytes(msgbuf[-6:]) and super().check_signature(msgbuf, srcSystem, srcComponent)
