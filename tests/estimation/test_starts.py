"""Where sources are looked for first."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.estimation.starts import ROOMS, places_of
from swarmsim.site.raster import in_areas
from tests.estimation.survey import place

CORNERS = 70.0 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def site_of(boxes, wall=0.3, axis=(1.0, 0.0)):
    """A plane with hollow boxes of (x, y), (half length, half width)."""
    site = place([((x, y, 2.5), (length, width, 2.5), "concrete") for (x, y), (length, width) in boxes])
    hollow, turned = jnp.full(len(boxes), wall), jnp.tile(jnp.array(axis), (len(boxes), 1))
    return replace(site, obstacles=replace(site.obstacles, wall_m=hollow, axis=turned))


@given(
    x=st.floats(-40.0, 40.0), y=st.floats(-40.0, 40.0), length=st.floats(1.0, 20.0), width=st.floats(1.0, 20.0),
    yaw=st.floats(0.0, 3.0),
)  # fmt: skip
def test_every_spot_of_a_building_is_near_a_place_in_it(x, y, length, width, yaw):
    axis = np.array([np.cos(yaw), np.sin(yaw)])
    places = places_of(site_of([((x, y), (length, width))], axis=axis), [CORNERS], 4.0, 1.0)
    there = places.there
    offset = places.inside_m[there] - np.array([x, y])
    own = np.stack([offset @ axis, offset @ np.array([-axis[1], axis[0]])], axis=1)
    assert np.all(np.abs(own) < np.array([length, width]) - 0.3)
    corner = np.array([length, width]) - 0.6
    spots = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 2)) * np.maximum(corner, 0.0)
    apart = np.linalg.norm(spots[:, None] - own, axis=2).min(axis=1)
    assert np.all(apart < 2.0 * np.sqrt(2.0) + 1e-3)
    assert len(there) == ROOMS


def test_the_nearest_point_of_the_grid_is_known():
    places = places_of(site_of([((10.0, -20.0), (8.0, 5.0))]), [CORNERS], 4.0, 1.0)
    apart = np.linalg.norm(places.points_m[places.near[places.there], :2] - places.inside_m[places.there], axis=1)
    assert np.all(apart < 2.0 * np.sqrt(2.0) + 0.1)


def test_a_site_without_buildings_has_no_places_in_them():
    places = places_of(place(), [CORNERS], 4.0, 1.0)
    assert places.there.shape == (ROOMS,)
    assert not places.there.any()
    assert np.isfinite(places.inside_m).all()


def test_a_town_has_one_place_in_each_building_at_least():
    side = np.arange(-65.0, 66.0, 5.0)
    town = [((x, y), (2.2, 2.2)) for x in side for y in side]
    places = places_of(site_of(town), [CORNERS], 1.0, 1.0)
    assert len(town) <= places.there.sum() <= ROOMS
    inside = places.inside_m[places.there]
    apart = np.linalg.norm(np.array([at for at, _ in town])[:, None] - inside, axis=2).min(axis=1)
    assert np.all(apart < 2.2)


def test_where_there_are_too_many_buildings_those_with_a_place_lie_all_over_the_area():
    side = np.arange(-69.0, 70.0, 3.0)
    places = places_of(site_of([((x, y), (1.2, 1.2)) for x in side for y in side]), [CORNERS], 1.0, 1.0)
    assert places.there.all()
    assert np.all(np.ptp(places.inside_m, axis=0) > 130.0)


def test_buildings_outside_the_area_take_no_place_from_those_inside():
    hall = ((0.0, 0.0), (20.0, 15.0))
    far = [((x, y), (3.0, 3.0)) for x in range(200, 600, 10) for y in range(-150, 150, 10)]
    alone, among = (places_of(site_of(boxes), [CORNERS], 4.0, 1.0) for boxes in ([hall], [*far, hall]))
    np.testing.assert_allclose(among.inside_m, alone.inside_m, atol=1e-4)
    assert among.there.sum() == 80


@pytest.mark.parametrize("x", [120.0, -120.0])
def test_a_building_outside_the_area_is_left_out(x):
    assert not places_of(site_of([((x, 0.0), (8.0, 5.0))]), [CORNERS], 4.0, 1.0).there.any()


@given(
    corners=st.lists(st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0)), min_size=3, max_size=3),
    places=st.lists(st.tuples(st.floats(-60.0, 60.0), st.floats(-60.0, 60.0)), min_size=1, max_size=20),
)
def test_a_place_in_a_triangle_is_a_mixture_of_its_corners(corners, places):
    a, b, c = np.array(corners)
    twice = (b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]
    if abs(twice) < 10.0:
        return
    triangle = np.array([a, b, c] if twice > 0.0 else [a, c, b])
    shares = np.linalg.solve(np.vstack([triangle.T, np.ones(3)]), np.vstack([np.array(places).T, np.ones(len(places))]))
    clear = np.abs(shares).min(axis=0) > 1e-3
    assert np.all((in_areas(np.array(places), [triangle]) == (shares > 0.0).all(axis=0))[clear])
    elsewhere = triangle + 1e3
    assert np.array_equal(in_areas(np.array(places), [elsewhere, triangle]), in_areas(np.array(places), [triangle]))
    assert in_areas(triangle, [triangle]).all()


def test_points_outside_of_the_areas_are_not_surveyed():
    places = places_of(place(), [CORNERS[:3] * [0.5, 1.0]], 4.0, 1.0)
    share = places.surveyed.mean()
    assert share == pytest.approx(0.5, abs=0.05)
    assert places_of(place(), [CORNERS], 4.0, 1.0).surveyed.all()


@given(angle=st.floats(0.0, 3.1), width=st.floats(0.2, 6.0), x=st.floats(-20.0, 20.0), y=st.floats(-20.0, 20.0))
def test_an_area_narrower_than_the_grid_has_a_point_to_be_judged_by(angle, width, x, y):
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    strip = np.array([x, y]) + np.array(
        [30.0 * a * along + 0.5 * width * b * across for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    )
    places = places_of(place(), [strip, CORNERS], 4.0, 1.0)
    near = places.points_m[places.surveyed, :2]
    alone = places_of(place(), [strip], 4.0, 1.0)
    assert alone.surveyed.any()
    assert np.all(np.abs((alone.points_m[alone.surveyed, :2] - [x, y]) @ across) < 0.5 * width + 4.0)
    assert len(near) > alone.surveyed.sum()
