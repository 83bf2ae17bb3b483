"""How primitives of small arrays are written as operations on scalars.

An array of one vehicle is a numpy array: of numbers where all of it is constant, otherwise of objects, each a
`swarmsim.scalars.graph` scalar. Rearrangements are numpy's own; the rest is written out.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from jax import lax

from swarmsim.scalars.graph import Graph, Operation, Scalar

Rule = Callable[..., Any]
SELECTIONS = 256
"""Largest number of selections that replace one access at an index that is not constant."""


class NotWritableError(Exception):
    """The equation has no form in scalars."""


def pack(scalars: Sequence[Scalar], shape: Sequence[int], dtype: Any) -> np.ndarray:
    """Array of scalars in row-major order, of numbers if all are constant."""
    if all(isinstance(x, np.generic) for x in scalars):
        return np.array(scalars, dtype).reshape(shape)
    packed = np.empty(len(scalars), object)
    for place, scalar in enumerate(scalars):  # as one assignment, numpy would turn its scalars into Python's
        packed[place] = scalar
    return packed.reshape(shape)


def unpack(array: np.ndarray) -> list[Scalar]:
    """Scalars of an array in row-major order."""
    return list(array.reshape(-1))


def as_objects(array: np.ndarray) -> np.ndarray:
    """The array as one of objects."""
    if array.dtype == object:
        return array
    objects = np.empty(array.size, object)
    for place, scalar in enumerate(array.reshape(-1)):
        objects[place] = scalar
    return objects.reshape(array.shape)


def tidy(array: np.ndarray, dtype: Any) -> np.ndarray:
    """The array as one of numbers if all of it is constant."""
    return pack(unpack(array), array.shape, dtype) if array.dtype == object else array


def _fold_div(a: Any, b: Any) -> Any:
    if np.issubdtype(np.asarray(a).dtype, np.integer):  # rounds towards zero, unlike numpy
        return np.trunc(np.true_divide(a, b))
    return np.true_divide(a, b)


def _fold_select(which: Any, *cases: Any) -> Any:
    return np.where(which, cases[1], cases[0]) if len(cases) == 2 else np.choose(which, cases)


FOLDS: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": _fold_div, "rem": np.fmod, "neg": np.negative,
    "abs": np.abs, "sign": np.sign, "floor": np.floor, "ceil": np.ceil, "max": np.maximum, "min": np.minimum,
    "sqrt": np.sqrt, "rsqrt": lambda x: 1 / np.sqrt(x), "square": np.square, "exp": np.exp, "log": np.log,
    "log1p": np.log1p, "expm1": np.expm1, "sin": np.sin, "cos": np.cos, "tan": np.tan, "tanh": np.tanh,
    "atan2": np.arctan2, "is_finite": np.isfinite, "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor,
    "not": np.invert, "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "select_n": _fold_select, "convert_element_type": lambda x: x,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
}  # fmt: skip
"""Elementwise primitives on numpy arrays; the result is then cast to the equation's type."""

ELEMENTWISE = frozenset(FOLDS) | {
    "pow", "integer_pow", "cbrt", "exp2", "asin", "acos", "atan", "sinh", "cosh", "asinh", "acosh", "atanh",
    "logistic", "erf", "erfc", "erf_inv", "lgamma", "digamma", "bessel_i0e", "bessel_i1e", "round", "nextafter",
    "reduce_precision", "shift_left", "shift_right_logical", "shift_right_arithmetic", "population_count", "clz",
    "real", "imag", "conj", "complex", "add_any",
}  # fmt: skip


def elementwise(graph: Graph, equation: Any, *operands: np.ndarray) -> np.ndarray:
    """An elementwise primitive, scalar by scalar."""
    out = equation.outvars[0].aval
    operation = operation_of(equation)
    if all(x.dtype != object for x in operands):
        if operation.fold is None:
            raise NotWritableError  # evaluated as it is
        return np.asarray(operation.fold(*operands), out.dtype)
    columns = [unpack(x if x.shape == out.shape else np.broadcast_to(x, out.shape)) for x in operands]
    return pack([graph.apply(operation, *row) for row in zip(*columns, strict=True)], out.shape, out.dtype)


def operation_of(equation: Any) -> Operation:
    """The operation of an equation with an elementwise primitive."""
    name, params, dtype = equation.primitive.name, equation.params, equation.outvars[0].aval.dtype
    try:
        key = (name, dtype, tuple(sorted(params.items())))
        hash(key)
    except TypeError:
        key = (name, dtype, tuple(sorted((k, str(v)) for k, v in params.items())))
    numpy_fold = FOLDS.get(name)
    fold = None
    if numpy_fold is not None:

        def fold(*operands: Any) -> Any:
            return np.asarray(numpy_fold(*operands)).astype(dtype)[()]

    return Operation(name, partial(equation.primitive.bind, **params), key, fold)


