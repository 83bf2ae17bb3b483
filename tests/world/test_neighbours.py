import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.world.neighbours import neighbours
from tests.world.point_masses import (
    ALL_PAIRS,
    cloud,
    traffic,
)

nearby = jax.jit(neighbours, static_argnames=("count", "window", "dense_max"))

# --- the K nearest ----------------------------------------------------------------------------------------------------


def brute(position, reach, count):
    distance = np.linalg.norm(position[:, None].astype(np.float64) - position[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    distance[~(distance <= reach)] = np.inf
    index = np.argsort(distance, axis=1, kind="stable")[:, :count]
    return index, np.take_along_axis(distance, index, axis=1)


@pytest.mark.parametrize("dense_max", [0, ALL_PAIRS], ids=["cell list", "all pairs"])
@pytest.mark.parametrize("size", [2, 5, 97, 300, 500])
def test_the_nearest_are_exact(size, dense_max):
    position = cloud(size, size)
    found = nearby(jnp.asarray(position), jnp.float32(60.0), 6, dense_max=dense_max)
    index, distance = brute(position, 60.0, 6)
    kept = index.shape[1]
    valid = np.isfinite(distance)
    assert not bool(found.overflow)
    np.testing.assert_array_equal(found.valid[:, :kept], valid)
    np.testing.assert_allclose(found.distance_m[:, :kept], distance, rtol=1e-5)
    np.testing.assert_array_equal(found.index[:, :kept], np.where(valid, index, np.arange(size)[:, None]))
    assert not np.any(found.valid[:, kept:])
    assert found.index.shape == found.distance_m.shape == found.valid.shape == (size, 6)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**31), reach=st.floats(0.5, 300.0), scale=st.floats(1.0, 2000.0))
def test_the_cell_list_finds_what_all_pairs_find_or_says_that_it_cannot(seed, reach, scale):
    position = jnp.asarray(cloud(seed, 300, per_vehicle_m2=scale))
    cells = nearby(position, jnp.float32(reach), 4, dense_max=0)
    pairs = nearby(position, jnp.float32(reach), 4)
    assert bool(cells.overflow) or np.allclose(cells.distance_m, pairs.distance_m, rtol=1e-6)
    assert np.all(np.asarray(cells.distance_m) >= np.asarray(pairs.distance_m) * (1.0 - 1e-6))


def test_everybody_in_one_cell_is_an_overflow():
    position = jnp.asarray(cloud(0, 300, per_vehicle_m2=0.01))
    assert bool(nearby(position, jnp.float32(50.0), 4, dense_max=0).overflow)
    assert not bool(nearby(position, jnp.float32(50.0), 4, dense_max=0, window=300).overflow)
    assert bool(traffic(position).overflow)
    assert not bool(traffic(position, dense_max=300).overflow)


def test_a_pair_on_both_sides_of_a_cell_border_is_found_everywhere():
    rng = np.random.default_rng(0)
    place = np.r_[rng.uniform(-5e3, 5e3, (150, 2)), 10.0 ** rng.uniform(0.0, 5.5, (150, 2))]
    angle = rng.uniform(0.0, 2.0 * np.pi, 300)
    place = np.c_[place, np.zeros(300)].astype(np.float32)
    mate = place + 0.98 * np.c_[np.cos(angle), np.sin(angle), np.zeros(300)].astype(np.float32)
    both = np.concatenate([place, mate])
    found = nearby(jnp.asarray(both), jnp.float32(1.0), 8, dense_max=0)
    _, distance = brute(both, 1.0, 8)
    np.testing.assert_array_equal(found.valid, np.isfinite(distance))


@pytest.mark.parametrize("dense_max", [0, ALL_PAIRS], ids=["cell list", "all pairs"])
def test_outliers_and_diverged_vehicles_leave_the_others_alone(dense_max):
    position = cloud(3, 300)
    strange = position.copy()
    strange[[4, 50]] = [[1e6, -1e6, 3.0], [-1e6, 1e6, 1e6]]
    strange[[7, 8, 9]] = [[np.nan, 0.0, 0.0], [np.inf, 1.0, 2.0], [1e30, 0.0, 0.0]]
    odd = [4, 50, 7, 8, 9]
    rest = np.setdiff1d(np.arange(300), odd)
    found = nearby(jnp.asarray(strange), jnp.float32(40.0), 5, dense_max=dense_max)
    alone = nearby(jnp.asarray(position[rest]), jnp.float32(40.0), 5)
    np.testing.assert_allclose(found.distance_m[rest], alone.distance_m, rtol=1e-6)
    assert not np.any(found.valid[np.array(odd)])
    assert not bool(found.overflow)
    rules = traffic(strange, dense_max=dense_max)
    np.testing.assert_array_equal(rules.hold[rest], traffic(position[rest]).hold)
    for leaf in (rules.push_m, rules.hold[np.array(odd)]):
        assert not np.any(np.isnan(leaf))
    assert not np.any(rules.hold[np.array(odd)])


def test_a_mission_alone_and_in_a_batch_has_the_same_neighbours():
    position = jnp.stack([jnp.asarray(cloud(seed, 120)) for seed in range(3)])
    for dense_max in (0, ALL_PAIRS):
        one = lambda p: nearby(p, jnp.float32(50.0), 3, dense_max=dense_max)  # noqa: B023, E731
        batch = jax.jit(jax.vmap(one))(position)
        for i in range(3):
            alone = one(position[i])
            np.testing.assert_array_equal(batch.index[i], alone.index)
            np.testing.assert_allclose(batch.distance_m[i], alone.distance_m, rtol=1e-6)


@pytest.mark.parametrize("dense_max", [0, ALL_PAIRS], ids=["cell list", "all pairs"])
def test_gradients_are_finite_and_right(dense_max):
    position = jnp.asarray(cloud(5, 20, per_vehicle_m2=9.0, depth=4.0)).at[3].set(jnp.nan)
    position = position.at[11].set(position[12])  # coincident

    def spread(p):
        near = nearby(p, jnp.float32(8.0), 3, dense_max=dense_max)
        rules = traffic(p, jnp.ones((20, 3)), dense_max=dense_max)
        nearest = jnp.where(jnp.isfinite(rules.nearest_m), rules.nearest_m, 0.0)
        return jnp.sum(jnp.where(near.valid, near.distance_m, 0.0)) + jnp.sum(nearest) + jnp.sum(rules.push_m**2)

    assert np.all(np.isfinite(jax.jit(jax.grad(spread))(position)))
    pair = jnp.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    gradient = jax.grad(lambda p: nearby(p, jnp.float32(9.0), 1, dense_max=dense_max).distance_m[0, 0])(pair)
    np.testing.assert_allclose(gradient, [[-0.6, -0.8, 0.0], [0.6, 0.8, 0.0]], atol=1e-6)


def test_memory_grows_with_the_number_and_not_with_its_square():
    def bytes_of(count):
        rules = jax.jit(lambda p, v: traffic(p, v)).lower(jnp.zeros((count, 3)), jnp.zeros((count, 3)))
        return rules.compile().memory_analysis().temp_size_in_bytes

    small, large = bytes_of(1000), bytes_of(2000)
    assert large < 2.2 * small
    assert small < 40e6
