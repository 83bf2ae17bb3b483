import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.world.right_of_way import ASIDE_S, BACK_S, PUSH_FROM_M, Traffic, kept_aside
from tests.world.point_masses import (
    ALL_PAIRS,
    SEPARATION_M,
    cloud,
    flown,
    random_tour,
    speeds,
    tour,
    traffic,
)

pytestmark = pytest.mark.optimised

# --- the rules --------------------------------------------------------------------------------------------------------


@settings(max_examples=15)
@given(seed=st.integers(0, 2**31), size=st.integers(2, 400))
def test_both_searches_give_the_same_rules(seed, size):
    rng = np.random.default_rng(seed)
    position = cloud(seed, 400, per_vehicle_m2=60.0)
    position[size:] = np.nan
    velocity = rng.normal(0.0, 3.0, (400, 3)) * (rng.random((400, 1)) < 0.6)
    given = {"flies": rng.random(400) < 0.8, "active": rng.random(400) < 0.8, "rank": rng.permutation(400)}
    given["height_m"] = np.where(given["flies"], rng.uniform(0.0, 20.0, 400), 0.0).astype(np.float32)
    cells, pairs = (traffic(position, velocity, dense_max=d, window=128, **given) for d in (0, ALL_PAIRS))
    assert not bool(cells.overflow)
    for name in ("hold", "nearest_m"):
        np.testing.assert_allclose(getattr(cells, name), getattr(pairs, name), rtol=1e-6)
    # With more encounters than are counted, the two searches count different ones.
    few = np.linalg.norm(np.asarray(pairs.push_m) - np.asarray(cells.push_m), axis=1) < 1e-3
    assert np.mean(few) > 0.95
    assert np.all(few | np.asarray(pairs.hold))


@settings(max_examples=30)
@given(seed=st.integers(0, 2**31), side=st.floats(2.0, 80.0))
def test_the_first_in_precedence_never_waits(seed, side):
    rng = np.random.default_rng(seed)
    height = rng.choice([0.0, 0.5, 2.0, 20.0], 12).astype(np.float32)
    rank = rng.permutation(12)
    position = np.c_[rng.uniform(0.0, side, (12, 2)), height]
    result = traffic(position, rng.normal(0.0, 4.0, (12, 3)), height_m=height, rank=rank)
    order = rank + np.where(height > PUSH_FROM_M, 0, 12)
    assert not bool(result.hold[np.argmin(order)])
    assert np.all(np.linalg.norm(result.push_m, axis=1) <= SEPARATION_M + 1e-4)
    assert np.all(np.asarray(result.push_m)[height <= PUSH_FROM_M] == 0.0)
    assert np.all(np.asarray(result.push_m)[~np.asarray(result.hold)] == 0.0)


def holds(position, velocity=None, **changes):
    return list(np.asarray(traffic(position, velocity, **changes).hold))


def test_of_two_in_flight_the_later_rank_waits():
    pair = [[0.0, 0.0, 20.0], [5.9, 0.0, 20.0]]
    assert holds(pair) == [False, True]
    assert holds(pair, rank=[9, 4]) == [True, False]
    assert holds([[0.0, 0.0, 20.0], [6.1, 0.0, 20.0]]) == [False, False]
    assert holds([[0.0, 0.0, 20.0], [0.0, 0.0, 26.1]]) == [False, False]
    assert holds(pair, active=[False, True]) == [False, False]
    assert holds(pair, active=[True, False]) == [False, False]


def test_one_in_flight_goes_before_one_on_the_ground():
    pair = [[0.0, 0.0, 0.2], [1.6, 0.0, 4.0]]
    assert holds(pair, height_m=[0.0, 3.8]) == [True, False]
    assert holds([[0.0, 0.0, 0.2], [1.6, 0.0, 0.2]], height_m=[0.0, 0.0]) == [False, True]


