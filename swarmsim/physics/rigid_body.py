"""A free rigid body: its attitude matrix and one step of its motion in closed form."""

import jax
import jax.numpy as jnp

from swarmsim.physics.rotations import from_rotation_vector, multiply, normalise
from swarmsim.vehicles.state import GRAVITY_M_S2, RigidState


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
    """Body vector ``v`` [3] in the world frame; a sum, because a dot of this size would be a kernel of its own."""
    return jnp.sum(matrix * v, axis=-1)


def to_body(matrix: jax.Array, v: jax.Array) -> jax.Array:
    """World vector ``v`` [3] in the body frame of the attitude ``matrix`` [3, 3]."""
    return jnp.sum(matrix * v[:, None], axis=0)


def free_body_step(
    body: RigidState,
    *,
    mass_kg: jax.Array,
    inertia_kg_m2: jax.Array,
    force_n: jax.Array,
    torque_nm: jax.Array,
    dt: float,
) -> RigidState:
    """The body ``dt`` s later under gravity, ``force_n`` [3] (world) and ``torque_nm`` [3] (body).

    The scheme is MuJoCo's semi-implicit Euler: velocities first, with the gyroscopic term of the old ones; then the
    pose with the new velocities, the attitude by the exponential map. ``inertia_kg_m2`` [3] is principal along the
    body axes.
    """
    w = body.angular_velocity_rad_s
    momentum = inertia_kg_m2 * w
    gravity = jnp.array([0.0, 0.0, -GRAVITY_M_S2], force_n.dtype)
    velocity = body.velocity_m_s + dt * (force_n / mass_kg + gravity)
    angular_velocity = w + dt * (torque_nm - jnp.cross(w, momentum)) / inertia_kg_m2
    return RigidState(
        position_m=body.position_m + dt * velocity,
        quaternion=normalise(multiply(body.quaternion, from_rotation_vector(dt * angular_velocity))),
        velocity_m_s=velocity,
        angular_velocity_rad_s=angular_velocity,
    )
