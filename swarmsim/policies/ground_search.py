"""A rover's search round a target: the cheapest way there, then viewpoints all round it."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from swarmsim.config.policies import ApproachAndOrbit as ApproachAndOrbitSettings
from swarmsim.policies.ground_path import (
    ROUTE_POINTS,
    RoverLimits,
    ground_path,
    planning_cells,
    route_grid,
    rover_limits,
)
from swarmsim.policies.path import Path
from swarmsim.policies.protocol import Assignment, Situation
from swarmsim.policies.registry import register
from swarmsim.policies.routes import MOVES, cost_to_go, descend
from swarmsim.pytree import on_host, pytree, static
from swarmsim.site import Site

ROUTE_WINDOW_M = 25.0  # a route round the target stays this close to it
RINGS = 9  # a viewpoint is looked for at the standoff and on 8 rings beyond it …
RING_STEP = 0.25  # … this share of the standoff apart


@pytree
class SearchTask:
    """Drive M rovers to a target and around it."""

    standoff_m: jax.Array  # [] distance at which to look at the target
    speed_m_s: jax.Array  # []
    limits: RoverLimits
    viewpoints: int = static()  # places round the target to visit
    laps: int = static()  # times round the target
    block: int = static()  # cells of the site's rasters along one edge of a planning cell
    window: int = static()  # planning cells that a route round the target may stray from it
    points: int = static()  # points of the path


@register("approach_and_orbit")
class ApproachAndOrbit:
    """Drive the cheapest way to a target, then visit viewpoints all round it."""

    Settings = ApproachAndOrbitSettings
    vehicles = ("skid_steer",)

    def task(self, assignment: Assignment) -> SearchTask:
        """Distances, speeds and sizes of the phase (host)."""
        settings = assignment.settings
        assert isinstance(settings, ApproachAndOrbitSettings)
        block, cell = planning_cells(assignment.site_model.site)
        return SearchTask(
            standoff_m=on_host(settings.standoff_m),
            speed_m_s=on_host(settings.speed_m_s),
            limits=rover_limits(assignment),
            viewpoints=settings.viewpoints,
            laps=settings.laps,
            block=block,
            window=math.ceil(ROUTE_WINDOW_M / cell),
            points=ROUTE_POINTS,
        )

    def plan(self, task: SearchTask, site: Site, situation: Situation) -> Path:
        """A path for each rover, of length zero where no viewpoint can be reached: it then stays where it is.

        Viewpoints stand at the standoff or the nearest beyond; those that cannot be reached are left out. They are
        visited in their order round the target, from the one that is cheapest to reach.
        """

        def one(position: jax.Array, limits: RoverLimits) -> Path:
            grid = route_grid(site, limits, task.block)
            start, enters = grid.entry(position[:2])
            target = grid.cell_of(situation.target_m)
            from_start = cost_to_go(grid.moves, start)
            views, reachable = _viewpoints(task, situation.target_m, from_start, grid.cell_of)
            first, legs, any_leg = _tour(task, grid.moves, from_start, views, reachable, target)
            approach = descend(from_start, grid.moves, first, 2 * sum(grid.cost.shape))[::-1]
            cells = grid.place(jnp.concatenate([approach, legs.reshape(-1, 2)]))
            xy = jnp.concatenate([position[None, :2], cells])
            xy = jnp.where(any_leg & enters & situation.found, xy, position[:2])
            return ground_path(site, xy, task.speed_m_s, limits, task.points)

        return jax.vmap(one)(situation.position_m, task.limits)


def _viewpoints(
    task: SearchTask, target_m: jax.Array, from_start: jax.Array, cell_of: Callable[[jax.Array], jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """Cells [n, 2] round the target, each on the innermost ring where the rover can go, and which exist [n]."""
    angle = 2.0 * jnp.pi * jnp.arange(task.viewpoints) / task.viewpoints
    ring = task.standoff_m * (1.0 + RING_STEP * jnp.arange(RINGS))
    direction = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    cells = cell_of(target_m + ring[None, :, None] * direction[:, None, :])
    free = jnp.isfinite(from_start[cells[..., 0], cells[..., 1]])
    innermost = jnp.argmax(free, axis=1)
    return jnp.take_along_axis(cells, innermost[:, None, None], axis=1)[:, 0], jnp.any(free, axis=1)


def _tour(
    task: SearchTask,
    moves: jax.Array,
    from_start: jax.Array,
    views: jax.Array,
    reachable: jax.Array,
    target: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """First viewpoint [2], the cells [n laps - 1, steps, 2] of the legs between viewpoints, and whether there is any.

    The legs are planned in a window round the target; a viewpoint that cannot be reached within it is left out.
    """
    n = task.viewpoints
    first = jnp.argmin(jnp.where(reachable, from_start[views[:, 0], views[:, 1]], jnp.inf))
    shape = moves.shape[1:]
    size = tuple(min(2 * task.window + 1, extent) for extent in shape)
    corner = jnp.clip(target - task.window, 0, jnp.array(shape) - jnp.array(size))
    local = _window(moves, corner, size)
    within = jnp.clip(views - corner, 0, jnp.array(size) - 1)
    fields = jax.vmap(lambda goal: cost_to_go(local, goal))(within)
    linked = reachable & jnp.isfinite(fields[first, within[:, 0], within[:, 1]])
    # in their order round the target from the first one, as often as there are laps; then the last one repeats
    turn = jnp.where(linked, (jnp.arange(n) - first) % n, n)
    visited = jnp.maximum(linked.sum(), 1)
    number = jnp.minimum(jnp.arange(n * task.laps), visited * task.laps - 1)
    order = jnp.argsort(turn)[number % visited]
    steps = sum(size)

    def leg(source: jax.Array, goal: jax.Array) -> jax.Array:
        return corner + descend(fields[goal], local, within[source], steps)

    legs = jax.vmap(leg)(order[:-1], order[1:]) if len(order) > 1 else views[order][None]
    return views[first], legs, jnp.any(reachable)


def _window(moves: jax.Array, corner: jax.Array, size: tuple[int, ...]) -> jax.Array:
    """The cells [16, *size] from ``corner`` [2] on, without the moves that lead out of them."""
    local = jax.lax.dynamic_slice(moves, (0, corner[0], corner[1]), (len(MOVES), *size))
    end = jnp.stack(jnp.meshgrid(*(jnp.arange(n) for n in size), indexing="ij"), axis=-1) + MOVES[:, None, None]
    return jnp.where(jnp.all((end >= 0) & (end < jnp.array(size)), axis=-1), local, jnp.inf)
