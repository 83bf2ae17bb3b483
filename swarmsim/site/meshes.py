"""Mesh files (COLLADA, OBJ, glTF binary, STL) as named, coloured parts in metres, z up."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.errors import InputError
from swarmsim.config.site import SiteSpec

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

NO_COLOUR = (0, 0, 0, 0)  # a part without a colour in the file; `visual_mesh` assigns one

# Rows: east, north and up in the axes of a file. COLLADA 1.4.1 (<up_axis>): right, in, up are -Y, +Z, +X for X_UP;
# +X, +Z, +Y for Y_UP; +X, -Y, +Z for Z_UP; north is away from the viewer, against "in". glTF 2.0 is Y up.
_TO_ENU = {
    "X": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "Y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "Z": np.eye(3),
}


@dataclass(frozen=True)
class Part:
    """One geometry with one material: a piece of a scene."""

    names: tuple[str, ...]  # of the material, geometry and node, matched by the patterns of the specification
    vertices: Floats  # [n, 3] ENU, m
    triangles: Integers  # [t, 3]
    colours: Bytes  # [t, 4] RGBA; NO_COLOUR where the file has none

    @property
    def corners(self) -> Floats:
        """Corner points of the triangles [t, 3, 3]."""
        return self.vertices[self.triangles]


def read_mesh(path: Path, spec: SiteSpec) -> list[Part]:
    """The parts of a mesh file in metres, ENU.

    COLLADA and glTF state their unit and up axis; OBJ and STL do not, and are read as metres with z up. ``spec.unit_m``
    and ``spec.up_axis`` take precedence. Raises `InputError` when the file cannot be read or holds no triangles.
    """
    try:
        unit, up, parts = (_read_collada if path.suffix.lower() == ".dae" else _read_with_trimesh)(path)
    except InputError:
        raise
    except Exception as error:  # the readers pass on the exceptions of their XML, JSON and number parsers
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError.of(
            f"cannot be read as {path.suffix.lower()} ({reason})",
            file=path,
            suggestion="export it again from its program",
        ) from error
    parts = [part for part in parts if len(part.triangles)]
    if not parts:
        raise InputError.of("holds no triangles", file=path, suggestion="export the surfaces, not lines or points")
    if not all(_sound(part) for part in parts):
        raise InputError.of("has vertices that are not finite or triangles that name missing vertices", file=path)
    scale = (spec.unit_m or unit) * _TO_ENU[spec.up_axis or up]
    return [Part(part.names, part.vertices @ scale.T, part.triangles, part.colours) for part in parts]


def _sound(part: Part) -> bool:
    bounds = bool(part.triangles.min() >= 0 and part.triangles.max() < len(part.vertices))
    return bounds and bool(np.isfinite(part.vertices).all())


def _read_collada(path: Path) -> tuple[float, str, list[Part]]:
    import collada

    with warnings.catch_warnings():  # pycollada uses numpy.matrix and assigns array shapes
        warnings.filterwarnings("ignore", "Setting the shape", DeprecationWarning)
        warnings.simplefilter("ignore", PendingDeprecationWarning)
        ignored = [collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError]
        return _collada_scene(collada.Collada(str(path), ignore=ignored), path)


def _collada_scene(scene: Any, path: Path) -> tuple[float, str, list[Part]]:
    if scene.scene is None:
        raise InputError.of("has no <scene>", file=path, suggestion="export it again with its scene")
    parts = []
    for node in scene.scene.nodes:
        for name, geometry in _geometries(node, np.eye(4), ""):
            for primitive in geometry.primitives():
                triangles = primitive.triangleset() if hasattr(primitive, "triangleset") else primitive
                if triangles.vertex is not None and np.ndim(triangles.vertex_index) == 2:
                    parts.append(_collada_part(name, geometry.original, triangles))
    return float(scene.assetInfo.unitmeter or 1.0), str(scene.assetInfo.upaxis or "Y_UP")[0], parts


def _geometries(node: Any, matrix: Floats, name: str) -> Iterator[tuple[str, Any]]:
    """The geometries below a node, placed in the scene, each with the name of the nearest named node."""
    if not hasattr(node, "children"):
        for geometry in node.objects("geometry", matrix):
            yield name, geometry
        return
    own = node.xmlnode.get("name") or node.xmlnode.get("id") or name if node.xmlnode is not None else name
    for child in node.children:
        yield from _geometries(child, matrix @ node.matrix, own)


def _collada_part(node: str, geometry: Any, triangles: Any) -> Part:
    material = triangles.material
    names = [getattr(material, "name", None) or getattr(material, "id", None), geometry.name or geometry.id, node]
    index = np.asarray(triangles.vertex_index, np.int64)
    colours = np.empty((len(index), 4), np.uint8)
    colours[:] = _collada_colour(material)
    original: Any = getattr(triangles, "original", None)
    for offset, _, _, _, source, *_ in original.sources.get("COLOR", ()) if original is not None else ():
        data = np.asarray(source.data, np.float64)
        colours[:, : data.shape[1]] = _to_bytes(data[np.asarray(original.indices)[..., offset]].mean(axis=1))
    return Part(tuple(dict.fromkeys(n for n in names if n)), np.asarray(triangles.vertex, np.float64), index, colours)


def _collada_colour(material: Any) -> tuple[int, ...]:
    diffuse = getattr(getattr(material, "effect", None), "diffuse", None)
    if isinstance(diffuse, tuple | list) and len(diffuse) >= 3:
        red, green, blue = (int(v) for v in _to_bytes(np.array(diffuse[:3], np.float64)))
        return red, green, blue, 255
    return NO_COLOUR


def _to_bytes(unit: Floats) -> Bytes:
    return np.clip(np.round(unit * 255.0), 0, 255).astype(np.uint8)


def _read_with_trimesh(path: Path) -> tuple[float, str, list[Part]]:
    import trimesh

    suffix = path.suffix.lower()
    extra: dict[str, Any] = {"split_object": True, "group_material": True} if suffix == ".obj" else {}
    scene = trimesh.load_scene(str(path), process=False, **extra)
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh):
            material = getattr(getattr(mesh.visual, "material", None), "name", None)
            names = tuple(dict.fromkeys(str(n) for n in (material, name, node) if n))
            vertices = trimesh.transform_points(mesh.vertices, transform)
            parts.append(Part(names, vertices, np.asarray(mesh.faces, np.int64), _trimesh_colours(mesh)))
    # glTF 2.0 (3.4): metres, +Y up. OBJ and STL have neither unit nor axis.
    return 1.0, "Y" if suffix == ".glb" else "Z", parts


def _trimesh_colours(mesh: Any) -> Bytes:
    if mesh.visual.kind is None:
        return np.tile(np.array(NO_COLOUR, np.uint8), (len(mesh.faces), 1))
    colours = mesh.visual.to_color() if mesh.visual.kind == "texture" else mesh.visual
    if colours.kind == "vertex":
        return np.asarray(colours.vertex_colors)[mesh.faces].mean(axis=1).astype(np.uint8)
    return np.asarray(colours.face_colors, np.uint8)
