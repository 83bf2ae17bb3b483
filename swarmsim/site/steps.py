"""Steps of the ground under a point: the two levels on either side of the nearest edge."""

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree
from swarmsim.site.model import Site, Steps, _cell


@pytree
class StepAt:
    """Ground near points [n]: the low level continued, and the edge beyond which the ground is higher."""

    low_m: jax.Array  # [n] height of the low level at the point
    slope: jax.Array  # [n, 2] rise per metre of both levels along x and y
    beyond_m: jax.Array  # [n] distance of the point beyond the edge; < 0 on the low side
    to_high: jax.Array  # [n, 2] unit vector from the low to the high side; zeros without an edge
    rise_m: jax.Array  # [n] height of the step; 0 without an edge


def sample_steps(steps: Steps, site: Site, xy: jax.Array) -> StepAt:
    """Levels and edge of the patch that ``xy`` [n, 2] (m, ENU) lies in."""
    corners, place, inside = _cell(site, steps.floor_m, xy)
    _, nx = steps.floor_m.shape
    column, row = jnp.moveaxis(jnp.floor((xy - site.origin_m) / site.cell_m), -1, 0)
    ny = steps.floor_m.shape[0]
    index = jnp.clip(row, 0, ny - 2).astype(jnp.int32) * nx + jnp.clip(column, 0, nx - 2).astype(jnp.int32)
    flat = steps.edge.reshape(-1)
    east, north, offset, rise = (flat.at[4 * index + k].get(mode="promise_in_bounds") for k in range(4))
    shift = [0.0, 1.0]
    at = jnp.stack([(east * x + north * y) * site.cell_m - offset for y in shift for x in shift], axis=-1)
    corners = corners - rise[:, None] * (at > 0.0)
    x, y = place[..., 0], place[..., 1]
    east_south, east_north = corners[..., 1] - corners[..., 0], corners[..., 3] - corners[..., 2]
    south, north_side = corners[..., 0] + x * east_south, corners[..., 2] + x * east_north
    slope = jnp.stack([east_south + y * (east_north - east_south), north_side - south], axis=-1)
    return StepAt(
        low_m=south + y * (north_side - south),
        slope=jnp.where(inside, slope / site.cell_m, 0.0),
        beyond_m=(east * x + north * y) * site.cell_m - offset,
        to_high=jnp.stack([east, north], axis=-1),
        rise_m=rise,
    )
