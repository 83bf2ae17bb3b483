"""`over_vehicles`: a function of one vehicle, mapped over many as operations on scalars.

`jax.vmap` of a one-vehicle function works on arrays [N, 3], [N, 3, 3], [N, 4], which XLA splits into many kernels that
pass intermediates through memory. Here every small array of the function is taken apart into scalars of shape [N], so
that nearly everything is elementwise and is fused.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.scalars.interpreter import UNROLL, is_foldable
from swarmsim.scalars.kernel import on_gpu
from swarmsim.scalars.program import Program, on_cpu

Layout = Literal["scalars", "vmap"]
LAYOUTS: tuple[Layout, ...] = ("scalars", "vmap")
_ARRANGED: dict[str, Callable[..., Any]] = {
    "cpu": lambda program, size, mapped, _: on_cpu(program, size, mapped),
    "gpu": on_gpu,
    "gpu, interpreted": partial(on_gpu, interpret=True),  # for tests of the kernels
}


def over_vehicles(
    function: Callable[..., Any],
    in_axes: Any = 0,
    layout: Layout = "scalars",
    *,
    unroll: int = UNROLL,
    returned: Sequence[int] = (),
    platform: str | None = None,
) -> Callable[..., Any]:
    """`jax.vmap` of a function of one vehicle, by default as operations on scalars [N].

    Results are those of `jax.vmap` but for rounding, with these exceptions, which are those of algebra on real numbers:
    an addition of zero and a multiplication by one are dropped, a multiplication by a *constant* zero is zero even for
    a factor that is infinite or NaN, and what nothing uses is not computed. `jit`, `vmap`, `scan`, `grad` (of every
    kind) and `shard_map` work on the result; call it inside a `jit`.

    Arrays that all vehicles share (axis None) are traced values if they are, and otherwise constants, which are folded:
    pass parameters as numpy arrays to have them compiled in. So are mapped arrays that are known while tracing and are
    the same for all vehicles. Arrays of more than 64 elements are not taken apart, nor
    are operations that have no form in scalars (random bits, sorting, linear solvers): these are vmapped one by one.

    Args:
        function: pure, of one vehicle; of arrays and pytrees of them.
        in_axes: as of `jax.vmap`: an axis or None, or a tuple of these or of pytree prefixes for each argument.
            Keyword arguments are mapped over axis 0. All results have the vehicles' axis in front.
        layout: ``scalars``, or ``vmap`` for `jax.vmap` itself.
        unroll: longest `jax.lax.scan` inside ``function`` that is written out; longer ones carry scalars.
        returned: numbers of the arguments, all of them mapped, that come back as the first results, leaf for leaf: a
            kernel of a GPU then writes them in place, which saves a loop around it a copy.
        platform: that the program will run on, by default JAX's own; see `swarmsim.scalars.program.on_cpu`.

    Raises:
        ValueError: for an unknown layout, or, when called, for arguments that do not fit ``in_axes``.
    """
    if layout not in LAYOUTS:
        raise ValueError(f"there is no layout '{layout}': choose one of {', '.join(LAYOUTS)}")
    if layout == "vmap":
        return jax.vmap(function, in_axes=in_axes)

    @wraps(function, updated=())
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
        alike = _alike(moved, leaf_axes, args, returned)
        program, arrays, structure = _program(function, tree, moved, varied, alike, unroll)
        own = sum(varied) - len(alike)
        of_vehicle = [False] * (len(arrays) - own) + [True] * own
        arranged = _ARRANGED.get(platform or jax.default_backend())
        evaluate = partial(program.evaluate, size, of_vehicle)
        if arranged:
            axes_left = [None if number in alike else axis for number, axis in enumerate(leaf_axes)]
            evaluate = arranged(program, size, of_vehicle, _places(args, returned, axes_left, len(arrays)))
        return jax.tree.unflatten(structure, evaluate(*arrays))

    return mapped


def _leaf_axes(axes: tuple[Any, ...], args: tuple[Any, ...]) -> list[int | None]:
    """Axis of each leaf of ``args``."""
    found: list[int | None] = []

    def add(axis: int | None, part: Any) -> None:
        found.extend([axis] * len(jax.tree.leaves(part)))

    jax.tree.map(add, axes, args, is_leaf=lambda x: x is None)
    return found


def _alike(leaves: list[Any], axes: list[int | None], args: Sequence[Any], returned: Sequence[int]) -> dict[int, Any]:
    """For the mapped leaves (by number) that are known and the same for all vehicles, the value of one vehicle.

    XLA takes such a constant for a broadcast, which it computes anew wherever a kernel reads it: for the parameters of
    a team of one kind this is thirty launches at each control period.
    """
    ends = [0, *itertools.accumulate(len(jax.tree.leaves(arg)) for arg in args)]
    kept = {leaf for number in returned for leaf in range(ends[number], ends[number + 1])}
    found = {}
    for number, (leaf, axis) in enumerate(zip(leaves, axes, strict=True)):
        if axis is None or number in kept or not len(leaf):
            continue
        kind = jax.typeof(leaf)
        if not is_foldable(leaf, jax.ShapeDtypeStruct(kind.shape[1:], kind.dtype)):
            continue
        every = np.ascontiguousarray(leaf, kind.dtype)
        bits = every.view(np.uint8) if every.ndim > 1 and every.size else every[:, None].view(np.uint8)
        if (bits == bits[:1]).all():  # of the bits: -0.0 is not 0.0, and NaN is NaN
            found[number] = every[:1].reshape(every.shape[1:]).copy()
    return found


def _places(args: Sequence[Any], returned: Sequence[int], axes: Sequence[int | None], arrays: int) -> list[int]:
    """Where the leaves of some arguments stand among a program's arrays, of which the mapped leaves are the last."""
    first = arrays - sum(axis is not None for axis in axes)
    ends = [0, *itertools.accumulate(len(jax.tree.leaves(arg)) for arg in args)]
    leaves = [leaf for number in returned for leaf in range(ends[number], ends[number + 1])]
    return [first + sum(axis is not None for axis in axes[:leaf]) for leaf in leaves]


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


