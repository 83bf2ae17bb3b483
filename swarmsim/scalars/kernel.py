"""A program as one kernel of a GPU: each thread takes one vehicle, whose scalars stay in registers through all loops.

Compiled by XLA, a loop over time writes what it carries to memory and reads it again at every pass, and each pass
costs several launches. Here the loop runs inside the kernel (Pallas, lowered to Triton): what a vehicle is made of is
read once and written once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from swarmsim.scalars.access import Memory, MemoryGraph, Numbers, Rows, apart
from swarmsim.scalars.control import CONTROL, loop_counts, while_by_vehicle
from swarmsim.scalars.graph import Graph, Scalar, is_constant, varying_axes
from swarmsim.scalars.indexing import full_start, gather_plan
from swarmsim.scalars.interpreter import SMALL, Interpreter, Value, Whole, is_number, is_small, needed
from swarmsim.scalars.program import Program
from swarmsim.scalars.rules import ADD, ELEMENTWISE, GE, LE, MAX, MIN, MUL, NotWritableError, pack

_NOT_IN_TRITON = frozenset({
    "erf", "erfc", "lgamma", "digamma", "bessel_i0e", "bessel_i1e", "round", "reduce_precision"
})  # fmt: skip
_NOT_OF_BOOLEANS = frozenset({"max", "min", "reduce_max", "reduce_min", "cummax", "cummin"})
_TYPES = {"bool", "int32", "uint32", "float32"}
_BLOCKS = ((2**17, 128), (2**14, 64), (0, 32))  # threads of a block from so many vehicles on: few fill few processors
_WARP = 32
_INDEX_MAX = 2**31 - 1


class NotInKernelError(Exception):
    """The program needs something that a kernel of one thread a vehicle does not have."""


@dataclass(frozen=True)
class _View:
    """Part of an array in memory, which is read where an index is known."""

    ref: Any
    rows: Rows
    offset: Scalar  # of the part within it
    strides: tuple[int, ...]
    shape: tuple[int, ...]


@dataclass(frozen=True)
class _InKernel(Interpreter):
    """Evaluates a program within a kernel; arrays that are not taken apart are views of memory."""

    graph: MemoryGraph
    nothing: Any = None  # [] int32: zero, which no compiler knows

    def loop(self, step: Callable[..., Any], first: list[Any], columns: list[Any], params: Any) -> Any:
        """A loop, of a length that the compiler does not know, or it might write out all loops within one another."""
        return lax.fori_loop(0, params["length"] + self.nothing, lambda _, carry: step(carry, [])[0], first), []

    def equation(self, equation: Any, values: list[Value], wanted: list[bool]) -> Sequence[Value]:
        """Outputs of one equation."""
        name, known = equation.primitive.name, all(is_number(x) for x in values)
        if not known and name in ELEMENTWISE:
            types = {str(v.aval.dtype) for v in (*equation.invars, *equation.outvars)}
            powers = name in ("pow", "integer_pow") and "float32" not in types
            chooses = name == "select_n" and len(values) > 3
            if name in _NOT_IN_TRITON or powers or chooses or not types <= _TYPES:
                raise NotInKernelError(f"{name} of {', '.join(sorted(types))}")
        if not known and name in _NOT_OF_BOOLEANS and equation.invars[0].aval.dtype == bool:
            raise NotInKernelError(f"{name} of bool")
        if name == "stop_gradient":  # a kernel is not differentiated
            return values
        if name in ("custom_jvp_call", "custom_vjp_call"):
            return self.run(equation.params["call_jaxpr"], values, wanted)
        return super().equation(equation, values, wanted)

    def put_together(self, value: Value, aval: Any) -> tuple[Any, bool]:
        """Array of a value, and whether it has the axis N in front; a kernel has arrays of one scalar only."""
        if isinstance(value, Whole) or aval.shape:
            raise NotInKernelError("an array that is not taken apart")
        return super().put_together(value, aval)

    def dump(self, value: Value, aval: Any, mapped: bool) -> list[Any]:
        """Scalars of a value; a view cannot be carried, nor what is no array in memory."""
        if isinstance(value, Whole):
            raise NotInKernelError("a loop or a branch that carries an array")
        return super().dump(value, aval, mapped)

    def settle(self, values: Sequence[Value]) -> None:
        """Bind the scalars of values, and the offsets of views."""
        self.graph.values(x.array.offset for x in values if isinstance(x, Whole) and isinstance(x.array, _View))
        super().settle(values)

    def _entered(self, value: Value) -> Value:
        view = value.array if isinstance(value, Whole) else None
        if not isinstance(view, _View) or is_constant(view.offset):
            return super()._entered(value)
        return Whole(replace(view, offset=self.graph.leaf(view.offset.value, view.offset.mapped)), value.mapped)

    def vmapped(self, equation: Any, values: list[Value]) -> list[Value]:
        """Outputs of an equation that has no form in scalars: reads from memory."""
        read = _READS.get(equation.primitive.name)
        if read is None or not isinstance(values[0], Whole) or not isinstance(values[0].array, _View):
            raise NotInKernelError(equation.primitive.name)
        if any(isinstance(x, Whole) for x in values[1:]):
            raise NotInKernelError(equation.primitive.name)
        return [read(self, equation, values[0], values[1:])]

    def of_view(self, view: _View, mapped: bool, aval: Any) -> Value:
        """A view as a value: its entries, if there are few."""
        if not is_small(aval, SMALL):
            return Whole(view, mapped or (not is_constant(view.offset) and view.offset.mapped))
        places = [_flat(view.strides, index) for index in np.ndindex(*view.shape)]
        return pack(self.entries(view, view.offset, places), aval.shape, aval.dtype)

    def entries(self, view: _View, offset: Scalar, places: Sequence[int]) -> list[Scalar]:
        """Entries of a view, ``places`` further than an ``offset``."""
        return [self.graph.read(view.ref, view.rows, offset, place) for place in places]


def _scan(interpreter: _InKernel, equation: Any, values: list[Value]) -> Sequence[Value]:
    p = equation.params
    first_carry, first_row = loop_counts(p)
    columns = len(values) > first_row or len(equation.outvars) > first_row - first_carry
    if any(isinstance(x, Whole) for x in values[first_row:]) or (columns and p["length"] > interpreter.unroll):
        raise NotInKernelError("a loop over the rows of an array")
    return CONTROL["scan"](interpreter, equation, values)


def _while(interpreter: _InKernel, equation: Any, values: list[Value]) -> Sequence[Value]:
    """A loop whose end each thread has of its own: a block goes on until the last of its threads is through."""
    try:
        return CONTROL["while"](interpreter, equation, values)
    except NotWritableError:
        return while_by_vehicle(interpreter, equation, values, lambda going: jnp.max(going) > 0)


def _flat(strides: Sequence[int], index: Sequence[int]) -> int:
    return sum(stride * i for stride, i in zip(strides, index, strict=True))


def _moved(graph: Graph, view: _View, start: Sequence[Scalar]) -> Scalar:
    """Offset of the entry ``start`` of a view."""
    offset = view.offset
    for index, stride in zip(start, view.strides, strict=True):
        offset = graph.apply(ADD, offset, graph.apply(MUL, _index(graph, index), np.int32(stride)))
    return offset


def _index(graph: Graph, scalar: Scalar) -> Scalar:
    if isinstance(scalar, np.generic):
        return np.int32(scalar)
    return graph.node("index", lambda x: lax.convert_element_type(x, jnp.int32), (scalar,))


def _within(graph: Graph, index: Scalar, last: int) -> Scalar:
    return graph.apply(MIN, graph.apply(MAX, _index(graph, index), np.int32(0)), np.int32(last))


def _dynamic_slice(interpreter: _InKernel, equation: Any, whole: Whole, start: list[Value]) -> Value:
    view, sizes, graph = whole.array, equation.params["slice_sizes"], interpreter.graph
    lasts = [full - size for full, size in zip(view.shape, sizes, strict=True)]
    first = [_within(graph, i[()], last) for i, last in zip(start, lasts, strict=True)]
    part = replace(view, offset=_moved(graph, view, first), shape=tuple(sizes))
    return interpreter.of_view(part, whole.mapped, equation.outvars[0].aval)


def _slice(interpreter: _InKernel, equation: Any, whole: Whole, _: list[Value]) -> Value:
    p, view, aval = equation.params, whole.array, equation.outvars[0].aval
    steps = p["strides"] or (1,) * len(view.shape)
    offset = _moved(interpreter.graph, view, [np.int32(i) for i in p["start_indices"]])
    strides = tuple(a * b for a, b in zip(view.strides, steps, strict=True))
    return interpreter.of_view(replace(view, offset=offset, strides=strides, shape=aval.shape), whole.mapped, aval)


def _squeeze(interpreter: _InKernel, equation: Any, whole: Whole, _: list[Value]) -> Value:
    view, dropped, aval = whole.array, equation.params["dimensions"], equation.outvars[0].aval
    strides = tuple(s for axis, s in enumerate(view.strides) if axis not in dropped)
    return interpreter.of_view(replace(view, strides=strides, shape=aval.shape), whole.mapped, aval)


def _reshape(interpreter: _InKernel, equation: Any, whole: Whole, _: list[Value]) -> Value:
    view, aval = whole.array, equation.outvars[0].aval
    if view.strides != _row_major(view.shape):
        raise NotInKernelError("reshape of a part")
    strides = _row_major(aval.shape)
    return interpreter.of_view(replace(view, strides=strides, shape=aval.shape), whole.mapped, aval)


def _row_major(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(int(np.prod(shape[axis + 1 :])) for axis in range(len(shape)))


def _gather(interpreter: _InKernel, equation: Any, whole: Whole, operands: list[Value]) -> Value:
    view, (indices,), out = whole.array, operands, equation.outvars[0].aval
    if not is_small(out, SMALL):
        raise NotInKernelError("gather of a large part")
    graph, plan = interpreter.graph, gather_plan(equation)
    read: list[Scalar] = []
    for batch in np.ndindex(*indices.shape[:-1]):
        start = full_start(len(view.shape), indices, batch, plan.axes, plan.shared)
        lasts = [full - size for full, size in zip(view.shape, plan.sizes, strict=True)]
        at = _moved(graph, view, [_within(graph, i, last) for i, last in zip(start, lasts, strict=True)])
        places = [_flat(view.strides, index) for index in np.ndindex(*plan.sizes)]
        entries = interpreter.entries(view, at, places)
        if not plan.clip:
            for i, last in zip(start, lasts, strict=True):
                if is_constant(i):
                    entries = entries if 0 <= int(i) <= last else [plan.outside] * len(entries)
                    continue
                low, high = (
                    graph.apply(GE, _index(graph, i), np.int32(0)),
                    graph.apply(LE, _index(graph, i), np.int32(last)),
                )
                entries = [graph.select(low, plan.outside, x) for x in entries]
                entries = [graph.select(high, plan.outside, x) for x in entries]
        read += entries
    return plan.arranged(read, indices.shape[:-1])


_READS: dict[str, Callable[..., Value]] = {
    "dynamic_slice": _dynamic_slice, "slice": _slice, "squeeze": _squeeze, "reshape": _reshape, "gather": _gather
}  # fmt: skip


def on_gpu(
    program: Program, size: int, mapped: Sequence[bool], returned: Sequence[int] = (), *, interpret: bool = False
) -> Callable[..., Any]:
    """``program.evaluate`` as one kernel, or as XLA compiles it where the program has no such form.

    Under `jax.vmap` the axes (mission, vehicle) become one. Derivatives are those of `Program.vmapped`. The first
    results may be written over the arguments numbered ``returned``. ``interpret`` runs the kernel without a GPU, for
    tests.
    """
    direct = partial(program.evaluate, size, mapped)

    def alone(*arrays: Any) -> list[jax.Array]:
        try:
            return _launch(program, size, mapped, [False] * len(arrays), 1, arrays, returned, interpret)
        except NotInKernelError:
            return direct(*arrays)

    batched = custom_vmap(alone)

    @batched.def_vmap
    def of_missions(missions: int, own: Sequence[bool], *arrays: Any) -> tuple[list[jax.Array], list[bool]]:
        every = [True] * len(program.jaxpr.outvars)
        try:
            results = _launch(program, size, mapped, own, missions, arrays, returned, interpret)
            return [x.reshape(missions, size, *x.shape[1:]) for x in results], every
        except NotInKernelError:
            return jax.vmap(direct, in_axes=[0 if x else None for x in own])(*arrays), every

    whole = jax.custom_jvp(lambda *arrays: batched(*arrays))
    whole.defjvp(partial(jax.jvp, partial(program.vmapped, size, mapped)))
    return whole


@dataclass(frozen=True)
class _Operand:
    """An argument as the kernel finds it in memory."""

    aval: Any  # of one vehicle
    rows: Rows


def _launch(
    program: Program, size: int, mapped: Sequence[bool], own: Sequence[bool], missions: int, arrays: Sequence[Any],
    returned: Sequence[int], interpret: bool,
) -> list[jax.Array]:  # fmt: skip
    """Results [missions x size, ...] of a kernel."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    total = missions * size
    flags = zip(mapped, own, program.variables, strict=True)
    operands = [_Operand(v.aval, Rows(of_vehicle, of_mission, v.aval.size)) for of_vehicle, of_mission, v in flags]
    given = [(o, a) for o, a in zip(operands, arrays, strict=True) if _in_memory(o.aval)]
    outs = [v.aval for v in program.jaxpr.outvars]
    if not all(_in_memory(a) or a.size == 0 for a in outs) or any(not is_small(a, SMALL) for a in outs):
        raise NotInKernelError("results that are not taken apart")
    if any(map(varying_axes, arrays)):
        raise NotInKernelError("a kernel does not say on which axes of a mesh its results depend")
    if any(np.size(a) > _INDEX_MAX for _, a in given) or any(total * a.size > _INDEX_MAX for a in outs):
        raise NotInKernelError("arrays with too many entries")
    block = next(threads for least, threads in _BLOCKS if total >= least)
    stored = [a for a in outs if a.size]

    def kernel(*refs: Any) -> None:
        place = pl.program_id(0) * block + lax.iota(jnp.int32, block)
        vehicle = lax.min(place, jnp.full(block, total - 1, jnp.int32))  # threads beyond the last one read the last
        memory = Memory(size, vehicle)
        graph = MemoryGraph(block, memory=memory)
        (nothing,) = graph.values([graph.read(refs[0], Rows(False, False, 1), np.int32(0), 0)])
        interpreter = _InKernel(graph, {**CONTROL, "scan": _scan, "while": _while}, program.unroll, nothing)
        results = _evaluated(program, operands, iter(refs[1 : 1 + len(given)]), interpreter)
        _store(place, total, list(zip(refs[1 + len(given) :], results, strict=True)))

    call = pl.pallas_call(
        kernel,
        grid=(-(-total // block),),
        in_specs=[pl.BlockSpec(memory_space=pl.ANY)] * (1 + len(given)),
        out_specs=[pl.BlockSpec(memory_space=pl.ANY)] * len(stored),
        out_shape=[jax.ShapeDtypeStruct((total * a.size,), a.dtype) for a in stored],
        input_output_aliases=_aliases(operands, outs, returned, missions),
        interpret=interpret,
        compiler_params=None if interpret else triton.CompilerParams(num_warps=block // _WARP, num_stages=1),
    )
    made = iter(call(jnp.zeros(1, jnp.int32), *[jnp.reshape(a, -1) for _, a in given]))
    return [next(made).reshape(total, *a.shape) if a.size else jnp.zeros((total, *a.shape), a.dtype) for a in outs]


def _aliases(
    operands: Sequence[_Operand], outs: Sequence[Any], returned: Sequence[int], missions: int
) -> dict[int, int]:
    """Arguments of the kernel over which results are written, by their places among all arguments and results.

    In a loop, what it carries would otherwise be copied at every pass.
    """
    found = {}
    for result, (number, aval) in enumerate(zip(returned, outs, strict=False)):
        operand = operands[number]
        whole = operand.rows.of_vehicle and (operand.rows.of_mission or missions == 1)
        if whole and aval.size and (operand.aval.shape, operand.aval.dtype) == (aval.shape, aval.dtype):
            place = 1 + sum(_in_memory(o.aval) for o in operands[:number])
            found[place] = sum(a.size > 0 for a in outs[:result])
    return found


def _in_memory(aval: Any) -> bool:
    """Whether a kernel can read an array: no keys of random numbers, and not empty."""
    return not jax.dtypes.issubdtype(aval.dtype, jax.dtypes.extended) and aval.size > 0


def _evaluated(program: Program, operands: Sequence[_Operand], refs: Any, interpreter: _InKernel) -> list[list[Any]]:
    """Arrays [threads] of every entry of each result that is not empty."""
    known: dict[Any, Any] = dict(program.constants)
    for variable, operand in zip(program.variables, operands, strict=True):
        aval, rows = operand.aval, operand.rows
        if not _in_memory(aval):
            empty = not jax.dtypes.issubdtype(aval.dtype, jax.dtypes.extended)
            known[variable] = np.zeros(aval.shape, aval.dtype) if empty else Whole(None, not rows.shared)
            continue
        view = _View(next(refs), rows, np.int32(0), _row_major(aval.shape), aval.shape)
        known[variable] = interpreter.of_view(view, not rows.shared, aval)
    live = needed(program.jaxpr, [True] * len(program.jaxpr.outvars))[1]
    interpreter.settle([known[v] for v in program.variables if v in live])
    with np.errstate(all="ignore"):
        results = interpreter.evaluate(program.jaxpr, known)
        interpreter.settle(results)
    outs = [(value, v.aval) for value, v in zip(results, program.jaxpr.outvars, strict=True) if v.aval.size]
    if any(isinstance(value, Whole) for value, _ in outs):
        raise NotInKernelError("a result that is not taken apart")
    return [[_typed(x, aval) for x in interpreter.dump(value, aval, True)] for value, aval in outs]


def _store(place: jax.Array, total: int, results: Sequence[tuple[Any, list[Any]]]) -> None:
    """Write the entries of each result [threads] to its array; the vehicle of a thread is the one at its ``place``."""
    from jax.experimental.pallas import triton

    sizes = {len(entries) for _, entries in results}
    firsts = [place * np.int32(size) for size in sizes]

    def work(number: Numbers, given: Sequence[Any]) -> list[Any]:
        written, *rest = given
        first, left = dict(zip(sizes, rest, strict=False)), iter(rest[len(sizes) :])
        for ref, entries in results:
            for at in range(len(entries)):
                triton.store(ref.at[number.after(at, first[len(entries)])], next(left), mask=written)
        return []

    apart(work, [place < total, *firsts, *(x for _, entries in results for x in entries)], [])


def _typed(entry: Any, aval: Any) -> Any:
    return entry if entry.dtype == aval.dtype else lax.convert_element_type(entry, aval.dtype)


assert _NOT_IN_TRITON <= ELEMENTWISE

__all__ = ["NotInKernelError", "on_gpu"]
