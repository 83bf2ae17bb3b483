"""Where the vehicles that carry sources have been: the spectra that are drawn at the end of a mission need it."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree
from swarmsim.world.emission import Poses, between, poses_of
from swarmsim.world.model import World
from swarmsim.world.state import WorldState, now_s


@pytree
class Trail:
    """Poses of the C carriers at T times: at the start, and at the end of each decision period of a running phase."""

    used: jax.Array  # [] int32: rows that are filled
    time_s: jax.Array  # [T] inf: not filled
    poses: Poses  # [T, C]


def trail_start(world: World, state: WorldState, rows: int) -> Trail | None:
    """A trail of the start alone, with room for ``rows`` (static); None where no source is carried."""
    poses = poses_of(world.emission, [g.vehicle.body for g in state.groups])
    if poses is None:
        return None
    return Trail(
        used=jnp.int32(1),
        time_s=jnp.full(rows, jnp.inf).at[0].set(now_s(world, state)),
        poses=jax.tree.map(lambda x: jnp.broadcast_to(x, (rows, *x.shape)), poses),
    )


def followed(world: World, trail: Trail | None, state: WorldState, runs: jax.Array) -> Trail | None:
    """The trail with the poses of now, if a phase ``runs`` []; a full one stays as it is."""
    poses = poses_of(world.emission, [g.vehicle.body for g in state.groups])
    if trail is None or poses is None:
        return trail
    row = jnp.where(runs, trail.used, trail.time_s.shape[0])
    return replace(
        trail,
        used=jnp.minimum(trail.used + runs, trail.time_s.shape[0]),
        time_s=trail.time_s.at[row].set(now_s(world, state), mode="drop"),
        poses=jax.tree.map(lambda x, new: x.at[row].set(new, mode="drop"), trail.poses, poses),
    )


def poses_at(trail: Trail | None, time_s: jax.Array) -> Poses | None:
    """The poses at ``time_s`` [], between the two rows around it; that of the first or last row beyond them."""
    if trail is None:
        return None
    after = jnp.clip(jnp.searchsorted(trail.time_s, time_s), 1, jnp.maximum(trail.used - 1, 1))
    start, end = trail.time_s[after - 1], trail.time_s[after]
    share = jnp.where(jnp.isfinite(end), jnp.clip((time_s - start) / jnp.maximum(end - start, 1e-6), 0.0, 1.0), 0.0)
    before, next_one = (jax.tree.map(lambda x, k=k: x[k], trail.poses) for k in (after - 1, after))
    return between(before, next_one, share)
