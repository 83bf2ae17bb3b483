import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.policies.path import (
    REACH_MAX,
    Path,
    acceleration_along,
    limit_in_bends,
    limit_speed,
    reference,
    resample,
    rounded,
    rounded_above,
)

ROUNDED_ABOVE = jax.jit(rounded_above)
ROUNDED = jax.jit(rounded)


def test_resampled_square_keeps_length_and_spacing():
    corners = jnp.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [10.0, 10.0], [0.0, 10.0]])
    points, length = resample(corners, 61)
    assert float(length) == pytest.approx(30.0)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    np.testing.assert_allclose(steps, 0.5, atol=1e-4)
    np.testing.assert_allclose(np.asarray(points)[[0, 20, 40, 60]], [[0, 0], [10, 0], [10, 10], [0, 10]], atol=1e-4)


def test_polyline_of_zero_length_stays_and_is_finite():
    points, length = resample(jnp.full((4, 3), 7.0), 16)
    assert float(length) == 0.0
    np.testing.assert_array_equal(points, 7.0)


@given(st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=3, max_size=8), st.floats(0.3, 3.0))
def test_speed_profile_never_asks_for_more_than_the_acceleration(corners, acceleration):
    points, length = resample(jnp.array(corners), 200)
    spacing = float(length) / 199
    speed = np.asarray(limit_speed(points, jnp.full(200, 4.0), acceleration, 0.5), np.float64)
    assert speed[0] == 0.0
    assert speed[-1] == 0.0
    assert np.all(speed <= 4.0 + 1e-5)
    assert np.all(np.isfinite(speed))
    if spacing > 1e-2:
        along = np.abs(np.diff(speed**2)) / (2 * spacing)
        assert along.max() <= acceleration * 1.02 + 1e-2


def test_right_angle_is_taken_at_the_speed_of_the_arc_that_cuts_it():
    points, _ = resample(jnp.array([[0.0, 0.0], [20.0, 0.0], [20.0, 20.0]]), 401)
    speed = limit_speed(points, jnp.full(401, 10.0), 1.0, 0.5)
    radius = 0.5 / (1 / np.cos(np.pi / 4) - 1)
    assert float(speed[200]) == pytest.approx(np.sqrt(radius), rel=1e-3)


def test_reference_moves_at_the_path_speed_and_stops_at_its_end():
    points, length = resample(jnp.array([[0.0, 0.0, 5.0], [10.0, 0.0, 5.0]]), 11)
    path = Path(points_m=points, speed_m_s=jnp.full(11, 2.0), spacing_m=length / 10, length_m=length)
    halfway = reference(path, jnp.array(4.25))
    np.testing.assert_allclose(halfway.position_m, [4.25, 0, 5], atol=1e-5)
    np.testing.assert_allclose(halfway.velocity_m_s, [2, 0, 0], atol=1e-5)
    over = reference(path, jnp.array(99.0))
    np.testing.assert_allclose(over.position_m, [10, 0, 5], atol=1e-5)
    np.testing.assert_array_equal(over.velocity_m_s, 0.0)


@pytest.mark.parametrize("turn_deg", [30.0, 90.0, 150.0])
def test_a_corner_is_rounded_to_a_parabola_and_the_ends_stay(turn_deg):
    turn, reach = np.radians(turn_deg), 1.0  # twice what may be cut
    corner = jnp.array([[-30.0, 0.0], [0.0, 0.0], [30.0 * np.cos(turn), 30.0 * np.sin(turn)]])
    points, length = resample(corner, 2401)
    smooth = np.asarray(rounded(points, length / 2400, 0.5))
    assert np.linalg.norm(smooth[1200]) == pytest.approx(0.5 * reach * np.sin(turn / 2), rel=0.02)
    np.testing.assert_allclose(smooth[[0, -1]], corner[np.array([0, 2])], atol=1e-4)
    far = np.abs(np.arange(2401) - 1200) * float(length) / 2400 > 1.01 * reach
    np.testing.assert_allclose(smooth[far], np.asarray(points)[far], atol=1e-4)


