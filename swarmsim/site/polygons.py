"""Faces of more than three corners as triangles, concave ones included."""

from functools import lru_cache

import numpy as np

from swarmsim.site.mesh_parts import Floats, Integers

CONCAVE_MAX = 1000
"""Corners of a concave face: ear clipping takes a time that grows with their square."""
CONCAVE_TOTAL_MAX = 50_000
"""Corners of all concave faces of a file."""
ROUND = 8  # convex faces of more corners are halved again and again: a fan would give slivers across the whole face
FORCED_MAX = 3  # corners clipped where there is no ear, before the rest is cut as a fan
_FLAT = 1e-9  # of the area: smaller turns are rounding


class PolygonError(ValueError):
    """A face has too many corners to be cut into triangles; the text is a sentence for the user."""


def triangulated(points: Floats, counts: Integers) -> tuple[Integers, Integers]:
    """Triangles [t, 3] that fill polygons, as rows of ``points``, and the polygon [t] of each; ordered by polygon.

    ``points`` [c, 3] are the corners of one polygon after the other, ``counts`` [p] how many each has. Polygons of
    fewer than three corners are left out. Raises `PolygonError` beyond `CONCAVE_MAX` and `CONCAVE_TOTAL_MAX`.
    """
    first = np.cumsum(counts) - counts
    triangles: list[Integers] = []
    polygons: list[Integers] = []
    concave = 0
    for n in (int(count) for count in np.unique(counts) if count >= 3):
        which = np.flatnonzero(counts == n)
        own = points[first[which][:, None] + np.arange(n)]
        fans, convex = _simple(own)
        chosen = [(fans & ~convex, fan(n)), (convex, halved(n) if n > ROUND else fan(n))]
        for turned in range(1, min(n, ROUND)):  # most concave faces are a fan from one of their corners
            rest = np.flatnonzero(~fans)
            more = np.zeros(len(own), bool)
            more[rest] = _simple(np.roll(own[rest], -turned, axis=1))[0]
            chosen.append((more, (fan(n) + turned) % n))
            fans |= more
        for mask, pattern in chosen:
            triangles.append((first[which[mask]][:, None, None] + pattern).reshape(-1, 3))
            polygons.append(np.repeat(which[mask], n - 2))
        rest = np.flatnonzero(~fans)
        concave += n * len(rest)
        _check(n if len(rest) else 0, concave)
        for k in rest:
            cut = clipped(_seen_from_above(own[k]))
            triangles.append(first[which[k]] + cut)
            polygons.append(np.full(len(cut), which[k]))
    if not triangles:
        return np.empty((0, 3), np.int64), np.empty(0, np.int64)
    polygon = np.concatenate(polygons)
    order = np.argsort(polygon, kind="stable")
    return np.concatenate(triangles)[order], polygon[order]


def _check(corners: int, total: int) -> None:
    if corners > CONCAVE_MAX:
        raise PolygonError(f"a concave face has {corners:,} corners, more than {CONCAVE_MAX:,}")
    if total > CONCAVE_TOTAL_MAX:
        raise PolygonError(f"its concave faces have more than {CONCAVE_TOTAL_MAX:,} corners in all")


def _simple(corners: Floats) -> tuple[np.ndarray, np.ndarray]:
    """Which polygons [p, n, 3] a fan from the first corner fills, and which of those are convex."""
    if corners.shape[1] == 3:
        return np.ones(len(corners), bool), np.zeros(len(corners), bool)
    # From the first corner, so that coordinates far from the origin keep their digits.
    own = corners - corners[:, :1]
    normal = np.cross(own[:, 1:-1], own[:, 2:]).sum(axis=1)  # Newell: twice the area, along the normal
    least = -_FLAT * (normal**2).sum(axis=1)[:, None]
    sides = np.roll(own, -1, axis=1) - own

    def none_back(one: Floats, other: Floats) -> np.ndarray:
        inside: np.ndarray = ((np.cross(one, other) @ normal[:, :, None])[..., 0] >= least).all(axis=1)
        return inside

    fans = none_back(own[:, 1:-1], own[:, 2:])
    return fans, fans & none_back(sides, np.roll(sides, -1, axis=1))


