"""What a straight line crosses: the length in each material, and where along the line it lies."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.device import on_processor
from swarmsim.pytree import pytree
from swarmsim.scalars import over_vehicles
from swarmsim.site.model import Obstacles, Site, sample
from swarmsim.site.shapes import (
    Crossed,
    Most,
    Shape,
    Way,
    in_axes,
    key_of,
    most_of,
    nothing_met,
    of_both,
    shaped,
    stretched,
    walls_of_materials,
    wide,
)
from swarmsim.site.surfaces import matter, part_inside, slabs
from swarmsim.site.terrain_crossing import Ceilings, ceilings, share_below

NEIGHBOURS = 16  # segments that are intersected with the same clusters of boxes
PAIRS = 128  # of a segment and a box, of which shares are computed at a time
PAIRS_OF_MANY = 128  # the same of each of many places, on an accelerator
CLUSTER = 16  # boxes, a multiple of the SIMD width; the last cluster is filled up with empty ones
LOW_M = 2.0  # height at which half of the ground is left of what a low source in a building sees of it
_TOUCH_M = 1e-3  # boxes so near to a segment count as met, for rounding


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
    derivatives. The ``shape`` knows three boxes, those with the most matter the short way, and others count as these.
    Where obstacles overlap, the lengths are scaled so that their sum does
    not exceed the distance. The remaining distance is that through ``air`` if the table has it, and then the sum equals
    the distance.
    """
    way = _way(site, above_of(site), a, b)
    every = shaped(site.obstacles, walls_of_materials(site), a[None], b[None], jax.tree.map(lambda x: x[None], way))
    return jax.tree.map(lambda x: x[0], every)


def above_of(site: Site) -> Ceilings:
    """The site's `Ceilings`, made here for a site that has none."""
    return ceilings(site.terrain_m) if site.above is None else site.above


def _way(site: Site, above: Ceilings, a: jax.Array, b: jax.Array, boxes: "Boxes | None" = None) -> Way:
    direction = b - a
    distance = _length(direction)
    materials = jnp.arange(len(site.material_names), dtype=jnp.int32)
    found = (boxes or _all_boxes)(site, a, direction, distance)
    fractions, moments, thin = found.share, found.moment, found.thin
    # A function with its own derivative takes no arrays of the host, as the values of a world are: add nothing to them.
    soil, soil_place = share_below(site, above, jnp.add(a, 0.0), jnp.add(b, 0.0))
    ground, of_metre = materials == site.ground_material, walls_of_materials(site)
    in_boxes = jax.lax.stop_gradient(distance * jnp.sum(thin * of_metre))
    fractions, thin = (x + jnp.where(ground, soil, 0.0) for x in (fractions, thin))
    in_all = jax.lax.stop_gradient(distance * jnp.sum(thin * of_metre))
    moments = moments + jnp.where(ground, jax.lax.stop_gradient(soil * soil_place), 0.0)
    place = jnp.where(fractions > 1e-9, moments / jnp.maximum(fractions, 1e-9), 0.5)
    total = jnp.sum(fractions)
    fractions, thin = (x / jnp.maximum(total, 1.0) for x in (fractions, thin))
    if "air" in site.material_names:
        rest = jnp.where(materials == site.material_names.index("air"), jnp.maximum(1.0 - total, 0.0), 0.0)
        fractions, thin = fractions + rest, thin + rest
    place = jax.lax.stop_gradient(jnp.clip(place, 0.0, 1.0))
    crossed = Crossed(length_m=distance * fractions, place=place)
    heights = above_ground(site, a, b)
    thin_m, ground = distance * thin, mirrored(a, b, *heights)
    low = 1.0 / (1.0 + jnp.square(jax.lax.stop_gradient(jnp.minimum(*heights)) / LOW_M))
    return Way(crossed=crossed, thin_m=thin_m, ground=ground, low=low, boxes=in_boxes, walls=in_all, met=found.met)


