"""The contact solver against MuJoCo's cost, a general-purpose optimiser and closed forms."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from swarmsim.physics.friction_cones import NEWTON_ITERATIONS, solve
from swarmsim.physics.wheel_contact import accelerations, contacts, mass_matrix
from swarmsim.vehicles.rover_body import rover_body
from swarmsim.vehicles.skid_steer import FRICTION_RATIO, IMPEDANCE, SLIP_DAMPING_1_S, wheel_inverse_mass
from tests.physics.rovers import DT, PARAMS, SPEC

CONVERGED = 20  # iterations
MASS = np.asarray(mass_matrix(PARAMS), float)


@partial(jax.jit, static_argnums=4)
def solved(twist, smooth, distance, normal, iterations):
    """Accelerations [n, 10] of many rovers."""
    one = partial(accelerations, PARAMS, iterations=iterations)
    return jax.vmap(lambda *inputs: one(*inputs))(twist, smooth, distance, normal)


def moving(seed, count):
    """Twist [count, 10], smooth force, distance and normals of rovers that slide, tilt and lift wheels."""
    rng = np.random.default_rng(seed)
    twist = rng.normal(0.0, [0.5, 0.3, 0.05, 0.2, 0.2, 0.6, 3, 3, 3, 3], (count, 10))
    tilt = rng.normal(0.0, 0.15, (count, 1, 2)) + rng.normal(0.0, 0.05, (count, 4, 2))
    normal = np.concatenate([tilt, np.ones((count, 4, 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    distance = rng.normal(-0.002, 0.002, (count, 4))
    weight = -SPEC.mass_kg * 9.81 * normal.mean(axis=1)
    smooth = np.concatenate([weight, rng.normal(0, 5, (count, 3)), rng.normal(0, 10, (count, 4))], axis=1)
    return [jnp.asarray(x, jnp.float32) for x in (twist, smooth, distance, normal)]


def mujoco_cost(acceleration, twist, smooth, distance, normal):
    """MuJoCo's primal cost in unscaled coordinates, written out contact by contact (documentation, "Computation")."""
    p = jax.tree.map(lambda x: np.asarray(x, float), PARAMS)
    inverse_mass = wheel_inverse_mass(SPEC, rover_body(SPEC))
    cost = 0.5 * acceleration @ MASS @ acceleration - acceleration @ smooth
    mu = p.friction[0] / np.sqrt(FRICTION_RATIO)
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
        across, along = residual[0] * mu, p.friction[0] * np.hypot(residual[1], residual[2])
        if across >= mu * along:
            continue
        if mu * across + along <= 0.0:
            cost += 0.5 * stiffness * (residual[0] ** 2 + FRICTION_RATIO * (residual[1] ** 2 + residual[2] ** 2))
        else:
            cost += 0.5 * stiffness / (mu**2 * (1.0 + mu**2)) * (across - mu * along) ** 2
    return cost


@pytest.mark.parametrize("seed", range(3))
def test_a_general_purpose_optimiser_finds_the_same_minimum_of_mujocos_cost(seed):
    inputs = moving(seed, 1)
    exact = tuple(np.asarray(x[0], float) for x in inputs)
    found = np.asarray(solved(*inputs, CONVERGED)[0], float)
    best = minimize(mujoco_cost, np.zeros(10), args=exact, method="Powell", options={"ftol": 1e-12, "xtol": 1e-9})
    best = minimize(mujoco_cost, best.x, args=exact, method="BFGS", options={"gtol": 1e-5})
    lowest = min(best.fun, mujoco_cost(found, *exact))
    assert mujoco_cost(found, *exact) - lowest < 1e-5 * abs(lowest)
    np.testing.assert_allclose(found, best.x, atol=2e-3 * np.abs(found).max())


def test_the_iterations_converge():
    inputs = moving(10, 512)
    exact = solved(*inputs, CONVERGED)
    speed_error = {n: DT * jnp.abs(solved(*inputs, n) - exact)[:, :6].max(axis=1) for n in (3, NEWTON_ITERATIONS)}
    assert float(jnp.mean(speed_error[NEWTON_ITERATIONS])) < 5e-4  # m/s, rad/s
    assert float(jnp.mean(speed_error[NEWTON_ITERATIONS])) < 0.2 * float(jnp.mean(speed_error[3]))
    np.testing.assert_allclose(solved(*inputs, 2 * CONVERGED), exact, atol=0.05)


def test_without_contact_it_falls_freely():
    twist, smooth, distance, normal = moving(20, 8)
    got = solved(twist, smooth, jnp.abs(distance) + 1e-4, normal, NEWTON_ITERATIONS)
    np.testing.assert_allclose(got, np.linalg.solve(MASS, np.asarray(smooth, float).T).T, atol=1e-3)


def test_friction_stays_in_the_cone_and_pushes():
    twist, smooth, distance, normal = moving(30, 256)
    acceleration = np.asarray(solved(twist, smooth, distance, normal, CONVERGED), float)
    wrench = acceleration @ MASS - np.asarray(smooth)  # of the contacts
    up = np.asarray(normal).mean(axis=1)
    pressed = np.sum(wrench[:, :3] * up, axis=1)
    across = np.linalg.norm(wrench[:, :3] - pressed[:, None] * up, axis=1)
    assert (pressed > -0.1).all()
    assert (across <= 1.25 * SPEC.wheels.friction * pressed + 0.5).all()  # planes differ by 0.1 rad


@pytest.mark.parametrize("iterations", [NEWTON_ITERATIONS, CONVERGED])
def test_forward_and_reverse_mode_agree_with_differences(iterations):
    """Of 64 rovers in double precision; the derivative is that of what is computed, converged or not."""
    with jax.enable_x64(True):
        params, *values = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), (PARAMS, *moving(40, 64)))

        def scaled(change, *values):
            shifted = [x * (1.0 + change[i]) for i, x in enumerate(values)]
            return accelerations(params, *shifted, iterations=iterations)

        over = partial(jax.vmap, in_axes=(None, 0, 0, 0, 0))
        ends, zero, step = jax.jit(over(scaled)), jnp.zeros(4), 1e-7
        differences = [(ends(step * e, *values) - ends(-step * e, *values)) / (2.0 * step) for e in jnp.eye(4)]
        forward, reverse = (jax.jit(over(mode(scaled)))(zero, *values) for mode in (jax.jacfwd, jax.jacrev))
    forward, reverse, differences = np.asarray(forward), np.asarray(reverse), np.stack(differences, axis=-1)
    largest = np.abs(forward).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(forward / largest, differences / largest, atol=1e-4)
    np.testing.assert_allclose(reverse / largest, forward / largest, atol=1e-8)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivatives_at_rest_are_finite(derivative):
    """Without slip the direction of friction is undefined; its derivative must not be NaN."""
    up = jnp.tile(jnp.array([0.0, 0.0, 1.0]), (4, 1))
    smooth = jnp.zeros(10).at[2].set(-SPEC.mass_kg * 9.81)

    def linear(distance, twist):
        return solve(contacts(PARAMS, twist, smooth, distance, up))[0]

    slopes = jax.jit(jax.vmap(derivative(linear, argnums=(0, 1)), in_axes=(0, None)))
    for slope in slopes(jnp.array([[-0.003] * 4, [0.0] * 4, [0.003] * 4]), jnp.zeros(10)):
        assert bool(jnp.isfinite(slope).all())
