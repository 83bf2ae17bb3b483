"""Bytes of a terminal to names of keys."""

ESCAPE_S = 0.1  # after which an escape character that nothing has followed is the key of that name
SEQUENCE_BYTES = 32  # an escape sequence that is longer is none

_CONTROL = {0x20: "space", 0x0A: "enter", 0x0D: "enter", 0x09: "tab", 0x7F: "backspace", 0x08: "backspace"}
_FINAL = {"A": "up", "B": "down", "C": "right", "D": "left", "H": "home", "F": "end"}  # ESC [ A, ESC O A, ESC [1;5A
_TILDE = {1: "home", 2: "insert", 3: "delete", 4: "end", 5: "pageup", 6: "pagedown", 7: "home", 8: "end"}  # ESC [ 3 ~


class KeyDecoder:
    """Names of the keys (`swarmsim.config.manual.Key`) in what a terminal sends, however it is split between reads.

    Escape sequences are those of ECMA-48 and xterm. What is no known key (other control characters, characters beyond
    ASCII, unknown sequences) is passed over.
    """

    def __init__(self) -> None:
        """Nothing has been read."""
        self._sequence = b""
        self._since_s = 0.0

    def feed(self, data: bytes, now_s: float) -> list[str]:
        """The keys in ``data``, read at ``now_s``, and in what was left before it; letters in lower case."""
        keys = []
        if self._sequence and not data and now_s - self._since_s > ESCAPE_S:
            keys = ["escape"] if self._sequence == b"\x1b" else []
            self._sequence = b""
        for code in data:
            key = self._one(code)
            if key is not None:
                keys.append(key)
        if data:
            self._since_s = now_s
        return keys

    def _one(self, code: int) -> str | None:
        if code == 0x1B:
            escape = "escape" if self._sequence == b"\x1b" else None
            self._sequence = b"\x1b"
            return escape
        if not self._sequence:
            return _CONTROL.get(code) or (chr(code).lower() if 0x21 <= code <= 0x7E else None)
        if self._sequence == b"\x1b" and code not in b"[O":  # Alt and a key
            self._sequence = b""
            return None
        self._sequence += bytes([code])
        if len(self._sequence) == 2 or 0x20 <= code <= 0x3F:  # the introducer, a parameter or an intermediate
            if len(self._sequence) > SEQUENCE_BYTES:
                self._sequence = b""
            return None
        sequence, self._sequence = self._sequence, b""
        return _named(sequence) if 0x40 <= code <= 0x7E else None


def _named(sequence: bytes) -> str | None:
    """The key of a whole sequence, ``ESC [`` or ``ESC O``, parameters, final character."""
    final, parameters = chr(sequence[-1]), sequence[2:-1].decode("ascii")
    if final != "~":
        return _FINAL.get(final)
    first = parameters.split(";")[0]
    return _TILDE.get(int(first)) if first.isdigit() else None
