"""Loops, branches and functions with derivatives of their own, on scalars of all vehicles."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from swarmsim.scalars.interpreter import (
    CALLS,
    SMALL,
    Interpreter,
    Value,
    Whole,
    is_mapped,
    is_number,
    is_small,
)
from swarmsim.scalars.rules import LE, NotWritableError, as_objects, pack, tidy, unpack


def _flow(jaxpr: Any, mapped: Sequence[bool]) -> list[bool]:
    """Whether each output of a jaxpr may differ between vehicles, given that of the inputs."""
    jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
    known = dict(zip(jaxpr.invars, mapped, strict=True))

    def read(variable: Any) -> bool:
        return not isinstance(variable, core.Literal) and known.get(variable, False)

    for equation in jaxpr.eqns:
        flags = [read(v) for v in equation.invars]
        name = equation.primitive.name
        outs = _flow(equation.params[CALLS[name]], flags) if name in CALLS else [any(flags)] * len(equation.outvars)
        known.update(zip(equation.outvars, outs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _carried(body: Any, constant: list[bool], carry: list[bool], rest: list[bool]) -> list[bool]:
    """Which parts of a loop's carry may differ between vehicles at any time."""
    while True:
        after = _flow(body, [*constant, *carry, *rest])[: len(carry)]
        joined = [a or b for a, b in zip(carry, after, strict=True)]
        if joined == carry:
            return carry
        carry = joined


def _dump_all(interpreter: Interpreter, values: Sequence[Value], avals: Sequence[Any], mapped: Sequence[bool]) -> list:
    interpreter.settle(values)
    found: list[Any] = []
    for value, aval, of_vehicle in zip(values, avals, mapped, strict=True):
        found += interpreter.dump(value, aval, of_vehicle)
    return found


def _load_all(interpreter: Interpreter, arrays: Sequence[Any], avals: Sequence[Any], mapped: Sequence[bool]) -> list:
    queue = list(arrays)
    return [interpreter.load(queue, aval, of_vehicle) for aval, of_vehicle in zip(avals, mapped, strict=True)]


def loop_counts(params: Any) -> tuple[int, int]:
    """Where a scan's carry and its rows begin among its inputs."""
    if "num_consts" in params:  # before jax 0.11
        return params["num_consts"], params["num_consts"] + params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()
    return len(consts), len(consts) + len(carry)


def _scan(interpreter: Interpreter, equation: Any, values: list[Value]) -> list[Value]:
    p = equation.params
    if p["length"] <= interpreter.unroll:
        return _written_out(interpreter, equation, values)
    body, (first_carry, split) = p["jaxpr"], loop_counts(p)
    consts, carry, rows = values[:first_carry], values[first_carry:split], values[split:]
    avals = [v.aval for v in body.jaxpr.invars]
    carry_avals, row_avals = avals[first_carry:split], avals[split:]
    row_flags = [is_mapped(x) for x in rows]
    const_flags = [is_mapped(x) for x in consts]
    carry_flags = _carried(body, const_flags, [is_mapped(x) for x in carry], row_flags)
    out_flags = _flow(body, [*const_flags, *carry_flags, *row_flags])[len(carry) :]
    out_avals = [v.aval for v in body.jaxpr.outvars[len(carry) :]]
    interpreter.settle(consts)

    def step(carried: list[Any], row: list[Any]) -> tuple[list[Any], list[Any]]:
        inner = interpreter.inner()
        own = _load_all(inner, carried, carry_avals, carry_flags)
        entries = [inner.take_apart(x, m, a) for x, m, a in zip(row, row_flags, row_avals, strict=True)]
        outs = inner.run(body, [*inner.enter(consts), *own, *entries])
        return (
            _dump_all(inner, outs[: len(carry)], carry_avals, carry_flags),
            _dump_all(inner, outs[len(carry) :], out_avals, out_flags),
        )

    columns = []
    for value, variable in zip(rows, equation.invars[split:], strict=True):
        array, mapped = interpreter.put_together(value, variable.aval)
        columns.append(interpreter.graph.vary(jnp.moveaxis(array, 1, 0) if mapped else jnp.asarray(array)))
    first = _dump_all(interpreter, carry, carry_avals, carry_flags)
    last, stacked = interpreter.loop(step, first, columns, p)
    queue, results = list(stacked), _load_all(interpreter, last, carry_avals, carry_flags)
    for variable, aval, mapped in zip(equation.outvars[len(carry) :], out_avals, out_flags, strict=True):
        results.append(_history(interpreter, queue, variable.aval, aval, mapped))
    return results


def _history(interpreter: Interpreter, queue: list[Any], full: Any, aval: Any, mapped: bool) -> Value:
    """Value of what a loop put out, from its dumped arrays with the loop's axis in front."""
    if is_small(aval, SMALL):
        parts = [queue.pop(0) for _ in range(aval.size)]
        array = jnp.stack(parts, -1) if parts else jnp.zeros((full.shape[0], 0), aval.dtype)
        array = array.reshape(*array.shape[: 1 + mapped], *aval.shape)
    else:
        array = queue.pop(0)
    return interpreter.take_apart(jnp.moveaxis(array, 0, 1) if mapped else array, mapped, full)


