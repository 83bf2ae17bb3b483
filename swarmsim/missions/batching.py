"""From a function of one mission to one of B missions, spread over the devices of the machine."""

import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

Axes = tuple[Any, ...]  # for each argument 0 where it has the axis of missions, None where all missions share it


def use_all_cores() -> None:
    """Make each processor core a JAX device, so that the missions of a batch are shared among them.

    Only possible before JAX has started; later, a batch runs on the devices that there are.
    """
    try:
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    except RuntimeError:
        return


def shards_of(missions: int) -> int:
    """On how many devices a batch is spread: all, as long as each gets at least two missions."""
    return max(1, min(len(jax.devices()), missions // 2))


def batched(function: Callable[..., Any], axes: Axes, missions: int, out_axes: Any = 0) -> Callable[..., Any]:
    """All missions in step, by vmap: for what runs in loops of small operations."""
    return jax.vmap(function, in_axes=axes, out_axes=out_axes, axis_size=missions)


def in_groups(function: Callable[..., Any], axes: Axes, together: int) -> Callable[..., Any]:
    """Groups of ``together`` missions after one another, each in step: bounds what is held in memory at a time."""

    def every(*arguments: Any) -> Any:
        own = [argument for argument, axis in zip(arguments, axes, strict=True) if axis == 0]

        def one(mine: list[Any]) -> Any:
            remaining = iter(mine)
            whole = (next(remaining) if axis == 0 else a for a, axis in zip(arguments, axes, strict=True))
            return function(*whole)

        return jax.lax.map(one, own, batch_size=together if together > 1 else None)

    return every


def missions_together() -> int:
    """How many missions to take in step in what fills a processor core alone: one, whose values stay in the cache.

    An accelerator has room for more, and needs them.
    """
    return 1 if jax.default_backend() == "cpu" else 256


def spread(function: Callable[..., Any], axes: Axes, shards: int) -> Callable[..., Any]:
    """A batch function of equal parts of the missions, on ``shards`` devices side by side.

    The parts do not wait for one another: a loop that ends when all missions have ended does so for each part.
    """
    if shards == 1:
        return function
    mesh = Mesh(np.array(jax.devices()[:shards]), ("mission",))
    places = tuple(PartitionSpec("mission") if axis == 0 else PartitionSpec() for axis in axes)
    return jax.shard_map(function, mesh=mesh, in_specs=places, out_specs=PartitionSpec("mission"), check_vma=False)
