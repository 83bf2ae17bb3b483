"""Attitudes: unit quaternions (w x y z, body to world) and rotation matrices."""

import jax
import jax.numpy as jnp


def rotate(q: jax.Array, v: jax.Array) -> jax.Array:
    """Body vector ``v`` [..., 3] in the world frame; ``q`` [..., 4]."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * jnp.cross(u, v)
    return v + w * t + jnp.cross(u, t)


def rotate_inverse(q: jax.Array, v: jax.Array) -> jax.Array:
    """World vector ``v`` [..., 3] in the body frame; ``q`` [..., 4]."""
    return rotate(conjugate(q), v)


def rotation_matrix(q: jax.Array) -> jax.Array:
    """Matrix [3, 3], body to world, of the unit quaternion ``q`` [4]."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return jnp.stack(
        [
            jnp.stack([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)]),
            jnp.stack([2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)]),
            jnp.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)]),
        ]
    )


def to_world(matrix: jax.Array, v: jax.Array) -> jax.Array:
    """Body vectors ``v`` [..., 3] in the world frame of the attitude ``matrix`` [3, 3].

    Written out, because a dot product of this size would be a kernel of its own.
    """
    return v[..., :1] * matrix[:, 0] + v[..., 1:2] * matrix[:, 1] + v[..., 2:] * matrix[:, 2]


def to_body(matrix: jax.Array, v: jax.Array) -> jax.Array:
    """World vectors ``v`` [..., 3] in the body frame of the attitude ``matrix`` [3, 3]."""
    return v[..., :1] * matrix[0] + v[..., 1:2] * matrix[1] + v[..., 2:] * matrix[2]


def conjugate(q: jax.Array) -> jax.Array:
    """Inverse of the unit quaternion ``q`` [..., 4]."""
    return q * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Hamilton product a b [..., 4]: the rotation ``b`` followed by ``a``."""
    aw, av = a[..., :1], a[..., 1:]
    bw, bv = b[..., :1], b[..., 1:]
    w = aw * bw - jnp.sum(av * bv, axis=-1, keepdims=True)
    return jnp.concatenate([w, aw * bv + bw * av + jnp.cross(av, bv)], axis=-1)


def from_rotation_vector(r: jax.Array) -> jax.Array:
    """Exponential map of a rotation vector ``r`` [..., 3] in rad; smooth at zero."""
    half_squared = 0.25 * jnp.sum(r * r, axis=-1, keepdims=True)
    small = half_squared < 1e-8
    half = jnp.sqrt(jnp.where(small, 1.0, half_squared))
    sinc = jnp.where(small, 1.0 - half_squared / 6.0, jnp.sin(half) / half)
    cosine = jnp.where(small, 1.0 - 0.5 * half_squared, jnp.cos(half))
    return jnp.concatenate([cosine, 0.5 * sinc * r], axis=-1)


def from_yaw(yaw: jax.Array) -> jax.Array:
    """Quaternion [..., 4] of a heading ``yaw`` [...] in rad, counter-clockwise from east."""
    zero = jnp.zeros_like(yaw)
    return jnp.stack([jnp.cos(0.5 * yaw), zero, zero, jnp.sin(0.5 * yaw)], axis=-1)


def yaw_of(q: jax.Array) -> jax.Array:
    """Heading [...] in rad of ``q`` [..., 4]."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return jnp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def normalise(q: jax.Array) -> jax.Array:
    """``q`` [..., 4] scaled to unit length."""
    return q / jnp.linalg.norm(q, axis=-1, keepdims=True)
