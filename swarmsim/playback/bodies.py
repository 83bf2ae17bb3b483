"""Simple solid bodies for the viewer: a multirotor of arms and rotor discs, a rover of a box and wheels."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from swarmsim.playback.colours import rgba
from swarmsim.results.record import Shape, VehicleRecord

# Sizes of a vehicle of which nothing but the kind is known: a small quadrotor, a small four-wheeled rover.
_GENERIC = {
    "multirotor": Shape(
        hubs_m=0.23 * np.array([[1, 1, 0.2], [-1, 1, 0.2], [-1, -1, 0.2], [1, -1, 0.2]]),
        radius_m=0.19,
        width_m=0.0,
        box_centre_m=np.zeros(3),
        box_size_m=np.array([0.26, 0.18, 0.1]),
    ),
    "skid_steer": Shape(
        hubs_m=np.array([[0.3, 0.3, 0.0], [0.3, -0.3, 0.0], [-0.3, 0.3, 0.0], [-0.3, -0.3, 0.0]]),
        radius_m=0.2,
        width_m=0.12,
        box_centre_m=np.array([0.0, 0.0, 0.12]),
        box_size_m=np.array([0.9, 0.45, 0.25]),
    ),
}
_DARK, _GREY, _LIGHT = (45, 45, 50, 255), (110, 110, 118, 255), (225, 225, 228, 255)


@dataclass(frozen=True)
class Mesh:
    """A coloured triangle mesh; normals make the viewer shade it."""

    vertices_m: NDArray[np.float32]  # [n, 3]
    triangles: NDArray[np.uint32]  # [t, 3]
    colours: NDArray[np.uint8]  # [n, 4] RGBA
    normals: NDArray[np.float32]  # [n, 3] unit


def shaded(
    vertices_m: NDArray[np.floating],
    triangles: NDArray[np.integer],
    colours: NDArray[np.uint8],
    crease_deg: float = 40.0,
) -> Mesh:
    """Add normals [n, 3] to a mesh: smooth over gentle bends, an edge where faces bend by more than ``crease_deg``.

    A vertex whose faces meet at such an edge is doubled, once for each face there.
    """
    corners = vertices_m[triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # [t, 3], twice the area long
    face = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-12)
    flat = triangles.reshape(-1)
    summed = [np.bincount(flat, np.repeat(area[:, k], 3), len(vertices_m)) for k in range(3)]
    smooth = np.stack(summed, -1)
    smooth = smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
    corner_face = np.repeat(face, 3, axis=0)
    sharp = np.flatnonzero((corner_face * smooth[flat]).sum(-1) < np.cos(np.radians(crease_deg)))
    indices = flat.astype(np.uint32)
    indices[sharp] = len(vertices_m) + np.arange(len(sharp))
    return Mesh(
        vertices_m=np.concatenate([vertices_m, vertices_m[flat[sharp]]]).astype(np.float32),
        triangles=indices.reshape(-1, 3),
        colours=np.concatenate([colours, colours[flat[sharp]]]),
        normals=np.concatenate([smooth, corner_face[sharp]]).astype(np.float32),
    )


_Part = tuple[NDArray[np.floating], NDArray[np.integer], tuple[int, ...]]  # vertices [n, 3], triangles [t, 3], RGBA

_BOX_CORNERS = np.array(
    [[x, y, z] for z in (-0.5, 0.5) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
)
_BOX_FACES = np.array(
    [0, 2, 1, 0, 3, 2, 4, 5, 6, 4, 6, 7, 0, 1, 5, 0, 5, 4, 1, 2, 6, 1, 6, 5, 2, 3, 7, 2, 7, 6, 3, 0, 4, 3, 4, 7]
).reshape(-1, 3)


def _box(centre: NDArray[np.floating], size: NDArray[np.floating], colour: tuple[int, ...]) -> _Part:
    return centre + _BOX_CORNERS * size, _BOX_FACES, colour


def _beam(start: NDArray[np.floating], end: NDArray[np.floating], thickness: float, colour: tuple[int, ...]) -> _Part:
    """A square bar from ``start`` to ``end``."""
    along = end - start
    length = float(np.linalg.norm(along))
    x = along / max(length, 1e-9)
    helper = np.array([0.0, 0.0, 1.0]) if abs(x[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    y = np.cross(helper, x) / np.linalg.norm(np.cross(helper, x))
    turn = np.stack([x, y, np.cross(x, y)])
    corners = (_BOX_CORNERS * [length, thickness, thickness]) @ turn
    return 0.5 * (start + end) + corners, _BOX_FACES, colour


def _cylinder(
    centre: NDArray[np.floating], axis: int, radius: float, length: float, colour: tuple[int, ...], sides: int = 20
) -> _Part:
    """A closed cylinder about the body axis ``axis`` (0 x, 1 y, 2 z)."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    first, second = [(1, 2), (2, 0), (0, 1)][axis]
    ring = np.zeros((sides, 3))
    ring[:, first], ring[:, second] = radius * np.cos(angle), radius * np.sin(angle)
    offset = np.zeros(3)
    offset[axis] = 0.5 * length
    vertices = np.concatenate([ring - offset, ring + offset, [-offset, offset]])
    k = np.arange(sides)
    n = (k + 1) % sides
    low, high = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    faces = [[k, n, n + sides], [k, n + sides, k + sides], [low, n, k], [high, k + sides, n + sides]]
    return centre + vertices, np.concatenate([np.stack(face, -1) for face in faces]), colour


