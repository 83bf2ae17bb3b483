"""Elevation models (GeoTIFF) as bare ground in a local ENU frame."""

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
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
from swarmsim.site.size_checks import check_cells, check_extent
from swarmsim.site.visual import GROUND_COLOUR, TRIANGLES_MAX, welded

SENTINELS = (-9999.0, -99999.0, -32768.0, -32767.0, 32767.0, -3.4028234663852886e38, 3.4028234663852886e38, 1e20)
"""Values that stand for "no data" where a file does not say so."""
HEIGHT_MAX_M = 12_000.0  # larger values, up or down, are no heights on Earth
GAP_M = 100.0  # a value this far from all others, and farther than they differ, that is there again and again: no data
SCALE_TOLERANCE = 0.005  # true length of a projected metre: nearer to one it is left alone
STRETCH_MAX = 0.02  # largest change of that length over a raster
RASTER_MAX = 100_000_000  # cells, which are held in memory together
LEAST_CELL = 1e-4  # units of the projection
DEGREES_MAX = 0.01  # smaller cells without a projection are no metres
REPROJECT = "reproject it to metres, e.g. gdalwarp -t_srs EPSG:32632 IN.tif OUT.tif"
FEET_M = (0.3048, 1200.0 / 3937.0)  # international and US survey foot


@dataclass(frozen=True)
class Elevation:
    """An elevation model in a local frame with its origin on the ground at the centre of the raster."""

    grid: Grid  # the raster's own cells; rows run south to north
    height: Floats  # [ny, nx] m; NaN where the file has no data
    colours: NDArray[np.uint8] | None  # [ny, nx, 3] of the orthophoto
    reference: dict[str, Any]  # crs; easting_m, northing_m and elevation_m of the local origin
    warnings: tuple[str, ...] = ()  # what was assumed


