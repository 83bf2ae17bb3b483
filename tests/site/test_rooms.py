"""The insides of hollow boxes."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from swarmsim.site.rooms import rooms_of
from tests.estimation.survey import place

HALF = (6.0, 4.0, 2.5)


def site_of(boxes, wall, slope=(0.0, 0.0)):
    site = place([(centre, half, "concrete") for centre, half in boxes], slope)
    return replace(site, obstacles=replace(site.obstacles, wall_m=jnp.asarray(wall, jnp.float32)))


def test_a_room_is_a_hollow_box_that_stands_on_the_ground():
    standing, solid = ((0.0, 0.0, 2.5), HALF), ((20.0, 0.0, 2.5), HALF)
    roof, narrow = ((0.0, 20.0, 8.0), HALF), ((-20.0, 0.0, 2.5), (0.4, 4.0, 2.5))
    rooms = rooms_of(site_of([solid, standing, roof, narrow], [0.0, 0.3, 0.3, 0.3]), margin_m=0.2)
    assert rooms.box.tolist() == [1]
    np.testing.assert_allclose(rooms.reach_m, [[5.5, 3.5]], rtol=1e-6)
    np.testing.assert_allclose(rooms.centre_m, [[0.0, 0.0, 2.5]])
    np.testing.assert_allclose(rooms.axis, [[1.0, 0.0]])


def test_the_ground_is_that_below_the_box():
    slope = (0.2, 0.0)
    on_the_hill = ((40.0, 0.0, 8.0 + 2.5), HALF)
    rooms = rooms_of(site_of([on_the_hill, ((0.0, 0.0, 8.0 + 2.5), HALF)], [0.3, 0.3], slope), margin_m=0.2)
    assert rooms.box.tolist() == [0]


def test_without_hollow_boxes_there_are_none():
    assert len(rooms_of(site_of([((0.0, 0.0, 2.5), HALF)], [0.0]), margin_m=0.2).box) == 0
