"""Feet on the ground: springs that push, friction that holds and slides."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.physics.contact import PART_M_S, ContactPoints, contact_wrench, wall_wrench

DT = 0.005
UP = jnp.array([0.0, 0.0, 1.0])
FEET = ContactPoints(
    position_m=jnp.array([[0.2, 0.2, -0.2], [-0.2, 0.2, -0.2], [-0.2, -0.2, -0.2], [0.2, -0.2, -0.2]]),
    stiffness_n_m=jnp.float32(9000.0),
    tangential_n_m=jnp.float32(3000.0),
    damping_n_s_m=jnp.float32(70.0),
    friction=jnp.float32(0.7),
    mass_kg=jnp.float32(3.5),
)


def contact(height, velocity=(0.0, 0.0, 0.0), rate=(0.0, 0.0, 0.0), slip=None):
    return contact_wrench(
        FEET,
        slip_m=jnp.zeros((4, 3)) if slip is None else slip,
        height_m=jnp.full(4, height),
        normal=UP,
        velocity_m_s=jnp.array(velocity, jnp.float32),
        angular_velocity_rad_s=jnp.array(rate, jnp.float32),
        dt=DT,
    )


def test_nothing_happens_in_the_air():
    force, torque, slip = contact(0.001, (3.0, 1.0, -2.0), (1.0, 2.0, 3.0), jnp.full((4, 3), 1e-3))
    for value in (force, torque, slip):
        np.testing.assert_array_equal(value, 0.0)


def test_springs_carry_the_sinkage():
    force, torque, _ = contact(-0.001)
    np.testing.assert_allclose(force, [0, 0, 4 * 9.0], rtol=1e-5)
    np.testing.assert_allclose(torque, 0.0, atol=1e-5)


@given(st.floats(-0.05, 0.01), *(st.floats(-5.0, 5.0) for _ in range(4)))
def test_ground_pushes_never_pulls_and_friction_stays_in_its_cone(height, vx, vy, vz, turn):
    force, _, slip = contact(height, (vx, vy, vz), (0.0, 0.0, turn))
    assert float(force[2]) >= 0.0
    assert np.linalg.norm(force[:2]) <= 0.7 * float(force[2]) * (1 + 1e-4) + 1e-4
    assert np.isfinite(slip).all()
    np.testing.assert_allclose(slip[:, 2], 0.0, atol=1e-7)


def test_a_foot_that_slides_feels_the_full_friction_against_its_motion():
    slip = jnp.zeros((4, 3))
    for _ in range(200):
        force, _, slip = contact(-0.001, (0.6, 0.8, 0.0), slip=slip)
    np.testing.assert_allclose(force, 36.0 * np.array([-0.7 * 0.6, -0.7 * 0.8, 1.0]), rtol=1e-3)


def test_a_small_give_is_elastic():
    slip = jnp.tile(jnp.array([5e-4, 0.0, 0.0]), (4, 1))
    force, _, kept = contact(-0.001, slip=slip)
    assert float(force[0]) == pytest.approx(-4 * 3000 * 5e-4, rel=1e-5)
    np.testing.assert_allclose(kept, slip, rtol=1e-6)


def test_spinning_on_the_feet_is_braked_about_the_normal():
    force, torque, _ = contact(-0.001, rate=(0.0, 0.0, 2.0))
    np.testing.assert_allclose(force[:2], 0.0, atol=1e-4)
    assert float(torque[2]) < 0.0
    np.testing.assert_allclose(torque[:2], 0.0, atol=1e-4)


@given(st.floats(0.0, 2.0), st.floats(-20.0, 20.0))
def test_no_depth_throws_the_body_back(depth, speed):
    """One step after it has come to be ``depth`` m deep at ``speed`` m/s, up is positive."""
    force, _, _ = contact(-depth, (0.0, 0.0, speed))
    assert speed + DT * float(force[2]) / 3.5 <= max(speed, PART_M_S) + 1e-3


@given(*(st.floats(-6.0, 6.0) for _ in range(3)), *(st.floats(-20.0, 20.0) for _ in range(3)), st.floats(0.0, 0.4))
def test_a_wall_gives_no_energy_but_what_parts_from_it(vx, vy, vz, wx, wy, wz, depth):
    """A step of free motion under the wall's force: friction takes the slip off at most, however hard the push is."""
    radius, mass, inertia = 0.5, 3.5, np.array([0.06, 0.05, 0.09])
    velocity, rate = np.array([vx, vy, vz]), np.array([wx, wy, wz])
    force, torque = wall_wrench(
        FEET, radius_m=jnp.float32(radius), distance_m=jnp.float32(radius - depth), normal=jnp.array([1.0, 0.0, 0.0]),
        velocity_m_s=jnp.asarray(velocity, jnp.float32), angular_velocity_rad_s=jnp.asarray(rate, jnp.float32),
        inertia_kg_m2=jnp.asarray(inertia, jnp.float32), dt=DT,
    )  # fmt: skip
    after, turned = velocity + DT * np.asarray(force) / mass, rate + DT * np.asarray(torque) / inertia
    energy = [0.5 * mass * v @ v + 0.5 * inertia @ w**2 for v, w in ((velocity, rate), (after, turned))]
    assert energy[1] <= energy[0] * (1 + 1e-4) + 0.5 * mass * PART_M_S**2
    assert float(force[0]) >= 0.0
