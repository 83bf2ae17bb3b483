"""Obstacles of a mesh as yaw-oriented boxes: connected components, split where one box would be mostly empty."""

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from swarmsim.site.raster import Floats, Grid, Integers, edge_points, faces_on

FILL_MIN = 0.75  # a box with a smaller filled share of its footprint is split
AREA_SMALL = 0.3  # m2; a smaller box is not split
BOXES_PER_COMPONENT = 24
FLAT_M = 1e-3  # m; a thinner component is a surface without thickness
SHEET_M = 0.01  # m; thickness of a surface for which the specification gives none
VOLUME_SMALL, HEIGHT_SMALL = 0.1, 0.3  # m3, m; a component below both is not an obstacle
STEPPED = 0.3  # a long component whose top varies by a larger share of its height is cut in two
POINTS_MAX = 6_000  # sampled on one component


@dataclass(frozen=True)
class Box:
    """A yaw-oriented box."""

    centre: tuple[float, float, float]  # m, ENU
    half: tuple[float, float, float]  # m, along its own axes
    axis: tuple[float, float]  # cos, sin of yaw
    wall: float  # m; 0 = solid

    @property
    def volume(self) -> float:
        """Outer volume, m3."""
        return 8.0 * self.half[0] * self.half[1] * self.half[2]


def components(vertices: Floats, triangles: Integers) -> list[Integers]:
    """Indices of the triangles of each connected component; vertices that agree to 0.1 mm are merged."""
    _, merged = np.unique(np.round(vertices, 4), axis=0, return_inverse=True)
    corner = merged.reshape(-1)[triangles]
    one, other = corner[:, [0, 0]].ravel(), corner[:, [1, 2]].ravel()
    size = int(corner.max()) + 1
    _, label = connected_components(coo_array((np.ones(len(one), bool), (one, other)), shape=(size, size)))
    piece = label[corner[:, 0]]
    order = np.argsort(piece, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(piece[order])) + 1)


def boxes_of(corners: Floats, wall: float | None) -> list[Box]:
    """Boxes that approximate one connected component with triangles ``corners`` [t, 3, 3].

    ``wall`` is the thickness of its shell, None when it is solid. A component below `VOLUME_SMALL` and `HEIGHT_SMALL`
    gives no box.
    """
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    angles = _directions(corners)
    axis = _best_axis(corners[..., :2].reshape(-1, 2), angles)
    extent = np.append(_extent(corners[..., :2].reshape(-1, 2), axis), high[2] - low[2])
    if extent.prod() < VOLUME_SMALL and extent[2] < HEIGHT_SMALL:
        return []
    points, spacing = _points(corners, float(extent[0] * extent[1]))
    clouds: list[tuple[float, int, Floats]] = [(-extent[0] * extent[1], 0, points)]
    done: list[Floats] = []
    serial = 1
    while clouds:
        _, _, cloud = heapq.heappop(clouds)
        room = len(done) + len(clouds) < BOXES_PER_COMPONENT - 1
        halves = _split(cloud, spacing, angles) if room else None
        if halves is None:
            done.append(cloud)
            continue
        for half in halves:
            heapq.heappush(clouds, (-_extent(half[:, :2], _best_axis(half[:, :2], angles)).prod(), serial, half))
            serial += 1
    # A component that was split is an open shell: its pieces are its walls, and solid.
    return [_box(cloud, wall, angles, whole=len(done) == 1) for cloud in done]


