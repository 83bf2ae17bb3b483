"""What a straight line crosses: the length in each material, and where along the line it lies."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.device import on_processor
from swarmsim.pytree import pytree
from swarmsim.scalars import over_vehicles
from swarmsim.site.model import Obstacles, Site, sample
from swarmsim.site.surfaces import DEPTHS, PARALLEL_M, Box, least, matter, most, scattered_share, thin_m_of
from swarmsim.site.terrain_crossing import Ceilings, ceilings, share_below

NEIGHBOURS = 16  # segments that are intersected with the same clusters of boxes
PAIRS = 128  # of a segment and a box, of which shares are computed at a time
CLUSTER = 16  # boxes, a multiple of the SIMD width; the last cluster is filled up with empty ones
_UPPER = -(1 << 16)  # mask of a number's upper half
_TOUCH_M = 1e-3  # boxes so near to a segment count as met, for rounding


@pytree
class Shape:
    """What decides how much of the photons that scatter in walls arrives: see `swarmsim.radiation.walls`."""

    thin_m: jax.Array  # [..., M] length the shortest way through each piece of matter that is crossed; <= length_m
    share: jax.Array  # [..., DEPTHS] photons that walls scatter, over those of infinite walls crossed squarely
    closed: jax.Array  # [...] 0..1: whether the segment leads out of a hollow box
    walls: jax.Array  # [...] 1..2: walls of a box that are crossed in turn
    ground: jax.Array  # [..., 2] how the ground shines, see `mirrored`


@pytree
class Crossed:
    """Materials along a segment, in the order of ``Site.material_names``."""

    length_m: jax.Array  # [..., M]
    place: jax.Array  # [..., M] mean place of the material along the segment, 0 at its start and 1 at its end
    shape: Shape | None = None  # None: walls are infinitely wide, and crossed squarely


def stretched(way: Crossed, factors: jax.Array) -> Crossed:
    """The same with each material [M] so many times as thick."""
    shape = None if way.shape is None else replace(way.shape, thin_m=way.shape.thin_m * factors)
    return replace(way, length_m=way.length_m * factors, shape=shape)


def nothing_crossed(n: int, materials: int) -> Crossed:
    """Of n segments that have no length."""
    zero = jnp.zeros((n, materials))
    return Crossed(length_m=zero, place=zero, shape=wide(zero, jnp.zeros((n, 2))))


def wide(thin_m: jax.Array, ground: jax.Array) -> Shape:
    """That of infinite walls crossed squarely: ``thin_m`` [..., M], ``ground`` [..., 2]."""
    one = jnp.ones(thin_m.shape[:-1])
    return Shape(
        thin_m=thin_m, share=jnp.ones((*one.shape, len(DEPTHS))), closed=jnp.zeros_like(one), walls=one, ground=ground
    )


def path_lengths(site: Site, a: jax.Array, b: jax.Array) -> jax.Array:
    """Metres [M] of the straight segment from ``a`` [3] to ``b`` [3] (ENU, m) in each of ``site.material_names``.

    See `crossed`.
    """
    return crossed(site, a, b).length_m


def crossed(site: Site, a: jax.Array, b: jax.Array) -> Crossed:
    """The materials on the straight segment from ``a`` [3] to ``b`` [3] (ENU, m).

    Boxes are intersected exactly (slab method, Kay and Kajiya, SIGGRAPH 1986); of a hollow box, only the shell counts.
    The terrain is crossed exactly too (`swarmsim.site.terrain_crossing`). Lengths are continuous in both ends and
    differentiable almost everywhere; of the rest ``thin_m`` and ``ground`` are, the others are constants to
    derivatives. The ``shape`` knows two boxes, those with the longest short ways; others count as wide walls, and the
    two do so too as far as a third is as long. Where obstacles overlap, the lengths are scaled so that their sum does
    not exceed the distance. The remaining distance is that through ``air`` if the table has it, and then the sum equals
    the distance.
    """
    way = _way(site, above_of(site), a, b)
    every = _shaped(site.obstacles, a[None], b[None], jax.tree.map(lambda x: x[None], way))
    return jax.tree.map(lambda x: x[0], every)


def above_of(site: Site) -> Ceilings:
    """The site's `Ceilings`, made here for a site that has none."""
    return ceilings(site.terrain_m) if site.above is None else site.above


@pytree
class _Longest:
    """The three boxes with the longest short ways, for segments [...]: see `_key`; 0 for none."""

    first: jax.Array  # [...] int32
    second: jax.Array
    third: jax.Array


