"""The small parts of a rollout: right of way, events, keys, spreading over devices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from swarmsim.missions.batching import batched, in_groups, shards_of, spread
from swarmsim.missions.flight import Traffic, follow, keep_apart
from swarmsim.missions.stage import Clock, Stage

from swarmsim.missions import events, keys
from swarmsim.policies.path import Path

ACTIVE = jnp.array([True, True, True])
RADIUS = jnp.full(3, 0.5)
apart = jax.jit(keep_apart)


def test_the_later_vehicle_gives_way_and_only_when_close():
    position = jnp.array([[0.0, 0.0, 20.0], [3.0, 0.0, 20.0], [50.0, 0.0, 20.0]])
    traffic = apart(position, ACTIVE, RADIUS, jnp.float32(6.0))
    np.testing.assert_array_equal(traffic.hold, [False, True, False])
    np.testing.assert_allclose(traffic.push_m, [[0, 0, 0], [3, 0, 0], [0, 0, 0]], atol=1e-4)
    assert not traffic.collided.any()


def test_vehicles_that_touch_have_collided_unless_they_are_down():
    position = jnp.array([[0.0, 0.0, 20.0], [0.8, 0.0, 20.0], [0.8, 0.4, 20.0]])
    np.testing.assert_array_equal(apart(position, ACTIVE, RADIUS, jnp.float32(6.0)).collided, [True, True, True])
    down = jnp.array([True, False, False])
    traffic = apart(position, down, RADIUS, jnp.float32(6.0))
    assert not traffic.collided.any()
    assert not traffic.hold.any()


@given(st.integers(0, 2**32 - 1))
def test_traffic_is_finite_even_at_one_place(seed):
    position = jax.random.normal(jax.random.key(seed), (3, 3)) * jnp.array([1.0, 0.0, 0.0])
    traffic = apart(position.at[1].set(position[0]), ACTIVE, RADIUS, jnp.float32(6.0))
    assert np.isfinite(np.asarray(traffic.push_m)).all()


def straight():
    points = jnp.stack([jnp.linspace(0.0, 10.0, 21), jnp.zeros(21), jnp.full(21, 5.0)], axis=1)
    return Path(points_m=points, speed_m_s=jnp.full(21, 2.0), spacing_m=jnp.float32(0.5), length_m=jnp.float32(10.0))


def free(hold=False):
    return Traffic(hold=jnp.array(hold), push_m=jnp.zeros(3), collided=jnp.array(False))


def test_the_reference_waits_for_traffic_and_for_a_vehicle_behind():
    path, here = straight(), jnp.array([4.0, 0.0, 5.0])
    _, on = follow(path, jnp.float32(4.0), here, free(), jnp.float32(0.0), 0.1)
    setpoint, held = follow(path, jnp.float32(4.0), here, free(hold=True), jnp.float32(0.0), 0.1)
    _, behind = follow(path, jnp.float32(4.0), here - jnp.array([3.0, 0.0, 0.0]), free(), jnp.float32(0.0), 0.1)
    assert float(on) == pytest.approx(4.2)
    assert float(held) == 4.0
    assert float(behind) == 4.0
    np.testing.assert_array_equal(setpoint.velocity_m_s, 0.0)


def test_only_the_first_event_ends_a_vehicles_part():
    nothing = jnp.zeros(len(events.KINDS), bool)
    times = events.record(events.none_yet(), nothing.at[events.OBSTACLE].set(True), jnp.float32(3.0))
    times = events.record(times, nothing.at[events.CRASH].set(True), jnp.float32(4.0))
    assert float(times[events.OBSTACLE]) == 3.0
    assert np.isinf(float(times[events.CRASH]))
    assert bool(events.crashed(times))
    done = events.record(events.none_yet(), nothing.at[events.FINISHED].set(True), jnp.float32(9.0))
    assert not bool(events.crashed(done))
    assert not bool(events.under_way(done))


def test_randomness_does_not_depend_on_how_ticks_are_grouped():
    key = keys.consumer(keys.mission_keys(jnp.array([7]))[0], "gusts")
    whole = jax.random.key_data(keys.per_tick(key, jnp.arange(10), 3))
    parts = [jax.random.key_data(keys.per_tick(key, jnp.arange(a, b), 3)) for a, b in ((0, 4), (4, 10))]
    np.testing.assert_array_equal(whole, np.concatenate(parts))
    assert len(np.unique(np.asarray(whole).reshape(-1, 2), axis=0)) == 30


def test_consumers_and_seeds_have_their_own_keys():
    data = [
        tuple(np.asarray(jax.random.key_data(keys.consumer(key, name))))
        for key in keys.mission_keys(jnp.arange(4))
        for name in ("gusts", "counts", "spectrum")
    ]
    assert len(set(data)) == len(data)


@pytest.mark.parametrize("missions", [1, 2, 5])
def test_in_groups_equals_in_step_and_spread(missions):
    def function(x, shared):
        return jnp.cumsum(x) * shared, jnp.sum(x)

    x = jnp.arange(12.0 * missions).reshape(missions, 12)
    in_step = jax.jit(batched(function, (0, None), missions))(x, 3.0)
    in_turn = jax.jit(in_groups(function, (0, None), 1))(x, 3.0)
    by_three = jax.jit(in_groups(function, (0, None), 3))(x, 3.0)
    over = jax.jit(spread(batched(function, (0, None), missions), (0, None), 1))(x, 3.0)
    for expected, *others in zip(in_step, in_turn, by_three, over, strict=True):
        for other in others:
            np.testing.assert_allclose(other, expected, rtol=1e-6)


def test_a_batch_spread_over_devices_equals_one_on_one_device():
    def until_small(x, limit):
        return jax.lax.while_loop(lambda v: v > limit, lambda v: 0.5 * v, x)

    assert len(jax.devices()) == 2
    x = jnp.array([1.0, 1000.0, 3.0, 1e6])
    part = batched(until_small, (0, None), 2)
    over = jax.jit(spread(part, (0, None), 2))(x, 0.7)
    alone = jax.jit(batched(until_small, (0, None), 4))(x, 0.7)
    np.testing.assert_array_equal(over, alone)
    assert len(over.sharding.device_set) == 2


def test_a_batch_is_spread_only_where_every_device_gets_two():
    devices = len(jax.devices())
    assert shards_of(1) == 1
    assert shards_of(3) == 1
    assert shards_of(1000) == devices


def test_a_stage_compiles_once_for_each_shape_and_keeps_times_apart():
    clock = Clock()
    stage = Stage("double", lambda x: 2 * x, clock)
    np.testing.assert_array_equal(stage(jnp.arange(3)), [0, 2, 4])
    compiled = clock.compile_s
    assert compiled > 0
    stage(jnp.arange(3) + 1)
    assert clock.compile_s == compiled
    stage(jnp.arange(4))
    assert clock.compile_s > compiled
    assert clock.run_s > 0
    clock.reset()
    assert clock.compile_s == clock.run_s == 0.0
