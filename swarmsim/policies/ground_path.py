"""Paths of rovers: routes over the traversability cost of a site, rounded and given speeds."""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from swarmsim.config.vehicles import SkidSteer
from swarmsim.policies.path import Path, limit_speed, resample
from swarmsim.policies.protocol import Assignment
from swarmsim.policies.routes import coarsen, passable, smooth
from swarmsim.pytree import on_host, pytree
from swarmsim.site import Site, sample

ROUTE_CELL_M = 1.0  # routes are planned on cells of about this size
ROUTE_POINTS = 1536
ROVER_MARGIN_M = 0.3  # kept beside the rover's half width
SMOOTHING_M = 1.0  # half width of the moving average that rounds the grid's corners
CORNER_M = 0.3  # how far the rover may cut a corner
START_COST = 10.0  # a rover that starts beside an obstacle may leave its cell at this cost per metre


@dataclass(frozen=True)
class RouteGrid:
    """The cost that routes are planned on, for one rover."""

    cost: jax.Array  # [ny, nx] per metre, inf where the rover does not fit
    origin_m: jax.Array  # [2] centre of cell [0, 0], world
    cell_m: jax.Array  # []

    def cell_of(self, xy: jax.Array) -> jax.Array:
        """Nearest cell [..., 2] (row, column) of places [..., 2]."""
        place = jnp.round((xy - self.origin_m) / self.cell_m).astype(jnp.int32)[..., ::-1]
        return jnp.clip(place, 0, jnp.array(self.cost.shape) - 1)

    def place(self, cells: jax.Array) -> jax.Array:
        """Centres [..., 2] of cells [..., 2] (row, column)."""
        return self.origin_m + self.cell_m * cells[..., ::-1].astype(jnp.float32)


def planning_cells(site: Site) -> tuple[int, float]:
    """Cells of the site's rasters along a planning cell's edge, and that edge in m (host)."""
    cell = float(site.cell_m)
    block = max(1, round(ROUTE_CELL_M / cell))
    return block, block * cell


@pytree
class RoverLimits:
    """Where M rovers can drive and how; each of them has what is said of one here."""

    radius_m: jax.Array  # [M] clearance that it needs
    slope_max: jax.Array  # [M] rise per metre
    step_max_m: jax.Array  # [M]
    acceleration_m_s2: jax.Array  # [M] of its paths


def rover_limits(assignment: Assignment) -> RoverLimits:
    """Limits of the rovers of a phase, from their specifications (host)."""
    specs = [assignment.scenario.vehicles[i] for i in assignment.members]
    rovers = [spec for spec in specs if isinstance(spec, SkidSteer)]
    return RoverLimits(
        radius_m=on_host([0.5 * spec.chassis_size_m[1] + ROVER_MARGIN_M for spec in rovers]),
        slope_max=on_host([math.tan(math.radians(spec.slope_max_deg)) for spec in rovers]),
        step_max_m=on_host([spec.step_max_m for spec in rovers]),
        acceleration_m_s2=on_host([0.5 * spec.control.acceleration_max_m_s2 for spec in rovers]),
    )


def route_grid(site: Site, limits: RoverLimits, block: int, start_m: jax.Array) -> RouteGrid:
    """The grid for one rover with its ``limits`` that stands at ``start_m`` [2]; its own cell is always open.

    It keeps clear of slopes and steps that are too much for the site's rules (`swarmsim.config.site.Traversability`) or
    for the rover.
    """
    cost = jnp.where(passable(site, limits.slope_max, limits.step_max_m), site.cost, jnp.inf)
    cost = coarsen(cost, site.clearance_m, limits.radius_m, block)
    grid = RouteGrid(cost=cost, origin_m=site.origin_m + 0.5 * (block - 1) * site.cell_m, cell_m=site.cell_m * block)
    start = grid.cell_of(start_m)
    return RouteGrid(cost=cost.at[start[0], start[1]].min(START_COST), origin_m=grid.origin_m, cell_m=grid.cell_m)


def ground_path(
    site: Site, corners_m: jax.Array, speed_m_s: jax.Array, acceleration_m_s2: jax.Array, points: int
) -> Path:
    """Round the grid's corners [W, 2], set the speeds and lay the path on the terrain."""
    flat, length = resample(corners_m, points)
    half_width = (SMOOTHING_M * (points - 1) / jnp.maximum(length, 1.0)).astype(jnp.int32)
    flat, length = resample(smooth(flat, half_width), points)
    places = jnp.concatenate([flat, sample(site.terrain_m, site, flat)[:, None]], axis=-1)
    speed = limit_speed(places, jnp.full(points, speed_m_s), acceleration_m_s2, CORNER_M)
    return Path(points_m=places, speed_m_s=speed, spacing_m=length / (points - 1), length_m=length)
