import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.policies.path import Path, limit_speed, reference, resample


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
