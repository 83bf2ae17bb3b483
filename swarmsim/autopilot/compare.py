"""How far a flown track lies from the planned paths, and from the simulated track of the same mission.

Two kinds of error are told apart, and neither stands for the other:

- *Geometric*: the least horizontal distance of each place that was flown from a line, whenever it was flown: from the
  planned path of its phase (cross-track error), and from the simulated track. A vehicle that is merely late has none:
  the phase is the one that the simulated vehicle was in where it was next to that place, in the order of the flight.
- *Time-synchronised*: the horizontal distance between the flown and the simulated vehicle at the same time, after one
  constant shift of time, the one with the least rms over what was flown (`time_shift_s`). It holds lags along the
  track, and whatever differs in take-off, corners and speed after that one shift. A flight's clock and a mission's have
  no common zero, so that without a shift the number would mean nothing.

"Simulated against firmware in the loop, same mission" is the time-synchronised rms over the whole common time, nothing
left out; geometric errors are those of all that is judged, also before and after it. "On the lines" leaves out corners,
take-off and landing: samples where the horizontal speed (simulated, or flown where nothing was simulated) is below 0.7
of its greatest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from swarmsim.autopilot.along_track import distance_from, matched, nearest

Floats = NDArray[np.float64]
ON_LINE_SHARE = 0.7  # of the greatest speed: slower parts are corners, take-off and landing
STEP_S = 0.05  # of the times at which tracks are compared
GAP_S, GAP_PERIODS, GAP_MOST_S = 1.0, 2.5, 3.0  # see `Track.gap_s`
CAP_M = 5.0  # what is farther apart fits no better or worse: several times what lags and estimates make
CORNER_M = 0.5  # a path that bends by less is one leg
LEG_M = 2.0  # shorter ones are corners
LONG_S = 50_000.0
_COARSE_S, _COARSE_MAX, _SHIFTS_MAX = 0.25, 2000, 8000  # first search for the shift: step, most samples, most shifts
_SPEED_OVER_S = 1.0
_MOVING_SHARE, _STANDING = 0.2, 0.1  # of the greatest speed: slower is standing, which counts so much in a shift
_COMMON_SHARE = 0.2  # of the shorter flight, for which both move at the same time at least
_TIE_M = 0.5  # a shift over the whole search must make an rms better by as much as this


@dataclass(frozen=True)
class Track:
    """Positions [n, 3] in the world (ENU) at increasing times [n]."""

    time_s: Floats
    position_m: Floats

    @property
    def gap_s(self) -> float:
        """Longest time between two positions that is bridged: 1 s, or 2.5 times the usual one up to 3 s."""
        usual = float(np.median(np.diff(self.time_s))) if len(self.time_s) > 1 else 0.0
        return max(GAP_S, min(GAP_PERIODS * usual, GAP_MOST_S))

    def at(self, time_s: ArrayLike) -> Floats:
        """Positions [m, 3] at ``time_s`` [m], linear in between; NaN outside, and in gaps (`gap_s`)."""
        times = np.asarray(time_s, np.float64)
        if not len(self.time_s):
            return np.full((len(times), 3), np.nan)
        columns = [np.interp(times, self.time_s, column, np.nan, np.nan) for column in self.position_m.T]
        after = np.clip(np.searchsorted(self.time_s, times), 1, max(1, len(self.time_s) - 1))
        gap = self.time_s[np.minimum(after, len(self.time_s) - 1)] - self.time_s[after - 1] > self.gap_s
        return np.where(gap[:, None], np.nan, np.stack(columns, axis=1))

    def speed_m_s(self, time_s: Floats) -> Floats:
        """Horizontal speeds [m], over 1 s around each time or what there is of it."""
        half = 0.5 * _SPEED_OVER_S
        low, high = self.time_s[[0, -1]]
        a, b = np.clip(time_s - half, low, high), np.clip(time_s + half, low, high)
        way = np.linalg.norm((self.at(b) - self.at(a))[:, :2], axis=1)
        return way / np.maximum(b - a, 1e-9)

    def within(self, spans_s: Sequence[tuple[float, float]]) -> "Track":
        """What lies in one of the spans."""
        keep = np.zeros(len(self.time_s), bool)
        for a, b in spans_s:
            keep |= (self.time_s >= a) & (self.time_s <= b)
        return Track(self.time_s[keep], self.position_m[keep])


@dataclass(frozen=True)
class Planned:
    """The path [P, 3] that a phase plans for the vehicle."""

    phase: str
    points_m: Floats


@dataclass(frozen=True)
class Simulated:
    """The track of the mission's own simulated vehicle."""

    track: Track
    phase: NDArray[np.int64]  # [n] index into the planned paths, -1 where there is none
    seed: int = 0


