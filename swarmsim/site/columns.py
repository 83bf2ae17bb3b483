"""Matter of closed meshes along vertical lines, whatever way their faces are wound."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from swarmsim.site.raster import Floats, Integers

WELD_DIGITS = 4  # of a metre: vertices that agree to 0.1 mm are one
LEVEL_M = 1e-3  # heights that differ by less are one level
CROSSINGS_MAX = 4_000_000  # candidates of lines and triangles that are looked at
UPRIGHT = 1e-6  # share of a face's area seen from above, below which no vertical line crosses it


@dataclass(frozen=True)
class Columns:
    """Matter along the vertical lines at every pair of places ``x`` [nx], ``y`` [ny]."""

    line: Integers  # [n] flat index (ix ny + iy), ascending
    low: Floats  # [n] m
    high: Floats  # [n] m


def oriented(corners: Floats) -> Floats | None:
    """The triangles [t, 3, 3] of a component, all wound with the matter below what faces up; None if there is no way.

    Faces drawn twice, once for either side, are taken once. The winding of a body, a set of triangles joined by edges
    that belong to two of them, is made the same throughout. A body with a negative volume is turned inside out.
    """
    _, number = np.unique(np.round(corners.reshape(-1, 3), WELD_DIGITS), axis=0, return_inverse=True)
    corner = number.reshape(-1, 3)
    _, first, count = np.unique(np.sort(corner, axis=1), axis=0, return_index=True, return_counts=True)
    if (count % 2 == 0).all():
        corners, corner = corners[first], corner[first]
    body, turned, whole = _bodies(corner)
    if turned is None:
        return None
    wound = np.where(turned[:, None, None], corners[:, ::-1], corners)
    flipped = (np.bincount(body, _volumes(wound)) < 0.0) & whole
    return np.where(flipped[body][:, None, None], wound[:, ::-1], wound)


def closed_volume(corners: Floats) -> float | None:
    """The matter of a component with triangles ``corners`` [t, 3, 3], m3; None where its surface is not closed.

    It may be open at its lowest level, where the ground closes it.
    """
    points, number = np.unique(np.round(corners.reshape(-1, 3), WELD_DIGITS), axis=0, return_inverse=True)
    ends = np.stack([number.reshape(-1, 3), np.roll(number.reshape(-1, 3), -1, axis=1)], axis=-1).reshape(-1, 2)
    edges, uses = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    above = points[:, 2] > points[:, 2].min() + LEVEL_M
    if above[edges[uses % 2 == 1]].any():
        return None
    wound = oriented(corners)
    return None if wound is None else abs(volume(wound))


def _bodies(corner: Integers) -> tuple[Integers, NDArray[np.bool_] | None, NDArray[np.bool_]]:
    """The body [t] of triangles with vertices ``corner`` [t, 3], whether each is to be turned [t] (None: a body has
    one side only, or its faces fold), and which bodies [b] meet nothing else along an edge.

    The bodies are the components of a graph with two nodes for each triangle, as it is and turned.
    """
    count = len(corner)
    start, end = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    up = start < end
    edge = np.minimum(start, end) * (int(corner.max()) + 1) + np.maximum(start, end)
    order = np.argsort(edge, kind="stable")
    _, begin, uses = np.unique(edge[order], return_index=True, return_counts=True)
    one, other = order[begin[uses == 2]], order[begin[uses == 2] + 1]
    opposed = up[one] != up[other]  # two triangles wound the same way run along their edge in opposite directions
    a, b = one // 3, other // 3
    across = np.where(opposed, 0, count)
    rows, columns = np.concatenate([a, a + count]), np.concatenate([b + across, b + count - across])
    links = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(2 * count, 2 * count))
    _, side = connected_components(links, directed=False)
    as_is, turned = side[:count], side[count:]
    _, body = np.unique(np.minimum(as_is, turned), return_inverse=True)
    shared = np.zeros(int(body.max()) + 1, bool)
    shared[body[order[np.repeat(uses > 2, uses)] // 3]] = True
    if (as_is == turned).any():
        return body, None, ~shared
    # Of the two ways to wind a body, that of most of its triangles.
    lower = as_is < turned
    most = np.bincount(body, np.where(lower, 1.0, -1.0)) >= 0.0
    return body, lower != most[body], ~shared


def volume(wound: Floats) -> float:
    """Volume that ``oriented`` triangles [t, 3, 3] enclose down to their lowest corner, m3; overlaps count twice."""
    return float(_volumes(wound).sum())


def _volumes(corners: Floats) -> Floats:
    """Signed volumes [t] between triangles [t, 3, 3] and the level of the lowest corner, m3."""
    heights = corners[..., 2].mean(axis=1) - corners[..., 2].min()
    return _seen_areas(corners) * heights


def _seen_areas(corners: Floats) -> Floats:
    """Areas [t] of triangles [t, 3, 3] seen from above, negative where they face down, m2."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def columns_at(corners: Floats, x: Floats, y: Floats) -> Columns | None:
    """The matter that ``oriented`` triangles [t, 3, 3] enclose, along lines at ``x`` [nx] and ``y`` [ny], ascending.

    Going down a line, faces are counted: those that face up enter matter, those that face down leave it, so that bodies
    may overlap. Matter without an underside, as of walls drawn on the ground, ends at the lowest corner. None where
    more faces are left than entered: the surface is not closed.
    """
    crossing = _crossings(corners, x, y)
    if crossing is None:
        return None
    line, height, sign = crossing
    # Of faces at the same height those entered come first: bodies that stand on one another are one piece of matter.
    order = np.lexsort((-sign, -np.round(height, WELD_DIGITS), line))
    line, height, sign = line[order], height[order], sign[order]
    first = np.flatnonzero(np.diff(line, prepend=-1))
    size = np.diff(np.append(first, len(line)))
    total = np.cumsum(sign)
    depth = total - np.repeat(total[first] - sign[first], size)  # bodies that a point below the face lies in
    if (depth < 0).any():
        return None
    entered, left = (depth > 0) & (depth - sign <= 0), (depth <= 0) & (depth - sign > 0)
    last = np.zeros(len(line), bool)
    last[first + size - 1] = True
    open_below = last & (depth > 0)
    floor = float(corners[..., 2].min())
    ends = np.flatnonzero(left | open_below)
    tops = np.flatnonzero(entered)
    low = np.where(open_below[ends], floor, height[ends])
    thick = height[tops] > low + 10.0**-WELD_DIGITS
    return Columns(line[tops][thick], low[thick], height[tops][thick])