def _key(thin: jax.Array, number: jax.Array) -> jax.Array:
    """A number that grows with ``thin`` [...] >= 0 to 1 %, and holds the box's ``number`` in its lower half."""
    bits = jax.lax.bitcast_convert_type(thin, jnp.int32)  # it grows with the value
    return jnp.where(thin > 0.0, (bits & _UPPER) | number, 0)


def _of_both(one: _Longest, other: _Longest) -> _Longest:
    """The same of the boxes of either."""
    lower, seconds = jnp.minimum(one.first, other.first), jnp.maximum(one.second, other.second)
    rest = jnp.maximum(jnp.minimum(lower, seconds), jnp.minimum(one.second, other.second))
    return _Longest(
        first=jnp.maximum(one.first, other.first),
        second=jnp.maximum(lower, seconds),
        third=jnp.maximum(rest, jnp.maximum(one.third, other.third)),
    )


def _nothing_met() -> _Longest:
    none = jnp.zeros((), jnp.int32)
    return _Longest(first=none, second=none, third=none)


@pytree
class _Way:
    """What is known of a segment before its `Shape`."""

    crossed: Crossed  # without a shape
    thin_m: jax.Array  # [M]
    ground: jax.Array  # [2]
    walls_m: jax.Array  # [] length the short way in all but air
    met: _Longest


def _shaped(boxes: Obstacles, a: jax.Array, b: jax.Array, way: _Way, size: int | None = None) -> Crossed:
    """``way`` [n] from ``a`` [n, 3] to ``b`` [n, 3] with its shape.

    With ``size``, so many pairs of a segment and a box at a time: many segments meet none. Else all together.
    """
    a, b, n = jax.lax.stop_gradient(a), jax.lax.stop_gradient(b), b.shape[0]
    keys = jnp.concatenate([way.met.first, way.met.second])
    # the third's, longer by what two keys may differ without being in order
    third = jax.lax.cond(
        jnp.any(way.met.third > 0),
        lambda: jnp.where(way.met.third > 0, 1.02 * thin_m_of(_box(boxes, way.met.third, a, b)), 0.0),
        lambda: jnp.zeros(n),
    )

    def of(pair: jax.Array) -> jax.Array:
        """Length the short way, share less 1, closed, and walls less 1 [DEPTHS + 3, k] of pairs [k]."""
        row = pair % n
        found = scattered_share(_box(boxes, keys[pair], a[row], b[row]))
        return jnp.stack([found.thin_m, *(x - 1.0 for x in found.share), found.closed, found.walls - 1.0])

    each = (of(jnp.arange(2 * n)) if size is None else _packed(of, keys > 0, size)).reshape(-1, 2, n)
    weight = jnp.where(keys.reshape(2, n) > 0, jnp.maximum(each[0] - third, 0.0), 0.0) / jnp.maximum(way.walls_m, 1e-9)
    more = [jnp.sum(jnp.where(weight > 0.0, weight * x, 0.0), axis=0) for x in each[1:]]
    share = 1.0 + jnp.stack(more[:-2], axis=-1)
    shape = Shape(thin_m=way.thin_m, share=share, closed=more[-2], walls=1.0 + more[-1], ground=way.ground)
    return replace(way.crossed, shape=shape)


