"""Distance to what stands in the way at a vehicle's height: walls, trees, masts."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import distance_transform_edt

from swarmsim.pytree import on_host, pytree
from swarmsim.site.model import Site

LEVEL_M = 1.0
"""Distance between two heights above the terrain at which walls are known."""
LEVELS_MAX = 24
"""Heights that are kept at most; what is taller is as wide above them as at the last one."""
LOWEST_M = 0.4
"""A surface this far above the terrain stands on it; a lower one is part of the ground."""
NOWHERE_M = 1e3
"""Distance [m] that stands for none."""


@pytree
class Walls:
    """Horizontal distances to what reaches higher than a few heights above the terrain."""

    distance_m: jax.Array  # [L, ny, nx] m, signed: negative inside; level k is LOWEST_M + k LEVEL_M above the terrain


def walls_of(site: Site) -> Walls:
    """The walls of a site's surface; on the host."""
    surface, terrain = np.asarray(site.surface_m, np.float32), np.asarray(site.terrain_m, np.float32)
    levels = _distances(surface.tobytes(), terrain.tobytes(), surface.shape, float(site.cell_m))
    return Walls(distance_m=on_host(levels, np.float32))


@lru_cache(maxsize=4)
def _distances(surface: bytes, terrain: bytes, shape: tuple[int, int], cell_m: float) -> np.ndarray:
    """Signed distances [L, ny, nx] to the cells' edges, by the exact Euclidean distance transform."""
    stands = (np.frombuffer(surface, np.float32) - np.frombuffer(terrain, np.float32)).reshape(shape)
    levels = int(np.clip(np.ceil((stands.max() - LOWEST_M) / LEVEL_M) + 1, 1, LEVELS_MAX))
    found = np.full((levels, *shape), NOWHERE_M, np.float32)
    for level in range(levels):
        blocked = stands > LOWEST_M + level * LEVEL_M
        if blocked.any():
            outside, inside = distance_transform_edt(~blocked), distance_transform_edt(blocked)
            found[level] = cell_m * np.where(blocked, 0.5 - inside, outside - 0.5)
    return found


def wall_near(walls: Walls, site: Site, xy: jax.Array, height_m: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distance [] m of the nearest wall and its normal [2] (unit, out of it), at ``xy`` [2] and a height [] above
    terrain.

    Between cells and levels the distance is interpolated; a wall that ends between two levels leans. Above the last
    level there is none.
    """
    levels, ny, nx = walls.distance_m.shape
    place = (xy - site.origin_m) / site.cell_m
    level = (height_m - LOWEST_M) / LEVEL_M
    # Clip the integers too: the conversion of a NaN is undefined.
    column = jnp.clip(jnp.clip(place[0], 0.0, nx - 1.0).astype(jnp.int32), 0, nx - 2)
    row = jnp.clip(jnp.clip(place[1], 0.0, ny - 1.0).astype(jnp.int32), 0, ny - 2)
    lower = jnp.clip(jnp.clip(level, 0.0, levels - 1.0).astype(jnp.int32), 0, levels - 1)
    x, y = jnp.clip(place[0] - column, 0.0, 1.0), jnp.clip(place[1] - row, 0.0, 1.0)
    up = jnp.clip(level - lower, 0.0, 1.0)
    flat = jnp.asarray(walls.distance_m).reshape(-1)

    def at(number: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Distance and slopes [] of a level, per cell."""
        first = (number * ny + row) * nx + column
        south_west, south_east, north_west, north_east = (
            flat.at[first + offset].get(mode="promise_in_bounds") for offset in (0, 1, nx, nx + 1)
        )
        south, north = south_west + x * (south_east - south_west), north_west + x * (north_east - north_west)
        east = (1.0 - y) * (south_east - south_west) + y * (north_east - north_west)
        return south + y * (north - south), east, north - south

    low, high = at(lower), at(jnp.minimum(lower + 1, levels - 1))
    # Where one level has no wall at all, the nearer level decides, and not a mean with "nowhere".
    share = jnp.where(jnp.maximum(low[0], high[0]) < NOWHERE_M / 2, up, jnp.where(up < 0.5, 0.0, 1.0))
    distance, east, north = (a + share * (b - a) for a, b in zip(low, high, strict=True))
    square = east * east + north * north
    steep = jax.lax.rsqrt(jnp.maximum(square, 1e-12))
    flat_here = square < 1e-8  # no wall, the middle of one, where any direction will do, or that of a gap
    normal = jnp.stack([jnp.where(flat_here, 1.0, east * steep), jnp.where(flat_here, 0.0, north * steep)])
    return jnp.where((level > levels) | (flat_here & (distance > 0.0)), NOWHERE_M, distance), normal
