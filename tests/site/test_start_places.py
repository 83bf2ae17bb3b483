"""Places where a new site's vehicles can start."""

import numpy as np

from swarmsim.site.obstacles import Box
from swarmsim.site.raster import Grid
from swarmsim.site.start_places import FREE_M, start_places

GRID = Grid((0.0, 0.0), 0.5, 61, 61)
AREA = np.array([[-1.0, -1.0], [31.0, -1.0], [31.0, 31.0], [-1.0, 31.0]])
FLAT = np.zeros((61, 61))


def places(boxes: list[Box]) -> np.ndarray:
    far = np.full(FLAT.shape, 50.0)
    return np.array(start_places(GRID, FLAT, FLAT, far, np.ones(FLAT.shape), AREA, boxes))


def test_on_bare_ground_they_are_far_from_one_another():
    found = places([])
    assert len(found) == 6
    apart = np.linalg.norm(found[:, None] - found, axis=-1) + 100.0 * np.eye(6)
    assert apart.min() > 10.0


def test_none_is_beside_a_box_however_low_it_is():
    # boxes of 10 cm, which the surface above the ground hardly shows, at the corners where the first places would be
    boxes = [
        Box((x, y, 0.05), (1.5, 1.0, 0.05), (np.cos(0.5), np.sin(0.5)), 0.0) for x in (1.0, 29.0) for y in (1.0, 29.0)
    ]
    found = places(boxes)
    assert len(found) == 6
    for box in boxes:
        offset = found - np.array(box.centre[:2])
        along, across = offset @ box.axis, offset @ np.array([-box.axis[1], box.axis[0]])
        off = np.hypot(np.maximum(np.abs(along) - box.half[0], 0.0), np.maximum(np.abs(across) - box.half[1], 0.0))
        assert off.min() > FREE_M[0] - 0.5
    assert np.linalg.norm(places([])[0] - boxes[0].centre[:2]) < FREE_M[0]


def test_a_box_below_the_ground_is_no_hindrance_and_one_above_it_is():
    below = Box((29.0, 29.0, -1.0), (2.0, 2.0, 0.9), (1.0, 0.0), 0.0)
    assert np.array_equal(places([below]), places([]))
    for height in (2.5, 4.0):
        above = Box((1.0, 1.0, height), (2.0, 2.0, 1.0), (1.0, 0.0), 0.0)
        assert not np.array_equal(places([above]), places([]))
