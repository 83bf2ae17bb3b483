"""COLLADA files as parts, read in double precision: pycollada rounds to float32, half a metre at UTM coordinates."""

import itertools
import warnings
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.site.mesh_parts import NO_COLOUR, Floats, Part, RawMesh, to_bytes

INSTANCES_MAX = 100_000  # nodes, with every instance of each


def read_collada(path: Path) -> RawMesh:
    """The triangles of a scene; lines beside them are left out."""
    import collada

    with warnings.catch_warnings():  # pycollada uses numpy.matrix and assigns array shapes
        warnings.filterwarnings("ignore", "Setting the shape", DeprecationWarning)
        warnings.simplefilter("ignore", PendingDeprecationWarning)
        ignored = [collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError]
        return _scene(collada.Collada(str(path), ignore=ignored), path)


def _scene(scene: Any, path: Path) -> RawMesh:
    from collada.lineset import LineSet

    if scene.scene is None:
        raise InputError.of("has no <scene>", file=path, suggestion="export it again with its scene")
    parts, lines = [], 0
    points: dict[int, Floats] = {}
    left = itertools.count(INSTANCES_MAX, -1)
    for node in scene.scene.nodes:
        for name, matrix, geometry in _geometries(node, np.eye(4), "", left, path):
            for primitive in geometry.original.primitives:
                if isinstance(primitive, LineSet):
                    lines += 1
                    continue
                triangles = primitive.triangleset() if hasattr(primitive, "triangleset") else primitive
                if triangles.vertex is not None and np.ndim(triangles.vertex_index) == 2:
                    bound = geometry.materialnodebysymbol.get(triangles.material)
                    material = None if bound is None else bound.target
                    source = triangles.sources["VERTEX"][0][4]
                    local = points.setdefault(id(source), _source_points(source))
                    vertices = local @ matrix[:3, :3].T + matrix[:3, 3]
                    parts.append(_part(name, geometry.original, triangles, material, vertices))
    unit, axis = float(scene.assetInfo.unitmeter or 1.0), str(scene.assetInfo.upaxis or "Y_UP")[0]
    return RawMesh(parts, unit, axis, lines)


def _geometries(
    node: Any, matrix: Floats, name: str, left: Iterator[int], path: Path
) -> Iterator[tuple[str, Floats, Any]]:  # fmt: skip
    """The geometries below a node with their matrices [4, 4], each with the name of the nearest named node.

    ``left`` counts down how many more nodes there may be: instances of instances multiply.
    """
    if next(left) <= 0:
        raise InputError.of(
            "has too many nodes, with every instance of each", file=path, allowed=f"at most {INSTANCES_MAX:,}",
            suggestion="join meshes and export it again",
        )  # fmt: skip
    if not hasattr(node, "children"):
        for geometry in node.objects("geometry", np.eye(4)):
            yield name, matrix, geometry
        return
    own = node.xmlnode.get("name") or node.xmlnode.get("id") or name if node.xmlnode is not None else name
    for transform in getattr(node, "node", node).transforms:  # an instance of a node has that node's transforms
        matrix = matrix @ _matrix(transform)
    for child in node.children:
        yield from _geometries(child, matrix, own, left, path)


def _matrix(transform: Any) -> Floats:
    """Matrix [4, 4] of a transform; a written matrix or translation is read anew, in double precision."""
    matrix = np.asarray(transform.matrix, np.float64).reshape(4, 4).copy()
    kind = str(getattr(transform.xmlnode, "tag", "")).rpartition("}")[2]
    if kind == "matrix":
        return np.array(transform.xmlnode.text.split(), np.float64).reshape(4, 4)
    if kind == "translate":
        matrix[:3, 3] = np.array(transform.xmlnode.text.split(), np.float64)
    return matrix


def _source_points(source: Any) -> Floats:
    """Positions [n, 3] of a source, read anew from its text."""
    arrays = [node for node in source.xmlnode if str(node.tag).endswith("float_array")]
    points = np.asarray(source.data, np.float64)
    written = np.array((arrays[0].text or "").split(), np.float64) if arrays else points
    return (written.reshape(points.shape) if written.size == points.size else points)[:, :3]


def _part(node: str, geometry: Any, triangles: Any, material: Any, vertices: Floats) -> Part:
    names = [getattr(material, "name", None) or getattr(material, "id", None), geometry.name or geometry.id, node]
    index = np.asarray(triangles.vertex_index, np.int64)
    diffuse = getattr(getattr(material, "effect", None), "diffuse", None)
    colours = np.empty((len(index), 4), np.uint8)
    colours[:] = _colour(diffuse)
    for offset, _, _, _, source, *_ in triangles.sources.get("COLOR", ()):
        data = np.asarray(source.data, np.float64)
        colours[:, : data.shape[1]] = to_bytes(data[np.asarray(triangles.indices)[..., offset]].mean(axis=1))
    image = getattr(getattr(getattr(diffuse, "sampler", None), "surface", None), "image", None)
    if image is not None and image.path:
        names.append(PurePath(str(image.path).replace("\\", "/")).stem)
    return Part(tuple(dict.fromkeys(n for n in names if n)), vertices, index, colours)


def _colour(diffuse: Any) -> tuple[int, ...]:
    if isinstance(diffuse, tuple | list) and len(diffuse) >= 3:
        red, green, blue = (int(v) for v in to_bytes(np.array(diffuse[:3], np.float64)))
        return red, green, blue, 255
    return NO_COLOUR
