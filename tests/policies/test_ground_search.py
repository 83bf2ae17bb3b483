import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import swarmsim
from swarmsim.policies.ground_path import LANDED_M, RoverLimits, rover_limits
from swarmsim.policies.ground_search import ApproachAndOrbit, SearchTask
from swarmsim.policies.routes import MOVES, coarsen, cost_to_go, descend, move_costs, smooth
from swarmsim.site import Steps
from tests.policies.assignments import assignment, situation
from tests.policies.sites import block_site

pytestmark = pytest.mark.optimised

planner = ApproachAndOrbit()
plan = jax.jit(planner.plan)
TARGET = (10.0, 4.0)


def make_task(rovers=1, standoff=4.0, viewpoints=8, radius=0.6, laps=1, slope_max=0.36, step_max=0.12, standing=()):
    limits = RoverLimits(
        radius_m=jnp.full(rovers, radius),
        slope_max=jnp.full(rovers, slope_max),
        step_max_m=jnp.full(rovers, step_max),
        acceleration_m_s2=jnp.full(rovers, 0.5),
        standing_m=jnp.broadcast_to(jnp.reshape(jnp.array(standing, jnp.float32), (-1, 3)), (rovers, len(standing), 3)),
    )
    return SearchTask(
        standoff_m=jnp.float32(standoff),
        speed_m_s=jnp.float32(0.9),
        limits=limits,
        viewpoints=viewpoints,
        laps=laps,
        block=2,
        window=20,
        points=512,
    )


def drive(start, target, site, **task):
    """The path of one rover."""
    paths = plan(make_task(**task), site, situation([start], target))
    return jax.tree.map(lambda x: x[0], paths)


def moves_over(cost, cell=1.0):
    """Moves on the ``cost`` [ny, nx] where a vehicle fits everywhere."""
    cost = jnp.asarray(cost, jnp.float32)
    return move_costs(cost, jnp.ones((len(MOVES), *cost.shape), bool), jnp.float32(cell))


def test_cost_to_go_on_open_ground_is_the_distance_within_the_grid_error():
    field = np.asarray(cost_to_go(moves_over(np.ones((41, 61)), 2.0), jnp.array([20, 30])))
    rows, columns = np.mgrid[:41, :61]
    distance = 2.0 * np.hypot(rows - 20, columns - 30)
    away = distance > 0
    assert (field[away] >= distance[away] * (1 - 1e-5)).all()
    assert (field[away] <= distance[away] * 1.0281).all()


@pytest.mark.parametrize("slanted", [False, True])
def test_no_move_leads_across_a_wall_of_one_cell(slanted):
    cost = np.ones((40, 40), np.float32)
    for row in range(5, 40):  # the gap is in the south, at rows 0 to 4
        cost[row, row if slanted else 20] = np.inf
    moves = moves_over(cost)
    field = cost_to_go(moves, jnp.array([30, 36]))
    route = np.asarray(descend(field, moves, jnp.array([36, 10]), 120))
    assert tuple(route[-1]) == (30, 36)
    assert route[:, 0].min() <= 4
    assert np.isfinite(cost[route[:, 0], route[:, 1]]).all()


@pytest.mark.slow
def test_a_route_leads_round_vehicles_that_stand_on_it():
    start, size = (-30.0, 4.0), 0.9
    places = (np.array([[-10.0, 3.8], [20.0, 30.0]]), np.array([[-10.0, 3.8], [10.0, 8.0]]))
    straight = np.asarray(drive(start, TARGET, block_site([])).points_m)[:, :2]
    for standing in places:
        given = [(*place, size) for place in standing]
        points = np.asarray(drive(start, TARGET, block_site([]), standing=given).points_m)[:, :2]
        apart = np.linalg.norm(points[:, None] - standing, axis=-1).min(axis=0)
        assert (apart >= size + 0.6 - 0.2).all()
        assert np.linalg.norm(straight - standing[0], axis=-1).min() < 0.5
        length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
        assert length < 1.05 * np.linalg.norm(np.diff(straight, axis=0), axis=1).sum() + 2.0


@pytest.mark.slow
def test_a_rover_leaves_from_beside_a_vehicle_and_has_no_way_where_these_enclose_it():
    beside = np.asarray(drive((-30.0, 4.0), TARGET, block_site([]), standing=[(-28.8, 4.0, 0.9)]).points_m)[:, :2]
    np.testing.assert_allclose(beside[0], [-30.0, 4.0], atol=1e-3)
    assert np.linalg.norm(beside - [-28.8, 4.0], axis=-1).min() > 1.1
    assert np.linalg.norm(beside - TARGET, axis=-1).min() < 6.0
    ring = [(-30.0 + 4.0 * np.cos(a), 4.0 + 4.0 * np.sin(a), 1.0) for a in np.linspace(0.0, 2.0 * np.pi, 13)[:-1]]
    assert float(drive((-30.0, 4.0), TARGET, block_site([]), standing=ring).length_m) < 1e-3


