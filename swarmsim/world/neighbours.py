"""Who is near whom in one mission.

All vehicles of a mission stand in one array, whatever their kind. Small numbers are compared pair by pair; more are put
into a cell list (Allen & Tildesley 2017, section 5.3.2), whose cost grows with V and not with V².
"""

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree

DENSE_MAX = 256  # up to this many vehicles comparing all pairs is faster than the cell list
NEAREST_DENSE_MAX = 2048  # the K nearest need one distance a pair, and a radio's reach may hold everybody in one cell
ROWS = 256  # vehicles compared with all others at a time, which bounds the memory
WINDOW = 48  # vehicles looked at in each of the three rows of cells around a vehicle
POSITION_MAX_M = 1e9  # a vehicle further out than this has diverged and is nobody's neighbour
_CELLS = 2**15  # per axis, so that row * _CELLS + column fits int32
_CELL_MARGIN = 1.01  # cells are larger than the reach, so that rounding never puts a neighbour two cells away
_NO_KEY = 2**31 - 1  # sorts after every cell


@pytree
class Neighbours:
    """The K nearest of each vehicle, nearest first."""

    index: jax.Array  # [V, K] int32; a vehicle's own index where not valid
    distance_m: jax.Array  # [V, K] m, between positions in 3-D; inf where not valid
    valid: jax.Array  # [V, K] bool
    overflow: jax.Array  # [] bool: a window was too small, so that somebody may be missing


@pytree
class Candidates:
    """Pairs (vehicle, other) worth comparing; C others for each vehicle."""

    index: jax.Array | None  # [V, C] int32, or None: all V in order
    pair: jax.Array  # [V, C] bool
    overflow: jax.Array  # [] bool

    def of(self, x: jax.Array) -> jax.Array:
        """The others' values [V, C, ...] (or [1, V, ...]) of ``x`` [V, ...]."""
        return x[None] if self.index is None else x[self.index]

    def named(self, slot: jax.Array) -> jax.Array:
        """The vehicles [V, E] int32 in the places ``slot`` [V, E] of the candidates."""
        return slot if self.index is None else jnp.take_along_axis(self.index, slot, axis=1)


