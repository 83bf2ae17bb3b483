"""What the device that computes is good at."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.extend import core

In = TypeVar("In")
Out = TypeVar("Out")

AT_A_TIME = 32  # missions for which an accelerator computes what only some of them need: each is much by itself

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
    parts = jax.tree.map(lambda x: x.reshape(count // size, size, *x.shape[1:]), values)
    found = jax.lax.map(jax.vmap(function), parts)
    # with both sizes: arrays of no material have no entries from which one of them would follow
    return jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), found)


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


def for_those(predicate: jax.Array, one: Callable[[], Out], other: Callable[[], Out]) -> Out:
    """The result of ``one`` where ``predicate`` [] holds, else that of ``other``, which costs next to nothing.

    Unlike `either` it is for what takes long and few missions need at a time: an accelerator computes ``one`` for those
    that need it alone, `AT_A_TIME` together. What is computed so cannot be differentiated in reverse.
    """
    if on_processor():
        return jax.lax.cond(predicate, one, other)
    closed, shapes = jax.make_jaxpr(one, return_shape=True)()
    structure: Any = jax.tree.structure(shapes)
    least, found = jax.tree.flatten(other())
    if structure != found:
        raise TypeError(f"the results differ in structure: {structure} and {found}")
    leaves = [jnp.asarray(x, aval.dtype) for x, aval in zip(least, closed.out_avals, strict=True)]

    def evaluate(*consts: Any) -> list[jax.Array]:
        return list(core.jaxpr_as_fun(core.ClosedJaxpr(closed.jaxpr, consts))())

    return jax.tree.unflatten(structure, _chosen(evaluate, jnp.asarray(predicate, bool), leaves, closed.consts))


def repeat_while(more: Callable[[Out], jax.Array], step: Callable[[Out], Out], start: Out) -> Out:
    """`jax.lax.while_loop`, of which an accelerator computes a ``step`` for the missions that go on alone."""
    if on_processor():
        return jax.lax.while_loop(more, step, start)
    return jax.lax.while_loop(more, lambda x: for_those(more(x), lambda: step(x), lambda: x), start)


def _chosen(
    evaluate: Callable[..., list[jax.Array]], predicate: jax.Array, other: list[jax.Array], consts: Sequence[Any]
) -> list[jax.Array]:
    """``evaluate(*consts)`` where ``predicate`` [] holds, else ``other``."""

    @custom_vmap
    def chosen(predicate: jax.Array, other: list[jax.Array], consts: list[Any]) -> list[jax.Array]:
        return jax.lax.cond(predicate, lambda: evaluate(*consts), lambda: other)

    @chosen.def_vmap
    def of_many(size: int, own: Any, predicate: jax.Array, other: list[jax.Array], consts: list[Any]) -> Any:
        apart, own_other, own_consts = own
        if not (apart or any(own_other) or any(own_consts)):  # JAX asks so for a derivative's sake
            return jax.lax.cond(predicate, lambda: evaluate(*consts), lambda: other), [False] * len(other)
        axes = [0 if x else None for x in own_consts]
        other = [x if y else _repeated(x, size) for x, y in zip(other, own_other, strict=True)]
        every = [True] * len(other)
        if apart:
            return _in_groups(evaluate, predicate, other, consts, axes), every

        def alike(*consts: Any) -> list[jax.Array]:
            return [_repeated(x, size) for x in evaluate(*consts)]

        many = jax.vmap(evaluate, in_axes=axes, axis_size=size) if any(own_consts) else alike
        return _chosen(many, predicate, other, consts), every

    return chosen(predicate, other, list(consts))


def _repeated(x: Any, size: int) -> jax.Array:
    return jnp.broadcast_to(jnp.asarray(x), (size, *np.shape(x)))


def _in_groups(
    evaluate: Callable[..., list[jax.Array]],
    predicate: jax.Array,
    other: list[jax.Array],
    consts: list[Any],
    axes: list[int | None],
) -> list[jax.Array]:
    """``other`` [B, ...] with the results for those where ``predicate`` [B] holds, a group of them after another."""
    size = predicate.shape[0]
    group = min(AT_A_TIME, size)
    count = jnp.sum(predicate)
    order = jnp.append(jnp.argsort(~predicate, stable=True), jnp.zeros(group, jnp.int32))
    together = jax.vmap(evaluate, in_axes=axes, axis_size=group)

    def take(number: jax.Array, results: list[jax.Array]) -> list[jax.Array]:
        at = jax.lax.dynamic_slice(order, (number * group,), (group,))
        asked = number * group + jnp.arange(group) < count
        # What fills the last group up is the first of it again: another one's state may be one that no loop ends from,
        # and what it asks for inside would be computed too.
        at = jnp.where(asked, at, at[0])
        found = together(*[x if axis is None else x[at] for x, axis in zip(consts, axes, strict=True)])
        rows = jnp.where(asked, at, size)  # the rest is dropped
        return [x.at[rows].set(y, mode="drop") for x, y in zip(results, found, strict=True)]

    return jax.lax.fori_loop(0, -(-count // group), take, other)
