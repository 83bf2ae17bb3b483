import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.policies.coverage import lines_needed, parallel_lines, points_needed
from swarmsim.policies.tasks import AerialTask
from tests.policies.sites import block_site

plan = jax.jit(parallel_lines)
HOMES = ((-38.0, -20.0), (-38.0, 0.0), (-38.0, 20.0))


def make_task(area, homes=HOMES, spacing=10.0, sweep=0.0, altitude=20.0, clearance=5.0, lines=None, points=1024):
    values = {
        "altitude_m": altitude,
        "line_spacing_m": spacing,
        "sweep_rad": sweep,
        "obstacle_clearance_m": clearance,
        "speed_m_s": 2.5,
        "climb_speed_m_s": 2.0,
        "descent_speed_m_s": 1.5,
        "touchdown_speed_m_s": 0.5,
        "acceleration_m_s2": 1.0,
    }
    return AerialTask(
        area_m=jnp.array(area, jnp.float32),
        home_m=jnp.array(homes, jnp.float32),
        lines_max=lines or lines_needed(area, spacing, sweep),
        points=points,
        **{name: jnp.float32(value) for name, value in values.items()},
    )


def rectangle(x, y):
    return ((-x, -y), (x, -y), (x, y), (-x, y))


def covered(paths, area_points, width, altitude_floor):
    """Share of points within half a swath of a path that flies above ``altitude_floor``."""
    flown = np.asarray(paths.points_m)
    flown = flown[flown[..., 2] > altitude_floor][:, :2]
    distance = np.linalg.norm(area_points[:, None] - flown[None], axis=-1).min(axis=1)
    return np.mean(distance <= width / 2 + 0.3)


def test_every_point_of_the_area_is_within_half_a_swath_of_a_line():
    site = block_site()
    paths = plan(make_task(rectangle(36, 30)), site)
    inside = np.random.default_rng(0).uniform([-35, -29], [35, 29], (400, 2))
    assert covered(paths, inside, 10.0, 19.0) == 1.0


def test_shares_are_balanced_and_total_is_the_lines_plus_transit():
    site = block_site()
    paths = plan(make_task(rectangle(36, 30)), site)
    lengths = np.asarray(paths.length_m)
    assert lengths.max() / lengths.min() < 1.1
    # 6 lines of 72 m, 3 crossings of 10 m, 3 times 20 m up and 20.4 m down, and the ways between home and line
    assert 6 * 72 + 30 + 3 * 40.4 < lengths.sum() < 6 * 72 + 30 + 3 * 40.4 + 3 * 45


def test_parts_keep_apart():
    site = block_site()
    paths = plan(make_task(rectangle(36, 30)), site)
    xy = np.asarray(paths.points_m)[..., :2]
    for a in range(3):
        for b in range(a):
            assert np.linalg.norm(xy[a][:, None] - xy[b][None], axis=-1).min() >= 9.9


def test_terrain_is_followed_and_buildings_are_cleared():
    site = block_site(blocks=[(-5, -5, 5, 5)], height=24.0, terrain=lambda x, y: 3.0 * np.sin(x / 12.0) + 0.05 * y)
    paths = plan(make_task(rectangle(36, 28)), site)
    points = np.asarray(paths.points_m).reshape(-1, 3)
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
    site = block_site()
    task = make_task(rectangle(x, y), sweep=sweep, spacing=8.0, lines=12)
    task = dataclasses.replace(task, sweep_rad=jnp.float32(sweep))
    paths = plan(task, site)
    inside = np.random.default_rng(1).uniform([-x, -y], [x, y], (200, 2))
    # lines are centred, so a border narrower than a swath may stay uncovered: whole lines only
    assert covered(paths, inside, 8.0 + 8.0, 15.0) > 0.97
    assert np.isfinite(np.asarray(paths.speed_m_s)).all()


def test_more_uavs_than_lines_leaves_the_rest_at_home():
    paths = plan(make_task(rectangle(30, 5), spacing=10.0), block_site())
    lengths = np.asarray(paths.length_m)
    assert (lengths > 60).sum() == 1
    spare = np.asarray(paths.points_m)[np.argsort(lengths)[:2], :, :2]
    assert np.ptp(spare, axis=1).max() < 1e-3


def test_host_bounds_are_enough():
    area = rectangle(36, 30)
    assert lines_needed(area, 10.0, 0.0) == 6
    points = points_needed(area, HOMES, 6, 20.0, 0.5)
    paths = plan(make_task(area, points=points), block_site())
    assert float(paths.spacing_m.max()) <= 0.5