def neighbours(
    position_m: jax.Array,
    reach_m: jax.Array,
    count: int,
    *,
    window: int = WINDOW,
    dense_max: int = NEAREST_DENSE_MAX,
) -> Neighbours:
    """The nearest vehicles within reach of each.

    Args:
        position_m: [V, 3] m, world. A vehicle with a non-finite position has no neighbours and is nobody's.
        reach_m: [] m, largest distance in 3-D; may be inf where all pairs are compared.
        count: K, how many neighbours to give (static).
        window: vehicles looked at in a row of three cells of the cell list (static).
        dense_max: number of vehicles up to which all pairs are compared (static).

    Returns:
        Neighbours, exact unless ``overflow`` is set. Which of several equally distant ones comes first is not
        specified.
    """
    size = position_m.shape[0]
    place, usable = cleared(position_m)
    own = jnp.arange(size, dtype=jnp.int32)
    kept = min(count, size if size <= dense_max else 3 * min(window, size))

    def nearest(place_: jax.Array, others: jax.Array, pair: jax.Array) -> tuple[jax.Array, jax.Array]:
        distance = norm(place_ - others)
        best, slot = jax.lax.top_k(jnp.where(pair & (distance <= reach_m), -distance, -jnp.inf), kept)
        return -best, slot

    if size <= dense_max:
        overflow = jnp.array(False)

        def row(x: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            return nearest(x[0], place, x[1] & usable & (x[2] != own))

        distance, index = jax.lax.map(row, (place, usable, own), batch_size=ROWS)
    else:
        near = _cell_list(place, usable, usable, reach_m, window)
        overflow = near.overflow
        distance, slot = nearest(place[:, None], near.of(place), near.pair)
        index = near.named(slot)
    valid = jnp.isfinite(distance)
    missing = ((0, 0), (0, count - kept))
    return Neighbours(
        index=jnp.broadcast_to(own[:, None], (size, count))
        .at[:, :kept]
        .set(jnp.where(valid, index.astype(jnp.int32), own[:, None])),
        distance_m=jnp.pad(distance, missing, constant_values=jnp.inf),
        valid=jnp.pad(valid, missing),
        overflow=overflow,
    )


def cleared(position_m: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Positions with the unusable ones at the origin, and which are usable."""
    usable = jnp.all(jnp.abs(position_m) < POSITION_MAX_M, axis=-1)  # also false for NaN
    return jnp.where(usable[:, None], position_m, 0.0), usable


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Sum of products over the last axis, which is short: written out, because a reduction is a kernel of its own."""
    return sum((a[..., axis] * b[..., axis] for axis in range(1, a.shape[-1])), a[..., 0] * b[..., 0])


def norm(vector: jax.Array) -> jax.Array:
    """Euclidean norm over the last axis, with gradient 0 at 0."""
    return root(dot(vector, vector))


def root(square: jax.Array) -> jax.Array:
    """Square root with gradient 0 at 0."""
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def candidates(
    place: jax.Array, asks: jax.Array, counts: jax.Array, reach: jax.Array, window: int, dense_max: int
) -> Candidates:
    """Pairs of a vehicle that ``asks`` [V] and one that ``counts`` [V], with all that are within reach."""
    if place.shape[0] > dense_max:
        return _cell_list(place, asks, counts, reach, window)
    pair = asks[:, None] & counts[None] & ~jnp.eye(place.shape[0], dtype=bool)
    return Candidates(index=None, pair=pair, overflow=jnp.array(False))


def _cell_list(place: jax.Array, asks: jax.Array, counts: jax.Array, reach: jax.Array, window: int) -> Candidates:
    size = place.shape[0]
    window = min(window, size)
    cell = _cells(jax.lax.stop_gradient(place[:, :2]), counts, jax.lax.stop_gradient(reach))
    key = jnp.where(counts, cell, _NO_KEY)
    order = jnp.argsort(key).astype(jnp.int32)
    # Three cells of a row are a contiguous run of keys; one place more tells whether the run goes on.
    first = cell[:, None] + _CELLS * jnp.array([-1, 0, 1]) - 1  # [V, 3]
    start = jnp.searchsorted(key[order], first)  # unrolled, it would be fused into and repeated in each of its uses
    slot = start[..., None] + jnp.arange(window + 1)
    key = jnp.pad(key[order], (0, window + 1), constant_values=_NO_KEY)[slot]
    within = asks[:, None, None] & (key <= first[..., None] + 2)
    index = jnp.pad(order, (0, window + 1))[slot[..., :-1]].reshape(size, 3 * window)
    pair = within[..., :-1].reshape(size, 3 * window) & (index != jnp.arange(size)[:, None])
    return Candidates(index=index, pair=pair, overflow=jnp.any(within[..., -1]))


def _cells(place: jax.Array, counts: jax.Array, reach: jax.Array) -> jax.Array:
    """Number of the cell of each place, row * _CELLS + column; [V] int32.

    Cells are counted from the median place, so that no outlier moves all others out of the range of numbers; beyond
    that range they are clipped, which keeps neighbours in adjacent cells.
    """
    number = jnp.sum(counts)
    ranked = jnp.sort(jnp.where(counts[:, None], place, jnp.inf), axis=0)
    middle = jnp.where(number > 0, ranked[jnp.maximum(number - 1, 0) // 2], 0.0)
    cell = jnp.floor((place - middle) / (_CELL_MARGIN * jnp.maximum(reach, 1e-3)))
    cell = jnp.clip(cell + _CELLS // 2, 1, _CELLS - 2).astype(jnp.int32)
    return cell[:, 1] * _CELLS + cell[:, 0]
