"""What a log tells of one vehicle's flight, whatever wrote it: `FlightLog`.

World ENU about the log's origin, body FLU, SI units. Times are those of the vehicle's clock, less that of its first
position.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarmsim.autopilot.frames import Geodetic, enu_of_ned, moved_origin, quaternion_enu_of_ned
from swarmsim.autopilot.link import LinkError
from swarmsim.autopilot.mavlink.profile import AUTOPILOTS, Profile, detect_profile, load_autopilot
from swarmsim.config.errors import InputError

Floats = NDArray[np.float64]
Format = Literal["tlog", "bin", "ulg"]
STALE_S = 1.0  # an attitude older than this is not that of a position
BACK_S = 1.0  # positions that are told in another order than they were taken lie less apart
UNKNOWN = "unknown"
_NEIGHBOURS = 7  # positions by which one is judged
_FAR_S, _FAR_M = 60.0, 100.0
_ABSURD = 1e10
_FAST_M_S = 1e4
_AROUND_S = 3600.0
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")


@dataclass(frozen=True)
class Change:
    """From ``time_s`` on it was ``name``: a mode, armed or disarmed, something that the vehicle told in words."""

    time_s: float
    name: str


@dataclass(frozen=True)
class Series:
    """Values [n, ...] at times [n]."""

    time_s: Floats
    values: Floats


@dataclass(frozen=True)
class FlightLog:
    """The flight of one vehicle as a log has it; NaN for what is not known."""

    format: Format
    autopilot: str  # px4 | ardupilot | unknown
    vehicle: str  # copter | rover | unknown
    system: int | None  # system id
    origin: Geodetic | None  # of the positions; None where the log does not tell it
    time_s: Floats  # [n], increasing
    position_m: Floats  # [n, 3] east, north and up of the origin
    velocity_m_s: Floats  # [n, 3]
    quaternion: Floats  # [n, 4] w x y z, body to world
    modes: tuple[Change, ...]
    armed: tuple[Change, ...]  # armed | disarmed
    messages: tuple[Change, ...]
    battery: Series  # [k] share of the capacity that is left
    setpoints: Series  # [m, 3] positions that it was to have; NaN where it had none
    follow_modes: tuple[str, ...] = ()  # those in which it follows setpoints
    notes: tuple[str, ...] = ()  # what of the file could not be read

    def spans_s(self) -> list[tuple[float, float]]:
        """When the vehicle flew by setpoints and was not disarmed; else when it was armed; else the whole log."""
        whole = (float(self.time_s[0]), float(self.time_s[-1]))
        still = _during(self.armed, ("disarmed",), whole[1])
        for found in (_during(self.modes, self.follow_modes, whole[1]), _during(self.armed, ("armed",), whole[1])):
            spans = [part for span in found for part in _without(span, still)]
            if spans:
                return spans
        return [whole]

    def moved_to(self, origin: Geodetic) -> "FlightLog":
        """The same with its positions about another origin, which must not be farther than the Earth is flat."""
        if self.origin is None:
            raise ValueError("the log's origin is not known")

        def moved(position_m: Floats) -> Floats:
            return moved_origin(position_m, self.origin, origin) if len(position_m) else position_m  # type: ignore[arg-type]

        setpoints = replace(self.setpoints, values=moved(self.setpoints.values))
        return replace(self, origin=origin, position_m=moved(self.position_m), setpoints=setpoints)

    def shifted(self, offset_m: ArrayLike) -> "FlightLog":
        """The same with ``offset_m`` [3] added to its positions, in a frame without a known place on the Earth."""
        offset = np.asarray(offset_m, np.float64)
        setpoints = replace(self.setpoints, values=self.setpoints.values + offset)
        return replace(self, origin=None, position_m=self.position_m + offset, setpoints=setpoints)


def _during(changes: Sequence[Change], names: Sequence[str], end_s: float) -> list[tuple[float, float]]:
    """When one of ``names`` held."""
    ends = [change.time_s for change in changes[1:]] + [end_s]
    return [(c.time_s, end) for c, end in zip(changes, ends, strict=False) if c.name in names and end > c.time_s]


def _without(span: tuple[float, float], others: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """What is left of a span outside of ``others``, which are in order."""
    left, (start, end) = [], span
    for a, b in others:
        if a > start:
            left.append((start, min(a, end)))
        start = max(start, b)
    return [(a, b) for a, b in [*left, (start, end)] if b > a and a < end]


@dataclass
class Collected:
    """What a reader has found in a log, on the vehicle's clock in s, in NED and FRD about ``origin``."""

    time_s: Floats
    position_ned_m: Floats  # [n, 3]
    velocity_ned_m_s: Floats  # [n, 3]
    attitude: Series  # [k, 4] w x y z, FRD to NED
    modes: Sequence[tuple[float, str]] = ()
    armed: Sequence[tuple[float, bool]] = ()
    messages: Sequence[tuple[float, str]] = ()
    battery: Series | None = None
    setpoints_ned_m: Series | None = None
    origin: Geodetic | None = None


def empty(width: int) -> Series:
    """A series of vectors [0, width]."""
    return Series(np.zeros(0), np.zeros((0, width)))