def _binary(name: str, bind: Callable[..., Any]) -> Operation:
    fold = FOLDS[name]
    return Operation(name, bind, name, lambda a, b: fold(a, b))


ADD, MUL = _binary("add", lax.add), _binary("mul", lax.mul)
MAX, MIN = _binary("max", lax.max), _binary("min", lax.min)
AND, OR, XOR = _binary("and", lax.bitwise_and), _binary("or", lax.bitwise_or), _binary("xor", lax.bitwise_xor)
EQ, NE, GT, LT = _binary("eq", lax.eq), _binary("ne", lax.ne), _binary("gt", lax.gt), _binary("lt", lax.lt)
LE, GE = _binary("le", lax.le), _binary("ge", lax.ge)


# Rearrangements: numpy's own on numbers and objects alike.


def _broadcast_in_dim(p: dict[str, Any], x: np.ndarray) -> np.ndarray:
    shape = [1] * len(p["shape"])
    for axis, size in zip(p["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), p["shape"])


def _reshape(p: dict[str, Any], x: np.ndarray) -> np.ndarray:
    order = p.get("dimensions")
    return (x if order is None else x.transpose(order)).reshape(p["new_sizes"])


def _slice(p: dict[str, Any], x: np.ndarray) -> np.ndarray:
    strides = p["strides"] or (1,) * x.ndim
    return x[tuple(itertools.starmap(slice, zip(p["start_indices"], p["limit_indices"], strides, strict=True)))]


def _split(p: dict[str, Any], x: np.ndarray) -> list[np.ndarray]:
    return np.split(x, np.cumsum(p["sizes"])[:-1], axis=p["axis"])


def _joined(join: Callable[..., np.ndarray], axis: str) -> Callable[..., np.ndarray]:
    def rule(p: dict[str, Any], *parts: np.ndarray) -> np.ndarray:
        mixed = any(x.dtype == object for x in parts)
        return join([as_objects(x) for x in parts] if mixed else parts, axis=p[axis])

    return rule


def _pad(p: dict[str, Any], x: np.ndarray, filling: np.ndarray) -> np.ndarray:
    shape, places, kept = [], [], []
    for size, (low, high, interior) in zip(x.shape, p["padding_config"], strict=True):
        full = size + max(size - 1, 0) * interior + low + high
        at = low + np.arange(size) * (interior + 1)
        inside = (at >= 0) & (at < full)
        shape.append(full)
        places.append(at[inside])
        kept.append(np.flatnonzero(inside))
    if x.dtype == object or filling.dtype == object:
        x, filling = as_objects(x), as_objects(filling)
    padded = np.empty(shape, x.dtype)
    padded[...] = filling
    padded[np.ix_(*places)] = x[np.ix_(*kept)]
    return padded


REARRANGE: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": _reshape,
    "squeeze": lambda p, x: np.squeeze(x, p["dimensions"]),
    "transpose": lambda p, x: x.transpose(p["permutation"]),
    "rev": lambda p, x: np.flip(x, p["dimensions"]),
    "tile": lambda p, x: np.tile(x, p["reps"]),
    "slice": _slice,
    "split": _split,
    "concatenate": _joined(np.concatenate, "dimension"),
    "stack": _joined(np.stack, "axis"),
    "unstack": lambda p, x: [np.moveaxis(x, p["axis"], 0)[k, ...] for k in range(x.shape[p["axis"]])],
    "pad": _pad,
    "copy": lambda p, x: x,
    "copy_p": lambda p, x: x,
}


# Reductions and products.


def _chain(graph: Graph, operation: Operation, scalars: list[Scalar]) -> Scalar:
    total = scalars[0]
    for scalar in scalars[1:]:
        total = graph.apply(operation, total, scalar)
    return total


def _tree(graph: Graph, operation: Operation, scalars: list[Scalar]) -> Scalar:
    """Pairwise, so that 2^k equal extremes share the gradient evenly, as they do in XLA's reduction."""
    while len(scalars) > 1:
        odd = scalars[len(scalars) & ~1 :]
        scalars = [graph.apply(operation, *pair) for pair in zip(scalars[::2], scalars[1::2], strict=False)] + odd
    return scalars[0]


def _reduction(operation: Operation, order: Callable[..., Scalar] = _chain) -> Rule:
    def rule(graph: Graph, equation: Any, x: np.ndarray) -> np.ndarray:
        out, axes = equation.outvars[0].aval, equation.params["axes"]
        if x.size == 0:
            raise NotWritableError
        rows = np.moveaxis(x, axes, range(-len(axes), 0)).reshape(out.size, -1)
        return pack([order(graph, operation, list(row)) for row in rows], out.shape, out.dtype)

    return rule


def _cumulative(operation: Operation) -> Rule:
    def rule(graph: Graph, equation: Any, x: np.ndarray) -> np.ndarray:
        out, axis = equation.outvars[0].aval, equation.params["axis"]
        moved = np.moveaxis(x, axis, -1)
        rows = moved.reshape(-1, x.shape[axis])
        if equation.params["reverse"]:
            rows = rows[:, ::-1]
        done = [list(itertools.accumulate(row, lambda a, b: graph.apply(operation, a, b))) for row in rows]
        summed = pack(list(itertools.chain(*done)), rows.shape, out.dtype)
        if equation.params["reverse"]:
            summed = summed[:, ::-1]
        return np.moveaxis(summed.reshape(moved.shape), -1, axis)

    return rule


def _arg_extreme(better: Operation) -> Rule:
    """The first of the best entries; a NaN is better than every number, as in XLA."""

    def rule(graph: Graph, equation: Any, x: np.ndarray) -> np.ndarray:
        out, (axis,) = equation.outvars[0].aval, equation.params["axes"]
        kind = np.dtype(equation.params["index_dtype"]).type
        places = []
        for row in np.moveaxis(x, axis, -1).reshape(out.size, -1):
            best, place = row[0], kind(0)
            for number, entry in enumerate(row[1:], 1):
                wins = graph.apply(better, entry, best)
                if equation.invars[0].aval.dtype.kind == "f":
                    broken = graph.apply(NE, entry, entry)
                    wins = graph.apply(AND, graph.apply(OR, wins, broken), graph.apply(EQ, best, best))
                best, place = graph.select(wins, best, entry), graph.select(wins, place, kind(number))
            places.append(place)
        return pack(places, out.shape, out.dtype)

    return rule


def _dot_general(graph: Graph, equation: Any, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    out = equation.outvars[0].aval
    if any(v.aval.dtype != out.dtype for v in equation.invars):
        raise NotWritableError
    (contract_a, contract_b), (batch_a, batch_b) = equation.params["dimension_numbers"]

    def ordered(x: np.ndarray, batch: Sequence[int], contract: Sequence[int]) -> np.ndarray:
        free = [i for i in range(x.ndim) if i not in batch and i not in contract]
        sizes = [int(np.prod([x.shape[i] for i in axes], dtype=int)) for axes in (batch, free, contract)]
        return x.transpose([*batch, *free, *contract]).reshape(sizes)

    left, right = ordered(a, batch_a, contract_a), ordered(b, batch_b, contract_b)
    if left.shape[2] == 0:
        return np.zeros(out.shape, out.dtype)
    products = [
        _chain(graph, ADD, [graph.apply(MUL, x, y) for x, y in zip(row, column, strict=True)])
        for rows, columns in zip(left, right, strict=True)
        for row, column in itertools.product(rows, columns)
    ]
    return pack(products, out.shape, out.dtype)


def _bitcast(graph: Graph, equation: Any, x: np.ndarray) -> np.ndarray:
    if equation.invars[0].aval.shape != equation.outvars[0].aval.shape:
        raise NotWritableError  # of one entry become several, or of several one
    return elementwise(graph, equation, x)


def _sort(graph: Graph, equation: Any, *operands: np.ndarray) -> list[np.ndarray]:
    if operands[0].shape[equation.params["dimension"]] > 1:
        raise NotWritableError
    return list(operands)


def _iota(graph: Graph, equation: Any) -> np.ndarray:
    p = equation.params
    line = np.arange(p["shape"][p["dimension"]], dtype=p["dtype"])
    return np.broadcast_to(np.expand_dims(line, [i for i in range(len(p["shape"])) if i != p["dimension"]]), p["shape"])


RULES: dict[str, Rule] = {
    "reduce_sum": _reduction(ADD),
    "reduce_prod": _reduction(MUL),
    "reduce_max": _reduction(MAX, _tree),
    "reduce_min": _reduction(MIN, _tree),
    "reduce_and": _reduction(AND),
    "reduce_or": _reduction(OR),
    "reduce_xor": _reduction(XOR),
    "cumsum": _cumulative(ADD),
    "cumprod": _cumulative(MUL),
    "cummax": _cumulative(MAX),
    "cummin": _cumulative(MIN),
    "argmax": _arg_extreme(GT),
    "argmin": _arg_extreme(LT),
    "dot_general": _dot_general,
    "bitcast_convert_type": _bitcast,
    "sort": _sort,
    "iota": _iota,
    "empty": lambda graph, equation: np.zeros(equation.outvars[0].aval.shape, equation.outvars[0].aval.dtype),
}