def test_multirotors_stand_in_the_way_of_rovers():
    scenario = swarmsim.load("recon", [])
    rover = next(i for i, member in enumerate(scenario.members) if member.name == "orpheus")
    standing = np.asarray(rover_limits(SimpleNamespace(scenario=scenario, members=(rover,))).standing_m)
    expected = [
        [*member.position_m, spec.collision_radius_m + LANDED_M]
        for member, spec in zip(scenario.members, scenario.vehicles, strict=True)
        if spec.kind == "multirotor"
    ]
    np.testing.assert_allclose(standing, [expected], rtol=1e-6)


def test_enclosed_goal_is_unreachable():
    cost = np.ones((20, 20), np.float32)
    cost[8:13, 8:13] = np.inf
    cost[10, 10] = 1.0
    field = np.asarray(cost_to_go(moves_over(cost), jnp.array([10, 10])))
    assert np.isfinite(field).sum() == 1


def test_coarse_cells_are_blocked_where_no_wheel_can_stand():
    cost = jnp.ones((8, 8)).at[3, 3].set(jnp.inf).at[6, 6].set(jnp.inf)
    coarse = np.asarray(coarsen(cost, jnp.full((8, 8), 0.5).at[6, 6].set(-0.1), 2))
    assert np.isinf(coarse[1, 1])  # too steep
    assert np.isfinite(coarse).sum() == 15  # an obstacle in a cell leaves the rest of it


def test_a_smoothed_line_keeps_its_ends_and_its_straight_parts():
    along = jnp.arange(0.0, 20.5, 0.5)
    corner = jnp.stack([jnp.minimum(along, 10.0), jnp.maximum(along - 10.0, 0.0)], axis=1)
    rounded = np.asarray(smooth(corner, 4))
    np.testing.assert_allclose(rounded[[0, -1]], np.asarray(corner)[[0, -1]], atol=1e-5)
    np.testing.assert_allclose(rounded[5:12], np.asarray(corner)[5:12], atol=1e-4)
    assert 0.3 < np.linalg.norm(rounded[20] - [10.0, 0.0]) < 1.0
    np.testing.assert_allclose(smooth(corner, 0), corner, atol=1e-5)


@pytest.mark.parametrize("start", [(-30.0, -20.0), (30.0, 20.0), (-30.0, 20.0)])
def test_route_starts_at_the_rover_avoids_obstacles_and_goes_round_the_target(start):
    blocks = [(-12, -10, 2, 10), (7, 2.5, 13, 5.5)]
    points = np.asarray(drive(start, TARGET, block_site(blocks)).points_m)[:, :2]
    np.testing.assert_allclose(points[0], start, atol=1e-3)
    for west, south, east, north in blocks:
        gap = np.hypot(
            np.maximum.reduce([west - points[:, 0], points[:, 0] - east, np.zeros(len(points))]),
            np.maximum.reduce([south - points[:, 1], points[:, 1] - north, np.zeros(len(points))]),
        )
        assert gap.min() > 0.45
    near = points[np.linalg.norm(points - TARGET, axis=1) < 7]
    angle = np.unwrap(np.arctan2(near[:, 1] - 4, near[:, 0] - 10))
    assert np.ptp(angle) > 1.5 * np.pi


def test_second_lap_goes_round_again():
    site = block_site([(7, 2.5, 13, 5.5)])
    once, twice = (drive((-30.0, -20.0), TARGET, site, laps=laps) for laps in (1, 2))
    lap = float(twice.length_m - once.length_m)
    assert 2 * np.pi * 3.5 < lap < 2 * np.pi * 6.5


@pytest.mark.parametrize("target", [(20.0, 0.0), None], ids=["behind a wall", "not found"])
def test_without_a_target_that_can_be_reached_the_rover_stays_where_it_is(target):
    path = drive((-30.0, 0.0), target, block_site([(-2, -30, 0, 30)]))
    assert float(path.length_m) == 0.0
    np.testing.assert_allclose(np.asarray(path.points_m)[:, :2], [[-30.0, 0.0]] * 512, atol=1e-4)


