"""Graph of scalar operations, one scalar of every vehicle to a node: folded, shared and emitted on demand.

A scalar is a numpy scalar (a constant) or a `Node`, whose value is a JAX array of shape [N] (mapped: one entry per
vehicle) or [] (shared by all vehicles). Nodes are recorded first and bound to JAX only when their value is asked for,
so that results that nothing uses cost neither tracing nor compilation, and equal operations are bound once.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata

Scalar = Any  # np.generic | Node
FOLD_LIMIT = 1024
"""Largest constant array, in elements, that is computed on the host."""
STORED_COST = 80.0
"""Repeated operations from which on a CPU a result is kept in memory: the fastest of 10 to 400, measured on a UAV."""


class Node:
    """Scalar of every vehicle that is not known while tracing."""

    __slots__ = ("compute", "free", "mapped", "operands", "value")

    def __init__(
        self,
        compute: Callable[..., Any],
        operands: tuple[Scalar, ...],
        mapped: bool,
        *,
        value: Any = None,
        free: bool = False,  # part of an array, which costs nothing
    ):
        self.compute, self.operands, self.mapped, self.value, self.free = compute, operands, mapped, value, free


@dataclass(frozen=True)
class Operation:
    """Elementwise operation: what it is called, how it is bound, and what tells it from others of that name."""

    name: str
    bind: Callable[..., Any]
    key: Any
    fold: Callable[..., Any] | None = None  # the same on numpy values


@dataclass
class Graph:
    """Nodes of one trace. JAX arrays of another trace may enter as leaves; its nodes may not."""

    size: int  # N
    varying: frozenset[str] = frozenset()  # manual mesh axes (shard_map) of which the arrays are functions
    stores: bool = False  # whether results that much depends on are kept in memory, see `to_store`
    _interned: dict[Any, Node] = field(default_factory=dict)
    _spread: dict[Any, Any] = field(default_factory=dict)

    def inner(self) -> "Graph":
        """Empty graph for the trace of a loop's or a branch's body."""
        return Graph(self.size, self.varying, self.stores)

    def leaf(self, value: jax.Array, mapped: bool) -> Node:
        """Node of a known array, [N] if ``mapped`` or else []."""
        return Node(_no_operands, (), mapped, value=value)

    def apply(self, operation: Operation, *operands: Scalar) -> Scalar:
        """Result of an operation on scalars: a constant, one of the operands or a node."""
        if all(isinstance(x, np.generic) for x in operands):
            if operation.fold is not None:
                return operation.fold(*operands)
            with jax.ensure_compile_time_eval():  # a kernel of a GPU takes no constant where it expects a scalar
                return np.asarray(operation.bind(*operands))[()]
        simple = _SIMPLIFY.get(operation.name)
        if simple is not None and (known := simple(self, *operands)) is not None:
            return known
        return self.node(operation.key, self._binder(operation), operands)

    def node(self, key: Any, compute: Callable[..., Any], operands: tuple[Scalar, ...]) -> Node:
        """The node of ``compute`` on ``operands``; the same one for an equal ``key`` and the same operands."""
        whole_key = (key, *map(_identity, operands))
        found = self._interned.get(whole_key)
        if found is None:
            mapped = any(isinstance(x, Node) and x.mapped for x in operands)
            found = self._interned[whole_key] = Node(compute, operands, mapped)
        return found

    def _binder(self, operation: Operation) -> Callable[..., Any]:
        bind = operation.bind
        if operation.name in ("select_n", "clamp"):  # these want operands of one shape
            return lambda *values: bind(*self._alike(values))
        return bind if not self.varying else lambda *values: bind(*map(self.vary, values))

    def _alike(self, values: Sequence[Any]) -> list[Any]:
        ranks = {np.ndim(x) for x in values}
        return [self.vary(x) for x in values] if len(ranks) == 1 else [self.spread(x) for x in values]

    def vary(self, value: Any) -> Any:
        """Inside a shard_map: ``value`` as a function of all axes in use, because operands must agree in that."""
        missing = self.varying - varying_axes(value) if self.varying else ()
        return lax.pcast(value, tuple(missing), to="varying") if missing else value

    def spread(self, value: Any) -> jax.Array:
        """Array [N] of a value [] or [N]."""
        if np.ndim(value):
            return self.vary(value)
        key = _identity(value)
        if key not in self._spread:
            self._spread[key] = (self.vary(lax.broadcast(value, (self.size,))), value)
        return self._spread[key][0]

    def values(self, scalars: Iterable[Scalar]) -> list[Any]:
        """Value of each scalar: a numpy scalar or an array [N] or []; binds what has not been bound yet."""
        scalars = list(scalars)
        roots = [x for x in scalars if isinstance(x, Node) and x.value is None]
        if roots:
            order = unbound(roots)
            stored = to_store(order, roots) if self.stores else ()
            for node in order:
                value = node.compute(*[x.value if isinstance(x, Node) else x for x in node.operands])
                node.value = store(value) if node in stored else value
        return [x.value if isinstance(x, Node) else x for x in scalars]

    def select(self, which: Scalar, on_false: Scalar, on_true: Scalar) -> Scalar:
        """``on_true`` where ``which`` holds."""
        return self.apply(_SELECT, which, on_false, on_true)


def varying_axes(value: Any) -> frozenset[str]:
    """Manual mesh axes (shard_map) that a value is a function of."""
    kind = jax.typeof(value)
    axes = getattr(kind, "manual_axis_type", None)
    return axes.varying if axes is not None else getattr(kind, "vma", frozenset())  # the latter before jax 0.10


def unbound(roots: Iterable[Node]) -> list[Node]:
    """Nodes without a value that ``roots`` depend on, and these, each after its operands."""
    order: list[Node] = []
    seen: set[Node] = set()
    waiting = [(node, False) for node in roots]
    while waiting:
        node, ready = waiting.pop()
        if ready:
            order.append(node)
        elif node not in seen:
            seen.add(node)
            waiting.append((node, True))
            waiting += [(x, False) for x in node.operands if isinstance(x, Node) and x.value is None]
    return order


def to_store(order: Sequence[Node], roots: Iterable[Node]) -> set[Node]:
    """Nodes whose value is to be kept in memory.

    On a CPU, XLA compiles one loop over the vehicles for each result that it keeps, and computes in it all that the
    result depends on: without results in between, ten times the work, and the time to compile it.
    """
    uses: dict[Node, list[Node]] = {node: [] for node in order}
    cost: dict[Node, float] = {}  # of computing it from what is in memory, were the cost of operands shared evenly
    for node in order:
        for x in {x for x in node.operands if isinstance(x, Node) and x in uses}:
            uses[x].append(node)
    for node in order:
        operands = {x for x in node.operands if isinstance(x, Node) and x in uses}
        cost[node] = 0.0 if node.free else 1.0 + sum(cost[x] / len(uses[x]) for x in operands)
    stored = {node for node in roots if not node.free}
    loops: dict[Node, int] = {}  # as bits: the loops that compute a node
    bits = {node: 1 << place for place, node in enumerate(stored)}
    for node in reversed(order):
        mine = bits.get(node, 0)
        for user in uses[node]:
            mine |= bits.get(user) or loops[user]
        if node not in stored and not node.free and (mine.bit_count() - 1) * cost[node] >= STORED_COST:
            stored.add(node)
            bits[node] = 1 << len(bits)
        loops[node] = mine
    return stored


_identity_call = jax.jit(lambda x: x)


def store(value: Any) -> Any:
    """``value``, in a way that keeps XLA from computing it more than once."""
    with set_xla_metadata(inlineable="false"):
        return _identity_call(value)


def _no_operands() -> None:
    raise AssertionError("a leaf has its value from the start")


def _identity(scalar: Any) -> Any:
    if isinstance(scalar, np.generic):
        return scalar.dtype.num, scalar.tobytes()  # tells -0.0 from 0.0 and one NaN from another
    return id(scalar)


def is_constant(x: Scalar, value: complex | None = None) -> bool:
    """Whether a scalar is a constant, or the constant of that value."""
    return isinstance(x, np.generic) and (value is None or bool(x == value))


def _add(graph: Graph, a: Scalar, b: Scalar) -> Scalar | None:
    if is_constant(a, 0):
        return b
    return a if is_constant(b, 0) else None


def _sub(graph: Graph, a: Scalar, b: Scalar) -> Scalar | None:
    if is_constant(b, 0):
        return a
    return graph.apply(_NEG, b) if is_constant(a, 0) else None


def _mul(graph: Graph, a: Scalar, b: Scalar) -> Scalar | None:
    if is_constant(b):
        a, b = b, a
    if not is_constant(a):
        return None
    if a == 0:
        return a
    if a == 1:
        return b
    return graph.apply(_NEG, b) if a == -1 and a.dtype.kind == "f" else None


def _div(graph: Graph, a: Scalar, b: Scalar) -> Scalar | None:
    return a if is_constant(b, 1) else None


def _bitwise(ends: bool) -> Callable[[Graph, Scalar, Scalar], Scalar | None]:
    """Simplification of ``and`` (``ends`` with False) or ``or`` (with True) of booleans."""

    def simplify(graph: Graph, a: Scalar, b: Scalar) -> Scalar | None:
        if a is b:
            return a
        if isinstance(b, np.bool_):
            a, b = b, a
        if not isinstance(a, np.bool_):
            return None
        return a if bool(a) == ends else b

    return simplify


def _extreme(neutral: float) -> Callable[[Graph, Scalar, Scalar], Scalar | None]:
    def simplify(graph: Graph, a: Scalar, b: Scalar) -> Scalar | None:
        if a is b or is_constant(b, neutral):
            return a
        return b if is_constant(a, neutral) else None

    return simplify


def _select_n(graph: Graph, which: Scalar, *cases: Scalar) -> Scalar | None:
    if is_constant(which):
        return cases[int(which)]
    same = all(_identity(case) == _identity(cases[0]) for case in cases)
    return cases[0] if same else None


_SIMPLIFY: dict[str, Callable[..., Scalar | None]] = {
    "add": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "and": _bitwise(False),
    "or": _bitwise(True),
    "max": _extreme(-math.inf),
    "min": _extreme(math.inf),
    "select_n": _select_n,
}
_NEG = Operation("neg", lax.neg, "neg", np.negative)
_SELECT = Operation("select_n", lax.select_n, "select_n", lambda which, *cases: cases[int(which)])
