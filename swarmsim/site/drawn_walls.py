"""Walls that a closed mesh draws with their thickness, as boxes along its faces.

A house drawn as one mesh is a component whose plan is mostly empty. Its upright faces give the lines that its plan is
cut along; between them the matter is exactly that of the mesh, whatever the thickness of walls and the width of gaps.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from swarmsim.site.columns import Columns, columns_at, oriented, volume
from swarmsim.site.obstacles import AREA_SMALL, Box
from swarmsim.site.raster import Floats, Integers

Mask = NDArray[np.bool_]

UPRIGHT = 0.02  # |cosine| to the vertical of the normal of an upright face
FACING = 0.999  # cosine to a direction of the normal of a face that faces it
MERGE_M = 2e-3  # faces and heights so near to one another are at one place
ALONG_M = 0.02  # a face whose ends lie no farther from a direction runs along it
DIRECTIONS_MAX = 8  # of walls, modulo a right angle
COVERED_MIN = 0.7  # share of the upright faces along these directions; else it is no building
STEP_M = 0.5  # cells where sloped or oblique faces run through them
RISE_M = 0.2  # sloped faces are stairs of this rise: heights to 0.1 m, as of the raster of clearances
CELLS_MAX = 60_000
THICK_M = 1.0  # twice volume over surface: no wall of a building is thicker, and a thicker piece is a block
EMPTY_SHARE = 0.5  # of the convex hull that is matter; a fuller piece is a block, which the rules may call hollow
FAITHFUL = 0.1  # share of the matter by which boxes may differ from what is drawn
BOXES_MAX = 128  # of a component
# Where a cell is looked at: its middle, and near its corners. Odd numbers, so that no diagonal of a face runs there.
PLACES = ((0.4967, 0.5041), (0.0523, 0.0477), (0.9459, 0.0511), (0.0487, 0.9533), (0.9513, 0.9471))


@dataclass(frozen=True)
class _Pieces:
    """Rectangles of plan with the same matter along all vertical lines through them."""

    low: Floats  # [n, 3] m, along the axis, across it, up
    high: Floats  # [n, 3] m
    axis: Floats  # [n, 2] cos, sin of yaw


def drawn_walls(corners: Floats) -> list[Box] | None:
    """The boxes of a component with triangles ``corners`` [t, 3, 3]; None where it does not draw walls as matter.

    They are its matter to `FAITHFUL`, in two boxes at least.
    """
    points = corners.reshape(-1, 3)
    if np.ptp(points[:, :2], axis=0).prod() < AREA_SMALL:
        return None
    directions = _directions(corners)
    wound = None if directions is None else oriented(corners)
    if directions is None or wound is None:
        return None
    drawn = volume(wound)
    thin = 0.0 < 2.0 * drawn < THICK_M * _areas(wound)[1].sum()
    if not thin or drawn > EMPTY_SHARE * _hull_volume(points):
        return None
    found = []
    for angle in directions:
        pieces, matter = _pieces_along(wound, angle, len(directions) > 1)
        if pieces is None:
            return None
        found.append(pieces)
    if len(found) == 1:
        drawn = matter  # bodies that overlap are not counted twice
    chosen = found[0] if len(found) == 1 else _chosen(found)
    imported = float((chosen.high - chosen.low).prod(axis=1).sum())
    if not 2 <= len(chosen.low) <= BOXES_MAX or abs(imported - drawn) > FAITHFUL * drawn:
        return None
    return [_box(*piece) for piece in zip(chosen.low, chosen.high, chosen.axis, strict=True)]


def _hull_volume(points: Floats) -> float:
    """Volume of the convex hull of ``points`` [n, 3], m3; 0 where they lie in a plane."""
    try:
        return float(ConvexHull(points).volume)
    except QhullError:
        return 0.0


def _areas(corners: Floats) -> tuple[Floats, Floats]:
    """Unit normals [t, 3] and areas [t] (m2) of triangles [t, 3, 3]."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(normal, axis=1)
    return normal / np.maximum(doubled, 1e-12)[:, None], 0.5 * doubled


