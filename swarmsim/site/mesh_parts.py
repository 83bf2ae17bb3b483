"""Parts of a mesh: what the readers of mesh files give."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

TRIANGLES_MAX = 5_000_000
"""Triangles of a scene, with every instance of each mesh: a file of 100 MB holds 2 million."""
NO_COLOUR = (0, 0, 0, 0)  # a part without a colour in the file; `visual_mesh` assigns one


@dataclass(frozen=True)
class Part:
    """One geometry with one material: a piece of a scene."""

    names: tuple[str, ...]  # of the material, geometry, node and texture, matched by the specification's patterns
    vertices: Floats  # [n, 3]; ENU, m once `swarmsim.site.meshes.read_mesh` has turned and scaled them
    triangles: Integers  # [t, 3]
    colours: Bytes  # [t, 4] RGBA; NO_COLOUR where the file has none

    @property
    def corners(self) -> Floats:
        """Corner points of the triangles [t, 3, 3]."""
        return self.vertices[self.triangles]


@dataclass(frozen=True)
class RawMesh:
    """A mesh file as it is written."""

    parts: list[Part]  # in the file's unit and axes
    unit_m: float | None  # not checked; None: the file does not say
    up_axis: str | None  # X, Y or Z, or what the file says instead; None: the file does not say
    lines: int  # sets of lines or points, which are left out
    crossed: int = 0  # faces that cross themselves, which triangles do not fill


def to_bytes(unit: Floats) -> Bytes:
    """Colour components of 0 to 1 as 0 to 255."""
    return np.clip(np.round(unit * 255.0), 0, 255).astype(np.uint8)
