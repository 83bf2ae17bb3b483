import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.policies.ground_search import approach_and_orbit
from swarmsim.policies.routes import coarsen, cost_to_go, descend
from swarmsim.policies.tasks import GroundTask
from tests.policies.sites import block_site

drive = jax.jit(approach_and_orbit)


def make_task(start, target, standoff=4.0, viewpoints=8, radius=0.6, laps=1):
    values = {"standoff_m": standoff, "speed_m_s": 0.9, "acceleration_m_s2": 0.5, "rover_radius_m": radius}
    return GroundTask(
        start_m=jnp.array(start, jnp.float32),
        target_m=jnp.array(target, jnp.float32),
        viewpoints=viewpoints,
        laps=laps,
        block=2,
        window=20,
        points=512,
        **{name: jnp.float32(value) for name, value in values.items()},
    )


def test_cost_to_go_on_open_ground_is_the_distance_within_the_grid_error():
    cost = jnp.ones((41, 61))
    field = np.asarray(cost_to_go(cost, jnp.array([20, 30]), jnp.float32(2.0)))
    rows, columns = np.mgrid[:41, :61]
    distance = 2.0 * np.hypot(rows - 20, columns - 30)
    away = distance > 0
    assert (field[away] >= distance[away] * (1 - 1e-5)).all()
    assert (field[away] <= distance[away] * 1.0281).all()


def test_detour_takes_the_cheaper_side_of_a_wall():
    cost = np.ones((40, 40), np.float32)
    cost[5:40, 20] = np.inf  # the gap is in the south, at rows 0 to 4
    cost[5:40, 21] = np.inf
    field = cost_to_go(jnp.array(cost), jnp.array([30, 30]), jnp.float32(1.0))
    route = np.asarray(descend(field, jnp.array(cost), jnp.array([30, 10]), jnp.float32(1.0), 120))
    assert tuple(route[-1]) == (30, 30)
    assert route[:, 0].min() <= 4
    assert np.isfinite(cost[route[:, 0], route[:, 1]]).all()


def test_enclosed_goal_is_unreachable():
    cost = np.ones((20, 20), np.float32)
    cost[8:13, 8:13] = np.inf
    cost[10, 10] = 1.0
    field = np.asarray(cost_to_go(jnp.array(cost), jnp.array([10, 10]), jnp.float32(1.0)))
    assert np.isfinite(field).sum() == 1


def test_coarse_cells_are_blocked_where_the_rover_does_not_fit():
    cost = jnp.ones((8, 8)).at[3, 3].set(jnp.inf)
    coarse = np.asarray(coarsen(cost, jnp.full((8, 8), 0.5).at[6, 6].set(0.1), jnp.float32(0.4), 2))
    assert np.isinf(coarse[1, 1])
    assert np.isinf(coarse[3, 3])
    assert np.isfinite(coarse).sum() == 14


@pytest.mark.parametrize("start", [(-30.0, -20.0), (30.0, 20.0), (-30.0, 20.0)])
def test_route_starts_at_the_rover_avoids_obstacles_and_goes_round_the_target(start):
    blocks = [(-12, -10, 2, 10), (7, 2.5, 13, 5.5)]
    path = drive(make_task(start, (10.0, 4.0)), block_site(blocks))
    points = np.asarray(path.points_m)[:, :2]
    np.testing.assert_allclose(points[0], start, atol=1e-3)
    for west, south, east, north in blocks:
        gap = np.hypot(
            np.maximum.reduce([west - points[:, 0], points[:, 0] - east, np.zeros(len(points))]),
            np.maximum.reduce([south - points[:, 1], points[:, 1] - north, np.zeros(len(points))]),
        )
        assert gap.min() > 0.45
    near = points[np.linalg.norm(points - [10, 4], axis=1) < 7]
    angle = np.unwrap(np.arctan2(near[:, 1] - 4, near[:, 0] - 10))
    assert np.ptp(angle) > 1.5 * np.pi


def test_second_lap_goes_round_again():
    site = block_site([(7, 2.5, 13, 5.5)])
    once, twice = (drive(make_task((-30.0, -20.0), (10.0, 4.0), laps=laps), site) for laps in (1, 2))
    lap = float(twice.length_m - once.length_m)
    assert 2 * np.pi * 3.5 < lap < 2 * np.pi * 6.5


def test_unreachable_target_leaves_the_rover_where_it_is():
    walls = [(-2, -30, 0, 30)]
    path = drive(make_task((-30.0, 0.0), (20.0, 0.0)), block_site(walls))
    assert float(path.length_m) == 0.0
    np.testing.assert_allclose(np.asarray(path.points_m)[:, :2], [[-30.0, 0.0]] * 512, atol=1e-4)


def test_batched_routes_equal_single_ones():
    site = block_site([(-12, -10, 2, 10)])
    tasks = [make_task((-30.0, -20.0), target) for target in ((10.0, 4.0), (-20.0, 15.0), (25.0, -20.0))]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *tasks)
    together = jax.jit(jax.vmap(approach_and_orbit, in_axes=(0, None)))(batch, site)
    for k, task in enumerate(tasks):
        np.testing.assert_allclose(together.points_m[k], drive(task, site).points_m, atol=1e-4)
