"""Where along a track a vehicle was, and how far from it: without regard to when."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]
MATCHED_MAX = 2000  # rows and columns of a match
HEIGHT_SHARE = 0.1  # of a difference in height that counts as one aside
_THIN_M, _PIECE_M = 0.05, 0.25  # shortest and longest pieces that a track is cut into
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


def distance_from(place_m: Floats, track_m: Floats) -> Floats:
    """Least horizontal distances [n] of places [n, 2 or 3] from a track [m, 3], to millimetres."""
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
    distance = np.full(len(places), np.inf)
    for first in (near - 1, near):
        a = ends[np.clip(first, 0, len(ends) - 1)]
        step = ends[np.clip(first + 1, 0, len(ends) - 1)] - a
        offset = places[:, None] - a
        length2 = np.maximum(np.sum(step * step, axis=2), 1e-12)
        part = np.clip(np.sum(offset * step, axis=2) / length2, 0.0, 1.0)
        apart = np.linalg.norm(offset - part[..., None] * step, axis=2)
        distance = np.minimum(distance, np.min(apart, axis=1))
    return distance
