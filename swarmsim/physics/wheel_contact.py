"""Tyre contact of a four-wheel rover as MuJoCo's convex contact problem, solved by MJX.

What `mjx.step` does for this body in several hundred small operations is written out here in closed form, in the body
frame and about the centre of mass, where the mass matrix of a chassis with four round wheels is constant: smooth
accelerations, contact points, their Jacobian and reference accelerations. The contact problem itself goes to
`mjx.solve`. A test holds accelerations to those of MuJoCo on the same MJCF.

Friction is MuJoCo's pyramid of four edges with one edge laid along the present slip of each tyre: a sliding tyre then has
Coulomb friction against its slip, of the same size in all directions, for less than the elliptic cone costs.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from swarmsim.vehicles.skid_steer import SkidSteerParams

SLIP_ONSET_M_S = 1e-3  # below this slip the pyramid's edge lies along the wheel
DOFS = 10  # linear and angular acceleration in the body frame, four wheels


@dataclass(frozen=True)
class ContactProblem:
    """Compiled model and what of it is constant: impedance and softness of the tyre's contact."""

    model: Any  # mjx.Model
    data: Any  # mjx.Data, template
    softness: float  # body_invweight0 of a wheel times the rover's mass
    impedance: tuple[float, float, float, float]  # solimp: dmin, dmax, width, power (midpoint 0.5)
    stiffness_1_s2: float  # k of the reference acceleration -b v - k r
    damping_1_s: float  # b


def contact_problem(mjcf: str, iterations: int, line_search: int) -> ContactProblem:
    """Compile ``mjcf`` (of `skid_steer_mjcf`) for MJX's Newton solver."""
    compiled = mujoco.MjModel.from_xml_string(mjcf)
    compiled.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    compiled.opt.iterations, compiled.opt.ls_iterations = iterations, line_search
    wheel = int(np.argmax(compiled.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE))
    time_constant, damping_ratio = compiled.geom_solref[wheel]
    time_constant = max(time_constant, 2.0 * compiled.opt.timestep)
    low, high, width, _, power = compiled.geom_solimp[wheel]
    return ContactProblem(
        model=mjx.put_model(compiled),
        data=mjx.make_data(compiled),
        softness=float(compiled.body_invweight0[compiled.geom_bodyid[wheel], 0] * compiled.body_subtreemass[0]),
        impedance=(float(low), float(high), float(width), float(power)),
        stiffness_1_s2=float(1.0 / (high * time_constant * damping_ratio) ** 2),
        damping_1_s=float(2.0 / (high * time_constant)),
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
    """Generalised force [10] less the gyroscopic one; ``force`` and ``moment`` [3] in the body frame, gravity included."""
    spin = twist[3:6]
    momentum = params.inertia_kg_m2 @ spin + params.wheel_inertia_kg_m2 * jnp.sum(twist[6:]) * jnp.array([0.0, 1.0, 0.0])
    return jnp.concatenate([force, moment - jnp.cross(spin, momentum), wheel_torque])


def contact_rows(
    problem: ContactProblem, params: SkidSteerParams, twist: jax.Array, distance: jax.Array, normal: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Jacobian [16, 10], inverse softness [16] and reference acceleration [16] of the pyramids' edges.

    ``twist`` [10] is the velocity, ``distance`` [4] (m) that of each tyre from its plane, negative in it, ``normal`` [4, 3]
    the planes' normals in the body frame. Formulas: MuJoCo documentation, "Computation", constraint model.
    """
    reach = params.wheel_radius_m + 0.5 * distance
    arm = params.wheel_position_m - normal * reach[:, None]
    planar = jax.lax.rsqrt(normal[:, 0] ** 2 + normal[:, 2] ** 2)
    zero = jnp.zeros_like(planar)
    ahead = jnp.stack([normal[:, 2] * planar, zero, -normal[:, 0] * planar], axis=-1)
    aside = jnp.cross(normal, ahead)
    rolling = -reach / planar
    velocity = twist[:3] + jnp.cross(twist[3:6], arm)
    slip_ahead = jnp.sum(ahead * velocity, axis=-1) + rolling * twist[6:]
    slip_aside = jnp.sum(aside * velocity, axis=-1)
    slip_ahead = slip_ahead + jnp.where(slip_ahead < 0.0, -SLIP_ONSET_M_S, SLIP_ONSET_M_S)
    slip = jax.lax.rsqrt(slip_ahead**2 + slip_aside**2)
    c, s = slip_ahead * slip, slip_aside * slip
    along = c[:, None] * ahead + s[:, None] * aside
    across = c[:, None] * aside - s[:, None] * ahead
    mu = params.friction
    edges = jnp.stack([normal + mu * along, normal - mu * along, normal + mu * across, normal - mu * across], axis=1)
    turning = mu * rolling[:, None] * jnp.stack([c, -c, -s, s], axis=1)
    angular = jnp.cross(arm[:, None, :], edges)
    own_wheel = turning[:, :, None] * jnp.eye(4)[:, None, :]
    jacobian = jnp.concatenate([edges, angular, own_wheel], axis=-1)
    jacobian = jnp.where(distance[:, None, None] < 0.0, jacobian, 0.0).reshape(16, DOFS)
    low, high, width, power = problem.impedance
    depth = jnp.minimum(jnp.abs(distance) / width, 1.0)
    half = 0.5 ** (power - 1.0)
    rise = jnp.where(depth < 0.5, depth**power / half, 1.0 - (1.0 - depth) ** power / half)
    stiff = low + rise * (high - low)
    softness = problem.softness / params.mass_kg * (1.0 + mu * mu) * 2.0 * mu * mu
    resistance = softness * (1.0 - stiff) / stiff
    pull = jnp.repeat(problem.stiffness_1_s2 * stiff * jnp.minimum(distance, 0.0), 4)
    return jacobian, jnp.repeat(1.0 / resistance, 4), -problem.damping_1_s * (jacobian @ twist) - pull


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
            "_impl.efc_J": jacobian,
            "_impl.efc_D": inverse_softness,
            "_impl.efc_aref": reference,
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
