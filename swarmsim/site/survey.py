"""The survey area: the polygon of the specification, or by default the convex hull of the site."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from swarmsim.config.errors import InputError
from swarmsim.config.site import SiteSpec
from swarmsim.site.raster import Floats, Grid

VERTICES_MAX = 32
INSET_M = 5.0  # a quadrotor at 4 m/s that brakes with 4 m/s^2 after 0.4 s comes to rest in 3.6 m
INSET_SHARE = 0.05  # of the smaller side, on a small site


def survey_area(grid: Grid, inside: NDArray[np.bool_], spec: SiteSpec) -> Floats:
    """Convex polygon [v, 2] in m, ENU, counter-clockwise.

    It is the specification's, or else the convex hull of the cells ``inside`` [ny, nx], inset so far that a vehicle at
    the end of a line can stop before the fence, which is the site's outline. Raises `InputError` when the
    specification's reaches beyond the site, or when the ground is a line.
    """
    if spec.survey_area_m is not None:
        return _inside_site(grid, np.array(spec.survey_area_m))
    inset = max(grid.cell, min(INSET_M, INSET_SHARE * min(grid.nx, grid.ny) * grid.cell))
    depth = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1] * grid.cell
    # On a site a few cells wide, what is left of it may be a line.
    hull = next((hull for core in (depth > inset, inside) if len(hull := _hull_of(grid, core)) > 2), None)
    if hull is None:
        raise InputError.of(
            f"there is nothing to survey: its ground lies in one line (cells: {int(inside.sum())})", file=spec.file,
            path="cell_m", suggestion="choose smaller cells: cell_m (--cell), or check that the file is whole",
        )  # fmt: skip
    while len(hull) > VERTICES_MAX:
        before, after = np.roll(hull, 1, axis=0) - hull, np.roll(hull, -1, axis=0) - hull
        lost = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])
        hull = np.delete(hull, int(np.argmin(lost)), axis=0)
    return hull


def _hull_of(grid: Grid, core: NDArray[np.bool_]) -> Floats:
    """Convex hull [v, 2] of the centres of the cells ``core`` [ny, nx], counter-clockwise."""
    rows = np.flatnonzero(core.any(axis=1))
    left, right = core.argmax(axis=1)[rows], grid.nx - 1 - core[:, ::-1].argmax(axis=1)[rows]
    ends = np.concatenate([np.column_stack([left, rows]), np.column_stack([right, rows])])
    return _hull(ends * grid.cell + grid.origin)


def _hull(points: Floats) -> Floats:
    """Convex hull [v, 2] of ``points`` [n, 2], counter-clockwise (monotone chain, Andrew 1979)."""
    ordered = [tuple(p) for p in np.unique(points, axis=0)]

    def chain(run: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
        kept: list[tuple[float, ...]] = []
        for x, y in run:
            while len(kept) > 1:
                (ax, ay), (bx, by) = kept[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                kept.pop()
            kept.append((x, y))
        return kept[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


def check_zones(grid: Grid, spec: SiteSpec) -> None:
    """Raise `InputError` for a zone that lies beside the site, where it closes nothing."""
    low, high = grid.bounds
    for k, zone in enumerate(spec.zones):
        corners = np.array(zone.polygon_m)
        if (corners.max(axis=0) <= low).any() or (corners.min(axis=0) >= high).any():
            raise InputError.of(
                f"the zone '{zone.name}' lies outside the site", path=f"zones.{k}.polygon_m",
                given=str(corners.tolist()),
                allowed=f"x from {low[0]:g} to {high[0]:g} m, y from {low[1]:g} to {high[1]:g} m",
            )  # fmt: skip


def _inside_site(grid: Grid, polygon: Floats) -> Floats:
    """``polygon`` [v, 2], or `InputError` when a corner lies outside the grid."""
    low, high = grid.bounds
    if ((polygon < low - 1e-6) | (polygon > high + 1e-6)).any():
        raise InputError.of(
            "the survey area reaches beyond the site", path="survey_area_m", given=str(polygon.tolist()),
            allowed=f"x from {low[0]:g} to {high[0]:g} m, y from {low[1]:g} to {high[1]:g} m",
        )  # fmt: skip
    return polygon