def _directions(corners: Floats) -> list[float] | None:
    """Angles in rad, modulo a right angle, that upright faces run along, those with most area first.

    None where they are of too many directions: nothing with walls.
    """
    normal, area = _areas(corners)
    upright = (np.abs(normal[:, 2]) < UPRIGHT) & (area > 0.0)
    area, angle = area[upright], np.arctan2(normal[upright, 1], normal[upright, 0])
    edges = (np.roll(corners[upright], -1, axis=1) - corners[upright])[..., :2]
    length = np.linalg.norm(edges, axis=2).max(axis=1)
    found: list[float] = []
    left = np.ones(len(area), bool)
    while left.any() and len(found) < DIRECTIONS_MAX:
        largest = angle[left][np.argmax(area[left])]
        off = (angle - largest + 0.25 * np.pi) % (0.5 * np.pi) - 0.25 * np.pi
        own = left & (np.abs(np.sin(off)) * length < ALONG_M)
        weight = area[own] * length[own]
        found.append(float((largest + (off[own] * weight).sum() / weight.sum()) % (0.5 * np.pi)))
        left &= ~own
    return found if len(area) and area[left].sum() <= (1.0 - COVERED_MIN) * area.sum() else None


def _pieces_along(wound: Floats, angle: float, oblique: bool) -> tuple[_Pieces | None, float]:
    """The matter between lines along and across ``angle``, and its volume, m3.

    Where other walls are ``oblique``, only cells of plan that are matter throughout count. None where the surface is
    not closed, or has too many lines.
    """
    axis = np.array([np.cos(angle), np.sin(angle)])
    turned = wound.copy()
    turned[..., 0], turned[..., 1] = wound[..., :2] @ axis, wound[..., :2] @ np.array([-axis[1], axis[0]])
    normal, _ = _areas(turned)
    leaning = (np.abs(normal[:, 2]) >= UPRIGHT) & (np.ptp(turned[..., 2], axis=1) > MERGE_M)
    step = max(STEP_M, 2.0 * (float(np.ptp(turned[..., :2].reshape(-1, 2), axis=0).prod()) / CELLS_MAX) ** 0.5)
    lines = []
    for side in (0, 1):
        facing = np.abs(normal[:, side]) > FACING
        ends = turned[..., side].min(), turned[..., side].max()
        own = _merged(np.append(turned[facing, :, side].mean(axis=1), ends))
        rise = np.abs(normal[leaning, side]) * np.ptp(turned[leaning, :, side], axis=1)
        cut = oblique or bool((rise > MERGE_M).any())
        lines.append(_refined(own, step) if cut else own)
    if (len(lines[0]) - 1) * (len(lines[1]) - 1) > CELLS_MAX:
        return None, 0.0
    looks = [_looked_at(turned, lines, place) for place in (PLACES if oblique else PLACES[:1])]
    if any(look is None for look in looks):
        return None, 0.0
    columns, *others = (look for look in looks if look is not None)
    whole = np.ones(len(columns.line), bool)
    for other in others:
        whole &= _among(columns, other, step if leaning.any() else 0.0)
    cells = np.multiply.outer(np.diff(lines[0]), np.diff(lines[1])).ravel()
    matter = float((cells[columns.line] * (columns.high - columns.low)).sum())
    kept = Columns(columns.line[whole], columns.low[whole], columns.high[whole])
    return _rectangles(kept, lines, axis, RISE_M if leaning.any() else MERGE_M), matter


def _merged(values: Floats) -> Floats:
    """``values`` in ascending order, with the mean of those that lie within `MERGE_M` of the next."""
    ordered = np.sort(values)
    return np.array([part.mean() for part in np.split(ordered, np.flatnonzero(np.diff(ordered) > MERGE_M) + 1)])


def _refined(lines: Floats, step: float) -> Floats:
    """``lines`` with as many more between them as makes them at most ``step`` apart."""
    pairs = pairwise(lines)
    return np.append(
        np.concatenate([np.linspace(a, b, int(np.ceil((b - a) / step)), endpoint=False) for a, b in pairs]), lines[-1]
    )


def _looked_at(turned: Floats, lines: list[Floats], place: tuple[float, float]) -> Columns | None:
    """The matter at one place in each cell of plan."""
    x, y = (own[:-1] + share * np.diff(own) for own, share in zip(lines, place, strict=True))
    return columns_at(turned, x, y)


def _among(columns: Columns, other: Columns, margin: float) -> Mask:
    """Whether the middle of each piece of ``columns`` [n] lies in matter of ``other``, to ``margin`` m up or down."""
    if not len(other.line):
        return np.zeros(len(columns.line), bool)
    base, span = min(columns.low.min(), other.low.min()) - 1.0, 2.0 * max(columns.high.max(), other.high.max(), 1.0)
    span = float(span - base) + 2.0
    middle = 0.5 * (columns.low + columns.high)
    # Down each line in turn: the last piece that begins above the middle.
    begins = other.line * span - (other.high - base)
    at = np.searchsorted(begins, columns.line * span - (middle - margin - base), side="right") - 1
    found: Mask = (other.line[at] == columns.line) & (other.low[at] - margin <= middle) & (at >= 0)
    return found


