"""Checks of a scenario against its site: what stands outside, inside a wall, or has no room."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.checks import footprint_radius_m
from swarmsim.config.documents import Place
from swarmsim.config.errors import Problem, first_problems
from swarmsim.config.policies import ApproachAndOrbit, Orbit, ParallelLines, Waypoints, line_spacing
from swarmsim.config.scenario import Scenario
from swarmsim.config.sources import points_of
from swarmsim.config.vehicles import Multirotor, SkidSteer

if TYPE_CHECKING:
    from swarmsim.site import Site, SiteModel

Floats = NDArray[np.float64]

OVERHEAD_M = 0.4  # a surface this far above the terrain is an obstacle to a UAV, not ground
OUTLINE_POINTS = 12  # along each side of a rover
POROUS_KG_M3 = 100.0  # a thing of a lower bulk density is foliage or straw: a source can lie in it


def check_site(scenario: Scenario, model: SiteModel | None = None) -> list[Problem]:
    """What of the scenario does not fit its site; ``model`` is the loaded site, where the caller has it already.

    Raises `InputError` when the site itself cannot be loaded.
    """
    if model is None:
        from swarmsim.site import load_site

        model = load_site(scenario.site_file, tuple(scenario.materials))
    ground = Ground(model.site, scenario)
    checks = (_check_sources, _check_vehicles, _check_areas, _check_points)
    return first_problems(problem for check in checks for problem in check(scenario, ground))


class Ground:
    """The site's arrays on the host."""

    def __init__(self, site: Site, scenario: Scenario):
        self.site = site
        self.cell = float(site.cell_m)
        self.terrain = np.asarray(site.terrain_m, float)
        self.surface = np.asarray(site.surface_m, float)
        self.site = site
        self.low = np.asarray(site.origin_m, float) - self.cell / 2
        self.high = self.low + self.cell * np.array(self.terrain.shape[::-1])
        self.area = np.asarray(site.survey_area_m, float)
        boxes = site.obstacles
        self.centre = np.asarray(boxes.centre_m, float)
        self.half = np.asarray(boxes.half_extent_m, float)
        self.axis = np.asarray(boxes.axis, float)
        self.wall = np.asarray(boxes.wall_m, float)
        self.material = [site.material_names[int(i)] for i in np.asarray(boxes.material)]
        self.porous = np.array([scenario.materials[name].density_kg_m3 < POROUS_KG_M3 for name in self.material])

    @property
    def extent(self) -> str:
        """What positions are allowed, in words."""
        (west, south), (east, north) = self.low, self.high
        return f"x from {west:g} to {east:g}, y from {south:g} to {north:g}"

    def holds(self, xy: Floats) -> bool:
        """Whether ``xy`` [2] lies on the site."""
        return bool(np.all(xy >= self.low) and np.all(xy <= self.high))

    def cell_value(self, raster: Floats, xy: Floats) -> float:
        """Value of the cell that ``xy`` [2] lies in."""
        rows, columns = raster.shape
        column, row = np.clip(((xy - self.low) / self.cell).astype(int), 0, [columns - 1, rows - 1])
        return float(raster[row, column])

    def rises_within(self, xy: Floats, radius: float) -> float:
        """How far the highest surface rises above the ground within ``radius`` of ``xy`` [2], m."""
        rows, columns = self.terrain.shape
        corners = np.stack([xy - radius, xy + radius])
        (left, low), (right, high) = np.clip(((corners - self.low) / self.cell).astype(int), 0, [columns - 1, rows - 1])
        window = np.s_[low : high + 1, left : right + 1]
        return float(np.max(self.surface[window] - self.terrain[window]))

    def clearances(self, xy: Floats) -> Floats:
        """Clearance [p] at points [p, 2], bilinear as the bumpers have it."""
        import jax.numpy as jnp

        from swarmsim.site import sample

        return np.asarray(sample(self.site.clearance_m, self.site, jnp.asarray(xy, jnp.float32)), float)

    def least_clearance(self, xy: Floats) -> float:
        """Least clearance of a rover at points [p, 2]."""
        return float(np.min(self.clearances(xy)))

    def above(self, xy: Floats, height_m: float) -> Floats:
        """Points [n, 3] that lie ``height_m`` above the terrain at ``xy`` [n, 2]."""
        from swarmsim.site.model import height_at

        return np.concatenate([xy, (height_at(self.site, xy) + height_m)[:, None]], axis=1)

    def depth(self, points: Floats) -> Floats:
        """How deep points [..., 3] lie within each box, along the box's own axes [..., K, 3]; < 0 outside."""
        offset = points[..., None, :] - self.centre
        along = offset[..., 0] * self.axis[:, 0] + offset[..., 1] * self.axis[:, 1]
        across = -offset[..., 0] * self.axis[:, 1] + offset[..., 1] * self.axis[:, 0]
        depth: Floats = self.half - np.abs(np.stack([along, across, offset[..., 2]], axis=-1))
        return depth

    def blocked(self, points: Floats) -> NDArray[np.bool_]:
        """Which boxes [..., K] points [..., 3] lie in where no source can: solid ones, and walls of hollow ones."""
        depth = self.depth(points)
        within = np.all(depth > 0, axis=-1)
        in_cavity = (self.wall > 0) & np.all(depth >= self.wall[:, None], axis=-1)
        blocked: NDArray[np.bool_] = within & ~in_cavity & ~self.porous
        return blocked