def _points(corners: Floats, area: float) -> tuple[Floats, float]:
    """Points [p, 3] of the faces and edges of a component, and their spacing in m."""
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1).sum()
    spacing = max(0.1, (2.0 * area / POINTS_MAX) ** 0.5, length / POINTS_MAX)
    low = corners[..., :2].reshape(-1, 2).min(axis=0)
    size = np.ceil(np.ptp(corners[..., :2].reshape(-1, 2), axis=0) / spacing).astype(int) + 1
    grid = Grid((float(low[0]), float(low[1])), spacing, int(size[1]), int(size[0]))
    hits = faces_on(grid, corners)
    xy = np.stack([hits.cell % grid.nx, hits.cell // grid.nx], axis=-1) * spacing + low
    along, _ = edge_points(corners, spacing)
    points = np.concatenate([np.column_stack([xy, hits.height]), along])
    return np.unique(np.round(points, 4), axis=0), spacing


def _directions(corners: Floats) -> Floats:
    """Angles [n] in rad, modulo a right angle, of the longest edges of a component seen from above."""
    edges = (np.roll(corners, -1, axis=1) - corners)[..., :2].reshape(-1, 2)
    length = np.linalg.norm(edges, axis=1)
    longest = edges[np.argsort(-length, kind="stable")[: np.minimum(128, (length > 1e-3).sum())]]
    return np.unique(np.round(np.arctan2(longest[:, 1], longest[:, 0]) % (0.5 * np.pi), 9))


def _best_axis(xy: Floats, angles: Floats) -> Floats:
    """Direction (cos, sin) of the longer side of the smallest rectangle around ``xy`` [n, 2].

    One of its sides lies along the convex hull; the directions tried are every degree and the edges' ``angles``.
    """
    tried = np.append(np.radians(np.arange(0.0, 90.0)), angles)
    hull = _extreme_points(xy)
    sides = np.stack([np.cos(tried), np.sin(tried)])
    first = np.ptp(hull @ sides, axis=0)
    second = np.ptp(hull @ np.stack([-sides[1], sides[0]]), axis=0)
    best = int(np.argmin(np.round(first * second + 1e-3 * (first + second), 6)))
    c, s = float(sides[0, best]), float(sides[1, best])
    return np.array([c, s]) if first[best] >= second[best] else np.array([-s, c])


def _extreme_points(xy: Floats) -> Floats:
    """``xy`` [n, 2] without those inside the polygon of the farthest in 32 directions (Akl and Toussaint, 1978)."""
    if len(xy) <= 64:
        return xy
    angles = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    farthest = list(dict.fromkeys((xy @ np.stack([np.cos(angles), np.sin(angles)])).argmax(axis=0).tolist()))
    polygon = xy[farthest]
    edge = np.roll(polygon, -1, axis=0) - polygon
    normal = np.stack([edge[:, 1], -edge[:, 0]])
    outside = (xy @ normal - (polygon * normal.T).sum(axis=1) >= -1e-12).any(axis=1)
    outside[farthest] = True
    return xy[outside]


def _own_axes(xy: Floats, axis: Floats) -> Floats:
    return xy @ np.array([[axis[0], -axis[1]], [axis[1], axis[0]]])


def _extent(xy: Floats, axis: Floats) -> Floats:
    return np.ptp(_own_axes(xy, axis), axis=0)


def _split(cloud: Floats, spacing: float, angles: Floats) -> tuple[Floats, Floats] | None:
    """The cloud split in two by the cut that saves most area of boxes; None where one box suffices."""
    axis = _best_axis(cloud[:, :2], angles)
    local = _own_axes(cloud[:, :2], axis)
    extent = np.ptp(local, axis=0)
    area = float(extent.prod())
    if extent[0] > 4.0 * extent[1] and extent[0] > 2.0 and _stepped(local[:, 0], cloud[:, 2]):
        return _parted(cloud, local, axis, 0, 0.5 * (local[:, 0].min() + local[:, 0].max()), spacing)
    if area < AREA_SMALL or extent[1] < 2.0 * spacing or _fill(local, spacing) >= FILL_MIN:
        return None
    saved, cut, side = max((*_best_cut(local, side, spacing), side) for side in (0, 1))
    if saved < max(0.002 * area, 1e-3):
        return None
    return _parted(cloud, local, axis, side, cut, spacing)


def _parted(cloud: Floats, local: Floats, axis: Floats, side: int, cut: float, spacing: float) -> tuple[Floats, Floats]:
    """The cloud on either side of a cut.

    Where the cut separates adjacent rows of points, the sparser row is extended to the other half, which leaves no gap.
    """
    u = local[:, side]
    left = u <= cut
    edge, other = u[left].max(), u[~left].min()
    halves = [cloud[left], cloud[~left]]
    if other - edge < 1.5 * spacing:
        rows = [cloud[left & (u > edge - 0.6 * spacing)], cloud[~left & (u < other + 0.6 * spacing)]]
        emptier = int(len(rows[1]) < len(rows[0]))
        along = np.array([axis[0], axis[1]]) if side == 0 else np.array([-axis[1], axis[0]])
        place = rows[emptier][:, :2] @ along
        drawn = rows[emptier].copy()
        drawn[:, :2] += np.outer((other if emptier == 0 else edge) - place, along)
        halves[emptier] = np.concatenate([halves[emptier], drawn])
    return halves[0], halves[1]


def _fill(local: Floats, spacing: float) -> float:
    """Share of the cells of the rectangle around ``local`` [n, 2] that contain points."""
    low, extent = local.min(axis=0), np.ptp(local, axis=0)
    size = np.maximum((extent / (1.5 * spacing)).astype(np.int64), 1)
    cells = np.minimum(((local - low) / extent * size).astype(np.int64), size - 1)
    return len(np.unique(cells[:, 0] * size[1] + cells[:, 1])) / float(size.prod())


def _stepped(along: Floats, height: Floats) -> bool:
    """Whether the top of a long component varies by more than `STEPPED` along it, as that of a fence on a slope."""
    bins = np.minimum((8.0 * (along - along.min()) / np.ptp(along)).astype(np.int64), 7)
    top, bottom = np.full(8, -np.inf), np.full(8, np.inf)
    np.maximum.at(top, bins, height)
    np.minimum.at(bottom, bins, height)
    used = np.isfinite(top)
    own = float(np.median((top - bottom)[used]))
    return bool(np.ptp(top[used]) > STEPPED * own and np.ptp(bottom[used]) > STEPPED * own and own > 0.0)


def _best_cut(local: Floats, side: int, spacing: float) -> tuple[float, float]:
    """Area saved by cutting across ``side`` (0 or 1) into two rectangles, and the coordinate after which to cut.

    All cuts through the legs of a U save about the same area; the one where most points begin or end is taken.
    """
    order = np.argsort(local[:, side], kind="stable")
    u, v = local[order, side], local[order, 1 - side]
    if u[-1] - u[0] <= 0.0:
        return 0.0, 0.0
    left = (u - u[0]) * (np.maximum.accumulate(v) - np.minimum.accumulate(v))
    back = v[::-1]
    right = (u[-1] - u) * (np.maximum.accumulate(back) - np.minimum.accumulate(back))[::-1]
    whole = (u[-1] - u[0]) * np.ptp(v)
    distinct = np.flatnonzero(np.diff(u) > 1e-6)
    both = left[distinct] + right[distinct + 1]
    saved = whole - both
    good = np.flatnonzero(saved >= 0.8 * saved.max() - 1e-9)
    row = 0.6 * spacing
    at, then = u[distinct[good]], u[distinct[good] + 1]
    before = np.searchsorted(u, at, "right") - np.searchsorted(u, at - row, "left")
    after = np.searchsorted(u, then + row, "right") - np.searchsorted(u, then, "left")
    best = good[int(np.argmax(np.abs(before - after)))]
    return float(saved[best]), float(u[distinct[best]])


def _box(cloud: Floats, wall: float | None, angles: Floats, whole: bool) -> Box:
    axis = _best_axis(cloud[:, :2], angles)
    local = _own_axes(cloud[:, :2], axis)
    low, high = local.min(axis=0), local.max(axis=0)
    middle = 0.5 * (low + high)
    half = np.append(0.5 * (high - low), 0.5 * np.ptp(cloud[:, 2]))
    thickness = wall or SHEET_M
    hollow = whole and wall is not None and bool((half > wall).all())
    half = np.where(half < 0.5 * FLAT_M, 0.5 * thickness, half)
    x = middle[0] * axis[0] - middle[1] * axis[1]
    y = middle[0] * axis[1] + middle[1] * axis[0]
    z = 0.5 * (cloud[:, 2].min() + cloud[:, 2].max())
    centre = (float(x), float(y), float(z))
    size = (float(half[0]), float(half[1]), float(half[2]))
    return Box(centre, size, (float(axis[0]), float(axis[1])), float(wall or 0.0) if hollow else 0.0)


def footprint(box: Box, grid: Grid, margin: float = 0.0) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
    """A window of the grid, and which of its cell centres lie in the box's footprint dilated by ``margin`` m."""
    c, s = box.axis
    reach = (
        np.array([abs(c) * box.half[0] + abs(s) * box.half[1], abs(s) * box.half[0] + abs(c) * box.half[1]]) + margin
    )
    low = np.maximum(np.floor(grid.place(np.array(box.centre[:2]) - reach)).astype(int), 0)
    high = np.minimum(np.ceil(grid.place(np.array(box.centre[:2]) + reach)).astype(int) + 1, [grid.nx, grid.ny])
    window = (slice(low[1], max(high[1], low[1])), slice(low[0], max(high[0], low[0])))
    columns, rows = np.meshgrid(np.arange(window[1].start, window[1].stop), np.arange(window[0].start, window[0].stop))
    x = grid.origin[0] + grid.cell * columns - box.centre[0]
    y = grid.origin[1] + grid.cell * rows - box.centre[1]
    along, across = np.abs(c * x + s * y), np.abs(c * y - s * x)
    return window, (along <= box.half[0] + margin) & (across <= box.half[1] + margin)