def _program(
    function: Callable[..., Any], tree: Any, leaves: list[Any], varied: list[bool], alike: dict[int, Any], unroll: int
) -> Any:
    """The function of one vehicle as a `Program` with its arguments, and the structure of its results.

    Leaves that are ``alike`` are traced like the others that are ``varied``, and are constants of the program.
    """
    inputs = [x for x, of_vehicle in zip(leaves, varied, strict=True) if of_vehicle]
    types = [jax.typeof(x) for x in inputs]
    one = [jax.ShapeDtypeStruct(t.shape[1:], t.dtype, weak_type=t.weak_type) for t in types]

    def of_one(*own: Any) -> Any:
        entries = iter(own)
        every = [next(entries) if of_vehicle else x for x, of_vehicle in zip(leaves, varied, strict=True)]
        args, kwargs = jax.tree.unflatten(tree, every)
        return function(*args, **kwargs)

    closed, shape = jax.make_jaxpr(of_one, return_shape=True)(*one)
    constants, variables, arrays = {}, [], []
    for variable, value in zip(closed.jaxpr.constvars, closed.consts, strict=True):
        if is_foldable(value, variable.aval):
            constants[variable] = np.asarray(value, variable.aval.dtype)
        else:
            variables.append(variable)
            arrays.append(value)
    numbers = [number for number, of_vehicle in enumerate(varied) if of_vehicle]
    for number, variable, value in zip(numbers, closed.jaxpr.invars, inputs, strict=True):
        if number in alike:
            constants[variable] = alike[number]
        else:
            variables.append(variable)
            arrays.append(value)
    program = Program(closed.jaxpr, constants, tuple(variables), unroll)
    return program, arrays, jax.tree.structure(shape)