def _rectangles(columns: Columns, lines: list[Floats], axis: Floats, rise: float) -> _Pieces:
    """``columns`` side by side whose heights agree to ``rise`` m as pieces."""
    shape = (len(lines[0]) - 1, len(lines[1]) - 1)
    middle, thick = 0.5 * (columns.low + columns.high), columns.high - columns.low
    both = np.stack([_grouped(middle, rise), _grouped(thick, rise)])
    _, kind = np.unique(both, axis=1, return_inverse=True)
    lows, highs = [], []
    for number in range(int(kind.max(initial=-1)) + 1):
        own = kind.ravel() == number
        mask = np.zeros(shape, bool)
        mask.ravel()[columns.line[own]] = True
        bottom, top = float(columns.low[own].mean()), float(columns.high[own].mean())
        for i0, i1, j0, j1 in _covering(mask, lines):
            lows.append((lines[0][i0], lines[1][j0], bottom))
            highs.append((lines[0][i1], lines[1][j1], top))
    return _Pieces(np.reshape(lows, (-1, 3)), np.reshape(highs, (-1, 3)), np.tile(axis, (len(lows), 1)))


def _grouped(values: Floats, span: float) -> Integers:
    """Numbers [n] of groups of ``values`` [n], each from its lowest to ``span`` above it."""
    order = np.argsort(values, kind="stable")
    number, group, lowest = np.zeros(len(values), np.int64), 0, np.inf
    for k in order:
        if values[k] > lowest + span:
            group, lowest = group + 1, values[k]
        lowest = min(lowest, values[k])
        number[k] = group
    return number


def _covering(mask: Mask, lines: list[Floats]) -> Iterator[tuple[int, int, int, int]]:
    """Rectangles (first and last line along and across) that make up ``mask`` [nx, ny], without overlaps.

    Each holds the first cell that is left, and is the larger of those grown along first and across first.
    """
    left = mask.copy()
    while left.any():
        i, j = (int(k) for k in np.unravel_index(np.argmax(left), left.shape))
        grown = [_grown(left, i, j), tuple(_grown(left.T, j, i)[k] for k in (2, 3, 0, 1))]
        best = max(grown, key=lambda r: (lines[0][r[1]] - lines[0][r[0]]) * (lines[1][r[3]] - lines[1][r[2]]))
        left[best[0] : best[1], best[2] : best[3]] = False
        yield best[0], best[1], best[2], best[3]


def _grown(left: Mask, i: int, j: int) -> tuple[int, int, int, int]:
    """The rectangle from cell ``i``, ``j`` that is as long as can be, then as wide."""
    end = i + int(np.argmin(np.append(left[i:, j], False)))
    full = left[i:end, j:].all(axis=0)
    return i, end, j, j + int(np.argmin(np.append(full, False)))


def _chosen(found: list[_Pieces]) -> _Pieces:
    """The pieces along several directions, the largest first, without those that are mostly in others."""
    low, high, axis = (np.concatenate([getattr(p, name) for p in found]) for name in ("low", "high", "axis"))
    shares = np.stack(np.meshgrid(*3 * [(np.arange(5) + 0.5) / 5], indexing="ij"), axis=-1).reshape(-1, 3)
    kept: list[int] = []
    for k in np.argsort(-(high - low).prod(axis=1), kind="stable")[: 4 * BOXES_MAX]:
        points = low[k] + shares * (high[k] - low[k])
        c, s = axis[k]
        points[:, :2] = points[:, :2] @ np.array([[c, s], [-s, c]])
        covered = np.zeros(len(points), bool)
        for other in kept:
            c, s = axis[other]
            own = np.column_stack([points[:, :2] @ np.array([[c, -s], [s, c]]), points[:, 2]])
            covered |= ((own > low[other]) & (own < high[other])).all(axis=1)
        if covered.mean() < 0.5:
            kept.append(int(k))
    return _Pieces(low[kept], high[kept], axis[kept])


def _box(low: Floats, high: Floats, axis: Floats) -> Box:
    """A piece as a box whose axis lies along its longer side."""
    c, s = axis
    x, y, z = 0.5 * (low + high)
    half = 0.5 * (high - low)
    centre = (float(c * x - s * y), float(s * x + c * y), float(z))
    along, across, up = (float(h) for h in half)
    if along >= across:
        return Box(centre, (along, across, up), (float(c), float(s)), 0.0)
    return Box(centre, (across, along, up), (float(-s), float(c)), 0.0)
