"""Elevation models (GeoTIFF) as bare ground in a local ENU frame."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from swarmsim.config.errors import InputError
from swarmsim.config.site import SiteSpec
from swarmsim.site.ground import Ground, complete_ground
from swarmsim.site.model import VisualMesh
from swarmsim.site.raster import Floats, Grid
from swarmsim.site.visual import GROUND_COLOUR, TRIANGLES_MAX, welded


@dataclass(frozen=True)
class Elevation:
    """An elevation model in a local frame with its origin on the ground at the centre of the raster."""

    grid: Grid  # the raster's own cells; rows run south to north
    height: Floats  # [ny, nx] m; NaN where the file has no data
    colours: NDArray[np.uint8] | None  # [ny, nx, 3] of the orthophoto
    reference: dict[str, Any]  # crs; easting_m, northing_m and elevation_m of the local origin


def read_elevation(path: Path, spec: SiteSpec) -> Elevation:
    """Read a GeoTIFF with square cells in a metric, north-up projection; raises `InputError` for any other."""
    import rasterio

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        try:
            with rasterio.open(path) as file:
                _check_raster(file, path)
                # Rows of a north-up raster run north to south; ours run south to north.
                band = file.read(1, masked=True).astype(np.float64).filled(np.nan)[::-1]
                matrix, crs = file.transform, file.crs
        except rasterio.errors.RasterioError as error:
            reason = str(error).splitlines()[0]
            raise InputError.of(f"cannot be read as GeoTIFF ({reason})", file=path) from error
    unit = spec.unit_m or (crs.linear_units_factor[1] if crs else 1.0)
    cell = float(matrix.a) * unit
    height = np.where(np.isfinite(band), band, np.nan) * (spec.unit_m or 1.0)
    ny, nx = height.shape
    if not np.isfinite(height).any():
        raise InputError.of("holds no elevation: every cell is empty", file=path)
    grid = Grid((-0.5 * (nx - 1) * cell, -0.5 * (ny - 1) * cell), cell, ny, nx)
    middle = height[ny // 2, nx // 2]
    base = float(middle if np.isfinite(middle) else np.nanmean(height))
    reference = {
        "crs": crs.to_string() if crs else None,
        "easting_m": float(matrix.c * unit + 0.5 * nx * cell),
        "northing_m": float(matrix.f * unit - 0.5 * ny * cell),
        "elevation_m": base,
    }
    photo = None if spec.orthophoto is None else _orthophoto(path.parent / spec.orthophoto, (ny, nx))
    return Elevation(grid, height - base, photo, reference)


def own_cell(path: Path) -> float:
    """Edge length of a GeoTIFF's cells in its projection, m."""
    spec = SiteSpec(name="elevation", file=path.name, licence="-", cell_m=1.0, max_file_mb=1e6)
    return read_elevation(path, spec).grid.cell


def _check_raster(file: Any, path: Path) -> None:
    matrix = file.transform
    if matrix.is_identity:
        raise InputError.of(
            "is not georeferenced, so the size of its cells is unknown", file=path,
            suggestion="give it one, e.g. gdal_translate -a_ullr 0 HEIGHT_M WIDTH_M 0 IN.tif OUT.tif",
        )  # fmt: skip
    if file.crs and file.crs.is_geographic:
        raise InputError.of(
            "is in degrees",
            file=path,
            suggestion="reproject it to metres, e.g. gdalwarp -t_srs EPSG:32632 IN.tif OUT.tif",
        )
    if matrix.b or matrix.d or matrix.e >= 0 or abs(matrix.a + matrix.e) > 1e-3 * matrix.a:
        raise InputError.of(
            "must be north-up with square cells", file=path, given=f"transform {tuple(matrix)[:6]}",
            suggestion="resample it with gdalwarp -tr SIZE SIZE",
        )  # fmt: skip
    if file.count >= 3 and file.dtypes[0] == "uint8":
        raise InputError.of(
            "is a picture, not an elevation model", file=path,
            suggestion="give the elevation as 'file' and the picture as 'orthophoto'",
        )  # fmt: skip


def _orthophoto(path: Path, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Colours [ny, nx, 3] of the orthophoto, which covers the same ground, one for each cell."""
    import rasterio

    if not path.is_file():
        raise InputError.of("there is no such orthophoto", file=path, path="orthophoto")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path) as file:
                bands = file.read(indexes=[1, 2, 3] if file.count >= 3 else [1, 1, 1], out_shape=(3, *shape))
    except rasterio.errors.RasterioError as error:
        raise InputError.of(f"cannot be read as a picture ({error})", file=path, path="orthophoto") from error
    return np.moveaxis(bands, 0, -1)[::-1].astype(np.uint8)


def elevation_ground(model: Elevation, grid: Grid, spec: SiteSpec) -> Ground:
    """The ground on ``grid``, by bilinear interpolation of the elevation model."""
    missing = ~np.isfinite(model.height)
    complete = complete_ground(model.height, np.zeros_like(missing), spec.holes_max)
    if grid == model.grid:
        return complete
    column, row = np.moveaxis(model.grid.place(grid.centres), -1, 0)

    def at(raster: NDArray[Any], order: int) -> NDArray[Any]:
        return ndimage.map_coordinates(raster, [row, column], order=order, mode="nearest")

    filled, outside = (at(mask.astype(np.uint8), 0) > 0 for mask in (complete.filled, complete.outside))
    return Ground(height=at(complete.height, 1), filled=filled, outside=outside)


def elevation_mesh(model: Elevation, grid: Grid, ground: Ground) -> VisualMesh:
    """The ground as at most `TRIANGLES_MAX` triangles, with the colours of the orthophoto if there is one."""
    step = int(np.ceil(np.sqrt(2.0 * grid.ny * grid.nx / TRIANGLES_MAX)))
    rows, columns = (np.unique(np.append(np.arange(0, n, step), n - 1)) for n in (grid.ny, grid.nx))
    points = np.concatenate([grid.centres, ground.height[..., None]], axis=-1)[np.ix_(rows, columns)]
    index = np.arange(points.shape[0] * points.shape[1]).reshape(points.shape[:2])
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    corners = points.reshape(-1, 3)[triangles]
    colours = np.empty((len(corners), 4), np.uint8)
    colours[:] = GROUND_COLOUR
    if model.colours is not None:
        cell = model.grid.cell_of(corners[..., :2].mean(axis=1))
        colours[:, :3] = model.colours.reshape(-1, 3)[cell]
    return welded(corners, colours)
