"""Photons that one box scatters into a detector, over those of an infinitely wide wall that the line crosses squarely.

Each face of a hollow box is one surface, which source and detector look at from the same side or from both; a solid box
is its middle plane, of each axis as far as the line leads through that one (`crossed_weights`). A place of the surface
scatters

    K dA / (d^2 d'^2),  K = F / (1 + r (1 - cos))^2 + m

photons, with d, d' the distances of source and detector, c, c' the cosines there, and cos that of the angle between the
ways to and from it. F is what scatters once and is not lost on its way through the wall, of depth t,

    (e^(-t / c) - e^(-g t / c')) / (g t / c' - t / c)         to the other side
    b (1 - e^(-t / c - g t / c')) / (t / c + g t / c')        back

g and b being for the photons' lower energy. Photons that scatter more often are in the constants, and m = M c^2 c' of
them come through the deepest of `DEPTHS` where the line itself does not. The integral over a face between source and
detector is taken at `NODES` x `NODES` places, Gauss-Legendre's in u = (x - x0) / sqrt((x - x0)^2 + h^2) on each edge,
with x0 and h the place and the width of the part of the plane that contributes most; of the other faces one place does.
The sum over the faces is divided by that of an infinite wall between the same two distances. What comes back from the
other walls of a box passes one more on its way: it is multiplied by e^(-f t (1 + s o / (1 + o))), o being the line's
metres in the wall over its thickness, less 1; what comes through both walls of a box between source and detector by
e^(-l t o / (1 + k o)). All of this is computed for walls of `DEPTHS`, and `swarmsim.radiation.walls` interpolates by
the depth that a line has.

Constants are those of ``configs/elements/walls.csv``, fitted to the Monte Carlo by ``experiments/transport/walls.py``.
"""

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.files import packaged_dir

DEPTHS = (0.25, 0.75, 2.25, 6.75)
"""Depths of a wall in mean free paths, each three times the one before."""
NODES = 2
"""Places along each edge of a face towards the detector."""
AWAY = 1
"""The same of the other faces."""
MOVING = 0.25
"""How near to a face a detector moves the places of the one opposite, over the box's half extent."""
PARALLEL_M = 1e-4  # over the whole segment; a smaller component of its direction is parallel to the slab
_LEAST_M = 1e-3  # from a plane, for rounding
_LEAST_COSINE = 1e-3


class Constants(NamedTuple):
    """Of this module, and from ``growth`` on of `swarmsim.radiation.walls`."""

    width: float  # of h
    softer: float  # g
    forward: float  # r
    back: float  # b
    diffuse: float  # M
    inside: float  # ln of all from a source inside a box, and its change with t / (1 + t)
    inside_depth: float
    between: float  # the same for a box between source and detector
    between_depth: float
    between_slant: float  # l
    between_steep: float  # k
    lost: float  # f
    lost_slant: float  # s
    sides: float  # ln of what a box between source and detector returns, and its change with t
    sides_depth: float
    growth: float  # a
    growth_depth: float  # b
    depth: float  # c
    energy: float  # v
    energy_depth: float  # w


@lru_cache(maxsize=1)
def constants() -> Constants:
    """The constants of the project's table."""
    text = (packaged_dir() / "elements" / "walls.csv").read_text(encoding="utf-8")
    rows = [line.split(",") for line in text.splitlines() if not line.startswith("#")][1:]
    return Constants(**{name: float(value) for name, value in rows})


class Box(NamedTuple):
    """A box that lines meet, and their ends in its axes, from its centre."""

    start: list[jax.Array]  # 3 of [n]
    end: list[jax.Array]
    half: list[jax.Array]
    wall_m: jax.Array  # [n] 0: solid


class Shares(NamedTuple):
    """What a box scatters."""

    share: list[jax.Array]  # DEPTHS of [n] over what a wide wall does that the line crosses squarely
    closed: jax.Array  # [n] 1 where one end of the line lies in a hollow box
    walls: jax.Array  # [n] how many walls in turn the line crosses
    thin_m: jax.Array  # [n] length the shortest way through them


