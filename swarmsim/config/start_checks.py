"""Checks of where vehicles start on a site, and the nearest place where one could."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from swarmsim.config.checks import footprint_radius_m
from swarmsim.config.errors import Problem
from swarmsim.config.scenario import Scenario
from swarmsim.config.site_ground import Floats, Ground, point_text
from swarmsim.config.vehicles import Multirotor, SkidSteer

OVERHEAD_M = 0.4  # a surface this far above the terrain is an obstacle to a UAV, not ground
OUTLINE_POINTS = 12  # along each side of a rover
ROOM_REACH_M = 20.0  # how far from its start another one is looked for
ROOM_STEP_M = 1.0
ROOM_BEARINGS = 12


def check_starts(scenario: Scenario, ground: Ground) -> Iterator[Problem]:
    """Starts that do not fit; the members of a formation are told once for each kind of fault."""
    found: dict[tuple[int, str], list[tuple[int, dict[str, str]]]] = {}
    for i in range(len(scenario.members)):
        fault = _start_fault(scenario, ground, i, np.array(scenario.members[i].position_m))
        if fault is not None:
            message, details = fault
            found.setdefault((scenario.entries[i], message), []).append((i, details))
    for (entry, message), members in found.items():
        first, details = members[0]
        if len(members) == 1 and (room := _nearest_room(scenario, ground, first)) is not None:
            details["suggestion"] = f"the nearest place with room is about {point_text(room)}"
        others = f" (and {len(members) - 1} more of its formation)" if len(members) > 1 else ""
        yield scenario.problem(
            ("vehicles", entry, "position_m"),
            f"'{scenario.members[first].name}'{others} starts {message}",
            given=str(list(scenario.members[first].position_m)),
            **details,
        )


def _nearest_room(scenario: Scenario, ground: Ground, i: int) -> Floats | None:
    """A place [2] as near as can be to the start of member ``i``, where it could start; None within `ROOM_REACH_M`."""
    here = np.clip(scenario.members[i].position_m, ground.low, ground.high)
    others = [k for k in range(len(scenario.members)) if k != i]
    pads = np.array([scenario.members[k].position_m for k in others]).reshape(-1, 2)
    own = footprint_radius_m(scenario.vehicles[i]) + scenario.mission.traffic.pad_gap_m
    apart = np.array([own + footprint_radius_m(scenario.vehicles[k]) for k in others])
    bearing = np.linspace(0.0, 2.0 * math.pi, ROOM_BEARINGS, endpoint=False)
    ring = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    for reach in np.arange(0.0, ROOM_REACH_M, ROOM_STEP_M):
        # whole tenths, which is how a message and a file write them
        for xy in np.round(here + reach * ring, 1):
            if np.all(np.hypot(*(pads - xy).T) >= apart) and _start_fault(scenario, ground, i, xy) is None:
                place: Floats = xy
                return place
    return None


def _start_fault(scenario: Scenario, ground: Ground, i: int, xy: Floats) -> tuple[str, dict[str, str]] | None:
    """What is wrong with member ``i`` starting at ``xy`` [2]: the end of a sentence, and the problem's details."""
    vehicle = scenario.vehicles[i]
    radius = footprint_radius_m(vehicle)
    if not ground.holds(xy):
        return "outside the site", {"allowed": ground.extent}
    fence = scenario.mission.failsafes.fence
    if isinstance(vehicle, Multirotor) and fence.action != "none":
        low, high = ground.fence(fence.margin_m)
        if np.all(low < high) and (np.any(xy < low) or np.any(xy > high)):  # a fence round nothing is told as such
            (west, south), (east, north) = low, high
            return "outside the fence, which is the site's outline less failsafes.fence.margin_m", {
                "allowed": f"x from {west:g} to {east:g}, y from {south:g} to {north:g}"
            }
    height = vehicle.chassis_height_m if isinstance(vehicle, SkidSteer) else vehicle.collision_height_m
    depth = ground.depth(np.array([*xy, ground.cell_value(ground.terrain, xy) + height / 2]))
    touching = np.flatnonzero((depth[:, :2].min(axis=1) > -radius) & (depth[:, 2] > -height / 2))
    touching = touching[np.all(ground.half[touching] > 0, axis=1)]
    if touching.size:
        k = int(touching[0])
        return f"inside an obstacle of {ground.material[k]}, or touches it", {
            "allowed": f"at least {radius:.2f} m from every obstacle",
            "suggestion": f"the obstacle's centre is at {point_text(ground.centre[k, :2])}",
        }
    if isinstance(vehicle, Multirotor) and ground.rises_within(xy, radius + ground.cell) > OVERHEAD_M:
        return "below something that stands there, such as a tree or a roof", {
            "allowed": f"a place with nothing above the ground within {radius:.2f} m"
        }
    if isinstance(vehicle, SkidSteer) and ground.least_clearance(_outline(scenario, i, xy)) <= 0:
        return "where a rover cannot drive (obstacle, closed zone or edge of the site)", {
            "allowed": "traversable ground"
        }
    return None


def _outline(scenario: Scenario, i: int, xy: Floats) -> Floats:
    """Points [p, 2] (m, ENU) of a rover that starts at ``xy`` [2], as its bumpers sense: its outline and its centre."""
    from swarmsim.vehicles.rover_body import rover_body

    vehicle, member = scenario.vehicles[i], scenario.members[i]
    assert isinstance(vehicle, SkidSteer)
    rear, front, right, left = rover_body(vehicle).outline_m
    share = np.linspace(0.0, 1.0, OUTLINE_POINTS)
    x, y = rear + share * (front - rear), right + share * (left - right)
    sides = [(x, 0 * x + right), (x, 0 * x + left), (0 * y + rear, y), (0 * y + front, y), (np.zeros(1), np.zeros(1))]
    own = np.concatenate([np.stack(side, axis=-1) for side in sides])
    cos, sin = math.cos(math.radians(member.heading_deg)), math.sin(math.radians(member.heading_deg))
    return own @ np.array([[cos, sin], [-sin, cos]]) + xy