def read_elevation(path: Path, spec: SiteSpec) -> Elevation:
    """Read a GeoTIFF with square cells in a metric, north-up projection; raises `InputError` for any other.

    Lengths are true: a projection that stretches the ground, such as Web Mercator, is scaled back at the raster's
    centre. Heights are in ``spec.height_unit_m``, or what the file says, or the unit of its projection.
    """
    told: list[str] = []
    with _opened(path) as file:
        matrix, crs = file.transform, file.crs
        unit, true = _scale(file, path, spec.unit_m, told)
        height_unit = spec.height_unit_m or spec.unit_m or _height_unit(file, unit, told)
        cell = float(matrix.a) * unit * true
        east, north = file.width * cell, file.height * cell
        check_extent((east, north), 0.0, path)
        check_cells(int(east / spec.cell_m + 0.5), int(north / spec.cell_m + 0.5), spec, path)
        # Rows of a north-up raster run north to south; ours run south to north.
        band = file.read(1, masked=True).astype(np.float64).filled(np.nan)[::-1]
        with np.errstate(over="ignore", invalid="ignore"):
            band = band * float(file.scales[0]) + float(file.offsets[0])
    band = np.where(np.isfinite(band), band, np.nan)
    height = _with_data(band, height_unit, told) * height_unit
    ny, nx = height.shape
    if not np.isfinite(height).any():
        if np.isfinite(band).any():
            low, high = np.nanmin(band) * height_unit, np.nanmax(band) * height_unit
            raise InputError.of(
                f"holds heights of {low:.6g} to {high:.6g} m, which are none on Earth", file=path, path="height_unit_m",
                allowed=f"heights of {-HEIGHT_MAX_M:g} to {HEIGHT_MAX_M:g} m",
                suggestion="set height_unit_m (--height-unit) to the length of their unit in metres",
            )  # fmt: skip
        raise InputError.of("holds no elevation: every cell is empty", file=path)
    grid = Grid((-0.5 * (nx - 1) * cell, -0.5 * (ny - 1) * cell), cell, ny, nx)
    middle = height[ny // 2, nx // 2]
    base = float(middle if np.isfinite(middle) else np.nanmean(height))
    reference = {
        "crs": crs.to_string() if crs else None,
        "easting_m": float(matrix.c + 0.5 * nx * matrix.a) * unit,
        "northing_m": float(matrix.f - 0.5 * ny * matrix.a) * unit,
        "elevation_m": base,
        "metres_per_projected_metre": true,
    }
    photo = None if spec.orthophoto is None else _orthophoto(path.parent / spec.orthophoto, (ny, nx))
    return Elevation(grid, height - base, photo, reference, tuple(told))


def own_cell(path: Path, unit_m: float | None = None) -> float:
    """Edge length of a GeoTIFF's cells on the ground, m; ``unit_m`` as in `SiteSpec`."""
    with _opened(path) as file:
        unit, true = _scale(file, path, unit_m, [])
        return float(file.transform.a) * unit * true


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A GeoTIFF of which an elevation model can be read; errors of GDAL are told as `InputError`."""
    import rasterio

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        try:
            # By its driver: GDAL would open descriptions of rasters too, which name files elsewhere.
            with rasterio.open(path, driver="GTiff") as file:
                _check_raster(file, path)
                yield file
        except rasterio.errors.RasterioError as error:
            reason = str(error).splitlines()[0]
            raise InputError.of(f"cannot be read as GeoTIFF ({reason})", file=path) from error


def _scale(file: Any, path: Path, unit_m: float | None, told: list[str]) -> tuple[float, float]:
    """Length in m of the unit of the projection, and what its metres measure on the ground."""
    unit = unit_m or _unit(file.crs, path, told)
    return unit, 1.0 if unit_m else _true_scale(file, path, unit, told)


def _unit(crs: Any, path: Path, told: list[str]) -> float:
    """Length in m of the unit of a projection."""
    if not crs:
        told.append("the file names no projection: its coordinates are taken as metres; set unit_m (--unit) if not")
        return 1.0
    try:
        return float(crs.linear_units_factor[1])
    except Exception as error:  # rasterio raises its own errors for what GDAL does not know
        raise InputError.of(
            "has a projection without a unit of length", file=path, path="unit_m",
            suggestion="set unit_m to the length of its unit in metres (--unit 1 for metres)",
        ) from error  # fmt: skip


def _height_unit(file: Any, unit: float, told: list[str]) -> float:
    """Length in m of the unit of the heights: that of the band, or of the vertical reference, or of the projection."""
    name = (file.units[0] or "").strip().casefold()
    wkt = file.crs.to_wkt() if file.crs else ""
    vertical = re.search(r"VERT_?C(?:S|RS)\[.*?(?:LENGTH)?UNIT\[\"[^\"]*\",\s*([0-9.eE+-]+)", wkt, re.DOTALL)
    if name in ("m", "metre", "meter", "metres", "meters"):
        return 1.0
    if name in ("ft", "foot", "feet", "us-ft", "us survey foot", "ftus", "foot_us"):
        return FEET_M[1] if "us" in name else FEET_M[0]
    if vertical:
        return float(vertical.group(1))
    if abs(unit - 1.0) > 1e-9:
        told.append(
            f"the file does not say the unit of its heights: taken as that of its projection, {unit:.6g} m; "
            "set height_unit_m (--height-unit 1) if they are metres"
        )
    return unit


def _true_scale(file: Any, path: Path, unit: float, told: list[str]) -> float:
    """Metres on the ground for a metre in the projection at the raster's centre, by the curvature of the ellipsoid.

    Radii of curvature of WGS 84: Snyder, "Map Projections: A Working Manual", USGS 1395 (1987), eq. 4-18 to 4-20.
    """
    if not file.crs or not file.crs.is_projected:
        return 1.0
    from rasterio.warp import transform

    matrix, rows, columns = file.transform, file.height, file.width
    x = matrix.c + matrix.a * columns * np.array([0.5, 0.0, 1.0, 0.5, 0.5])
    y = matrix.f + matrix.e * rows * np.array([0.5, 0.5, 0.5, 0.0, 1.0])
    step = 10.0 / unit
    try:
        longitude, latitude = (
            np.radians(np.array(values).reshape(3, 5))
            for values in transform(
                file.crs, "EPSG:4326", np.concatenate([x, x + step, x]), np.concatenate([y, y, y + step])
            )
        )
    except Exception as error:
        raise InputError.of(
            f"has a projection that cannot be turned into latitudes ({str(error).splitlines()[0]})", file=path,
            suggestion=f"{REPROJECT}, or set unit_m (--unit 1)",
        ) from error  # fmt: skip
    axis, square = 6_378_137.0, 0.00669437999014
    bend = 1.0 - square * np.sin(latitude[0]) ** 2
    along, across = axis * (1.0 - square) / bend**1.5, axis / np.sqrt(bend) * np.cos(latitude[0])
    east, north = (
        np.hypot(across * (longitude[k] - longitude[0]), along * (latitude[k] - latitude[0])) / 10.0 for k in (1, 2)
    )
    scale = np.sqrt(east * north)
    if not np.isfinite(scale).all() or np.ptp(scale) > STRETCH_MAX * scale[0]:
        raise InputError.of(
            "its projection does not keep lengths over the raster", file=path,
            suggestion=f"cut out a smaller piece, or {REPROJECT}",
        )  # fmt: skip
    if abs(scale[0] - 1.0) <= SCALE_TOLERANCE:
        return 1.0
    told.append(
        f"a metre in its projection ({file.crs.to_string()}) is {scale[0]:.4f} m on the ground here: lengths are those "
        "on the ground"
    )
    return float(scale[0])


def _with_data(height: Floats, unit: float, told: list[str]) -> Floats:
    """``height`` [ny, nx] with NaN in place of values that stand for "no data" although the file does not say so."""
    with np.errstate(over="ignore"):
        single = height.astype(np.float32)
    found = np.isin(height, np.array(SENTINELS)) | np.isin(single, np.array(SENTINELS, np.float32))
    found |= np.abs(height) * unit > HEIGHT_MAX_M
    rest = np.unique(height[np.isfinite(height) & ~found])
    for end in (0, -1, 0, -1):  # the lowest value and the highest one, each twice
        value, others = rest[end:][:1], rest[1:] if end == 0 else rest[:-1]
        if len(others) and abs(others[end] - value[0]) * unit > max(GAP_M, np.ptp(others) * unit):
            again = height == value[0]
            if again.sum() > 1:
                found |= again
                rest = others
    if not found.any():
        return height
    values = np.unique(height[found])
    shown = ", ".join(f"{value:g}" for value in values[:4]) + (" …" if len(values) > 4 else "")
    told.append(
        f"{int(found.sum())} cells hold {shown}, taken as no data, which the file does not declare "
        f"(gdal_edit.py -a_nodata {values[0]:g} declares it)"
    )
    height = np.where(found, np.nan, height)
    # Resampling mixes such a value into the cells beside it.
    rest = height[np.isfinite(height)]
    if rest.size:
        low, high = np.percentile(rest, [2.0, 98.0])
        reach = 3.0 * (high - low) + GAP_M / unit
        beside = ndimage.binary_dilation(found, iterations=2)
        height = np.where(beside & ((height < low - reach) | (height > high + reach)), np.nan, height)
    return height


def _check_raster(file: Any, path: Path) -> None:
    matrix = file.transform
    if not np.isfinite(tuple(matrix)).all():
        raise InputError.of(
            "is not georeferenced by finite numbers", file=path, given=f"transform {tuple(matrix)[:6]}",
            suggestion="give it others, e.g. gdal_translate -a_ullr WEST NORTH EAST SOUTH IN.tif OUT.tif",
        )  # fmt: skip
    if file.dtypes[0].startswith("complex"):
        raise InputError.of("holds complex numbers, not heights", file=path, suggestion="write its real part")
    if matrix.is_identity:
        raise InputError.of(
            "is not georeferenced, so the size of its cells is unknown", file=path,
            suggestion="give it one, e.g. gdal_translate -a_ullr 0 HEIGHT_M WIDTH_M 0 IN.tif OUT.tif",
        )  # fmt: skip
    if file.width * file.height > RASTER_MAX:
        raise InputError.of(
            f"has {file.width} x {file.height} cells", file=path, allowed=f"at most {RASTER_MAX:,} cells",
            suggestion="cut out or resample the site: gdalwarp -te WEST SOUTH EAST NORTH -tr SIZE SIZE IN.tif OUT.tif",
        )  # fmt: skip
    if file.crs and file.crs.is_geographic:
        raise InputError.of(
            "is in degrees",
            file=path,
            suggestion=REPROJECT,
        )
    if not file.crs and matrix.a < DEGREES_MAX:
        raise InputError.of(
            f"has cells of {matrix.a:g} and names no projection: they are probably degrees", file=path,
            suggestion="say so and reproject it, e.g. gdalwarp -s_srs EPSG:4326 -t_srs EPSG:32632 IN.tif OUT.tif",
        )  # fmt: skip
    if matrix.b or matrix.d or matrix.e >= 0 or abs(matrix.a + matrix.e) > 1e-3 * matrix.a:
        raise InputError.of(
            "must be north-up with square cells", file=path, given=f"transform {tuple(matrix)[:6]}",
            suggestion="resample it with gdalwarp -tr SIZE SIZE",
        )  # fmt: skip
    if matrix.a < LEAST_CELL:
        raise InputError.of(f"has cells of {matrix.a:g}", file=path, allowed=f"{LEAST_CELL:g} or more of its unit")
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