@given(st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=2, max_size=8), st.floats(0.1, 2.0))
def test_a_rounded_path_stays_within_its_reach_of_the_path(corners, corner):
    points, length = resample(jnp.array([*corners, *[corners[-1]] * (8 - len(corners))]), 300)
    spacing = float(length) / 299
    smooth = np.asarray(ROUNDED(points, length / 299, corner))
    apart = np.linalg.norm(smooth - np.asarray(points), axis=-1)
    assert apart.max() <= corner + 0.5 * spacing + 1e-3
    np.testing.assert_allclose(smooth[[0, -1]], np.asarray(points)[[0, -1]], atol=1e-4)


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=40), st.floats(0.0, 2.0 * REACH_MAX))
def test_heights_rounded_from_above_are_nowhere_less(heights, reach):
    values = np.resize(np.array(heights, np.float32), 300)
    above = np.asarray(ROUNDED_ABOVE(values, jnp.float32(reach)))
    assert np.all(above >= values - 1e-3)
    assert above.max() <= values.max() + np.ptp(values) + 1e-3


def test_slopes_stay_and_bends_become_curves_that_begin_before_them():
    number = jnp.arange(200.0)
    np.testing.assert_allclose(rounded_above(0.3 * number, jnp.float32(9.0)), 0.3 * number, atol=1e-4)
    np.testing.assert_array_equal(rounded_above(jnp.full(50, 3.0), jnp.float32(9.0)), 3.0)
    climb = jnp.clip(0.5 * (number - 60.0), 0.0, 40.0)  # up from 60 to 140
    above = np.asarray(rounded_above(climb, jnp.float32(12.0)))
    np.testing.assert_allclose(above[[20, 100, 180]], climb[jnp.array([20, 100, 180])], atol=1e-4)
    # the climb's slope of a half is reached and left over 24 points
    assert np.abs(np.diff(above, 2)).max() < 2.0 * 0.5 / 24.0
    assert above[60] > 0.5
    assert above[140] == pytest.approx(40.0, abs=0.1)
    assert above.max() < 41.5


def test_on_a_circle_speed_and_acceleration_are_those_of_the_turn():
    angle = jnp.linspace(0.0, 2.0 * jnp.pi, 401)
    circle = jnp.stack([6.0 * jnp.cos(angle), 6.0 * jnp.sin(angle), 0.0 * angle], axis=-1)
    speed = limit_in_bends(circle, jnp.full(401, 50.0), jnp.float32(2.5))
    np.testing.assert_allclose(speed[2:-2], np.sqrt(2.5 * 6.0), rtol=1e-3)
    given_m_s2 = acceleration_along(circle, jnp.full(401, 3.0), jnp.float32(100.0))
    np.testing.assert_allclose(given_m_s2[1:-1], -9.0 / 36.0 * circle[1:-1], atol=2e-3)
    limited = acceleration_along(circle, jnp.full(401, 3.0), jnp.float32(0.7))
    assert float(jnp.linalg.norm(limited, axis=-1).max()) <= 0.7 * 1.0001


def test_acceleration_along_a_straight_path_is_that_of_its_speeds():
    points, _ = resample(jnp.array([[0.0, 0.0, 5.0], [40.0, 0.0, 5.0]]), 401)
    speed = limit_speed(points, jnp.full(401, 4.0), 2.0, 0.5)  # 4 m of speeding up, 4 m of slowing down
    fed = np.asarray(acceleration_along(points, speed, jnp.float32(2.0)))
    np.testing.assert_allclose(fed[2:38, 0], 2.0, rtol=0.02)
    np.testing.assert_allclose(fed[45:355], 0.0, atol=1e-3)
    np.testing.assert_allclose(fed[363:398, 0], -2.0, rtol=0.02)
    np.testing.assert_array_equal(fed[:, 1:], 0.0)


def test_a_reference_tells_the_acceleration_of_its_path():
    points, length = resample(jnp.array([[0.0, 0.0, 5.0], [10.0, 0.0, 5.0]]), 11)
    fed = jnp.arange(33.0).reshape(11, 3)
    path = Path(
        points_m=points, speed_m_s=jnp.full(11, 2.0), spacing_m=length / 10, length_m=length, acceleration_m_s2=fed
    )
    np.testing.assert_allclose(reference(path, jnp.array(4.25)).acceleration_m_s2, fed[4] + 0.25 * 3.0, atol=1e-4)
    np.testing.assert_array_equal(reference(path, jnp.array(10.0)).acceleration_m_s2, 0.0)
