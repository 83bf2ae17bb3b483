"""The contact solver against MuJoCo's formulas, a general-purpose optimiser and the equations of motion."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from swarmsim.physics import friction_cones, wheel_contact
from swarmsim.vehicles.skid_steer import FRICTION_RATIO, IMPEDANCE, SLIP_DAMPING_1_S, wheel_inverse_mass
from swarmsim.vehicles.rover_body import rover_body
from tests.physics.rovers import DT, PARAMS, SPEC

WEIGHT = SPEC.mass_kg * 9.81
solved = jax.jit(jax.vmap(wheel_contact.accelerations, in_axes=(None, 0, 0, 0, 0)))


def moving(seed, count):
    """Twist [count, 10], smooth force, distance and normals of rovers that slide, tilt and lift wheels."""
    rng = np.random.default_rng(seed)
    scale = np.array([0.5, 0.3, 0.05, 0.2, 0.2, 0.6, 3, 3, 3, 3])
    twist = rng.normal(0.0, 1.0, (count, 10)) * scale
    tilt = rng.normal(0.0, 0.2, (count, 1, 2)) + rng.normal(0.0, 0.05, (count, 4, 2))
    normal = np.concatenate([tilt, np.ones((count, 4, 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    distance = rng.normal(-0.003, 0.003, (count, 4))
    smooth = np.concatenate([-WEIGHT * normal.mean(axis=1), rng.normal(0, 5, (count, 3)), rng.normal(0, 10, (count, 4))], 1)
    return [jnp.asarray(x, jnp.float32) for x in (twist, smooth, distance, normal)]


def mujoco_cost(acceleration, twist, smooth, distance, normal):
    """MuJoCo's primal cost in unscaled coordinates, written out contact by contact (documentation, "Computation")."""
    p = jax.tree.map(lambda x: np.asarray(x, float), PARAMS)
    mass = np.asarray(wheel_contact.mass_matrix(PARAMS), float)
    inverse_mass = wheel_inverse_mass(SPEC, rover_body(SPEC))
    cost = 0.5 * acceleration @ mass @ acceleration - acceleration @ smooth
    mu = p.friction / np.sqrt(FRICTION_RATIO)
    for wheel in range(4):
        if distance[wheel] >= 0.0:
            continue
        n = normal[wheel]
        ahead = np.cross([0.0, 1.0, 0.0], n) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], n))
        point = p.wheel_position_m[wheel] - n * (p.wheel_radius_m + 0.5 * distance[wheel])
        rim = np.cross([0.0, 1.0, 0.0], point - p.wheel_position_m[wheel])
        jacobian = np.zeros((3, 10))
        for row, axis in enumerate((n, ahead, np.cross(n, ahead))):
            jacobian[row, :3], jacobian[row, 3:6], jacobian[row, 6 + wheel] = axis, np.cross(point, axis), axis @ rim
        damping = np.array([p.contact_damping_1_s, SLIP_DAMPING_1_S, SLIP_DAMPING_1_S])
        reference = -damping * (jacobian @ twist)
        reference[0] -= p.contact_stiffness_1_s2 * IMPEDANCE * distance[wheel]
        residual = jacobian @ acceleration - reference
        stiffness = IMPEDANCE / (1.0 - IMPEDANCE) / inverse_mass
        across, along = residual[0] * mu, p.friction * np.hypot(residual[1], residual[2])
        if across >= mu * along:
            continue
        if mu * across + along <= 0.0:
            cost += 0.5 * stiffness * (residual[0] ** 2 + FRICTION_RATIO * (residual[1] ** 2 + residual[2] ** 2))
        else:
            cost += 0.5 * stiffness / (mu**2 * (1.0 + mu**2)) * (across - mu * along) ** 2
    return cost


@pytest.mark.parametrize("seed", range(6))
def test_no_general_purpose_optimiser_finds_a_lower_cost(seed):
    inputs = moving(seed, 1)
    exact = [np.asarray(x[0], float) for x in inputs]
    found = np.asarray(solved(PARAMS, *inputs)[0], float)
    start = np.linalg.solve(np.asarray(wheel_contact.mass_matrix(PARAMS), float), exact[1])
    best = minimize(mujoco_cost, start, args=tuple(exact), method="Powell", options={"maxiter": 20_000, "ftol": 1e-12, "xtol":1e-10})
    best = minimize(mujoco_cost, best.x, args=tuple(exact), method="BFGS", options={"gtol": 1e-6})
    print(best.fun, mujoco_cost(found, *exact), np.abs(best.x - found).max())