def _crossings(corners: Floats, x: Floats, y: Floats) -> tuple[Integers, Floats, Integers] | None:
    """Lines, heights and signs (1: faces up) [h] of all crossings; None where there are too many to look at."""
    area = _seen_areas(corners)
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = corners[np.abs(area) > UPRIGHT * np.linalg.norm(sides, axis=1)]
    low, high = flat[..., :2].min(axis=1), flat[..., :2].max(axis=1)
    i, j = np.searchsorted(x, low[:, 0]), np.searchsorted(y, low[:, 1])
    ni, nj = np.searchsorted(x, high[:, 0]) - i, np.searchsorted(y, high[:, 1]) - j
    pairs = ni * nj
    if pairs.sum() > CROSSINGS_MAX:
        return None
    of = np.repeat(np.arange(len(flat)), pairs)
    k = np.arange(len(of)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    column, row = i[of] + k // nj[of], j[of] + k % nj[of]
    a, first, second = flat[:, 0], flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    doubled = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    east, north = x[column] - a[of, 0], y[row] - a[of, 1]
    u = (east * second[of, 1] - north * second[of, 0]) / doubled[of]
    v = (first[of, 0] * north - first[of, 1] * east) / doubled[of]
    hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
    of = of[hit]
    height = a[of, 2] + u[hit] * first[of, 2] + v[hit] * second[of, 2]
    return column[hit] * len(y) + row[hit], height, np.sign(doubled[of]).astype(np.int64)
