import jax
import numpy as np
import pytest

from swarmsim.policies.waypoints import AirWaypoints, GroundWaypoints, WaypointsPlanner
from tests.policies.assignments import assignment, situation
from tests.policies.sites import block_site

planner = WaypointsPlanner()
plan = jax.jit(planner.plan)
POINTS = ((10.0, 10.0), (20.0, -10.0), (-5.0, -5.0))
HOMES = [(-30.0, -20.0), (-30.0, 20.0)]


def distances(points, corners):
    """Distance [W] from each corner to the path [P, D], and the index [W] where it is nearest."""
    apart = np.linalg.norm(points[:, None, :2] - np.asarray(corners)[None], axis=-1)
    return apart.min(axis=0), apart.argmin(axis=0)


def test_multirotors_visit_the_points_in_their_order_and_land_at_home():
    site = block_site()
    made = assignment("waypoints", "tarot_t650", HOMES, site, points=POINTS, speed_m_s=4.0, altitude_m=10.0)
    task = planner.task(made)
    assert isinstance(task, AirWaypoints)
    paths = jax.tree.map(np.asarray, plan(task, site, situation(HOMES)))
    assert float(paths.spacing_m.max()) <= 0.5
    for home, points in zip(HOMES, paths.points_m, strict=True):
        np.testing.assert_allclose(points[0], [*home, 0.0], atol=1e-3)
        np.testing.assert_allclose(points[-1, :2], home, atol=1e-3)
        assert points[-1, 2] < 0.0
        near, when = distances(points, POINTS)
        assert near.max() < 0.5 + 0.15  # corners are cut by half a metre; points of the path lie half a metre apart
        assert np.all(np.diff(when) > 0)
        np.testing.assert_allclose(points[when, 2], 10.0, atol=0.05)


def test_laps_repeat_the_points():
    site = block_site()
    made = [
        assignment("waypoints", "tarot_t650", HOMES[:1], site, points=POINTS, speed_m_s=4.0, altitude_m=10.0, laps=laps)
        for laps in (1, 3)
    ]
    once, thrice = (plan(planner.task(each), site, situation(HOMES[:1])) for each in made)
    lap = np.linalg.norm(np.diff([*POINTS, POINTS[0]], axis=0), axis=1).sum()
    assert float((thrice.length_m - once.length_m)[0]) == pytest.approx(2.0 * lap, rel=0.05)  # corners are cut


@pytest.fixture(scope="module")
def driven():
    """Paths of two rovers; the second point stands inside walls."""
    room = [(15, -15, 25, -14), (15, -6, 25, -5), (15, -15, 16, -5), (24, -15, 25, -5)]
    site = block_site([(0.0, -2.0, 4.0, 20.0), *room], terrain=lambda x, y: 0.03 * x)
    task = planner.task(assignment("waypoints", "orpheus", HOMES, site, points=POINTS, speed_m_s=1.0))
    assert isinstance(task, GroundWaypoints)
    return jax.tree.map(np.asarray, plan(task, site, situation(HOMES)))


def test_rovers_visit_the_points_over_ground_and_stop_at_the_last(driven):
    for home, points in zip(HOMES, driven.points_m, strict=True):
        np.testing.assert_allclose(points[0, :2], home, atol=1e-3)
        near, when = distances(points, [POINTS[0], POINTS[2]])
        assert near[0] < 0.6
        assert when[1] > when[0]
        np.testing.assert_allclose(points[-1, :2], POINTS[2], atol=0.05)
        np.testing.assert_allclose(points[:, 2], 0.03 * points[:, 0], atol=0.01)
        inside = (points[:, 0] > -0.2) & (points[:, 0] < 4.2) & (points[:, 1] > -2.2) & (points[:, 1] < 20.2)
        assert not inside.any()
    assert np.all(driven.speed_m_s <= 1.0 + 1e-6)
    np.testing.assert_array_equal(driven.speed_m_s[:, [0, -1]], 0.0)


def test_a_rover_leaves_out_a_point_that_it_cannot_reach(driven):
    for points in driven.points_m:
        near, _ = distances(points, [POINTS[1]])
        assert near[0] > 4.0
        assert np.isfinite(points).all()
