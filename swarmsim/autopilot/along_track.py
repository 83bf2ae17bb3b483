"""Where along a track a vehicle was, and how far from it: without regard to when."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]
MATCHED_MAX = 2000  # rows and columns of a match
HEIGHT_SHARE = 0.1  # of a difference in height that counts as one aside
_THIN_M, _PIECE_M = 0.05, 0.25  # shortest and longest pieces that a track is cut into
_CHUNK = 256  # places at a time
_NEAR = 8  # ends of pieces that are looked at


def matched(place_m: Floats, track_m: Floats) -> NDArray[np.intp]:
    """Rows [n] of a track [m, 3], never going back, that are nearest to places [n, 3] flown one after the other.

    The sum of the distances is the least of all such assignments, so that a vehicle that is late or early, waits or
    leaves something out is where it is, and one that is aside stays beside its own part of the track. In long tracks
    every k-th place and row is looked at.
    """
    rows, columns = (
        np.unique(np.linspace(0, len(x) - 1, min(len(x), MATCHED_MAX)).astype(int)) for x in (place_m, track_m)
    )
    scale = np.array([1.0, 1.0, HEIGHT_SHARE])
    places, track = place_m[rows] * scale, track_m[columns] * scale
    best = np.empty((len(rows), len(columns)), np.int32)  # column of the place before
    total = np.zeros(len(columns))
    index = np.arange(len(columns), dtype=np.int32)
    for k, place in enumerate(places):
        lowest = np.minimum.accumulate(total)
        # the first column with the lowest sum so far
        best[k] = np.maximum.accumulate(np.where(np.r_[True, total[1:] < lowest[:-1]], index, 0))
        total = lowest + np.linalg.norm(track - place, axis=1)
    column = np.empty(len(rows), np.intp)
    at = int(np.argmin(total))
    for k in range(len(rows) - 1, -1, -1):
        column[k] = at
        at = int(best[k, at])
    latest = np.searchsorted(rows, np.arange(len(place_m)), "right") - 1
    return np.asarray(columns[column[latest]], np.intp)


def nearest(places_m: ArrayLike, path_m: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Of places the horizontal distance [n] from a polyline [P, 3], and its height and arc length there [n].

    With places [n, 3] their heights tell apart the parts of a path that lie over each other, as where it climbs
    upright or crosses itself; [n, 2] does without.
    """
    places, path = np.asarray(places_m, np.float64), np.asarray(path_m, np.float64)
    if len(path) == 1:
        path = np.concatenate([path, path])
    start, step = path[:-1], np.diff(path, axis=0)
    along = np.r_[0.0, np.cumsum(np.linalg.norm(step[:, :2], axis=1))]
    distance, height, arc = (np.full(len(places), np.nan) for _ in range(3))
    for first in range(0, len(places), _CHUNK):
        part = slice(first, first + _CHUNK)
        share, apart = _foot(places[part, None, :2] - start[:, :2], step[:, :2])
        cost = apart
        if places.shape[1] > 2:
            up = places[part, None, 2] - start[:, 2] - share * step[:, 2]
            cost = apart + (HEIGHT_SHARE * up) ** 2
        best = np.argmin(cost, axis=1)
        row = np.arange(len(best))
        distance[part] = np.sqrt(apart[row, best])
        height[part] = start[best, 2] + share[row, best] * step[best, 2]
        arc[part] = along[best] + share[row, best] * (along[best + 1] - along[best])
    return distance, height, arc


def _foot(offset_m: Floats, step_m: Floats) -> tuple[Floats, Floats]:
    """Shares [...] of segments ``step_m`` [..., 2] next to places ``offset_m`` [..., 2] from their starts, and the
    squared distances [...] there."""
    length2 = np.maximum(np.sum(step_m * step_m, axis=-1), 1e-12)
    share = np.clip(np.sum(offset_m * step_m, axis=-1) / length2, 0.0, 1.0)
    return share, np.sum((offset_m - share[..., None] * step_m) ** 2, axis=-1)


def distance_from(place_m: Floats, track_m: Floats) -> Floats:
    """Least horizontal distances [n] of places [n, 2 or 3] from a track [m, 3], as long as a flight makes it.

    As `nearest` but for windings of the track below 5 cm, which are cut short; in a time that does not grow with the
    product of both lengths.
    """
    points = np.asarray(track_m, np.float64)[:, :2]
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    kept = np.r_[0, np.flatnonzero(np.diff(np.floor(along / _THIN_M)) > 0.0) + 1, len(points) - 1]
    points, along = points[kept], along[kept]
    pieces = np.maximum(1, np.ceil(np.diff(along) / _PIECE_M)).astype(int)
    start = np.repeat(np.arange(len(pieces)), pieces)
    share = (np.arange(len(start)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[start]
    ends = points[start] + share[:, None] * (points[start + 1] - points[start])
    ends = np.concatenate([ends, points[-1:]])
    places = np.asarray(place_m, np.float64)[:, :2]
    count = min(_NEAR, len(ends))
    near = np.reshape(cKDTree(ends).query(places, k=count)[1], (len(places), count))
    squared = np.full(len(places), np.inf)
    for first in (near - 1, near):
        a = ends[np.clip(first, 0, len(ends) - 1)]
        step = ends[np.clip(first + 1, 0, len(ends) - 1)] - a
        squared = np.minimum(squared, np.min(_foot(places[:, None] - a, step)[1], axis=1))
    return np.asarray(np.sqrt(squared), np.float64)
