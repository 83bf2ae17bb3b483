"""Reading and writing parts of small arrays: at constant indices, or else by selecting among all places.

The arrays are those of `swarmsim.scalars.rules`.
"""

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jax import lax

from swarmsim.scalars.graph import Graph, Operation, Scalar, is_constant
from swarmsim.scalars.rules import (
    ADD,
    AND,
    EQ,
    GE,
    LE,
    MAX,
    MIN,
    MUL,
    SELECTIONS,
    NotWritableError,
    Rule,
    as_objects,
    unpack,
)

Place = tuple[Scalar | None, tuple[int, ...]]
"""Condition (None: always) and first index of a window."""


@dataclass(frozen=True)
class _Windows:
    """Windows of one size in an array, at indices of one type."""

    graph: Graph
    shape: tuple[int, ...]
    sizes: tuple[int, ...]
    clip: bool  # indices out of bounds mean the nearest window inside, or else none
    kind: type[np.generic]  # of the indices

    def places(self, start: Iterable[Scalar]) -> Iterator[Place]:
        """Where the window at ``start`` may lie; at most one of the conditions holds."""
        lasts = [full - size for full, size in zip(self.shape, self.sizes, strict=True)]
        axes = [self._positions(index, last) for index, last in zip(start, lasts, strict=True)]
        if math.prod(map(len, axes)) * math.prod(self.sizes) > SELECTIONS:
            raise NotWritableError
        for choice in itertools.product(*axes):
            conditions = [condition for condition, _ in choice if condition is not None]
            both = None
            for condition in conditions:
                both = condition if both is None else self.graph.apply(AND, both, condition)
            yield both, tuple(at for _, at in choice)

    def _positions(self, index: Scalar, last: int) -> list[tuple[Scalar | None, int]]:
        if is_constant(index):
            at = min(max(int(index), 0), last) if self.clip else int(index)
            return [(None, at)] if 0 <= at <= last else []
        if self.clip and last == 0:
            return [(None, 0)]
        found: list[tuple[Scalar | None, int]] = []
        for at in range(last + 1):
            compare = LE if self.clip and at == 0 else GE if self.clip and at == last else EQ
            found.append((self.graph.apply(compare, index, self.kind(at)), at))
        return found

    def cut(self, array: np.ndarray, at: tuple[int, ...]) -> np.ndarray:
        """View of the window at ``at``."""
        return array[tuple(slice(first, first + size) for first, size in zip(at, self.sizes, strict=True))]

    def read(self, array: np.ndarray, start: Iterable[Scalar], outside: Scalar = None) -> list[Scalar]:
        """Entries of the window at ``start``, in row-major order; ``outside`` where it is not inside."""
        places = list(self.places(start))
        if self.clip:  # one of them holds: the last needs no condition
            result = unpack(self.cut(array, places[-1][1]))
            places = places[-2::-1]
        else:
            result = [outside] * math.prod(self.sizes)
        for condition, at in places:
            entries = unpack(self.cut(array, at))
            if condition is not None:
                pairs = zip(result, entries, strict=True)
                entries = [self.graph.select(condition, old, new) for old, new in pairs]
            result = entries
        return result

    def write(
        self, array: np.ndarray, start: Iterable[Scalar], update: np.ndarray, combine: Operation | None = None
    ) -> None:
        """Put ``update`` in place of the window at ``start`` of an array of objects, or combine it with what is there.

        A window that is not inside is left out.
        """
        for condition, at in self.places(start):
            window = self.cut(array, at)
            for index in np.ndindex(*self.sizes):
                old, new = window[index], update[index]
                if combine is not None:
                    new = self.graph.apply(combine, old, new)
                window[index] = new if condition is None else self.graph.select(condition, old, new)


def _kind(variable: Any) -> type[np.generic]:
    return np.dtype(variable.aval.dtype).type


def _dynamic_slice(graph: Graph, equation: Any, x: np.ndarray, *start: np.ndarray) -> np.ndarray:
    if not start:
        return x
    sizes = equation.params["slice_sizes"]
    windows = _Windows(graph, x.shape, sizes, True, _kind(equation.invars[1]))
    return _objects(windows.read(x, [i[()] for i in start])).reshape(sizes)


def _dynamic_update_slice(
    graph: Graph, equation: Any, x: np.ndarray, update: np.ndarray, *start: np.ndarray
) -> np.ndarray:
    if not start:
        return update
    written = as_objects(x).copy()
    windows = _Windows(graph, x.shape, update.shape, True, _kind(equation.invars[2]))
    windows.write(written, [i[()] for i in start], as_objects(update))
    return written


def _objects(scalars: list[Scalar]) -> np.ndarray:
    packed = np.empty(len(scalars), object)
    for place, scalar in enumerate(scalars):
        packed[place] = scalar
    return packed


