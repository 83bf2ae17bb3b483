"""Evaluation of a one-vehicle jaxpr with every small array taken apart into scalars of all vehicles."""

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from swarmsim.scalars.graph import FOLD_LIMIT, Graph, Node
from swarmsim.scalars.indexing import INDEXING
from swarmsim.scalars.rules import (
    ELEMENTWISE,
    REARRANGE,
    RULES,
    NotWritableError,
    elementwise,
    tidy,
)

SMALL = 64
"""Largest array of one vehicle, in elements, that is taken apart."""
UNROLL = 16
"""Longest `jax.lax.scan` that is written out."""
CALLS = {
    "jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr", "checkpoint": "jaxpr",
    "remat": "jaxpr", "remat2": "jaxpr",
}  # fmt: skip
"""Primitives that call a jaxpr, and the parameter that holds it."""


@dataclass(frozen=True)
class Whole:
    """Array that is not taken apart: [N, ...] if ``mapped``, or shared by all vehicles."""

    array: Any
    mapped: bool


Value = Any  # np.ndarray of numbers (constant) or of objects (scalars), or Whole


@dataclass(frozen=True)
class Interpreter:
    """Evaluates jaxprs of one vehicle on a graph of scalars."""

    graph: Graph
    control: Mapping[str, Callable[..., Sequence[Value]]]  # of primitives with inner jaxprs: (self, equation, values)
    unroll: int = UNROLL

    def inner(self) -> "Interpreter":
        """Interpreter for the trace of a loop's or a branch's body."""
        return replace(self, graph=self.graph.inner())

    def run(self, jaxpr: Any, inputs: Sequence[Value], wanted: Sequence[bool] | None = None) -> list[Value]:
        """Outputs of a jaxpr (closed or without constants); those that are not ``wanted`` are None."""
        consts = getattr(jaxpr, "consts", ())
        jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
        known = {v: self.constant(x, v.aval) for v, x in zip(jaxpr.constvars, consts, strict=True)}
        known.update(zip(jaxpr.invars, inputs, strict=True))
        return self.evaluate(jaxpr, known, wanted)

    def evaluate(self, jaxpr: Any, known: dict[Any, Value], wanted: Sequence[bool] | None = None) -> list[Value]:
        """Outputs of a jaxpr, given the values of its constants and inputs."""

        def read(variable: Any) -> Value:
            return self.constant(variable.val, variable.aval) if isinstance(variable, core.Literal) else known[variable]

        wanted = [True] * len(jaxpr.outvars) if wanted is None else wanted
        equations, live = needed(jaxpr, wanted)
        for equation in equations:
            results = self.equation(equation, [read(v) for v in equation.invars], [v in live for v in equation.outvars])
            known.update(zip(equation.outvars, results, strict=True))
        return [read(v) if want else None for v, want in zip(jaxpr.outvars, wanted, strict=True)]

    def equation(self, equation: Any, values: list[Value], wanted: list[bool]) -> Sequence[Value]:
        """Outputs of one equation."""
        name = equation.primitive.name
        if name in CALLS:
            return self.run(equation.params[CALLS[name]], values, wanted)
        special = self.control.get(name)
        constant = all(is_number(x) for x in values)
        outs = [v.aval for v in equation.outvars]
        limit = FOLD_LIMIT if constant else SMALL
        whole = any(isinstance(x, Whole) for x in values)
        try:
            if special is not None:
                return special(self, equation, values)
            if not whole and not equation.effects and all(is_small(a, limit) for a in outs):
                return [tidy(x, a.dtype) for x, a in zip(self._rule(equation, values), outs, strict=True)]
        except NotWritableError:
            pass
        plain = not any(jax.dtypes.issubdtype(a.dtype, jax.dtypes.extended) for a in outs)
        if values and constant and plain and not equation.effects and all(is_small(a, FOLD_LIMIT) for a in outs):
            with jax.ensure_compile_time_eval():
                return [np.asarray(x) for x in bind(equation, values)]
        return self.vmapped(equation, values)

    def _rule(self, equation: Any, values: list[Value]) -> Sequence[Value]:
        name = equation.primitive.name
        if name in ELEMENTWISE:
            return [elementwise(self.graph, equation, *values)]
        if name in REARRANGE:
            moved = REARRANGE[name](equation.params, *values)
            return moved if equation.primitive.multiple_results else [moved]
        rule = RULES.get(name) or INDEXING.get(name)
        if rule is None:
            raise NotWritableError
        results = rule(self.graph, equation, *values)
        return results if equation.primitive.multiple_results else [results]

    def vmapped(self, equation: Any, values: list[Value]) -> list[Value]:
        """Outputs of an equation by `jax.vmap` of its primitive."""
        arrays, mapped = [], []
        for value, variable in zip(values, equation.invars, strict=True):
            array, of_vehicle = self.put_together(value, variable.aval)
            arrays.append(self.graph.vary(array))
            mapped.append(of_vehicle)
        call: Callable[..., Any] = lambda *xs: bind(equation, xs)  # noqa: E731
        if any(mapped):
            call = jax.vmap(call, in_axes=[0 if of_vehicle else None for of_vehicle in mapped])
        outs = zip(call(*arrays), equation.outvars, strict=True)
        return [self.take_apart(x, any(mapped), v.aval) for x, v in outs]

    def constant(self, value: Any, aval: Any) -> Value:
        """Value that all vehicles share: numbers if it is known while tracing and not too large."""
        if is_foldable(value, aval):
            return np.asarray(value, aval.dtype)
        return self.take_apart(value, False, aval)

    def take_apart(self, array: Any, mapped: bool, aval: Any) -> Value:
        """Value of an array that has the axis N in front if ``mapped``; ``aval`` is the type of one vehicle's."""
        if not is_small(aval, SMALL):
            return Whole(array, mapped)
        if aval.size == 0:
            return np.zeros(aval.shape, aval.dtype)
        graph, parts = self.graph, np.empty(aval.size, object)
        if aval.size == 1:
            source = graph.leaf(array, mapped)
            parts[0] = (
                Node(lambda x: x.reshape(x.shape[:mapped]), (source,), mapped, free=True) if aval.shape else source
            )
        else:
            split = Node(lambda: _unstack(array, mapped), (), mapped, free=True)
            for place in range(aval.size):
                parts[place] = Node(operator.itemgetter(place), (split,), mapped, free=True)
        return parts.reshape(aval.shape)

    def put_together(self, value: Value, aval: Any) -> tuple[Any, bool]:
        """Array of a value, and whether it has the axis N in front."""
        if isinstance(value, Whole):
            return value.array, value.mapped
        if is_number(value):
            return value, False
        flat = value.reshape(-1)
        entries = self.graph.values(flat)
        if not is_mapped(value):
            if not aval.shape:
                return entries[0], False
            return jnp.stack([jnp.asarray(x) for x in map(self.graph.vary, entries)]).reshape(aval.shape), False
        columns = [self.graph.spread(x) for x in entries]
        if not aval.shape:
            return columns[0], True
        size = columns[0].shape[0]
        return lax.concatenate([lax.expand_dims(x, (1,)) for x in columns], 1).reshape(size, *aval.shape), True

    def mapped_array(self, value: Value, aval: Any) -> jax.Array:
        """Array [N, ...] of a value."""
        array, mapped = self.put_together(value, aval)
        if mapped:
            return array
        return self.graph.vary(lax.broadcast(jnp.asarray(array), (self.graph.size,)))

    def loop(self, step: Callable[..., Any], first: list[Any], columns: list[Any], params: Any) -> Any:
        """`jax.lax.scan` with the parameters of the primitive."""
        return lax.scan(step, first, columns, params["length"], reverse=params["reverse"], unroll=params["unroll"])

    # What loops and branches carry: a scalar of each small value, and the large ones whole.

    def dump(self, value: Value, aval: Any, mapped: bool) -> list[Any]:
        """Arrays of a value, spread over the vehicles if ``mapped``."""
        if is_small(aval, SMALL):
            if isinstance(value, Whole):
                value = self.take_apart(value.array, value.mapped, aval)
            entries = self.graph.values(value.reshape(-1))
            return [self.graph.spread(x) if mapped else self.graph.vary(jnp.asarray(x)) for x in entries]
        return [self.mapped_array(value, aval) if mapped else self.graph.vary(self.put_together(value, aval)[0])]

    def load(self, arrays: list[Any], aval: Any, mapped: bool) -> Value:
        """Value of dumped arrays, taken off the front of the list."""
        if not is_small(aval, SMALL):
            return Whole(arrays.pop(0), mapped)
        if aval.size == 0:
            return np.zeros(aval.shape, aval.dtype)
        parts = np.empty(aval.size, object)
        for place in range(aval.size):
            parts[place] = self.graph.leaf(arrays.pop(0), mapped)
        return parts.reshape(aval.shape)

    def settle(self, values: Sequence[Value]) -> None:
        """Bind the scalars of values, all at once, because the graph then knows what several of them need."""
        self.graph.values(x for value in values if not isinstance(value, Whole) for x in value.reshape(-1))

    def enter(self, values: Sequence[Value]) -> list[Value]:
        """Settled values of an outer trace as those of this one."""
        return [self._entered(x) for x in values]

    def _entered(self, value: Value) -> Value:
        if isinstance(value, Whole) or is_number(value):
            return value
        parts = np.empty(value.size, object)
        for place, x in enumerate(value.reshape(-1)):
            parts[place] = self.graph.leaf(x.value, x.mapped) if isinstance(x, Node) else x
        return parts.reshape(value.shape)


