"""Traversability for a rover: clearance to obstacles, and cost of driving one metre."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from swarmsim.config.site import Traversability, Zone
from swarmsim.site.obstacles import Box, footprint
from swarmsim.site.raster import Floats, Grid, edges_on, faces_on, highest, in_polygon, lowest

Mask = NDArray[np.bool_]

FINE_CELLS_MAX = 1_000_000
POCKET_M2 = 50.0  # an enclosed free area smaller than this counts as part of the obstacle around it
FINE_FACTORS = (5, 3, 1)  # refinement of the grid that distances are measured on; odd keeps the cell centres


def clearance(
    grid: Grid,
    ground: Floats,
    outside: Mask,
    corners: Floats,
    boxes: list[Box],
    zones: tuple[Zone, ...],
    rules: Traversability,
) -> Floats:
    """Signed distance [ny, nx] in m from each cell's centre to the nearest obstacle, zone or border; < 0 inside it.

    The obstacles are the triangles ``corners`` [t, 3, 3] and ``boxes``. Both are needed: only a box has an interior,
    and small components have no box. ``outside`` [ny, nx] marks the cells beyond the mesh.
    """
    factor = next(f for f in FINE_FACTORS if f == 1 or f * f * grid.ny * grid.nx <= FINE_CELLS_MAX)
    fine = grid.refined(factor)
    floor = np.repeat(np.repeat(ground, factor, 0), factor, 1)
    blocked = _touched(fine, floor, corners, rules)
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
    signed = np.where(framed, 0.5 - within, away - 0.5) * fine.cell
    return signed[1 + factor // 2 : -1 : factor, 1 + factor // 2 : -1 : factor]


def _pockets(blocked: Mask, cells: float) -> Mask:
    """Enclosed free areas smaller than ``cells``, such as the inside of an open container."""
    place, count = ndimage.label(~blocked)
    return (np.bincount(place.ravel(), minlength=count + 1) < cells)[place] & ~blocked


def _touched(fine: Grid, ground: Floats, corners: Floats, rules: Traversability) -> Mask:
    """Cells in which a surface lies between the highest passable step and the rover's height above the ground."""
    blocked = np.zeros((fine.ny, fine.nx), bool)
    for find in (faces_on, edges_on):
        hits = find(fine, corners)
        low, high = lowest(fine, hits, np.inf), highest(fine, hits, -np.inf)
        blocked |= (low < ground + rules.rover_height_m) & (high > ground + rules.step_max_m)
    return blocked


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
