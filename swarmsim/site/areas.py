"""Areas on the ground: convex polygons, counter-clockwise (host)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

ON_THE_EDGE = 1e-5  # of a polygon's size: a place so near to an edge is in it


def within(areas_m: Sequence[ArrayLike], xy_m: ArrayLike) -> NDArray[np.bool_]:
    """Whether places [n, 2] lie in any of the ``areas_m``, each the corners [V, 2] of a convex polygon."""
    xy = np.asarray(xy_m, float)
    inside = np.zeros(len(xy), bool)
    for area in areas_m:
        corners = np.asarray(area, float)
        edges = np.roll(corners, -1, axis=0) - corners
        offset = xy[:, None] - corners
        left = edges[:, 0] * offset[..., 1] - edges[:, 1] * offset[..., 0]
        inside |= np.all(left >= -ON_THE_EDGE * np.linalg.norm(edges, axis=1) * np.ptp(corners, axis=0).max(), axis=1)
    return inside
