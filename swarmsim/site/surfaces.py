"""What of a box decides how many photons it scatters from one end of a line to the other.

Each face of a hollow box is one surface, which source and detector look at from the same side or from both; a solid box
is its middle plane, of each axis as far as the line leads through that one (`crossed_weights`). A place of the surface
scatters

    K dA / (d^2 d'^2),  K = F / (1 + r (1 - cos))^2

photons, with d, d' the distances of source and detector, c, c' the cosines there, and cos that of the angle between the
ways to and from it. F is what scatters once and is not lost on its way through the wall, of depth t,

    (e^(-t / c) - e^(-g t / c')) / (g t / c' - t / c)         to the other side
    (1 - e^(-t / c - g t / c')) / (t / c + g t / c')          back

g being for the photons' lower energy. The integral over a face is taken at one place in
u = (x - x0) / sqrt((x - x0)^2 + h^2) on each edge, with x0 and h the place and the width of the part of the plane that
contributes most. The sums over the faces, of what passes them and of what they send back, are divided by that of an
infinite wall between the same two distances.

They are features among others, lengths and distances over the box's size, of which `swarmsim.site.wall_network` makes
the photons that arrive: the integral is known to a factor of two by one place, photons scatter more than once, in all
walls of a box, and soften. All of this is symmetric in the axes and the sides of a box, and continuous in the ends of
the line.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

SEEN = (0.75, 6.75)
"""Depths in mean free paths of the walls of which faces are looked at; the second is nine times the first."""
WIDTH = 1.442  # of h; this and the next two were fitted to the Monte Carlo of buildings, without the other features
SOFTER = 0.7975  # g
FORWARD = 0.6962  # r
FEATURES = (
    "through_thin",  # ln of the sum of what passes faces, at each depth of `SEEN`
    "through_thick",
    "back_thin",  # of what comes back
    "back_thick",
    "slant",  # o / (1 + o), o being the line's metres in walls over the short way through them, less 1
    "grazing",  # ln(o)
    "place",  # of the matter along the line
    "between",  # share of the line that lies inside the walls
    "first",  # share of the matter that lies before that
    "detector_way",  # ln of the detector's distance from the box over the line's length
    "detector",  # ln of distances and lengths over the mean of the box's half extents: the detector's from the box,
    "outside",  # the source's from the box,
    "inside",  # its distance from the nearest face within, as such; outside negative, and at least -1
    "detector_inside",  # that of the detector
    "two",  # 1 where the line crosses two walls in turn
    "hollow",  # 1, of a solid box 0
    "thin",  # the short way through the walls
    "narrow",  # the least and
    "broad",  # the largest half extent
)
PARALLEL_M = 1e-4  # over the whole segment; a smaller component of its direction is parallel to the slab
_LEAST_M = 1e-3  # from a plane, for rounding
_LEAST_COSINE = 1e-6
_LEAST_SEEN = 0.02
_LEAST_SLANT = 0.15
_LEAST_RATIO = 3e-3
_LEAST_THIN = 0.01
_LEAST_AWAY = 0.01  # of the box's size: a source that touches a face must not count by tenths of a millimetre


class Box(NamedTuple):
    """A box that lines meet, and their ends in its axes, from its centre."""

    start: list[jax.Array]  # 3 of [n]
    end: list[jax.Array]
    half: list[jax.Array]
    wall_m: jax.Array  # [n] 0: solid


class Matter(NamedTuple):
    """What segments cross of boxes [K]; lengths over the segment's."""

    share: jax.Array  # length in matter
    moment: jax.Array  # integral of the place along the segment over it
    thin: jax.Array  # the shortest way through each piece of matter
    between: jax.Array  # length inside the walls of a hollow box
    first: jax.Array  # 0..1: share of the matter that lies before that, of a solid one half


class Surroundings(NamedTuple):
    """What decides how a box scatters photons from the one end of a line to the other."""

    features: list[jax.Array]  # FEATURES of [n]
    among: jax.Array  # [n] 0..1: less where an end lies within matter
    closed: jax.Array  # [n] 1 where one end of the line lies in a hollow box
    walls: jax.Array  # [n] how many walls in turn the line crosses
    thin_m: jax.Array  # [n] length the shortest way through them


def matter(
    start: list[jax.Array], along: list[jax.Array], outer: list[jax.Array], wall_m: jax.Array, distance: jax.Array
) -> Matter:
    """What segments of length ``distance`` cross of boxes: see `Box` for the other arguments.

    Pieces of matter are of a hollow box a wall before its inside and one after it, and of a solid one its halves before
    and after its middle. An end within matter has what is between it and the inside or middle.
    """
    middle, reach = slabs(start, along)
    hollow = (wall_m > 0.0) & (least(outer) > wall_m)
    inner = [half - jnp.where(hollow, wall_m, 0.0) for half in outer]
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
    # of a line that passes the inside by: the less of it counts, the farther it passes, until both halves are alike
    one, other = jnp.clip(enter - first, 0.0, whole), jnp.clip(last - leave, 0.0, whole)
    past = jnp.clip((enter - leave) / jnp.maximum(whole, 1e-9), 0.0, 1.0)
    lead = 0.5 * (one - other) / jnp.maximum(one + other, 1e-9) * (1.0 - past)
    return Matter(
        share=share, moment=moment, thin=jnp.minimum(share, jnp.where(empty > 0.0, each, before + after)),
        between=empty, first=jnp.where(hollow, 0.5 + lead, 0.5),
    )  # fmt: skip


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