def _packed(function: Callable[[jax.Array], jax.Array], wanted: jax.Array, size: int) -> jax.Array:
    """``function`` [k, size] of the ``wanted`` [n] numbers, ``size`` at a time; of the others anything."""
    n, place = wanted.shape[0], jnp.cumsum(wanted.astype(jnp.int32)) - 1
    size = min(size, n)
    rows = jnp.zeros(n + size, jnp.int32).at[jnp.where(wanted, place, n + size)].set(jnp.arange(n), mode="drop")
    found = jnp.zeros((len(DEPTHS) + 3, n + size))

    def step(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        first, found = carry
        own = function(jax.lax.dynamic_slice(rows, (first,), (size,)))
        return first + size, jax.lax.dynamic_update_slice(found, own, (jnp.zeros_like(first), first))

    _, found = jax.lax.while_loop(lambda carry: carry[0] <= place[-1], step, (jnp.zeros((), jnp.int32), found))
    return found[:, jnp.maximum(place, 0)]


def _box(boxes: Obstacles, key: jax.Array, a: jax.Array, b: jax.Array) -> Box:
    """The boxes of these keys [n], with segments from ``a`` [n, 3] to ``b`` [n, 3]."""
    own = jax.tree.map(lambda x: jnp.take(x, key & ~_UPPER, axis=0, mode="clip"), boxes)
    start, end = (_in_axes(own, x - own.centre_m) for x in (a, b))
    return Box(start, end, [own.half_extent_m[:, k] for k in range(3)], own.wall_m)


def _way(site: Site, above: Ceilings, a: jax.Array, b: jax.Array, boxes: "Boxes | None" = None) -> _Way:
    direction = b - a
    squared = jnp.sum(direction * direction)
    distance = jnp.where(squared > 0.0, jnp.sqrt(jnp.where(squared > 0.0, squared, 1.0)), 0.0)
    materials = jnp.arange(len(site.material_names), dtype=jnp.int32)
    found = (boxes or _all_boxes)(site, a, direction, distance)
    fractions, moments, thin = found.share, found.moment, found.thin
    # A function with its own derivative takes no arrays of the host, as the values of a world are: add nothing to them.
    soil, soil_place = share_below(site, above, jnp.add(a, 0.0), jnp.add(b, 0.0))
    ground = materials == site.ground_material
    fractions, thin = (x + jnp.where(ground, soil, 0.0) for x in (fractions, thin))
    walls = jnp.maximum(jnp.sum(thin), 1e-9)
    moments = moments + jnp.where(ground, jax.lax.stop_gradient(soil * soil_place), 0.0)
    place = jnp.where(fractions > 1e-9, moments / jnp.maximum(fractions, 1e-9), 0.5)
    total = jnp.sum(fractions)
    fractions, thin = (x / jnp.maximum(total, 1.0) for x in (fractions, thin))
    if "air" in site.material_names:
        rest = jnp.where(materials == site.material_names.index("air"), jnp.maximum(1.0 - total, 0.0), 0.0)
        fractions, thin = fractions + rest, thin + rest
    place = jax.lax.stop_gradient(jnp.clip(place, 0.0, 1.0))
    crossed = Crossed(length_m=distance * fractions, place=place)
    thin_m, ground = distance * thin, mirrored(site, a, b)
    return _Way(
        crossed=crossed, thin_m=thin_m, ground=ground, walls_m=jax.lax.stop_gradient(distance * walls), met=found.met
    )


def mirrored(site: Site, a: jax.Array, b: jax.Array) -> jax.Array:
    """(r / r')^2 (sqrt(u), u) [2] of a segment above the ground: `swarmsim.radiation.ground`.

    r is the distance of its ends, r' that of the one from the other's mirror image below the ground, u the sine of the
    image's elevation; by the ends' heights above the ground below each.
    """
    one, other = (jnp.maximum(x[2] - sample(site.terrain_m, site, x[:2]), 0.0) for x in (a, b))
    level2 = jnp.square(b[0] - a[0]) + jnp.square(b[1] - a[1])
    both, image2 = one + other, level2 + jnp.square(one + other) + 1e-12
    u, ratio = both * jax.lax.rsqrt(image2), (level2 + jnp.square(one - other)) / image2
    # an elevation of zero has a root without derivative
    root = jnp.where(u > 0.0, jnp.sqrt(jnp.where(u > 0.0, u, 1.0)), 0.0)
    return ratio * jnp.stack([root, u])


def crossed_from(site: Site, a: jax.Array, b: jax.Array) -> Crossed:
    """`crossed` [n] of the segments from ``a`` [3] to each of ``b`` [n, 3], in the way that suits the device."""
    return _in_blocks(site, a, b) if on_processor() else by_threads(site, a, b)


def _in_blocks(site: Site, a: jax.Array, b: jax.Array) -> Crossed:
    """In blocks of neighbouring ends; clusters of boxes that none of a block's segments comes near are left out.

    Within a cluster the boxes are the vectorised axis.
    """
    n, above, clusters = b.shape[0], above_of(site), _clusters(site.obstacles)
    every = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), clusters)
    firsts = jnp.arange(0, every.wall_m.shape[0], CLUSTER)
    size = min(NEIGHBOURS, n)
    ends = jnp.pad(b, [(0, -n % size), (0, 0)], mode="edge").reshape(-1, size, 3)

    def block(ends: jax.Array) -> _Way:
        near = jax.lax.map(lambda boxes: jnp.any(_near(boxes, a, ends)), clusters)

        def of_clusters(site: Site, a: jax.Array, direction: jax.Array, distance: jax.Array) -> _Found:
            def add(found: _Found, cluster: tuple[Obstacles, jax.Array, jax.Array]) -> tuple[_Found, None]:
                def met(found: _Found) -> _Found:
                    return _together(
                        found, _all_boxes(replace(site, obstacles=cluster[0]), a, direction, distance, cluster[2])
                    )

                return jax.lax.cond(cluster[1], met, lambda found: found, found), None

            return jax.lax.scan(add, _nothing_found(len(site.material_names)), (clusters, near, firsts))[0]

        return jax.vmap(lambda end: _way(site, above, a, end, of_clusters))(ends)

    ways = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:n], jax.lax.map(block, ends))
    return _shaped(every, jnp.broadcast_to(a, b.shape), b, ways, PAIRS)


