import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.policies.air_path import FlightProfile
from swarmsim.policies.coverage import ParallelLinesPlanner, SurveyTask, bands_needed, lines_needed
from tests.policies.assignments import assignment, situation
from tests.policies.sites import block_site

pytestmark = pytest.mark.optimised

planner = ParallelLinesPlanner()
fly = jax.jit(planner.plan)
HOMES = ((-38.0, -20.0), (-38.0, 0.0), (-38.0, 20.0))
SITE = block_site()
TURNED = 0.7


def make_task(area, homes=HOMES, spacing=10.0, sweep=0.0, altitude=20.0, clearance=5.0, lines=None, points=1024):
    area, homes = np.asarray(area, np.float64), np.asarray(homes, np.float32)
    profile = {
        "altitude_m": altitude,
        "obstacle_clearance_m": clearance,
        "speed_m_s": 2.5,
        "climb_speed_m_s": 2.0,
        "descent_speed_m_s": 1.5,
        "touchdown_speed_m_s": 0.5,
        "acceleration_m_s2": 1.0,
    }
    lines = lines or lines_needed(area, spacing, sweep)
    return SurveyTask(
        profile=FlightProfile(**{name: jnp.float32(value) for name, value in profile.items()}),
        area_m=jnp.asarray(area, jnp.float32),
        home_m=jnp.asarray(homes),
        line_spacing_m=jnp.float32(spacing),
        sweep_rad=jnp.float32(sweep),
        lines_max=lines,
        bands=bands_needed(area, lines, len(homes), sweep),
        points=points,
    )


def plan(task, site=SITE, positions=None):
    return fly(task, site, situation(task.home_m if positions is None else positions))


def rectangle(x, y):
    return np.array([(-x, -y), (x, -y), (x, y), (-x, y)])


def covered(paths, area_points, width, altitude_floor):
    """Share of points within half a swath of a path that flies above ``altitude_floor``."""
    flown = np.asarray(paths.points_m)
    flown = flown[flown[..., 2] > altitude_floor][:, :2]
    distance = np.linalg.norm(area_points[:, None] - flown[None], axis=-1).min(axis=1)
    return np.mean(distance <= width / 2 + 0.3)


def test_every_point_of_the_area_is_within_half_a_swath_of_a_line():
    paths = plan(make_task(rectangle(36, 30)))
    inside = np.random.default_rng(0).uniform([-35, -29], [35, 29], (400, 2))
    assert covered(paths, inside, 10.0, 19.0) == 1.0


def test_shares_are_balanced_and_total_is_the_lines_plus_transit():
    lengths = np.asarray(plan(make_task(rectangle(36, 30))).length_m)
    assert lengths.max() / lengths.min() < 1.1
    # 6 lines of 72 m, 3 crossings of 10 m, 3 times 20 m up and 20.4 m down, and the ways between home and line
    assert 6 * 72 + 30 + 3 * 40.4 < lengths.sum() < 6 * 72 + 30 + 3 * 40.4 + 3 * 45


def test_parts_keep_apart():
    xy = np.asarray(plan(make_task(rectangle(36, 30))).points_m)[..., :2]
    for a in range(3):
        for b in range(a):
            assert np.linalg.norm(xy[a][:, None] - xy[b][None], axis=-1).min() >= 9.9


def test_terrain_is_followed_and_buildings_are_cleared():
    site = block_site(blocks=[(-5, -5, 5, 5)], height=24.0, terrain=lambda x, y: 3.0 * np.sin(x / 12.0) + 0.05 * y)
    points = np.asarray(plan(make_task(rectangle(36, 28)), site).points_m).reshape(-1, 3)
    ground = 3.0 * np.sin(points[:, 0] / 12.0) + 0.05 * points[:, 1]
    home_distance = np.linalg.norm(points[:, None, :2] - np.array(HOMES)[None], axis=-1).min(axis=1)
    survey = points[home_distance > 1.0]
    height = survey[:, 2] - ground[home_distance > 1.0]
    assert height.min() > 19.9
    over = (np.abs(survey[:, 0]) < 5) & (np.abs(survey[:, 1]) < 5)
    assert over.any()
    assert (height[over] >= 24.0 + 4.9).all()
    away = (np.abs(survey[:, 0]) > 30) | (np.abs(survey[:, 1]) > 20)
    assert np.median(height[away]) == pytest.approx(20.0, abs=0.2)


@settings(max_examples=10)
@given(st.floats(-3.1, 3.1), st.floats(12.0, 36.0), st.floats(12.0, 28.0))
def test_any_sweep_direction_covers_a_rectangle(sweep, x, y):
    task = make_task(rectangle(x, y), spacing=8.0, lines=12)
    paths = plan(dataclasses.replace(task, sweep_rad=jnp.float32(sweep)))
    inside = np.random.default_rng(1).uniform([-x, -y], [x, y], (200, 2))
    # lines are centred, so a border narrower than a swath may stay uncovered: whole lines only
    assert covered(paths, inside, 8.0 + 8.0, 15.0) > 0.97
    assert np.isfinite(np.asarray(paths.speed_m_s)).all()


