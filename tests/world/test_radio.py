"""What team mates hear of each other: range, loss, delay, and the nearest first."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.world.radio import broadcast, heard
from tests.world.worlds import begin, row, with_group, world

PLACES = np.array([[-30.0, 0.0, 10.0], [-22.0, 0.0, 10.0], [-10.0, 0.0, 10.0]], np.float32)
JUDGE_S = 0.05


def team(mates=2, **radio):
    """Three UAVs and a rover without counts."""
    members = row("uav", "tarot_t650", 3, (-30.0, 0.0)) + row("rover", "orpheus", 1, (20.0, -20.0))
    return world(members, mates=mates, radio=radio)


sent = jax.jit(broadcast)


def listened(world, radio, first, size):
    """What some vehicles heard, asked when the last messages were sent."""
    return heard(world, radio, radio.tick, first, size)


def at(world, state, places, rates=(0.0, 0.0, 0.0)):
    """The state with UAVs at ``places`` that move east at 1, 2 and 3 m/s and have read count rates."""
    g = state.groups[0]
    velocity = jnp.zeros((3, 3)).at[:, 0].set(jnp.array([1.0, 2.0, 3.0]))
    body = replace(g.vehicle.body, position_m=jnp.asarray(places), velocity_m_s=velocity)
    reading = replace(g.counter.reading, counts=jnp.asarray(rates, jnp.float32), exposure_s=jnp.ones(3))
    return with_group(state, 0, vehicle=replace(g.vehicle, body=body), counter=replace(g.counter, reading=reading))


def after(world, state, periods, key=0):
    """Radio after broadcasts of one state in several periods."""
    state = replace(state, key=jax.random.key(key))
    for number in range(periods):
        state = replace(state, radio=sent(world, state, jnp.int32(number)))
    return state.radio


@pytest.mark.slow
def test_the_nearest_in_range_are_heard_as_they_are():
    field = team(range_m=15.0)
    state = at(field, begin(field, jax.random.key(0)), PLACES, rates=(100.0, 200.0, 300.0))
    told = listened(field, after(field, state, 1), 0, 3)
    np.testing.assert_array_equal(told.valid, [[True, False], [True, True], [True, False]])
    np.testing.assert_allclose(told.position_m[1], PLACES[[0, 2]])
    np.testing.assert_allclose(told.velocity_m_s[1], [[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    np.testing.assert_allclose(told.count_rate_cps, [[200.0, 0.0], [100.0, 300.0], [200.0, 0.0]])
    np.testing.assert_array_equal(told.position_m[0, 1], 0.0)  # what is not valid is zero
    np.testing.assert_array_equal(told.age_s, 0.0)
    np.testing.assert_array_equal(told.member, [[1, -1], [0, 2], [1, -1]])  # who sent it
    rover = listened(field, after(field, state, 1), 3, 1)
    assert not np.any(rover.valid)


def test_without_a_range_all_are_heard_up_to_the_number_of_mates():
    field = team(mates=2)
    state = at(field, begin(field, jax.random.key(0)), PLACES)
    radio = after(field, state, 1)
    told = listened(field, radio, 0, 3)
    assert np.all(told.valid)
    np.testing.assert_allclose(told.position_m[0], PLACES[[1, 2]])
    rover = listened(field, radio, 3, 1)
    np.testing.assert_allclose(np.asarray(rover.position_m)[0, :, 0], PLACES[[2, 1], 0])  # nearest first


def test_a_message_carries_its_sender_and_the_heading_and_grows_older():
    members = row("rover", "orpheus", 1, (20.0, -20.0)) + row("uav", "tarot_t650", 2, (-30.0, 0.0))
    members[0]["heading_deg"] = 70.0
    field = world(members, mates=2)
    radio = after(field, begin(field, jax.random.key(0)), 1)
    first = field.groups[0].size if field.groups[0].kind == "skid_steer" else 0
    told = heard(field, radio, radio.tick + 3, first, 2)
    np.testing.assert_array_equal(np.sort(told.member, axis=1), [[0, 2], [0, 1]])
    found = np.asarray(told.yaw_rad)[np.asarray(told.member) == 0]
    np.testing.assert_allclose(found, np.radians(70.0), rtol=1e-5)
    np.testing.assert_allclose(told.age_s, 0.03, rtol=1e-5)


def test_messages_arrive_after_the_delay():
    periods = 3
    field = team(delay_s=periods * JUDGE_S)
    state = at(field, begin(field, jax.random.key(0)), PLACES)
    assert field.radio.delay == periods
    seen = []
    for number in range(periods + 2):
        moved = at(field, state, PLACES + np.array([0.1 * number, 0.0, 0.0], np.float32), rates=(number, 0.0, 0.0))
        state = replace(moved, radio=sent(field, moved, jnp.int32(number)))
        told = listened(field, state.radio, 1, 1)
        first = int(np.argmin(np.abs(np.asarray(told.position_m)[0, :, 0] - PLACES[0, 0])))
        seen.append((float(told.position_m[0, first, 0] - PLACES[0, 0]), float(told.count_rate_cps[0, first])))
    np.testing.assert_allclose(told.age_s, periods * JUDGE_S, rtol=1e-5)
    # until the first message arrives the starting places are known
    np.testing.assert_allclose([x for x, _ in seen], [0.0, 0.0, 0.0, 0.0, 0.1], atol=1e-5)
    assert [rate for _, rate in seen] == [0.0, 0.0, 0.0, 0.0, 1.0]


def test_a_share_of_the_messages_is_lost():
    field = team(loss=0.3)
    state = at(field, begin(field, jax.random.key(0)), PLACES)

    def kept(key, number):
        told = listened(field, broadcast(field, replace(state, key=key), number), 0, 4)
        return told.valid

    keys = jax.random.split(jax.random.key(1), 100)
    got = jax.jit(jax.vmap(jax.vmap(kept, in_axes=(None, 0)), in_axes=(0, None)))(keys, jnp.arange(20))
    share, trials = np.mean(got), got.size
    assert share == pytest.approx(0.7, abs=4.0 * np.sqrt(0.7 * 0.3 / trials))
    assert 0.6 < np.asarray(got)[:, :, 2, 1].mean() < 0.8
    every = team(loss=1.0)
    assert not np.any(listened(every, after(every, state, 1), 0, 4).valid)


def test_without_listeners_the_radio_is_off():
    field = team(mates=0)
    state = begin(field, jax.random.key(0))
    assert listened(field, state.radio, 0, 3) is None
    assert sent(field, state, jnp.int32(0)).position_m.size == 0
