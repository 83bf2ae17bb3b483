"""Checks of a scenario against its site: what stands outside, inside a wall, or has no room."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from swarmsim.config.documents import Place
from swarmsim.config.errors import InputError, Problem, first_problems
from swarmsim.config.phases import CEILING_HINT
from swarmsim.config.policies import ApproachAndOrbit, Orbit, ParallelLines, Waypoints, line_spacing
from swarmsim.config.scenario import Scenario
from swarmsim.config.site_ground import Floats, Ground, point_text
from swarmsim.config.sources import points_of
from swarmsim.config.start_checks import check_starts
from swarmsim.config.vehicles import Multirotor

if TYPE_CHECKING:
    from swarmsim.site import SiteModel


ROUNDING_M = 1e-3  # of places in float32
ABOVE_M = 0.5  # over the ceiling: by less a path that cuts a corner may stay below it


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
    checks = (_check_sources, check_starts, _check_areas, _check_fence, _check_points, _check_ceiling, _check_map)
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


def _check_fence(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """Survey lines that end nearer to the fence than a vehicle stops in: its failsafe would end the survey there."""
    fence = scenario.mission.failsafes.fence
    surveys = [(i, own) for i, own in enumerate(scenario.settings) if isinstance(own, ParallelLines)]
    if fence.action == "none" or not surveys:
        return
    import jax.numpy as jnp

    from swarmsim.world.failsafes import stopping_m

    for i, own in surveys:
        members = [scenario.vehicles[k] for k in scenario.phase_members[i]]
        brake = min(vehicle.control.acceleration_max_m_s2 for vehicle in members)
        area, sweep, spacing = np.array(own.area_m or ground.area), math.radians(own.sweep_deg), line_spacing(own)
        if not all(ground.holds(corner) for corner in area):  # told of already
            continue
        first, last = _survey_lines(area, sweep, spacing)
        stop = float(stopping_m(jnp.float32(own.speed_m_s), brake))
        onward = stop * np.array([math.cos(sweep), math.sin(sweep)])
        ends, ahead = np.concatenate([first, last]), np.concatenate([first - onward, last + onward])
        low, high = ground.fence(fence.margin_m)
        beyond = np.max(np.maximum(low - ahead, ahead - high), axis=1)
        worst = int(np.argmax(beyond))
        if beyond[worst] > ROUNDING_M:
            place: Place = ("phases", i, "settings", "area_m" if own.area_m is not None else "speed_m_s")
            yield scenario.problem(
                place,
                f"a survey line ends so near to the fence that a vehicle at {own.speed_m_s:g} m/s could not stop "
                "before it: its failsafe would bring it home",
                given=f"{stop - beyond[worst]:.3g} m from the fence, at {point_text(ends[worst])}",
                allowed=f"at least {stop:.3g} m",
                suggestion="a smaller area_m, or survey_area_m in the site's file, a lower speed_m_s, or another "
                "failsafes.fence",
            )


def _survey_lines(area: Floats, sweep: float, spacing: float) -> tuple[Floats, Floats]:
    """Ends [L, 2], [L, 2] of the lines of a survey over ``area`` [V, 2] in the direction ``sweep`` (rad)."""
    import jax
    import jax.numpy as jnp

    from swarmsim.policies.coverage import lines_needed, survey_lines

    cut = jax.jit(survey_lines, static_argnums=3)  # one by one its operations take a second to compile
    lines = lines_needed(area, spacing, sweep)
    start, end, used = cut(jnp.asarray(area), jnp.float32(sweep), jnp.float32(spacing), lines)
    return np.asarray(start, float)[np.asarray(used)], np.asarray(end, float)[np.asarray(used)]


def _check_ceiling(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """Survey lines and waypoints over things so high that the way above them leads through the fence's ceiling."""
    fence = scenario.mission.failsafes.fence
    if fence.action == "none":
        return
    for i, own in enumerate(scenario.settings):
        flies = any(isinstance(scenario.vehicles[k], Multirotor) for k in scenario.phase_members[i])
        if not flies or not isinstance(own, ParallelLines | Waypoints) or (own.altitude_m or 0.0) >= fence.ceiling_m:
            continue  # too high over bare ground is told without a site
        if isinstance(own, ParallelLines):
            area = np.array(own.area_m or ground.area)
            ends = np.stack(_survey_lines(area, math.radians(own.sweep_deg), line_spacing(own)), axis=1)
        else:
            corners = np.array(own.points)
            ends = np.stack([corners[:-1], corners[1:]], axis=1)
        for first, last in ends:
            xy = np.linspace(first, last, max(2, math.ceil(math.dist(first, last) / ground.cell)))
            over = ground.rises(xy) + own.obstacle_clearance_m
            over = np.minimum(over[:-1], over[1:])  # what is narrower than a cell may fall between a path's points
            worst = int(np.argmax(over))
            if over[worst] > fence.ceiling_m + ABOVE_M:
                field = "points" if isinstance(own, Waypoints) else "area_m" if own.area_m is not None else "altitude_m"
                yield scenario.problem(
                    ("phases", i, "settings", field),
                    f"the way leads {over[worst]:.3g} m above the terrain, over what stands there, and the fence's "
                    f"ceiling is lower: the failsafe would take over (action {fence.action})",
                    given=f"obstacle_clearance_m {own.obstacle_clearance_m:g}, at {point_text(xy[worst])}",
                    allowed=f"less than {fence.ceiling_m:g} m (failsafes.fence.ceiling_m)",
                    suggestion=CEILING_HINT,
                )
                break


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


def _check_map(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """A map of more cells or basis functions than can be computed."""
    mapping = scenario.mission.mapping
    if mapping is None or not scenario.detectors:
        return
    from swarmsim.missions.plan_build import kept_mapping, mapped_area

    try:
        kept_mapping(mapping, mapped_area(scenario, ground.site.survey_area_m))
    except InputError as error:
        for told in error.problems:
            details = {"given": told.given, "allowed": told.allowed, "suggestion": told.suggestion}
            yield scenario.problem(tuple((told.path or "").split(".")), told.message, **details)
