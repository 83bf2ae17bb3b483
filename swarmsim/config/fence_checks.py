"""Checks of a scenario against the fence of its failsafes: ways that it would end for certain."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from swarmsim.config.documents import Place
from swarmsim.config.errors import Problem
from swarmsim.config.phases import CEILING_HINT
from swarmsim.config.policies import Orbit, ParallelLines, Waypoints, line_spacing
from swarmsim.config.scenario import Scenario
from swarmsim.config.site_ground import Floats, Ground, point_text
from swarmsim.config.vehicles import Multirotor

ROUNDING_M = 1e-3  # of places in float32
CUT_M = 0.5  # beyond the fence: by less a path that cuts a corner may stay within it


def check_fence(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """Ways of flying phases that the failsafe of the fence would end for certain."""
    fence = scenario.mission.failsafes.fence
    if fence.action == "none" or not any(isinstance(vehicle, Multirotor) for vehicle in scenario.vehicles):
        return
    low, high = ground.fence(fence.margin_m)
    if np.any(low >= high):
        yield scenario.problem(
            ("failsafes", "fence", "margin_m"),
            "leaves nothing of the site within the fence",
            given=f"{fence.margin_m:g}",
            allowed=f"less than {0.5 * np.min(high - low) + fence.margin_m:.4g}",
        )
        return
    for check in (_check_stops, _check_ways, _check_ceiling):
        yield from check(scenario, ground)


def _check_stops(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """Survey lines that end nearer to the fence than a vehicle stops in: its failsafe would end the survey there."""
    fence = scenario.mission.failsafes.fence
    surveys = [(i, own) for i, own in enumerate(scenario.settings) if isinstance(own, ParallelLines)]
    if not surveys:
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


def _check_ways(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """Waypoints and circles beyond the fence."""
    fence = scenario.mission.failsafes.fence
    low, high = ground.fence(fence.margin_m)
    took = f"the fence: the failsafe would take over (action {fence.action})"
    allowed = f"x from {low[0]:g} to {high[0]:g}, y from {low[1]:g} to {high[1]:g}"

    def beyond(xy: Floats) -> Floats:
        return np.asarray(np.max(np.maximum(low - xy, xy - high), axis=-1))

    for i, own in enumerate(scenario.settings):
        flying = [k for k in scenario.phase_members[i] if isinstance(scenario.vehicles[k], Multirotor)]
        if isinstance(own, Waypoints) and flying:
            for k, point in enumerate(own.points):
                if ground.holds(np.array(point)) and beyond(np.array(point)) > CUT_M:
                    place: Place = ("phases", i, "settings", "points", k)
                    message = f"the waypoint lies outside {took}"
                    yield scenario.problem(place, message, given=str(list(point)), allowed=allowed)
        elif isinstance(own, Orbit) and isinstance(own.target, str):
            room = float(np.min(high - low)) + 2.0 * CUT_M
            if own.turns >= 1.0 and 2.0 * own.radius_m > room:
                place = ("phases", i, "settings", "radius_m")
                message, most = f"a circle round any target leads over {took}", f"at most {0.5 * room - CUT_M:.4g}"
                yield scenario.problem(place, message, given=f"{own.radius_m:g}", allowed=most)
        elif isinstance(own, Orbit) and ground.holds(np.array(own.target)):
            place = ("phases", i, "settings", "radius_m")
            first = 2.0 * math.pi * np.arange(len(flying))[:, None] / max(1, len(flying))
            angle = first + 2.0 * math.pi * min(own.turns, 1.0) * np.linspace(0.0, 1.0, 181)
            circle = np.array(own.target) + own.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            over = beyond(circle)
            if np.max(over, initial=0.0) > CUT_M:
                worst = circle.reshape(-1, 2)[int(np.argmax(over))]
                message, given = f"the circle round the target leads over {took}", f"{own.radius_m:g}"
                hint = f"it would come to {point_text(worst)}"
                yield scenario.problem(place, message, given=given, allowed=allowed, suggestion=hint)


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
            if over[worst] > fence.ceiling_m + CUT_M:
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
