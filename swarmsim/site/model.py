"""Ground truth of a site: device arrays (rasters, obstacles), and the host-side model with its visual mesh."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.site import SiteSpec
from swarmsim.pytree import pytree, static
from swarmsim.site.terrain_crossing import Ceilings

SURROUNDING_KG_M3 = 10.0
"""A lighter material (air, leaves) surrounds source and detector; a denser one is a wall between them."""


@pytree
class Obstacles:
    """Yaw-oriented boxes, hollow or solid. K >= 1: a site without obstacles has one box of zero size."""

    centre_m: jax.Array  # [K, 3] ENU
    half_extent_m: jax.Array  # [K, 3] along the box's own axes (length, width, height)
    axis: jax.Array  # [K, 2] unit vector (cos, sin of yaw): direction of the box's first axis in ENU
    wall_m: jax.Array  # [K] thickness of the shell of a hollow box; 0 = solid
    material: jax.Array  # [K] int32 index into Site.material_names


@pytree
class Steps:
    """Vertical faces of the ground such as kerbs and ledges: at most one straight edge near each patch of ground.

    A patch lies between four cell centres, [i, j] the south-west one. Within it the ground is the bilinear one of
    ``floor_m``, less the rise at those cell centres that lie beyond the edge, plus the rise wherever one is beyond it.
    """

    floor_m: jax.Array  # [ny, nx] height that wheels stand on: bare ground, and what is low enough to be driven over
    edge: jax.Array  # [ny, nx, 4] unit vector (x, y) to the high side, distance of the edge (m) from the south-west
    # cell centre along it, rise (m); zeros where there is none


@pytree
class Site:
    """A site on the device. Raster rows run south to north (y), columns west to east (x)."""

    origin_m: jax.Array  # [2] ENU centre of cell [0, 0], the south-west one
    cell_m: jax.Array  # [] edge length of a cell
    terrain_m: jax.Array  # [ny, nx] height of the bare ground
    surface_m: jax.Array  # [ny, nx] highest surface in the cell: ground, roofs, trees
    clearance_m: jax.Array  # [f ny, f nx] signed distance to the nearest obstacle, zone or border for a rover; < 0
    # inside. Each cell of the other rasters holds f x f of its cells, so that it knows thin walls.
    cost: jax.Array  # [ny, nx] cost of driving one metre, >= 1; inf where a rover cannot drive
    obstacles: Obstacles
    survey_area_m: jax.Array  # [V, 2] ENU convex polygon, counter-clockwise
    ground_material: jax.Array  # [] int32 index into material_names
    steps: Steps | None = None  # None: the ground has no steps
    above: Ceilings | None = None  # of the terrain; None: made where it is needed
    wall_kg_m3: jax.Array | None = None  # [M] bulk density of what can be a wall, 0 of air and leaves, see
    # `SURROUNDING_KG_M3`; None: boxes of every material count by their metres
    material_names: tuple[str, ...] = static()  # order of the materials table


@dataclass(frozen=True)
class VisualMesh:
    """Triangles with vertex colours for a viewer, in the site's ENU frame."""

    vertices_m: NDArray[np.float32]  # [n, 3] ENU
    triangles: NDArray[np.uint32]  # [t, 3] indices into vertices_m, counter-clockwise seen from outside
    colours: NDArray[np.uint8]  # [n, 4] RGBA


@dataclass(frozen=True)
class SiteModel:
    """A loaded site on the host: specification, arrays, visual mesh, and the report of the import."""

    name: str
    spec: SiteSpec
    site: Site
    mesh: VisualMesh
    report: dict[str, Any]  # area_m2, relief_m, obstacles, filled_cells, warnings … (plain JSON values)


def walls_among(densities_kg_m3: Sequence[float]) -> NDArray[np.float64]:
    """``Site.wall_kg_m3`` [M] of materials with these bulk densities."""
    densities = np.array(densities_kg_m3, np.float64)
    return np.where(densities < SURROUNDING_KG_M3, 0.0, densities)


