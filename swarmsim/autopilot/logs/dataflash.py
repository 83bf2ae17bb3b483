"""The format of ArduPilot's dataflash logs (``.bin``): messages that describe themselves.

Each message begins with the bytes A3 95 and its type; those of type 80 (FMT) tell length, name, format and columns of
the other types. The characters of a format are those of ArduPilot's LogStructure.h. pymavlink's reader is not used: it
is under the GPL, and a message of length zero keeps it busy for ever.
"""

import mmap
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Data = bytes | mmap.mmap
HEADER = b"\xa3\x95"
_FMT = 0x80
_HEADER_BYTES = 3
_KINDS: dict[str, tuple[str, float]] = {  # numpy's type, factor
    "a": ("(32,)<i2", 1.0),
    "b": ("i1", 1.0),
    "B": ("u1", 1.0),
    "g": ("<f2", 1.0),
    "h": ("<i2", 1.0),
    "H": ("<u2", 1.0),
    "i": ("<i4", 1.0),
    "I": ("<u4", 1.0),
    "f": ("<f4", 1.0),
    "d": ("<f8", 1.0),
    "n": ("S4", 1.0),
    "N": ("S16", 1.0),
    "Z": ("S64", 1.0),
    "c": ("<i2", 1e-2),
    "C": ("<u2", 1e-2),
    "e": ("<i4", 1e-2),
    "E": ("<u4", 1e-2),
    "L": ("<i4", 1e-7),
    "M": ("u1", 1.0),
    "q": ("<i8", 1.0),
    "Q": ("<u8", 1.0),
}


@dataclass(frozen=True)
class _Format:
    name: str
    length: int
    columns: np.dtype[np.void]
    factors: tuple[float, ...]


@dataclass(frozen=True)
class Messages:
    """All messages of one name, a column for each field."""

    rows: NDArray[np.void]
    factors: dict[str, float]

    def __len__(self) -> int:
        return len(self.rows)

    def has(self, *names: str) -> bool:
        """Whether it has all these columns, of numbers."""
        return all(self._kind(name) in "iuf" for name in names)

    def has_texts(self, *names: str) -> bool:
        """Whether it has all these columns, of texts."""
        return all(self._kind(name) == "S" for name in names)

    def _kind(self, name: str) -> str:
        """numpy's letter for the kind of a column; ``-`` where there is none, or each of its values is an array."""
        fields = self.rows.dtype.fields
        column = None if fields is None else fields.get(name)
        return "-" if column is None or column[0].shape else column[0].kind

    def numbers(self, name: str) -> NDArray[np.float64]:
        """A column [n] in the unit of its format."""
        with np.errstate(invalid="ignore"):  # damage may leave a signalling NaN
            return np.asarray(self.rows[name], np.float64) * self.factors[name]

    def texts(self, name: str) -> list[str]:
        """A column of texts [n]."""
        return [bytes(text).decode("utf-8", "replace") for text in self.rows[name]]

    def where(self, mask: NDArray[np.bool_]) -> "Messages":
        """Those rows."""
        return Messages(self.rows[mask], self.factors)


def read_messages(data: Data, names: set[str]) -> tuple[dict[str, Messages], int]:
    """The messages of these names, and how many bytes of the log are no message; never raises for wrong bytes.

    A message counts if another one follows it or the log ends there.
    """
    formats: dict[int, _Format] = {}
    places: dict[int, list[int]] = {}
    lengths = {_FMT: 89}
    position, skipped, size = 0, 0, len(data)
    while position + _HEADER_BYTES <= size:
        kind = data[position + 2]
        length = lengths.get(kind, 0) if data[position : position + 2] == HEADER else 0
        after = position + length
        whole = length and after <= size and (after + 2 > size or data[after : after + 2] == HEADER)
        if not whole:
            found = data.find(HEADER, position + 1)
            found = size if found < 0 else found
            skipped += found - position
            position = found
            continue
        if kind == _FMT:
            number, made = _format(data[position + _HEADER_BYTES : after])
            if made is not None and not places.get(number):  # what has been found was of the format told before
                lengths[number], formats[number], places[number] = made.length, made, []
        elif formats[kind].name in names:
            places[kind].append(position)
        position = after
    skipped += size - position
    raw = np.frombuffer(data, np.uint8)
    return {
        formats[kind].name: _gathered(raw, formats[kind], np.array(starts, np.int64))
        for kind, starts in places.items()
        if starts
    }, skipped


def _format(body: bytes) -> tuple[int, _Format | None]:
    """Type and format that a FMT message tells; None where it contradicts itself."""
    number, length, name, characters, columns = struct.unpack("<BB4s16s64s", body)
    texts = [part.split(b"\0")[0].decode("ascii", "replace") for part in (name, characters, columns)]
    fields = texts[2].split(",") if texts[2] else []
    right = number != _FMT and len(fields) == len(texts[1]) == len(set(fields)) and set(texts[1]) <= set(_KINDS)
    if not right or not all(fields):
        return number, None
    made = np.dtype([(field, _KINDS[c][0]) for field, c in zip(fields, texts[1], strict=True)])
    if made.itemsize + _HEADER_BYTES != length:
        return number, None
    return number, _Format(texts[0], length, made, tuple(_KINDS[c][1] for c in texts[1]))


def _gathered(raw: NDArray[np.uint8], kind: _Format, starts: NDArray[np.int64]) -> Messages:
    body = np.arange(_HEADER_BYTES, kind.length)
    rows = np.ascontiguousarray(raw[starts[:, None] + body]).view(kind.columns)[:, 0]
    return Messages(rows, dict(zip(kind.columns.names or (), kind.factors, strict=True)))
