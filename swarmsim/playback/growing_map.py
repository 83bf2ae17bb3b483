"""The radiation map as it grows: what the counts so far show, drawn a little above the ground."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from swarmsim.results.record import MissionRecord, RadiationMap, Samples
from swarmsim.site.model import Site

_VERTICES_PER_SIDE_MAX = 160  # keeps the recording small on a large site
_KERNEL_M = 5.0  # one standard deviation: half the usual line spacing
_SEEN = 0.12  # share of the kernel's weight at a sample that makes a cell count as seen


@dataclass(frozen=True)
class MapGrid:
    """The map's grid as drawn, thinned to a size that a viewer likes."""

    x_m: NDArray[np.floating]  # [nx]
    y_m: NDArray[np.floating]  # [ny]
    stride: int  # cells of the mission's map for one of these

    @property
    def triangles(self) -> NDArray[np.uint32]:
        """Two triangles [2 (ny-1) (nx-1), 3] for each square of four grid points, counter-clockwise from above."""
        nx, ny = len(self.x_m), len(self.y_m)
        corner = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).reshape(-1, 1)
        return (corner + np.array([[0, 1, nx + 1, 0, nx + 1, nx]])).reshape(-1, 3).astype(np.uint32)

    def triangles_where(self, seen: NDArray[np.bool_]) -> NDArray[np.uint32]:
        """Those of the triangles [t, 3] whose three corners are ``seen`` [ny, nx]."""
        triangles = self.triangles
        return triangles[seen.reshape(-1)[triangles].all(axis=1)]


def grid_of(radiation_map: RadiationMap) -> MapGrid:
    """The grid to draw ``radiation_map`` on."""
    ny, nx = radiation_map.mean_cps.shape
    stride = -(-max(ny, nx) // _VERTICES_PER_SIDE_MAX)
    x = radiation_map.origin_m[0] + radiation_map.cell_m * np.arange(0, nx, stride)
    y = radiation_map.origin_m[1] + radiation_map.cell_m * np.arange(0, ny, stride)
    return MapGrid(x_m=x, y_m=y, stride=stride)


def raster_at(
    raster: NDArray[np.floating], site: Site, x_m: NDArray[np.floating], y_m: NDArray[np.floating]
) -> NDArray:
    """Bilinear value [...] of a site's raster at ``x_m``, ``y_m`` [...] (ENU), clamped at the border."""
    cell = float(site.cell_m)
    origin = np.asarray(site.origin_m, float)
    rows, columns = (y_m - origin[1]) / cell, (x_m - origin[0]) / cell
    return map_coordinates(np.asarray(raster, float), [rows, columns], order=1, mode="nearest")


def drape(grid: MapGrid, site: Site, above_m: float) -> NDArray[np.float32]:
    """Points [ny nx, 3] of the grid, ``above_m`` over the bare ground."""
    x, y = np.meshgrid(grid.x_m, grid.y_m)
    z = raster_at(np.asarray(site.terrain_m), site, x, y) + above_m
    return np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32)


def partial_map(samples: Samples, grid: MapGrid) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Rate [ny, nx] in cps that ``samples`` show on ``grid``, and where they reach [ny, nx].

    Kernel estimate: counts and exposures are spread by the same Gaussian and divided (Nadaraya 1964, Watson 1964),
    two filters for each picture. The mission's own map, interpolated by its own method, replaces it once it is made.
    """
    shape = (len(grid.y_m), len(grid.x_m))
    spacing = float(grid.x_m[1] - grid.x_m[0]) if shape[1] > 1 else 1.0
    rows = np.rint((samples.position_m[:, 1] - grid.y_m[0]) / spacing).astype(int)
    columns = np.rint((samples.position_m[:, 0] - grid.x_m[0]) / spacing).astype(int)
    inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    cells = (rows * shape[1] + columns)[inside]
    sigma = max(_KERNEL_M / spacing, 0.5)

    def spread(weight: NDArray[np.floating]) -> NDArray[np.floating]:
        return gaussian_filter(np.bincount(cells, weight, shape[0] * shape[1]).reshape(shape), sigma, mode="constant")

    counts, exposure = spread(samples.counts[inside]), spread(samples.exposure_s[inside])
    # A single flown line spreads to a ridge 1 / (sqrt(2 pi) sigma) high where it passes each cell once.
    visited = np.minimum(np.bincount(cells, minlength=shape[0] * shape[1]), 1).astype(float).reshape(shape)
    reach = gaussian_filter(visited, sigma, mode="constant") * np.sqrt(2.0 * np.pi) * sigma
    return counts / np.maximum(exposure, 1e-12), (reach > _SEEN) & (exposure > 0.0)


@dataclass(frozen=True)
class Snapshot:
    """The map at one time."""

    time_s: float
    rate_cps: NDArray[np.floating]  # [ny, nx]
    seen: NDArray[np.bool_]  # [ny, nx] where there are data


def snapshots(record: MissionRecord, made: RadiationMap, count: int) -> list[Snapshot]:
    """``count`` growing maps until ``made``, the mission's own, and that last; none if nothing was measured."""
    samples = record.samples.until(record.surveyed_s)
    if len(samples.time_s) == 0:
        return []
    grid = grid_of(made)
    grown = []
    for time in np.linspace(record.start_s, record.surveyed_s, count + 2)[1:-1]:
        so_far = samples.until(time)
        if len(so_far.time_s):
            grown.append(Snapshot(float(time), *partial_map(so_far, grid)))
    mean = made.mean_cps[:: grid.stride, :: grid.stride]
    return [*grown, Snapshot(float(record.surveyed_s), mean, np.isfinite(mean))]