def _unstack(array: jax.Array, mapped: bool) -> list[jax.Array]:
    front = array.shape[:mapped]
    flat = array.reshape(*front, -1)
    axis = len(front)
    return [lax.squeeze(x, (axis,)) for x in lax.split(flat, [1] * flat.shape[axis], axis)]


def bind(equation: Any, values: Sequence[Any]) -> Sequence[Any]:
    """Outputs of an equation for arrays of one vehicle."""
    found = equation.primitive.get_bind_params(equation.params)
    functions, params = found if isinstance(found, tuple) else ((), found)  # the former before jax 0.10
    outs = equation.primitive.bind(*functions, *values, **params)
    return outs if equation.primitive.multiple_results else [outs]


def needed(jaxpr: Any, wanted: Sequence[bool]) -> tuple[list[Any], set[Any]]:
    """Equations that wanted outputs or effects depend on, in order, and the variables in use."""
    live = {v for v, want in zip(jaxpr.outvars, wanted, strict=True) if want and not isinstance(v, core.Literal)}
    equations = []
    for equation in reversed(jaxpr.eqns):
        if equation.effects or any(v in live for v in equation.outvars):
            equations.append(equation)
            live.update(v for v in equation.invars if not isinstance(v, core.Literal))
    return equations[::-1], live


def is_small(aval: Any, limit: int) -> bool:
    """Whether an array of one vehicle is taken apart."""
    if not hasattr(aval, "shape"):
        return False
    size = math.prod(aval.shape)
    return size <= limit and not (size == 0 and jax.dtypes.issubdtype(aval.dtype, jax.dtypes.extended))


def is_foldable(value: Any, aval: Any) -> bool:
    """Whether a value is known while tracing, and is computed with on the host."""
    known = not isinstance(value, jax.core.Tracer) and not jax.dtypes.issubdtype(aval.dtype, jax.dtypes.extended)
    return known and is_small(aval, FOLD_LIMIT) and getattr(value, "is_fully_addressable", True)


def is_number(value: Value) -> bool:
    """Whether all of a value is constant."""
    return not isinstance(value, Whole) and value.dtype != object


def is_mapped(value: Value) -> bool:
    """Whether a value differs between vehicles."""
    if isinstance(value, Whole):
        return value.mapped
    return value.dtype == object and any(isinstance(x, Node) and x.mapped for x in value.reshape(-1))
