"""Path length through each material along a line segment."""

import jax
import jax.numpy as jnp

from swarmsim.site.model import Obstacles, Site, sample

GROUND_SAMPLES = 48  # points along a segment at which its height is compared with the terrain's
_PARALLEL = 1e-9  # m over the whole segment; a smaller direction component is parallel to the slab


def path_lengths(site: Site, a: jax.Array, b: jax.Array, soil: jax.Array | None = None) -> jax.Array:
    """Metres [M] of the straight segment from ``a`` [3] to ``b`` [3] (ENU, m) in each of ``site.material_names``.

    Boxes are intersected exactly (slab method, Kay and Kajiya, SIGGRAPH 1986); of a hollow box, only the shell counts.
    The length below the terrain is integrated with linear interpolation between `GROUND_SAMPLES` points, so that it is
    continuous in both ends and differentiable almost everywhere. Where obstacles overlap, the lengths are scaled so
    that their sum does not exceed the distance. The remaining distance is that through ``air`` if the table has it, and
    then the sum equals the distance. ``soil`` [] is the fraction below the terrain (`ground_fraction`) if it is known.
    """
    direction = b - a
    squared = jnp.sum(direction * direction)
    distance = jnp.where(squared > 0.0, jnp.sqrt(jnp.where(squared > 0.0, squared, 1.0)), 0.0)
    materials = jnp.arange(len(site.material_names), dtype=jnp.int32)
    one_hot = (site.obstacles.material[:, None] == materials).astype(jnp.float32)
    # Matrix product: a masked sum would dominate the cost.
    boxes = _box_fractions(site.obstacles, a, direction)
    fractions = jnp.dot(boxes, one_hot, precision=jax.lax.Precision.HIGHEST)
    soil = ground_fraction(site, a, direction) if soil is None else soil
    fractions = fractions + jnp.where(materials == site.ground_material, soil, 0.0)
    total = jnp.sum(fractions)
    fractions = fractions / jnp.maximum(total, 1.0)
    if "air" in site.material_names:
        rest = jnp.maximum(1.0 - total, 0.0)
        fractions = fractions + jnp.where(materials == site.material_names.index("air"), rest, 0.0)
    return distance * fractions


def _box_fractions(obstacles: Obstacles, a: jax.Array, direction: jax.Array) -> jax.Array:
    """Fraction [K] of the segment inside the material of each box.

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
    empty = jnp.where(hollow, _slab_fraction(middle, reach, inner), 0.0)
    return _slab_fraction(middle, reach, outer) - empty


def _slab_fraction(middle: list[jax.Array], reach: list[jax.Array], half: list[jax.Array]) -> jax.Array:
    """Fraction [K] of the segments 0 <= t <= 1 inside boxes with slabs at middle -/+ reach half."""
    enter = [m - r * h for m, r, h in zip(middle, reach, half, strict=True)]
    leave = [m + r * h for m, r, h in zip(middle, reach, half, strict=True)]
    first = jnp.maximum(jnp.maximum(jnp.maximum(enter[0], enter[1]), enter[2]), 0.0)
    last = jnp.minimum(jnp.minimum(jnp.minimum(leave[0], leave[1]), leave[2]), 1.0)
    return jnp.maximum(last - first, 0.0)


def ground_fraction(site: Site, a: jax.Array, direction: jax.Array) -> jax.Array:
    """Fraction [] of the segment from ``a`` [3] along ``direction`` [3] (its whole length, m) below the terrain."""
    points = a + jnp.linspace(0.0, 1.0, GROUND_SAMPLES)[:, None] * direction
    depth = sample(site.terrain_m, site, points[:, :2]) - points[:, 2]
    below = jnp.maximum(depth, 0.0)
    # The depth is linear between two samples: the share below is g+ / (g+ + g-), all, or none.
    span = jnp.abs(depth[:-1]) + jnp.abs(depth[1:])
    part = jnp.where(span > 0.0, (below[:-1] + below[1:]) / jnp.where(span > 0.0, span, 1.0), 0.0)
    return jnp.sum(part) / (GROUND_SAMPLES - 1)