def homes_in_a_row(count):
    return np.stack([np.full(count, -38.0), np.linspace(-24.0, 24.0, count) + 0.3], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("sweep", [0.0, 0.7])
@pytest.mark.parametrize(
    ("x", "y", "count", "bands"),
    [(30.0, 5.0, 3, 3), (36.0, 20.0, 4, 2), (36.0, 25.0, 12, 6)],
)
def test_few_lines_are_cut_into_bands_for_many_uavs(x, y, count, bands, sweep):
    spacing, altitude = 10.0, 15.0
    turn = np.array([[np.cos(sweep), -np.sin(sweep)], [np.sin(sweep), np.cos(sweep)]])
    area = rectangle(x, y) @ turn.T
    task = make_task(area, homes=homes_in_a_row(count), spacing=spacing, sweep=sweep, altitude=altitude)
    assert task.bands == bands
    paths = plan(task)
    cells = np.stack(np.meshgrid(np.arange(-x + 0.5, x), np.arange(-y + 0.5, y)), axis=-1).reshape(-1, 2)
    assert covered(paths, cells @ turn.T, spacing, altitude - 0.5) == 1.0
    # each one's part: how far it flies on a line
    points = np.asarray(paths.points_m)
    local = points[..., :2] @ turn
    number = (local[..., 1] / spacing + 0.5 * (task.lines_max - 1)).round()
    aside = np.abs(local[..., 1] - spacing * (number - 0.5 * (task.lines_max - 1)))
    on_line = (aside < 0.02) & (np.abs(local[..., 0]) <= x + 0.1) & (points[..., 2] > altitude - 0.5)
    part = on_line.sum(axis=1) * np.asarray(paths.spacing_m)
    rounded = 0.7 * 2 * task.lines_max * task.bands  # of each piece both ends, where the path has begun to turn
    assert part.sum() == pytest.approx(2 * x * task.lines_max - rounded, rel=0.15)
    assert part.max() / part.min() < 1.6


@given(lines=st.integers(1, 60), vehicles=st.integers(1, 200))
def test_bands_divide_the_vehicles_and_balance_their_parts(lines, vehicles):
    bands = bands_needed(rectangle(40.0, 5.0 * lines), lines, vehicles, 0.0)
    assert vehicles % bands == 0
    share = vehicles // bands  # vehicles of a band
    assert lines >= share
    assert -(-lines // share) <= 1.6 * (lines // share)


def test_uavs_are_matched_to_parts_by_where_they_are():
    """Planned again in flight: from their places, and back to their own pads."""
    task = make_task(rectangle(36, 30))
    places = np.array([[0.0, 25.0, 20.0], [0.0, 0.0, 20.0], [0.0, -25.0, 20.0]], np.float32)
    points = np.asarray(plan(task, positions=places).points_m)
    np.testing.assert_allclose(points[:, 0], places, atol=1e-3)
    np.testing.assert_allclose(points[:, -1, :2], HOMES, atol=1e-3)
    middle = [np.median(path[path[:, 2] > 19.5, 1]) for path in points]
    assert middle[0] > 10.0
    assert abs(middle[1]) < 6.0
    assert middle[2] < -10.0


def test_the_task_of_a_phase_has_sizes_that_are_enough():
    area = [tuple(corner) for corner in rectangle(36.0, 30.0).tolist()]
    made = assignment(
        "parallel_lines", "tarot_t650", HOMES, SITE, area_m=area, altitude_m=20.0, speed_m_s=3.0, sweep_deg=90.0
    )
    task = planner.task(made)
    assert (task.lines_max, task.bands) == (7, 1)  # 72 m across, lines half the altitude apart
    np.testing.assert_allclose(task.home_m, HOMES)
    assert float(task.profile.acceleration_m_s2) == 2.0  # half of what the T650 is allowed
    paths = plan(task)
    assert float(paths.spacing_m.max()) <= 0.5
    inside = np.random.default_rng(0).uniform([-34, -29], [34, 29], (200, 2))
    assert covered(paths, inside, 10.0, 19.0) == 1.0
    whole = planner.task(assignment("parallel_lines", "tarot_t650", HOMES, SITE, altitude_m=20.0, speed_m_s=3.0))
    np.testing.assert_allclose(whole.area_m, SITE.survey_area_m)
    ends = np.asarray(paths.points_m)[:, -1]
    np.testing.assert_allclose(ends[:, :2], HOMES, atol=1e-3)
    assert np.all(ends[:, 2] < 0.0)  # a landing goes on into the ground
