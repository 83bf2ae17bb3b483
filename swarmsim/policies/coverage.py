"""Coverage of an area by parallel lines, shared among UAVs in balanced parts (boustrophedon paths).

Choset, "Coverage of known spaces: the boustrophedon cellular decomposition", Autonomous Robots 9 (2000), for a convex
area, which is one cell of that decomposition.
"""

import math
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.policies.path import Path, limit_speed, resample
from swarmsim.policies.registry import register
from swarmsim.policies.tasks import AerialTask
from swarmsim.site import Site, sample

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

CLIMB_GRADIENT = 0.7  # a survey path climbs at most 7 m in 10 m, about 35 degrees
BELOW_GROUND_M = 0.4  # the landing path ends here, so that the vehicle comes down until it touches
TOUCHDOWN_HEIGHT_M = 2.5  # below this height the descent is slow
CORNER_M = 0.5  # how far a corner may be cut
VERTICAL_POINTS = 32


def lines_needed(area_m: "ArrayLike", line_spacing_m: float, sweep_rad: float) -> int:
    """How many parallel lines an area [V, 2] takes (host)."""
    across = np.asarray(area_m) @ np.array([-math.sin(sweep_rad), math.cos(sweep_rad)])
    return max(1, math.floor((across.max() - across.min()) / line_spacing_m + 1e-6))


def points_needed(area_m: "ArrayLike", home_m: "ArrayLike", lines: int, altitude_m: float, spacing_m: float) -> int:
    """How many points a path takes so that they stand about ``spacing_m`` apart (host; an upper bound)."""
    area, homes = np.asarray(area_m), np.asarray(home_m)
    extent = float(np.linalg.norm(np.ptp(np.concatenate([area, homes]), axis=0)))
    share = math.ceil(lines / len(homes)) + 1
    length = share * extent + 2 * extent + 4 * altitude_m
    return 256 * math.ceil(length / spacing_m / 256)


@register("aerial", "parallel_lines")
def parallel_lines(task: AerialTask, site: Site) -> Path:
    """One path per UAV: take off, fly its share of the lines at height above ground, return, land.

    Lines stand ``line_spacing_m`` apart, centred on the area, and are cut to it. Each UAV gets neighbouring lines, so
    that their summed lengths are equal within a line; UAVs are matched to parts in the order of their homes across the
    lines, so that their ways do not cross. Every UAV flies its part in the order and direction with the least transit.

    Returns:
        `Path` with a leading axis U on every field.
    """
    start, end, used = _cut_lines(task)
    share = _share(start, end, used, task.home_m.shape[0])
    across = jnp.array([-jnp.sin(task.sweep_rad), jnp.cos(task.sweep_rad)])
    rank = jnp.argsort(jnp.argsort(task.home_m @ across))

    def fly(home: jax.Array, part: jax.Array) -> Path:
        return _path(task, site, home, _lawnmower(home, start, end, used & (share == part)))

    return jax.vmap(fly)(task.home_m, rank)


def _cut_lines(task: AerialTask) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Line ends [L, 2], [L, 2] in ENU and which of the L lines are used."""
    along = jnp.array([jnp.cos(task.sweep_rad), jnp.sin(task.sweep_rad)])
    across = jnp.array([-along[1], along[0]])
    u, v = task.area_m @ along, task.area_m @ across
    height = v.max() - v.min()
    count = jnp.clip(jnp.floor(height / task.line_spacing_m + 1e-6), 1, task.lines_max)
    k = jnp.arange(task.lines_max)
    at = 0.5 * (v.max() + v.min()) + (k - 0.5 * (count - 1)) * task.line_spacing_m
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


def _path(task: AerialTask, site: Site, home: jax.Array, corners: jax.Array) -> Path:
    """Lift the corners above terrain and obstacles, add take-off and landing, set speeds."""
    flat, flat_length = resample(corners, task.points)
    height = _safe_height(task, site, flat, flat_length / (task.points - 1))
    survey = jnp.concatenate([flat, height[:, None]], axis=-1)
    ground = sample(site.terrain_m, site, home)
    rise = jnp.linspace(0.0, 1.0, VERTICAL_POINTS)[:, None]
    foot = jnp.append(home, ground)
    below = jnp.append(home, ground - BELOW_GROUND_M)
    whole = jnp.concatenate([foot + rise * (survey[0] - foot), survey, survey[-1] + rise * (below - survey[-1])])
    points, length = resample(whole, task.points)
    vertical = jnp.asarray(jnp.gradient(points[:, 2])) / jnp.maximum(length / (task.points - 1), 1e-6)
    low = points[:, 2] < ground + TOUCHDOWN_HEIGHT_M
    down = jnp.where(low, task.touchdown_speed_m_s, task.descent_speed_m_s)
    cruise = jnp.where(vertical > 0.9, task.climb_speed_m_s, jnp.where(vertical < -0.9, down, task.speed_m_s))
    speed = limit_speed(points, cruise, task.acceleration_m_s2, CORNER_M)
    # the landing must not stop above ground: the last points keep the touchdown speed
    landing = low & (jnp.arange(task.points) > task.points // 2)
    speed = jnp.where(landing, task.touchdown_speed_m_s, speed)
    return Path(points_m=points, speed_m_s=speed, spacing_m=length / (task.points - 1), length_m=length)


def _safe_height(task: AerialTask, site: Site, xy: jax.Array, spacing: jax.Array) -> jax.Array:
    """Height [P] that keeps the altitude above ground and the clearance above the surface around each point.

    Higher ground ahead is met by climbing before it, at `CLIMB_GRADIENT`.
    """
    ring = jnp.linspace(0.0, 2.0 * jnp.pi, 8, endpoint=False)
    offsets = jnp.stack([jnp.cos(ring), jnp.sin(ring)], axis=-1)
    around = xy[:, None, None] + jnp.array([0.0, 0.5, 1.0])[:, None, None] * task.obstacle_clearance_m * offsets
    surface = jnp.max(sample(site.surface_m, site, around), axis=(1, 2))
    wanted = jnp.maximum(sample(site.terrain_m, site, xy) + task.altitude_m, surface + task.obstacle_clearance_m)
    slope = CLIMB_GRADIENT * spacing * jnp.arange(len(wanted))
    ahead = jax.lax.cummax(wanted - slope, reverse=True) + slope
    behind = jax.lax.cummax(wanted + slope) - slope
    return jnp.maximum(ahead, behind)
