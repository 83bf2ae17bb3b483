"""The rover's drive: over the traversability cost to the hotspot and round it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from swarmsim.policies.path import Path, limit_speed, resample
from swarmsim.policies.registry import register
from swarmsim.policies.routes import coarsen, cost_to_go, descend, smooth
from swarmsim.policies.tasks import GroundTask
from swarmsim.site import Site, sample

RINGS = 9  # a viewpoint is looked for at the standoff and on 8 rings beyond it …
RING_STEP = 0.25  # … this share of the standoff apart
SMOOTHING_M = 1.0  # half width of the moving average that rounds the grid's corners
CORNER_M = 0.3  # how far the rover may cut a corner
START_COST = 10.0  # a rover that starts beside an obstacle may leave its cell at this cost per metre


@register("ground", "approach_and_orbit")
def approach_and_orbit(task: GroundTask, site: Site) -> Path:
    """Drive the cheapest way to the target, then visit viewpoints all round it, at the standoff or the nearest beyond.

    Viewpoints that cannot be reached are left out; they are visited in their order round the target, from the one
    that is cheapest to reach. If none can be reached the path has length zero: the rover stays where it is.
    """
    cell = site.cell_m * task.block
    origin = site.origin_m + 0.5 * (task.block - 1) * site.cell_m
    cost = coarsen(site.cost, site.clearance_m, task.rover_radius_m, task.block)

    def cell_of(xy: jax.Array) -> jax.Array:
        place = jnp.round((xy - origin) / cell).astype(jnp.int32)[..., ::-1]
        return jnp.clip(place, 0, jnp.array(cost.shape) - 1)

    start = cell_of(task.start_m)
    cost = cost.at[start[0], start[1]].min(START_COST)
    from_start = cost_to_go(cost, start, cell)
    views, reachable = _viewpoints(task, from_start, cell_of)
    first, legs, any_leg = _tour(task, cost, from_start, views, reachable, cell_of(task.target_m), cell)
    approach = descend(from_start, cost, first, cell, 2 * sum(cost.shape))[::-1]
    cells = jnp.concatenate([approach, legs.reshape(-1, 2)])
    xy = (origin + cell * cells[:, ::-1].astype(jnp.float32)).at[0].set(task.start_m)
    return _path(task, site, jnp.where(any_leg, xy, task.start_m))


def _viewpoints(
    task: GroundTask, from_start: jax.Array, cell_of: Callable[[jax.Array], jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """Cells [n, 2] round the target, each on the innermost ring where the rover can go, and which exist [n]."""
    angle = 2.0 * jnp.pi * jnp.arange(task.viewpoints) / task.viewpoints
    ring = task.standoff_m * (1.0 + RING_STEP * jnp.arange(RINGS))
    direction = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    cells = cell_of(task.target_m + ring[None, :, None] * direction[:, None, :])
    free = jnp.isfinite(from_start[cells[..., 0], cells[..., 1]])
    innermost = jnp.argmax(free, axis=1)
    return jnp.take_along_axis(cells, innermost[:, None, None], axis=1)[:, 0], jnp.any(free, axis=1)


def _tour(
    task: GroundTask,
    cost: jax.Array,
    from_start: jax.Array,
    views: jax.Array,
    reachable: jax.Array,
    target: jax.Array,
    cell: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """First viewpoint [2], the cells [n laps - 1, steps, 2] of the legs between viewpoints, and whether there is any.

    The legs are planned in a window round the target; a viewpoint that cannot be reached within it is left out.
    """
    n = task.viewpoints
    first = jnp.argmin(jnp.where(reachable, from_start[views[:, 0], views[:, 1]], jnp.inf))
    size = tuple(min(2 * task.window + 1, extent) for extent in cost.shape)
    corner = jnp.clip(target - task.window, 0, jnp.array(cost.shape) - jnp.array(size))
    local = jax.lax.dynamic_slice(cost, (corner[0], corner[1]), size)
    within = jnp.clip(views - corner, 0, jnp.array(size) - 1)
    fields = jax.vmap(lambda goal: cost_to_go(local, goal, cell))(within)
    linked = reachable & jnp.isfinite(fields[first, within[:, 0], within[:, 1]])
    # in their order round the target from the first one, as often as there are laps; then the last one repeats
    turn = jnp.where(linked, (jnp.arange(n) - first) % n, n)
    visited = jnp.maximum(linked.sum(), 1)
    number = jnp.minimum(jnp.arange(n * task.laps), visited * task.laps - 1)
    order = jnp.argsort(turn)[number % visited]
    steps = sum(size)

    def leg(source: jax.Array, goal: jax.Array) -> jax.Array:
        return corner + descend(fields[goal], local, within[source], cell, steps)

    legs = jax.vmap(leg)(order[:-1], order[1:]) if len(order) > 1 else views[order][None]
    return views[first], legs, jnp.any(reachable)


def _path(task: GroundTask, site: Site, corners_m: jax.Array) -> Path:
    """Round the grid's corners, set the speeds and lay the path on the terrain."""
    flat, length = resample(corners_m, task.points)
    half_width = (SMOOTHING_M * (task.points - 1) / jnp.maximum(length, 1.0)).astype(jnp.int32)
    flat, length = resample(smooth(flat, half_width), task.points)
    points = jnp.concatenate([flat, sample(site.terrain_m, site, flat)[:, None]], axis=-1)
    cruise = jnp.full(task.points, task.speed_m_s)
    speed = limit_speed(points, cruise, task.acceleration_m_s2, CORNER_M)
    return Path(points_m=points, speed_m_s=speed, spacing_m=length / (task.points - 1), length_m=length)
