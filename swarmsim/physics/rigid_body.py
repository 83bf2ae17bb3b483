"""One step of a free rigid body in closed form."""

import jax
import jax.numpy as jnp

from swarmsim.physics.rotations import from_rotation_vector, multiply, normalise
from swarmsim.vehicles.state import GRAVITY_M_S2, RigidState


def free_body_step(
    body: RigidState,
    *,
    mass_kg: jax.Array,
    inertia_kg_m2: jax.Array,
    force_n: jax.Array,
    torque_nm: jax.Array,
    dt: float,
) -> RigidState:
    """State after ``dt`` s under gravity, ``force_n`` [3] (N, world) and ``torque_nm`` [3] (N m, body).

    Semi-implicit Euler as in MuJoCo: velocities first, with the gyroscopic torque of the old ones; then the pose with
    the new velocities, the attitude by the exponential map. ``inertia_kg_m2`` [3] are the principal moments about the
    body axes, ``mass_kg`` [] the mass.
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
