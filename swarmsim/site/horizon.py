"""Path lengths from one point to many, with a conservative test that skips the terrain for rays clear of it.

Integrating the terrain is three quarters of the cost of a ray, and most rays to an aircraft do not touch the ground.
A maximum mipmap (Tevs, Ihrke and Seidel, I3D 2008) holds the highest ground of each neighbourhood at several
resolutions; a ray that is above it in every interval is clear of the ground.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.site.model import Site
from swarmsim.site.rays import ground_fraction, path_lengths

Ceilings = tuple[jax.Array, ...]  # each level [ty, tx]: highest ground in a tile and its eight neighbours

FIRST_TILE_CELLS = 2  # edge of the finest tile; each further level doubles it
INTERVALS_PER_LEVEL = 2  # intervals of the length of a level's tile, before the next level is used
GROUP = 32  # segments for which the terrain is integrated together or not at all
BLOCK = 384  # segments intersected with all boxes at a time, so that the result fits the cache
VECTOR = 8  # boxes are padded to a multiple of this SIMD width, with empty boxes


def ceilings(site: Site) -> Ceilings:
    """Maximum mipmap of a site's terrain, up to a level with one tile."""
    corner = jax.lax.reduce_window(site.terrain_m, -jnp.inf, jax.lax.max, (2, 2), (1, 1), "VALID")  # [ny-1, nx-1]
    levels, tiles = [], _pooled(corner, FIRST_TILE_CELLS)
    while True:
        levels.append(jax.lax.reduce_window(tiles, -jnp.inf, jax.lax.max, (3, 3), (1, 1), "SAME"))
        if max(tiles.shape) == 1:
            return tuple(levels)
        tiles = _pooled(tiles, 2)


def clear_of_ground(site: Site, above: Ceilings, a: jax.Array, b: jax.Array) -> jax.Array:
    """Whether the segments from ``a`` [3] to ``b`` [n, 3] are certain not to touch the ground [n].

    A segment is tested in intervals that grow with the distance from ``a``, each within one tile of a level and its
    neighbours. The test is conservative: a segment for which it is False may still be clear.
    """
    direction = b - a
    length = jnp.maximum(jnp.linalg.norm(direction[:, :2], axis=-1), 1e-6)
    clear, done = jnp.ones(b.shape[0], bool), 0  # done: cells along the segment
    for level, highest in enumerate(above):
        cells = FIRST_TILE_CELLS << level
        for _ in range(INTERVALS_PER_LEVEL):
            first, last = (jnp.minimum(c * site.cell_m / length, 1.0) for c in (done, done + cells))
            place = (a[:2] + first[:, None] * direction[:, :2] - site.origin_m) / (cells * site.cell_m)
            index = jnp.clip(place.astype(jnp.int32), 0, jnp.array([highest.shape[1] - 1, highest.shape[0] - 1]))
            lowest = a[2] + jnp.minimum(first * direction[:, 2], last * direction[:, 2])
            clear &= (lowest > highest[index[:, 1], index[:, 0]]) | (done * site.cell_m >= length)
            done += cells
    # A segment longer than the range of the coarsest level was not tested to its end.
    return clear & (length <= done * site.cell_m)


def path_lengths_from(site: Site, above: Ceilings, a: jax.Array, b: jax.Array) -> jax.Array:
    """`path_lengths` [n, M] of the segments from ``a`` [3] to each of ``b`` [n, 3], much faster than one by one.

    ``above`` are the site's `ceilings`. The terrain is integrated only for groups of `GROUP` consecutive segments with
    one that is not clear of it, so sort segments that end near the ground together. (Under `vmap`, it is integrated
    for all groups, because a batched `cond` evaluates both branches.)
    """
    n = b.shape[0]

    def soil(group: tuple[jax.Array, jax.Array]) -> jax.Array:
        ends, clear = group

        def follow() -> jax.Array:
            return jax.vmap(lambda end: ground_fraction(site, a, end - a))(ends)

        return jax.lax.cond(jnp.all(clear), lambda: jnp.zeros(GROUP), follow)

    groups = _grouped(b, GROUP), _grouped(clear_of_ground(site, above, a, b), GROUP)
    below = jax.lax.map(soil, groups).reshape(-1)[:n]
    rows = -site.obstacles.wall_m.shape[0] % VECTOR
    boxes = jax.tree.map(lambda x: jnp.pad(x, [(0, rows)] + [(0, 0)] * (x.ndim - 1)), site.obstacles)
    padded = replace(site, obstacles=boxes)
    size = min(BLOCK, n)

    def block(part: tuple[jax.Array, jax.Array]) -> jax.Array:
        return jax.vmap(lambda end, soil: path_lengths(padded, a, end, soil))(*part)

    lengths = jax.lax.map(block, (_grouped(b, size), _grouped(below, size)))
    return lengths.reshape(-1, len(site.material_names))[:n]


def _grouped(x: jax.Array, size: int) -> jax.Array:
    """Rows [n, …] in groups [ceil(n / size), size, …]; the last group is padded with the last row."""
    padded = jnp.pad(x, [(0, -x.shape[0] % size)] + [(0, 0)] * (x.ndim - 1), mode="edge")
    return padded.reshape(-1, size, *x.shape[1:])


def _pooled(raster: jax.Array, cells: int) -> jax.Array:
    """Maximum over each square of ``cells`` x ``cells``; squares at the far borders may be incomplete."""
    padding = [(0, -n % cells) for n in raster.shape]
    return jax.lax.reduce_window(raster, -jnp.inf, jax.lax.max, (cells, cells), (cells, cells), padding)
