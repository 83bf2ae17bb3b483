"""Coverage of an area by parallel lines, shared among UAVs in balanced parts (boustrophedon paths).

Choset, "Coverage of known spaces: the boustrophedon cellular decomposition", Autonomous Robots 9 (2000), for a convex
area, which is one cell of that decomposition.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.policies import ParallelLines, line_spacing
from swarmsim.policies.air_path import FlightProfile, air_path, flight_profile, points_for
from swarmsim.policies.path import Path
from swarmsim.policies.protocol import Assignment, Situation
from swarmsim.policies.registry import register
from swarmsim.pytree import on_host, pytree, static
from swarmsim.site import Site


@pytree
class SurveyTask:
    """Survey an area with M multirotors."""

    profile: FlightProfile
    area_m: jax.Array  # [V, 2] convex polygon, world
    home_m: jax.Array  # [M, 2] where each lands, world
    line_spacing_m: jax.Array  # []
    sweep_rad: jax.Array  # [] direction of the lines, counter-clockwise from east
    lines_max: int = static()  # most lines that the area can need
    bands: int = static()  # pieces that every line is cut into
    points: int = static()  # points of a path


def lines_needed(area_m: np.ndarray, line_spacing_m: float, sweep_rad: float) -> int:
    """How many parallel lines an area [V, 2] takes (host)."""
    across = area_m @ np.array([-math.sin(sweep_rad), math.cos(sweep_rad)])
    return max(1, math.floor((across.max() - across.min()) / line_spacing_m + 1e-6))


def bands_needed(area_m: np.ndarray, lines: int, vehicles: int, sweep_rad: float) -> int:
    """Into how many pieces lines are cut: one, unless there are too few lines for so many vehicles (host).

    Then it divides the vehicles, so that nobody's part lies in two bands, and parts are as square as that allows. The
    vehicles of a band get equal numbers of pieces, or at least two each, so that parts differ by no more than a half.
    """
    if lines >= 2 * vehicles:
        return 1
    along = np.array([math.cos(sweep_rad), math.sin(sweep_rad)])
    across = np.array([-along[1], along[0]])
    square = math.sqrt(vehicles * np.ptp(area_m @ along) / np.ptp(area_m @ across))

    def balanced(share: int) -> bool:
        return lines % share == 0 or lines >= 2 * share

    fair = [n for n in range(1, vehicles + 1) if vehicles % n == 0 and balanced(vehicles // n)]
    return min(fair, key=lambda n: abs(math.log(n / square)))


@register("parallel_lines")
class ParallelLinesPlanner:
    """Survey an area along parallel lines, shared among the UAVs in balanced parts."""

    Settings = ParallelLines
    vehicles = ("multirotor",)

    def task(self, assignment: Assignment) -> SurveyTask:
        """Area, lines and sizes of the phase (host)."""
        settings, scenario = assignment.settings, assignment.scenario
        assert isinstance(settings, ParallelLines)
        area = np.asarray(settings.area_m or assignment.site_model.site.survey_area_m, np.float64)
        homes = np.array([scenario.members[i].position_m for i in assignment.members], np.float64)
        spacing, sweep = line_spacing(settings), math.radians(settings.sweep_deg)
        lines = lines_needed(area, spacing, sweep)
        extent = float(np.linalg.norm(np.ptp(np.concatenate([area, homes]), axis=0)))
        bands = bands_needed(area, lines, len(homes), sweep)
        share = math.ceil(lines * bands / len(homes)) + 1
        piece = float(np.linalg.norm(np.ptp(area, axis=0))) / bands
        return SurveyTask(
            profile=flight_profile(settings, [scenario.vehicles[i] for i in assignment.members]),
            area_m=on_host(area),
            home_m=on_host(homes),
            line_spacing_m=on_host(spacing),
            sweep_rad=on_host(sweep),
            lines_max=lines,
            bands=bands,
            points=points_for(share * (piece + spacing) + 3 * extent, settings.altitude_m),
        )

    def plan(self, task: SurveyTask, site: Site, situation: Situation) -> Path:
        """One path per UAV: take off, fly its share of the lines at height above ground, return, land.

        Lines stand ``line_spacing_m`` apart, centred on the area, and are cut to it. Each UAV gets neighbouring lines,
        so that their summed lengths are equal within a line; UAVs are matched to parts in the order of their places
        across the lines, so that their ways do not cross. Every UAV flies its part in the order and direction with the
        least transit.
        """
        lines = survey_lines(task.area_m, task.sweep_rad, task.line_spacing_m, task.lines_max)
        start, end, used = _pieces(*lines, task.bands)
        share = _share(start, end, used, task.home_m.shape[0])
        rank = _places_in_order(task, situation.position_m[:, :2])

        def fly(position: jax.Array, home: jax.Array, part: jax.Array) -> Path:
            corners = _lawnmower(home, start, end, used & (share == part))
            return air_path(task.profile, site, position, home, corners[1:-1], task.points)

        return jax.vmap(fly)(situation.position_m, task.home_m, rank)


def survey_lines(
    area_m: jax.Array, sweep_rad: jax.Array, line_spacing_m: jax.Array, lines_max: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Ends [L, 2], [L, 2] (m, ENU) of parallel lines through a convex area [V, 2], and which of the L lines are used.

    ``L`` is ``lines_max``, ``sweep_rad`` [] the direction of the lines, counter-clockwise from east.
    """
    along = jnp.array([jnp.cos(sweep_rad), jnp.sin(sweep_rad)])
    across = jnp.array([-along[1], along[0]])
    u, v = area_m @ along, area_m @ across
    height = v.max() - v.min()
    count = jnp.clip(jnp.floor(height / line_spacing_m + 1e-6), 1, lines_max)
    k = jnp.arange(lines_max)
    at = 0.5 * (v.max() + v.min()) + (k - 0.5 * (count - 1)) * line_spacing_m
    # intersections of every line with every edge of the polygon
    u2, v2 = jnp.roll(u, -1), jnp.roll(v, -1)
    crosses = (jnp.minimum(v, v2) <= at[:, None]) & (at[:, None] < jnp.maximum(v, v2))
    part = (at[:, None] - v) / jnp.where(v2 == v, 1.0, v2 - v)
    x = u + part * (u2 - u)
    low = jnp.min(jnp.where(crosses, x, jnp.inf), axis=1)
    high = jnp.max(jnp.where(crosses, x, -jnp.inf), axis=1)
    used = (k < count) & (high > low)
    low, high = jnp.where(used, low, 0.0), jnp.where(used, high, 0.0)
    offset = at[:, None] * across
    return low[:, None] * along + offset, high[:, None] * along + offset, used