def _cells_in_one(site: Site, raster: Any) -> int:
    """How many cells of a raster lie along the edge of one of the site's."""
    return max(1, raster.shape[0] // site.terrain_m.shape[0])


def _cells_of(site: Site, raster: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Centre [2] of the south-west cell of a raster and its cell's edge length [] (m): the site's, or finer cells."""
    factor = _cells_in_one(site, raster)
    if factor == 1:
        return site.origin_m, site.cell_m
    cell = site.cell_m / factor
    return site.origin_m - 0.5 * (site.cell_m - cell), cell


def _cell(site: Site, raster: jax.Array, xy: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Values at the corners [..., 4] (SW, SE, NW, NE), place in the cell [..., 2], and whether inside [..., 2]."""
    ny, nx = raster.shape
    last = jnp.array([nx - 1, ny - 1], jnp.float32)
    origin, size = _cells_of(site, raster)
    place = (xy - origin) / size
    clamped = jnp.clip(place, 0.0, last)
    # Clip the integer as well: the conversion of a NaN is undefined.
    index = jnp.clip(clamped.astype(jnp.int32), 0, jnp.array([nx - 2, ny - 2]))
    south_west = index[..., 1] * nx + index[..., 0]
    corners = raster.reshape(-1).at[south_west[..., None] + jnp.array([0, 1, nx, nx + 1])].get(mode="promise_in_bounds")
    return corners, clamped - index, (place >= 0.0) & (place <= last)


def sample(raster: jax.Array, site: Site, xy: jax.Array) -> jax.Array:
    """Bilinear value of a site's raster at ``xy`` [..., 2] (ENU, m), clamped at the border; [...].

    ``raster`` [ny, nx] or [f ny, f nx] must be finite (not ``Site.cost``, whose inf would turn to NaN between cells).
    """
    corners, t, _ = _cell(site, raster, xy)
    x, y = t[..., 0], t[..., 1]
    south = corners[..., 0] + x * (corners[..., 1] - corners[..., 0])
    north = corners[..., 2] + x * (corners[..., 3] - corners[..., 2])
    return south + y * (north - south)


def nearest(raster: jax.Array, site: Site, xy: jax.Array) -> jax.Array:
    """Value of a site's raster in the cell nearest to ``xy`` [..., 2] (ENU, m), clamped at the border; [...]."""
    ny, nx = raster.shape
    place = jnp.clip((xy - site.origin_m) / site.cell_m + 0.5, 0.0, jnp.array([nx - 1, ny - 1], jnp.float32))
    index = jnp.clip(place.astype(jnp.int32), 0, jnp.array([nx - 1, ny - 1]))  # the conversion of a NaN is undefined
    flat = jnp.ravel(raster)
    return flat.at[index[..., 1] * nx + index[..., 0]].get(mode="promise_in_bounds")


def sample_with_gradient(raster: jax.Array, site: Site, xy: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Bilinear value [...] at ``xy`` [..., 2] (ENU, m) and its gradient [..., 2] along x and y, per metre.

    Outside the raster the value is clamped, so the gradient across the border is zero there.
    """
    corners, t, inside = _cell(site, raster, xy)
    x, y = t[..., 0], t[..., 1]
    east_south = corners[..., 1] - corners[..., 0]
    east_north = corners[..., 3] - corners[..., 2]
    south = corners[..., 0] + x * east_south
    north = corners[..., 2] + x * east_north
    slope = jnp.stack([east_south + y * (east_north - east_south), north - south], axis=-1)
    return south + y * (north - south), jnp.where(inside, slope / _cells_of(site, raster)[1], 0.0)


def bounds_m(site: Site) -> tuple[jax.Array, jax.Array]:
    """South-west and north-east corner [2] of the site: centres of its outermost cells, ENU."""
    rows, columns = site.terrain_m.shape
    return site.origin_m, site.origin_m + site.cell_m * (jnp.array([columns, rows]) - 1)


def height_at(site: Site, xy: NDArray[np.floating]) -> NDArray[np.float64]:
    """Height of the terrain [n] at ``xy`` [n, 2] (ENU, m) on the host; see `sample_on_host`."""
    return sample_on_host(site.terrain_m, site, xy)


def sample_on_host(raster: Any, site: Site, xy: NDArray[np.floating]) -> NDArray[np.float64]:
    """`sample` of a raster at ``xy`` [n, 2] (ENU, m) on the host, where nothing has to be compiled for it; [n]."""
    values = np.asarray(raster)
    ny, nx = values.shape
    coarse = float(site.cell_m)
    cell = coarse / _cells_in_one(site, values)
    origin = np.asarray(site.origin_m) - 0.5 * (coarse - cell)
    place = np.clip((xy - origin) / cell, 0.0, [nx - 1, ny - 1])
    index = np.minimum(place.astype(int), [nx - 2, ny - 2])
    (x, y), column, row = (place - index).T, index[:, 0], index[:, 1]
    near = [values[row + i, column + k].astype(np.float64) for i in (0, 1) for k in (0, 1)]
    south, north = near[0] + x * (near[1] - near[0]), near[2] + x * (near[3] - near[2])
    return np.asarray(south + y * (north - south))
