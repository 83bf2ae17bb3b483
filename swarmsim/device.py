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
Known = TypeVar("Known")

AT_A_TIME = 64  # missions for which an accelerator computes what only some of them need: each is much by itself
IN_STEP = 512  # missions that wait for one another, where what takes long is asked for inside, by `for_those` again

_ASKED: ContextVar[jax.Array | None] = ContextVar("swarmsim asked", default=None)
_CORES: ContextVar[str | None] = ContextVar("swarmsim cores", default=None)


def on_processor() -> bool:
    """Whether arrays live on the processor: a core is fastest with work that fits its cache, one piece after another.

    An accelerator wants as much as possible at a time.
    """
    return jax.default_backend() == "cpu"


@contextmanager
def among_cores(axis: str) -> Iterator[None]:
    """What is traced inside shares the elements of `each` and `in_turn` among the devices along an ``axis`` of a mesh.

    All else is computed by each of them alike, so that none waits for what another one decides.
    """
    token = _CORES.set(axis)
    try:
        yield
    finally:
        _CORES.reset(token)


def each(function: Callable[[In], Out], values: In, together: int) -> Out:
    """``function`` of every element of the leading axis; up to ``together`` (static) at a time on an accelerator."""
    if on_processor():
        return in_turn(lambda known, x: (known, function(x)), None, values)
    count = jax.tree.leaves(values)[0].shape[0]
    # equal parts: a rest would be compiled as well
    size = max(n for n in range(1, min(together, count) + 1) if count % n == 0)
    parts = jax.tree.map(lambda x: x.reshape(count // size, size, *x.shape[1:]), values)
    found = jax.lax.map(jax.vmap(function), parts)
    # with both sizes: arrays of no material have no entries from which one of them would follow
    return jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), found)


def in_turn(step: Callable[[Known, In], tuple[Known, Out]], start: Known, values: In) -> Out:
    """The second result of ``step``, of what is known and an element, for every element of the leading axis.

    Its first result is what is known at the next element, ``start`` at the first one. For a processor; every device of
    `among_cores` begins its part of the elements with ``start``.
    """
    axis = _CORES.get()

    def of_part(part: In) -> Out:
        return jax.lax.scan(step, start, part)[1]

    return of_part(values) if axis is None else _shared(of_part, values, axis)


def _shared(function: Callable[[In], Out], values: In, axis: str) -> Out:
    """``function`` of all of the leading axis, every device along ``axis`` taking its part of it."""
    count = jax.tree.leaves(values)[0].shape[0]
    part = -(-count // jax.lax.axis_size(axis))
    mine = jnp.minimum(jax.lax.axis_index(axis) * part + jnp.arange(part), count - 1)
    leaves, structure = jax.tree.flatten(function(jax.tree.map(lambda x: x[mine], values)))
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


def for_those(
    predicate: jax.Array, one: Callable[[], Out], other: Callable[[], Out], together: int | None = None
) -> Out:
    """The result of ``one`` where ``predicate`` [] holds, else that of ``other``, which costs next to nothing.

    Unlike `either` it is for what takes long and few missions need at a time: an accelerator computes ``one`` for those
    that need it alone, ``together`` at a time (static; `AT_A_TIME` by default). What is computed so cannot be
    differentiated in reverse.

    Inside, missions that fill up a group ask for nothing. So ``one`` may be computed for many at a time (`IN_STEP`)
    whose number falls, if all that takes long in it is in `for_those` or `repeat_while` again, of which the groups are
    full whenever there are enough missions that need it.
    """
    if on_processor():
        return jax.lax.cond(predicate, one, other)

    def asked(yes: jax.Array) -> Out:
        token = _ASKED.set(yes)
        try:
            return one()
        finally:
            _ASKED.reset(token)

    closed, shapes = jax.make_jaxpr(asked, return_shape=True)(jax.ShapeDtypeStruct((), bool))
    structure: Any = jax.tree.structure(shapes)
    least, found = jax.tree.flatten(other())
    if structure != found:
        raise TypeError(f"the results differ in structure: {structure} and {found}")
    leaves = [jnp.asarray(x, aval.dtype) for x, aval in zip(least, closed.out_avals, strict=True)]

    def evaluate(yes: jax.Array, *consts: Any) -> list[jax.Array]:
        return list(core.jaxpr_as_fun(core.ClosedJaxpr(closed.jaxpr, consts))(yes))

    chosen = _chosen(evaluate, _asked(predicate), leaves, closed.consts, together or AT_A_TIME)
    return jax.tree.unflatten(structure, chosen)


def _asked(predicate: jax.Array) -> jax.Array:
    """Whether [] it holds, for a mission that is asked."""
    asked, predicate = _ASKED.get(), jnp.asarray(predicate, bool)
    return predicate if asked is None else predicate & asked


def some_at_a_time(function: Callable[[], Out]) -> Out:
    """The result of ``function``; on an accelerator for `AT_A_TIME` missions at a time, inside `for_those`.

    Missions that are not asked get zeros.
    """
    if on_processor():
        return function()
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(function))
    return for_those(jnp.array(True), function, lambda: nothing)