def _written_out(interpreter: Interpreter, equation: Any, values: list[Value]) -> list[Value]:
    p = equation.params
    first_carry, split = loop_counts(p)
    consts, carry, rows = values[:first_carry], values[first_carry:split], values[split:]
    row_avals = [v.aval for v in p["jaxpr"].jaxpr.invars[split:]]
    order = range(p["length"])
    collected: list[Any] = [None] * p["length"]
    for number in reversed(order) if p["reverse"] else order:
        entries = [_row(interpreter, x, number, aval) for x, aval in zip(rows, row_avals, strict=True)]
        outs = interpreter.run(p["jaxpr"], [*consts, *carry, *entries])
        carry, collected[number] = outs[: len(carry)], outs[len(carry) :]
    outs = [
        _joined(interpreter, [outs[place] for outs in collected], v.aval)
        for place, v in enumerate(equation.outvars[len(carry) :])
    ]
    return [*carry, *outs]


def _row(interpreter: Interpreter, value: Value, number: int, aval: Any) -> Value:
    if isinstance(value, Whole):
        entry = lax.index_in_dim(value.array, number, int(value.mapped), keepdims=False)
        return interpreter.take_apart(entry, value.mapped, aval)
    row = value[number, ...]
    if is_small(aval, SMALL):
        return tidy(row, aval.dtype)
    return row


def _joined(interpreter: Interpreter, rows: list[Value], aval: Any) -> Value:
    if not rows:
        return np.zeros(aval.shape, aval.dtype)
    if is_small(aval, SMALL) and not any(isinstance(x, Whole) for x in rows):
        return tidy(np.stack([as_objects(x) for x in rows]), aval.dtype)
    one = jax.ShapeDtypeStruct(aval.shape[1:], aval.dtype)
    mapped = any(is_mapped(x) for x in rows)
    if mapped:
        return Whole(jnp.stack([interpreter.mapped_array(x, one) for x in rows], 1), True)
    return Whole(jnp.stack([jnp.asarray(interpreter.put_together(x, one)[0]) for x in rows]), False)


@dataclass(frozen=True)
class _While:
    """A `jax.lax.while_loop` on scalars."""

    test: Any
    body: Any
    test_consts: list[Value]
    consts: list[Value]
    carry: list[Value]

    @classmethod
    def of(cls, equation: Any, values: list[Value]) -> "_While":
        p = equation.params
        if p["cond_jaxpr"].jaxpr.outvars[0].aval.shape:
            raise NotWritableError  # several loops in step, as `jax.vmap` makes them
        first, split = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
        return cls(p["cond_jaxpr"], p["body_jaxpr"], values[:first], values[first:split], values[split:])

    @property
    def avals(self) -> list[Any]:
        """Types of what is carried."""
        return [v.aval for v in self.body.jaxpr.invars[len(self.consts) :]]

    def going(self, interpreter: Interpreter, carried: list[Any], flags: list[bool], mapped: bool) -> Any:
        """Whether it goes on, for all or for each vehicle [N]."""
        inner = interpreter.inner()
        own = _load_all(inner, carried, self.avals, flags)
        (going,) = inner.run(self.test, [*inner.enter(self.test_consts), *own])
        (array,) = _dump_all(inner, [going], [self.test.jaxpr.outvars[0].aval], [mapped])
        return array

    def step(self, interpreter: Interpreter, carried: list[Any], flags: list[bool]) -> list[Any]:
        """What is carried after the body."""
        inner = interpreter.inner()
        own = _load_all(inner, carried, self.avals, flags)
        return _dump_all(inner, inner.run(self.body, [*inner.enter(self.consts), *own]), self.avals, flags)


def _while(interpreter: Interpreter, equation: Any, values: list[Value]) -> list[Value]:
    loop = _While.of(equation, values)
    flags = _carried(loop.body, [is_mapped(x) for x in loop.consts], [is_mapped(x) for x in loop.carry], [])
    if any(_flow(loop.test, [*(is_mapped(x) for x in loop.test_consts), *flags])):
        raise NotWritableError  # every vehicle has an end of its own: left to jax.vmap
    interpreter.settle([*loop.test_consts, *loop.consts])

    def test(carried: list[Any]) -> Any:
        return loop.going(interpreter, carried, flags, False)

    def step(carried: list[Any]) -> list[Any]:
        return loop.step(interpreter, carried, flags)

    last = lax.while_loop(test, step, _dump_all(interpreter, loop.carry, loop.avals, flags))
    return _load_all(interpreter, last, loop.avals, flags)


