"""Rasterisation of triangles: heights of faces at grid points, and cells crossed by edges."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_CHUNK = 200_000  # candidate points per chunk; they stay in a cache of a core
_TOLERANCE = 1e-6  # cells, and share of a triangle
ON_THE_EDGE = 1e-5  # of the distance to the middle of an area: a place so near to an edge is in it


@dataclass(frozen=True)
class Grid:
    """A grid of square cells; ``origin`` is the centre of cell [0, 0], the south-west one."""

    origin: tuple[float, float]  # m
    cell: float  # m
    ny: int
    nx: int

    @property
    def centres(self) -> Floats:
        """Centres [ny, nx, 2] of the cells."""
        x = self.origin[0] + self.cell * np.arange(self.nx)
        y = self.origin[1] + self.cell * np.arange(self.ny)
        return np.stack(np.meshgrid(x, y), axis=-1)

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """South-west and north-east corner [2] of the grid, m."""
        low = np.array(self.origin) - 0.5 * self.cell
        return low, low + self.cell * np.array([self.nx, self.ny])

    @property
    def corners(self) -> "Grid":
        """The grid whose points are the corners of these cells."""
        half = 0.5 * self.cell
        return Grid((self.origin[0] - half, self.origin[1] - half), self.cell, self.ny + 1, self.nx + 1)

    def refined(self, factor: int) -> "Grid":
        """The grid with ``factor`` x ``factor`` cells in each cell; ``factor`` is odd, which keeps the centres."""
        shift = 0.5 * self.cell * (1.0 - 1.0 / factor)
        origin = (self.origin[0] - shift, self.origin[1] - shift)
        return Grid(origin, self.cell / factor, self.ny * factor, self.nx * factor)

    def place(self, xy: Floats) -> Floats:
        """``xy`` [..., 2] (m) in units of cells from the centre of cell [0, 0]."""
        return (xy - np.asarray(self.origin)) / self.cell

    def cell_of(self, xy: Floats) -> Integers:
        """Flat index [...] of the cell that contains ``xy`` [..., 2] (m); the nearest cell for points outside."""
        column, row = np.moveaxis(np.rint(self.place(xy)).astype(np.int64), -1, 0)
        return np.clip(row, 0, self.ny - 1) * self.nx + np.clip(column, 0, self.nx - 1)


@dataclass(frozen=True)
class Hits:
    """Points of surfaces on a grid."""

    cell: Integers  # [h] flat index of the grid point
    height: Floats  # [h] m
    triangle: Integers  # [h] index of the triangle


def faces_on(grid: Grid, corners: Floats) -> Hits:
    """Intersections of the vertical lines through the grid's points with triangles [t, 3, 3], edges included."""
    found = list(faces_in_parts(grid, corners))
    if len(found) == 1:
        return found[0]
    nothing = np.empty(0, np.int64)
    return Hits(
        np.concatenate([nothing, *(part.cell for part in found)]),
        np.concatenate([np.empty(0), *(part.height for part in found)]),
        np.concatenate([nothing, *(part.triangle for part in found)]),
    )


def faces_in_parts(grid: Grid, corners: Floats) -> Iterator[Hits]:
    """The hits of `faces_on`, up to some hundred thousand at a time."""
    points = grid.place(corners[..., :2])
    first, second = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    doubled_area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    low, high = _between(points.min(axis=1), points.max(axis=1), grid)
    chosen = np.flatnonzero((high >= low).all(axis=1) & (np.abs(doubled_area) > 1e-9))
    for part in _chunks(chosen, high[:, 1] - low[:, 1] + 1):
        of, row = _runs(low[part, 1], high[part, 1])
        of = part[of]
        start, end = _ends(points[of], row)
        left, right = (x[:, 0] for x in _between(start[:, None], end[:, None], grid))
        for several in _chunks(np.flatnonzero(right >= left), right - left + 1):
            # along a row all of them change evenly
            at = of[several]
            east, north = left[several] - points[at, 0, 0], row[several] - points[at, 0, 1]
            x, y, area = first[at], second[at], doubled_area[at]
            rise = corners[at, 1:, 2] - corners[at, :1, 2]
            u, along_u = (east * y[:, 1] - north * y[:, 0]) / area, y[:, 1] / area
            v, along_v = (x[:, 0] * north - x[:, 1] * east) / area, -x[:, 1] / area
            line, step = _runs(np.zeros_like(at), right[several] - left[several])
            u, v = u[line] + along_u[line] * step, v[line] + along_v[line] * step
            hit = np.flatnonzero((u >= -_TOLERANCE) & (v >= -_TOLERANCE) & (u + v <= 1.0 + _TOLERANCE))
            line = line[hit]
            height = corners[at, 0, 2][line] + u[hit] * rise[line, 0] + v[hit] * rise[line, 1]
            cell = (row[several] * grid.nx + left[several])[line] + step[hit]
            yield Hits(cell, height, at[line])


