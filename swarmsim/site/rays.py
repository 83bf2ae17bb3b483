"""How much of each material lies between two points."""

import jax
import jax.numpy as jnp

from swarmsim.site.model import Obstacles, Site, sample

GROUND_SAMPLES = 48  # points along a ray at which it is compared with the terrain
_PARALLEL = 1e-9  # a direction component below this, in metres over the whole segment, is parallel to the slab
_FAR = 1e6  # stands for an unbounded interval in units of the segment; finite, so that no inf - inf arises


def path_lengths(site: Site, a: jax.Array, b: jax.Array) -> jax.Array:
    """Metres [M] of the straight segment from ``a`` [3] to ``b`` [3] (ENU, m) in each of ``site.material_names``.

    Boxes are intersected exactly (slab method, Kay and Kajiya, SIGGRAPH 1986); a hollow box counts its shell alone. The
    ground is what lies below the terrain, followed linearly between `GROUND_SAMPLES` points, so that the length is
    continuous in both ends and differentiable almost everywhere. Where things overlap, their lengths are scaled so that
    the sum never exceeds the distance. The rest of the distance goes to ``air`` if the table has it, and then the sum
    equals the distance.
    """
    direction = b - a
    squared = jnp.sum(direction * direction)
    distance = jnp.where(squared > 0.0, jnp.sqrt(jnp.where(squared > 0.0, squared, 1.0)), 0.0)
    materials = jnp.arange(len(site.material_names), dtype=jnp.int32)
    in_boxes = _box_fractions(site.obstacles, a, direction)
    one_hot = site.obstacles.material[:, None] == materials
    fractions = jnp.sum(jnp.where(one_hot, in_boxes[:, None], 0.0), axis=0)
    fractions = fractions + jnp.where(materials == site.ground_material, _ground_fraction(site, a, direction), 0.0)
    total = jnp.sum(fractions)
    fractions = fractions / jnp.maximum(total, 1.0)
    if "air" in site.material_names:
        rest = jnp.maximum(1.0 - total, 0.0)
        fractions = fractions + jnp.where(materials == site.material_names.index("air"), rest, 0.0)
    return distance * fractions


def _box_fractions(obstacles: Obstacles, a: jax.Array, direction: jax.Array) -> jax.Array:
    """Fraction [K] of the segment within the matter of each box."""
    offset = a - obstacles.centre_m
    c, s = obstacles.axis[:, 0], obstacles.axis[:, 1]
    start = jnp.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2]], -1)
    along = jnp.stack(
        [c * direction[0] + s * direction[1], c * direction[1] - s * direction[0], jnp.full_like(c, direction[2])], -1
    )
    outer = obstacles.half_extent_m
    inner = outer - obstacles.wall_m[:, None]
    hollow = (obstacles.wall_m > 0.0) & jnp.all(inner > 0.0, axis=-1)
    empty = jnp.where(hollow, _slab_fraction(start, along, inner), 0.0)
    return _slab_fraction(start, along, outer) - empty


def _slab_fraction(start: jax.Array, along: jax.Array, half: jax.Array) -> jax.Array:
    """Fraction [K] of the segments start + t along, 0 <= t <= 1 [K, 3], within the boxes |x| <= half [K, 3]."""
    parallel = jnp.abs(along) < _PARALLEL
    inverse = 1.0 / jnp.where(parallel, 1.0, along)
    middle = -start * inverse
    reach = half * jnp.abs(inverse)
    within = jnp.where(jnp.abs(start) <= half, _FAR, -_FAR)
    enter = jnp.where(parallel, -within, middle - reach)
    leave = jnp.where(parallel, within, middle + reach)
    first = jnp.maximum(jnp.max(enter, axis=-1), 0.0)
    last = jnp.minimum(jnp.min(leave, axis=-1), 1.0)
    return jnp.maximum(last - first, 0.0)


def _ground_fraction(site: Site, a: jax.Array, direction: jax.Array) -> jax.Array:
    """Fraction [] of the segment below the terrain."""
    points = a + jnp.linspace(0.0, 1.0, GROUND_SAMPLES)[:, None] * direction
    depth = sample(site.terrain_m, site, points[:, :2]) - points[:, 2]
    below = jnp.maximum(depth, 0.0)
    # Between two samples the depth is linear: the part below is g+ / (g+ + g-), or all, or nothing.
    span = jnp.abs(depth[:-1]) + jnp.abs(depth[1:])
    part = jnp.where(span > 0.0, (below[:-1] + below[1:]) / jnp.where(span > 0.0, span, 1.0), 0.0)
    return jnp.sum(part) / (GROUND_SAMPLES - 1)