@custom_vmap
def at_most(x: jax.Array) -> jax.Array:
    """``x`` [] or more: what is computed for many at a time gets the largest of theirs.

    A loop with so many steps ends at the same one for all, and need not keep the results of those that ended before.
    """
    return x


@at_most.def_vmap
def _at_most_of_all(size: int, own: Any, x: jax.Array) -> tuple[jax.Array, bool]:
    del size
    return at_most(jnp.max(x) if own[0] else x), False


def repeat_while(
    more: Callable[[Out], jax.Array], step: Callable[[Out], Out], start: Out, together: int | None = None
) -> Out:
    """`jax.lax.while_loop`, of which an accelerator computes a ``step`` for the missions that go on alone.

    ``together`` is that of `for_those`.
    """
    if on_processor():
        return jax.lax.while_loop(more, step, start)

    def on(x: Out) -> jax.Array:
        return _asked(more(x))

    return jax.lax.while_loop(on, lambda x: for_those(on(x), lambda: step(x), lambda: x, together), start)


def _chosen(
    evaluate: Callable[..., list[jax.Array]], predicate: jax.Array, other: list[jax.Array], consts: Sequence[Any],
    together: int,
) -> list[jax.Array]:  # fmt: skip
    """``evaluate(True, *consts)`` where ``predicate`` [] holds, else ``other``; ``together`` at a time."""
    yes = jnp.array(True)

    @custom_vmap
    def chosen(predicate: jax.Array, other: list[jax.Array], consts: list[Any]) -> list[jax.Array]:
        return jax.lax.cond(predicate, lambda: evaluate(yes, *consts), lambda: other)

    @chosen.def_vmap
    def of_many(size: int, own: Any, predicate: jax.Array, other: list[jax.Array], consts: list[Any]) -> Any:
        apart, own_other, own_consts = own
        if not (apart or any(own_other) or any(own_consts)):  # JAX asks so for a derivative's sake
            return jax.lax.cond(predicate, lambda: evaluate(yes, *consts), lambda: other), [False] * len(other)
        axes = [0 if x else None for x in own_consts]
        other = [x if y else _repeated(x, size) for x, y in zip(other, own_other, strict=True)]
        every = [True] * len(other)
        if apart:
            return _in_groups(evaluate, predicate, other, consts, axes, together), every

        def alike(asked: jax.Array, *consts: Any) -> list[jax.Array]:
            return [_repeated(x, size) for x in evaluate(asked, *consts)]

        many = jax.vmap(evaluate, in_axes=[None, *axes], axis_size=size) if any(own_consts) else alike
        return _chosen(many, predicate, other, consts, together), every

    return chosen(predicate, other, list(consts))


def _repeated(x: Any, size: int) -> jax.Array:
    return jnp.broadcast_to(jnp.asarray(x), (size, *np.shape(x)))


def _in_groups(
    evaluate: Callable[..., list[jax.Array]],
    predicate: jax.Array,
    other: list[jax.Array],
    consts: list[Any],
    axes: list[int | None],
    most: int,
) -> list[jax.Array]:
    """``other`` [B, ...] with the results for those where ``predicate`` [B] holds, a group of them after another."""
    size = predicate.shape[0]
    group = min(most, size)
    together = jax.vmap(evaluate, in_axes=[0, *axes], axis_size=group)
    if group == size and most > AT_A_TIME:  # what takes long is asked for inside
        found = together(predicate, *consts)
        return [jnp.where(_over(predicate, y), y, x) for x, y in zip(other, found, strict=True)]
    count = jnp.sum(predicate)
    order = jnp.append(jnp.argsort(~predicate, stable=True), jnp.zeros(group, jnp.int32))

    def take(number: jax.Array, results: list[jax.Array]) -> list[jax.Array]:
        at = jax.lax.dynamic_slice(order, (number * group,), (group,))
        asked = number * group + jnp.arange(group) < count
        # What fills the last group up is the first of it again: another one's state may be one that no loop ends from.
        at = jnp.where(asked, at, at[0])
        found = together(asked, *[x if axis is None else x[at] for x, axis in zip(consts, axes, strict=True)])
        rows = jnp.where(asked, at, size)  # the rest is dropped
        return [x.at[rows].set(y, mode="drop") for x, y in zip(results, found, strict=True)]

    return jax.lax.fori_loop(0, -(-count // group), take, other)


def _over(predicate: jax.Array, x: jax.Array) -> jax.Array:
    """The predicate [B] for every entry of ``x`` [B, ...]."""
    return predicate.reshape(-1, *[1] * (x.ndim - 1))
