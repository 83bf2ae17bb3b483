"""The insides of hollow boxes that stand on the ground: of buildings and containers (host)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarmsim.site.model import Site, height_at

ABOVE_GROUND_M = 1.0
"""A cavity whose floor is higher than this above the ground below its middle, as that of a roof, is no room."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Rooms:
    """Rectangles of floor within R hollow boxes."""

    box: NDArray[np.int64]  # [R] number of the obstacle
    centre_m: Floats  # [R, 3] ENU, of the box
    reach_m: Floats  # [R, 2] from its middle along its axes, up to the margin from its walls
    axis: Floats  # [R, 2] cosine and sine of its yaw


def rooms_of(site: Site, margin_m: float) -> Rooms:
    """The hollow boxes with room for the margin, and a cavity that reaches to the ground."""
    boxes = site.obstacles
    centre, half, wall = (np.asarray(x, np.float64) for x in (boxes.centre_m, boxes.half_extent_m, boxes.wall_m))
    inner = half - wall[:, None]
    roomy = np.all(inner[:, :2] > margin_m, axis=1) & (inner[:, 2] > 0) & (wall > 0)
    floor = centre[:, 2] - inner[:, 2]
    found = np.flatnonzero(roomy & (floor < height_at(site, centre[:, :2]) + ABOVE_GROUND_M))
    axis = np.asarray(boxes.axis, np.float64)[found]
    return Rooms(box=found, centre_m=centre[found], reach_m=inner[found, :2] - margin_m, axis=axis)