def test_rovers_wait_for_rovers_only_and_are_not_pushed():
    near = [[0.0, 0.0, 0.3], [1.9, 0.0, 0.3]]
    ground = {"height_m": [0.0, 0.0]}
    assert holds(near, flies=[False, False], **ground) == [False, True]
    assert holds([[0.0, 0.0, 0.3], [2.1, 0.0, 0.3]], flies=[False, False], **ground) == [False, False]
    assert holds(near, flies=[False, True], **ground) == [False, False]
    assert holds(near, flies=[True, False], **ground) == [False, False]
    assert np.all(traffic(near, flies=[False, False]).push_m == 0.0)


def test_one_that_closes_in_waits_before_the_separation_is_lost():
    apart = [[0.0, 0.0, 20.0], [14.0, 0.0, 20.0]]
    assert holds(apart, [[0.0, 0.0, 0.0], [-5.0, 0.0, 0.0]]) == [False, True]
    assert holds(apart, [[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) == [False, True]
    assert holds(apart, [[-5.0, 0.0, 0.0], [-5.0, 0.0, 0.0]]) == [False, True]  # behind it: it may stop
    further = [[0.0, 0.0, 20.0], [16.5, 0.0, 20.0]]
    assert holds(further, [[-5.0, 0.0, 0.0], [-5.0, 0.0, 0.0]]) == [False, False]
    assert holds(apart, [[0.0, 5.0, 0.0], [0.0, 5.0, 0.0]]) == [False, False]  # on parallel lines
    assert holds(apart, [[5.0, 0.0, 0.0], [0.0, 8.0, 0.0]]) == [False, False]  # out of its way in time


def test_one_that_waits_sets_out_only_where_there_is_room():
    passing = [[0.0, 0.0, 20.0], [20.0, 7.0, 20.0]]  # the second stands a separation and a metre aside of the first
    velocity = [[10.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    assert holds(passing, velocity) == [False, False]
    assert holds(passing, velocity, held=[False, True]) == [False, True]
    aside = [[0.0, 0.0, 20.0], [20.0, 9.1, 20.0]]
    assert holds(aside, velocity, held=[False, True]) == [False, False]


def test_one_that_stepped_aside_stays_there_until_the_other_has_passed():
    dt, gap = 0.05, 3.0
    high, flies = jnp.array([20.0]), jnp.array([True])

    def step(push, wanted):
        return kept_aside(push, jnp.array([[wanted, 0.0, 0.0]]), high, flies, jnp.float32(gap), dt)

    push = jnp.zeros((1, 3))
    for _ in range(200):  # it does what it is told, and what is still missing is wanted
        push, waits = step(push, max(gap - float(push[0, 0]), 0.0))
    assert float(push[0, 0]) == pytest.approx(gap * BACK_S / (BACK_S + ASIDE_S), rel=0.01)
    assert bool(waits[0])
    for _ in range(30):
        push, waits = step(push, 0.0)
    assert float(push[0, 0]) == pytest.approx(gap * BACK_S / (BACK_S + ASIDE_S) * np.exp(-30 * dt / BACK_S), rel=0.01)
    for _ in range(60):
        push, waits = step(push, 0.0)
    assert not bool(waits[0])
    low = kept_aside(jnp.full((1, 3), 2.0), jnp.zeros((1, 3)), jnp.array([0.5]), flies, jnp.float32(gap), dt)[0]
    assert np.all(low == 0.0)


def test_the_push_is_across_the_way_of_the_other():
    result = traffic([[0.0, 0.0, 20.0], [8.0, 2.0, 20.0]], [[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    east, north, up = np.asarray(result.push_m[1])
    assert abs(east) < 0.02
    assert north > 2.0
    assert up > 0.0
    head_on = traffic([[0.0, 0.0, 20.0], [8.0, 0.0, 20.0]], [[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert float(head_on.push_m[1, 1]) < -1.0  # to the right of one that comes east
    below = traffic([[0.0, 0.0, 20.0], [0.0, 0.0, 17.0]])
    assert float(below.push_m[1, 2]) < -2.0


@pytest.mark.parametrize(("height", "share"), [(0.0, 0.0), (1.0, 0.0), (2.0, 0.5), (3.0, 1.0), (20.0, 1.0)])
def test_the_push_fades_towards_the_ground_and_never_leads_into_it(height, share):
    pair = [[0.0, 0.0, height], [4.0, 0.0, height]]
    result = traffic(pair, height_m=[20.0, height])
    full = traffic(pair)
    np.testing.assert_allclose(result.push_m[1, :2], share * full.push_m[1, :2], atol=1e-5)
    above = traffic([[0.0, 0.0, height + 3.0], [0.0, 0.0, height]], height_m=[height + 3.0, height])
    assert float(above.push_m[1, 2]) >= -max(height - 3.0, 0.0) - 1e-6


def test_the_distance_of_the_nearest_is_given_within_the_separation():
    result = traffic([[0.0, 0.0, 9.0], [3.0, 0.0, 13.0], [40.0, 0.0, 9.0]])
    np.testing.assert_allclose(result.nearest_m, [5.0, 5.0, np.inf])


# --- flights of point masses ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fly():
    return jax.jit(flown)


@pytest.mark.slow
def test_teams_on_any_pads_take_off_cross_and_land_without_touching_or_waiting_for_ever():
    ways = jnp.stack([random_tour(seed) for seed in range(64)])
    result = jax.jit(jax.vmap(flown, (0, None)))(ways, speeds(5))
    exists = np.isfinite(np.asarray(ways)[:, :, 0, 0])
    assert not np.any(result.collided)
    np.testing.assert_array_equal(result.landed, exists)


@pytest.mark.parametrize("cruise", [2.0, 5.0, 8.0])
@pytest.mark.parametrize("aside", [0.0, 0.5, 3.0])
def test_two_that_meet_head_on_pass_each_other(fly, cruise, aside):
    pads = np.array([[-50.0, 0.0], [50.0, aside]])
    result = fly(tour(pads, pads[::-1] * [1.0, 0.0] + pads * [0.0, 1.0]), speeds(4, cruise))
    assert np.all(result.landed)
    assert np.all(np.asarray(result.nearest_m) > 2.5)


def test_two_land_side_by_side_at_the_same_time(fly):
    pads = np.array([[0.0, 0.0], [1.6, 0.0]])
    for stops in ([[40.0, 0.0], [-40.0, 0.0]], [[-40.0, 0.0], [40.0, 0.0]], [[30.0, 0.0], [30.0, 9.0]]):
        result = fly(tour(pads, np.array(stops)), speeds(4))
        assert np.all(result.landed)
        assert not np.any(result.collided)


def test_one_passes_over_others_that_wait(fly):
    pads = np.array([[-30.0, 0.0], [0.0, 0.0], [1.6, 0.0], [3.2, 0.0]])
    stops = np.array([[30.0, 0.0], [0.0, 20.0], [1.6, 20.0], [3.2, 20.0]])
    result = fly(tour(pads, stops), speeds(4))
    assert np.all(result.landed)
    assert not np.any(result.collided)


def test_a_dense_grid_of_pads_takes_off_one_after_another(fly):
    pads = 1.53 * np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
    angle = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    result = fly(tour(pads, 60.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)), speeds(4))
    assert np.all(result.landed)
    assert not np.any(result.collided)
    assert float(result.time_s) < 20 * 20.0


def test_traffic_is_a_pytree_of_arrays():
    assert isinstance(jax.tree.map(lambda x: x, traffic([[0.0, 0.0, 5.0]])), Traffic)
    alone = traffic([[0.0, 0.0, 5.0]])
    assert not np.any(alone.hold)
    assert np.isinf(alone.nearest_m[0])
