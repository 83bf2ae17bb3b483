"""One step of a free rigid body in closed form."""

import jax
import jax.numpy as jnp

from swarmsim.physics.rotations import from_rotation_vector, multiply, normalise, rotation_matrix, to_body, to_world
from swarmsim.vehicles.state import GRAVITY_M_S2, RigidState


def free_body_step(
    body: RigidState,
    *,
    mass_kg: jax.Array,
    inertia_kg_m2: jax.Array,
    principal_axes: jax.Array | None,
    force_n: jax.Array,
    torque_nm: jax.Array,
    rotor_momentum_nms: jax.Array,
    first: jax.Array,
    dt: float,
) -> RigidState:
    """State after ``dt`` s under gravity, ``force_n`` [3] (N, world) and ``torque_nm`` [3] (N m, body).

    The share ``first`` [] of the change of velocity comes before the motion and the rest after it. One half is exact
    under a constant force (kick, drift, kick), and all of it is the semi-implicit Euler scheme, which keeps stiff
    contacts stable; the rate is that of `rates_after`. ``mass_kg`` [] is the mass, ``inertia_kg_m2`` [3] the principal
    moments, ``principal_axes`` the quaternion [4] from their axes to the body's (None: they are the body's),
    ``rotor_momentum_nms`` [] the angular momentum of the rotors along body z, relative to the body.
    """
    gravity = jnp.array([0.0, 0.0, -GRAVITY_M_S2], force_n.dtype)
    change = dt * (force_n / mass_kg + gravity)
    turning, rate = rates_after(
        body.angular_velocity_rad_s, inertia_kg_m2, principal_axes, torque_nm, rotor_momentum_nms, first, dt
    )
    return RigidState(
        position_m=body.position_m + dt * (body.velocity_m_s + first * change),
        quaternion=normalise(multiply(body.quaternion, from_rotation_vector(dt * turning))),
        velocity_m_s=body.velocity_m_s + change,
        angular_velocity_rad_s=rate,
    )


def rates_after(
    rate_rad_s: jax.Array,
    inertia_kg_m2: jax.Array,
    principal_axes: jax.Array | None,
    torque_nm: jax.Array,
    rotor_momentum_nms: jax.Array,
    first: jax.Array,
    dt: float,
) -> tuple[jax.Array, jax.Array]:
    """Mean body rate [3] during a step of ``dt`` s and body rate [3] after it; arguments as in `free_body_step`.

    The torque [3] (body) acts at once, the share ``first`` [] of it before the body turns and the rest after that. It
    turns freely in five exact rotations about its principal axes, in the order x, y, z, y, x (Dullweber, Leimkuhler and
    McLachlan, "Symplectic splitting methods for rigid body molecular dynamics", J. Chem. Phys. 107(15), 1997). Length
    of the angular momentum and energy do not drift; Euler's step with the gyroscopic torque of the old rate gains
    energy at every step. Rotors with an angular momentum relative to the body make it a gyrostat, whose rotation about
    an axis is slower by the rotors' share along it.
    """
    if principal_axes is None:
        return _principal_rates_after(rate_rad_s, inertia_kg_m2, torque_nm, (0.0, 0.0, rotor_momentum_nms), first, dt)
    axes = rotation_matrix(principal_axes)
    rotors = rotor_momentum_nms * axes[2]
    rate, torque = to_body(axes, rate_rad_s), to_body(axes, torque_nm)
    turning, after = _principal_rates_after(rate, inertia_kg_m2, torque, (rotors[0], rotors[1], rotors[2]), first, dt)
    return to_world(axes, turning), to_world(axes, after)


def _principal_rates_after(
    rate_rad_s: jax.Array,
    inertia_kg_m2: jax.Array,
    torque_nm: jax.Array,
    rotors_nms: tuple[jax.Array | float, jax.Array | float, jax.Array],
    first: jax.Array,
    dt: float,
) -> tuple[jax.Array, jax.Array]:
    """`rates_after` with all vectors along the principal axes."""
    inverse = 1.0 / inertia_kg_m2  # of parameters alone, so that a loop of steps divides once
    kick = dt * torque_nm * inverse
    kicked = rate_rad_s + first * kick
    of_x, of_y, of_z = rotors_nms
    x, y, z = (kicked[axis] * inertia_kg_m2[axis] + rotors_nms[axis] for axis in range(3))  # angular momentum
    per_x, per_y, per_z = (dt * inverse[axis] for axis in range(3))
    y, z = _turned(y, z, 0.5 * per_x * (x - of_x))
    z, x = _turned(z, x, 0.5 * per_y * (y - of_y))
    x, y = _turned(x, y, per_z * (z - of_z))
    z, x = _turned(z, x, 0.5 * per_y * (y - of_y))
    y, z = _turned(y, z, 0.5 * per_x * (x - of_x))
    turned = jnp.stack([x - of_x, y - of_y, z - of_z]) * inverse
    return 0.5 * (kicked + turned), turned + (1.0 - first) * kick


def times_inertia(inertia_kg_m2: jax.Array, principal_axes: jax.Array | None, rate: jax.Array) -> jax.Array:
    """Tensor of inertia times a vector [3] (both body): angular momentum (N m s) of a rate, torque of its change."""
    if principal_axes is None:
        return inertia_kg_m2 * rate
    axes = rotation_matrix(principal_axes)
    return to_world(axes, inertia_kg_m2 * to_body(axes, rate))


def over_inertia(inertia_kg_m2: jax.Array, principal_axes: jax.Array | None, momentum: jax.Array) -> jax.Array:
    """Inverse of the tensor of inertia times a vector [3] (both body): rate (rad/s) of an angular momentum."""
    return times_inertia(1.0 / inertia_kg_m2, principal_axes, momentum)


def torque_of_euler_step(
    rate_rad_s: jax.Array, inertia_kg_m2: jax.Array, wanted_rad_s: jax.Array, dt: float
) -> jax.Array:
    """Torque [3] (N m) with which Euler's step of Euler's equations leads from one rate [3] to another.

    All vectors along the principal axes.
    """
    gyroscopic = jnp.cross(rate_rad_s, inertia_kg_m2 * rate_rad_s)
    return inertia_kg_m2 * (wanted_rad_s - rate_rad_s) / dt + gyroscopic


def _turned(a: jax.Array, b: jax.Array, angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Components (a, b) [] of a fixed vector in axes turned by an ``angle`` [] (rad).

    The angle is exact to 1e-6 of itself below 0.5 rad (Padé's tangent of its half), and whatever it is the vector's
    length is kept.
    """
    half = 0.5 * angle
    square = half * half
    tangent, one = half * (15.0 - square), 15.0 - 6.0 * square
    n, d = tangent * tangent, one * one
    inverse = 1.0 / (n + d)
    c, s = (d - n) * inverse, 2.0 * tangent * one * inverse
    return c * a + s * b, c * b - s * a