def assembled(
    found: Collected, format_: Format, profile: Profile | None, autopilot: str, system: int | None, notes: Sequence[str]
) -> FlightLog:
    """The flight that was collected: in ENU and FLU, in order of time, which begins with the first position.

    Of positions at the same time the last counts. Raises `InputError` where there is none.
    """
    notes = list(notes)
    known = np.isfinite(found.position_ned_m).all(axis=1)
    sound = np.flatnonzero(known)[_sound(found.time_s[known], found.position_ned_m[known])]
    if len(sound) < known.sum():
        notes.append(f"{known.sum() - len(sound)} positions are far from those before and after them: left out")
    order = sound[_increasing(found.time_s[sound])]
    if not len(order):
        raise InputError.of(
            "the log holds no position that makes sense", suggestion="the vehicle had no position estimate"
        )
    back = int((np.diff(found.time_s[sound]) < -BACK_S).sum())
    if back:
        notes.append(f"times go back ({back} x): the log is damaged, or flights after one another lie over each other")
    start = float(found.time_s[order[0]])
    time_s = found.time_s[order] - start
    battery = _ordered(found.battery or Series(np.zeros(0), np.zeros(0)))
    setpoints = _ordered(found.setpoints_ned_m or empty(3))
    velocity = found.velocity_ned_m_s[order]

    span = (start, float(found.time_s[order[-1]]))
    armed = _changes([(when, "armed" if armed else "disarmed") for when, armed in found.armed], span)
    if armed and armed[-1].name == "armed":
        notes.append("the log ends while the vehicle is armed: it was cut, or the vehicle lost its power")
    return FlightLog(
        format=format_,
        autopilot=autopilot,
        vehicle=UNKNOWN if profile is None else profile.vehicle,
        system=system,
        origin=found.origin,
        time_s=time_s,
        position_m=enu_of_ned(found.position_ned_m[order]),
        velocity_m_s=enu_of_ned(np.where(np.abs(velocity) < _FAST_M_S, velocity, np.nan)),
        quaternion=quaternion_enu_of_ned(_nearest(found.attitude, found.time_s[order])),
        modes=_changes(found.modes, span),
        armed=armed,
        messages=_changes(found.messages, span, every=True),
        battery=Series(battery.time_s - start, battery.values),
        setpoints=Series(setpoints.time_s - start, enu_of_ned(setpoints.values)),
        follow_modes=() if profile is None else profile.kind.follow,
        notes=tuple(notes),
    )


def _changes(raw: Sequence[tuple[float, str]], span_s: tuple[float, float], every: bool = False) -> tuple[Change, ...]:
    """In order of time from the begin of the span, without what was told long before or after it."""
    told: list[Change] = []
    for when, name in sorted(raw, key=lambda pair: pair[0]):
        inside = span_s[0] - _AROUND_S < when < span_s[1] + _AROUND_S
        if inside and (every or not told or told[-1].name != readable(name)):
            told.append(Change(float(when) - span_s[0], readable(name)))
    return tuple(told)


def profile_of(autopilot: int, vehicle_type: int) -> tuple[str, Profile | None]:
    """Name of the autopilot, and its profile if it is one of a known kind of vehicle; by MAV_AUTOPILOT and MAV_TYPE."""
    try:
        profile = detect_profile(autopilot, vehicle_type)
    except LinkError:
        known = (name for name in AUTOPILOTS if load_autopilot(name).autopilot == autopilot)
        return next(known, UNKNOWN), None
    return profile.autopilot.name, profile


def readable(text: str) -> str:
    """A text without colours of terminals and other characters that cannot be shown."""
    return "".join(c if c.isprintable() else " " for c in _COLOURS.sub("", text)).strip()


def _sound(time_s: Floats, position_m: Floats) -> NDArray[np.bool_]:
    """Rows [n] in the order of the file that are near the median of their neighbours, in time and in space.

    Two of the three kinds of logs have no checksums: damage there leaves numbers that make no sense.
    """
    right: NDArray[np.bool_] = np.isfinite(time_s)
    reach = _NEIGHBOURS // 2
    for values, far in ((time_s, _FAR_S), *((column, _FAR_M) for column in position_m.T)):
        if len(values) < _NEIGHBOURS:
            right &= np.abs(values) < _ABSURD
            continue
        bounded = np.clip(np.nan_to_num(values, nan=_ABSURD), -_ABSURD, _ABSURD)
        windows = np.lib.stride_tricks.sliding_window_view(bounded, _NEIGHBOURS)
        middle = np.median(windows, axis=1)
        middle = np.r_[[middle[0]] * reach, middle, [middle[-1]] * reach]
        right &= np.abs(bounded - middle) <= far
    return right


def _increasing(time_s: Floats) -> NDArray[np.intp]:
    """Rows in order of time, each time once."""
    rows = np.argsort(time_s, kind="stable")
    return rows[np.r_[np.diff(time_s[rows]) > 0.0, True]] if len(rows) else rows


def _ordered(series: Series) -> Series:
    order = np.argsort(series.time_s, kind="stable")
    return Series(series.time_s[order], series.values[order])


def _nearest(series: Series, time_s: Floats) -> Floats:
    """The values [n, k] of a series that are nearest in time, NaN where none is near."""
    if not len(series.time_s):
        return np.full((len(time_s), series.values.shape[1]), np.nan)
    series = _ordered(series)
    times, values = series.time_s, series.values
    above = np.clip(np.searchsorted(times, time_s), 0, len(times) - 1)
    below = np.maximum(above - 1, 0)
    nearest = np.where(np.abs(times[below] - time_s) <= np.abs(times[above] - time_s), below, above)
    far = np.abs(times[nearest] - time_s) > STALE_S
    return np.where(far[:, None], np.nan, values[nearest])
