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
from swarmsim.site.model import Obstacles, Site
from swarmsim.site.terrain_crossing import Ceilings, ceilings, share_below

BLOCK = 1024  # segments intersected with all boxes at a time, so that the result fits the cache
VECTOR = 8  # boxes are padded to a multiple of this SIMD width, with empty boxes
_PARALLEL = 1e-9  # m over the whole segment; a smaller direction component is parallel to the slab


@pytree
class Crossed:
    """Materials along a segment, in the order of ``Site.material_names``."""

    length_m: jax.Array  # [..., M]
    place: jax.Array  # [..., M] mean place of the material along the segment, 0 at its start and 1 at its end


def path_lengths(site: Site, a: jax.Array, b: jax.Array) -> jax.Array:
    """Metres [M] of the straight segment from ``a`` [3] to ``b`` [3] (ENU, m) in each of ``site.material_names``.

    See `crossed`.
    """
    return crossed(site, a, b).length_m


def crossed(site: Site, a: jax.Array, b: jax.Array) -> Crossed:
    """The materials on the straight segment from ``a`` [3] to ``b`` [3] (ENU, m).

    Boxes are intersected exactly (slab method, Kay and Kajiya, SIGGRAPH 1986); of a hollow box, only the shell counts.
    The terrain is crossed exactly too (`swarmsim.site.terrain_crossing`). Lengths are continuous in both ends and
    differentiable almost everywhere; places are taken as constant by derivatives. Where obstacles overlap, the lengths
    are scaled so that their sum does not exceed the distance. The remaining distance is that through ``air`` if the
    table has it, and then the sum equals the distance.
    """
    return _crossed(site, above_of(site), a, b)


def above_of(site: Site) -> Ceilings:
    """The site's `Ceilings`, made here for a site that has none."""
    return ceilings(site.terrain_m) if site.above is None else site.above


def _crossed(site: Site, above: Ceilings, a: jax.Array, b: jax.Array, boxes: "Boxes | None" = None) -> Crossed:
    direction = b - a
    squared = jnp.sum(direction * direction)
    distance = jnp.where(squared > 0.0, jnp.sqrt(jnp.where(squared > 0.0, squared, 1.0)), 0.0)
    materials = jnp.arange(len(site.material_names), dtype=jnp.int32)
    fractions, moments = (boxes or _all_boxes)(site, a, direction)
    # A function with its own derivative takes no arrays of the host, as the values of a world are: add nothing to them.
    soil, soil_place = share_below(site, above, jnp.add(a, 0.0), jnp.add(b, 0.0))
    ground = materials == site.ground_material
    fractions = fractions + jnp.where(ground, soil, 0.0)
    moments = moments + jnp.where(ground, jax.lax.stop_gradient(soil * soil_place), 0.0)
    place = jnp.where(fractions > 1e-9, moments / jnp.maximum(fractions, 1e-9), 0.5)
    total = jnp.sum(fractions)
    fractions = fractions / jnp.maximum(total, 1.0)
    if "air" in site.material_names:
        rest = jnp.maximum(1.0 - total, 0.0)
        fractions = fractions + jnp.where(materials == site.material_names.index("air"), rest, 0.0)
    return Crossed(length_m=distance * fractions, place=jax.lax.stop_gradient(jnp.clip(place, 0.0, 1.0)))


def crossed_from(site: Site, a: jax.Array, b: jax.Array) -> Crossed:
    """`crossed` [n] of the segments from ``a`` [3] to each of ``b`` [n, 3], in the way that suits the device."""
    return _in_blocks(site, a, b) if on_processor() else by_threads(site, a, b)


def _in_blocks(site: Site, a: jax.Array, b: jax.Array) -> Crossed:
    """In blocks that fit the cache, the boxes as the vectorised axis."""
    n, above = b.shape[0], above_of(site)
    rows = -site.obstacles.wall_m.shape[0] % VECTOR
    boxes = jax.tree.map(lambda x: jnp.pad(x, [(0, rows)] + [(0, 0)] * (x.ndim - 1)), site.obstacles)
    padded = replace(site, obstacles=boxes)
    size = min(BLOCK, n)
    ends = jnp.pad(b, [(0, -n % size), (0, 0)], mode="edge").reshape(-1, size, 3)
    found = jax.lax.map(jax.vmap(lambda end: _crossed(padded, above, a, end)), ends)
    return jax.tree.map(lambda x: x.reshape(-1, x.shape[-1])[:n], found)