def while_by_vehicle(
    interpreter: Interpreter, equation: Any, values: list[Value], any_of: Callable[[Any], Any]
) -> list[Value]:
    """A loop that ends for each vehicle by itself: the others go on, and what it carries stays.

    ``any_of`` tells whether any of the vehicles [N] goes on, by numbers of which those that do have one above zero.
    """
    loop = _While.of(equation, values)
    flags = [True] * len(loop.carry)
    interpreter.settle([*loop.test_consts, *loop.consts])

    def going(carried: list[Any]) -> Any:
        return lax.convert_element_type(loop.going(interpreter, carried, flags, True), jnp.int32)

    def step(state: tuple[Any, list[Any]]) -> tuple[Any, list[Any]]:
        on, carried = state
        after = loop.step(interpreter, carried, flags)
        kept = [lax.select(on > 0, new, old) for new, old in zip(after, carried, strict=True)]
        return on * going(kept), kept

    first = _dump_all(interpreter, loop.carry, loop.avals, flags)
    _, last = lax.while_loop(lambda state: any_of(state[0]), step, (going(first), first))
    return _load_all(interpreter, last, loop.avals, flags)


def _cond(interpreter: Interpreter, equation: Any, values: list[Value]) -> list[Value]:
    branches, (index, *operands) = equation.params["branches"], values
    if is_number(index):
        return interpreter.run(branches[min(max(int(index), 0), len(branches) - 1)], operands)
    avals = [v.aval for v in equation.outvars]
    if not is_mapped(index):
        return _branch(interpreter, branches, index, operands, avals)
    if equation.effects or not all(is_small(aval, SMALL) for aval in avals):
        raise NotWritableError
    graph, (number,) = interpreter.graph, unpack(index)
    kind = np.dtype(equation.invars[0].aval.dtype).type
    *results, chosen = [interpreter.run(branch, operands) for branch in branches]
    for place in reversed(range(len(results))):
        here = graph.apply(LE, number, kind(place))
        chosen = [
            pack([graph.select(here, a, b) for a, b in zip(unpack(x), unpack(y), strict=True)], aval.shape, aval.dtype)
            for x, y, aval in zip(chosen, results[place], avals, strict=True)
        ]
    return chosen


def _branch(
    interpreter: Interpreter, branches: Sequence[Any], index: Value, operands: list[Value], avals: list[Any]
) -> list[Value]:
    """One branch for all vehicles."""
    flows = [_flow(branch, [is_mapped(x) for x in operands]) for branch in branches]
    flags = [any(of_output) for of_output in zip(*flows, strict=True)]
    interpreter.settle([index, *operands])

    def of(branch: Any) -> Any:
        def go() -> list[Any]:
            inner = interpreter.inner()
            return _dump_all(inner, inner.run(branch, inner.enter(operands)), avals, flags)

        return go

    (number,) = interpreter.graph.values(unpack(index))
    return _load_all(interpreter, lax.switch(number, [of(branch) for branch in branches]), avals, flags)


def _custom_derivative(interpreter: Interpreter, equation: Any, values: list[Value]) -> list[Value]:
    """The function in scalars; its derivatives are those of the vmapped equation, which keeps the custom rule."""
    avals = [v.aval for v in equation.outvars]
    if any(isinstance(x, Whole) for x in values) or not all(is_small(a, SMALL) for a in avals):
        raise NotWritableError
    flags = [any(is_mapped(x) for x in values)] * len(avals)
    interpreter.settle(values)
    nodes = [x for value in values for x in unpack(value) if not isinstance(x, np.generic)]

    def rebuilt(inner: Interpreter, arrays: Sequence[Any]) -> list[Value]:
        leaves = iter([inner.graph.leaf(x, node.mapped) for x, node in zip(arrays, nodes, strict=True)])
        return [
            pack([x if isinstance(x, np.generic) else next(leaves) for x in unpack(value)], value.shape, v.aval.dtype)
            for value, v in zip(values, equation.invars, strict=True)
        ]

    def written(*arrays: Any) -> list[Any]:
        inner = interpreter.inner()
        return _dump_all(inner, inner.run(equation.params["call_jaxpr"], rebuilt(inner, arrays)), avals, flags)

    def reference(*arrays: Any) -> list[Any]:
        inner = interpreter.inner()
        return _dump_all(inner, inner.vmapped(equation, rebuilt(inner, arrays)), avals, flags)

    with_rule: Any
    if equation.primitive.name == "custom_jvp_call":
        with_rule = jax.custom_jvp(written)
        with_rule.defjvp(lambda primals, tangents: jax.jvp(reference, primals, tangents))
    else:
        with_rule = jax.custom_vjp(written)
        with_rule.defvjp(lambda *arrays: jax.vjp(reference, *arrays), lambda pullback, given: pullback(given))
    return _load_all(interpreter, with_rule(*(node.value for node in nodes)), avals, flags)


CONTROL = {
    "scan": _scan,
    "while": _while,
    "cond": _cond,
    "custom_jvp_call": _custom_derivative,
    "custom_vjp_call": _custom_derivative,
}
"""How primitives with inner jaxprs are evaluated."""
