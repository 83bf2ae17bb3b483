"""Solids as triangles [t, 3, 3] (m), counter-clockwise seen from outside, for the scripts that generate sites."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Triangles = NDArray[np.float64]
Parts = dict[tuple[str, str], Triangles]  # by (geometry, material)
GroundHeight = Callable[[Floats], Floats]  # xy [..., 2] -> height [...] (m)

_RECTANGLE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


def joined(pieces: Sequence[Triangles]) -> Triangles:
    """All triangles of several pieces."""
    return np.concatenate(list(pieces))


def merged(groups: Sequence[Mapping[tuple[str, str], Triangles]]) -> Parts:
    """The parts of several groups, in their order."""
    return {key: triangles for group in groups for key, triangles in group.items()}


def scaled(unit: Triangles, length: float, width: float, height: float) -> Triangles:
    """A unit shape scaled to its size (m)."""
    return unit * np.array([length, width, height])


def moved(triangles: Triangles, place: tuple[float, float, float], yaw_deg: float) -> Triangles:
    """``triangles`` rotated by ``yaw_deg`` about the vertical and then moved by ``place`` (m)."""
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return triangles @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + np.array(place)


def lowest_ground(
    height: GroundHeight, centre: tuple[float, float], length: float, width: float, yaw_deg: float
) -> float:
    """Lowest ground (m) below a rectangle, at its corners, edge midpoints and centre."""
    corners = scaled(np.array([[[i, j, 0.0] for i in (-0.5, 0, 0.5) for j in (-0.5, 0, 0.5)]]), length, width, 1.0)
    turned = moved(corners, (*centre, 0.0), yaw_deg)
    return float(height(turned[..., :2]).min())


def ground_cells(xy: Floats, height: GroundHeight, use: NDArray[np.str_]) -> Parts:
    """The ground on a quadrilateral grid ``xy`` [ny + 1, nx + 1, 2], by the ``use`` [ny, nx] of its cells."""
    points = np.concatenate([xy, height(xy)[..., None]], axis=-1)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    triangles = np.stack([a, b, c, a, c, d], axis=-2).reshape(*use.shape, 2, 3, 3)
    return {("ground", name): triangles[use == name].reshape(-1, 3, 3) for name in sorted(set(use.ravel().tolist()))}


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
    return scaled(polygon_prism(_RECTANGLE, 1.0, 1.0), length, width, height)


def roof(length: float, width: float, eaves: float, ridge: float, overhang: float) -> Triangles:
    """A gable roof whose ridge runs along x, ``ridge`` m above the eaves, closed below."""
    x, y = 0.5 * length + overhang, 0.5 * width + overhang
    section = np.array([[-y, eaves], [y, eaves], [0.0, eaves + ridge]])
    west, east = (np.column_stack([np.full(3, side), section]) for side in (-x, x))
    faces = [_quad(west[i], west[j], east[j], east[i]) for i, j in ((0, 1), (1, 2), (2, 0))]
    return joined([*faces, east[None], west[None, ::-1]])


def gables(length: float, width: float, eaves: float, ridge: float) -> Triangles:
    """The two triangles of wall below the ends of a gable roof, 2 cm outside it."""
    x, y = 0.5 * length + 0.52, 0.5 * width
    end = np.array([[x, -y, eaves], [x, y, eaves], [x, 0.0, eaves + ridge - 0.25]])
    return np.stack([end, (end * [-1.0, 1.0, 1.0])[::-1]])


def face_panels(length: float, width: float, storeys: int) -> Triangles:
    """Windows of 1.4 x 1.3 m on the four walls of a box, every 3.2 m, in each storey, 3 cm outside the wall."""
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
    """A wall along ``line`` [n, 3] at the ground, sunk 0.2 m into it; a sheet of one face when ``thickness`` is 0."""
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
    """The crown of a tree: an icosahedron scaled vertically, about its centre."""
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


def tree(height: float, yaw_deg: float, place: tuple[float, float, float]) -> tuple[Triangles, Triangles]:
    """Trunk and crown of a tree of ``height`` m that stands on ``place``."""
    leaves = crown(0.26 * height, 0.36 * height) + np.array([0.0, 0.0, 0.64 * height])
    return moved(cylinder(0.035 * height, 0.45 * height, 6), place, 0.0), moved(leaves, place, yaw_deg)


def building(
    name: str,
    size: tuple[float, float, float, float],
    place: tuple[float, float, float],
    yaw_deg: float,
    materials: tuple[str, str],
    windows: bool = True,
) -> Parts:
    """A building of ``size`` (length, width, height of the eaves, height of the ridge above them; 0 = flat roof).

    ``materials`` are those of the walls and of the roof. Its door is on the south side before ``yaw_deg`` applies.
    """
    length, width, eaves, ridge = size
    wall, cover = materials
    parts = {(name, wall): scaled(box(), length, width, eaves)}
    parts[f"{name}_roof", cover] = (
        roof(length, width, eaves, ridge, 0.5) if ridge else sheet(length, width, eaves + 0.03)
    )
    if ridge:
        parts[f"{name}_gables", wall] = gables(length, width, eaves, ridge)
    if windows:
        parts[f"{name}_windows", "window"] = face_panels(length, width, max(1, int(eaves // 3.2)))
    parts[f"{name}_door", "door"] = scaled(box(), 2.4, 0.06, 2.6) + np.array([0.0, -0.5 * width, 0.0])
    return {key: moved(triangles, place, yaw_deg) for key, triangles in parts.items()}
