"""Bare ground: which surfaces of a mesh are ground, and its height in every cell."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from swarmsim.config.errors import InputError
from swarmsim.site.raster import Floats, Grid, Hits, edges_on, faces_on, highest, lowest

Mask = NDArray[np.bool_]

SMOOTH_SLOPE = 1.2  # neighbouring cells steeper than this (50 deg) belong to different sheets
RAISED_SHARE = 0.6  # a sheet with a larger share of its border above its neighbours is not ground
SHEET_MAX = 0.2  # a sheet of a larger share of the site is always ground
PIT_M2 = 4.0  # a lower sheet smaller than this is the base of something embedded in the ground, such as a post
UNDERLAY_SHARE = 0.5  # one sheet above a larger share of the lowest surface may be the ground, and that a slab below it
CRAWL_M = 1.0  # a lower surface this close below another one is no floor that anything stands on
WALLED = 0.25  # of a sheet's border: with more walls below it, it is a roof
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


def found_ground(grid: Grid, corners: Floats) -> tuple[Floats, float]:
    """Height [ny, nx] of the ground inferred from the shape alone (NaN where the mesh does not show it), and the share
    of it that lies over a slab.

    The lowest upward-facing surface of every column is segmented into smooth sheets at jumps steeper than
    `SMOOTH_SLOPE`. A sheet that is higher than its neighbours along most of its border (a roof, a crown, a parked car
    in a photogrammetric surface) is not ground. A surface that lies below one sheet over most of the site, without
    walls between the two, is a slab under the scene.
    """
    normal_up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    hits = faces_on(grid, corners[normal_up > 0.0])
    bottom = lowest(grid, hits)
    both_ways = lowest(grid, faces_on(grid, corners))
    underlaid = 0.0
    if np.isfinite(bottom).sum() < 0.5 * np.isfinite(both_ways).sum():
        bottom = both_ways  # inverted faces: their orientation is not usable
    elif np.isfinite(bottom).any():
        above = _over_slab(grid, corners, hits, bottom)
        underlaid = float(np.isfinite(above).sum() / np.isfinite(bottom).sum())
        bottom = np.where(np.isfinite(above), above, bottom)
    return np.where(_raised(bottom, grid.cell), np.nan, bottom), underlaid


def _over_slab(grid: Grid, corners: Floats, hits: Hits, bottom: Floats) -> Floats:
    """Height [ny, nx] of the ground that lies over a slab, which is ``bottom``; NaN where it does not, or is none.

    ``hits`` are those of the faces that look up.
    """
    higher = hits.height > bottom.ravel()[hits.cell] + THICKNESS
    second = lowest(grid, Hits(hits.cell[higher], hits.height[higher], hits.triangle[higher]))
    nothing = np.full(bottom.shape, np.nan)
    if not np.isfinite(second).any() or np.isfinite(second).sum() < UNDERLAY_SHARE * np.isfinite(bottom).sum():
        return nothing
    sheet, area = _sheets(second, grid.cell)
    largest = (sheet == np.argmax(area)).reshape(bottom.shape) & np.isfinite(second)
    if largest.sum() < UNDERLAY_SHARE * np.isfinite(bottom).sum():
        return nothing
    gap = second - bottom
    if np.median(gap[largest]) > CRAWL_M:
        low, high = (bottom + 0.25 * gap).ravel(), (bottom + 0.75 * gap).ravel()
        between = edges_on(grid, corners)
        inside = (between.height > low[between.cell]) & (between.height < high[between.cell])
        walled = np.zeros(bottom.size, bool)
        walled[between.cell[inside]] = True
        border = largest & ~ndimage.binary_erosion(largest)
        if (walled.reshape(bottom.shape) & largest).sum() > WALLED * border.sum():
            return nothing
    return np.where(largest, second, np.nan)


def _sheets(height: Floats, cell: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Smooth sheet [ny nx] that each cell belongs to, and the cells with a height in each sheet."""
    one, other, jump = _neighbours(height)
    smooth = np.abs(jump) <= SMOOTH_SLOPE * cell
    shape = (height.size, height.size)
    links = coo_array((np.ones(int(smooth.sum()), bool), (one[smooth], other[smooth])), shape=shape)
    count, sheet = connected_components(links, directed=False)
    return sheet, np.bincount(sheet, np.isfinite(height.ravel()), count)


def _neighbours(height: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Flat indices [p] of the pairs of neighbouring cells, and how much higher the first is (NaN beside missing)."""
    index = np.arange(height.size).reshape(height.shape)
    pairs = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
    one, other = (np.concatenate([p[i].ravel() for p in pairs]) for i in (0, 1))
    flat = height.ravel()
    return one, other, flat[one] - flat[other]


def _raised(height: Floats, cell: float) -> Mask:
    """Mask [ny, nx] of the sheets that lie above the ground, or that are bases embedded in it."""
    flat = height.ravel()
    one, other, jump = _neighbours(height)
    sheet, area = _sheets(height, cell)
    count = len(area)
    border = np.abs(jump) > SMOOTH_SLOPE * cell
    one, other, above = one[border], other[border], jump[border] > 0.0
    length = np.bincount(sheet[one], minlength=count) + np.bincount(sheet[other], minlength=count)
    higher = np.bincount(sheet[one], above, count) + np.bincount(sheet[other], ~above, count)
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
            suggestion="check up_axis (--up), name the ground's mesh material or geometry (ground, --ground NAME), or "
            "lay level ground under the model (plane, --plane 20)",
        )
    empty, count = ndimage.label(missing & ~covered)
    rim = np.unique(np.concatenate([empty[0], empty[-1], empty[:, 0], empty[:, -1]]))
    outside = np.isin(empty, rim[rim > 0]) if count else np.zeros_like(missing)
    holes = missing & ~covered & ~outside
    share = holes.sum() / max((~outside).sum(), 1)
    if share > holes_max:
        enough = min(1.0, np.ceil(20.0 * share) / 20.0 + 0.05)
        raise InputError.of(
            f"{100 * share:.0f} % of the ground inside the outline of the mesh are holes ({holes.sum()} cells)",
            allowed=f"at most {100 * holes_max:.0f} % (holes_max)",
            suggestion="close the holes in the mesh, choose larger cells (cell_m, --cell), or raise holes_max "
            f"(--set holes_max={enough:.2f}) to have them filled by interpolation",
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
        from scipy.spatial import Delaunay

        # Its LinearNDInterpolator calls LAPACK for each triangle: seconds on a machine whose cores are all taken.
        corners = np.column_stack([points[:, ::-1], seen[ring]])[Delaunay(points).simplices]
        hits = faces_on(Grid((0.0, 0.0), 1.0, *missing.shape), corners)
        at = enclosed.ravel()[hits.cell]
        filled.ravel()[hits.cell[at]] = hits.height[at]
    return filled
