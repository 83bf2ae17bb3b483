"""Steps of the ground from a mesh: where its steep faces stand, and how far the ground rises across them (host).

Position and direction of an edge are those of the mesh's own faces; the rise is measured on a fine raster of the ground
and of what is low enough to be driven over. A patch of ground (between four cell centres) keeps the one edge that is
longest and highest near it. Where several edges meet within a patch, such as at the end of a kerb, the cell centres may
not fit a single straight edge: the patch then has none, and the ground between its cell centres is a ramp.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from swarmsim.site.raster import Floats, Grid, Integers, faces_in_parts

STEEP = 0.5  # cosine of 60 degrees: faces that are steeper are faces of steps
RISE_MIN_M = 0.04  # lower steps are roughness
REACH_M = 0.3  # an edge this far outside a patch is still near it: the radius of a large wheel
FINE_M = 0.1  # wanted cell of the fine raster
FINE_CELLS_MAX = 6_000_000
MISFIT = 0.35  # largest difference of a patch's rise between its cell centres, as a share of the edge's rise
_SPACING_M = 0.05  # of points along edges
_OUTSIDE = 0.2  # weight of an edge outside the patch


@dataclass(frozen=True)
class StepRasters:
    """Content of `swarmsim.site.Steps`."""

    floor: Floats  # [ny, nx] m
    edge: Floats  # [ny, nx, 4]


def find_steps(grid: Grid, ground: Floats, clear: Floats, corners: Floats, step_max: float) -> StepRasters | None:
    """Steps of the ground on ``grid``; None where there are none.

    ``ground`` [ny, nx] is the bare ground, ``clear`` [ny, nx] the clearance (m), ``corners`` [t, 3, 3] all triangles
    that carry or stop a rover; what rises by more than ``step_max`` above the ground is an obstacle and no step, unless
    it is ground itself.
    """
    points, normal, weight = _steep_points(corners)
    cells = grid.cell_of(points[:, :2])
    near = points[:, 2] < ndimage.maximum_filter(ground, 3).ravel()[cells] + step_max + RISE_MIN_M
    points, normal, weight = points[near], normal[near], weight[near]
    if not len(points):
        return None
    factor = next(
        (f for f in (9, 7, 5, 3) if f * f * grid.ny * grid.nx <= FINE_CELLS_MAX and grid.cell / f >= 0.5 * FINE_M), 1
    )
    fine = grid.refined(factor)
    level = _standing(fine, grid, ground, corners, step_max)
    rise = _rise_across(fine, level, points[:, :2], normal)
    normal = np.where(rise[:, None] < 0.0, -normal, normal)
    kept = np.abs(rise) >= RISE_MIN_M
    for side in (-REACH_M, REACH_M):  # no edge inside an obstacle, such as the floor of a container
        kept &= clear.ravel()[grid.cell_of(points[:, :2] + side * normal)] > 0.0
    points, normal, rise, weight = points[kept, :2], normal[kept], np.abs(rise[kept]), weight[kept]
    if not len(points):
        return None
    floor = level[factor // 2 :: factor, factor // 2 :: factor]
    edge = _edges(grid, points, normal, rise, weight)
    edge[~_fits(grid, floor, edge)] = 0.0
    return StepRasters(floor, edge) if edge.any() else None


def _steep_points(corners: Floats) -> tuple[Floats, Floats, Floats]:
    """Points [p, 3] at the top of steep triangles, their horizontal normals [p, 2] and lengths [p] (m)."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(across, axis=1)
    steep = corners[(np.abs(across[:, 2]) < STEEP * size) & (size > 1e-9)]
    plan = np.roll(steep, -1, axis=1)[..., :2] - steep[..., :2]
    longest = np.argmax(np.linalg.norm(plan, axis=-1), axis=1)
    rows = np.arange(len(steep))
    start, along = steep[rows, longest, :2], plan[rows, longest]
    length = np.linalg.norm(along, axis=1)
    pieces = np.maximum(np.ceil(length / _SPACING_M).astype(np.int64), 1)
    index = np.repeat(rows, pieces)
    within = np.arange(len(index)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    place = start[index] + ((within + 0.5) / pieces[index])[:, None] * along[index]
    unit = along / np.maximum(length, 1e-9)[:, None]
    normal = np.stack([unit[:, 1], -unit[:, 0]], axis=-1)[index]
    bottom = steep[..., 2].min(axis=1)[index]
    useful = (length > 1e-3)[index]
    return np.column_stack([place, bottom])[useful], normal[useful], (length / pieces)[index][useful]


def _standing(fine: Grid, grid: Grid, ground: Floats, corners: Floats, step_max: float) -> Floats:
    """Height [ny, nx] on the fine grid of the highest upward face at most ``step_max`` above the bare ground."""
    factor = fine.ny // grid.ny
    coarse = np.repeat(np.repeat(ground, factor, 0), factor, 1)
    most = np.repeat(np.repeat(ndimage.maximum_filter(ground, 3), factor, 0), factor, 1) + step_max
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = corners[up[:, 2] >= STEEP * np.linalg.norm(up, axis=1)]
    level = np.full(coarse.size, -np.inf)
    for hits in faces_in_parts(fine, flat):
        usable = hits.height <= most.ravel()[hits.cell]
        np.maximum.at(level, hits.cell[usable], hits.height[usable])
    return np.where(np.isfinite(level), level, coarse.ravel()).reshape(coarse.shape)


def _rise_across(fine: Grid, level: Floats, xy: Floats, normal: Floats) -> Floats:
    """Rise [p] of ``level`` at ``xy`` [p, 2] along ``normal`` [p, 2], less what the slopes on both sides rise."""
    step = max(fine.cell, FINE_M)

    def at(distance: float) -> Floats:
        return level.ravel()[fine.cell_of(xy + distance * normal)]

    jump = at(step) - at(-step)
    slopes = (at(2.0 * step) - at(step)) + (at(-step) - at(-2.0 * step))
    return np.where(np.abs(slopes) < 0.5 * np.abs(jump), jump - slopes, jump)


def _edges(grid: Grid, points: Floats, normal: Floats, rise: Floats, weight: Floats) -> Floats:
    """The edge [ny, nx, 4] of each patch: that with the largest sum of length x rise near it."""
    angle = np.arctan2(normal[:, 1], normal[:, 0])
    offset = np.sum(points * normal, axis=1)
    line = np.stack([np.rint(angle / np.radians(6.0)), np.rint(offset / 0.1)], axis=-1).astype(np.int64)
    _, line = np.unique(line, axis=0, return_inverse=True)
    place = grid.place(points)
    reach = REACH_M / grid.cell
    span = int(np.ceil(reach))
    patches: list[Integers] = []
    members: list[Integers] = []
    shares: list[Floats] = []
    base = np.floor(place).astype(np.int64)
    for east in range(-span, span + 1):
        for north in range(-span, span + 1):
            patch = base + np.array([east, north])
            beside = np.abs(place - patch - 0.5) - 0.5
            near = (beside <= reach).all(axis=1) & (patch >= 0).all(axis=1)
            near &= (patch[:, 0] < grid.nx - 1) & (patch[:, 1] < grid.ny - 1)
            chosen = np.flatnonzero(near)
            patches.append(patch[chosen, 1] * grid.nx + patch[chosen, 0])
            members.append(chosen)
            inside = (beside[chosen] <= 0.0).all(axis=1)
            shares.append(weight[chosen] * rise[chosen] * np.where(inside, 1.0, _OUTSIDE))
    patch, member, share = np.concatenate(patches), np.concatenate(members), np.concatenate(shares)
    pair, group = np.unique(np.stack([patch, line.reshape(-1)[member]]), axis=1, return_inverse=True)
    group = group.reshape(-1)
    total = np.bincount(group, share)

    def mean(values: Floats) -> Floats:
        result: Floats = np.bincount(group, share * values[member]) / np.maximum(total, 1e-12)
        return result

    order = np.lexsort((total, pair[0]))
    best = order[np.append(pair[0][order][1:] != pair[0][order][:-1], True)]
    east_part, north_part = mean(normal[:, 0])[best], mean(normal[:, 1])[best]
    size = np.hypot(east_part, north_part)
    east_part, north_part = east_part / size, north_part / size
    x = mean(points[:, 0])[best] - (grid.origin[0] + grid.cell * (pair[0][best] % grid.nx))
    y = mean(points[:, 1])[best] - (grid.origin[1] + grid.cell * (pair[0][best] // grid.nx))
    edge = np.zeros((grid.ny * grid.nx, 4))
    edge[pair[0][best]] = np.stack([east_part, north_part, east_part * x + north_part * y, mean(rise)[best]], axis=-1)
    return edge.reshape(grid.ny, grid.nx, 4)


def _fits(grid: Grid, floor: Floats, edge: Floats) -> NDArray[np.bool_]:
    """Whether [ny, nx] the four cell centres of each patch stand on the sides that its edge gives them."""
    east, north, offset, rise = np.moveaxis(edge[:-1, :-1], -1, 0)
    heights = np.stack([floor[:-1, :-1], floor[:-1, 1:], floor[1:, :-1], floor[1:, 1:]])
    x, y = grid.cell * np.array([0, 1, 0, 1]), grid.cell * np.array([0, 0, 1, 1])
    beyond = east * x[:, None, None] + north * y[:, None, None] > offset
    low = heights - rise * beyond
    # Ground below a step is smooth: its four heights lie in a plane, and no steeper than the step is high.
    twist = np.abs(low[0] - low[1] - low[2] + low[3])
    fits = (twist <= 2.0 * MISFIT * rise) & (np.ptp(low, axis=0) <= np.maximum(MISFIT * rise, 0.0) + grid.cell)
    mixed = beyond.any(axis=0) & ~beyond.all(axis=0)
    jump = _mean_where(heights, beyond) - _mean_where(heights, ~beyond)
    fits &= ~mixed | (np.abs(jump - rise) <= MISFIT * rise + 0.3 * grid.cell)
    return np.pad(fits, ((0, 1), (0, 1)))


def _mean_where(values: Floats, chosen: NDArray[np.bool_]) -> Floats:
    mean: Floats = np.sum(values * chosen, axis=0) / np.maximum(chosen.sum(axis=0), 1)
    return mean