def test_each_rover_has_its_own_route_by_its_own_width():
    """Through a gap of 4 m the narrow one goes, the wide one round the wall."""
    site = block_site([(-2, -30, 0, -2.0), (-2, 2.0, 0, 20)])
    task = make_task(rovers=2)
    limits = dataclasses.replace(task.limits, radius_m=jnp.array([0.6, 2.6]))
    paths = plan(dataclasses.replace(task, limits=limits), site, situation([(-20.0, -2.0), (-20.0, 2.0)], TARGET))
    narrow, wide = np.asarray(paths.points_m)
    np.testing.assert_allclose(narrow[0, :2], [-20.0, -2.0], atol=1e-3)
    np.testing.assert_allclose(wide[0, :2], [-20.0, 2.0], atol=1e-3)
    assert narrow[:, 1].max() < 12.0
    assert wide[:, 1].max() > 20.0
    alone = drive((-20.0, -2.0), TARGET, site)
    np.testing.assert_allclose(narrow, alone.points_m, atol=1e-4)


def test_batched_routes_equal_single_ones():
    site = block_site([(-12, -10, 2, 10)])
    targets = (TARGET, (-20.0, 15.0), (25.0, -20.0))
    batch = jax.tree.map(lambda *x: jnp.stack(x), *[situation([(-30.0, -20.0)], target) for target in targets])
    together = jax.jit(jax.vmap(planner.plan, in_axes=(None, None, 0)))(make_task(), site, batch)
    for k, target in enumerate(targets):
        np.testing.assert_allclose(together.points_m[k, 0], drive((-30.0, -20.0), target, site).points_m, atol=1e-4)


def test_the_task_of_a_phase_has_the_rovers_limits_and_sizes():
    site = block_site()
    made = assignment(
        "approach_and_orbit", "orpheus", [(-30.0, -20.0)], site, target=TARGET, speed_m_s=0.8, standoff_m=5.0, laps=2
    )
    task = planner.task(made)
    np.testing.assert_allclose(task.limits.radius_m, [0.5 * 0.42 + 0.3])  # half the chassis and a margin
    np.testing.assert_allclose(task.limits.acceleration_m_s2, [0.5])
    np.testing.assert_allclose(task.limits.slope_max, np.tan(np.radians(20.0)), rtol=1e-6)
    np.testing.assert_allclose(task.limits.step_max_m, 0.12)
    assert (task.viewpoints, task.laps, task.block, task.window) == (8, 2, 2, 25)
    path = jax.tree.map(lambda x: x[0], plan(task, site, situation([(-30.0, -20.0)], TARGET)))
    distance = np.linalg.norm(np.asarray(path.points_m)[:, :2] - TARGET, axis=1)
    assert distance.min() > 3.5
    assert np.all(np.asarray(path.speed_m_s) <= 0.8 + 1e-6)
    np.testing.assert_allclose(np.linalg.norm(np.diff(path.points_m, axis=0), axis=1).max(), path.spacing_m, rtol=0.05)


def bank(x, y):
    """A bank along x = 0, of 10 degrees, with a gentle way round in the north."""
    height = np.tan(np.radians(10.0)) * np.clip(x + 3.0, 0.0, 6.0)
    return height * np.clip((20.0 - y) / 10.0, 0.0, 1.0)


def test_each_rover_keeps_to_the_slope_that_it_climbs():
    site = block_site(terrain=bank)
    steep, gentle = (drive((-30.0, -5.0), TARGET, site, slope_max=np.tan(np.radians(d))) for d in (15.0, 7.0))
    assert np.asarray(steep.points_m)[:, 1].max() < 10.0
    crossing = np.asarray(gentle.points_m)
    assert np.all(crossing[np.abs(crossing[:, 0]) < 2.0, 1] > 12.0)


@pytest.mark.parametrize(("rise", "crosses"), [(0.1, True), (0.13, False)])
def test_a_step_higher_than_the_rover_climbs_is_gone_round(rise, crosses):
    """A kerb along x = 0 that ends at y = 15."""
    site = block_site()
    rows, columns = site.terrain_m.shape
    edge = np.zeros((rows, columns, 4), np.float32)
    west = round(-float(site.origin_m[0]) / 0.5) - 1
    south = np.arange(rows) * 0.5 + float(site.origin_m[1])
    edge[south < 15.0, west] = [1.0, 0.0, 0.25, rise]
    site = dataclasses.replace(site, steps=Steps(floor_m=site.terrain_m, edge=jnp.asarray(edge)))
    path = np.asarray(drive((-30.0, 0.0), TARGET, site).points_m)
    at_kerb = path[np.abs(path[:, 0]) < 0.4, 1]
    assert (at_kerb.min() < 14.0) == crosses
