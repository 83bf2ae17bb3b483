"""A mission's keys: its own, one for each consumer, and the same in any company."""

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim import randomness


def data(keys):
    return np.asarray(jax.random.key_data(keys))


def test_consumers_seeds_occasions_and_vehicles_have_their_own_keys():
    found = [
        tuple(key)
        for mission in randomness.mission_keys(np.arange(4))
        for name in ("gusts", "counts", "radio")
        for number in range(3)
        for key in data(randomness.per_vehicle(randomness.consumer(mission, name), jnp.int32(number), jnp.arange(3)))
    ]
    assert len(set(found)) == len(found) == 4 * 3 * 3 * 3


def test_a_vehicles_key_depends_on_its_number_and_not_on_its_group():
    key = randomness.consumer(randomness.mission_keys(np.array([7]))[0], "gusts")
    whole = randomness.per_vehicle(key, jnp.int32(5), jnp.arange(6))
    part = randomness.per_vehicle(key, jnp.int32(5), jnp.array([4, 1]))
    np.testing.assert_array_equal(data(whole)[[4, 1]], data(part))


def test_a_missions_key_is_that_of_its_seed():
    keys = randomness.mission_keys(np.array([3, 2**31 - 1]))
    np.testing.assert_array_equal(data(keys[0]), data(jax.random.key(3)))
    np.testing.assert_array_equal(data(keys[1]), data(jax.random.key(2**31 - 1)))
