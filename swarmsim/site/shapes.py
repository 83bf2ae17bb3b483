"""What decides how walls scatter photons along a segment: its three boxes with the most matter the short way.

`swarmsim.site.rays` finds them; `shaped` computes what they scatter (`swarmsim.site.wall_network`), for those segments
alone that meet any.
"""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.device import at_most
from swarmsim.pytree import pytree
from swarmsim.site.model import Obstacles, Site
from swarmsim.site.surfaces import Box
from swarmsim.site.wall_network import OUTPUTS, scattered

_UPPER = -(1 << 16)  # mask of a number's upper half
ALIKE = 0.05
"""Weight of a box beside three others of the same matter, over that of a box alone."""


@pytree
class Shape:
    """What decides how much of the photons that scatter in walls arrives: see `swarmsim.radiation.walls`."""

    thin_m: jax.Array  # [..., M] length the shortest way through each piece of matter that is crossed; <= length_m
    scattered: jax.Array  # [..., OUTPUTS] coefficients of photons over those of infinite walls crossed squarely
    closed: jax.Array  # [...] 0..1: whether the segment leads out of a hollow box
    walls: jax.Array  # [...] 1..2: walls of a box that are crossed in turn
    ground: jax.Array  # [..., 2] how the ground shines, see `mirrored`
    low: jax.Array  # [...] 0..1: how near to the ground the lower end of the segment is


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


def wide(thin_m: jax.Array, ground: jax.Array) -> Shape:
    """That of infinite walls crossed squarely: ``thin_m`` [..., M], ``ground`` [..., 2]."""
    one = jnp.ones(thin_m.shape[:-1])
    nothing = jnp.zeros_like(one)
    return Shape(
        thin_m=thin_m, scattered=jnp.zeros((*one.shape, OUTPUTS)), closed=nothing, walls=one, ground=ground, low=nothing
    )


@pytree
class Most:
    """The three boxes with the most matter the short way, for segments [...]: see `key_of`; 0 for none."""

    first: jax.Array  # [...] int32
    second: jax.Array
    third: jax.Array


def key_of(matter: jax.Array, number: jax.Array) -> jax.Array:
    """A number that grows with ``matter`` [...] >= 0 to 1 %, and holds the box's ``number`` in its lower half."""
    bits = jax.lax.bitcast_convert_type(matter, jnp.int32)  # it grows with the value
    return jnp.where(matter > 0.0, (bits & _UPPER) | number, 0)


def walls_of_materials(site: Site) -> jax.Array:
    """What a metre of each material [M] counts among walls: its bulk density, 0 of what is none."""
    return jnp.ones(len(site.material_names)) if site.wall_kg_m3 is None else jnp.asarray(site.wall_kg_m3)


def of_both(one: Most, other: Most) -> Most:
    """The same of the boxes of either."""
    lower, seconds = jnp.minimum(one.first, other.first), jnp.maximum(one.second, other.second)
    rest = jnp.maximum(jnp.minimum(lower, seconds), jnp.minimum(one.second, other.second))
    return Most(
        first=jnp.maximum(one.first, other.first),
        second=jnp.maximum(lower, seconds),
        third=jnp.maximum(rest, jnp.maximum(one.third, other.third)),
    )


def nothing_met() -> Most:
    """Of a segment that meets no box."""
    none = jnp.zeros((), jnp.int32)
    return Most(first=none, second=none, third=none)


@pytree
class Way:
    """What is known of a segment before its `Shape`."""

    crossed: Crossed  # without a shape
    thin_m: jax.Array  # [M]
    ground: jax.Array  # [2]
    low: jax.Array  # []
    boxes: jax.Array  # [] matter the short way in all boxes: metres times `walls_of_materials`
    walls: jax.Array  # [] the same with the ground
    met: Most


