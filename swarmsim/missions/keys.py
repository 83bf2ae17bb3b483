"""Randomness: a mission's numbers come from its own seed alone, each consumer folds in its own name.

So a mission gives the same result alone, in a batch, in any segment length and at any place in a sweep.
"""

import zlib

import jax
import jax.numpy as jnp
import numpy as np


def consumer(mission_key: jax.Array, name: str) -> jax.Array:
    """Key of one consumer of a mission's randomness, such as ``"gusts"``."""
    return jax.random.fold_in(mission_key, zlib.crc32(name.encode()) & 0x7FFFFFFF)


def per_tick(key: jax.Array, ticks: jax.Array, vehicles: int) -> jax.Array:
    """Keys [T, vehicles] for the ticks numbered ``ticks`` [T], independent of how ticks are grouped."""

    def one(tick: jax.Array, vehicle: jax.Array) -> jax.Array:
        return jax.random.fold_in(jax.random.fold_in(key, tick), vehicle)

    return jax.vmap(lambda tick: jax.vmap(lambda vehicle: one(tick, vehicle))(jnp.arange(vehicles)))(ticks)


def mission_keys(seeds: jax.Array | np.ndarray) -> jax.Array:
    """Keys [B] of the missions' seeds [B] (uint32)."""
    return jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))
