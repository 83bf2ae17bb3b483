"""COLLADA files as parts, read in double precision: pycollada rounds to float32, half a metre at UTM coordinates."""

import itertools
import re
import warnings
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.site.mesh_parts import NO_COLOUR, TRIANGLES_MAX, Floats, Part, RawMesh, to_bytes
from swarmsim.site.polygons import Cutter

INSTANCES_MAX = 100_000  # nodes, with every instance of each


def read_collada(path: Path) -> RawMesh:
    """The triangles of a scene; lines beside them are left out."""
    import collada

    _check_text(path)
    with warnings.catch_warnings():  # pycollada uses numpy.matrix and assigns array shapes
        warnings.filterwarnings("ignore", "Setting the shape", DeprecationWarning)
        warnings.simplefilter("ignore", PendingDeprecationWarning)
        ignored = [collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError]
        return _scene(collada.Collada(str(path), ignore=ignored), path)


def _check_text(path: Path) -> None:
    """Raise `InputError` for what pycollada unpacks without a bound, or leaves out without a word."""
    content = path.read_bytes()
    problem = None
    if content[:2] == b"PK":
        problem, mended = "is a .zip archive", "unpack it"
    for found in re.finditer(rb"<(?:\w+:)?vcount\b[^>]*>([^<]*)<", content):
        corners = [int(count) for count in found[1].split()]
        if sum(corners) > len(content) or min(corners, default=0) < 0:
            problem, mended = f"has a <vcount> of {sum(corners):,} corners, but does not name them", "export it again"
    if re.search(rb"<(?:\w+:)?ph\b", content):
        problem, mended = "has polygons with holes (<ph>), which cannot be read", "triangulate its faces on export"
    if problem is not None:
        raise InputError.of(problem, file=path, suggestion=mended)


def _scene(scene: Any, path: Path) -> RawMesh:
    from collada.lineset import LineSet

    if scene.scene is None:
        raise InputError.of("has no <scene>", file=path, suggestion="export it again with its scene")
    parts, lines = [], 0
    points: dict[int, Floats] = {}
    cut: dict[int, Any] = {}
    cutter = Cutter()
    count = 0
    left = itertools.count(INSTANCES_MAX, -1)
    for node in scene.scene.nodes:
        for name, matrix, geometry in _geometries(node, np.eye(4), "", left, path):
            for primitive in geometry.original.primitives:
                if isinstance(primitive, LineSet):
                    lines += 1
                    continue
                if id(primitive) not in cut:  # instances share it
                    has_more = hasattr(primitive, "triangleset")
                    cut[id(primitive)] = _triangles(primitive, points, cutter) if has_more else primitive
                triangles = cut[id(primitive)]
                if triangles.vertex is not None and np.ndim(triangles.vertex_index) == 2:
                    bound = geometry.materialnodebysymbol.get(triangles.material)
                    material = None if bound is None else bound.target
                    source = triangles.sources["VERTEX"][0][4]
                    local = _source_points(source, points)
                    vertices = local @ matrix[:3, :3].T + matrix[:3, 3]
                    parts.append(_part(name, geometry.original, triangles, material, vertices))
                    count += len(triangles.vertex_index)
                    if count > TRIANGLES_MAX:  # `swarmsim.site.meshes` says so; instances multiply beyond all memory
                        return RawMesh(parts, 1.0, "Y", lines, cutter.crossed)
    return RawMesh(parts, *_unit_and_axis(scene.assetInfo.xmlnode), lines, cutter.crossed)


def _unit_and_axis(asset: Any) -> tuple[float, str]:
    """Metres of the file's unit (NaN: no number) and X, Y or Z, or what else stands there; pycollada skips bad ones."""
    said = {str(node.tag).rpartition("}")[2]: node for node in asset} if asset is not None else {}
    unit, axis = 1.0, "Y_UP"
    if "unit" in said:
        try:
            unit = float(said["unit"].get("meter", "1"))
        except ValueError:
            unit = np.nan
    if "up_axis" in said:
        axis = (said["up_axis"].text or "").strip().upper()
    return unit, axis[0] if axis in ("X_UP", "Y_UP", "Z_UP") else axis


def _triangles(primitive: Any, points: dict[int, Floats], cutter: Cutter) -> Any:
    """The polygons of a primitive as triangles; pycollada cuts each as a fan from its first corner."""
    from collada.triangleset import TriangleSet

    if primitive.vertex_index is None:
        return primitive.triangleset()
    local = _source_points(primitive.sources["VERTEX"][0][4], points)
    corners, _ = cutter.cut(local[primitive.vertex_index], np.asarray(primitive.vcounts, np.int64))
    return TriangleSet(primitive.sources, primitive.material, primitive.index[corners].ravel(), primitive.xmlnode)


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


def _source_points(source: Any, known: dict[int, Floats]) -> Floats:
    """Positions [n, 3] of a source, read anew from its text; ``known`` holds those of sources read before."""
    if id(source) not in known:
        arrays = [node for node in source.xmlnode if str(node.tag).endswith("float_array")]
        for node in source.xmlnode.iter():
            width = node.get("stride") if str(node.tag).endswith("}accessor") else None
            if width is not None and (int(width) != len(source.components) or int(node.get("offset", "0")) != 0):
                raise ValueError(f"<accessor> of {len(source.components)} values with stride {width} or an offset")
        points = np.asarray(source.data, np.float64)
        written = np.array((arrays[0].text or "").split(), np.float64) if arrays else points
        known[id(source)] = (written.reshape(points.shape) if written.size == points.size else points)[:, :3]
    return known[id(source)]


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
