"""Where on a site a multirotor can land clear of all that stands there."""

import numpy as np
from scipy import ndimage

from swarmsim.site.model import Site

STANDS_M = 0.3
"""Height above the ground from which something stands there: a rotor would touch it."""
STOPS_M = 3.0
"""What a vehicle flies on before it has stopped, from the speed at which it looks for such a place."""
CLEAR_SLOPE = 0.25
"""Largest slope of the ground, 14 degrees, on which a multirotor is put down."""


def landing_places(site: Site, keep_m: float, border_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Nearest cells to land in [2, ny, nx] (m, east and north), and the highest surface [ny, nx] around each cell,
    as far as a vehicle flies on.

    One can land where the ground is gentle and nothing stands within ``keep_m``, ``border_m`` from the site's edge.
    Where no place is clear, each cell is its own.
    """
    terrain, surface = np.asarray(site.terrain_m, np.float64), np.asarray(site.surface_m, np.float64)
    cell = float(site.cell_m)
    slope = np.hypot(*np.gradient(terrain, cell))
    stands = (surface - terrain > STANDS_M) | (slope > CLEAR_SLOPE)
    clear = ndimage.distance_transform_edt(~stands) * cell > keep_m
    rim = int(np.ceil(border_m / cell))
    inner = np.zeros_like(clear)
    inner[rim : clear.shape[0] - rim, rim : clear.shape[1] - rim] = True
    clear &= inner
    row, column = np.indices(clear.shape)
    if clear.any():
        row, column = ndimage.distance_transform_edt(~clear, return_distances=False, return_indices=True)
    reach = 2 * int(np.ceil((keep_m + STOPS_M) / cell)) + 1
    origin = np.asarray(site.origin_m, np.float64)
    return np.stack([origin[0] + cell * column, origin[1] + cell * row]), ndimage.maximum_filter(surface, reach)