@dataclass(frozen=True)
class Comparison:
    """Errors at times [k] of the flown track's clock; NaN where there is nothing to compare with."""

    time_s: Floats
    shift_s: float | None  # to be added to the simulated track's times; None: nothing simulated, or no common part
    cross_track_m: Floats  # horizontal distance from the planned path
    above_path_m: Floats  # height over the planned path there
    synchronised_m: Floats  # horizontal distance from the simulated vehicle at the same time
    above_m: Floats  # height over it
    from_simulated_m: Floats  # horizontal distance from its track
    on_lines: NDArray[np.bool_]
    phase: NDArray[np.int64]  # index into ``phases``, -1 where it is not known
    leg: NDArray[np.int64]  # number of the straight part of the path that is nearest, -1 where none is
    phases: tuple[str, ...]

    def measures(self) -> dict[str, Floats]:
        """The errors by the names that reports have."""
        return {
            "cross_track": self.cross_track_m,
            "above_path": self.above_path_m,
            "synchronised": self.synchronised_m,
            "above_simulated": self.above_m,
            "from_simulated_track": self.from_simulated_m,
        }

    def report(self) -> dict[str, Any]:
        """Sums for a file: m and s; over all that is judged, on the lines alone, by phase, and by leg on the lines."""
        common = self.time_s[np.isfinite(self.synchronised_m)]
        everywhere = np.ones(len(self.time_s), bool)
        return {
            "time_shift_s": self.shift_s,
            "from_s": float(self.time_s[0]) if len(self.time_s) else None,
            "to_s": float(self.time_s[-1]) if len(self.time_s) else None,
            "common_from_s": float(common[0]) if len(common) else None,
            "common_to_s": float(common[-1]) if len(common) else None,
            "whole": self._of(everywhere),
            "on_lines": self._of(self.on_lines),
            "phases": [{"phase": name} | self._of(self.phase == k) for k, name in enumerate(self.phases)],
            "legs": [
                {"phase": self.phases[k], "leg": int(leg) + 1} | {"cross_track": statistics(self.cross_track_m[mask])}
                for k in range(len(self.phases))
                for leg in np.unique(self.leg[(self.phase == k) & (self.leg >= 0)])
                if (mask := (self.phase == k) & (self.leg == leg) & self.on_lines).any()
            ],
        }

    def _of(self, mask: NDArray[np.bool_]) -> dict[str, Any]:
        return {name: statistics(error[mask]) for name, error in self.measures().items()}


def statistics(error_m: Floats) -> dict[str, Any] | None:
    """Number, rms, 95th percentile and greatest of the magnitudes; None where there is none."""
    size = np.abs(error_m[np.isfinite(error_m)])
    if not len(size):
        return None
    return {
        "samples": len(size),
        "rms_m": float(np.sqrt(np.mean(size**2))),
        "p95_m": float(np.percentile(size, 95.0)),
        "max_m": float(np.max(size)),
    }


