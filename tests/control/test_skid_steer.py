"""Pure pursuit and wheel speeds, alone and with the rover that they drive."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.control.skid_steer import pursue, wheel_speeds
from swarmsim.physics.rotations import rotate_inverse
from swarmsim.physics.skid_steer import rest_state
from tests.physics.rovers import DT, PARAMS, SPEC, STEP, plane_site

FLAT = plane_site()
AT_REST = rest_state(PARAMS, FLAT, jnp.zeros(2), 0.0)
STEPS = 400
wheel_speeds_compiled, pursue_compiled = jax.jit(wheel_speeds), jax.jit(pursue)


@jax.jit
def _follow(state, target, speed, site):
    """Two seconds of pursuing ``target`` with the closed-form rover."""

    def one(state, _):
        ahead, turn = pursue(PARAMS, state, target, speed)
        state = STEP["analytic"](PARAMS, state, wheel_speeds(PARAMS, ahead, turn, state), site)
        return state, state

    return jax.lax.scan(one, state, None, length=STEPS)


@jax.jit
def _hold(state, ahead, turn, site):
    """Two seconds of a commanded speed and yaw rate with the mjx rover."""

    def one(state, _):
        return STEP["mjx"](PARAMS, state, wheel_speeds(PARAMS, ahead, turn, state), site), None

    return jax.lax.scan(one, state, None, length=STEPS)[0]


@pytest.mark.parametrize(("ahead", "turn"), [(1.0, 0.0), (0.6, 0.4), (0.0, 0.7), (-0.5, 0.0), (0.9, -0.2)])
def test_the_rover_does_what_is_commanded_in_spite_of_slip(ahead, turn):
    state = _hold(AT_REST, ahead, turn, FLAT)
    assert float(rotate_inverse(state.body.quaternion, state.body.velocity_m_s)[0]) == pytest.approx(ahead, abs=0.04)
    assert float(state.body.angular_velocity_rad_s[2]) == pytest.approx(turn, abs=0.06)


def test_speed_holds_on_a_slope():
    site = plane_site(slope=(float(np.tan(np.radians(10.0))), 0.0))
    state = _hold(rest_state(PARAMS, site, jnp.zeros(2), 0.0), 0.9, 0.0, site)
    assert float(jnp.linalg.norm(state.body.velocity_m_s)) == pytest.approx(0.9, abs=0.03)
    parked = _hold(rest_state(PARAMS, site, jnp.zeros(2), 0.0), 0.0, 0.0, site)
    assert float(jnp.linalg.norm(parked.body.velocity_m_s)) < 0.01


@given(st.floats(-20, 20), st.floats(-5, 5))
def test_commands_stay_within_the_wheels_limit(ahead, turn):
    command = wheel_speeds_compiled(PARAMS, ahead, turn, AT_REST)
    assert float(jnp.abs(command).max()) <= SPEC.motor.speed_max_rad_s * 1.0001


@given(st.floats(-30, 30), st.floats(-30, 30), st.floats(0, 10))
def test_pursuit_stays_within_its_limits(x, y, speed):
    ahead, turn = pursue_compiled(PARAMS, AT_REST, jnp.array([x, y]), speed)
    assert abs(float(turn)) <= SPEC.control.yaw_rate_max_rad_s * 1.0001
    assert abs(float(ahead)) <= min(SPEC.control.speed_max_m_s, 0.4 * SPEC.control.acceleration_max_m_s2) * 1.0001
    assert float(ahead) >= 0.0
    if np.hypot(x, y) > 0.1 and abs(y) > 1e-3:  # straight behind, either way round will do
        assert float(turn) * np.arctan2(y, x) >= -1e-6  # towards the target


@pytest.mark.parametrize("target", [(-3.0, 0.1), (-2.0, -2.0), (0.0, 3.0)])
def test_a_target_behind_or_beside_is_turned_to_in_place(target):
    ahead, turn = pursue_compiled(PARAMS, AT_REST, jnp.array(target), 1.0)
    assert float(ahead) == 0.0
    assert np.sign(float(turn)) == np.sign(target[1])


def test_the_arc_goes_through_the_target():
    x, y = 2.0, 1.0
    ahead, turn = pursue_compiled(PARAMS, AT_REST, jnp.array([x, y]), 0.3)
    assert float(turn / ahead) == pytest.approx(2.0 * y / (x * x + y * y), rel=1e-4)


@pytest.mark.parametrize("target", [(6.0, 2.0), (-4.0, 3.0), (0.5, -5.0)])
def test_the_rover_arrives_and_stops(target):
    state = AT_REST
    fastest = 0.0
    for _ in range(8):
        state, states = _follow(state, jnp.array(target), 1.0, FLAT)
        fastest = max(fastest, float(jnp.linalg.norm(states.body.velocity_m_s, axis=-1).max()))
    assert float(jnp.linalg.norm(state.body.position_m[:2] - jnp.array(target))) < 0.08
    assert float(jnp.linalg.norm(state.body.velocity_m_s)) < 0.02
    assert fastest < 1.05


def test_acceleration_is_limited():
    _, states = _follow(AT_REST, jnp.array([30.0, 0.0]), 2.0, FLAT)
    speed = states.body.velocity_m_s[:, 0]
    window = round(0.2 / DT)
    gained = speed[window:] - speed[:-window]
    assert float(gained[window:].max()) / 0.2 < 4.0 * SPEC.control.acceleration_max_m_s2
    assert float(speed[-1]) > 1.5
