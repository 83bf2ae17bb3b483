"""Compiled functions that keep their compilation time apart from their running time."""

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax


@contextmanager
def uncollected() -> Iterator[None]:
    """Without the cyclic garbage collector, which takes a quarter of the time of tracing and finds nothing there."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class Clock:
    """Seconds spent compiling and running each stage since the last reset."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin again at zero."""
        self.compiled: dict[str, float] = {}
        self.ran: dict[str, float] = {}

    def copy(self) -> "Clock":
        """The times as they stand now."""
        taken = Clock()
        taken.compiled, taken.ran = dict(self.compiled), dict(self.ran)
        return taken

    @property
    def compile_s(self) -> float:
        """Seconds spent compiling."""
        return sum(self.compiled.values())

    @property
    def run_s(self) -> float:
        """Seconds spent running."""
        return sum(self.ran.values())


class Stage:
    """A function compiled for each shape of its arguments that it meets; runs to completion at each call."""

    def __init__(self, name: str, function: Callable[..., Any], clock: Clock):
        self._name = name
        self._jitted = jax.jit(function)
        self._compiled: dict[Any, Any] = {}
        self._clock = clock

    def __call__(self, *arguments: Any) -> Any:
        """The function's value, its compilation (if any) and its run timed on the clock."""
        leaves, structure = jax.tree.flatten(arguments)
        key = structure, tuple(jax.typeof(leaf) for leaf in leaves)
        compiled = self._compiled.get(key)
        if compiled is None:
            start = time.perf_counter()
            with uncollected():
                compiled = self._compiled[key] = self._jitted.lower(*arguments).compile()
            self._clock.compiled[self._name] = self._clock.compiled.get(self._name, 0.0) + time.perf_counter() - start
        start = time.perf_counter()
        result = jax.block_until_ready(compiled(*arguments))
        self._clock.ran[self._name] = self._clock.ran.get(self._name, 0.0) + time.perf_counter() - start
        return result
