"""Bare ground: which surfaces of a mesh are ground, and its height in every cell."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from swarmsim.config.errors import InputError
from swarmsim.site.raster import Floats, Grid, faces_on, highest, lowest

Mask = NDArray[np.bool_]

SMOOTH_SLOPE = 1.2  # neighbouring cells steeper than this (50 deg) belong to different sheets
RAISED_SHARE = 0.6  # a sheet with a larger share of its border above its neighbours is not ground
SHEET_MAX = 0.2  # a sheet of a larger share of the site is always ground
PIT_M2 = 4.0  # a lower sheet smaller than this is the base of something embedded in the ground, such as a post
THICKNESS = 0.1  # m; a surface within this distance of the ground is part of it


@dataclass(frozen=True)
class Ground:
    """The bare ground on a grid."""

    height: Floats  # [ny, nx] m, finite everywhere
    filled: Mask  # [ny, nx] holes within the outline of the mesh, interpolated
    outside: Mask  # [ny, nx] beyond the outline of the mesh


def named_ground(grid: Grid, corners: Floats) -> Floats:
    """Height [ny, nx] of the triangles named as ground; NaN where there is none."""
    return highest(grid, faces_on(grid, corners))


def found_ground(grid: Grid, corners: Floats) -> Floats:
    """Height [ny, nx] of the ground inferred from the shape alone; NaN where the mesh does not show it.

    The lowest upward-facing surface of every column is segmented into smooth sheets at jumps steeper than
    `SMOOTH_SLOPE`. A sheet that is higher than its neighbours along most of its border (a roof, a crown, a parked car
    in a photogrammetric surface) is not ground.
    """
    normal_up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    bottom = lowest(grid, faces_on(grid, corners[normal_up > 0.0]))
    both_ways = lowest(grid, faces_on(grid, corners))
    if np.isfinite(bottom).sum() < 0.5 * np.isfinite(both_ways).sum():
        bottom = both_ways  # inverted faces: their orientation is not usable
    return np.where(_raised(bottom, grid.cell), np.nan, bottom)


def _raised(height: Floats, cell: float) -> Mask:
    """Mask [ny, nx] of the sheets that lie above the ground, or that are bases embedded in it."""
    index = np.arange(height.size).reshape(height.shape)
    pairs = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
    one, other = (np.concatenate([p[i].ravel() for p in pairs]) for i in (0, 1))
    flat = height.ravel()
    jump = flat[one] - flat[other]  # NaN beside missing cells, which is neither smooth nor a border
    smooth = np.abs(jump) <= SMOOTH_SLOPE * cell
    links = coo_array((np.ones(int(smooth.sum()), bool), (one[smooth], other[smooth])), shape=(flat.size, flat.size))
    count, sheet = connected_components(links, directed=False)
    border = np.abs(jump) > SMOOTH_SLOPE * cell
    one, other, above = one[border], other[border], jump[border] > 0.0
    length = np.bincount(sheet[one], minlength=count) + np.bincount(sheet[other], minlength=count)
    higher = np.bincount(sheet[one], above, count) + np.bincount(sheet[other], ~above, count)
    area = np.bincount(sheet, np.isfinite(flat), count)
    stands = (higher > RAISED_SHARE * length) & (area <= SHEET_MAX * max(area.sum(), 1.0))
    sunk = (length - higher > RAISED_SHARE * length) & (area * cell**2 < PIT_M2)
    return ((stands | sunk)[sheet] & np.isfinite(flat)).reshape(height.shape)


def complete_ground(seen: Floats, covered: Mask, holes_max: float) -> Ground:
    """The ground ``seen`` [ny, nx] (NaN = not seen) with its missing cells interpolated.

    Cells below an obstacle (``covered``) are expected to be missing; a hole is a missing cell inside the outline with
    nothing above it. Raises `InputError` when more than ``holes_max`` of the ground inside the outline are holes.
    """
    missing = ~np.isfinite(seen)
    if missing.all():
        raise InputError.of(
            "no ground found: no surface that faces up",
            suggestion="check up_axis, or name the ground's mesh material or geometry under 'ground:'",
        )
    empty, count = ndimage.label(missing & ~covered)
    rim = np.unique(np.concatenate([empty[0], empty[-1], empty[:, 0], empty[:, -1]]))
    outside = np.isin(empty, rim[rim > 0]) if count else np.zeros_like(missing)
    holes = missing & ~covered & ~outside
    share = holes.sum() / max((~outside).sum(), 1)
    if share > holes_max:
        raise InputError.of(
            f"{100 * share:.0f} % of the ground inside the outline of the mesh are holes ({holes.sum()} cells)",
            allowed=f"at most {100 * holes_max:.0f} % (holes_max)",
            suggestion="close the holes in the mesh, choose larger cells (cell_m), or raise holes_max to have them "
            "filled by interpolation",
        )
    return Ground(height=_interpolated(seen, missing, outside), filled=holes, outside=outside)


def _interpolated(seen: Floats, missing: Mask, outside: Mask) -> Floats:
    """``seen`` with missing cells interpolated linearly; beyond the outline, the nearest cell's height."""
    if not missing.any():
        return seen
    nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    filled = seen[tuple(nearest)]
    enclosed = missing & ~outside
    ring = ~missing & ndimage.binary_dilation(enclosed)
    points = np.argwhere(ring)
    if len(points) and np.linalg.matrix_rank(points - points.mean(axis=0)) == 2:
        from scipy.interpolate import LinearNDInterpolator

        value = LinearNDInterpolator(points, seen[ring])(np.argwhere(enclosed))
        filled[enclosed] = np.where(np.isfinite(value), value, filled[enclosed])
    return filled
