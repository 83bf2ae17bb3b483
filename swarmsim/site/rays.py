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
from swarmsim.site.terrain_crossing import Ceilings, ceilings, share_below

NEIGHBOURS = 16  # segments that are intersected with the same clusters of boxes
CLUSTER = 16  # boxes, a multiple of the SIMD width; the last cluster is filled up with empty ones
_TOUCH_M = 1e-3  # boxes so near to a segment count as met, for rounding
_PARALLEL = 1e-9  # m over the whole segment; a smaller direction component is parallel to the slab


@pytree
class Shape:
    """What decides how much of the photons that scatter in walls arrives: see `swarmsim.radiation.scattering`."""

    thin_m: jax.Array  # [..., M] length the shortest way through each piece of matter that is crossed; <= length_m
    spread: jax.Array  # [...] 0..1: part of an infinite wall's scattered photons that come from a wall of its size
    closed: jax.Array  # [...] 0..1: whether the segment leads out of a hollow box, whose other walls scatter too
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
    zero, row = jnp.zeros((n, materials)), jnp.zeros(n)
    return Crossed(
        length_m=zero, place=zero, shape=Shape(thin_m=zero, spread=row, closed=row, ground=jnp.zeros((n, 2)))
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
    derivatives. Where obstacles overlap, the lengths are scaled so that their sum does not exceed the distance. The
    remaining distance is that through ``air`` if the table has it, and then the sum equals the distance.
    """
    return _crossed(site, above_of(site), a, b)


def above_of(site: Site) -> Ceilings:
    """The site's `Ceilings`, made here for a site that has none."""
    return ceilings(site.terrain_m) if site.above is None else site.above


def _crossed(site: Site, above: Ceilings, a: jax.Array, b: jax.Array, boxes: "Boxes | None" = None) -> Crossed:
    direction = b - a
    distance = _length(direction)
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
    spread, closed = 1.0 - jnp.sum(found.narrow) / walls, jnp.sum(found.closed) / walls
    place, spread, closed = jax.lax.stop_gradient((jnp.clip(place, 0.0, 1.0), spread, closed))
    shape = Shape(thin_m=distance * thin, spread=spread, closed=closed, ground=mirrored(site, a, b))
    return Crossed(length_m=distance * fractions, place=place, shape=shape)


def _length(vector: jax.Array) -> jax.Array:
    """Length [...] of vectors [..., 3]; that of zero has no derivative, not one that is no number."""
    squared = jnp.sum(vector * vector, axis=-1)
    return jnp.where(squared > 0.0, jnp.sqrt(jnp.where(squared > 0.0, squared, 1.0)), 0.0)


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

    Of the boxes of a cluster, those that a segment meets are taken one after another, for all segments of the block at
    once: few segments meet more than one or two.
    """
    n, above, clusters = b.shape[0], above_of(site), _clusters(site.obstacles)
    size = min(NEIGHBOURS, n)
    ends = jnp.pad(b, [(0, -n % size), (0, 0)], mode="edge").reshape(-1, size, 3)
    row, one = jnp.zeros((size, len(site.material_names))), jnp.zeros(size)
    nothing = _Found(share=row, moment=row, thin=row, narrow=one, closed=one)

    def block(ends: jax.Array) -> Crossed:
        near = jax.lax.map(lambda boxes: jnp.any(_near(boxes, a, ends)), clusters)
        direction = ends - a
        distance = _length(direction)

        def add(found: _Found, cluster: tuple[Obstacles, jax.Array]) -> tuple[_Found, None]:
            def met(found: _Found) -> _Found:
                return _met(site, cluster[0], a, direction, distance, found)

            return jax.lax.cond(cluster[1], met, lambda found: found, found), None

        def some() -> _Found:
            return jax.lax.scan(add, nothing, (clusters, near))[0]

        found = jax.lax.cond(jnp.any(near), some, lambda: nothing)
        return jax.vmap(lambda end, own: _crossed(site, above, a, end, lambda *_: own))(ends, found)

    found = jax.lax.map(block, ends)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:n], found)


def _met(
    site: Site, boxes: Obstacles, a: jax.Array, direction: jax.Array, distance: jax.Array, found: "_Found"
) -> "_Found":
    """``found`` [n] with what n segments from ``a`` [3] cross of some boxes."""
    materials, numbers = jnp.arange(len(site.material_names), dtype=jnp.int32), jnp.arange(boxes.wall_m.shape[0])

    def more(carry: tuple[jax.Array, _Found]) -> jax.Array:
        return jnp.any(carry[0])

    def next_(carry: tuple[jax.Array, _Found]) -> tuple[jax.Array, _Found]:
        meets, found = carry
        number = jnp.argmax(meets, axis=1)

        def one(number: jax.Array, meets: jax.Array, direction: jax.Array, distance: jax.Array) -> _Found:
            box = jax.tree.map(lambda x: x[number][None], boxes)
            own = jax.tree.map(lambda x: jnp.where(meets, x[0], 0.0), _of_boxes(box, a, direction, distance))
            return _by_material(own, box.material[0] == materials)

        own = jax.vmap(one)(number, jnp.any(meets, axis=1), direction, distance)
        return meets & (numbers != number[:, None]), jax.tree.map(jnp.add, found, own)

    meets = jax.vmap(lambda d: _meets(boxes, a, d))(direction)
    return jax.lax.while_loop(more, next_, (meets, found))[1]


def _by_material(found: "_Found", material: jax.Array) -> "_Found":
    """What was found of one box [], or of each [1], by ``material`` [M]: whether it is the box's."""
    share, moment, thin = (jnp.where(material, x, 0.0) for x in (found.share, found.moment, found.thin))
    return _Found(share=share, moment=moment, thin=thin, narrow=found.narrow, closed=found.closed)


def _meets(boxes: Obstacles, a: jax.Array, direction: jax.Array) -> jax.Array:
    """Whether a segment meets each box [K]: those that `_of_boxes` finds something of."""
    middle, reach = _slabs(boxes, a, direction)
    (enter, leave), _ = _slab_fraction(middle, reach, [boxes.half_extent_m[:, k] for k in range(3)])
    # what is no number stays so
    return ~(jnp.minimum(_least(leave), 1.0) <= jnp.maximum(_most(enter), 0.0))


def _slabs(boxes: Obstacles, a: jax.Array, direction: jax.Array) -> tuple[list[jax.Array], list[jax.Array]]:
    """Where [K] a line from ``a`` crosses the middle planes of boxes, and how much of it a metre across them takes."""
    start, along = _in_axes(boxes, a - boxes.centre_m), _in_axes(boxes, direction)
    # Clamp a component that is too small to divide by: the slab then extends far beyond the segment.
    inverse = [1.0 / jnp.where(jnp.abs(d) < _PARALLEL, _PARALLEL, d) for d in along]
    return [-x * i for x, i in zip(start, inverse, strict=True)], [jnp.abs(i) for i in inverse]


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
    inverse = [1.0 / jnp.where(jnp.abs(d) < _PARALLEL, _PARALLEL, d) for d in along]
    reach = [jnp.abs(i) * larger[:, k] for k, i in enumerate(inverse)]
    middles = [-x * i for x, i in zip(start, inverse, strict=True)]
    enter = jnp.maximum(_most([m - r for m, r in zip(middles, reach, strict=True)]), 0.0)
    leave = jnp.minimum(_least([m + r for m, r in zip(middles, reach, strict=True)]), 1.0)
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

    def one(end: jax.Array, start: jax.Array, needed: Any, heights: tuple[jax.Array, jax.Array]) -> Crossed:
        boxes, terrain, origin, cell, ground = needed
        here = replace(bare, obstacles=boxes, terrain_m=terrain, origin_m=origin, cell_m=cell, ground_material=ground)
        ceiling = Ceilings(highest_m=heights[0], around_m=heights[1], shapes=shapes)
        return _crossed(here, ceiling, start, end, _box_after_box)

    starts = jnp.broadcast_to(a, b.shape)
    found: Crossed = over_vehicles(one, (0, 0, None, None), platform=platform)(
        b, starts, needed, (above.highest_m, above.around_m)
    )
    return found


@pytree
class _Found:
    """What a segment crosses of each box [K], or of the boxes of each material [M]; lengths over the segment's."""

    share: jax.Array
    moment: jax.Array  # integral of the place over the part inside
    thin: jax.Array  # the shortest way through the box's matter
    narrow: jax.Array  # that, times the missing part of an infinite wall
    closed: jax.Array  # that, for a box that one end of the segment lies in


Boxes = Callable[[Site, jax.Array, jax.Array, jax.Array], _Found]
"""What a segment meets [M]; it starts at a place [3], and is given as a vector [3] and that vector's length []."""


def _all_boxes(site: Site, a: jax.Array, direction: jax.Array, distance: jax.Array) -> _Found:
    materials = jnp.arange(len(site.material_names), dtype=jnp.int32)
    one_hot = (site.obstacles.material[:, None] == materials).astype(jnp.float32)
    # Matrix product: a masked sum would dominate the cost.
    found = _of_boxes(site.obstacles, a, direction, distance)
    stacked = jnp.stack([found.share, jax.lax.stop_gradient(found.moment), found.thin])
    share, moment, thin = jnp.dot(stacked, one_hot, precision=jax.lax.Precision.HIGHEST)
    return _Found(share=share, moment=moment, thin=thin, narrow=found.narrow, closed=found.closed)


def _box_after_box(site: Site, a: jax.Array, direction: jax.Array, distance: jax.Array) -> _Found:
    boxes, materials = site.obstacles, jnp.arange(len(site.material_names), dtype=jnp.int32)

    def add(k: jax.Array, found: _Found) -> _Found:
        box = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, k, 1), boxes)
        own = _by_material(_of_boxes(box, a, direction, distance), box.material == materials)
        return jax.tree.map(jnp.add, found, own)

    zero, one = jnp.zeros(materials.shape), jnp.zeros(1)
    nothing = _Found(share=zero, moment=zero, thin=zero, narrow=one, closed=one)
    return jax.lax.fori_loop(0, boxes.wall_m.shape[0], add, nothing)