def _between(low: Floats, high: Floats, grid: Grid) -> tuple[Integers, Integers]:
    """First and last column and row of the grid between places [n, 1 or 2]; last < first where there is none."""
    size = np.array([grid.nx, grid.ny])[: low.shape[1]]
    first = np.clip(np.ceil(low - _TOLERANCE), 0, size).astype(np.int64)
    return first, np.clip(np.floor(high + _TOLERANCE), -1, size - 1).astype(np.int64)


def _runs(first: Integers, last: Integers) -> tuple[Integers, Integers]:
    """All whole numbers of the runs from ``first`` [n] to ``last`` [n], after the run that each belongs to."""
    count = last - first + 1
    run = np.repeat(np.arange(len(first)), count)
    return run, np.arange(len(run)) - np.repeat(np.cumsum(count) - count - first, count)


def _ends(points: Floats, row: Integers) -> tuple[Floats, Floats]:
    """From where to where [n] a triangle [n, 3, 2], grown by the tolerance, reaches in a row [n] of the grid."""
    middle = points.mean(axis=1, keepdims=True)
    grown = middle + (1.0 + 4.0 * _TOLERANCE) * (points - middle)
    one, other = grown, np.roll(grown, -1, axis=1)
    rise = other[..., 1] - one[..., 1]
    off = row[:, None] - one[..., 1]
    share = np.clip(off / np.where(rise == 0.0, 1.0, rise), 0.0, 1.0)
    x = one[..., 0] + share * (other[..., 0] - one[..., 0])
    met = np.abs(one[..., 1] + share * rise - row[:, None]) <= _TOLERANCE
    # An edge along the row: the two others end where it does.
    return np.where(met, x, np.inf).min(axis=1), np.where(met, x, -np.inf).max(axis=1)


