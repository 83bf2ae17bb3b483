"""A traced function of one vehicle, evaluated for many; and how that is arranged on a CPU."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.extend import core

from swarmsim.scalars.control import CONTROL
from swarmsim.scalars.graph import Graph, store, varying_axes
from swarmsim.scalars.interpreter import SMALL, Interpreter, is_small


@dataclass(frozen=True)
class Program:
    """Function of one vehicle, traced."""

    jaxpr: Any
    constants: dict[Any, np.ndarray]  # values of variables that are known
    variables: tuple[Any, ...]  # constants and inputs of the jaxpr that are arguments
    unroll: int  # longest scan that is written out

    def evaluate(self, size: int, mapped: Sequence[bool], *arrays: Any, stores: bool = False) -> list[jax.Array]:
        """Results [N, ...] for N = ``size`` vehicles, as operations on scalars; ``mapped`` arguments have the axis N.

        With ``stores``, results that much depends on are kept in memory (`swarmsim.scalars.graph.to_store`).
        """
        varying: frozenset[str] = frozenset().union(*map(varying_axes, arrays))
        interpreter = Interpreter(Graph(size, varying, stores), CONTROL, self.unroll)
        known: dict[Any, Any] = dict(self.constants)
        for variable, array, of_vehicle in zip(self.variables, arrays, mapped, strict=True):
            known[variable] = interpreter.take_apart(array, of_vehicle, variable.aval)
        with np.errstate(all="ignore"):  # folded constants follow IEEE 754 without a word, as on the device
            results = interpreter.evaluate(self.jaxpr, known)
            interpreter.settle(results)
        outs = zip(results, self.jaxpr.outvars, strict=True)
        return [interpreter.mapped_array(value, variable.aval) for value, variable in outs]

    def vmapped(self, size: int, mapped: Sequence[bool], *arrays: Any) -> list[jax.Array]:
        """The same by `jax.vmap`."""

        def one(*values: Any) -> Any:
            known = {**self.constants, **dict(zip(self.variables, values, strict=True))}
            consts = [known[v] for v in self.jaxpr.constvars]
            return core.jaxpr_as_fun(core.ClosedJaxpr(self.jaxpr, consts))(*[known[v] for v in self.jaxpr.invars])

        axes = [0 if of_vehicle else None for of_vehicle in mapped]
        results: list[jax.Array] = jax.vmap(one, in_axes=axes, axis_size=size)(*arrays)
        return results


def on_cpu(program: Program, size: int, mapped: Sequence[bool]) -> Callable[..., list[jax.Array]]:
    """``program.evaluate`` as a CPU wants it.

    Derivatives are those of `Program.vmapped`, because written out in scalars they take three times as long to compile
    and half as long again to run. Under `jax.vmap` the axes (mission, vehicle) become one, because XLA's vector
    instructions cover the last axis, and there are few vehicles in a mission.
    """
    direct = partial(program.evaluate, size, mapped, stores=True)
    batched = custom_vmap(direct)

    @batched.def_vmap
    def of_missions(missions: int, own: Sequence[bool], *arrays: Any) -> tuple[list[jax.Array], list[bool]]:
        if not any(own):
            return direct(*arrays), [False] * len(program.jaxpr.outvars)
        every = [True] * len(program.jaxpr.outvars)
        if not _can_join(program, mapped, own):
            return jax.vmap(direct, in_axes=[0 if x else None for x in own])(*arrays), every
        joined = [_joined(x, missions, size, *flags) for x, *flags in zip(arrays, mapped, own, strict=True)]
        either = [a or b for a, b in zip(mapped, own, strict=True)]
        results = on_cpu(program, missions * size, either)(*joined)
        return [x.reshape(missions, size, *x.shape[1:]) for x in results], every

    whole = jax.custom_jvp(lambda *arrays: batched(*arrays))
    whole.defjvp(partial(jax.jvp, partial(program.vmapped, size, mapped)))
    return whole


def _can_join(program: Program, mapped: Sequence[bool], own: Sequence[bool]) -> bool:
    """Whether every argument that has one of the axes is small enough to be repeated along the other."""
    repeated = zip(program.variables, mapped, own, strict=True)
    return all(is_small(v.aval, SMALL) for v, of_vehicle, of_mission in repeated if of_vehicle != of_mission)


def _joined(array: Any, missions: int, size: int, of_vehicle: bool, of_mission: bool) -> Any:
    """Argument with the axis (mission, vehicle), or as it is if it has neither axis."""
    if not (of_vehicle or of_mission):
        return array
    if not of_mission:
        array = store(jnp.broadcast_to(array, (missions, *array.shape)))
    elif not of_vehicle:
        array = store(jnp.broadcast_to(array[:, None], (missions, size, *array.shape[1:])))
    return array.reshape(missions * size, *array.shape[2:])