def _of_boxes(obstacles: Obstacles, a: jax.Array, direction: jax.Array, distance: jax.Array) -> _Found:
    """What the segment crosses of each box [K]. Written per component, so that the boxes are the vectorised axis."""
    start, along = _in_axes(obstacles, a - obstacles.centre_m), _in_axes(obstacles, direction)
    middle, reach = _slabs(obstacles, a, direction)
    outer = [obstacles.half_extent_m[:, k] for k in range(3)]
    inner = [half - obstacles.wall_m for half in outer]
    hollow = (obstacles.wall_m > 0.0) & (_least(inner) > 0.0)
    (enter, leave), (whole, of_whole) = _slab_fraction(middle, reach, outer)
    _, (empty, of_empty) = _slab_fraction(middle, reach, inner)
    share = whole - jnp.where(hollow, empty, 0.0)
    moment = of_whole - jnp.where(hollow, of_empty, 0.0)
    first, last = _most(enter), _least(leave)
    within = (first < 0.0) != (last > 1.0)
    shortest = jnp.where(hollow, jnp.where(within, 1.0, 2.0) * obstacles.wall_m, 2.0 * _least(outer))
    thin = jnp.minimum(share, shortest / jnp.maximum(distance, 1e-9))
    # The face that the segment leaves the box by, or enters it by if it ends inside, and how far its edges are
    at = jnp.where(last < 1.0, last, first)
    faces = [jnp.where(last < 1.0, leave[k], enter[k]) == at for k in (0, 1)]
    place = [x + at * d for x, d in zip(start, along, strict=True)]
    (one, other), (wide, high) = (
        (jnp.where(faces[0], x[1], x[0]), jnp.where(faces[0] | faces[1], x[2], x[1])) for x in (place, outer)
    )
    per_share = 1.0 / jnp.maximum(share, 1e-9)
    mean = moment * per_share
    scale = jnp.square(distance * thin * per_share * mean * (1.0 - mean)) + 1e-12
    missing = 1.0 - _seen(one, wide, scale) * _seen(other, high, scale)
    closed = jnp.where(hollow & within, thin, 0.0)
    return _Found(share=share, moment=moment, thin=thin, narrow=thin * missing, closed=closed)