def matter(
    start: list[jax.Array], along: list[jax.Array], outer: list[jax.Array], wall_m: jax.Array, distance: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """What segments of length ``distance`` cross of boxes [K], over that length: see `Box` for the other arguments.

    Returns the length in matter, the integral of the place along the segment over it, and the length the shortest way
    through each piece of matter; of a hollow box these are a wall before its inside and one after it, and of a solid
    one its halves before and after its middle. An end within matter has what is between it and the inside or middle.
    """
    middle, reach = slabs(start, along)
    inner = [half - wall_m for half in outer]
    hollow = (wall_m > 0.0) & (least(inner) > 0.0)
    first, last = part_inside(middle, reach, outer)
    enter, leave = part_inside(middle, reach, inner)
    whole, empty = jnp.maximum(last - first, 0.0), jnp.where(hollow, jnp.maximum(leave - enter, 0.0), 0.0)
    share = whole - empty
    moment = 0.5 * (whole * (first + last) - empty * (enter + leave))
    thickness = jnp.maximum(jnp.where(hollow, wall_m, least(outer)), 1e-6)
    end = [x + d for x, d in zip(start, along, strict=True)]
    wall = jnp.where(hollow, wall_m, _mean(crossed_weights(along, outer), outer)) / jnp.maximum(distance, 1e-9)
    before, after = (wall * _outside(x, outer, thickness) for x in (start, end))
    each = jnp.minimum(enter - first, before) + jnp.minimum(last - leave, after)
    return share, moment, jnp.minimum(share, jnp.where(empty > 0.0, each, before + after))


def crossed_weights(along: list[jax.Array], half: list[jax.Array]) -> list[jax.Array]:
    """How much a line is one through the slab of each axis of a solid box; their sum is 1.

    It is that of the axis with the shortest way from face to face; the weights are the fourth powers of the inverse.
    """
    fourth = [jnp.square(jnp.square(d / jnp.maximum(h, 1e-3))) for d, h in zip(along, half, strict=True)]
    total = jnp.maximum(fourth[0] + fourth[1] + fourth[2], 1e-12)
    return [x / total for x in fourth]


def _mean(weights: list[jax.Array], x: list[jax.Array]) -> jax.Array:
    return weights[0] * x[0] + weights[1] * x[1] + weights[2] * x[2]


def slabs(start: list[jax.Array], along: list[jax.Array]) -> tuple[list[jax.Array], list[jax.Array]]:
    """Where segments cross the middle planes of boxes, and how much of them a metre across those takes."""
    # Clamp a component that is too small to divide by: the slab then extends far beyond the segment.
    inverse = [1.0 / jnp.where(jnp.abs(d) < PARALLEL_M, PARALLEL_M, d) for d in along]
    return [-x * i for x, i in zip(start, inverse, strict=True)], [jnp.abs(i) for i in inverse]


def part_inside(middle: list[jax.Array], reach: list[jax.Array], half: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
    """Where segments enter and leave slabs at middle -/+ reach half; the latter is less where they do not meet."""
    enter = [m - r * h for m, r, h in zip(middle, reach, half, strict=True)]
    leave = [m + r * h for m, r, h in zip(middle, reach, half, strict=True)]
    return jnp.maximum(most(enter), 0.0), jnp.minimum(least(leave), 1.0)


def most(x: list[jax.Array]) -> jax.Array:
    """Largest of three."""
    return jnp.maximum(jnp.maximum(x[0], x[1]), x[2])


def least(x: list[jax.Array]) -> jax.Array:
    """Smallest of three."""
    return jnp.minimum(jnp.minimum(x[0], x[1]), x[2])


def scattered_share(box: Box, k: Constants | None = None) -> Shares:
    """Of each line and the box that it meets."""
    k = k or constants()
    hollow = (box.wall_m > 0.0) & (least(box.half) > box.wall_m)
    thickness = jnp.maximum(jnp.where(hollow, box.wall_m, least(box.half)), _LEAST_M)
    ends = [_outside(x, box.half, thickness) for x in (box.start, box.end)]
    walls = jnp.maximum(ends[0] + ends[1], 1.0)
    # kept in memory, here and below: fused into all that uses them, they would be computed once for each
    toward, away, walls = jax.lax.optimization_barrier((*_faces(box, hollow, walls), walls))
    seen = jax.lax.optimization_barrier([_seen(toward, NODES, k), _seen(away, AWAY, k)])
    opposite = [toward.opposite, away.opposite]
    along = [b - a for a, b in zip(box.start, box.end, strict=True)]
    distance = jnp.sqrt(toward.squared)
    share, moment, thin = matter(box.start, along, box.half, box.wall_m, distance)
    share, moment, thin = jax.lax.optimization_barrier((share, moment, thin))
    wide = jax.lax.optimization_barrier(_wide(moment / jnp.maximum(share, 1e-9), k))
    between = jnp.where(hollow, walls - 1.0, 0.0)
    inside, over = jnp.where(hollow, 2.0 - walls, 0.0), jnp.maximum(share / jnp.maximum(thin, 1e-9) - 1.0, 0.0)
    found = []
    for t, depth in enumerate(DEPTHS):
        x = depth / (1.0 + depth)
        lost = k.between_slant * depth * over / (1.0 + k.between_steep * over)
        of_through = inside * (k.inside + k.inside_depth * x) + between * (k.between + k.between_depth * x - lost)
        of_returned = between * (k.sides + k.sides_depth * depth)
        of_returned -= k.lost * depth * (1.0 + k.lost_slant * over / (1.0 + over))
        one = sum(_sum(jnp.where(x, s[t], 0.0)) for x, s in zip(opposite, seen, strict=True))
        other = sum(_sum(jnp.where(x, 0.0, s[t])) for x, s in zip(opposite, seen, strict=True))
        found.append((one * jnp.exp(of_through) + other * jnp.exp(of_returned)) / wide[t])
    # an end within matter: as a slab, of a hollow box the more so the nearer it is to the middle of the wall
    among = jnp.where(hollow, jnp.abs((2.0 * ends[0] - 1.0) * (2.0 * ends[1] - 1.0)), ends[0] * ends[1])
    shares = jax.lax.optimization_barrier([1.0 + among * (s - 1.0) for s in found])
    return Shares(share=shares, closed=inside, walls=jnp.where(hollow, walls, 1.0), thin_m=thin * distance)


def _sum(each: jax.Array) -> jax.Array:
    """Of three faces [3, n]; a reduction along the first axis would not be vectorised."""
    return each[0] + each[1] + each[2]


def _outside(x: list[jax.Array], half: list[jax.Array], thickness: jax.Array) -> jax.Array:
    """How far [n] from the inner surface (0) to the outer one (1) and beyond."""
    out = [jnp.abs(place) - h for place, h in zip(x, half, strict=True)]
    return jnp.clip(most(out) / thickness + 1.0, 0.0, 1.0)


class _Faces(NamedTuple):
    """A face of boxes along each axis [3, n]."""

    source: jax.Array  # heights of source and detector above the face
    detector: jax.Array
    low: tuple[jax.Array, jax.Array]  # edges of the face, from the source's foot
    high: tuple[jax.Array, jax.Array]
    foot: tuple[jax.Array, jax.Array]  # the detector's foot
    squared: jax.Array  # [n] distance of source and detector, squared
    weight: jax.Array
    apart: jax.Array  # 0..1 how far the places of the face lie from their middle
    opposite: jax.Array  # whether source and detector are on different sides


def _faces(box: Box, hollow: jax.Array, walls: jax.Array) -> tuple[_Faces, _Faces]:
    """Of each axis the face that lies between source and detector, of two that of the detector, and the other one."""
    along = [b - a for a, b in zip(box.start, box.end, strict=True)]
    x, y, z = (jnp.square(component) for component in along)
    squared, found = x + y + z, []
    # the middle plane of a solid box is one, and the line crosses it within the box where the others are far off
    crossed = crossed_weights(along, box.half)
    edge = jnp.where(hollow, 0.5 * box.wall_m, 0.0)
    for sign in (1.0, -1.0):
        rows = []
        for axis in range(3):
            plane = jnp.where(hollow, box.half[axis] - edge, 0.0)
            s, d = box.start[axis], box.end[axis]
            # the face between the ends, if there is one, and of two that the detector is nearer to
            within = jnp.abs(d) < plane
            side = jnp.where(jnp.where(within, s, d - s) > 0.0, sign, -sign)
            # where the detector passes from the one case to the other, places of the face move together
            near = jnp.abs(jnp.abs(d) - plane) / jnp.maximum(MOVING * box.half[axis], _LEAST_M)
            apart = jnp.where(hollow & (d * s < 0.0), jnp.clip(near, 0.0, 1.0), 1.0)
            weight = jnp.where(hollow, 1.0 / walls, crossed[axis] * (0.5 + 0.5 * sign))
            spans = [x for j in range(3) if j != axis for x in (
                edge - box.half[j] - box.start[j], box.half[j] - edge - box.start[j], box.end[j] - box.start[j]
            )]  # fmt: skip
            rows.append((side * s - plane, side * d - plane, weight, apart, *spans))
        rows = jax.lax.optimization_barrier(rows)
        source, detector, weight, apart, l1, h1, f1, l2, h2, f2 = (jnp.stack(x) for x in zip(*rows, strict=True))
        found.append(_Faces(
            source=source, detector=detector, low=(l1, l2), high=(h1, h2), foot=(f1, f2), squared=squared,
            weight=weight, apart=apart, opposite=source * detector < 0.0,
        ))  # fmt: skip
    return found[0], found[1]


def _seen(faces: _Faces, nodes_of_edge: int, k: Constants) -> list[jax.Array]:
    """What source and detector see of each face [3, n], at each of `DEPTHS`."""
    s, d = jnp.abs(faces.source) + _LEAST_M, jnp.abs(faces.detector) + _LEAST_M
    near, far = s * s, d * d
    for low, high, foot in zip(faces.low, faces.high, faces.foot, strict=True):
        near += jnp.square(jnp.maximum(jnp.maximum(low, -high), 0.0))
        far += jnp.square(jnp.maximum(jnp.maximum(low - foot, foot - high), 0.0))
    h = k.width * jnp.sqrt(near * far) / (jnp.sqrt(near) + jnp.sqrt(far))
    part = near / (near + far)
    # a face that is seen from one side has one place, whichever way the line runs
    apart = jnp.where(faces.opposite, faces.apart, 0.0)
    along, across = (
        _along(low, high, foot * part, h, nodes_of_edge, apart) for low, high, foot in zip(*faces[2:5], strict=True)
    )
    scale = faces.weight * faces.squared * (1.0 / (2.0 * np.pi))
    along, across, scale = jax.lax.optimization_barrier((along, across, scale))
    nodes = []
    for x, of_x in along:
        for y, of_y in across:
            u, v = faces.foot[0] - x, faces.foot[1] - y
            one, two = jax.lax.rsqrt(x * x + y * y + s * s), jax.lax.rsqrt(u * u + v * v + d * d)
            both = one * two
            cosine = (x * u + y * v - faces.source * faces.detector) * both
            weight = scale * of_x * of_y * both * both
            nodes.append(_Node.at(weight, s * one, d * two, 1.0 - cosine, k))
    return _kernels(jax.lax.optimization_barrier(nodes), faces.opposite, k)


class _Node(NamedTuple):
    """A place of a face."""

    source: jax.Array  # cosines
    detector: jax.Array
    weight: jax.Array  # of what scatters once
    turned: jax.Array  # over that, of what scatters more often
    into: jax.Array  # e^(-t / c) and e^(-g t / c') of the first of `DEPTHS`
    out: jax.Array

    @staticmethod
    def at(weight: jax.Array, source: jax.Array, detector: jax.Array, turned: jax.Array, k: Constants) -> "_Node":
        """By its weight, the cosines, and 1 - cosine of the angle between the ways."""
        c, d = jnp.maximum(source, _LEAST_COSINE), jnp.maximum(detector, _LEAST_COSINE)
        often = jnp.square(1.0 + k.forward * turned)
        return _Node(c, d, weight / often, often, jnp.exp(-DEPTHS[0] / c), jnp.exp(-k.softer * DEPTHS[0] / d))


def _along(
    low: jax.Array, high: jax.Array, middle: jax.Array, h: jax.Array, nodes: int, apart: jax.Array | float = 1.0
) -> list[tuple[jax.Array, jax.Array]]:
    """Places along one edge, and their weights; with ``apart`` 0 all in the middle."""
    first, last = low - middle, high - middle
    first, last = (x * jax.lax.rsqrt(x * x + h * h) for x in (first, last))
    half, centre, found = 0.5 * (last - first), 0.5 * (first + last), []
    for node, weight in zip(*np.polynomial.legendre.leggauss(nodes), strict=True):
        u = centre + float(node) * apart * half
        root = jax.lax.rsqrt(jnp.maximum(1.0 - u * u, 1e-9))
        found.append((middle + h * u * root, float(weight) * half * h * root * root * root))
    return found


def _kernels(nodes: list[_Node], opposite: jax.Array | bool, k: Constants) -> list[jax.Array]:
    """Sums of K over places, at each of `DEPTHS`."""
    found = []
    for t, depth in enumerate(DEPTHS):
        total = jnp.zeros_like(nodes[0].weight)
        for node in nodes:
            one, two = node.into, node.out
            for _ in range(t):
                one, two = one * one * one, two * two * two
            into, out = depth / node.source, k.softer * depth / node.detector
            apart = out - into
            few = jnp.abs(apart) < 0.3
            once = jnp.where(
                few, 0.5 * (one + two) * (1.0 - apart * apart / 12.0), (one - two) / jnp.where(few, 1.0, apart)
            )
            passed = once
            if depth == DEPTHS[-1]:
                passed = once + k.diffuse * node.source * node.source * node.detector * node.turned
            back = k.back * (1.0 - one * two) / (into + out)
            total += node.weight * jnp.where(opposite, passed, back)
        found.append(total)
    return found


def _wide(place: jax.Array, k: Constants) -> list[jax.Array]:
    """The same sum [n] over an infinite wall that the line crosses squarely at ``place`` between its ends."""
    s = jnp.clip(place, 0.02, 0.98)
    d, wide = 1.0 - s, jnp.full_like(s, 1e4)
    along = _along(-wide, wide, jnp.zeros_like(s), k.width * s * d, NODES)[NODES // 2 :]  # it is symmetric
    along = [(x, w if NODES % 2 and not j else 2.0 * w) for j, (x, w) in enumerate(along)]
    nodes = []
    for x, of_x in along:
        for y, of_y in along:
            one, two = jax.lax.rsqrt(x * x + y * y + s * s), jax.lax.rsqrt(x * x + y * y + d * d)
            both = one * two
            weight = of_x * of_y * both * both * (1.0 / (2.0 * np.pi))
            nodes.append(_Node.at(weight, s * one, d * two, 1.0 - (s * d - x * x - y * y) * both, k))
    return _kernels(nodes, True, k)