def _length(vector: jax.Array) -> jax.Array:
    """Length [...] of vectors [..., 3]; that of zero has no derivative, not one that is no number."""
    squared = jnp.sum(vector * vector, axis=-1)
    return jnp.where(squared > 0.0, jnp.sqrt(jnp.where(squared > 0.0, squared, 1.0)), 0.0)


def above_ground(site: Site, a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Heights [] of the ends of a segment above the ground below each; 0 below it."""
    one, other = (jnp.maximum(x[2] - sample(site.terrain_m, site, x[:2]), 0.0) for x in (a, b))
    return one, other


def mirrored(a: jax.Array, b: jax.Array, one: jax.Array, other: jax.Array) -> jax.Array:
    """(r / r')^2 (sqrt(u), u) [2] of a segment above the ground: `swarmsim.radiation.ground`.

    r is the distance of its ends, r' that of the one from the other's mirror image below the ground, u the sine of the
    image's elevation; by the ends' heights ``one`` and ``other`` [] above the ground below each.
    """
    level2 = jnp.square(b[0] - a[0]) + jnp.square(b[1] - a[1])
    both, image2 = one + other, level2 + jnp.square(one + other) + 1e-12
    u, ratio = both * jax.lax.rsqrt(image2), (level2 + jnp.square(one - other)) / image2
    # an elevation of zero has a root without derivative
    root = jnp.where(u > 0.0, jnp.sqrt(jnp.where(u > 0.0, u, 1.0)), 0.0)
    return ratio * jnp.stack([root, u])


def crossed_from(site: Site, a: jax.Array, b: jax.Array, wanted: jax.Array | None = None) -> Crossed:
    """`crossed` [n] of the segments from ``a`` [3] to each of ``b`` [n, 3], in the way that suits the device.

    Those not ``wanted`` [n] need not be followed: what comes out of them means nothing.
    """
    return _in_blocks(site, a, b, wanted) if on_processor() else by_threads(site, a, b, wanted)


def _in_blocks(site: Site, a: jax.Array, b: jax.Array, wanted: jax.Array | None = None) -> Crossed:
    """In blocks of neighbouring ends; clusters of boxes that none of a block's segments comes near are left out.

    Of the boxes of a cluster, those that a segment meets are taken one after another, for all segments of the block at
    once: few segments meet more than one or two.
    """
    n, above, clusters = b.shape[0], above_of(site), _clusters(site.obstacles)
    every = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), clusters)
    firsts = jnp.arange(0, every.wall_m.shape[0], CLUSTER)
    size = min(NEIGHBOURS, n)
    ends = jnp.pad(b, [(0, -n % size), (0, 0)], mode="edge").reshape(-1, size, 3)
    nothing = jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), _nothing_found(len(site.material_names)))

    def block(ends: jax.Array) -> Way:
        near = jax.lax.map(lambda boxes: jnp.any(_near(boxes, a, ends)), clusters)
        direction = ends - a
        distance = _length(direction)

        def add(found: _Found, cluster: tuple[Obstacles, jax.Array, jax.Array]) -> tuple[_Found, None]:
            def met(found: _Found) -> _Found:
                return _met(site, cluster[0], cluster[2], a, direction, distance, found)

            return jax.lax.cond(cluster[1], met, lambda found: found, found), None

        def some() -> _Found:
            return jax.lax.scan(add, nothing, (clusters, near, firsts))[0]

        found = jax.lax.cond(jnp.any(near), some, lambda: nothing)
        return jax.vmap(lambda end, own: _way(site, above, a, end, lambda *_: own))(ends, found)

    if wanted is None:
        ways = jax.lax.map(block, ends)
    else:
        parts = jnp.pad(wanted, (0, -n % size)).reshape(-1, size)
        unseen = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(block, ends[0]))
        ways = jax.lax.map(
            lambda x: jax.lax.cond(jnp.any(x[1]), block, lambda _: unseen, x[0]), (ends, parts)
        )  # fmt: skip
    ways = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:n], ways)
    return shaped(every, walls_of_materials(site), jnp.broadcast_to(a, b.shape), b, ways, PAIRS)


def _met(
    site: Site,
    boxes: Obstacles,
    first: jax.Array,
    a: jax.Array,
    direction: jax.Array,
    distance: jax.Array,
    found: "_Found",
) -> "_Found":
    """``found`` [n] with what n segments from ``a`` [3] cross of boxes, the numbers of which begin with ``first``."""
    numbers = jnp.arange(boxes.wall_m.shape[0], dtype=jnp.int32)

    def more(carry: tuple[jax.Array, _Found]) -> jax.Array:
        return jnp.any(carry[0])

    def next_(carry: tuple[jax.Array, _Found]) -> tuple[jax.Array, _Found]:
        meets, found = carry
        number = jnp.argmax(meets, axis=1).astype(jnp.int32)

        def one(number: jax.Array, meets: jax.Array, direction: jax.Array, distance: jax.Array) -> _Found:
            box = jax.tree.map(lambda x: x[number][None], boxes)
            return _of_box(site, box, first + number, a, direction, distance, meets)

        own = jax.vmap(one)(number, jnp.any(meets, axis=1), direction, distance)
        return meets & (numbers != number[:, None]), _together(found, own)

    meets = jax.vmap(lambda d: _meets(boxes, a, d))(direction)
    return jax.lax.while_loop(more, next_, (meets, found))[1]


def _of_box(
    site: Site,
    box: Obstacles,
    number: jax.Array,
    a: jax.Array,
    direction: jax.Array,
    distance: jax.Array,
    meets: jax.Array | bool = True,
) -> "_Found":
    """What a segment crosses of one ``box`` [1]; nothing unless it ``meets`` it."""
    lengths = [jnp.where(meets, x, 0.0) for x in _of_boxes(box, a, direction, distance)]
    own = box.material == jnp.arange(len(site.material_names), dtype=jnp.int32)
    of_metre = jnp.sum(jnp.where(own, walls_of_materials(site), 0.0))
    met = replace(nothing_met(), first=key_of(jax.lax.stop_gradient(distance * lengths[2][0] * of_metre), number))
    share, moment, thin = (jnp.where(own, x, 0.0) for x in lengths)
    return _Found(share=share, moment=moment, thin=thin, met=met)


def _meets(boxes: Obstacles, a: jax.Array, direction: jax.Array) -> jax.Array:
    """Whether a segment meets each box [K]: those that `_of_boxes` finds something of."""
    start, along = in_axes(boxes, a - boxes.centre_m), in_axes(boxes, direction)
    first, last = part_inside(*slabs(start, along), [boxes.half_extent_m[:, k] for k in range(3)])
    # what is no number stays so
    return ~(last <= first)


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
    start, along = in_axes(boxes, -offset), in_axes(boxes, direction)
    enter, leave = part_inside(*slabs(start, along), [larger[:, k] for k in range(3)])
    # an end that is no number (padding may hold anything) must not hide a box from its neighbours
    return ~(leave < enter) & (radius > 0.0)


def by_threads(
    site: Site, a: jax.Array, b: jax.Array, wanted: jax.Array | None = None, platform: str | None = None
) -> Crossed:
    """`crossed_from` with a thread for each segment, which goes through the boxes and over the terrain by itself.

    ``platform`` is that of `swarmsim.scalars.over_vehicles`.
    """
    above = above_of(site)
    of_metre = walls_of_materials(site)
    needed = (site.obstacles, of_metre, site.terrain_m, site.origin_m, site.cell_m, site.ground_material)
    nothing, shapes = np.zeros(1, np.float32), above.shapes
    bare = jax.tree.map(lambda _: nothing, site)

    def one(
        end: jax.Array, followed: jax.Array, start: jax.Array, needed: Any, heights: tuple[jax.Array, jax.Array]
    ) -> Way:
        solid, metre, terrain, origin, cell, ground = needed
        here = replace(
            bare, obstacles=solid, wall_kg_m3=metre, terrain_m=terrain, origin_m=origin, cell_m=cell,
            ground_material=ground,
        )  # fmt: skip
        ceiling = Ceilings(highest_m=heights[0], around_m=heights[1], shapes=shapes)
        # without an end that a segment has of its own the loop has a derivative of every kind
        boxes = _box_after_box if wanted is None else partial(_box_after_box, followed=followed)
        return _way(here, ceiling, start, end, boxes)

    starts = jnp.broadcast_to(a, b.shape)
    followed = jnp.ones(b.shape[0], bool) if wanted is None else wanted
    ways: Way = over_vehicles(one, (0, 0, 0, None, None), platform=platform)(
        b, followed, starts, needed, (above.highest_m, above.around_m)
    )
    return shaped(site.obstacles, of_metre, starts, b, ways, PAIRS_OF_MANY)


@pytree
class _Found:
    """What a segment crosses of the boxes of each material [M]; lengths over the segment's."""

    share: jax.Array
    moment: jax.Array  # integral of the place over the part inside
    thin: jax.Array  # the shortest way through each box's matter
    met: Most


def _nothing_found(materials: int) -> _Found:
    zero = jnp.zeros(materials)
    return _Found(share=zero, moment=zero, thin=zero, met=nothing_met())


def _together(one: _Found, other: _Found) -> _Found:
    return _Found(
        share=one.share + other.share, moment=one.moment + other.moment, thin=one.thin + other.thin,
        met=of_both(one.met, other.met),
    )  # fmt: skip


Boxes = Callable[[Site, jax.Array, jax.Array, jax.Array], _Found]
"""What a segment meets [M]; it starts at a place [3], and is given as a vector [3] and that vector's length []."""


def _all_boxes(site: Site, a: jax.Array, direction: jax.Array, distance: jax.Array) -> _Found:
    materials = jnp.arange(len(site.material_names), dtype=jnp.int32)
    one_hot = (site.obstacles.material[:, None] == materials).astype(jnp.float32)
    share, moment, thin = _of_boxes(site.obstacles, a, direction, distance)
    # Matrix product: a masked sum would dominate the cost.
    stacked = jnp.stack([share, jax.lax.stop_gradient(moment), thin])
    sums = jnp.dot(stacked, one_hot, precision=jax.lax.Precision.HIGHEST)
    of_metre = jnp.take(walls_of_materials(site), site.obstacles.material, mode="clip")
    return _Found(
        share=sums[0], moment=sums[1], thin=sums[2], met=most_of(jax.lax.stop_gradient(distance * thin * of_metre))
    )


def _box_after_box(
    site: Site, a: jax.Array, direction: jax.Array, distance: jax.Array, followed: jax.Array | None = None
) -> _Found:
    """What a segment meets; nothing if it is not ``followed`` [], which costs nothing if no neighbour is."""
    boxes, materials = site.obstacles, jnp.arange(len(site.material_names), dtype=jnp.int32)

    def add(k: jax.Array, found: _Found) -> _Found:
        box = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, k, 1), boxes)
        return _together(found, _of_box(site, box, jnp.asarray(k, jnp.int32), a, direction, distance))

    number = boxes.wall_m.shape[0]
    last = number if followed is None else jnp.where(followed, number, 0)
    return jax.lax.fori_loop(0, last, add, _nothing_found(materials.shape[0]))


def _of_boxes(
    obstacles: Obstacles, a: jax.Array, direction: jax.Array, distance: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The first three of `matter` of each box [K]. Written per component: the boxes are the vectorised axis."""
    start, along = in_axes(obstacles, a - obstacles.centre_m), in_axes(obstacles, direction)
    half = [obstacles.half_extent_m[:, k] for k in range(3)]
    return matter(start, along, half, obstacles.wall_m, distance)[:3]


__all__ = [
    "Crossed", "Shape", "above_of", "by_threads", "crossed", "crossed_from", "mirrored",
    "path_lengths", "stretched", "wide",
]  # fmt: skip