def surroundings(box: Box) -> Surroundings:
    """Of each line and the box that it meets."""
    hollow = (box.wall_m > 0.0) & (least(box.half) > box.wall_m)
    thickness = jnp.maximum(jnp.where(hollow, box.wall_m, least(box.half)), _LEAST_M)
    ends = [_outside(x, box.half, thickness) for x in (box.start, box.end)]
    walls = jnp.maximum(ends[0] + ends[1], 1.0)
    # kept in memory, here and below: fused into all that uses them, they would be computed once for each
    toward, away, walls = jax.lax.optimization_barrier((*_faces(box, hollow, walls), walls))
    seen = jax.lax.optimization_barrier([_seen(toward), _seen(away)])
    opposite = [toward.opposite, away.opposite]
    along = [b - a for a, b in zip(box.start, box.end, strict=True)]
    distance = jnp.sqrt(toward.squared)
    met = matter(box.start, along, box.half, box.wall_m, distance)
    share, moment, thin, between, first = jax.lax.optimization_barrier(met)
    place = moment / jnp.maximum(share, 1e-9)
    wide = _wide(place)
    through = [sum(_sum(jnp.where(x, s[t], 0.0)) for x, s in zip(opposite, seen, strict=True)) for t in range(2)]
    back = [sum(_sum(jnp.where(x, 0.0, s[t])) for x, s in zip(opposite, seen, strict=True)) for t in range(2)]
    over = jnp.maximum(share / jnp.maximum(thin, 1e-9) - 1.0, 0.0)
    size = jnp.maximum(jnp.cbrt(box.half[0] * box.half[1] * box.half[2]), _LEAST_M)
    detector, source = _away(box.end, box.half), _away(box.start, box.half)
    features = [
        *(_log(x / w, _LEAST_SEEN) for some in (through, back) for x, w in zip(some, wide, strict=True)),
        over / (1.0 + over),
        _log(over, _LEAST_SLANT),
        place,
        between,
        first,
        _log(detector / jnp.maximum(distance, _LEAST_M), _LEAST_RATIO),
        *(_log(x / size, _LEAST_AWAY) for x in (detector, source)),
        *(jnp.maximum(-most(_beyond(x, box.half)) / size, -1.0) for x in (box.start, box.end)),
        jnp.where(hollow, walls - 1.0, 0.0),
        jnp.where(hollow, 1.0, 0.0),
        _log(thin * distance / size, _LEAST_THIN),
        *(_log(x / size, _LEAST_RATIO) for x in (least(box.half), most(box.half))),
    ]
    # an end within matter: as a slab, of a hollow box the more so the nearer it is to the middle of the wall
    among = jnp.where(hollow, jnp.abs((2.0 * ends[0] - 1.0) * (2.0 * ends[1] - 1.0)), ends[0] * ends[1])
    return Surroundings(
        features=features, among=among, closed=jnp.where(hollow, 2.0 - walls, 0.0),
        walls=jnp.where(hollow, walls, 1.0), thin_m=thin * distance,
    )  # fmt: skip


def _beyond(x: list[jax.Array], half: list[jax.Array]) -> list[jax.Array]:
    return [jnp.abs(place) - h for place, h in zip(x, half, strict=True)]


def _away(x: list[jax.Array], half: list[jax.Array]) -> jax.Array:
    """Distance [n] from the box, 0 inside."""
    a, b, c = (jnp.square(jnp.maximum(out, 0.0)) for out in _beyond(x, half))
    return jnp.sqrt(a + b + c)


def _log(x: jax.Array, smallest: float) -> jax.Array:
    return jnp.log(jnp.maximum(x, 0.0) + smallest)


def _sum(each: jax.Array) -> jax.Array:
    """Of three faces [3, n]; a reduction along the first axis would not be vectorised."""
    return each[0] + each[1] + each[2]


def _outside(x: list[jax.Array], half: list[jax.Array], thickness: jax.Array) -> jax.Array:
    """How far [n] from the inner surface (0) to the outer one (1) and beyond."""
    return jnp.clip(most(_beyond(x, half)) / thickness + 1.0, 0.0, 1.0)


