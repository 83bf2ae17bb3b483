"""Whether vehicles crossed walls, by the triangles of a mesh themselves and not by anything derived from them."""

import numpy as np

ROUND = ((1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0))


def crossed(start, end, triangles) -> np.ndarray:
    """Whether each segment from ``start`` to ``end`` [s, 3] crosses one of the ``triangles`` [t, 3, 3].

    Möller and Trumbore, "Fast, minimum storage ray/triangle intersection", J. Graphics Tools 2(1), 1997.
    """
    found = np.zeros(len(start), bool)
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    for i, (p, q) in enumerate(zip(start, end, strict=True)):
        near = triangles[((low <= np.maximum(p, q)) & (high >= np.minimum(p, q))).all(axis=1)]
        first, second, way = near[:, 1] - near[:, 0], near[:, 2] - near[:, 0], q - p
        across = np.cross(way, second)
        volume = (first * across).sum(axis=1)
        usable = np.abs(volume) > 1e-12
        volume = np.where(usable, volume, 1.0)
        offset = p - near[:, 0]
        u = (offset * across).sum(axis=1) / volume
        beside = np.cross(offset, first)
        v, t = (beside @ way) / volume, (second * beside).sum(axis=1) / volume
        found[i] = (usable & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)).any()
    return found


def outline_crossed(position, yaw, half, triangles, height) -> np.ndarray:
    """Whether the outline of a rover, ``half`` [2] long and wide, cuts a triangle at each pose [n, 3], [n].

    The outline is taken ``height`` m above the centre of mass.
    """
    cos, sin = np.cos(yaw), np.sin(yaw)
    corners = [
        position
        + np.stack([cos * x * half[0] - sin * y * half[1], sin * x * half[0] + cos * y * half[1], 0 * cos + height], 1)
        for x, y in ROUND
    ]
    return np.any([crossed(corners[k], corners[(k + 1) % 4], triangles) for k in range(4)], axis=0)
