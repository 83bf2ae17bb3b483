"""Where sources are looked for first: the points of a grid that are most promising in the open air, and in buildings.

Walls of a building hide a source from one side and let it through on another, so that the open air's statistic
(`swarmsim.estimation.scan`) may be largest metres away, and the building it lies in not be among the best. So places in
hollow boxes are looked at besides, with rays.
"""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.device import for_those
from swarmsim.estimation.forward import Problem
from swarmsim.estimation.normal_equations import Others, Unknowns
from swarmsim.estimation.overload import likeliest_source, overloaded
from swarmsim.estimation.scan import open_totals, scan, strongest
from swarmsim.pytree import on_host, pytree
from swarmsim.site import Site
from swarmsim.site.model import height_at
from swarmsim.site.raster import in_areas
from swarmsim.site.rooms import rooms_of

STARTS = 8  # grid points that are tried for a further source
APART_M = 12.0  # between those
POINTS_MAX = 20_000  # of the grid
ROOMS = 960  # places in buildings; the array always has as many, so that another area is only another value
FROM_WALLS_M = 0.3  # of places in buildings


@pytree
class Places:
    """Where sources are looked for first, by the area and the site."""

    points_m: jax.Array  # [C, 3] grid over the area's bounding box, world
    inside_m: jax.Array  # [I, 2] in hollow boxes, world
    near: jax.Array  # [I] int32 the nearest point of the grid
    there: jax.Array  # [I] bool, whether it is a place: the rest fills the array up
    surveyed: jax.Array  # [C] bool, whether the point lies in the area


@pytree
class Starts:
    """What is tried for a further source: S grid points and I places in buildings."""

    point_m: jax.Array  # [S, 3] world
    nuclide: jax.Array  # [S] int32 that explains most there
    inside_m: jax.Array  # [I, 2] world, the most promising first
    inside_nuclide: jax.Array  # [I] int32
    there: jax.Array  # [I] bool


def places_of(site: Site, areas_m: Sequence[np.ndarray], step_m: float, height_m: float) -> Places:
    """The places ``height_m`` above the ground around areas, convex polygons with corners [V, 2] (host).

    Points of the grid lie ``step_m`` apart, farther where there would be too many, and so do those in a building.
    """
    corners = np.concatenate(areas_m)
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    step = max(step_m, float(np.sqrt(np.prod(high - low) / POINTS_MAX)))
    axes = [np.linspace(a, b, max(2, round((b - a) / step) + 1)) for a, b in zip(low, high, strict=True)]
    xy = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    inside = _inside(site, low - step, high + step, step)
    there = np.arange(ROOMS) < len(inside)
    # what fills the array up is a point of the grid
    inside = np.concatenate([inside, np.tile(xy[:1], (ROOMS - len(inside), 1))])
    spacing = np.array([axis[1] - axis[0] for axis in axes])
    last = [len(axis) - 1 for axis in axes]
    column, row = np.clip(np.rint((inside - low) / np.maximum(spacing, 1e-9)), 0, last).astype(int).T
    near = row * len(axes[0]) + column
    return Places(
        points_m=on_host(np.column_stack([xy, height_at(site, xy) + height_m])),
        inside_m=on_host(inside),
        near=on_host(near, np.int32),
        there=on_host(there, bool),
        surveyed=on_host(_surveyed(xy, areas_m), bool),
    )


def _surveyed(xy: np.ndarray, areas_m: Sequence[np.ndarray]) -> np.ndarray:
    """Which points [C, 2] lie in areas; of one narrower than the grid that is nearest to its middle."""
    inside = in_areas(xy, areas_m)
    for area in areas_m:
        if not np.any(in_areas(xy, [area])):
            inside[np.argmin(np.linalg.norm(xy - np.mean(area, axis=0), axis=1))] = True
    return inside


def _inside(site: Site, low: np.ndarray, high: np.ndarray, step_m: float) -> np.ndarray:
    """Places [I, 2] in the hollow boxes between ``low`` and ``high`` [2]: one in each, and at most ``step_m`` apart.

    Where there would be too many they are farther apart, and some boxes have none.
    """
    rooms = rooms_of(site, FROM_WALLS_M)
    near = np.all((rooms.centre_m[:, :2] >= low) & (rooms.centre_m[:, :2] <= high), axis=1)
    centre, reach, axis = (x[near] for x in (rooms.centre_m[:, :2], rooms.reach_m, rooms.axis))
    step = step_m
    while True:
        parts = np.maximum(np.ceil(2.0 * reach / step), 1).astype(int)
        if np.sum(np.prod(parts, axis=1)) <= ROOMS or np.all(parts == 1):
            break
        step *= 1.25
    made = [np.zeros((0, 2))]
    for number, (along, across) in enumerate(parts):
        shares = np.meshgrid((2 * np.arange(along) + 1) / along - 1, (2 * np.arange(across) + 1) / across - 1)
        one, other = (reach[number, k] * shares[k].ravel() for k in range(2))
        (c, s), middle = axis[number], centre[number]
        made.append(middle + np.stack([c * one - s * other, s * one + c * other], axis=1))
    every = np.concatenate(made)
    return every[np.linspace(0, len(every) - 1, ROOMS).astype(int)] if len(every) > ROOMS else every


def starts_of(
    problem: Problem, places: Places, allowed: jax.Array, others: Others, u: Unknowns
) -> tuple[Starts, jax.Array]:  # fmt: skip
    """What is tried for a source beside ``others``, and the largest statistic; ``u`` is the fit with them alone.

    ``allowed`` [N] are the nuclides in question. A place in a building is tried with the nuclide that explains most at
    the nearest point of the grid.
    """
    places = jax.tree.map(jnp.asarray, places)
    scanned = scan(problem, places.points_m, allowed, others, u)
    alone = ~jnp.any(others.counts > 0.0)

    def strong() -> jax.Array:
        # the fit has raised the background to what it is that overloads the counters
        background = jnp.sum(problem.background, axis=1)
        return likeliest_source(problem, open_totals(problem, places.points_m, scanned.nuclide), background)

    # the score is that of a weak source: around one that paralyses counters it is largest far from it
    value = for_those(alone & overloaded(problem), strong, lambda: scanned.statistic)
    scanned = replace(scanned, statistic=value)
    index, statistic = strongest(scanned, places.points_m, STARTS, APART_M)
    near = places.near
    order = jnp.argsort(jnp.where(places.there, -scanned.statistic[near], jnp.inf))
    starts = Starts(
        point_m=places.points_m[index],
        nuclide=scanned.nuclide[index],
        inside_m=places.inside_m[order],
        inside_nuclide=scanned.nuclide[near[order]],
        there=places.there[order],
    )
    return starts, statistic[0]


def no_starts(places: Places) -> Starts:
    """Of a search that begins where the source is."""
    count = places.there.shape[0]
    return Starts(
        point_m=jnp.zeros((STARTS, 3)), nuclide=jnp.zeros(STARTS, jnp.int32),
        inside_m=jnp.zeros((count, 2)), inside_nuclide=jnp.zeros(count, jnp.int32), there=jnp.zeros(count, bool),
    )  # fmt: skip
