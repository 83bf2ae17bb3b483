"""Paths at equal spacing with a speed at every point, and the reference that moves along them."""

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree

ROUNDING_TAPS = 12
REACH_MAX = 64  # points before and behind each that `rounded_above` looks at, at most


@pytree
class Path:
    """A polyline at equal spacing; unused points at the end repeat the last one."""

    points_m: jax.Array  # [P, 3] ENU
    speed_m_s: jax.Array  # [P] speed limit at each point
    spacing_m: jax.Array  # [] between neighbouring points
    length_m: jax.Array  # []
    acceleration_m_s2: jax.Array | None = None  # [P, 3] at that speed, ENU: what a follower feeds forward


@pytree
class Reference:
    """Where a follower should be now."""

    position_m: jax.Array  # [3] ENU
    velocity_m_s: jax.Array  # [3] ENU
    speed_m_s: jax.Array  # [] along the path
    acceleration_m_s2: jax.Array  # [3] ENU; zero on a path that does not tell it


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


def rounded(points_m: jax.Array, spacing_m: jax.Array, corner_m: float) -> jax.Array:
    """A polyline [P, D] at equal spacing with its corners rounded; the ends stay.

    Every point becomes the mean of the path over ``h``, twice ``corner_m``, before and behind it, less near the ends.
    Of a corner that turns by ``a`` this cuts ``h sin(a/2) / 2``, at most ``corner_m``, and makes it a parabola.
    """
    last = points_m.shape[0] - 1
    number = jnp.arange(last + 1, dtype=points_m.dtype)
    reach = jnp.minimum(2.0 * corner_m / jnp.maximum(spacing_m, 1e-6), jnp.minimum(number, last - number))

    def add(tap: jax.Array, total: jax.Array) -> jax.Array:
        at = number + reach * ((2 * tap + 1) / ROUNDING_TAPS - 1.0)  # in the middles of equal parts
        low = jnp.clip(at.astype(jnp.int32), 0, last - 1)
        return total + points_m[low] + (at - low)[:, None] * (points_m[low + 1] - points_m[low])

    return jax.lax.fori_loop(0, ROUNDING_TAPS, add, jnp.zeros_like(points_m)) / ROUNDING_TAPS


def rounded_above(values: jax.Array, reach: jax.Array) -> jax.Array:
    """Values [P] smoothed over ``reach`` [] points before and behind each, nowhere less than they were.

    The mean over that length, and where that is less somewhere nearby, so much more: the mean, over that length, of the
    greatest lack within it, among which is that of the point itself. Even slopes stay as they are. The length is at
    most `REACH_MAX`, and less near the ends.
    """
    last = values.shape[0] - 1
    number = jnp.arange(last + 1)
    whole = jnp.clip(jnp.ceil(reach).astype(jnp.int32), 1, REACH_MAX)
    near = jnp.minimum(whole, jnp.minimum(number, last - number))

    def neighbours(x: jax.Array, shift: jax.Array) -> jax.Array:
        wide = jnp.pad(x, REACH_MAX, mode="edge")
        return jax.lax.dynamic_slice(wide, (REACH_MAX + shift,), (last + 1,))

    def mean(x: jax.Array, reach: jax.Array) -> jax.Array:
        def add(shift: jax.Array, total: jax.Array) -> jax.Array:
            return total + jnp.where(jnp.abs(shift) <= reach, neighbours(x, shift), 0.0)

        return jax.lax.fori_loop(-whole, whole + 1, add, jnp.zeros_like(x)) / (2.0 * reach + 1.0)

    def greatest(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(-whole, whole + 1, lambda shift, most: jnp.maximum(most, neighbours(x, shift)), x)

    smooth = mean(values, near)
    return smooth + mean(greatest(jnp.maximum(values - smooth, 0.0)), whole)


def turning(points_m: jax.Array) -> jax.Array:
    """Change of direction over arc length [P, 3], 1/m, at the points [P, 3] of a path; zero at its ends."""
    steps = jnp.diff(points_m, axis=0)
    length = jnp.linalg.norm(steps, axis=-1, keepdims=True)
    direction = steps / jnp.maximum(length, 1e-6)
    there = (length[:-1] > 1e-6) & (length[1:] > 1e-6)
    change = jnp.where(there, direction[1:] - direction[:-1], 0.0) / jnp.maximum(0.5 * (length[1:] + length[:-1]), 1e-6)
    return jnp.pad(change, ((1, 1), (0, 0)))


def limit_in_bends(points_m: jax.Array, cruise_m_s: jax.Array, acceleration_m_s2: jax.Array) -> jax.Array:
    """Speed limit [P] ``cruise_m_s``, less in bends: ``v^2`` over their radius is limited."""
    bend = jnp.linalg.norm(turning(points_m), axis=-1)
    bend = jnp.convolve(bend, jnp.array([0.25, 0.5, 0.25]), mode="same")
    return jnp.minimum(cruise_m_s, jnp.sqrt(acceleration_m_s2 / jnp.maximum(bend, 1e-6)))


def acceleration_along(points_m: jax.Array, speed_m_s: jax.Array, limit_m_s2: jax.Array) -> jax.Array:
    """Acceleration [P, 3] of what moves along the path [P, 3] at ``speed_m_s`` [P], at most ``limit_m_s2`` []."""
    ahead = jnp.concatenate([points_m[1:], points_m[-1:]])
    behind = jnp.concatenate([points_m[:1], points_m[:-1]])
    length = jnp.maximum(jnp.linalg.norm(ahead - behind, axis=-1), 1e-6)
    energy = 0.5 * jnp.square(speed_m_s)
    change = jnp.concatenate([energy[1:], energy[-1:]]) - jnp.concatenate([energy[:1], energy[:-1]])
    along = (change / length)[:, None] * (ahead - behind) / length[:, None]
    whole = along + jnp.square(speed_m_s)[:, None] * turning(points_m)
    size = jnp.linalg.norm(whole, axis=-1, keepdims=True)
    return whole * jnp.minimum(1.0, limit_m_s2 / jnp.maximum(size, 1e-6))


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
    acceleration = jnp.zeros_like(direction)
    if path.acceleration_m_s2 is not None:
        fed = jax.lax.dynamic_slice(path.acceleration_m_s2, (low, 0), (2, path.points_m.shape[1]))
        acceleration = jnp.where(moving, fed[0] + part * (fed[1] - fed[0]), 0.0)
    return Reference(
        position_m=ends[0] + part * (ends[1] - ends[0]),
        velocity_m_s=jnp.where(moving, speed * direction, 0.0),
        speed_m_s=jnp.where(moving, speed, 0.0),
        acceleration_m_s2=acceleration,
    )