def fan(n: int) -> Integers:
    """Triangles [n - 2, 3] of a polygon of ``n`` corners, all from the first."""
    k = np.arange(1, n - 1)
    return np.column_stack([np.zeros_like(k), k, k + 1])


@lru_cache(maxsize=64)
def halved(n: int) -> Integers:
    """Triangles [n - 2, 3] of a convex polygon of ``n`` corners, cut in halves again and again."""
    found, open_ends = [], [(0, n - 1)]
    while open_ends:
        low, high = open_ends.pop()
        if high - low > 1:
            middle = (low + high) // 2
            found.append((low, middle, high))
            open_ends += [(low, middle), (middle, high)]
    return np.array(found)


def _seen_from_above(corners: Floats) -> Floats:
    """A polygon [n, 3] in the plane of its two longer axes [n, 2], counter-clockwise."""
    own = corners - corners[0]
    normal = np.cross(own[1:-1], own[2:]).sum(axis=0)
    up = int(np.argmax(np.abs(normal)))
    one, other = ((1, 2), (2, 0), (0, 1))[up]
    return own[:, [one, other] if normal[up] >= 0.0 else [other, one]]


def clipped(xy: Floats) -> Integers:
    """Triangles [t, 3] of a polygon [n, 2], counter-clockwise, by clipping ears (Meisters, 1975).

    A polygon that crosses itself has no right answer; it is cut into n - 2 triangles or fewer all the same.
    """
    n = len(xy)
    after, before = [*range(1, n), 0], [n - 1, *range(n - 1)]
    x, y = xy[:, 0].tolist(), xy[:, 1].tolist()

    def turn(k: int) -> float:
        a, c = before[k], after[k]
        return (x[k] - x[a]) * (y[c] - y[a]) - (y[k] - y[a]) * (x[c] - x[a])

    reflex = np.array([turn(k) < 0.0 for k in range(n)])

    def is_ear(k: int) -> bool:
        bend = turn(k)
        return bend == 0.0 or (bend > 0.0 and _free(xy, reflex, before[k], k, after[k]))

    ears = [is_ear(k) for k in range(n)]
    found: list[tuple[int, int, int]] = []
    k, left, passed, forced = 0, n, 0, 0
    while left > 2:
        if passed > left:  # no ear: looked for anew, and if there is none, the polygon crosses itself
            ring, passed = _ring(after, k), 0
            if forced == FORCED_MAX:
                return np.array([*found, *np.array(ring)[fan(left)]], np.int64)
            for i in ring:
                ears[i] = is_ear(i)
            if not any(ears[i] for i in ring):
                ears[k], forced = True, forced + 1
        a, c = before[k], after[k]
        if not ears[k]:
            k, passed = c, passed + 1
            continue
        if turn(k) != 0.0:
            found.append((a, k, c))
        after[a], before[c], reflex[k] = c, a, False
        reflex[a], reflex[c] = turn(a) < 0.0, turn(c) < 0.0
        ears[a], ears[c] = is_ear(a), is_ear(c)
        left, passed = left - 1, 0
        k = after[c]  # every second corner: clipping one after the other would give slivers
    return np.array(found, np.int64).reshape(-1, 3)


def _ring(after: list[int], start: int) -> list[int]:
    """The corners that are left."""
    found, k = [start], after[start]
    while k != start:
        found.append(k)
        k = after[k]
    return found


def _free(xy: Floats, reflex: np.ndarray, a: int, b: int, c: int) -> bool:
    """Whether the triangle a b c, counter-clockwise, holds no reflex corner other than its own."""
    others = np.flatnonzero(reflex)
    if len(others) == 0:
        return True
    p, corners = xy[others], xy[[a, b, c]]
    way, offset = np.roll(corners, -1, axis=0) - corners, p[:, None] - corners
    within = (way[:, 0] * offset[..., 1] - way[:, 1] * offset[..., 0] >= 0.0).all(axis=1)
    # A hole is joined to the outline by an edge that is run twice: its corners stand there twice too.
    return not (within & (offset != 0.0).any(axis=2).all(axis=1)).any()
