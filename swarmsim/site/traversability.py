"""Traversability for a rover: clearance to obstacles, and cost of driving one metre."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from swarmsim.config.site import Traversability, Zone
from swarmsim.site.obstacles import Box, footprint
from swarmsim.site.raster import Floats, Grid, in_polygon, surface_points

Mask = NDArray[np.bool_]

FINE_M = 0.1
"""Wanted cell of the raster of clearances: walls, fences and gaps are known to this."""
FINE_CELLS_MAX = 4_000_000
POCKET_M2 = 50.0  # an enclosed free area smaller than this counts as part of the obstacle around it


def fine_factor(grid: Grid) -> int:
    """Cells of the raster of clearances along a cell of ``grid``: odd, which keeps the centres of the cells."""
    most = min(grid.cell / (0.95 * FINE_M), (FINE_CELLS_MAX / (grid.ny * grid.nx)) ** 0.5)
    return max(1, 2 * ((int(most) + 1) // 2) - 1)


def clearance(
    grid: Grid,
    ground: Floats,
    outside: Mask,
    corners: Floats,
    boxes: list[Box],
    zones: tuple[Zone, ...],
    rules: Traversability,
) -> Floats:
    """Signed distance [f ny, f nx] in m to the nearest obstacle, zone or border, f = `fine_factor`; < 0 inside it.

    The obstacles are the triangles ``corners`` [t, 3, 3] and ``boxes``. Both are needed: only a box has an interior,
    and small components have no box. ``outside`` [ny, nx] marks the cells beyond the mesh. A surface without thickness
    takes up the fine cells that it runs through, and those cells touch along their sides: there is no way between them.
    """
    factor = fine_factor(grid)
    fine = grid.refined(factor)
    floor = _refined(ground, factor)
    blocked = _filled_corners(_touched(fine, floor, corners, rules))
    for box in boxes:
        window, inside = footprint(box, fine, 0.5 * fine.cell)
        low, high = box.centre[2] - box.half[2], box.centre[2] + box.half[2]
        height = floor[window]
        blocked[window] |= inside & (low < height + rules.rover_height_m) & (high > height + rules.step_max_m)
    for zone in zones:
        blocked |= in_polygon(fine.centres, np.array(zone.polygon_m))
    blocked |= np.repeat(np.repeat(outside, factor, 0), factor, 1)
    blocked |= _pockets(blocked, POCKET_M2 / fine.cell**2)
    framed = np.pad(blocked, 1, constant_values=True)
    away, within = ndimage.distance_transform_edt(~framed), ndimage.distance_transform_edt(framed)
    # The transform measures between cell centres; the boundary lies half a cell before the first blocked one.
    signed: Floats = np.where(framed, 0.5 - within, away - 0.5) * fine.cell
    return signed[1:-1, 1:-1]


def at_centres(clear: Floats, grid: Grid) -> Floats:
    """A raster of clearances [f ny, f nx] at the centres of the cells [ny, nx] of ``grid``."""
    factor = len(clear) // grid.ny
    return clear[factor // 2 :: factor, factor // 2 :: factor]


def _refined(raster: Floats, factor: int) -> Floats:
    """``raster`` [ny, nx] at the centres of ``factor`` x ``factor`` cells in each cell, bilinear."""
    if factor == 1:
        return raster
    ny, nx = raster.shape
    row, column = ((np.arange(factor * n) + 0.5) / factor - 0.5 for n in (ny, nx))
    along = ndimage.map_coordinates(raster, np.meshgrid(row, np.arange(nx), indexing="ij"), order=1, mode="nearest")
    places = np.meshgrid(np.arange(factor * ny), column, indexing="ij")
    refined: Floats = ndimage.map_coordinates(along, places, order=1, mode="nearest")
    return refined


def _filled_corners(blocked: Mask) -> Mask:
    """``blocked`` with the cells beside every two that meet only at their corners: a point could slip between them."""
    sw, se, nw, ne = blocked[:-1, :-1], blocked[:-1, 1:], blocked[1:, :-1], blocked[1:, 1:]
    meet = (sw & ne & ~se & ~nw) | (se & nw & ~sw & ~ne)
    closed = blocked.copy()
    for side in (closed[:-1, :-1], closed[:-1, 1:], closed[1:, :-1], closed[1:, 1:]):
        side |= meet
    return closed


def _pockets(blocked: Mask, cells: float) -> Mask:
    """Enclosed free areas smaller than ``cells``, such as the inside of an open container."""
    place, count = ndimage.label(~blocked)
    return (np.bincount(place.ravel(), minlength=count + 1) < cells)[place] & ~blocked


def _touched(fine: Grid, floor: Floats, corners: Floats, rules: Traversability) -> Mask:
    """Cells in which a surface lies between the highest passable step and the rover's height above the ``floor``."""
    blocked = np.zeros(fine.ny * fine.nx, bool)
    level = floor.ravel()
    low, high = rules.step_max_m, max(rules.rover_height_m, rules.step_max_m)
    spacing = min(0.5 * fine.cell, 0.25 * max(high - low, 0.1))
    near = corners[
        (corners[..., 2].min(axis=1) < level.max() + high) & (corners[..., 2].max(axis=1) > level.min() + low)
    ]
    for points in surface_points(near, spacing):
        place = fine.place(points[:, :2])
        inside = ((place > -0.5 - 1e-6) & (place < np.array([fine.nx, fine.ny]) - 0.5 + 1e-6)).all(axis=1)
        cell = fine.cell_of(points[inside, :2])
        above = points[inside, 2] - level[cell]
        blocked[cell[(above > low) & (above < high)]] = True
    return blocked.reshape(fine.ny, fine.nx)


def cost(grid: Grid, ground: Floats, clear: Floats, rules: Traversability, rise: Floats | None = None) -> Floats:
    """Cost [ny, nx] of driving one metre (formula: `swarmsim.config.site.Traversability`); inf where impassable.

    ``rise`` [ny, nx] is that of the steps near the patch between four cell centres, [i, j] the south-west one.
    """
    north, east = np.gradient(ground, grid.cell)
    slope = np.hypot(north, east)
    steepest = np.tan(np.radians(rules.slope_max_deg))
    roughness = np.abs(ground - ndimage.uniform_filter(ground, 3, mode="nearest"))
    near = np.clip(1.0 - clear / rules.obstacle_distance_m, 0.0, 1.0)
    total = 1.0 + rules.slope_weight * (slope / steepest) ** 2
    total = total + rules.roughness_weight * roughness + rules.obstacle_weight * near**2
    passable = (slope <= steepest) & (clear > 0.0)
    if rise is not None:
        around = np.pad(rise, ((1, 0), (1, 0)))  # a cell centre has a patch on either side
        passable &= ndimage.maximum_filter(around, 2)[1:, 1:] <= rules.step_max_m
    return np.where(passable, total, np.inf)
