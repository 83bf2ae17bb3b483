"""What the device that computes is good at."""

from collections.abc import Callable
from typing import TypeVar

import jax

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
