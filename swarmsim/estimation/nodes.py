"""Where a crystal is looked at from a source during a window: the places along its way that rays lead to."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from swarmsim.estimation.likelihood import travel_gain
from swarmsim.estimation.measurements import Measurements
from swarmsim.pytree import pytree
from swarmsim.site import Site, sample

LEAST_ABOVE_M = 0.2  # height of a crystal above the ground


Span = tuple[int, int, int, int]
"""Rows from, to, their detector model, and the rays to each window along its way."""


@pytree
class Nodes:
    """Where the crystal is looked at from a source: ``rays`` places of each of m windows, one window after another.

    Each stands for the part of the way that is nearest to it: two straight pieces, one before it and one after.
    """

    position_m: jax.Array  # [rays m, 3]
    axis: jax.Array  # [rays m, 3]
    pieces_m: jax.Array  # [rays m, 2, 3] from the place to the beginning of its part, and to the end
    pieces: jax.Array  # [rays m, 2] shares of the way


def nodes_of(site: Site, m: Measurements, spans: Sequence[Span]) -> Nodes:
    """The nodes of the windows of all ``spans``, one after another."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *(_nodes_of(site, m, span) for span in spans))


def _nodes_of(site: Site, m: Measurements, span: Span) -> Nodes:
    """The nodes of a span's windows.

    With one ray a window has its middle; with more the first and the last end of the way are among them, so that a
    shadow's edge that a window crosses is seen in the spread between its rays. A way is two straight legs of equal
    time, which the ends and the mean place tell: the corner between them lies as far beyond the mean as this lies off
    the straight line between the ends. No place is taken to lie below the ground.
    """
    first, last, _, rays = span
    mean, travel, axis = (x[first:last] for x in (m.position_m, m.travel_m, m.axis))
    chord = jnp.zeros_like(travel) if m.chord_m is None else m.chord_m[first:last]
    corner = -2.0 * chord
    # a vehicle that stands for long and drives off at last, or drives in circles, has no two legs of equal time
    length, off = (jnp.linalg.norm(x, axis=-1, keepdims=True) for x in (travel, corner))
    corner = corner * jnp.minimum(1.0, 0.5 * length / jnp.maximum(off, 1e-6))

    def at(share: jax.Array) -> jax.Array:
        """Places [m, ..., 3] at so much of the way."""
        along, beside = share[..., None] - 0.5, 1.0 - jnp.abs(2.0 * share[..., None] - 1.0)
        return (mean + chord)[:, None] + along * travel[:, None] + beside * corner[:, None]

    share, low, high = _parts(rays)
    position = at(share)
    pieces = jnp.stack([at(low) - position, at(high) - position], axis=2)
    ground = jax.vmap(lambda xy: sample(site.terrain_m, site, xy))(position[..., :2].reshape(-1, 2))
    position = position.reshape(-1, 3)
    return Nodes(
        position_m=position.at[:, 2].max(ground + LEAST_ABOVE_M),
        axis=jnp.repeat(axis, rays, axis=0),
        pieces_m=pieces.reshape(-1, 2, 3),
        pieces=jnp.tile(jnp.stack([share - low, high - share], axis=1), (last - first, 1)),
    )


def _parts(rays: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where on a way its nodes [rays] are, and where the parts that they stand for begin and end."""
    share = jnp.linspace(0.0, 1.0, rays) if rays > 1 else jnp.array([0.5])
    half = 0.5 / max(rays - 1, 1)
    return share, jnp.maximum(share - half, 0.0), jnp.minimum(share + half, 1.0)


def inverse_square_gain(offset_m: jax.Array, nodes: Nodes) -> jax.Array:
    """Integral of 1/r² [rays m] over the parts of the ways over its value at their nodes, ``offset_m`` from the source.

    Over all of a way; ``offset_m`` is [rays m, 3].
    """
    middle = offset_m[:, None] + 0.5 * nodes.pieces_m
    squared = jnp.maximum(jnp.sum(middle * middle, axis=-1), 1e-6)
    mean = jnp.sum(nodes.pieces * travel_gain(middle, nodes.pieces_m) / squared, axis=-1)
    return jnp.sum(offset_m * offset_m, axis=-1) * mean


def spans_of(groups: Sequence[tuple[int, int, int]]) -> tuple[Span, ...]:
    """Spans from (rows, detector, rays) of groups that follow one another; neighbours that are alike are one span."""
    spans: list[Span] = []
    at = 0
    for size, detector, rays in groups:
        if spans and spans[-1][2:] == (detector, rays):
            spans[-1] = (spans[-1][0], at + size, detector, rays)
        elif size:
            spans.append((at, at + size, detector, rays))
        at += size
    return tuple(spans)
