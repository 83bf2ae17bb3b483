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


def per_vehicle(key: jax.Array, number: jax.Array, member: jax.Array) -> jax.Array:
    """Keys [U] of the vehicles numbered ``member`` [U] at the occasion ``number`` [] of a consumer."""
    occasion = jax.random.fold_in(key, number)
    return jax.vmap(lambda vehicle: jax.random.fold_in(occasion, vehicle))(member)


def mission_keys(seeds: jax.Array | np.ndarray) -> jax.Array:
    """Keys [B] of the missions' seeds [B] (uint32)."""
    return jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))
