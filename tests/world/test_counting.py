"""What detectors count while vehicles go several control periods."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.world.counting import counted
from tests.world.worlds import begin, row, with_group, world

SOURCE = {"nuclide": "Cs-137", "position_m": (2.0, 6.0), "height_m": 0.5, "activity_mbq": 300.0}


def read(made, state, active_after):
    """Readings after a judging period from tick 5 to 10, in which the exposure of 9 ticks ended."""
    (before,), (group,) = state.groups, made.groups
    assert (group.counter.ticks, group.counter.evaluations, made.timing.judge_ticks) == (9, 1, 5)
    after = replace(before, active=jnp.asarray(active_after))
    (running,), first, seen = state.clock.running, jnp.int32(5), (before.vehicle.body,)
    return jax.jit(lambda: counted(made, group, state.key, first, 5, running, before, after, seen).counter.reading)()


@pytest.mark.slow
def test_an_exposure_counts_for_a_vehicle_that_had_a_part_until_it_came_to_rest_at_the_end_of_the_period():
    made = world(row("uav", "tarot_t650", 3, (-5.0, 0.0)), sources=[SOURCE])
    state = with_group(begin(made, jax.random.key(0)), 0, active=jnp.array([True, True, False]))
    reading = read(made, state, [True, False, False])
    np.testing.assert_array_equal(reading.fresh, True)
    np.testing.assert_array_equal(reading.valid, [True, True, False])


def test_a_group_that_waits_counts_nothing():
    made = world(row("uav", "tarot_t650", 3, (-5.0, 0.0)), sources=[SOURCE])
    state = begin(made, jax.random.key(0))
    state = replace(state, clock=replace(state.clock, running=jnp.zeros(1, bool)))
    reading = read(made, state, [True, True, True])
    np.testing.assert_array_equal(reading.fresh, False)
    np.testing.assert_array_equal(reading.valid, False)