def by_threads(site: Site, a: jax.Array, b: jax.Array, platform: str | None = None) -> Crossed:
    """`crossed_from` with a thread for each segment, which goes through the boxes and over the terrain by itself.

    ``platform`` is that of `swarmsim.scalars.over_vehicles`.
    """
    above = above_of(site)
    needed = (site.obstacles, site.terrain_m, site.origin_m, site.cell_m, site.ground_material)
    nothing, shapes = np.zeros(1, np.float32), above.shapes
    bare = jax.tree.map(lambda _: nothing, site)

    def one(end: jax.Array, start: jax.Array, needed: Any, highest: jax.Array) -> Crossed:
        boxes, terrain, origin, cell, ground = needed
        here = replace(bare, obstacles=boxes, terrain_m=terrain, origin_m=origin, cell_m=cell, ground_material=ground)
        return _crossed(here, Ceilings(highest_m=highest, shapes=shapes), start, end, _box_after_box)

    starts = jnp.broadcast_to(a, b.shape)
    found: Crossed = over_vehicles(one, (0, 0, None, None), platform=platform)(b, starts, needed, above.highest_m)
    return found


Boxes = Callable[[Site, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""Fractions [M] of a segment in the boxes of each material, and the integrals [M] of the place over them."""


def _all_boxes(site: Site, a: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
    materials = jnp.arange(len(site.material_names), dtype=jnp.int32)
    one_hot = (site.obstacles.material[:, None] == materials).astype(jnp.float32)
    # Matrix product: a masked sum would dominate the cost.
    share, moment = _box_fractions(site.obstacles, a, direction)
    stacked = jnp.stack([share, jax.lax.stop_gradient(moment)])
    fractions, moments = jnp.dot(stacked, one_hot, precision=jax.lax.Precision.HIGHEST)
    return fractions, moments


def _box_after_box(site: Site, a: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
    boxes, materials = site.obstacles, jnp.arange(len(site.material_names), dtype=jnp.int32)

    def add(k: jax.Array, found: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        box = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, k, 1), boxes)
        share, moment = _box_fractions(box, a, direction)
        own = box.material == materials
        return found[0] + jnp.where(own, share, 0.0), found[1] + jnp.where(own, moment, 0.0)

    nothing = jnp.zeros(materials.shape)
    return jax.lax.fori_loop(0, boxes.wall_m.shape[0], add, (nothing, nothing))


def _box_fractions(obstacles: Obstacles, a: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Fraction [K] of the segment inside the material of each box, and the integral [K] of the place over it.

    Written per component, so that the boxes are the vectorised axis.
    """
    offset = a - obstacles.centre_m
    c, s = obstacles.axis[:, 0], obstacles.axis[:, 1]
    start = (c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2])
    along = (
        c * direction[0] + s * direction[1],
        c * direction[1] - s * direction[0],
        jnp.broadcast_to(direction[2], c.shape),
    )
    # Clamp a component that is too small to divide by: the slab then extends far beyond the segment.
    inverse = [1.0 / jnp.where(jnp.abs(d) < _PARALLEL, _PARALLEL, d) for d in along]
    middle = [-x * i for x, i in zip(start, inverse, strict=True)]
    reach = [jnp.abs(i) for i in inverse]
    outer = [obstacles.half_extent_m[:, k] for k in range(3)]
    inner = [half - obstacles.wall_m for half in outer]
    hollow = (obstacles.wall_m > 0.0) & (jnp.minimum(jnp.minimum(inner[0], inner[1]), inner[2]) > 0.0)
    whole, of_whole = _slab_fraction(middle, reach, outer)
    empty, of_empty = _slab_fraction(middle, reach, inner)
    return whole - jnp.where(hollow, empty, 0.0), of_whole - jnp.where(hollow, of_empty, 0.0)


def _slab_fraction(
    middle: list[jax.Array], reach: list[jax.Array], half: list[jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """Fraction [K] of the segments 0 <= t <= 1 inside boxes with slabs at middle -/+ reach half, and its moment [K]."""
    enter = [m - r * h for m, r, h in zip(middle, reach, half, strict=True)]
    leave = [m + r * h for m, r, h in zip(middle, reach, half, strict=True)]
    first = jnp.maximum(jnp.maximum(jnp.maximum(enter[0], enter[1]), enter[2]), 0.0)
    last = jnp.minimum(jnp.minimum(jnp.minimum(leave[0], leave[1]), leave[2]), 1.0)
    share = jnp.maximum(last - first, 0.0)
    return share, share * 0.5 * (jnp.minimum(first, 1.0) + jnp.maximum(last, 0.0))
