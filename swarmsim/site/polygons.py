"""Faces of more than three corners as triangles, concave ones included."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from mapbox_earcut import triangulate_float64
from numpy.typing import NDArray

from swarmsim.site.mesh_parts import Floats, Integers

Mask = NDArray[np.bool_]

CONCAVE_MAX = 3000
"""Corners of the concave faces of a file: the cube root of the sum of their cubes.

Earcut takes a time that grows with the square of a face's corners (0.01 s for 5,000), but with their cube where the
face crosses itself (13 s for 3,000), which is not known beforehand.
"""
ROUND = 8  # convex faces of more corners are halved again and again: a fan would give slivers across the whole face
_FLAT = 1e-9  # of the area: smaller turns are rounding
_FILLED = 1e-6  # of the rectangle around a face: triangles that cover so much more or less than the face fill it


class PolygonError(ValueError):
    """The faces have too many corners to be cut into triangles; the text is a sentence for the user."""


@dataclass
class Cutter:
    """Cuts the faces of one file into triangles."""

    crossed: int = 0  # faces that triangles do not fill, since they cross themselves
    cubes: int = 0  # of the corners of all concave faces so far

    def cut(self, points: Floats, counts: Integers) -> tuple[Integers, Integers]:
        """Triangles [t, 3] that fill polygons, as rows of ``points``, and the polygon [t] of each; ordered by polygon.

        ``points`` [c, 3] are the corners of one polygon after the other, ``counts`` [p] how many each has. Polygons of
        fewer than three corners are left out. One that crosses itself may be filled in parts, in parts twice, or not at
        all, by up to n - 2 triangles. Raises `PolygonError` beyond `CONCAVE_MAX`.
        """
        first = np.cumsum(counts) - counts
        triangles: list[Integers] = []
        polygons: list[Integers] = []
        for n in (int(count) for count in np.unique(counts) if count >= 3):
            which = np.flatnonzero(counts == n)
            # From the first corner, so that coordinates far from the origin keep their digits.
            own = points[first[which][:, None] + np.arange(n)]
            own -= own[:, :1].copy()
            normal = np.cross(own[:, 1:-1], own[:, 2:]).sum(axis=1)  # Newell: twice the area, along the normal
            # What is not finite is refused once the file is read, whatever its triangles are.
            convex = _convex(own, normal) | ~np.isfinite(normal).all(axis=1)
            pattern = halved(n) if n > ROUND else fan(n)
            triangles.append((first[which[convex]][:, None, None] + pattern).reshape(-1, 3))
            polygons.append(np.repeat(which[convex], n - 2))
            if not convex.all():
                rest = which[~convex]
                corners, face = self._concave(own[~convex], normal[~convex])
                triangles.append(first[rest[face]][:, None] + corners)
                polygons.append(rest[face])
        if not triangles:
            return np.empty((0, 3), np.int64), np.empty(0, np.int64)
        polygon = np.concatenate(polygons)
        order = np.argsort(polygon, kind="stable")
        return np.concatenate(triangles)[order], polygon[order]

    def _concave(self, own: Floats, normal: Floats) -> tuple[Integers, Integers]:
        """Triangles [t, 3] of polygons [p, n, 3] with normals [p, 3], as corners, and the polygon [t] of each."""
        n = own.shape[1]
        self.cubes += n**3 * len(own)
        if self.cubes > CONCAVE_MAX**3:
            raise PolygonError(
                f"its concave faces have too many corners, one of them {n:,}: there may be one of {CONCAVE_MAX:,}, or "
                f"1,000 of {CONCAVE_MAX // 10}"
            )
        seen, ends = _seen_from_above(own, normal), np.array([n], np.uint32)
        cuts = [triangulate_float64(xy, ends) for xy in seen]
        corners = np.concatenate(cuts).reshape(-1, 3).astype(np.int64)
        face = np.repeat(np.arange(len(own)), [len(cut) // 3 for cut in cuts])
        a, b, c = np.moveaxis(seen[face[:, None], corners], 1, 0)
        doubled = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        off = np.bincount(face, doubled, minlength=len(own)) - np.abs(normal).max(axis=1)
        self.crossed += int((np.abs(off) > _FILLED * np.ptp(seen, axis=1).prod(axis=1)).sum())
        return corners, face


def _convex(own: Floats, normal: Floats) -> Mask:
    """Which polygons [p, n, 3], with the first corner at the origin and normals [p, 3], are convex."""
    if own.shape[1] == 3:
        return np.ones(len(own), bool)
    least = -_FLAT * (normal**2).sum(axis=1)[:, None]
    sides = np.roll(own, -1, axis=1) - own

    def none_back(one: Floats, other: Floats) -> Mask:
        inside: Mask = ((np.cross(one, other) @ normal[:, :, None])[..., 0] >= least).all(axis=1)
        return inside

    # Those that turn the same way at all corners, but more than once around, have no fan from the first corner.
    return none_back(own[:, 1:-1], own[:, 2:]) & none_back(sides, np.roll(sides, -1, axis=1))


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


def _seen_from_above(own: Floats, normal: Floats) -> Floats:
    """Polygons [p, n, 3] with normals [p, 3] in the planes of their two longer axes [p, n, 2], counter-clockwise."""
    up = np.argmax(np.abs(normal), axis=1)[:, None]
    axes = (up + np.where(np.take_along_axis(normal, up, axis=1) >= 0.0, [1, 2], [2, 1])) % 3
    return np.take_along_axis(own, axes[:, None], axis=2)
