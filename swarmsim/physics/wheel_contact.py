"""Tyre contact of a four-wheel rover as MuJoCo's convex contact problem, solved by MJX.

What `mjx.step` does for this body in several hundred small operations is written out here in closed form, in the body
frame and about the centre of mass, where the mass matrix of a chassis with four round wheels is constant: smooth
accelerations, contact points, their Jacobian and reference accelerations. The contact problem itself goes to
`mjx.solve`. A test holds accelerations to those of MuJoCo on the same MJCF.

Friction cones are elliptic: Coulomb friction against the slip, of the same size in all directions.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from swarmsim.config.vehicles import SkidSteer
from swarmsim.physics.mjx_import import mjx
from swarmsim.vehicles.rover_body import RoverBody
from swarmsim.vehicles.skid_steer import (
    FRICTION_RATIO,
    IMPEDANCE,
    SLIP_DAMPING_1_S,
    SkidSteerParams,
    skid_steer_mjcf,
    tyre_constants,
    wheel_inverse_mass,
)

DOFS = 10  # linear and angular acceleration in the body frame, four wheels


@dataclass(frozen=True)
class ContactProblem:
    """Compiled model and the constants of its tyre contact."""

    model: Any  # mjx.Model
    data: Any  # mjx.Data, template
    softness: float  # inverse mass of a wheel's centre times the rover's mass
    stiffness_1_s2: float  # k of the reference acceleration -b v - k d r
    damping_1_s: float  # b of the normal


def contact_problem(spec: SkidSteer, body: RoverBody, dt: float, iterations: int, line_search: int) -> ContactProblem:
    """Compile the rover for MJX's Newton solver with so many iterations, each with so many steps of line search."""
    compiled = mujoco.MjModel.from_xml_string(skid_steer_mjcf(spec, body, dt))
    compiled.opt.iterations, compiled.opt.ls_iterations = iterations, line_search
    stiffness, damping = tyre_constants(spec, body)
    return ContactProblem(
        model=mjx.put_model(compiled),
        data=mjx.make_data(compiled),
        softness=wheel_inverse_mass(spec, body) * body.mass_kg,
        stiffness_1_s2=stiffness,
        damping_1_s=damping,
    )


def mass_matrix(params: SkidSteerParams) -> jax.Array:
    """Mass matrix [10, 10]: constant, since a turning wheel looks the same to the chassis."""
    rover = jnp.zeros((6, 6)).at[:3, :3].set(params.mass_kg * jnp.eye(3)).at[3:, 3:].set(params.inertia_kg_m2)
    coupling = jnp.zeros((6, 4)).at[4].set(params.wheel_inertia_kg_m2)
    wheels = (params.wheel_inertia_kg_m2 + params.rotor_inertia_kg_m2) * jnp.eye(4)
    return jnp.block([[rover, coupling], [coupling.T, wheels]])


def smooth_force(
    params: SkidSteerParams, twist: jax.Array, force: jax.Array, moment: jax.Array, wheel_torque: jax.Array
) -> jax.Array:
    """Generalised force [10] less the gyroscopic one; ``force``, ``moment`` [3] in the body frame, with gravity."""
    spin = twist[3:6]
    wheels = params.wheel_inertia_kg_m2 * jnp.sum(twist[6:]) * jnp.array([0.0, 1.0, 0.0])
    momentum = params.inertia_kg_m2 @ spin + wheels
    return jnp.concatenate([force, moment - jnp.cross(spin, momentum), wheel_torque])


def contact_rows(
    problem: ContactProblem, params: SkidSteerParams, twist: jax.Array, distance: jax.Array, normal: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Jacobian [4, 3, 10], inverse softness [3], reference acceleration [4, 3] along normal, rolling, side direction.

    ``twist`` [10] is the velocity, ``distance`` [4] (m) that of each tyre from its plane, negative in it, ``normal``
    [4, 3] the planes' normals in the body frame. Formulas: MuJoCo documentation, "Computation", constraint model.
    """
    reach = params.wheel_radius_m + 0.5 * distance
    arm = params.wheel_position_m - normal * reach[:, None]
    planar = jax.lax.rsqrt(normal[:, 0] ** 2 + normal[:, 2] ** 2)
    ahead = jnp.stack([normal[:, 2] * planar, jnp.zeros(4), -normal[:, 0] * planar], axis=-1)
    axes = jnp.stack([normal, ahead, jnp.cross(normal, ahead)], axis=1)
    rolling = (-reach / planar)[:, None, None] * jnp.array([0.0, 1.0, 0.0])[:, None] * jnp.eye(4)[:, None, :]
    jacobian = jnp.concatenate([axes, jnp.cross(arm[:, None, :], axes), rolling], axis=-1)
    touching = (distance < 0.0)[:, None]
    jacobian = jnp.where(touching[..., None], jacobian, 0.0)
    damping = jnp.array([problem.damping_1_s, SLIP_DAMPING_1_S, SLIP_DAMPING_1_S])
    spring = problem.stiffness_1_s2 * IMPEDANCE * distance[:, None] * jnp.array([1.0, 0.0, 0.0])
    reference = -damping * (jacobian @ twist) - jnp.where(touching, spring, 0.0)
    normal_mass = params.mass_kg / problem.softness * IMPEDANCE / (1.0 - IMPEDANCE)
    return jacobian, normal_mass * jnp.array([1.0, FRICTION_RATIO, FRICTION_RATIO]), reference


def accelerations(
    problem: ContactProblem,
    params: SkidSteerParams,
    twist: jax.Array,
    smooth: jax.Array,
    distance: jax.Array,
    normal: jax.Array,
) -> jax.Array:
    """Acceleration [10] under the generalised force ``smooth`` [10] and the tyres' contact (see `contact_rows`)."""
    jacobian, inverse_softness, reference = contact_rows(problem, params, twist, distance, normal)
    data = problem.data.tree_replace(
        {
            "_impl.M": mass_matrix(params),
            "_impl.efc_J": jacobian.reshape(12, DOFS),
            "_impl.efc_D": jnp.tile(inverse_softness, 4),
            "_impl.efc_aref": reference.reshape(12),
            "_impl.contact.friction": jnp.full((4, 5), params.friction),
            "qfrc_smooth": smooth,
            "qacc_smooth": free_acceleration(params, smooth),
            "qacc_warmstart": jnp.zeros(DOFS),
        }
    )
    return mjx.solve(problem.model, data).qacc


def free_acceleration(params: SkidSteerParams, smooth: jax.Array) -> jax.Array:
    """Acceleration [10] without contact: the mass matrix's blocks eliminated, wheels first."""
    wheel = params.wheel_inertia_kg_m2 + params.rotor_inertia_kg_m2
    share = params.wheel_inertia_kg_m2 / wheel
    pitch = jnp.array([0.0, 1.0, 0.0])
    held = params.inertia_kg_m2 - 4.0 * share * params.wheel_inertia_kg_m2 * jnp.outer(pitch, pitch)
    columns = jnp.cross(held[jnp.array([1, 2, 0])], held[jnp.array([2, 0, 1])])
    inverse = columns / jnp.dot(held[0], columns[0])
    angular = inverse @ (smooth[3:6] - share * jnp.sum(smooth[6:]) * pitch)
    return jnp.concatenate([smooth[:3] / params.mass_kg, angular, smooth[6:] / wheel - share * angular[1]])
