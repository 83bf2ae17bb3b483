"""Where the true sources are, and how strong, at a time of the mission."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.physics.rotations import rotate
from swarmsim.pytree import pytree
from swarmsim.radiation.detector import Source
from swarmsim.vehicles.state import RigidState


@pytree
class Emission:
    """What the points of `World.sources` are of, and what becomes of them; P points, the last C of them carried."""

    decay_1_s: jax.Array  # [P] decay constant
    number: jax.Array  # [P] int32: source of the mission that a point belongs to
    carrier: jax.Array | None  # [C] int32: their vehicles, as rows of all groups after one another; None: no carrier
    corners_m: jax.Array | None  # [K, 3] corners of all lines and areas, world; None: there are none
    corner_of: jax.Array | None  # [K] int32: source of the mission that a corner belongs to


@pytree
class Poses:
    """Poses of the C carriers."""

    position_m: jax.Array  # [C, 3] world
    quaternion: jax.Array  # [C, 4] w x y z, body to world


def poses_of(emission: Emission, bodies: Sequence[RigidState]) -> Poses | None:
    """Poses of the carriers, where there are any; ``bodies`` [U] are those of each group."""
    if emission.carrier is None:
        return None
    row = jnp.asarray(emission.carrier)
    position, quaternion = ([getattr(body, name) for body in bodies] for name in ("position_m", "quaternion"))
    return Poses(position_m=jnp.concatenate(position)[row], quaternion=jnp.concatenate(quaternion)[row])


def between(before: Poses | None, after: Poses | None, share: jax.Array) -> Poses | None:
    """The poses at ``share`` [] of the way from one to the other, straight and with an even turn.

    Over a judging period of 0.05 s at 10 m/s2 this is within 4 mm.
    """
    if before is None or after is None:
        return None
    nearer = jnp.sign(jnp.sum(before.quaternion * after.quaternion, axis=-1, keepdims=True) + 1e-12)
    turned = (1.0 - share) * before.quaternion + share * nearer * after.quaternion
    return Poses(
        position_m=(1.0 - share) * before.position_m + share * after.position_m,
        quaternion=turned / jnp.sqrt(jnp.sum(turned * turned, axis=-1, keepdims=True) + 1e-12),
    )


def sources_at(sources: Source, emission: Emission, time_s: jax.Array, poses: Poses | None) -> Source:
    """The points [P] at ``time_s`` [] after the start, with activities A exp(-ln2 t / T), all in world coordinates.

    ``sources`` and ``emission`` are those of a `World`; ``poses`` are its carriers' then, None where it has none.

    Raises:
        ValueError: while tracing, where a world with carried sources is asked without their poses.
    """
    left = replace(sources, activity_bq=sources.activity_bq * jnp.exp(-emission.decay_1_s * time_s))
    if emission.carrier is None:
        return left
    if poses is None:
        raise ValueError("the world has sources on vehicles: give their poses")
    standing = sources.position_m.shape[0] - emission.carrier.shape[0]
    carried = poses.position_m + rotate(poses.quaternion, jnp.asarray(sources.position_m)[standing:])
    return replace(left, position_m=jnp.concatenate([jnp.asarray(sources.position_m)[:standing], carried]))
