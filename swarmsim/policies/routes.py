"""Least-cost routes over a grid: a cost-to-go field by relaxation, and the route that descends it.

The field is the fixed point of Bellman's equation on a grid graph with 16 neighbours (king's and knight's moves), whose
lengths exceed the Euclidean ones by at most 2.8 % (Nagy, "Digital geometry of neighborhood sequences"; Montanari 1968).
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.site import Site, sample

MOVES = np.array(
    [(r, c) for r in range(-2, 3) for c in range(-2, 3) if abs(r) + abs(c) in (1, 3) or abs(r) == abs(c) == 1]
)  # (row, column)
REACH = 2  # furthest a move goes along one axis
SAMPLE_CELLS = 2  # cells of the raster of clearances between the points of a move at which they are looked up


def coarsen(cost: jax.Array, clearance_m: jax.Array, factor: int) -> jax.Array:
    """Mean cost per metre on blocks of ``factor`` x ``factor`` cells; inf where it is too steep or a step too high.

    Cells inside an obstacle (negative ``clearance_m``) do not count: `line_clearance` tells where a vehicle fits. A
    block of such cells only is inf. Rows and columns beyond a whole number of blocks are dropped.
    """
    rows, columns = (n // factor for n in cost.shape)

    def blocks(raster: jax.Array) -> jax.Array:
        whole = raster[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
        return whole.transpose(0, 2, 1, 3).reshape(rows, columns, factor * factor)

    free, price = blocks(clearance_m) > 0.0, blocks(cost)
    count = jnp.sum(free, axis=-1)
    mean = jnp.sum(jnp.where(free, price, 0.0), axis=-1) / jnp.maximum(count, 1)
    return jnp.where(count > 0, mean, jnp.inf)


def at_centres(raster: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Values [ny, nx] of a finer raster [f ny, f nx], f odd, at the centres of cells of ``shape``."""
    factor = max(1, raster.shape[0] // shape[0])
    return raster[factor // 2 :: factor, factor // 2 :: factor]


def clearance_at(site: Site, standing_m: jax.Array, xy: jax.Array) -> jax.Array:
    """Clearance [...] of a rover's centre at places [..., 2]: to obstacles, and to what stands there [V, 3].

    Of the latter east, north and a radius are given.
    """
    # written out, so that the least is taken without an array of all: a swarm may stand there
    east, north = (xy[..., None, axis] - standing_m[:, axis] for axis in (0, 1))
    apart = jnp.sqrt(east * east + north * north) - standing_m[:, 2]
    return jnp.minimum(sample(site.clearance_m, site, xy), jnp.min(apart, axis=-1, initial=jnp.inf))


def line_clearance(
    site: Site, standing_m: jax.Array, start_m: jax.Array, end_m: jax.Array, samples: int
) -> jax.Array:  # fmt: skip
    """Least `clearance_at` [...] on straight lines from ``start_m`` to ``end_m`` [..., 2]."""
    share = jnp.linspace(0.0, 1.0, samples)

    def closer(least: jax.Array, along: jax.Array) -> tuple[jax.Array, None]:
        return jnp.minimum(least, clearance_at(site, standing_m, start_m + along * (end_m - start_m))), None

    shape = jnp.broadcast_shapes(start_m.shape, end_m.shape)[:-1]
    return jax.lax.scan(closer, jnp.full(shape, jnp.inf), share)[0]


def move_clearance(
    site: Site, standing_m: jax.Array, centre_m: jax.Array, cell_m: jax.Array, fine_cells: int
) -> jax.Array:  # fmt: skip
    """Least `clearance_at` [16, ny, nx] along each move from cells with centres ``centre_m`` [ny, nx, 2].

    ``fine_cells`` cells of the raster of clearances lie along the edge ``cell_m`` [] of a cell.
    """
    found: dict[tuple[int, int], jax.Array] = {}
    rows, columns = centre_m.shape[:2]
    for row, column in MOVES.tolist():
        if (-row, -column) in found:  # the same line, from its other end
            back = jnp.pad(found[-row, -column], REACH, constant_values=-jnp.inf)
            found[row, column] = back[REACH + row : REACH + row + rows, REACH + column : REACH + column + columns]
        else:
            samples = max(2, math.ceil(fine_cells * math.hypot(row, column) / SAMPLE_CELLS)) + 1
            end = centre_m + cell_m * jnp.array([column, row], jnp.float32)
            found[row, column] = line_clearance(site, standing_m, centre_m, end, samples)
    return jnp.stack(list(found.values()))


def move_costs(cost: jax.Array, fits: jax.Array, cell_m: jax.Array) -> jax.Array:
    """Cost [16, ny, nx] of each move from each cell; inf where there is no way.

    Args:
        cost: [ny, nx] per metre, inf where no wheel can stand.
        fits: [16, ny, nx] whether the vehicle fits along the move.
        cell_m: [] edge length of a cell.

    No move leads across such cells: between those that a knight's move passes, or two that meet at their corners.
    """
    length = cell_m * jnp.asarray(np.linalg.norm(MOVES, axis=1), cost.dtype)[:, None, None]
    price = 0.5 * length * (cost + _neighbours(cost, np.inf))
    padded = jnp.pad(jnp.isfinite(cost), REACH)
    rows, columns = cost.shape

    def stands(row: int, column: int) -> jax.Array:
        return padded[REACH + row : REACH + row + rows, REACH + column : REACH + column + columns]

    ways = []
    for row, column in MOVES.tolist():
        r, c = int(np.sign(row)), int(np.sign(column))
        if abs(row) == abs(column):
            ways.append(stands(r, 0) | stands(0, c))
        elif abs(row) + abs(column) == 3:
            beside = stands(r, 0) if abs(row) == 2 else stands(0, c)
            ways.append(beside & stands(r, c))
        else:
            ways.append(jnp.ones(cost.shape, bool))
    return jnp.where(fits & jnp.stack(ways), price, jnp.inf)


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


def cost_to_go(moves: jax.Array, goal: jax.Array) -> jax.Array:
    """Least cost [ny, nx] from every cell to ``goal``; inf where it cannot be reached.

    Args:
        moves: [16, ny, nx] cost of each move from each cell (`move_costs`).
        goal: [2] int (row, column); a goal that no move leads to is reachable from nowhere.
    """
    rows, columns = moves.shape[1:]
    at_goal = (jnp.arange(rows) == goal[0])[:, None] & (jnp.arange(columns) == goal[1])
    field = jnp.where(at_goal, 0.0, jnp.inf)

    def relax(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        field, _ = carry
        better = jnp.minimum(field, jnp.min(_neighbours(field, np.inf) + moves, axis=0))
        return better, jnp.any(better < field)

    return jax.lax.while_loop(lambda carry: carry[1], relax, (field, jnp.array(True)))[0]


def descend(field: jax.Array, moves: jax.Array, start: jax.Array, steps: int) -> jax.Array:
    """Cells [steps + 1, 2] (row, column) from ``start`` down a cost-to-go ``field`` to its goal, which is repeated."""
    way = jnp.asarray(MOVES)
    shape = jnp.array(field.shape)

    def step(cell: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        there = cell + way
        inside = jnp.all((there >= 0) & (there < shape), axis=-1)
        at = jnp.clip(there, 0, shape - 1)
        price = field[at[:, 0], at[:, 1]] + moves[:, cell[0], cell[1]]
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
