"""How much of a straight segment lies below the terrain, exactly.

The terrain is the bilinear surface between cell centres; along a segment its height above each patch is a quadratic,
whose roots are where the segment enters and leaves the ground. A segment is followed patch by patch, and a maximum
mipmap (Tevs, Ihrke and Seidel, I3D 2008) lets it skip what lies above all ground: a ray to an aircraft takes a dozen
steps, one along the ground one for each patch.

Most segments stay above the ground. They are told by fewer and cheaper steps, whose length is not that to the border of
a tile: the ground in the four tiles that a step can touch is looked at together (`clear_until`). Only from where that
finds no way on is a segment followed patch by patch.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.pytree import on_device, pytree, static

LEAST_STEP = 2.0**-23  # more than float32 can leave out of a sum below 1
NUDGE_CELLS = 1e-3  # a step ends on the border of a tile; so far ahead is asked which tile comes next
ROUNDING_M = 1e-3  # so far above the ground a part of a segment counts as clear: its ends are rounded


@pytree
class Ceilings:
    """Highest ground in square tiles of 1, 2, 4 … patches, levels one after another."""

    highest_m: jax.Array  # [tiles of all levels]
    around_m: jax.Array  # [the same] highest in a tile, the next one to the east, and those two to the north of them
    shapes: tuple[tuple[int, int], ...] = static()  # (rows, columns) of each level


@pytree
class Below:
    """The part of a segment below the terrain."""

    share: jax.Array  # [] of its length
    moment: jax.Array  # [] integral of the place (0 at the start, 1 at the end) over that part
    by_start: jax.Array  # [3] gradient of the share in the segment's start, 1/m
    by_end: jax.Array  # [3] in its end


def ceilings(terrain_m: Any) -> Ceilings:
    """Maximum mipmap of a terrain [ny, nx], up to a level with one tile; on the host for an array of numpy."""
    xp = np if isinstance(terrain_m, np.ndarray) else jnp
    tiles = xp.maximum(terrain_m[1:], terrain_m[:-1])
    tiles = xp.maximum(tiles[:, 1:], tiles[:, :-1])
    levels = [tiles]
    while max(tiles.shape) > 1:
        rows, columns = tiles.shape
        tiles = xp.pad(tiles, ((0, rows % 2), (0, columns % 2)), mode="edge")
        tiles = xp.maximum(tiles[::2], tiles[1::2])
        tiles = xp.maximum(tiles[:, ::2], tiles[:, 1::2])
        levels.append(tiles)
    shapes = tuple((level.shape[0], level.shape[1]) for level in levels)
    highest = xp.concatenate([level.reshape(-1) for level in levels])
    around = xp.concatenate([_of_four(level, xp).reshape(-1) for level in levels])
    if xp is np:
        highest, around = on_device(highest), on_device(around)
    return Ceilings(highest_m=highest, around_m=around, shapes=shapes)


def _of_four(level: Any, xp: Any) -> Any:
    """Greatest value in each tile of a level, the next column's, and those of the next row."""
    level = xp.pad(level, ((0, 1), (0, 1)), mode="edge")
    level = xp.maximum(level[1:], level[:-1])
    return xp.maximum(level[:, 1:], level[:, :-1])


def clear_until(site: Any, above: Ceilings, a: jax.Array, b: jax.Array) -> jax.Array:
    """Share [] of the segment from ``a`` [3] to ``b`` [3] up to which it is surely above the terrain; 1 for all of it.

    Each step is as long as a tile of its level, measured along the axis on which the segment is longer, so that four
    tiles hold it; the next one is twice as long where the segment is above these, and else half as long.
    """
    start, way = (a[:2] - site.origin_m) / site.cell_m, (b[:2] - a[:2]) / site.cell_m
    rise, top = b[2] - a[2], len(above.shapes) - 1
    patch = 1.0 / jnp.maximum(jnp.max(jnp.abs(way)), 1e-9)  # share of the segment

    Carry = tuple[jax.Array, jax.Array, jax.Array]

    def more(carry: Carry) -> jax.Array:
        t, _, met = carry
        return (t < 1.0) & ~met

    def step(carry: Carry) -> Carry:
        t, level, _ = carry
        size = jnp.left_shift(1, level).astype(jnp.float32)
        end = jnp.minimum(t + size * patch, 1.0)
        corner = start + jnp.where(way < 0.0, end, t) * way
        lowest = a[2] + jnp.where(rise < 0.0, end, t) * rise
        ground = _in_tile(above, above.around_m, level, jnp.floor(corner / size))
        clear = lowest > ground + ROUNDING_M
        met = ~clear & (level == 0)
        level = jnp.where(clear, jnp.minimum(level + 1, top), jnp.maximum(level - 1, 0))
        return jnp.where(clear, end, t), level, met

    return jax.lax.while_loop(more, step, (jnp.zeros(()), jnp.asarray(0, jnp.int32), jnp.asarray(False)))[0]


