"""Visit given points in their order: by air at a height above ground, or over ground by the cheapest routes."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.policies import Waypoints
from swarmsim.config.vehicles import Multirotor
from swarmsim.policies.air_path import FlightProfile, air_path, flight_profile, points_for
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
from swarmsim.policies.routes import cost_to_go, descend
from swarmsim.pytree import on_host, pytree, static
from swarmsim.site import Site


@pytree
class AirWaypoints:
    """Waypoints of M multirotors, which all visit them."""

    profile: FlightProfile
    home_m: jax.Array  # [M, 2] where each lands, world
    corners_m: jax.Array  # [W, 2] of all laps, world
    points: int = static()


@pytree
class GroundWaypoints:
    """Waypoints of M rovers, which all visit them."""

    corners_m: jax.Array  # [W, 2] of all laps, world
    speed_m_s: jax.Array  # []
    limits: RoverLimits
    block: int = static()  # cells of the site's rasters along one edge of a planning cell
    points: int = static()


@register("waypoints")
class WaypointsPlanner:
    """Visit points in their order; multirotors then fly home and land, rovers stop at the last one."""

    Settings = Waypoints

    def task(self, assignment: Assignment) -> Any:
        """Points, speeds and sizes of the phase (host)."""
        settings, scenario = assignment.settings, assignment.scenario
        assert isinstance(settings, Waypoints)
        specs = [scenario.vehicles[i] for i in assignment.members]
        corners = np.tile(np.array(settings.points, np.float32), (settings.laps, 1))
        homes = np.array([scenario.members[i].position_m for i in assignment.members], np.float32)
        if isinstance(specs[0], Multirotor):
            assert settings.altitude_m is not None
            tour = np.concatenate([homes[:1], corners, homes[:1]])
            spread = float(np.linalg.norm(np.ptp(homes, axis=0)))
            length = float(np.linalg.norm(np.diff(tour, axis=0), axis=1).sum()) + 2.0 * spread
            points = points_for(length, settings.altitude_m)
            return AirWaypoints(
                profile=flight_profile(settings, specs),
                home_m=on_host(homes),
                corners_m=on_host(corners),
                points=points,
            )
        block, _ = planning_cells(assignment.site_model.site)
        return GroundWaypoints(
            corners_m=on_host(corners),
            speed_m_s=on_host(settings.speed_m_s),
            limits=rover_limits(assignment),
            block=block,
            points=max(ROUTE_POINTS, 32 * len(corners)),
        )

    def plan(self, task: Any, site: Site, situation: Situation) -> Path:
        """One path for each vehicle. A rover skips a point that it cannot reach from the one before."""
        if isinstance(task, AirWaypoints):
            fly = partial(_fly, task, site)
            return jax.vmap(fly)(situation.position_m, task.home_m)
        drive = partial(_drive, task, site)
        return jax.vmap(drive)(situation.position_m, task.limits)


def _fly(task: AirWaypoints, site: Site, position: jax.Array, home: jax.Array) -> Path:
    return air_path(task.profile, site, position, home, task.corners_m, task.points)


def _drive(task: GroundWaypoints, site: Site, position: jax.Array, limits: RoverLimits) -> Path:
    grid = route_grid(site, limits, task.block)
    steps = 2 * sum(grid.cost.shape)
    start, enters = grid.entry(position[:2])

    def leg(here: jax.Array, corner: jax.Array) -> tuple[jax.Array, jax.Array]:
        goal, ends = grid.entry(corner)
        field = cost_to_go(grid.moves, goal)
        cells = descend(field, grid.moves, here, steps)
        reached = jnp.all(cells[-1] == goal)
        xy = grid.place(cells)
        return cells[-1], xy.at[-1].set(jnp.where(reached & ends, corner, xy[-1]))

    _, legs = jax.lax.scan(leg, start, task.corners_m)
    xy = jnp.concatenate([position[None, :2], jnp.where(enters, legs.reshape(-1, 2), position[:2])])
    return ground_path(site, xy, task.speed_m_s, limits, task.points)