def _check_sources(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    drawn = {varied.place[1] for varied in scenario.family if varied.distribution.place is not None}
    for i, source in enumerate(scenario.mission.sources):
        if source.activity_mbq == 0.0:  # a family's mission has fewer sources than its largest one
            continue
        if i in drawn or source.height_m is None:  # a carried one is where its vehicle is
            continue
        place: Place = ("sources", i, source.place_field)
        outside = [list(corner) for corner in source.corners_m if not ground.holds(np.array(corner))]
        if outside:
            given = ", ".join(map(str, outside))
            yield scenario.problem(place, "the source lies outside the site", given=given, allowed=ground.extent)
            continue
        points = ground.above(points_of(source).xy_m, source.height_m)
        within, boxes = np.nonzero(ground.blocked(points))
        if len(boxes):
            k, lies = int(boxes[0]), "the source lies"
            given = str(list(source.position_m)) if source.position_m else _point(points[within[0], :2])
            if source.form != "point":
                lies = f"{len(set(within))} of the {len(points)} points of the source lie"
            what = "the wall of a building" if ground.wall[k] > 0 else "a solid obstacle"
            yield scenario.problem(
                place,
                f"{lies} inside {what} of {ground.material[k]}",
                given=f"{given}, height_m {source.height_m:g}",
                allowed="the open, or the hollow inside of a building",
                suggestion=f"the obstacle's centre is at {_point(ground.centre[k, :2])}; move the source by the wall's "
                "thickness or more",
            )


def _check_vehicles(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """Starts that do not fit; the members of a formation are told once for each kind of fault."""
    found: dict[tuple[int, str], list[tuple[int, dict[str, str]]]] = {}
    for i in range(len(scenario.members)):
        fault = _start_fault(scenario, ground, i)
        if fault is not None:
            message, details = fault
            found.setdefault((scenario.entries[i], message), []).append((i, details))
    for (entry, message), members in found.items():
        first, details = members[0]
        others = f" (and {len(members) - 1} more of its formation)" if len(members) > 1 else ""
        yield scenario.problem(
            ("vehicles", entry, "position_m"),
            f"'{scenario.members[first].name}'{others} starts {message}",
            given=str(list(scenario.members[first].position_m)),
            **details,
        )


def _start_fault(scenario: Scenario, ground: Ground, i: int) -> tuple[str, dict[str, str]] | None:
    """What is wrong with the start of member ``i``, as the end of a sentence, and the details of the problem."""
    vehicle, xy = scenario.vehicles[i], np.array(scenario.members[i].position_m)
    radius = footprint_radius_m(vehicle)
    if not ground.holds(xy):
        return "outside the site", {"allowed": ground.extent}
    height = vehicle.chassis_height_m if isinstance(vehicle, SkidSteer) else vehicle.collision_height_m
    depth = ground.depth(np.array([*xy, ground.cell_value(ground.terrain, xy) + height / 2]))
    touching = np.flatnonzero((depth[:, :2].min(axis=1) > -radius) & (depth[:, 2] > -height / 2))
    touching = touching[np.all(ground.half[touching] > 0, axis=1)]
    if touching.size:
        k = int(touching[0])
        return f"inside an obstacle of {ground.material[k]}, or touches it", {
            "allowed": f"at least {radius:.2f} m from every obstacle",
            "suggestion": f"the obstacle's centre is at {_point(ground.centre[k, :2])}",
        }
    if isinstance(vehicle, Multirotor) and ground.rises_within(xy, radius + ground.cell) > OVERHEAD_M:
        return "below something that stands there, such as a tree or a roof", {
            "allowed": f"a place with nothing above the ground within {radius:.2f} m"
        }
    if isinstance(vehicle, SkidSteer) and ground.least_clearance(_outline(scenario, i)) <= 0:
        return "where a rover cannot drive (obstacle, closed zone or edge of the site)", {
            "allowed": "traversable ground"
        }
    return None


def _outline(scenario: Scenario, i: int) -> Floats:
    """Points [p, 2] (m, ENU) along the outline of a rover at its start, and its centre: what its bumpers sense."""
    from swarmsim.vehicles.rover_body import rover_body

    vehicle, member = scenario.vehicles[i], scenario.members[i]
    assert isinstance(vehicle, SkidSteer)
    rear, front, right, left = rover_body(vehicle).outline_m
    share = np.linspace(0.0, 1.0, OUTLINE_POINTS)
    x, y = rear + share * (front - rear), right + share * (left - right)
    sides = [(x, 0 * x + right), (x, 0 * x + left), (0 * y + rear, y), (0 * y + front, y), (np.zeros(1), np.zeros(1))]
    own = np.concatenate([np.stack(side, axis=-1) for side in sides])
    cos, sin = math.cos(math.radians(member.heading_deg)), math.sin(math.radians(member.heading_deg))
    return own @ np.array([[cos, sin], [-sin, cos]]) + np.array(member.position_m)


def _check_areas(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """Survey areas beyond the site, or without room for a line."""
    for i, settings in enumerate(scenario.settings):
        if not isinstance(settings, ParallelLines):
            continue
        own = settings.area_m is not None
        corners = np.array(settings.area_m) if own else ground.area
        settings_place: Place = ("phases", i, "settings")
        place = (*settings_place, "area_m") if own else settings_place
        outside = [_point(corner) for corner in corners if not ground.holds(corner)]
        if outside:
            message = "the survey area reaches beyond the site"
            yield scenario.problem(place, message, given=", ".join(outside), allowed=ground.extent)
        spacing, angle = line_spacing(settings), math.radians(settings.sweep_deg)
        along = np.ptp(corners @ np.array([math.cos(angle), math.sin(angle)]))
        across = np.ptp(corners @ np.array([-math.sin(angle), math.cos(angle)]))
        if min(along, across) < spacing:
            yield scenario.problem(
                place,
                "the survey area has no room for one survey line",
                given=f"{along:.4g} m along the lines and {across:.4g} m across them",
                allowed=f"at least the line spacing, {spacing:g} m, both ways",
                suggestion="enlarge area_m, or set a smaller line_spacing_m",
            )


def _check_points(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """Waypoints and targets beyond the site."""
    for i, settings in enumerate(scenario.settings):
        points: list[tuple[Place, tuple[float, float]]] = []
        if isinstance(settings, Waypoints):
            points = [(("points", k), point) for k, point in enumerate(settings.points)]
        elif isinstance(settings, ApproachAndOrbit | Orbit) and not isinstance(settings.target, str):
            points = [(("target",), settings.target)]
        for place, point in points:
            if not ground.holds(np.array(point)):
                message = f"the {'waypoint' if place[0] == 'points' else 'target'} lies outside the site"
                given = str(list(point))
                yield scenario.problem(("phases", i, "settings", *place), message, given=given, allowed=ground.extent)


def _point(xy: Floats) -> str:
    return f"[{xy[0]:.4g}, {xy[1]:.4g}]"