@jax.custom_jvp
def share_below(site: Any, above: Ceilings, a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Share [] of the segment from ``a`` [3] to ``b`` [3] below the terrain, and the mean place of that part.

    The place is 0 at ``a`` and 1 at ``b``. The share is differentiable in both ends, the place is taken as constant.
    """
    found = below(site, above, a, b)
    return found.share, found.moment / jnp.maximum(found.share, 1e-9)


@share_below.defjvp
def _share_below_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
    site, above, a, b = primals
    found = below(site, above, a, b)
    change = jnp.dot(found.by_start, tangents[2]) + jnp.dot(found.by_end, tangents[3])
    place = found.moment / jnp.maximum(found.share, 1e-9)
    return (found.share, place), (change, jnp.zeros_like(place))


def below(site: Any, above: Ceilings, a: jax.Array, b: jax.Array) -> Below:
    """The part of the segment from ``a`` [3] to ``b`` [3] below the terrain of ``site``; see `share_below`.

    Beyond its border the terrain goes on at the height of the border.
    """
    start = (a[:2] - site.origin_m) / site.cell_m
    way = (b[:2] - a[:2]) / site.cell_m
    rise, top = b[2] - a[2], len(above.shapes) - 1
    # in units of the segment's length
    ahead = jnp.clip(NUDGE_CELLS / jnp.maximum(jnp.max(jnp.abs(way)), 1e-9), LEAST_STEP, 1.0)
    raster = site.terrain_m.reshape(-1)
    ny, nx = site.terrain_m.shape
    patch = partial(_patch, raster, (ny, nx), start, way, site.cell_m)

    Carry = tuple[jax.Array, jax.Array, Below]

    def more(carry: Carry) -> jax.Array:
        return carry[0] < 1.0

    def step(carry: Carry) -> Carry:
        t, level, found = carry
        size = jnp.left_shift(1, level)
        tile = jnp.floor((start + (t + ahead) * way) / size)
        border = (tile + (way > 0.0)) * size
        leave = jnp.where(way == 0.0, jnp.inf, (border - start) / jnp.where(way == 0.0, 1.0, way))
        end = jnp.clip(jnp.min(leave), jnp.minimum(t + ahead, 1.0), 1.0)
        lowest = a[2] + jnp.minimum(t * rise, end * rise)
        clear = lowest > _in_tile(above, above.highest_m, level, tile)
        descend = ~clear & (level > 0)
        inside = patch(tile, (t, end), (a[2], rise), ~clear & (level == 0))
        found = jax.tree.map(jnp.add, found, inside)
        level = jnp.where(descend, level - 1, jnp.where(clear, jnp.minimum(level + 1, top), level))
        return jnp.where(descend, t, end), level, found

    zero = jnp.zeros(())
    nothing = Below(share=zero, moment=zero, by_start=jnp.zeros(3), by_end=jnp.zeros(3))
    return jax.lax.while_loop(more, step, (clear_until(site, above, a, b), jnp.asarray(0, jnp.int32), nothing))[2]


def _in_tile(above: Ceilings, values: jax.Array, level: jax.Array, tile: jax.Array) -> jax.Array:
    """Value [] of a tile (column, row) of a level; tiles beyond the border are those at it."""
    rows, columns, first = [], [], [0]
    for ny, nx in above.shapes:
        rows.append(ny)
        columns.append(nx)
        first.append(first[-1] + ny * nx)
    width, height = jnp.asarray(columns)[level], jnp.asarray(rows)[level]
    column = jnp.clip(tile[0].astype(jnp.int32), 0, width - 1)
    row = jnp.clip(tile[1].astype(jnp.int32), 0, height - 1)
    return values.at[jnp.asarray(first)[level] + row * width + column].get(mode="promise_in_bounds")


def _patch(
    raster: jax.Array,
    shape: tuple[int, int],
    start: jax.Array,
    way: jax.Array,
    cell_m: jax.Array,
    tile: jax.Array,
    span: tuple[jax.Array, jax.Array],
    height: tuple[jax.Array, jax.Array],
    counts: jax.Array,
) -> Below:
    """What lies below one patch between two places; zeros unless ``counts``."""
    (ny, nx), (t0, t1) = shape, span
    columns = jnp.clip(tile[0].astype(jnp.int32) + jnp.array([0, 1]), 0, nx - 1)
    rows = jnp.clip(tile[1].astype(jnp.int32) + jnp.array([0, 1]), 0, ny - 1)
    corner = raster.at[rows[:, None] * nx + columns].get(mode="promise_in_bounds")
    east, north = corner[0, 1] - corner[0, 0], corner[1, 0] - corner[0, 0]
    twist = corner[1, 1] - corner[1, 0] - east
    # from the beginning of the span on, s = 0 .. 1: depth below the ground = p + q s + r s^2
    x, y = start + t0 * way - tile
    dx, dy = (t1 - t0) * way
    p = corner[0, 0] + east * x + north * y + twist * x * y - height[0] - t0 * height[1]
    q = east * dx + north * dy + twist * (x * dy + y * dx) - (t1 - t0) * height[1]
    r = twist * dx * dy
    low, high = _roots(p, q, r)
    cuts = jnp.stack([jnp.zeros(()), low, high, jnp.ones(())])
    middle = 0.5 * (cuts[1:] + cuts[:-1])
    under = (p + middle * (q + middle * r) > 0.0) & counts
    length = (t1 - t0) * jnp.where(under, cuts[1:] - cuts[:-1], 0.0)
    share = jnp.sum(length)
    moment = jnp.sum(length * (t0 + (t1 - t0) * middle))
    # At a root s the segment crosses the ground; moving the ground up by dg there lengthens the part by dg / |slope|.
    root = cuts[1:3]
    crosses = (under[:-1] != under[1:]) & counts
    slope = jnp.abs(q + 2.0 * r * root) / jnp.maximum(t1 - t0, 1e-9)
    weight = jnp.where(crosses, 1.0 / jnp.maximum(slope, 1e-6), 0.0)
    place = t0 + (t1 - t0) * root
    normal = jnp.stack([
        (east + twist * (y + root * dy)) / cell_m, (north + twist * (x + root * dx)) / cell_m, -jnp.ones_like(root)
    ])  # fmt: skip
    return Below(
        share=share, moment=moment, by_start=normal @ (weight * (1.0 - place)), by_end=normal @ (weight * place)
    )


def _roots(p: jax.Array, q: jax.Array, r: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Roots of p + q s + r s^2 between 0 and 1 in order; 0 and 0, or 1 and 1, for those that lie elsewhere."""
    square = q * q - 4.0 * p * r
    real = square > 0.0
    # the root that does not cancel first; the other by Vieta
    sum_ = -0.5 * (q + jnp.where(q < 0.0, -1.0, 1.0) * jnp.sqrt(jnp.where(real, square, 0.0)))
    one = jnp.where(sum_ != 0.0, p / jnp.where(sum_ != 0.0, sum_, 1.0), jnp.inf)
    two = jnp.where(r != 0.0, sum_ / jnp.where(r != 0.0, r, 1.0), jnp.inf)
    found = [jnp.clip(jnp.where(real, root, 0.0), 0.0, 1.0) for root in (one, two)]
    return jnp.minimum(*found), jnp.maximum(*found)