def _clips(mode: Any) -> bool:
    if mode == lax.GatherScatterMode.FILL_OR_DROP:
        return False
    if mode in (lax.GatherScatterMode.CLIP, lax.GatherScatterMode.PROMISE_IN_BOUNDS):
        return True
    raise NotWritableError


def _filling(dtype: Any, given: Any) -> np.generic:
    """What `jax.lax.gather` puts for an entry out of bounds."""
    if given is None:
        if dtype.kind in "iu":
            bounds = np.iinfo(dtype)
            given = bounds.min if dtype.kind == "i" else bounds.max
        else:
            given = True if dtype.kind == "b" else np.nan
    filling: np.generic = np.dtype(dtype).type(given)
    return filling


def full_start(
    rank: int, indices: np.ndarray, batch: tuple[int, ...], axes: Iterable[int], shared: Iterable[tuple[int, int]]
) -> list[Scalar]:
    """First index of a window in all axes of the operand."""
    start: list[Scalar] = [np.int32(0)] * rank
    for axis, index in zip(axes, indices[batch], strict=True):
        start[axis] = index
    for axis, of_indices in shared:
        start[axis] = np.int32(batch[of_indices])
    return start


@dataclass(frozen=True)
class GatherPlan:
    """What `jax.lax.gather` does, whatever it reads from."""

    sizes: tuple[int, ...]  # of a window, with all axes of the operand
    axes: tuple[int, ...]  # of the operand, that an index has
    shared: tuple[tuple[int, int], ...]  # axes of operand and indices that go together
    clip: bool  # indices out of bounds mean the nearest window inside, or else `outside`
    outside: Scalar
    window_shape: tuple[int, ...]
    offset_dims: tuple[int, ...]

    def arranged(self, read: list[Scalar], batches: tuple[int, ...]) -> np.ndarray:
        """The result from the entries of each window in turn."""
        found = _objects(read).reshape((*batches, *self.window_shape))
        return np.moveaxis(found, range(len(batches), found.ndim), self.offset_dims)


def gather_plan(equation: Any) -> GatherPlan:
    """The plan of a gather; raises `NotWritableError` for a mode that has no form in scalars."""
    p, numbers = equation.params, equation.params["dimension_numbers"]
    clip = _clips(p["mode"])
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    return GatherPlan(
        sizes=tuple(p["slice_sizes"]),
        axes=tuple(numbers.start_index_map),
        shared=tuple(zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True)),
        clip=clip,
        outside=None if clip else _filling(np.dtype(equation.outvars[0].aval.dtype), p["fill_value"]),
        window_shape=tuple(size for axis, size in enumerate(p["slice_sizes"]) if axis not in dropped),
        offset_dims=tuple(numbers.offset_dims),
    )


def _gather(graph: Graph, equation: Any, x: np.ndarray, indices: np.ndarray) -> np.ndarray:
    plan = gather_plan(equation)
    windows = _Windows(graph, x.shape, plan.sizes, plan.clip, _kind(equation.invars[1]))
    batches = indices.shape[:-1]
    read: list[Scalar] = []
    for batch in np.ndindex(*batches):
        read += windows.read(x, full_start(x.ndim, indices, batch, plan.axes, plan.shared), plan.outside)
    return plan.arranged(read, batches)


def _scatter(combine: Operation | None) -> Rule:
    def rule(graph: Graph, equation: Any, x: np.ndarray, indices: np.ndarray, updates: np.ndarray) -> np.ndarray:
        p = equation.params
        numbers, clip = p["dimension_numbers"], _clips(p["mode"])
        inserted = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        window_axes = numbers.update_window_dims
        updates = np.moveaxis(as_objects(updates), window_axes, range(updates.ndim - len(window_axes), updates.ndim))
        batches = indices.shape[:-1]
        remaining = iter(updates.shape[len(batches) :])
        sizes = tuple(1 if axis in inserted else next(remaining) for axis in range(x.ndim))
        windows = _Windows(graph, x.shape, sizes, clip, _kind(equation.invars[1]))
        shared = list(zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True))
        updates, written = updates.reshape(*batches, *sizes), as_objects(x).copy()
        for batch in np.ndindex(*batches):
            start = full_start(x.ndim, indices, batch, numbers.scatter_dims_to_operand_dims, shared)
            windows.write(written, start, updates[batch], combine)
        return written

    return rule


INDEXING: dict[str, Rule] = {
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "scatter": _scatter(None),
    "scatter-add": _scatter(ADD),
    "scatter_add": _scatter(ADD),
    "scatter-mul": _scatter(MUL),
    "scatter_mul": _scatter(MUL),
    "scatter-min": _scatter(MIN),
    "scatter_min": _scatter(MIN),
    "scatter-max": _scatter(MAX),
    "scatter_max": _scatter(MAX),
}