def _seen(place: jax.Array, half: jax.Array, scale2: jax.Array) -> jax.Array:
    """Part [K] of an infinite wall's scattered photons from a strip of it, -/+ ``half`` wide, around ``place``."""
    ahead, behind = half - place, half + place
    return 0.5 * (ahead * jax.lax.rsqrt(ahead * ahead + scale2) + behind * jax.lax.rsqrt(behind * behind + scale2))


def _most(x: list[jax.Array]) -> jax.Array:
    return jnp.maximum(jnp.maximum(x[0], x[1]), x[2])


def _least(x: list[jax.Array]) -> jax.Array:
    return jnp.minimum(jnp.minimum(x[0], x[1]), x[2])


def _slab_fraction(
    middle: list[jax.Array], reach: list[jax.Array], half: list[jax.Array]
) -> tuple[tuple[list[jax.Array], list[jax.Array]], tuple[jax.Array, jax.Array]]:
    """Where lines enter and leave slabs at middle -/+ reach half; the share [K] of 0 <= t <= 1 in all, its moment."""
    enter = [m - r * h for m, r, h in zip(middle, reach, half, strict=True)]
    leave = [m + r * h for m, r, h in zip(middle, reach, half, strict=True)]
    first, last = jnp.maximum(_most(enter), 0.0), jnp.minimum(_least(leave), 1.0)
    share = jnp.maximum(last - first, 0.0)
    return (enter, leave), (share, share * 0.5 * (jnp.minimum(first, 1.0) + jnp.maximum(last, 0.0)))
