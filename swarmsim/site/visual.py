"""Visual mesh of a site: one coloured mesh, decimated to at most `TRIANGLES_MAX` triangles."""

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.site import SiteSpec
from swarmsim.site.mesh_parts import NO_COLOUR, Part
from swarmsim.site.model import VisualMesh
from swarmsim.site.raster import Floats, Integers

TRIANGLES_MAX = 30_000
GROUND_COLOUR = (126, 133, 104, 255)
OBSTACLE_COLOUR = (163, 158, 149, 255)  # of parts whose file gives none


def visual_mesh(parts: list[Part], is_ground: NDArray[np.bool_], spec: SiteSpec) -> VisualMesh:
    """The parts as one mesh; those without a colour get a default. ``is_ground`` [t] covers all their triangles."""
    corners = np.concatenate([part.corners for part in parts])
    colours = np.concatenate([part.colours for part in parts]).copy()
    bare = (colours == np.array(NO_COLOUR, np.uint8)).all(axis=1)
    colours[bare & is_ground] = GROUND_COLOUR
    colours[bare & ~is_ground] = OBSTACLE_COLOUR
    keep = np.ones(len(corners), bool)
    spacing = 0.05
    points = corners
    while keep.sum() > TRIANGLES_MAX:
        # Vertex clustering (Rossignac and Borrel, 1993): the vertices in one cube are replaced by their mean.
        points = _clustered(corners.reshape(-1, 3), spacing).reshape(-1, 3, 3)
        keep = _drawn(points)
        spacing *= 1.5
    return welded(points[keep], colours[keep])


def _clustered(points: Floats, spacing: float) -> Floats:
    _, cube = np.unique(np.floor(points / spacing), axis=0, return_inverse=True)
    cube = cube.reshape(-1)
    count = np.bincount(cube)[:, None]
    mean = np.stack([np.bincount(cube, points[:, i]) for i in range(3)], axis=-1) / count
    return mean[cube]


def _drawn(corners: Floats) -> NDArray[np.bool_]:
    """Mask [t] of the triangles with an area, without duplicates."""
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    order = np.sort(np.round(corners, 4).view([("", corners.dtype)] * 3).reshape(-1, 3), axis=1)
    _, first = np.unique(order.view(np.float64).reshape(len(corners), 9), axis=0, return_index=True)
    once = np.zeros(len(corners), bool)
    once[first] = True
    return once & (area > 1e-9)


def welded(corners: Floats, colours: NDArray[np.uint8]) -> VisualMesh:
    """Mesh of triangles [t, 3, 3] with colours [t, 4]; corners of equal position and colour share a vertex."""
    packed = colours.astype(np.int64) @ np.array([1 << 24, 1 << 16, 1 << 8, 1])
    keyed = np.column_stack([np.round(corners.reshape(-1, 3), 4), np.repeat(packed, 3)])
    unique, index = np.unique(keyed, axis=0, return_inverse=True)
    triangles: Integers = index.reshape(-1, 3)
    shades = unique[:, 3].astype(np.int64)
    vertex_colours = np.stack([(shades >> shift) & 255 for shift in (24, 16, 8, 0)], axis=-1).astype(np.uint8)
    return VisualMesh(unique[:, :3].astype(np.float32), triangles.astype(np.uint32), vertex_colours)