def compare(
    flown: Track, planned: Sequence[Planned] = (), simulated: Simulated | None = None,
    spans_s: Sequence[tuple[float, float]] | None = None,
) -> Comparison:  # fmt: skip
    """The errors of a flown track, of which ``spans_s`` alone are judged if given."""
    judged = flown if spans_s is None else flown.within(spans_s)
    shift = None if simulated is None else time_shift_s(judged, simulated.track)
    time_s = _times(judged)
    place = judged.at(time_s)
    known = np.isfinite(place).all(axis=1)
    time_s, place = time_s[known], place[known]
    nothing = np.full(len(time_s), np.nan)
    synchronised, above, apart, phase = nothing, nothing, nothing, np.full(len(time_s), -1)
    speed = judged.speed_m_s(time_s) if len(time_s) else nothing
    if simulated is not None and shift is not None and len(time_s):
        leader, own = simulated.track, time_s - shift
        there = leader.at(own)
        synchronised = np.linalg.norm((place - there)[:, :2], axis=1)
        above = place[:, 2] - there[:, 2]
        apart = distance_from(place, leader.position_m)
        phase = simulated.phase[matched(place, leader.position_m)]
        common = np.isfinite(synchronised)
        speed[common] = leader.speed_m_s(own[common])
    elif len(planned) == 1:
        phase = np.zeros(len(time_s), int)
    distance, height, leg = _from_paths(place, planned, phase)
    return Comparison(
        time_s=time_s,
        shift_s=shift,
        cross_track_m=distance,
        above_path_m=place[:, 2] - height,
        synchronised_m=synchronised,
        above_m=above,
        from_simulated_m=apart,
        on_lines=on_lines(speed),
        phase=np.asarray(phase),
        leg=leg,
        phases=tuple(path.phase for path in planned),
    )


def _times(flown: Track) -> Floats:
    """Evenly spaced times of what was flown; in a very long flight its own."""
    if not len(flown.time_s):
        return np.zeros(0)
    low, high = float(flown.time_s[0]), float(flown.time_s[-1])
    if high - low > LONG_S:
        return flown.time_s
    return np.asarray(low + STEP_S * np.arange(int((high - low) / STEP_S + 1e-6) + 1), np.float64)


def on_lines(speed_m_s: Floats) -> NDArray[np.bool_]:
    """Where a speed [n] is nearly the greatest."""
    known = np.isfinite(speed_m_s)
    top = float(np.max(speed_m_s[known])) if known.any() else 0.0
    return np.asarray(known & (speed_m_s > ON_LINE_SHARE * top))