def _clusters(boxes: Obstacles) -> Obstacles:
    """Boxes [C, `CLUSTER`] in clusters of near ones: along a Z-order curve of 1024 x 1024 cells (Morton 1966)."""
    low, high = jnp.min(boxes.centre_m, axis=0), jnp.max(boxes.centre_m, axis=0)
    cell = ((boxes.centre_m - low) / jnp.maximum(high - low, 1e-6) * 1023.0)[:, :2].astype(jnp.uint32)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        cell = (cell | (cell << shift)) & mask
    order = jnp.argsort(cell[:, 0] | (cell[:, 1] << 1))
    rows = -len(order) % CLUSTER

    def clustered(leaf: jax.Array) -> jax.Array:
        padded = jnp.pad(jnp.asarray(leaf)[order], [(0, rows)] + [(0, 0)] * (leaf.ndim - 1))
        return padded.reshape(-1, CLUSTER, *leaf.shape[1:])

    return jax.tree.map(clustered, boxes)


def _near(boxes: Obstacles, a: jax.Array, ends: jax.Array) -> jax.Array:
    """Whether any segment from ``a`` [3] to ``ends`` [n, 3] may meet each box [K].

    A point at the share s of one of them is no farther than s D from that of the segment to the ends' middle, D being
    how far they lie around it: that segment is tested against a box so much larger.
    """
    middle = 0.5 * (jnp.min(ends, axis=0) + jnp.max(ends, axis=0))
    around = jnp.sqrt(jnp.max(jnp.sum(jnp.square(ends - middle), axis=1)))
    direction = middle - a
    length = jnp.sqrt(jnp.sum(direction * direction))
    offset = boxes.centre_m - a
    share = jnp.clip(offset @ direction / jnp.maximum(length * length, 1e-9), 0.0, 1.0)
    radius = jnp.sqrt(jnp.sum(boxes.half_extent_m**2, axis=1))
    # where it meets the box, at s: (s - share) length <= radius + s around
    last = jnp.where(length > around, (radius + share * length) / jnp.maximum(length - around, 1e-6), 1.0)
    larger = boxes.half_extent_m + (around * jnp.minimum(last, 1.0) + _TOUCH_M)[:, None]
    start, along = _in_axes(boxes, -offset), _in_axes(boxes, direction)
    inverse = [1.0 / jnp.where(jnp.abs(d) < PARALLEL_M, PARALLEL_M, d) for d in along]
    reach = [jnp.abs(i) * larger[:, k] for k, i in enumerate(inverse)]
    middles = [-x * i for x, i in zip(start, inverse, strict=True)]
    enter = jnp.maximum(most([m - r for m, r in zip(middles, reach, strict=True)]), 0.0)
    leave = jnp.minimum(least([m + r for m, r in zip(middles, reach, strict=True)]), 1.0)
    # an end that is no number (padding may hold anything) must not hide a box from its neighbours
    return ~(leave < enter) & (radius > 0.0)


def _in_axes(boxes: Obstacles, vector: jax.Array) -> list[jax.Array]:
    """Components [K] of ``vector`` [3] or [K, 3] along the axes of each box."""
    c, s = boxes.axis[:, 0], boxes.axis[:, 1]
    x, y, z = (vector[..., k] for k in range(3))
    return [c * x + s * y, c * y - s * x, jnp.broadcast_to(z, c.shape)]


