"""Free places where vehicles can start: level ground, nothing near, and the rest of the site within a rover's reach."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from swarmsim.site.obstacles import Box, footprint
from swarmsim.site.raster import Floats, Grid, in_polygon

PLACES = 6
APART_M = 4.0  # between two places
FREE_M = (3.0, 2.0, 1.2)  # wanted distance to whatever stands near; the largest that some place has
STANDS_M = 0.3  # what rises further above the ground stands on it
SLOPE_MAX = 0.18  # rise per metre, 10 degrees


def start_places(
    grid: Grid, ground: Floats, surface: Floats, clear: Floats, cost: Floats, area: Floats, boxes: Sequence[Box]
) -> list[list[float]]:
    """At most `PLACES` places [x, y] (m, ENU) in the survey ``area`` [v, 2], spread over it; fewer on a small site.

    ``ground``, ``surface``, ``clear`` (clearance) and ``cost`` are [ny, nx]. All lie in the largest part of the site
    that a rover can drive through, and none beside one of the ``boxes``, however low it is: nothing may start in one.
    """
    drivable = np.isfinite(cost) & (clear > FREE_M[-1] / 2)
    part, count = ndimage.label(drivable)
    if not count:
        return []
    largest = part == 1 + np.argmax(np.bincount(part.ravel())[1:])
    level = np.hypot(*np.gradient(ground, grid.cell)) <= SLOPE_MAX
    free = (surface - ground <= STANDS_M) & ~_covered(grid, ground, boxes)
    apart = ndimage.distance_transform_edt(free) * grid.cell
    usable = largest & level & in_polygon(grid.centres, area)
    for wanted in FREE_M:
        good = usable & (np.minimum(apart, clear) > wanted)
        if good.any():
            return _spread(grid.centres[good])
    return []


def _covered(grid: Grid, ground: Floats, boxes: Sequence[Box]) -> NDArray[np.bool_]:
    """Cells [ny, nx] above whose ground a box reaches."""
    found = np.zeros(ground.shape, bool)
    for box in boxes:
        window, inside = footprint(box, grid, margin=0.5 * grid.cell)
        found[window] |= inside & (box.centre[2] + box.half[2] > ground[window])
    return found


def _spread(places: Floats) -> list[list[float]]:
    """Places far from each other: the south-west one, then each time the farthest from all before (Gonzalez 1985)."""
    chosen = [int(np.argmin(places.sum(axis=1)))]
    gap = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < PLACES and gap.max() >= APART_M:
        chosen.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return np.round(places[chosen], 2).tolist()