def _from_paths(
    place_m: Floats, planned: Sequence[Planned], phase: NDArray[np.int64]
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Distance from the path of the phase, or from the nearest path where that is not known, height and leg there."""
    distance = np.full(len(place_m), np.inf)
    height, leg = np.full(len(place_m), np.nan), np.full(len(place_m), -1)
    for k, path in enumerate(planned):
        mine = np.flatnonzero((phase == k) | (phase < 0))
        if not len(path.points_m) or not len(mine):
            continue
        apart, up, along = nearest(place_m[mine], path.points_m)
        closer = apart < distance[mine]
        rows = mine[closer]
        distance[rows], height[rows] = apart[closer], up[closer]
        leg[rows] = np.searchsorted(leg_ends_m(path.points_m), along[closer], "left")
    return np.where(np.isfinite(distance), distance, np.nan), height, leg


def leg_ends_m(path_m: Floats) -> Floats:
    """Arc lengths at which the straight parts of a path [P, 3] end, but the last (Douglas-Peucker, 0.5 m)."""
    plane = np.asarray(path_m, np.float64)[:, :2]
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(plane, axis=0), axis=1))]
    corners, open_ = {0, len(plane) - 1}, [(0, len(plane) - 1)]
    while open_:
        a, b = open_.pop()
        if b - a < 2:
            continue
        apart = nearest(plane[a + 1 : b], np.c_[plane[[a, b]], [0.0, 0.0]])[0]
        worst = int(np.argmax(apart))
        if apart[worst] > CORNER_M:
            corners.add(a + 1 + worst)
            open_ += [(a, a + 1 + worst), (a + 1 + worst, b)]
    ends = along[sorted(corners)][1:]
    kept: list[float] = []
    for end in ends[:-1]:
        if end - (kept[-1] if kept else 0.0) >= LEG_M:
            kept.append(float(end))
    return np.array(kept)


def time_shift_s(flown: Track, simulated: Track) -> float | None:
    """What to add to the simulated times so that the horizontal distance of both at the same time has the least rms.

    Every shift is judged by all that was flown: the simulated vehicle stands at its ends before and after its track, so
    that a flight may begin before it on the ground and be broken off at any time. Both are under way at the same time
    for a fifth of the shorter flight at least. Distances count up to `CAP_M` where more than half of the flight fits
    so, as what follows when it is broken off belongs to no simulated track; else it was flown elsewhere, and what all
    distances have in common does not count. Where it stands it hardly counts. Of shifts that fit equally well, as on
    laps, both set out together with the one taken.
    None where nothing was flown without gaps, or nothing simulated.
    """
    if len(flown.time_s) < 2 or len(simulated.time_s) < 2:
        return None
    low, high = flown.time_s[0] - simulated.time_s[-1], flown.time_s[-1] - simulated.time_s[0]
    span = float(high - low)
    fit = _Fit.of(flown, simulated, _COARSE_S, _COARSE_MAX)
    if fit is None:
        return None
    step = max(_COARSE_S, span / _SHIFTS_MAX)
    shifts = low + step * np.arange(int(span / step) + 2)
    moved, moves = _moving_s(flown), _moving_s(simulated)
    together = moved[0] - moves[0]
    both = np.minimum(moved[1], moves[1] + shifts) - np.maximum(moved[0], moves[0] + shifts)
    enough = both >= _COMMON_SHARE * min(moved[1] - moved[0], moves[1] - moves[0])
    for centred, cap in ((False, CAP_M), (True, np.inf)):
        errors = np.array([fit.squares(float(shift), centred) for shift in shifts])
        rough = np.minimum(errors, cap**2) @ fit.weights + _TIE_M**2 * np.abs(shifts - together) / span
        rough = np.where(enough, rough, np.inf) if enough.any() else rough
        best = int(np.argmin(rough))
        if float((errors[best] < CAP_M**2) @ fit.weights) > 0.5:
            break
    fine = _Fit.of(flown, simulated, STEP_S, 20_000) or fit

    def cost(shift: float) -> float:
        return float(np.minimum(fine.squares(shift, centred), cap**2) @ fine.weights)

    first = float(shifts[best])
    near = minimize_scalar(cost, bounds=(first - step, first + step), method="bounded", options={"xatol": 1e-4})
    return float(near.x) if near.fun <= cost(first) else first


@dataclass(frozen=True)
class _Fit:
    """Places [n, 2] of a flown track at times [n] with weights [n], to be compared with a simulated one."""

    time_s: Floats
    place_m: Floats
    weights: Floats
    simulated: Track

    @classmethod
    def of(cls, flown: Track, simulated: Track, step_s: float, most: int) -> "_Fit | None":
        """At times ``step_s`` apart, or at ``most`` times; None where there is no flown place."""
        span = float(flown.time_s[-1] - flown.time_s[0])
        times, place = _grid(flown, min(max(step_s, span / most), span / 8.0))
        known = np.isfinite(place).all(axis=1)
        if not known.any():
            return None
        times, place = times[known], place[known, :2]
        weights = np.where(_moves(flown, times), 1.0, _STANDING)
        return cls(times, place, weights / np.sum(weights), simulated)

    def squares(self, shift_s: float, centred: bool = False) -> Floats:
        """Squares [n] of the distances from the simulated vehicle, which stands at its ends before and after.

        ``centred``: without the part that is the same everywhere.
        """
        own, track = self.time_s - shift_s, self.simulated
        there = np.stack([np.interp(own, track.time_s, column) for column in track.position_m.T[:2]], axis=1)
        apart = self.place_m - there
        apart = apart - self.weights @ apart if centred else apart
        error: Floats = np.sum(apart * apart, axis=1)
        return error


def _moves(track: Track, time_s: Floats) -> NDArray[np.bool_]:
    """Whether [n] the vehicle moves over the ground; everywhere where it stands all along."""
    speed = np.nan_to_num(track.speed_m_s(time_s))
    moves = speed > _MOVING_SHARE * float(np.percentile(speed, 95.0))
    return np.asarray(moves if moves.any() else ~moves)


def _moving_s(track: Track) -> tuple[float, float]:
    """When the vehicle sets out, and when it has arrived."""
    times = _grid(track, max(_COARSE_S, float(track.time_s[-1] - track.time_s[0]) / _COARSE_MAX))[0]
    moves = np.flatnonzero(_moves(track, times))
    return float(times[moves[0]]), float(times[moves[-1]])


def _grid(track: Track, step_s: float) -> tuple[Floats, Floats]:
    times = np.arange(float(track.time_s[0]), float(track.time_s[-1]) + 0.5 * step_s, step_s)
    return times, track.at(np.minimum(times, track.time_s[-1]))
