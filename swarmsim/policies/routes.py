"""Least-cost routes over a grid: a cost-to-go field by relaxation, and the route that descends it.

The field is the fixed point of Bellman's equation on a grid graph with 16 neighbours (king's and knight's moves), whose
lengths exceed the Euclidean ones by at most 2.8 % (Nagy, "Digital geometry of neighborhood sequences"; Montanari 1968).
"""

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.site import Site

MOVES = np.array(
    [(r, c) for r in range(-2, 3) for c in range(-2, 3) if abs(r) + abs(c) in (1, 3) or abs(r) == abs(c) == 1]
)  # (row, column)
REACH = 2  # furthest a move goes along one axis


def coarsen(cost: jax.Array, clearance_m: jax.Array, radius_m: jax.Array, factor: int) -> jax.Array:
    """Cost per metre on blocks of ``factor`` x ``factor`` cells; inf where a vehicle of the radius does not fit.

    A block is blocked when any of its cells is, or when its least clearance is below the radius; else it costs their
    mean. Rows and columns beyond a whole number of blocks are dropped.
    """
    rows, columns = (n // factor for n in cost.shape)

    def blocks(raster: jax.Array) -> jax.Array:
        whole = raster[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
        return whole.transpose(0, 2, 1, 3).reshape(rows, columns, factor * factor)

    fits = blocks(clearance_m).min(axis=-1) >= radius_m
    return jnp.where(fits, blocks(cost).mean(axis=-1), jnp.inf)


def passable(site: Site, slope_max: jax.Array, step_max_m: jax.Array) -> jax.Array:
    """Cells [ny, nx] of a site's rasters where no slope is above ``slope_max`` [] (rise per metre) and no step higher.

    The slope is that between the neighbouring cells, as in the site's own cost. A cell centre has a step near it when
    one of the four patches of ground around it has.
    """
    north, east = jnp.gradient(site.terrain_m)
    gentle = jnp.hypot(north, east) <= slope_max * site.cell_m
    if site.steps is None:
        return gentle
    high = jnp.pad(site.steps.edge[..., 3] > step_max_m, ((1, 0), (1, 0)))
    return gentle & ~(high[1:, 1:] | high[1:, :-1] | high[:-1, 1:] | high[:-1, :-1])


def _neighbours(field: jax.Array, fill: float) -> jax.Array:
    """The field [ny, nx] as seen after each of the 16 moves [16, ny, nx]."""
    padded = jnp.pad(field, REACH, constant_values=fill)
    rows, columns = field.shape
    return jnp.stack([padded[REACH + r : REACH + r + rows, REACH + c : REACH + c + columns] for r, c in MOVES.tolist()])


def cost_to_go(cost: jax.Array, goal: jax.Array, cell_m: jax.Array) -> jax.Array:
    """Least cost [ny, nx] from every cell to ``goal``; inf where it cannot be reached.

    Args:
        cost: [ny, nx] cost per metre, inf where blocked.
        goal: [2] int (row, column); a blocked goal is reachable from nowhere.
        cell_m: [] edge length of a cell.
    """
    length = cell_m * jnp.asarray(np.linalg.norm(MOVES, axis=1), cost.dtype)[:, None, None]
    step = 0.5 * length * (cost + _neighbours(cost, np.inf))
    at_goal = (jnp.arange(cost.shape[0]) == goal[0])[:, None] & (jnp.arange(cost.shape[1]) == goal[1])
    field = jnp.where(at_goal & jnp.isfinite(cost), 0.0, jnp.inf)

    def relax(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        field, _ = carry
        better = jnp.minimum(field, jnp.min(_neighbours(field, np.inf) + step, axis=0))
        return better, jnp.any(better < field)

    return jax.lax.while_loop(lambda carry: carry[1], relax, (field, jnp.array(True)))[0]


def descend(field: jax.Array, cost: jax.Array, start: jax.Array, cell_m: jax.Array, steps: int) -> jax.Array:
    """Cells [steps + 1, 2] (row, column) from ``start`` down a cost-to-go ``field`` to its goal, which is repeated."""
    moves = jnp.asarray(MOVES)
    length = cell_m * jnp.asarray(np.linalg.norm(MOVES, axis=1), cost.dtype)
    shape = jnp.array(field.shape)

    def step(cell: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        there = cell + moves
        inside = jnp.all((there >= 0) & (there < shape), axis=-1)
        at = jnp.clip(there, 0, shape - 1)
        price = field[at[:, 0], at[:, 1]] + 0.5 * length * (cost[at[:, 0], at[:, 1]] + cost[cell[0], cell[1]])
        best = jnp.argmin(jnp.where(inside, price, jnp.inf))
        here = field[cell[0], cell[1]]
        arrived = (here == 0.0) | ~jnp.isfinite(here)
        following = jnp.where(arrived, cell, at[best])
        return following, following

    return jnp.concatenate([start[None], jax.lax.scan(step, start, None, length=steps)[1]])


def smooth(points_m: jax.Array, half_width: jax.Array | int) -> jax.Array:
    """Moving average of a polyline [P, D] over ``2 half_width + 1`` points, narrower at the ends, which stay."""
    count = points_m.shape[0]
    total = jnp.concatenate([jnp.zeros((1, points_m.shape[1])), jnp.cumsum(points_m - points_m[0], axis=0)])
    k = jnp.arange(count)
    half = jnp.minimum(jnp.minimum(k, count - 1 - k), half_width)
    return points_m[0] + (total[k + half + 1] - total[k - half]) / (2 * half + 1)[:, None]
