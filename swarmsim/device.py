"""What the device that computes is good at."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

In = TypeVar("In")
Out = TypeVar("Out")

_CORES: ContextVar[str | None] = ContextVar("swarmsim cores", default=None)


def on_processor() -> bool:
    """Whether arrays live on the processor: a core is fastest with work that fits its cache, one piece after another.

    An accelerator wants as much as possible at a time.
    """
    return jax.default_backend() == "cpu"


@contextmanager
def among_cores(axis: str) -> Iterator[None]:
    """What is traced inside shares the elements of `each` among the devices along that ``axis`` of a mesh.

    All else is computed by each of them alike, so that none waits for what another one decides.
    """
    token = _CORES.set(axis)
    try:
        yield
    finally:
        _CORES.reset(token)


def each(function: Callable[[In], Out], values: In, together: int) -> Out:
    """``function`` of every element of the leading axis; up to ``together`` (static) at a time on an accelerator."""
    count = jax.tree.leaves(values)[0].shape[0]
    if on_processor():
        axis = _CORES.get()
        return jax.lax.map(function, values) if axis is None else _shared(function, values, count, axis)
    # equal parts: a rest would be compiled as well
    size = max(n for n in range(1, min(together, count) + 1) if count % n == 0)
    return jax.lax.map(function, values, batch_size=size)


def _shared(function: Callable[[In], Out], values: In, count: int, axis: str) -> Out:
    """`each`, every device along ``axis`` taking its part of the ``count`` elements."""
    part = -(-count // jax.lax.axis_size(axis))
    mine = jnp.minimum(jax.lax.axis_index(axis) * part + jnp.arange(part), count - 1)
    leaves, structure = jax.tree.flatten(jax.lax.map(function, jax.tree.map(lambda x: x[mine], values)))
    # in one piece: it is their number that exchanges cost
    flat = jnp.concatenate([_as_floats(x).reshape(part, x[0].size) for x in leaves], axis=1)
    whole = jax.lax.all_gather(flat, axis, tiled=True)[:count]
    ends = np.cumsum([leaf[0].size for leaf in leaves])
    pieces = jnp.split(whole, ends[:-1], axis=1)
    return jax.tree.unflatten(structure, [_from_floats(p, leaf) for p, leaf in zip(pieces, leaves, strict=True)])


def _as_floats(x: jax.Array) -> jax.Array:
    """The bits of an array as float32."""
    if x.dtype == jnp.bool:
        x = x.astype(jnp.int32)
    assert x.dtype.itemsize == 4
    return x if x.dtype == jnp.float32 else jax.lax.bitcast_convert_type(x, jnp.float32)


def _from_floats(x: jax.Array, like: jax.Array) -> jax.Array:
    """The rows of `_as_floats` again as what they were."""
    kind: Any = jnp.int32 if like.dtype == jnp.bool else like.dtype
    x = x if kind == jnp.float32 else jax.lax.bitcast_convert_type(x, kind)
    return x.astype(like.dtype).reshape(x.shape[0], *like.shape[1:])


def either(predicate: jax.Array, one: Callable[[], Out], other: Callable[[], Out]) -> Out:
    """The result of ``one`` where ``predicate`` [] holds, else that of ``other``.

    A condition that each mission has of its own makes `jax.vmap` compute both anyway, and `jax.lax.cond` copy all that
    they read, rasters of the site as well, for every mission. On an accelerator, which steps many, both are computed.
    """
    if on_processor():
        return jax.lax.cond(predicate, one, other)
    return jax.tree.map(lambda a, b: a if a is b else jnp.where(predicate, a, b), one(), other())


def switch(number: jax.Array, branches: Sequence[Callable[[], Out]]) -> Out:
    """The result of the branch of that ``number`` []; all of them are computed on an accelerator, as by `either`."""
    if on_processor():
        return jax.lax.switch(number, branches)
    return jax.tree.map(lambda *leaves: jax.lax.select_n(number, *leaves), *(branch() for branch in branches))
