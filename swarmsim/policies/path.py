"""Paths at equal spacing with a speed at every point, and the reference that moves along them."""

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree


@pytree
class Path:
    """A polyline at equal spacing; unused points at the end repeat the last one."""

    points_m: jax.Array  # [P, 3] ENU
    speed_m_s: jax.Array  # [P] speed limit at each point
    spacing_m: jax.Array  # [] between neighbouring points
    length_m: jax.Array  # []


@pytree
class Reference:
    """Where a follower should be now."""

    position_m: jax.Array  # [3] ENU
    velocity_m_s: jax.Array  # [3] ENU
    speed_m_s: jax.Array  # [] along the path


def resample(waypoints_m: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """Points [count, D] at equal arc length along the polyline ``waypoints_m`` [W, D], and its length [].

    Repeated waypoints are allowed, so a polyline of fewer corners is padded by repeating its last one.
    """
    steps = jnp.linalg.norm(jnp.diff(waypoints_m, axis=0), axis=-1)
    arc = jnp.concatenate([jnp.zeros(1, steps.dtype), jnp.cumsum(steps)])
    at = jnp.linspace(0.0, 1.0, count) * arc[-1]
    low = jnp.clip(jnp.searchsorted(arc, at, side="right") - 1, 0, len(steps) - 1)
    part = jnp.where(steps[low] > 0, (at - arc[low]) / jnp.where(steps[low] > 0, steps[low], 1.0), 0.0)
    points = waypoints_m[low] + jnp.clip(part, 0.0, 1.0)[:, None] * (waypoints_m[low + 1] - waypoints_m[low])
    return points, arc[-1]


def limit_speed(
    points_m: jax.Array, cruise_m_s: jax.Array, acceleration_m_s2: jax.Array | float, corner_m: float
) -> jax.Array:
    """Speed [P] that starts and ends at rest, slows at corners and never asks for more than the acceleration.

    A corner of turning angle ``a`` may be rounded within ``corner_m``: the arc that stays that close to the vertex has
    radius ``corner_m / (1/cos(a/2) - 1)``, and the lateral acceleration is ``v^2 / radius``.

    Args:
        points_m: [P, 3] at equal spacing.
        cruise_m_s: [P] upper limit.
        acceleration_m_s2: largest acceleration, along and across the path.
        corner_m: how far a corner may be cut.
    """
    steps = jnp.diff(points_m, axis=0)
    length = jnp.linalg.norm(steps, axis=-1)
    direction = steps / jnp.maximum(length, 1e-6)[:, None]
    moving = (length[:-1] > 1e-6) & (length[1:] > 1e-6)
    # a corner seen over one spacing is spread over neighbouring points; half-angle cosine from |d1 + d2| / 2
    half_cosine = jnp.clip(0.5 * jnp.linalg.norm(direction[:-1] + direction[1:], axis=-1), 1e-3, 1.0)
    radius = corner_m * half_cosine / jnp.maximum(1.0 - half_cosine, 1e-6)
    corner = jnp.where(moving, jnp.sqrt(acceleration_m_s2 * radius), jnp.inf)
    limit = jnp.concatenate([jnp.zeros(1), jnp.minimum(cruise_m_s[1:-1], corner), jnp.zeros(1)])
    arc = jnp.concatenate([jnp.zeros(1), jnp.cumsum(length)])
    slope = 2.0 * acceleration_m_s2 * arc
    squared = limit**2
    reach_forward = jax.lax.cummin(squared - slope) + slope
    reach_backward = jax.lax.cummin(squared + slope, reverse=True) - slope
    return jnp.sqrt(jnp.clip(jnp.minimum(reach_forward, reach_backward), 0.0))


def reference(path: Path, progress_m: jax.Array, speed_min_m_s: float = 0.0) -> Reference:
    """The reference at arc length ``progress_m`` [].

    ``speed_min_m_s`` keeps a reference moving that starts at rest, where the speed limit is zero.
    """
    at = jnp.clip(progress_m, 0.0, path.length_m) / jnp.maximum(path.spacing_m, 1e-6)
    low = jnp.clip(at.astype(jnp.int32), 0, path.points_m.shape[0] - 2)
    ends = jax.lax.dynamic_slice(path.points_m, (low, 0), (2, path.points_m.shape[1]))
    limits = jax.lax.dynamic_slice(path.speed_m_s, (low,), (2,))
    part = at - low
    speed = jnp.maximum(limits[0] + part * (limits[1] - limits[0]), speed_min_m_s)
    direction = (ends[1] - ends[0]) / jnp.maximum(path.spacing_m, 1e-6)
    moving = progress_m < path.length_m
    return Reference(
        position_m=ends[0] + part * (ends[1] - ends[0]),
        velocity_m_s=jnp.where(moving, speed * direction, 0.0),
        speed_m_s=jnp.where(moving, speed, 0.0),
    )
