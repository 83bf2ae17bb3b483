"""A program to compile, and a process that has compiled nothing."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.pytree import pytree, static
from swarmsim.runtime import programs
from swarmsim.runtime.executables import Executables
from swarmsim.runtime.programs import Program


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drop this process's executables, as a new process would have none."""
    monkeypatch.setattr(programs, "_EXECUTABLES", Executables(most=256))


@pytree
class State:
    position: Any
    key: Any
    act: Any = static(default=jnp.tanh)


def walk(state: State, empty: jax.Array) -> tuple[State, jax.Array, dict[str, Any]]:
    """A step with a random key, a static function, a zero-sized array, None and a dictionary."""
    key, use = jax.random.split(state.key)
    moved = state.act(state.position + jax.random.normal(use, state.position.shape))
    return State(position=moved, key=key, act=state.act), empty, {"none": None, "sum": moved.sum()}


def start() -> tuple[State, jax.Array]:
    return State(position=jnp.arange(4.0), key=jax.random.key(1)), jnp.zeros((0, 3))


def bits(tree: Any) -> list[bytes]:
    def data(leaf: Any) -> np.ndarray:
        is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if is_key else leaf)

    return [data(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


def scaled(factor: float) -> Any:
    return lambda x: x * factor


def key_of(program: Program, argument: Any) -> str | None:
    return program._key(*jax.tree.flatten((argument,)))