class _Faces(NamedTuple):
    """A face of boxes along each axis [3, n]."""

    source: jax.Array  # heights of source and detector above the face
    detector: jax.Array
    low: tuple[jax.Array, jax.Array]  # edges of the face, from the source's foot
    high: tuple[jax.Array, jax.Array]
    foot: tuple[jax.Array, jax.Array]  # the detector's foot
    squared: jax.Array  # [n] distance of source and detector, squared
    weight: jax.Array
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
            weight = jnp.where(hollow, 1.0 / walls, crossed[axis] * (0.5 + 0.5 * sign))
            spans = [x for j in range(3) if j != axis for x in (
                edge - box.half[j] - box.start[j], box.half[j] - edge - box.start[j], box.end[j] - box.start[j]
            )]  # fmt: skip
            rows.append((side * s - plane, side * d - plane, weight, *spans))
        rows = jax.lax.optimization_barrier(rows)
        source, detector, weight, l1, h1, f1, l2, h2, f2 = (jnp.stack(x) for x in zip(*rows, strict=True))
        found.append(_Faces(
            source=source, detector=detector, low=(l1, l2), high=(h1, h2), foot=(f1, f2), squared=squared,
            weight=weight, opposite=source * detector < 0.0,
        ))  # fmt: skip
    return found[0], found[1]


def _seen(faces: _Faces) -> list[jax.Array]:
    """What source and detector see of each face [3, n], at each depth of `SEEN`."""
    source, detector = jnp.abs(faces.source), jnp.abs(faces.detector)
    s, d = source + _LEAST_M, detector + _LEAST_M
    near, far = s * s, d * d
    for low, high, foot in zip(faces.low, faces.high, faces.foot, strict=True):
        near += jnp.square(jnp.maximum(jnp.maximum(low, -high), 0.0))
        far += jnp.square(jnp.maximum(jnp.maximum(low - foot, foot - high), 0.0))
    h = WIDTH * jnp.sqrt(near * far) / (jnp.sqrt(near) + jnp.sqrt(far))
    part = near / (near + far)
    (x, of_x), (y, of_y) = (
        _middle(low, high, foot * part, h) for low, high, foot in zip(*faces[2:5], strict=True)
    )  # fmt: skip
    u, v = faces.foot[0] - x, faces.foot[1] - y
    one, two = jax.lax.rsqrt(x * x + y * y + s * s), jax.lax.rsqrt(u * u + v * v + d * d)
    both = one * two
    cosine = (x * u + y * v - faces.source * faces.detector) * both
    weight = faces.weight * faces.squared * (1.0 / (2.0 * np.pi)) * of_x * of_y * both * both
    # what passes a face and what comes back are both nothing where an end lies in its plane
    return _kernels(weight, source * one, detector * two, 1.0 - cosine, faces.opposite)


def _middle(low: jax.Array, high: jax.Array, middle: jax.Array, h: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The place along one edge, and its weight."""
    first, last = (x * jax.lax.rsqrt(x * x + h * h) for x in (low - middle, high - middle))
    u = 0.5 * (first + last)
    root = jax.lax.rsqrt(jnp.maximum(1.0 - u * u, 1e-9))
    return middle + h * u * root, (last - first) * h * root * root * root


def _kernels(
    weight: jax.Array, source: jax.Array, detector: jax.Array, turned: jax.Array, opposite: jax.Array | bool
) -> list[jax.Array]:
    """K with its ``weight`` at each depth of `SEEN`, by the cosines, and 1 - cosine of the angle between the ways."""
    c, d = jnp.maximum(source, _LEAST_COSINE), jnp.maximum(detector, _LEAST_COSINE)
    weight = weight / jnp.square(1.0 + FORWARD * turned)
    one, two, found = jnp.exp(-SEEN[0] / c), jnp.exp(-SOFTER * SEEN[0] / d), []
    for number, depth in enumerate(SEEN):
        if number:
            one, two = (x * x * x for x in (one, two))
            one, two = (x * x * x for x in (one, two))
        into, out = depth / c, SOFTER * depth / d
        apart = out - into
        few = jnp.abs(apart) < 0.3
        passed = jnp.where(
            few, 0.5 * (one + two) * (1.0 - apart * apart / 12.0), (one - two) / jnp.where(few, 1.0, apart)
        )
        found.append(weight * jnp.where(opposite, passed, (1.0 - one * two) / (into + out)))
    return found


def _wide(place: jax.Array) -> list[jax.Array]:
    """The same [n] of an infinite wall that the line crosses squarely at ``place`` between its ends: a place of each
    quarter of it."""
    s = jnp.clip(place, 0.02, 0.98)
    d = 1.0 - s
    x, of_x = _middle(jnp.zeros_like(s), jnp.full_like(s, 1e4), jnp.zeros_like(s), WIDTH * s * d)
    one, two = jax.lax.rsqrt(2.0 * x * x + s * s), jax.lax.rsqrt(2.0 * x * x + d * d)
    both = one * two
    weight = jnp.square(2.0 * of_x * both) * (1.0 / (2.0 * np.pi))
    return _kernels(weight, s * one, d * two, 1.0 - (s * d - 2.0 * x * x) * both, True)