def _chunks(chosen: Integers, count: Integers) -> Iterator[Integers]:
    if len(chosen):
        edges = np.flatnonzero(np.diff(np.cumsum(count[chosen]) // _CHUNK)) + 1
        yield from np.split(chosen, edges)


def edges_on(grid: Grid, corners: Floats) -> Hits:
    """The cells that the edges of the triangles ``corners`` [t, 3, 3] run through, sampled every quarter of a cell."""
    points, triangle = edge_points(corners, 0.25 * grid.cell)
    place = grid.place(points[:, :2])
    inside = ((place > -0.5 - 1e-6) & (place < np.array([grid.nx, grid.ny]) - 0.5 + 1e-6)).all(axis=1)
    return Hits(grid.cell_of(points[inside, :2]), points[inside, 2], triangle[inside])


def edge_points(corners: Floats, spacing: float) -> tuple[Floats, Integers]:
    """Points [p, 3] along the edges of triangles [t, 3, 3], ends included, and the triangle [p] of each."""
    start = corners.reshape(-1, 3)
    step = np.roll(corners, -1, axis=1).reshape(-1, 3) - start
    pieces = np.maximum(np.ceil(np.linalg.norm(step, axis=1) / spacing).astype(np.int64), 1)
    edge = np.repeat(np.arange(len(start)), pieces + 1)
    within = np.arange(len(edge)) - np.repeat(np.cumsum(pieces + 1) - pieces - 1, pieces + 1)
    return start[edge] + (within / pieces[edge])[:, None] * step[edge], edge // 3


def surface_points(corners: Floats, spacing: float) -> Iterator[Floats]:
    """Points [p, 3] of triangles [t, 3, 3], edges included, at most ``spacing`` apart along each surface; in chunks."""
    if len(corners) == 0:
        return
    # The longest edge is opposite the first corner: the two others span the triangle with the fewest points.
    opposite = np.linalg.norm(np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1), axis=-1)
    first = (np.argmax(opposite, axis=1)[:, None] + np.arange(3)) % 3
    ordered = np.take_along_axis(corners, first[..., None], axis=1)
    sides = ordered[:, 1:] - ordered[:, :1]
    pieces = np.maximum(np.ceil(np.linalg.norm(sides, axis=-1) / spacing).astype(np.int64), 1)
    count = (pieces + 1).prod(axis=1)
    for part in _chunks(np.arange(len(corners)), count):
        row, along = _runs(np.zeros_like(part), pieces[part, 1])
        triangle = part[row]
        v = along / pieces[triangle, 1]
        line, step = _runs(np.zeros_like(triangle), np.floor(pieces[triangle, 0] * (1.0 - v + 1e-9)).astype(np.int64))
        start = ordered[triangle, 0] + v[:, None] * sides[triangle, 1]
        yield start[line] + step[:, None] * (sides[triangle, 0] / pieces[triangle, :1])[line]
    for start in range(0, len(corners), 20_000):
        yield edge_points(corners[start : start + 20_000], spacing)[0]


def highest(grid: Grid, hits: Hits, empty: float = np.nan) -> Floats:
    """Highest hit of each cell [ny, nx]; ``empty`` where there is none."""
    return _extreme(grid, hits, empty, -np.inf, np.maximum)


def lowest(grid: Grid, hits: Hits, empty: float = np.nan) -> Floats:
    """Lowest hit of each cell [ny, nx]; ``empty`` where there is none."""
    return _extreme(grid, hits, empty, np.inf, np.minimum)


def _extreme(grid: Grid, hits: Hits, empty: float, start: float, pick: np.ufunc) -> Floats:
    flat = np.full(grid.ny * grid.nx, start)
    pick.at(flat, hits.cell, hits.height)
    return np.where(np.isinf(flat), empty, flat).reshape(grid.ny, grid.nx)


def top_of_cells(grid: Grid, corners: Floats, empty: float = np.nan) -> Floats:
    """Highest point of triangles [t, 3, 3] within each whole cell [ny, nx].

    The highest point of a triangle within a cell is at a corner of the cell or on an edge of the triangle.
    """
    at_corners = highest(grid.corners, faces_on(grid.corners, corners), -np.inf)
    top = np.maximum.reduce([at_corners[:-1, :-1], at_corners[:-1, 1:], at_corners[1:, :-1], at_corners[1:, 1:]])
    top = np.maximum(top, highest(grid, edges_on(grid, corners), -np.inf))
    return np.where(np.isinf(top), empty, top)


def in_polygon(points: Floats, polygon: Floats) -> NDArray[np.bool_]:
    """Whether each of ``points`` [..., 2] lies in ``polygon`` [v, 2] (even-odd rule)."""
    inside = np.zeros(points.shape[:-1], bool)
    x, y = points[..., 0], points[..., 1]
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return inside


def in_areas(points: Floats, areas_m: Sequence[NDArray[np.floating]]) -> NDArray[np.bool_]:
    """Whether each of ``points`` [n, 2] lies in any of ``areas_m``, convex polygons [v, 2], or on an edge."""
    inside = np.zeros(len(points), bool)
    for area in areas_m:
        corners = np.asarray(area, float)
        middle = corners.mean(axis=0)
        inside |= in_polygon(points, middle + (1.0 + ON_THE_EDGE) * (corners - middle))
    return inside
