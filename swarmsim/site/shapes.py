"""Triangles [t, 3, 3] of simple solids, seen counter-clockwise from outside; for sites drawn by a script."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Triangles = NDArray[np.float64]

_RECTANGLE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


def joined(pieces: Sequence[Triangles]) -> Triangles:
    """All triangles of several pieces."""
    return np.concatenate(list(pieces))


def placed(unit: Triangles, length: float, width: float, height: float) -> Triangles:
    """A unit shape stretched to size (m)."""
    return unit * np.array([length, width, height])


def _quad(a: Floats, b: Floats, c: Floats, d: Floats) -> Triangles:
    return np.array([[a, b, c], [a, c, d]])


def box() -> Triangles:
    """The unit box that stands on the origin: x and y from -1/2 to 1/2, z from 0 to 1."""
    return polygon_prism(_RECTANGLE, 0.0, 1.0)


def cylinder(radius: float, height: float, sides: int) -> Triangles:
    """A prism with a regular polygon for its base, standing on the origin."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    return polygon_prism(radius * np.column_stack([np.cos(angle), np.sin(angle)]), 0.0, height)


def polygon_prism(outline: Floats, low: float, high: float) -> Triangles:
    """A prism over a counter-clockwise, simple polygon [v, 2]; a sheet facing up when ``low`` equals ``high``."""
    cap = _ears(outline)
    top = np.concatenate([outline[cap], np.full((*cap.shape, 1), high)], axis=-1)
    if low == high:
        return top
    bottom = np.concatenate([outline[cap[:, ::-1]], np.full((*cap.shape, 1), low)], axis=-1)
    sides = [
        _quad(np.array([*a, low]), np.array([*b, low]), np.array([*b, high]), np.array([*a, high]))
        for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True)
    ]
    return joined([top, bottom, *sides])


def _ears(outline: Floats) -> NDArray[np.int64]:
    """Triangulation [v - 2, 3] of a simple polygon by cutting off ears (Meisters, 1975)."""

    def turn(a: Floats, b: Floats, c: Floats) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    left, found = list(range(len(outline))), []
    while len(left) > 3:
        for k in range(len(left)):
            i, j, m = left[k - 1], left[k], left[(k + 1) % len(left)]
            a, b, c = outline[i], outline[j], outline[m]
            others = [outline[n] for n in left if n not in (i, j, m)]
            if turn(a, b, c) > 0 and not any(
                turn(a, b, p) >= 0 and turn(b, c, p) >= 0 and turn(c, a, p) >= 0 for p in others
            ):
                found.append((i, j, m))
                del left[k]
                break
        else:
            raise ValueError("the outline is not a simple counter-clockwise polygon")
    return np.array([*found, left])


def sheet(length: float, width: float, height: float) -> Triangles:
    """A level rectangle at a height, facing up."""
    return placed(polygon_prism(_RECTANGLE, 1.0, 1.0), length, width, height)


def roof(length: float, width: float, eaves: float, ridge: float, overhang: float) -> Triangles:
    """A gable roof whose ridge runs along x, ``ridge`` m above the eaves, closed below."""
    x, y = 0.5 * length + overhang, 0.5 * width + overhang
    section = np.array([[-y, eaves], [y, eaves], [0.0, eaves + ridge]])
    west, east = (np.column_stack([np.full(3, side), section]) for side in (-x, x))
    faces = [_quad(west[i], west[j], east[j], east[i]) for i, j in ((0, 1), (1, 2), (2, 0))]
    return joined([*faces, east[None], west[None, ::-1]])


def gables(length: float, width: float, eaves: float, ridge: float) -> Triangles:
    """The two triangles of wall below the ends of a gable roof, a hand outside it."""
    x, y = 0.5 * length + 0.52, 0.5 * width
    end = np.array([[x, -y, eaves], [x, y, eaves], [x, 0.0, eaves + ridge - 0.25]])
    return np.stack([end, (end * [-1.0, 1.0, 1.0])[::-1]])


def face_panels(length: float, width: float, storeys: int) -> Triangles:
    """Windows of 1.4 x 1.3 m on the four walls of a box, every 3.2 m, in each storey; 3 cm before the wall."""
    panels = []
    pane = np.array([[-0.7, 0.0, 0.0], [0.7, 0.0, 0.0], [0.7, 0.0, 1.3], [-0.7, 0.0, 1.3]])
    for side, (span, off) in enumerate([(length, width), (width, length)] * 2):
        c, s = np.cos(0.5 * np.pi * side), np.sin(0.5 * np.pi * side)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        count = int((span - 1.0) / 3.2)
        for storey in range(storeys):
            for k in range(count):
                x = 3.2 * (k - 0.5 * (count - 1))
                if not (side == 0 and storey == 0 and abs(x) < 2.2):  # the door is there
                    panels.append(_quad(*((pane + np.array([x, -0.5 * off - 0.03, 1.1 + 3.1 * storey])) @ turn)))
    return joined(panels)


def ribbon(line: Floats, height: float, thickness: float) -> Triangles:
    """A wall along ``line`` [n, 3] at the ground, sunk 0.2 m into it; a single sheet when it has no thickness."""
    step = np.gradient(line[:, :2], axis=0)
    aside = np.column_stack([-step[:, 1], step[:, 0], np.zeros(len(line))])
    aside *= 0.5 * thickness / np.linalg.norm(aside, axis=1, keepdims=True)
    down, up = np.array([0.0, 0.0, -0.2]), np.array([0.0, 0.0, height])
    left, right = line + aside, line - aside
    if thickness == 0.0:
        rails = [line + down, line + up]
        pairs = [(0, 1)]
    else:
        rails = [right + down, right + up, left + up, left + down]
        pairs = [(0, 1), (1, 2), (2, 3), (3, 0)]
    sides = [
        _quad(rails[i][k], rails[i][k + 1], rails[j][k + 1], rails[j][k])
        for k in range(len(line) - 1)
        for i, j in pairs
    ]
    ends = [] if thickness == 0.0 else [_quad(*(r[0] for r in rails))[:, ::-1], _quad(*(r[-1] for r in rails))]
    return joined([*sides, *ends])


def crown(radius: float, half_height: float) -> Triangles:
    """A tree's crown: an icosahedron stretched upwards, about its middle."""
    golden = 0.5 * (1.0 + 5.0**0.5)
    signs = [(a, b) for a in (-1.0, 1.0) for b in (-golden, golden)]
    corners = np.array([p for a, b in signs for p in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))])
    near = np.isclose(np.linalg.norm(corners[:, None] - corners, axis=-1), 2.0)
    faces = [
        (i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[i, k]
    ]
    triangles = corners[np.array(faces)]
    inward = np.linalg.det(triangles) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return triangles / np.hypot(1.0, golden) * np.array([radius, radius, half_height])
