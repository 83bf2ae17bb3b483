"""A multirotor on the ground: it rests, slides and tips."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.physics.multirotor import longest_time_step, rest_state
from tests.flights import DT, GRAVITY, airborne, angle_deg, attitude, fly, params_of, plane, spec_of

SECONDS_2 = 400


def up_of(states):
    """Body z in the world [n, 3]."""
    return attitude(states.body.quaternion)[..., 2]


@pytest.mark.parametrize("engine", ["analytic", "mjx"])
@pytest.mark.parametrize("slope_deg", [0.0, 10.0])
def test_stays_at_rest(engine, slope_deg):
    params = params_of()
    start = rest_state(params, plane(slope_deg), 0.7)
    states = fly(params, start, 0.0, steps=2 * SECONDS_2, ground=plane(slope_deg), engine=engine)
    moved = np.linalg.norm(states.body.position_m - np.asarray(start.body.position_m), axis=1)
    assert moved.max() < 1.5e-3  # the feet give elastically as friction takes the load
    assert np.linalg.norm(states.body.position_m[-1] - states.body.position_m[-200]) < 1e-5  # and do not creep
    assert np.linalg.norm(states.body.velocity_m_s[-1]) < 1e-4


@pytest.mark.parametrize(
    ("name", "slope_deg"), [("tarot_t650", 0.0), ("tarot_t650", 10.0), ("x500", 0.0), ("x500", 5.0)]
)
def test_comes_to_rest_after_a_drop(name, slope_deg):
    params, ground = params_of(name), plane(slope_deg)
    foot = -spec_of(name).feet.positions_m[0][2]
    start = airborne(params, height=foot + 0.05)
    states = fly(params, start, 0.0, steps=2 * SECONDS_2, ground=ground, name=name)
    assert np.linalg.norm(states.body.velocity_m_s[-1]) < 1e-3
    np.testing.assert_allclose(up_of(states)[-1], ground.normal, atol=5e-3)
    clearance = states.body.position_m[-1] @ np.asarray(ground.normal)
    sink = spec_of(name).mass_kg * GRAVITY / (4 * spec_of(name).feet.stiffness_n_m)
    assert clearance == pytest.approx(foot - sink, abs=2e-4)


def test_slides_beyond_friction_with_the_coulomb_acceleration():
    params = replace(params_of(), contact_friction=jnp.float32(0.3))
    ground = plane(25.0)
    states = fly(params, rest_state(params, ground, 0.0), 0.0, steps=SECONDS_2, ground=ground)
    speed = np.linalg.norm(states.body.velocity_m_s, axis=1)
    found = (speed[-1] - speed[100]) / (DT * (SECONDS_2 - 101))
    slope = np.radians(25.0)
    drag = 0.0995494 * np.mean(speed[101:] ** 2) / 3.5
    assert found + drag == pytest.approx(GRAVITY * (np.sin(slope) - 0.3 * np.cos(slope)), rel=0.02)


@pytest.mark.parametrize(("slope_deg", "tips"), [(30.0, False), (42.0, True)])
def test_tips_where_its_weight_leaves_the_feet(slope_deg, tips):
    # Feet 0.16 m out and 0.22 m down: with friction that holds, it tips beyond atan(0.16 / 0.22) = 36 degrees.
    params = replace(params_of(), contact_friction=jnp.float32(5.0))
    ground = plane(slope_deg)
    states = fly(params, rest_state(params, ground, 0.0), 0.0, steps=SECONDS_2, ground=ground)
    lean = np.degrees(np.arccos(np.clip(up_of(states) @ np.asarray(ground.normal), -1, 1)))
    assert (lean.max() > 60.0) == tips
    if not tips:
        assert lean.max() < 2.0


def test_lies_on_its_rotors_when_upside_down():
    params = params_of()
    start = airborne(params, height=0.3, q=(0.0, 1.0, 0.0, 0.0))
    states = fly(params, start, 0.0, steps=2 * SECONDS_2)
    assert np.linalg.norm(states.body.velocity_m_s[-1]) < 1e-3
    assert -2e-3 < states.body.position_m[-1, 2] < 1e-3
    assert angle_deg(states.body.quaternion[-1], [0.0, 1.0, 0.0, 0.0]) < 1.0


def test_a_crash_at_speed_stays_finite_and_loses_energy():
    params = params_of()
    start = airborne(params, height=1.0, rate=(3.0, -2.0, 1.0), q=(0.9, 0.3, 0.3, 0.1))
    start = replace(start, body=replace(start.body, velocity_m_s=jnp.array([10.0, 3.0, -15.0])))
    states = fly(params, start, 0.0, steps=2 * SECONDS_2)
    assert all(np.isfinite(leaf).all() for leaf in (states.body.position_m, states.body.angular_velocity_rad_s))
    assert states.body.position_m[:, 2].max() < 5.0
    assert np.linalg.norm(states.body.velocity_m_s[-1]) < 2.0


@pytest.mark.parametrize("name", ["tarot_t650", "x500"])
def test_feet_are_stable_with_margin_at_5_ms(name):
    assert longest_time_step(spec_of(name)) > DT
    light = replace(params_of(name), mass_kg=jnp.float32(0.8 * spec_of(name).mass_kg))
    states = fly(light, rest_state(light, plane(), 0.0), 0.0, steps=SECONDS_2, name=name)
    assert np.linalg.norm(states.body.velocity_m_s, axis=1).max() < 1e-3
