"""Small made-up sites for tests of policies."""

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import distance_transform_edt

from swarmsim.site import Site
from swarmsim.site.model import Obstacles


def block_site(blocks=(), extent=(80.0, 60.0), cell=0.5, height=6.0, terrain=lambda x, y: 0.0 * x):
    """A rectangle of ``extent`` centred on the origin with axis-parallel blocks (west, south, east, north)."""
    x = np.arange(-extent[0] / 2, extent[0] / 2 + cell / 2, cell)
    y = np.arange(-extent[1] / 2, extent[1] / 2 + cell / 2, cell)
    xs, ys = np.meshgrid(x, y)
    blocked = np.zeros(xs.shape, bool)
    for west, south, east, north in blocks:
        blocked |= (xs >= west) & (xs <= east) & (ys >= south) & (ys <= north)
    border = np.minimum.reduce([xs - x[0], x[-1] - xs, ys - y[0], y[-1] - ys])
    outside = distance_transform_edt(~blocked) * cell if blocked.any() else np.full(xs.shape, np.inf)
    clearance = np.where(blocked, -distance_transform_edt(blocked) * cell, np.minimum(outside, border))
    ground = terrain(xs, ys)
    area = np.array([[x[0], y[0]], [x[-1], y[0]], [x[-1], y[-1]], [x[0], y[-1]]])
    return Site(
        origin_m=jnp.array([x[0], y[0]], jnp.float32),
        cell_m=jnp.array(cell, jnp.float32),
        terrain_m=jnp.array(ground, jnp.float32),
        surface_m=jnp.array(ground + height * blocked, jnp.float32),
        clearance_m=jnp.array(clearance, jnp.float32),
        cost=jnp.array(np.where(blocked, np.inf, 1.0), jnp.float32),
        obstacles=Obstacles(
            centre_m=jnp.zeros((1, 3)),
            half_extent_m=jnp.zeros((1, 3)),
            axis=jnp.array([[1.0, 0.0]]),
            wall_m=jnp.zeros(1),
            material=jnp.zeros(1, jnp.int32),
        ),
        survey_area_m=jnp.array(area, jnp.float32),
        ground_material=jnp.array(0, jnp.int32),
        material_names=("air",),
    )
