import jax
import numpy as np
import pytest

from swarmsim.policies.orbit import OrbitPlanner
from tests.policies.assignments import assignment, situation
from tests.policies.sites import block_site

planner = OrbitPlanner()
plan = jax.jit(planner.plan)
HOMES = [(-30.0, -20.0), (-30.0, 20.0)]
TARGET = (10.0, 4.0)
RADIUS, ALTITUDE, TURNS = 8.0, 12.0, 1.5


@pytest.fixture(scope="module")
def site():
    return block_site([(16.0, 2.0, 20.0, 6.0)], height=10.0, terrain=lambda x, y: 0.02 * x)


@pytest.fixture(scope="module")
def task(site):
    settings = {"radius_m": RADIUS, "altitude_m": ALTITUDE, "turns": TURNS, "speed_m_s": 3.0, "target": TARGET}
    return planner.task(assignment("orbit", "tarot_t650", HOMES, site, **settings))


@pytest.fixture(scope="module")
def paths(task, site):
    return jax.tree.map(np.asarray, plan(task, site, situation(HOMES, TARGET)))


def test_the_circle_is_flown_as_often_as_asked_from_opposite_sides(paths):
    for number, points in enumerate(paths.points_m):
        offset = points[:, :2] - TARGET
        beside = np.flatnonzero(np.abs(np.linalg.norm(offset, axis=1) - RADIUS) > 0.1)
        last = np.argmax(np.diff(beside))  # the longest part of the path on the circle
        angle = np.unwrap(np.arctan2(*offset[beside[last] + 1 : beside[last + 1]].T[::-1]))
        assert np.cos(angle[0] - np.pi * number) > 0.99
        assert angle[-1] - angle[0] == pytest.approx(2.0 * np.pi * TURNS, abs=0.25)  # less its corners
        assert np.all(np.diff(angle) > -0.05)


def test_the_way_leads_from_the_vehicle_and_back_to_its_pad(paths):
    for home, points in zip(HOMES, paths.points_m, strict=True):
        np.testing.assert_allclose(points[0], [*home, 0.0], atol=1e-3)
        np.testing.assert_allclose(points[-1, :2], home, atol=1e-3)
        assert points[-1, 2] < 0.02 * home[0]  # below the ground: it lands


def test_altitude_and_clearance_are_kept(paths):
    points = paths.points_m.reshape(-1, 3)
    away = np.linalg.norm(points[:, None, :2] - np.array(HOMES), axis=-1).min(axis=1) > 1.0
    assert (points[away, 2] - 0.02 * points[away, 0]).min() > ALTITUDE - 0.1
    over = (np.abs(points[:, 0] - 18.0) < 2.0) & (np.abs(points[:, 1] - 4.0) < 2.0)
    assert over.any()
    assert points[over, 2].min() > 10.0 + 5.0 - 0.1
    assert float(paths.spacing_m.max()) <= 0.5
    assert np.all(paths.speed_m_s <= 3.0 + 1e-6)


def test_without_a_target_it_comes_home(task, site):
    paths = plan(task, site, situation(HOMES))
    points = np.asarray(paths.points_m)
    np.testing.assert_allclose(
        points[..., :2], np.broadcast_to(np.array(HOMES)[:, None], points[..., :2].shape), atol=1e-3
    )
    assert points[..., 2].max() > 8.0
    assert np.all(points[:, -1, 2] < 0.0)
