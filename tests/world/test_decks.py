"""Decks of rovers as ground: they move as the rover does where one stands on them, and only while it is moved on."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.world.decks import on_decks
from tests.world.worlds import begin, row, with_group, world

FOOT_M = 0.2289  # of the x500, below its centre of mass
SPEED_M_S, TURN_RAD_S = 1.0, 0.5


@pytest.fixture(scope="module")
def place():
    """A UAV that stands 0.2 m ahead of the middle of a rover's deck, while the rover drives east and turns left."""
    made = world(row("uav", "x500", 1, (-30.0, 0.0)) + row("rover", "orpheus", 1, (-20.0, 0.0)))
    state = begin(made, jax.random.key(0))
    rover = state.groups[1].vehicle
    spin = rover.body.angular_velocity_rad_s.at[0, 2].set(TURN_RAD_S)
    body = replace(rover.body, velocity_m_s=jnp.array([[SPEED_M_S, 0.0, 0.0]]), angular_velocity_rad_s=spin)
    state = with_group(state, 1, vehicle=replace(rover, body=body))
    above = jnp.array([0.2, 0.0, made.groups[1].limits.deck_m[0, 2] + FOOT_M])
    return made, standing(state, rover.body.position_m + above)


def standing(state, place_m):
    uav = state.groups[0].vehicle
    body = replace(uav.body, position_m=place_m)
    return with_group(state, 0, vehicle=replace(uav, body=body))


def test_the_deck_moves_as_the_rover_does_below_the_feet(place):
    made, state = place
    uav, _ = on_decks(made, state.groups)
    np.testing.assert_allclose(uav.around.ground.velocity_m_s, [[SPEED_M_S, 0.2 * TURN_RAD_S, 0.0]], atol=1e-3)
    np.testing.assert_allclose(uav.around.height_m, 0.0, atol=1e-3)
    assert bool(uav.around.rides[0])


def test_the_deck_of_a_rover_that_is_not_moved_on_stands_still(place):
    made, state = place
    waiting = with_group(state, 1, active=jnp.array([False]))
    uav, _ = on_decks(made, waiting.groups)
    np.testing.assert_array_equal(uav.around.ground.velocity_m_s, 0.0)
    assert bool(uav.around.rides[0])


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.5), (1.0, 0.0, 0.0)])
def test_who_flies_over_the_deck_or_is_beside_it_does_not_ride(place, offset):
    made, state = place
    away = standing(state, state.groups[0].vehicle.body.position_m + jnp.array(offset))
    uav, _ = on_decks(made, away.groups)
    assert not bool(uav.around.rides[0])
