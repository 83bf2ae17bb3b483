"""Parameters of the stand-in, and how each autopilot writes their values into a float of the wire."""

import struct

from pymavlink.dialects.v20 import ardupilotmega as mav

Number = int | float


class Parameters:
    """Names and values in the order of the list. Integers stay integers."""

    def __init__(self, values: dict[str, Number], bit_patterns: bool):
        """Take ``values``; with ``bit_patterns`` (PX4) the bits of an integer travel in the float's place."""
        self._values = dict(values)
        self._bits = bit_patterns
        self.names = tuple(self._values)

    def __getitem__(self, name: str) -> Number:
        return self._values[name]

    def get(self, name: str, default: Number) -> Number:
        """The value, or ``default`` for an autopilot without that parameter."""
        return self._values.get(name, default)

    def put(self, name: str, value: Number) -> None:
        """Set a value as the vehicle's owner would; KeyError for an unknown name."""
        whole = isinstance(self._values[name], int)
        self._values[name] = int(value) if whole else float(value)

    def message(self, name: str) -> mav.MAVLink_param_value_message:
        """PARAM_VALUE of one parameter."""
        value = self._values[name]
        whole = isinstance(value, int)
        kind = mav.MAV_PARAM_TYPE_INT32 if whole else mav.MAV_PARAM_TYPE_REAL32
        carried = _as_bits(int(value)) if whole and self._bits else float(value)
        return mav.MAVLink_param_value_message(
            name.encode()[:16], carried, kind, len(self.names), self.names.index(name)
        )

    def asked(self, name: str, index: int) -> str | None:
        """The parameter that PARAM_REQUEST_READ means; None where there is none."""
        if index >= 0:
            return self.names[index] if index < len(self.names) else None
        return name if name in self._values else None

    def set(self, name: str, carried: float, kind: int) -> str | None:
        """Set from the wire; the name to answer with, None where there is nothing to answer.

        PX4 refuses a value of the wrong type and answers with nothing; ArduPilot takes any type by value.
        """
        if name not in self._values:
            return None
        whole = isinstance(self._values[name], int)
        if self._bits:
            if kind != (mav.MAV_PARAM_TYPE_INT32 if whole else mav.MAV_PARAM_TYPE_REAL32):
                return None
            value: Number = _of_bits(carried) if whole else carried
        else:
            value = carried
        if value != value or abs(value) > 2**31:
            return name
        self._values[name] = round(value) if whole else float(value)
        return name


def _as_bits(value: int) -> float:
    bits: float = struct.unpack("<f", struct.pack("<i", value))[0]
    return bits


def _of_bits(value: float) -> int:
    whole: int = struct.unpack("<i", struct.pack("<f", value))[0]
    return whole
