"""Dataclasses that are JAX pytrees: the one way in which swarmsim declares states, parameters and results."""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax
import numpy as np

T = TypeVar("T")


def on_host(value: Any, dtype: Any = np.float32) -> Any:
    """A leaf made on the host: a numpy array, which compiled functions take as they take one of JAX.

    Building with `jax.numpy` would compile a small program for each operation.
    """
    return np.asarray(value, dtype)


def on_device(value: Any, dtype: Any = np.float32) -> jax.Array:
    """An array of JAX, made on the host and put on the device: `jnp.asarray` compiles a program for each shape."""
    return jax.device_put(np.asarray(value, dtype))


def static(**kwargs: Any) -> Any:
    """A field that is not traced: changing it compiles anew."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(static,))
def pytree(cls: type[T]) -> type[T]:
    """Make ``cls`` a frozen, keyword-only dataclass whose fields are pytree leaves, except those marked `static`."""
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True, kw_only=True)(cls))
