"""Checks of a scenario against its site: what stands outside, inside a wall, or has no room."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from swarmsim.config.documents import Place
from swarmsim.config.errors import InputError, Problem, first_problems
from swarmsim.config.fence_checks import check_fence
from swarmsim.config.policies import ApproachAndOrbit, Orbit, ParallelLines, Waypoints, line_spacing
from swarmsim.config.scenario import Scenario
from swarmsim.config.site_ground import Ground, point_text
from swarmsim.config.sources import points_of
from swarmsim.config.start_checks import check_starts
from swarmsim.config.vehicles import Multirotor, SkidSteer

if TYPE_CHECKING:
    from swarmsim.site import SiteModel


def check_site(scenario: Scenario, model: SiteModel | None = None) -> list[Problem]:
    """What of the scenario does not fit its site; ``model`` is the loaded site, where the caller has it already.

    Raises `InputError` when the site itself cannot be loaded.
    """
    if model is None:
        from swarmsim.site import load_site

        model = load_site(scenario.site_file, tuple(scenario.materials))
    ground = Ground(model.site, scenario)
    if vehicles := first_problems(_check_vehicles(scenario)):
        return vehicles  # without its body nothing is known of a vehicle's outline
    checks = (_check_sources, check_starts, _check_areas, check_fence, _check_points, _check_traffic, _check_map)
    return first_problems(problem for check in checks for problem in check(scenario, ground))


def _check_vehicles(scenario: Scenario) -> Iterator[Problem]:
    """Vehicle types whose body's file is wrong, or whose feet are too stiff for the time step."""
    from swarmsim.world.build import vehicle_params

    step, told = scenario.mission.timing.time_step_s, set()
    for entry, member, vehicle in zip(scenario.entries, scenario.members, scenario.vehicles, strict=True):
        if member.type in told:
            continue
        told.add(member.type)
        try:
            vehicle_params(vehicle, scenario.mission.effects, step)
        except InputError as error:
            for own in error.problems:
                place: Place = ("vehicles", entry, "type")
                yield own if own.file is not None else scenario.problem(place, own.message, given=own.given)


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
            given = str(list(source.position_m)) if source.position_m else point_text(points[within[0], :2])
            if source.form != "point":
                lies = f"{len(set(within))} of the {len(points)} points of the source lie"
            what = "the wall of a building" if ground.wall[k] > 0 else "a solid obstacle"
            yield scenario.problem(
                place,
                f"{lies} inside {what} of {ground.material[k]}",
                given=f"{given}, height_m {source.height_m:g}",
                allowed="the open, or the hollow inside of a building",
                suggestion=f"the obstacle's centre is at {point_text(ground.centre[k, :2])}; move the source by the "
                "wall's thickness or more",
            )


def _check_areas(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """Survey areas beyond the site, or without room for a line."""
    for i, settings in enumerate(scenario.settings):
        if not isinstance(settings, ParallelLines):
            continue
        own = settings.area_m is not None
        corners = np.array(settings.area_m) if own else ground.area
        settings_place: Place = ("phases", i, "settings")
        place = (*settings_place, "area_m") if own else settings_place
        outside = [point_text(corner) for corner in corners if not ground.holds(corner)]
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


def _check_traffic(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """Distances to keep that are longer than the site."""
    across = math.dist(ground.low, ground.high)
    allowed = f"less than the {across:.4g} m from corner to corner of the site"
    kept = (("separation_m", Multirotor, "UAVs"), ("ground_separation_m", SkidSteer, "rovers"))
    for field, kind, what in kept:
        distance = getattr(scenario.mission.traffic, field)
        if sum(isinstance(vehicle, kind) for vehicle in scenario.vehicles) > 1 and distance >= across:
            message = f"the {what} of the team can nowhere be so far apart"
            yield scenario.problem(("traffic", field), message, given=f"{distance:g}", allowed=allowed)
    for i, settings in enumerate(scenario.settings):
        if isinstance(settings, ApproachAndOrbit) and settings.standoff_m >= across:
            message, place = "no viewpoint so far from the target lies on the site", ("phases", i, "settings")
            given = f"{settings.standoff_m:g}"
            yield scenario.problem((*place, "standoff_m"), message, given=given, allowed=allowed)


def _check_map(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """A map of more cells or basis functions than can be computed."""
    mapping = scenario.mission.mapping
    if mapping is None or not scenario.detectors:
        return
    from swarmsim.missions.plan_build import kept_mapping, mapped_areas

    try:
        kept_mapping(mapping, mapped_areas(scenario, ground.site.survey_area_m))
    except InputError as error:
        for told in error.problems:
            details = {"given": told.given, "allowed": told.allowed, "suggestion": told.suggestion}
            yield scenario.problem(tuple((told.path or "").split(".")), told.message, **details)
