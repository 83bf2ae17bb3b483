"""Frames of autopilots: round trips, rotation matrices, and places on the Earth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.autopilot import frames
from swarmsim.autopilot.frames import Alignment, Geodetic

ENU_TO_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_TO_FRD = np.diag([1.0, -1.0, -1.0])

metres = st.floats(-1e4, 1e4)
vectors = st.tuples(metres, metres, metres)
angles = st.floats(-20.0, 20.0)
places = st.builds(Geodetic, st.floats(-89.0, 89.0), st.floats(-180.0, 180.0), st.floats(-400.0, 9000.0))
near = st.tuples(st.floats(-5e3, 5e3), st.floats(-5e3, 5e3), st.floats(-500.0, 500.0))


@st.composite
def quaternions(draw):
    numbers = np.array(draw(st.tuples(*[st.floats(-1.0, 1.0)] * 4)))
    norm = np.linalg.norm(numbers)
    return np.array([1.0, 0.0, 0.0, 0.0]) if norm < 1e-3 else numbers / norm


def rotation(quaternion):
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def about_up(yaw):
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def apart(a, b):
    """Angle between two headings."""
    return abs(np.angle(np.exp(1j * (a - b))))


@given(vectors)
def test_ned_is_a_rotation_of_enu_and_leads_back(vector):
    np.testing.assert_array_equal(frames.ned_of_enu(vector), ENU_TO_NED @ np.array(vector))
    np.testing.assert_array_equal(frames.enu_of_ned(frames.ned_of_enu(vector)), vector)
    assert np.linalg.det(ENU_TO_NED) == pytest.approx(1.0)


@given(vectors)
def test_frd_is_a_rotation_of_flu_and_leads_back(vector):
    np.testing.assert_array_equal(frames.frd_of_flu(vector), FLU_TO_FRD @ np.array(vector))
    np.testing.assert_array_equal(frames.flu_of_frd(frames.frd_of_flu(vector)), vector)


@given(st.lists(vectors, min_size=1, max_size=5))
def test_vectors_are_converted_in_batches(batch):
    for function in (frames.ned_of_enu, frames.frd_of_flu):
        np.testing.assert_array_equal(function(batch), [function(one) for one in batch])


@given(angles)
def test_yaw_points_where_the_rotated_vector_points(yaw):
    north, east, _ = frames.ned_of_enu([np.cos(yaw), np.sin(yaw), 0.0])
    heading = frames.yaw_ned_of_enu(yaw)
    assert apart(heading, np.arctan2(east, north)) < 1e-12
    assert -np.pi <= heading <= np.pi
    assert apart(frames.yaw_enu_of_ned(heading), yaw) < 1e-12


@pytest.mark.parametrize(("enu", "ned"), [(0.0, 90.0), (90.0, 0.0), (180.0, -90.0), (-90.0, 180.0)])
def test_east_is_ninety_degrees_clockwise_from_north(enu, ned):
    assert apart(frames.yaw_ned_of_enu(np.radians(enu)), np.radians(ned)) < 1e-12


@given(quaternions())
def test_attitude_agrees_with_rotation_matrices(quaternion):
    turned = frames.quaternion_ned_of_enu(quaternion)
    np.testing.assert_allclose(rotation(turned), ENU_TO_NED @ rotation(quaternion) @ FLU_TO_FRD, atol=1e-12)
    assert turned[0] >= 0.0
    assert np.linalg.norm(turned) == pytest.approx(1.0)


@given(quaternions())
def test_attitude_leads_back(quaternion):
    back = frames.quaternion_enu_of_ned(frames.quaternion_ned_of_enu(quaternion))
    assert abs(back @ quaternion) == pytest.approx(1.0)


@given(angles)
def test_yaw_of_a_level_attitude(yaw):
    assert apart(frames.yaw_of_quaternion(about_up(yaw)), yaw) < 1e-12
    turned = frames.quaternion_ned_of_enu(about_up(yaw))
    assert apart(frames.yaw_of_quaternion(turned), frames.yaw_ned_of_enu(yaw)) < 1e-12


@given(quaternions())
def test_yaw_of_any_attitude_is_the_heading_of_its_nose(quaternion):
    nose = rotation(quaternion)[:, 0]
    if np.hypot(nose[0], nose[1]) > 1e-3:
        assert apart(frames.yaw_of_quaternion(quaternion), np.arctan2(nose[1], nose[0])) < 1e-9


@given(places, near)
def test_places_on_the_earth_lead_back(origin, offset):
    place = frames.geodetic_of_enu(offset, origin)
    np.testing.assert_allclose(frames.enu_of_geodetic(place, origin), offset, atol=1e-6)


@given(places)
def test_the_origin_is_nowhere_else(origin):
    np.testing.assert_allclose(frames.enu_of_geodetic(origin, origin), 0.0, atol=1e-8)
    place = frames.geodetic_of_enu((0.0, 0.0, 0.0), origin)
    assert place.latitude_deg == pytest.approx(origin.latitude_deg, abs=1e-11)
    assert place.altitude_m == pytest.approx(origin.altitude_m, abs=1e-7)


@given(places)
def test_a_little_north_east_and_up_by_the_radii_of_curvature(origin):
    e2 = frames.FLATTENING * (2.0 - frames.FLATTENING)
    latitude = np.radians(origin.latitude_deg)
    w = np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
    meridian = frames.EARTH_RADIUS_M * (1.0 - e2) / w**3 + origin.altitude_m
    prime = (frames.EARTH_RADIUS_M / w + origin.altitude_m) * np.cos(latitude)
    step = 1e-5  # degrees: about a metre
    place = Geodetic(origin.latitude_deg + step, origin.longitude_deg + step, origin.altitude_m + 1.0)
    expected = [np.radians(step) * prime, np.radians(step) * meridian, 1.0]
    np.testing.assert_allclose(frames.enu_of_geodetic(place, origin), expected, atol=1e-5)


def test_a_known_distance():
    """A degree of latitude from the equator is 110 574.4 m of meridian, its chord on the tangent plane little less."""
    east, north, up = frames.enu_of_geodetic(Geodetic(1.0, 0.0, 0.0), Geodetic(0.0, 0.0, 0.0))
    assert east == pytest.approx(0.0, abs=1e-9)
    assert north == pytest.approx(110_574.4, abs=10.0)
    assert up < -900.0


@given(vectors, vectors, vectors)
def test_an_alignment_leads_back(world, local, position):
    alignment = Alignment(world, local)
    np.testing.assert_allclose(alignment.to_world(alignment.to_local(position)), position, atol=1e-8)
    np.testing.assert_allclose(alignment.to_local(alignment.to_world(position)), position, atol=1e-8)


@given(vectors, vectors, vectors)
def test_an_alignment_maps_its_place_and_keeps_displacements(world, local, displacement):
    alignment = Alignment(world, local)
    np.testing.assert_array_equal(alignment.to_local(world), local)
    np.testing.assert_array_equal(alignment.to_world(local), world)
    moved = alignment.to_local(np.add(world, displacement)) - np.array(local)
    np.testing.assert_allclose(moved, frames.ned_of_enu(displacement), atol=1e-8)
