"""What the device that computes is good at."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp

In = TypeVar("In")
Out = TypeVar("Out")


def on_processor() -> bool:
    """Whether arrays live on the processor: a core is fastest with work that fits its cache, one piece after another.

    An accelerator wants as much as possible at a time.
    """
    return jax.default_backend() == "cpu"


def each(function: Callable[[In], Out], values: In, together: int) -> Out:
    """``function`` of every element of the leading axis; up to ``together`` (static) at a time on an accelerator."""
    if on_processor():
        return jax.lax.map(function, values)
    count = jax.tree.leaves(values)[0].shape[0]
    # equal parts: a rest would be compiled as well
    size = max(n for n in range(1, min(together, count) + 1) if count % n == 0)
    return jax.lax.map(function, values, batch_size=size)


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
