"""Randomness: a mission's numbers come from its own seed alone, each consumer folds in its own name.

So a mission gives the same result alone, in a batch, in any segment length and at any place in a sweep.
"""

import zlib

import jax
import jax.numpy as jnp


def consumer(mission_key: jax.Array, name: str) -> jax.Array:
    """Key of one consumer of a mission's randomness, such as ``"gusts"``."""
    return jax.random.fold_in(mission_key, zlib.crc32(name.encode()) & 0x7FFFFFFF)


def normals(key: jax.Array, ticks: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Standard normal numbers [T, *shape] of the ticks numbered ``ticks`` [T], independent of how ticks are grouped."""
    return jax.vmap(lambda tick: jax.random.normal(jax.random.fold_in(key, tick), shape))(ticks)


def mission_keys(seeds: jax.Array) -> jax.Array:
    """Keys [B] of the missions' seeds [B] (uint32)."""
    return jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))
