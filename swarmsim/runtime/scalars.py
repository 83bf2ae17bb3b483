"""`over_vehicles`: a function of one vehicle, mapped over many as operations on scalars.

`jax.vmap` of a one-vehicle function works on arrays [N, 3], [N, 3, 3], [N, 4], which XLA splits into many kernels that
pass intermediates through memory. Here every small array of the function is taken apart into scalars of shape [N], so
that nearly everything is elementwise and is fused.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.runtime.scalar_control import CONTROL
from swarmsim.runtime.scalar_graph import Graph, varying_axes
from swarmsim.runtime.scalar_interpreter import UNROLL, Interpreter

Layout = Literal["scalars", "vmap"]
LAYOUTS = ("scalars", "vmap")


def over_vehicles(
    function: Callable[..., Any], in_axes: Any = 0, layout: Layout = "scalars", *, unroll: int = UNROLL
) -> Callable[..., Any]:
    """`jax.vmap` of a function of one vehicle, by default as operations on scalars [N].

    Results are those of `jax.vmap` but for rounding, with these exceptions, which are those of algebra on real numbers:
    an addition of zero and a multiplication by one are dropped, a multiplication by a *constant* zero is zero even for
    a factor that is infinite or NaN, and what nothing uses is not computed. `jit`, `vmap`, `scan`, `grad` (of every
    kind) and `shard_map` work on the result; call it inside a `jit`.

    Arrays that all vehicles share (axis None) are traced values if they are, and otherwise constants, which are folded:
    pass parameters as numpy arrays to have them compiled in. Arrays of more than 64 elements are not taken apart, nor
    are operations that have no form in scalars (random bits, sorting, linear solvers): these are vmapped one by one.

    Args:
        function: pure, of one vehicle; of arrays and pytrees of them.
        in_axes: as of `jax.vmap`: an axis or None, or a tuple of these or of pytree prefixes for each argument.
            Keyword arguments are mapped over axis 0. All results have the vehicles' axis in front.
        layout: ``scalars``, or ``vmap`` for `jax.vmap` itself.
        unroll: longest `jax.lax.scan` inside ``function`` that is written out; longer ones carry scalars.

    Raises:
        ValueError: for an unknown layout, or, when called, for arguments that do not fit ``in_axes``.
    """
    if layout not in LAYOUTS:
        raise ValueError(f"there is no layout '{layout}': choose one of {', '.join(LAYOUTS)}")
    if layout == "vmap":
        return jax.vmap(function, in_axes=in_axes)

    @functools.wraps(function, updated=())
    def mapped(*args: Any, **kwargs: Any) -> Any:
        axes = tuple(in_axes) if isinstance(in_axes, (tuple, list)) else (in_axes,) * len(args)
        if len(axes) != len(args):
            raise ValueError(f"in_axes has {len(axes)} entries for {len(args)} arguments")
        leaves, tree = jax.tree.flatten((args, kwargs))
        leaf_axes = _leaf_axes(axes, args) + [0] * len(jax.tree.leaves(kwargs))
        size = _vehicles(leaves, leaf_axes)
        moved = [
            x if axis in (None, 0) else jnp.moveaxis(x, axis, 0) for x, axis in zip(leaves, leaf_axes, strict=True)
        ]
        varied = [axis is not None for axis in leaf_axes]
        return _evaluate(function, tree, moved, varied, size, unroll)

    return mapped


def _leaf_axes(axes: tuple[Any, ...], args: tuple[Any, ...]) -> list[int | None]:
    """Axis of each leaf of ``args``."""
    found: list[int | None] = []

    def add(axis: int | None, part: Any) -> None:
        found.extend([axis] * len(jax.tree.leaves(part)))

    jax.tree.map(add, axes, args, is_leaf=lambda x: x is None)
    return found


def _vehicles(leaves: list[Any], axes: list[int | None]) -> int:
    """Number of vehicles."""
    sizes = set()
    for leaf, axis in zip(leaves, axes, strict=True):
        if axis is not None:
            if not -np.ndim(leaf) <= axis < np.ndim(leaf):
                raise ValueError(f"an argument of shape {np.shape(leaf)} has no axis {axis} to map over")
            sizes.add(np.shape(leaf)[axis])
    if len(sizes) != 1:
        raise ValueError(f"mapped axes must have one size; found {sorted(sizes) or 'no mapped argument'}")
    return sizes.pop()


def _evaluate(
    function: Callable[..., Any], tree: Any, leaves: list[Any], varied: list[bool], size: int, unroll: int
) -> Any:
    """Results of ``function`` for the leaves of its arguments, of which those that are ``varied`` have axis N."""
    inputs = [x for x, of_vehicle in zip(leaves, varied, strict=True) if of_vehicle]
    types = [jax.typeof(x) for x in inputs]
    one = [jax.ShapeDtypeStruct(t.shape[1:], t.dtype, weak_type=t.weak_type) for t in types]

    def of_one(*own: Any) -> Any:
        entries = iter(own)
        every = [next(entries) if of_vehicle else x for x, of_vehicle in zip(leaves, varied, strict=True)]
        args, kwargs = jax.tree.unflatten(tree, every)
        return function(*args, **kwargs)

    closed, shape = jax.make_jaxpr(of_one, return_shape=True)(*one)
    shared = [x for x in closed.consts if isinstance(x, jax.Array)]
    varying = frozenset().union(*map(varying_axes, [*inputs, *shared]))
    interpreter = Interpreter(Graph(size, varying, stores=jax.default_backend() == "cpu"), CONTROL, unroll)
    values = [interpreter.take_apart(x, True, v.aval) for x, v in zip(inputs, closed.jaxpr.invars, strict=True)]
    with np.errstate(all="ignore"):  # folded constants follow IEEE 754 without a word, as on the device
        results = interpreter.run(closed, values)
        interpreter.settle(results)
    arrays = [interpreter.mapped_array(r, v.aval) for r, v in zip(results, closed.jaxpr.outvars, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(shape), arrays)
