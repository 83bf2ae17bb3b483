"""One judging period of a mission: what its detectors count in it."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.missions.frame import _counted, _Flown
from tests.world.worlds import at_tick, begin, row, with_group, world

SOURCE = {"nuclide": "Cs-137", "position_m": (2.0, 6.0), "height_m": 0.5, "activity_mbq": 300.0}


def counted(made, state, active_after):
    """Readings after a judging period from tick 5 to 10, in which the exposure of 9 ticks ended."""
    (group,) = state.groups
    (counter,) = (g.counter for g in made.groups)
    assert (counter.ticks, counter.evaluations, made.timing.judge_ticks) == (9, 1, 5)
    flown = _Flown(
        state=replace(group, active=jnp.asarray(active_after)), parts=(), done_s=(), seen=(group.vehicle.body,)
    )
    mission = SimpleNamespace(world=at_tick(state, 5))
    return jax.jit(lambda: _counted(made, mission, 0, flown).counter.reading)()


def test_an_exposure_counts_for_a_vehicle_that_had_a_part_until_it_came_to_rest_at_the_end_of_the_period():
    made = world(row("uav", "tarot_t650", 3, (-5.0, 0.0)), sources=[SOURCE])
    state = with_group(begin(made, jax.random.key(0)), 0, active=jnp.array([True, True, False]))
    reading = counted(made, state, [True, False, False])
    np.testing.assert_array_equal(reading.fresh, True)
    np.testing.assert_array_equal(reading.valid, [True, True, False])


def test_a_group_that_waits_counts_nothing():
    made = world(row("uav", "tarot_t650", 3, (-5.0, 0.0)), sources=[SOURCE])
    state = begin(made, jax.random.key(0))
    state = replace(state, clock=replace(state.clock, running=jnp.zeros(1, bool)))
    reading = counted(made, state, [True, True, True])
    np.testing.assert_array_equal(reading.fresh, False)
    np.testing.assert_array_equal(reading.valid, False)