def _pieces(start: jax.Array, end: jax.Array, used: jax.Array, bands: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Lines [L, 2] cut into ``bands`` equal pieces [bands L, 2] each: the first pieces of all, then the second ones."""
    edge = jnp.linspace(0.0, 1.0, bands + 1)[:, None, None]
    cut = start + edge * (end - start)
    return cut[:-1].reshape(-1, 2), cut[1:].reshape(-1, 2), jnp.tile(used, bands)


def _places_in_order(task: SurveyTask, position_m: jax.Array) -> jax.Array:
    """Rank [M] of vehicles at ``position_m`` [M, 2] in the order of the parts: by bands, then across the lines."""
    along = jnp.array([jnp.cos(task.sweep_rad), jnp.sin(task.sweep_rad)])
    across = jnp.array([-along[1], along[0]])
    count = position_m.shape[0]
    band = jnp.argsort(jnp.argsort(position_m @ along)) * task.bands // count
    return jnp.argsort(jnp.lexsort((position_m @ across, band)))


def _share(start: jax.Array, end: jax.Array, used: jax.Array, parts: int) -> jax.Array:
    """Which part [L] each line belongs to: equal shares of the summed length."""
    length = jnp.where(used, jnp.linalg.norm(end - start, axis=-1), 0.0)
    middle = jnp.cumsum(length) - 0.5 * length
    return jnp.clip((middle / jnp.maximum(length.sum(), 1e-6) * parts).astype(jnp.int32), 0, parts - 1)


def _lawnmower(home: jax.Array, start: jax.Array, end: jax.Array, mine: jax.Array) -> jax.Array:
    """Corners [2 L + 2, 2] from home over the lines that are ``mine`` and back, by the shortest of four orders."""
    lines = len(mine)
    place = jnp.cumsum(mine) - 1

    def corners(backwards: jax.Array, reverse: jax.Array) -> jax.Array:
        order = jnp.where(mine, jnp.where(reverse, mine.sum() - 1 - place, place), lines)
        slot = jnp.argsort(order)  # lines of this part first, in flying order
        turned = (jnp.arange(lines) % 2 == 1) != backwards
        first = jnp.where(turned[:, None], end[slot], start[slot])
        second = jnp.where(turned[:, None], start[slot], end[slot])
        legs = jnp.stack([first, second], axis=1).reshape(-1, 2)
        flown = jnp.repeat(jnp.arange(lines) < mine.sum(), 2)[:, None]
        return jnp.concatenate([home[None], jnp.where(flown, legs, home), home[None]])

    options = jax.vmap(corners)(jnp.array([False, False, True, True]), jnp.array([False, True, False, True]))
    lengths = jnp.linalg.norm(jnp.diff(options, axis=1), axis=-1).sum(axis=-1)
    return options[jnp.argmin(lengths)]