def shaped(
    boxes: Obstacles, of_metre: jax.Array, a: jax.Array, b: jax.Array, way: Way, size: int | None = None
) -> Crossed:
    """``way`` [n] from ``a`` [n, 3] to ``b`` [n, 3] with its shape; ``of_metre`` are the `walls_of_materials`.

    With ``size``, so many pairs of a segment and a box at a time: many segments meet none. Else all together.
    """
    a, b, n = jax.lax.stop_gradient(a), jax.lax.stop_gradient(b), b.shape[0]
    keys = jnp.concatenate([way.met.first, way.met.second, way.met.third])

    def of(pair: jax.Array) -> jax.Array:
        """Length the short way, coefficients, closed, and walls less 1 [OUTPUTS + 3, k] of pairs [k]."""
        row = pair % n
        of_photons, around = scattered(_box(boxes, keys[pair], a[row], b[row]))
        return jnp.concatenate([around.thin_m[None], of_photons, around.closed[None], around.walls[None] - 1.0])

    each = (of(jnp.arange(3 * n)) if size is None else _packed(of, keys > 0, size)).reshape(-1, 3, n)
    matter = jnp.where(keys > 0, each[0].reshape(-1) * of_metre[_row(boxes.material, keys)], 0.0).reshape(3, n)
    # What is left may be a box that is about to change places with the third, which then has no weight of its own but
    # this small one, for boxes that are all alike.
    least = jnp.min(matter, axis=0)
    left = jnp.minimum(jnp.maximum(way.boxes - jnp.sum(matter, axis=0), 0.0), least)
    own = matter - left * left / jnp.maximum(matter, 1e-9) + ALIKE * matter
    weight = own * way.boxes / (jnp.maximum(jnp.sum(own, axis=0), 1e-9) * jnp.maximum(way.walls, 1e-9))
    more = [jnp.sum(jnp.where(weight > 0.0, weight * x, 0.0), axis=0) for x in each[1:]]
    shape = Shape(
        thin_m=way.thin_m, scattered=jnp.stack(more[:-2], axis=-1), closed=more[-2], walls=1.0 + more[-1],
        ground=way.ground, low=way.low,
    )  # fmt: skip
    return replace(way.crossed, shape=shape)


def _packed(function: Callable[[jax.Array], jax.Array], wanted: jax.Array, size: int) -> jax.Array:
    """``function`` [k, size] of the ``wanted`` [n] numbers, ``size`` at a time; of the others anything."""
    n, place = wanted.shape[0], jnp.cumsum(wanted.astype(jnp.int32)) - 1
    size = min(size, n)
    rows = jnp.zeros(n + size, jnp.int32).at[jnp.where(wanted, place, n + size)].set(jnp.arange(n), mode="drop")

    def step(number: jax.Array, found: jax.Array) -> jax.Array:
        first = number * size
        own = function(jax.lax.dynamic_slice(rows, (first,), (size,)))
        return jax.lax.dynamic_update_slice(found, own, (jnp.zeros_like(first), first))

    found = jax.lax.fori_loop(0, at_most(-(-(place[-1] + 1) // size)), step, jnp.zeros((OUTPUTS + 3, n + size)))
    return found[:, jnp.maximum(place, 0)]


def _box(boxes: Obstacles, key: jax.Array, a: jax.Array, b: jax.Array) -> Box:
    """The boxes of these keys [n], with segments from ``a`` [n, 3] to ``b`` [n, 3]."""
    own = jax.tree.map(lambda x: _row(x, key), boxes)
    start, end = (in_axes(own, x - own.centre_m) for x in (a, b))
    return Box(start, end, [own.half_extent_m[:, k] for k in range(3)], own.wall_m)


def _row(x: jax.Array, key: jax.Array) -> jax.Array:
    """What ``x`` [K, ...] is of the boxes of these keys [n]."""
    return jnp.take(x, key & ~_UPPER, axis=0, mode="clip")


def most_of(matter: jax.Array) -> Most:
    """Those of boxes with so much ``matter`` [K] the short way."""
    key = key_of(matter, jnp.arange(matter.shape[0], dtype=jnp.int32))
    most = jnp.max(key)
    rest = jnp.where(key == most, 0, key)
    second = jnp.max(rest)
    return Most(first=most, second=second, third=jnp.max(jnp.where(rest == second, 0, rest)))


def in_axes(boxes: Obstacles, vector: jax.Array) -> list[jax.Array]:
    """Components [K] of ``vector`` [3] or [K, 3] along the axes of each box."""
    c, s = boxes.axis[:, 0], boxes.axis[:, 1]
    x, y, z = (vector[..., k] for k in range(3))
    return [c * x + s * y, c * y - s * x, jnp.broadcast_to(z, c.shape)]
