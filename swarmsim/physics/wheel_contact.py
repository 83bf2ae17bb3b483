"""Tyre contact of a four-wheel rover as MuJoCo models it: accelerations from velocities, forces and ground planes.

The rover has ten degrees of freedom: linear and angular velocity of the body (body frame, about the centre of mass) and
four wheel speeds. Its mass matrix is constant, because a round wheel looks the same to the chassis at any angle. Each
wheel touches one plane; `swarmsim.physics.friction_cones` solves the contact problem. Accelerations agree with MuJoCo C
on the same MJCF (tests). Friction cones are elliptic: Coulomb friction against the slip, equal in all directions.
"""

import jax
import jax.numpy as jnp

from swarmsim.physics.friction_cones import NEWTON_ITERATIONS, Contacts, solve
from swarmsim.vehicles.skid_steer import FRICTION_RATIO, IMPEDANCE, SLIP_DAMPING_1_S, SkidSteerParams


def mass_matrix(params: SkidSteerParams) -> jax.Array:
    """Mass matrix [10, 10] of the generalised velocities."""
    rover = jnp.zeros((6, 6)).at[:3, :3].set(params.mass_kg * jnp.eye(3)).at[3:, 3:].set(params.inertia_kg_m2)
    coupling = jnp.zeros((6, 4)).at[4].set(params.wheel_inertia_kg_m2)
    wheels = (params.wheel_inertia_kg_m2 + params.rotor_inertia_kg_m2) * jnp.eye(4)  # a diagonal: [4] along it
    return jnp.block([[rover, coupling], [coupling.T, wheels]])


def smooth_force(
    params: SkidSteerParams, twist: jax.Array, force: jax.Array, moment: jax.Array, wheel_torque: jax.Array
) -> jax.Array:
    """Generalised force [10] (N, N m) without contact, less the gyroscopic one.

    ``twist`` [10] (m/s, rad/s) is the generalised velocity; ``force`` and ``moment`` [3] act on the centre of mass in
    the body frame, gravity included; ``wheel_torque`` [4] on the wheels.
    """
    spin = twist[3:6]
    wheel_momentum = params.wheel_inertia_kg_m2 * jnp.sum(twist[6:]) * _pitch()
    momentum = jnp.sum(params.inertia_kg_m2 * spin, axis=-1) + wheel_momentum
    return jnp.concatenate([force, moment - jnp.cross(spin, momentum), wheel_torque])


def accelerations(
    params: SkidSteerParams,
    twist: jax.Array,
    smooth: jax.Array,
    distance: jax.Array,
    normal: jax.Array,
    iterations: int = NEWTON_ITERATIONS,
    radius: jax.Array | None = None,
) -> jax.Array:
    """Acceleration [10] (m/s^2, rad/s^2) under the generalised force ``smooth`` [10] and the contact of the tyres.

    ``twist`` [10] is the generalised velocity, ``distance`` [4] (m) that of each tyre from its ground plane, negative
    in it, ``normal`` [4, 3] the unit normals of the planes in the body frame; ``iterations`` of Newton's method.
    ``radius`` [4] (m) is that of each wheel towards its plane, by default the wheel's.
    """
    linear, angular, wheels = solve(contacts(params, twist, smooth, distance, normal, radius), iterations)
    return jnp.concatenate([linear, angular, wheels - _pitch_share(params) * angular[1]])


def contacts(
    params: SkidSteerParams,
    twist: jax.Array,
    smooth: jax.Array,
    distance: jax.Array,
    normal: jax.Array,
    radius: jax.Array | None = None,
) -> Contacts:
    """The contact problem; arguments as those of `accelerations`.

    Jacobian and reference acceleration follow the constraint model of the MuJoCo documentation ("Computation"). Normal
    rows are scaled by friction / sqrt(friction ratio) and the others by the friction, in which MuJoCo's cone is round.
    The wheel accelerations of the problem are y = wheel acceleration + `_pitch_share` x pitch acceleration.
    """
    friction, share = params.friction, _pitch_share(params)
    opening = friction / FRICTION_RATIO**0.5
    pitch = _pitch()
    reach = (
        params.wheel_radius_m if radius is None else radius
    ) + 0.5 * distance  # MuJoCo's contact point is halfway between tyre and plane
    arm = params.wheel_position_m - normal * reach[:, None]
    in_plane = jax.lax.rsqrt(jnp.maximum(normal[:, 0] ** 2 + normal[:, 2] ** 2, 1e-6))
    ahead = jnp.stack([normal[:, 2] * in_plane, jnp.zeros(4), -normal[:, 0] * in_plane], axis=-1)
    across = friction[:, None] * jnp.cross(normal, ahead)
    axes = jnp.stack([opening[:, None] * normal, friction[:, None] * ahead, across], axis=1)
    moments = jnp.cross(arm[:, None, :], axes)
    rolling = -friction * reach / in_plane
    velocity = jnp.sum(axes * twist[:3], axis=-1) + jnp.sum(moments * twist[3:6], axis=-1)
    velocity = velocity + (rolling * twist[6:])[:, None] * pitch  # the rolling direction is row 1
    damping = jnp.stack([params.contact_damping_1_s, SLIP_DAMPING_1_S, SLIP_DAMPING_1_S])
    spring = params.contact_stiffness_1_s2 * IMPEDANCE * opening * distance
    normal_mass = params.mass_kg / params.contact_softness * (IMPEDANCE / (1.0 - IMPEDANCE))
    return Contacts(
        axes=axes,
        moments=moments - (share * rolling)[:, None, None] * pitch[:, None] * pitch,
        rolling=rolling,
        reference=-damping * velocity - spring[:, None] * jnp.array([1.0, 0.0, 0.0]),
        stiffness_kg=jnp.where(distance < 0.0, normal_mass / (opening * opening), 0.0),
        opening=opening,
        mass_kg=params.mass_kg,
        inertia_kg_m2=params.inertia_kg_m2 - jnp.sum(share) * params.wheel_inertia_kg_m2 * pitch[:, None] * pitch,
        wheel_inertia_kg_m2=params.wheel_inertia_kg_m2 + params.rotor_inertia_kg_m2,
        force_n=smooth[:3],
        torque_nm=smooth[3:6] - jnp.sum(share * smooth[6:]) * pitch,
        wheel_torque_nm=smooth[6:],
    )


def _pitch_share(params: SkidSteerParams) -> jax.Array:
    """Inertia of each wheel without its motor over that with it [4]: couples wheels and pitch in the mass matrix."""
    return params.wheel_inertia_kg_m2 / (params.wheel_inertia_kg_m2 + params.rotor_inertia_kg_m2)


def _pitch() -> jax.Array:
    """The body's pitch axis [3], which is that of the wheels."""
    return jnp.array([0.0, 1.0, 0.0])