def by_threads(site: Site, a: jax.Array, b: jax.Array, platform: str | None = None) -> Crossed:
    """`crossed_from` with a thread for each segment, which goes through the boxes and over the terrain by itself.

    ``platform`` is that of `swarmsim.scalars.over_vehicles`.
    """
    above = above_of(site)
    needed = (site.obstacles, site.terrain_m, site.origin_m, site.cell_m, site.ground_material)
    nothing, shapes = np.zeros(1, np.float32), above.shapes
    bare = jax.tree.map(lambda _: nothing, site)

    def one(end: jax.Array, start: jax.Array, needed: Any, highest: jax.Array) -> _Way:
        boxes, terrain, origin, cell, ground = needed
        here = replace(bare, obstacles=boxes, terrain_m=terrain, origin_m=origin, cell_m=cell, ground_material=ground)
        return _way(here, Ceilings(highest_m=highest, shapes=shapes), start, end, _box_after_box)

    starts = jnp.broadcast_to(a, b.shape)
    ways: _Way = over_vehicles(one, (0, 0, None, None), platform=platform)(b, starts, needed, above.highest_m)
    return _shaped(site.obstacles, starts, b, ways)


@pytree
class _Found:
    """What a segment crosses of the boxes of each material [M]; lengths over the segment's."""

    share: jax.Array
    moment: jax.Array  # integral of the place over the part inside
    thin: jax.Array  # the shortest way through each box's matter
    met: _Longest


def _nothing_found(materials: int) -> _Found:
    zero = jnp.zeros(materials)
    return _Found(share=zero, moment=zero, thin=zero, met=_nothing_met())


def _together(one: _Found, other: _Found) -> _Found:
    return _Found(
        share=one.share + other.share, moment=one.moment + other.moment, thin=one.thin + other.thin,
        met=_of_both(one.met, other.met),
    )  # fmt: skip


Boxes = Callable[[Site, jax.Array, jax.Array, jax.Array], _Found]
"""What a segment meets [M]; it starts at a place [3], and is given as a vector [3] and that vector's length []."""


def _all_boxes(
    site: Site, a: jax.Array, direction: jax.Array, distance: jax.Array, first: jax.Array | int = 0
) -> _Found:
    """Of all boxes of the site, the numbers of which begin with ``first``."""
    materials = jnp.arange(len(site.material_names), dtype=jnp.int32)
    one_hot = (site.obstacles.material[:, None] == materials).astype(jnp.float32)
    share, moment, thin = _of_boxes(site.obstacles, a, direction, distance)
    # Matrix product: a masked sum would dominate the cost.
    stacked = jnp.stack([share, jax.lax.stop_gradient(moment), thin])
    sums = jnp.dot(stacked, one_hot, precision=jax.lax.Precision.HIGHEST)
    return _Found(share=sums[0], moment=sums[1], thin=sums[2], met=_longest(jax.lax.stop_gradient(thin), first))


def _longest(thin: jax.Array, first: jax.Array | int) -> _Longest:
    """Those of boxes with short ways ``thin`` [K], the numbers of which begin with ``first``."""
    key = _key(thin, jnp.arange(thin.shape[0], dtype=jnp.int32) + first)
    most = jnp.max(key)
    rest = jnp.where(key == most, 0, key)
    second = jnp.max(rest)
    return _Longest(first=most, second=second, third=jnp.max(jnp.where(rest == second, 0, rest)))


def _box_after_box(site: Site, a: jax.Array, direction: jax.Array, distance: jax.Array) -> _Found:
    boxes, materials = site.obstacles, jnp.arange(len(site.material_names), dtype=jnp.int32)

    def add(k: jax.Array, found: _Found) -> _Found:
        box = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, k, 1), boxes)
        lengths = _of_boxes(box, a, direction, distance)
        own, met = box.material == materials, jax.lax.stop_gradient(lengths[2][0])
        share, moment, thin = (jnp.where(own, x, 0.0) for x in lengths)
        each = replace(_nothing_met(), first=_key(met, jnp.asarray(k, jnp.int32)))
        return _together(found, _Found(share=share, moment=moment, thin=thin, met=each))

    return jax.lax.fori_loop(0, boxes.wall_m.shape[0], add, _nothing_found(materials.shape[0]))


def _of_boxes(
    obstacles: Obstacles, a: jax.Array, direction: jax.Array, distance: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`matter` of each box [K]. Written per component, so that the boxes are the vectorised axis."""
    start, along = _in_axes(obstacles, a - obstacles.centre_m), _in_axes(obstacles, direction)
    half = [obstacles.half_extent_m[:, k] for k in range(3)]
    return matter(start, along, half, obstacles.wall_m, distance)