def _merge(parts: list[_Part], scale: float) -> Mesh:
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in parts)])
    return shaded(
        scale * np.concatenate([vertices for vertices, _, _ in parts]),
        np.concatenate([faces + start for (_, faces, _), start in zip(parts, starts[:-1], strict=True)]),
        np.concatenate([np.tile(np.array(colour, np.uint8), (len(vertices), 1)) for vertices, _, colour in parts]),
    )


def _multirotor(shape: Shape, colour: tuple[int, ...]) -> list[_Part]:
    radius = shape.radius_m
    thickness = 0.12 * radius
    bottom = shape.box_centre_m[2] - 0.5 * shape.box_size_m[2]
    parts = [_box(shape.box_centre_m, shape.box_size_m, colour)]
    for hub in shape.hubs_m:
        forward = hub[0] > 1e-6  # The front pair of rotors is lighter, so that the heading can be seen.
        parts.append(_beam(np.array([0.0, 0.0, shape.box_centre_m[2]]), hub - [0, 0, 0.2 * radius], thickness, _DARK))
        parts.append(_cylinder(hub - [0.0, 0.0, 0.15 * radius], 2, 0.16 * radius, 0.3 * radius, _GREY))
        parts.append(_cylinder(hub, 2, radius, 0.06 * radius, _LIGHT if forward else colour, sides=28))
    for side in (-1.0, 1.0):
        foot = np.array([0.0, side * 0.75 * shape.box_size_m[1], bottom - 0.5 * radius])
        parts.append(_beam(np.array([0.0, side * 0.3 * shape.box_size_m[1], bottom]), foot, thickness, _DARK))
        reach = np.array([0.9 * radius, 0.0, 0.0])
        parts.append(_beam(foot - reach, foot + reach, thickness, _DARK))
    parts.append(_cylinder(np.array([0.0, 0.0, bottom - 0.2 * radius]), 2, 0.15 * radius, 0.4 * radius, _GREY))
    return parts


def _rover(shape: Shape, colour: tuple[int, ...]) -> list[_Part]:
    length, width, height = shape.box_size_m
    parts = [_box(shape.box_centre_m, shape.box_size_m, colour)]
    for hub in shape.hubs_m:
        parts.append(_cylinder(hub, 1, shape.radius_m, shape.width_m, _DARK, sides=24))
        parts.append(_cylinder(hub, 1, 0.45 * shape.radius_m, 1.08 * shape.width_m, _LIGHT, sides=16))

    def on_deck(x: float, z: float) -> NDArray[np.floating]:
        """A point ``x`` lengths ahead of the deck's centre and ``z`` heights above it."""
        return shape.box_centre_m + np.array([x * length, 0.0, (0.5 + z) * height])

    parts.append(_box(on_deck(-0.1, 0.15), np.array([0.5 * length, 0.7 * width, 0.3 * height]), _GREY))
    parts.append(_beam(on_deck(0.32, 0.0), on_deck(0.32, 1.2), 0.06 * width, _DARK))
    parts.append(_box(on_deck(0.34, 1.2), np.array([0.16 * length, 0.3 * width, 0.25 * height]), _LIGHT))
    return parts


def vehicle_mesh(vehicle: VehicleRecord, colour: str, scale: float = 1.0) -> Mesh:
    """Body of a vehicle in its own frame (FLU), ``scale`` times life size, painted in ``colour`` (hex).

    It grows from its feet or wheels upwards, so that an enlarged vehicle still stands on the ground.
    """
    shape = vehicle.shape or _GENERIC[vehicle.kind]
    build = _multirotor if vehicle.kind == "multirotor" else _rover
    mesh = _merge(build(shape, tuple(rgba(colour))), scale)
    lowest = float(mesh.vertices_m[:, 2].min()) / scale
    raised = mesh.vertices_m - np.array([0.0, 0.0, (scale - 1.0) * lowest], np.float32)
    return replace(mesh, vertices_m=raised)
