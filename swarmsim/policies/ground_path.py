"""Paths of rovers: routes over the traversability cost of a site, rounded and given speeds."""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.vehicles import Multirotor, SkidSteer
from swarmsim.policies.path import Path, limit_speed, resample
from swarmsim.policies.protocol import Assignment
from swarmsim.policies.routes import (
    at_centres,
    clearance_at,
    coarsen,
    line_clearance,
    move_clearance,
    move_costs,
    passable,
    smooth,
)
from swarmsim.pytree import on_host, pytree
from swarmsim.site import Site, sample

ROUTE_CELL_M = 1.0  # routes are planned on cells of about this size
ROUTE_POINTS = 1536
ROVER_MARGIN_M = 0.3  # kept beside the rover's half width
SMOOTHING_M = 1.0  # half width of the moving average that rounds the grid's corners
CORNER_M = 0.3  # how far the rover may cut a corner
LANDED_M = 0.5  # from where it started, within which a multirotor stands when it has landed
ENTRY_CELLS = 2  # a route begins and ends at a cell at most this many away …
ENTRY_SAMPLES = 12  # … to which the straight line is clear, as told by this many points of it
NEARER_M = 0.05  # how much nearer to an obstacle than where it stands that line may lead
CLEAR_MIN_M = 0.05  # of that line, in any case
CUT_M = 0.15  # of the margin that rounding the corners may take up


@dataclass(frozen=True)
class RouteGrid:
    """The cells that routes are planned on, for one rover."""

    site: Site
    radius_m: jax.Array  # [] clearance that the rover needs
    standing_m: jax.Array  # [V, 3] vehicles in its way
    cost: jax.Array  # [ny, nx] per metre, inf where no wheel can stand
    moves: jax.Array  # [16, ny, nx] cost of each move, inf where the rover does not fit
    origin_m: jax.Array  # [2] centre of cell [0, 0], world
    cell_m: jax.Array  # []

    def cell_of(self, xy: jax.Array) -> jax.Array:
        """Nearest cell [..., 2] (row, column) of places [..., 2]."""
        place = jnp.round((xy - self.origin_m) / self.cell_m).astype(jnp.int32)[..., ::-1]
        return jnp.clip(place, 0, jnp.array(self.cost.shape) - 1)

    def place(self, cells: jax.Array) -> jax.Array:
        """Centres [..., 2] of cells [..., 2] (row, column)."""
        return self.origin_m + self.cell_m * cells[..., ::-1].astype(jnp.float32)

    def entry(self, xy: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Where a route that begins or ends at ``xy`` [2] joins the grid: a cell [2], and whether [] there is one.

        It is the nearest cell where the rover fits, with a straight way there that leads no nearer to obstacles than
        ``xy`` is; the nearest cell of all where there is none.
        """
        nearest = self.cell_of(xy)
        span = jnp.arange(-ENTRY_CELLS, ENTRY_CELLS + 1)
        around = nearest + jnp.stack(jnp.meshgrid(span, span, indexing="ij"), axis=-1).reshape(-1, 2)
        inside = jnp.all((around >= 0) & (around < jnp.array(self.cost.shape)), axis=-1)
        around = jnp.clip(around, 0, jnp.array(self.cost.shape) - 1)
        centre = self.place(around)
        wanted = jnp.minimum(self.radius_m, clearance_at(self.site, self.standing_m, xy) - NEARER_M)
        way = line_clearance(self.site, self.standing_m, jnp.broadcast_to(xy, centre.shape), centre, ENTRY_SAMPLES)
        leaves = jnp.any(jnp.isfinite(self.moves[:, around[:, 0], around[:, 1]]), axis=0)
        good = inside & leaves & (way >= jnp.maximum(wanted, CLEAR_MIN_M))
        apart = jnp.where(good, jnp.sum((centre - xy) ** 2, axis=-1), jnp.inf)
        best = jnp.argmin(apart)
        return jnp.where(good[best], around[best], nearest), good[best]


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
    standing_m: jax.Array  # [M, V, 3] east, north and radius of multirotors that land in its way


def rover_limits(assignment: Assignment) -> RoverLimits:
    """Limits of the rovers of a phase, from their specifications (host)."""
    specs = [assignment.scenario.vehicles[i] for i in assignment.members]
    rovers = [spec for spec in specs if isinstance(spec, SkidSteer)]
    return RoverLimits(
        radius_m=on_host([0.5 * spec.chassis_size_m[1] + ROVER_MARGIN_M for spec in rovers]),
        slope_max=on_host([math.tan(math.radians(spec.slope_max_deg)) for spec in rovers]),
        step_max_m=on_host([spec.step_max_m for spec in rovers]),
        acceleration_m_s2=on_host([0.5 * spec.control.acceleration_max_m_s2 for spec in rovers]),
        standing_m=on_host(_standing(assignment)),
    )


def _standing(assignment: Assignment) -> NDArray[np.float64]:
    """East, north and radius [M, V, 3] of the multirotors, which start and land beside each of M rovers (host)."""
    scenario = assignment.scenario
    places = [
        (*member.position_m, spec.collision_radius_m + LANDED_M)
        for member, spec in zip(scenario.members, scenario.vehicles, strict=True)
        if isinstance(spec, Multirotor)
    ]
    return np.tile(np.array(places).reshape(-1, 3), (len(assignment.members), 1, 1))


def route_grid(site: Site, limits: RoverLimits, block: int) -> RouteGrid:
    """The grid for one rover with its ``limits``.

    It keeps clear of obstacles by the rover's width and a margin, and of slopes and steps that are too much for the
    site's rules (`swarmsim.config.site.Traversability`) or for the rover.
    """
    cost = jnp.where(passable(site, limits.slope_max, limits.step_max_m), site.cost, jnp.inf)
    cost = coarsen(cost, at_centres(site.clearance_m, site.terrain_m.shape), block)
    origin, cell = site.origin_m + 0.5 * (block - 1) * site.cell_m, site.cell_m * block
    rows, columns = cost.shape
    east, north = jnp.meshgrid(jnp.arange(columns), jnp.arange(rows))
    centre = origin + cell * jnp.stack([east, north], axis=-1)
    fine_cells = block * max(1, site.clearance_m.shape[0] // site.terrain_m.shape[0])
    fits = move_clearance(site, limits.standing_m, centre, cell, fine_cells) >= limits.radius_m
    return RouteGrid(site, limits.radius_m, limits.standing_m, cost, move_costs(cost, fits, cell), origin, cell)


def ground_path(site: Site, corners_m: jax.Array, speed_m_s: jax.Array, limits: RoverLimits, points: int) -> Path:
    """Round the grid's corners [W, 2] where one rover has room for it, set the speeds, lay the path on the terrain."""
    flat, length = resample(corners_m, points)
    half_width = (SMOOTHING_M * (points - 1) / jnp.maximum(length, 1.0)).astype(jnp.int32)
    wanted = jnp.minimum(limits.radius_m, clearance_at(site, limits.standing_m, flat)) - CUT_M
    rounded = flat
    for share in (4, 2, 1):  # the widest rounding that keeps clear
        wider = smooth(flat, half_width // share)
        rounded = jnp.where((clearance_at(site, limits.standing_m, wider) >= wanted)[:, None], wider, rounded)
    flat, length = resample(rounded, points)
    places = jnp.concatenate([flat, sample(site.terrain_m, site, flat)[:, None]], axis=-1)
    speed = limit_speed(places, jnp.full(points, speed_m_s), limits.acceleration_m_s2, CORNER_M)
    return Path(points_m=places, speed_m_s=speed, spacing_m=length / (points - 1), length_m=length)
