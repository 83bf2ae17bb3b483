"""What a glTF binary file says of itself, checked before it is read (glTF 2.0: the numbers below are its sections)."""

import json
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.site.mesh_parts import TRIANGLES_MAX

ZEROS_MAX = 1_000_000
"""Values of accessors without data, which stand for zeros: a few bytes of a file may ask for any number of them."""
SHARED_MAX = 20  # bytes that views and accessors name, over those of the file: they may name the same ones
PARTS_MAX = 20_000
"""Primitives, with every instance of each."""
DEPTH_MAX = 250  # of nodes within nodes: the reader goes all the way for each
_FAN = 6  # mode of a primitive (3.7.2.1)
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
AGAIN = "export it again from its program, without compression and with the shapes applied"


def check_glb(path: Path) -> None:
    """Raise `InputError` for a file that would be read wrongly, or that asks for more memory than it has content.

    A file whose header cannot be read is left to the reader.
    """
    header = _header(path)
    if header is None:
        return
    try:
        problem = next(_problems(header, path.stat().st_size), None)
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise InputError.of(
            f"cannot be read as .glb (its header is damaged: {type(error).__name__} {error})", file=path,
            suggestion="export it again from its program",
        ) from error  # fmt: skip
    if problem is not None:
        raise InputError.of(problem, file=path, suggestion=AGAIN)


def _header(path: Path) -> dict[str, Any] | None:
    with path.open("rb") as file:
        head = np.frombuffer(file.read(20)[:20].ljust(20, b"\0"), "<u4")
        size = int(head[3])
        if size > path.stat().st_size:
            return None
        try:
            header = json.loads(file.read(size))
        except (ValueError, RecursionError):
            return None
    return header if isinstance(header, dict) else None


def _problems(header: dict[str, Any], size: int) -> Iterator[str]:
    """What is wrong, each as the rest of a sentence about the file of ``size`` bytes."""
    needed = set(header.get("extensionsRequired", ()))
    compressed = {"EXT_meshopt_compression", *(() if find_spec("DracoPy") else ("KHR_draco_mesh_compression",))}
    for name in sorted(needed & compressed):
        yield f"is compressed ({name}), which cannot be read"
    if "EXT_mesh_gpu_instancing" in header.get("extensionsUsed", ()):
        yield "repeats its meshes by EXT_mesh_gpu_instancing, which cannot be read"
    if any("uri" in buffer and not buffer["uri"].startswith("data:") for buffer in header.get("buffers", ())):
        yield "keeps its shapes in other files, but must hold them itself"
    accessors, views = header.get("accessors", []), header.get("bufferViews", [])
    if header.get("meshes") and not (accessors and views):
        yield "has meshes without data"
    zeros = named = 0
    for accessor in accessors:
        values = int(accessor["count"]) * _COMPONENTS[accessor["type"]]
        if values < 0:
            yield "has an accessor of a negative count"
        if "bufferView" in accessor:
            named += values * _BYTES[accessor["componentType"]]
        else:
            zeros += values
    if zeros > ZEROS_MAX:
        yield f"has {zeros:,} values without data (accessors without a bufferView), more than {ZEROS_MAX:,}"
    named = max(named, sum(int(view["byteLength"]) for view in views))
    if named > SHARED_MAX * size:
        yield f"names {named:,} bytes of data, but has {size:,}"
    if _deeper(header.get("nodes", []), DEPTH_MAX):
        yield f"has nodes within nodes more than {DEPTH_MAX} deep"
    yield from _of_meshes(header, accessors)


def _of_meshes(header: dict[str, Any], accessors: list[dict[str, Any]]) -> Iterator[str]:
    """What is wrong with the meshes, and with the number of triangles with every instance of each."""
    meshes, corners = header.get("meshes", []), []
    for mesh in meshes:
        corners.append(0)
        for primitive in mesh["primitives"]:
            if primitive.get("mode") == _FAN:
                yield "has triangles as fans (mode 6), which cannot be read"
            used = [accessors[primitive["attributes"]["POSITION"]]]
            if used[0].get("normalized"):
                yield "has positions as fractions (normalized), which cannot be read"
            if "indices" in primitive:
                used.append(accessors[primitive["indices"]])
            if any("sparse" in accessor for accessor in used):
                yield "has sparse positions or indices, which cannot be read"
            corners[-1] += max(int(accessor["count"]) for accessor in used)
    shown = [node["mesh"] for node in header.get("nodes", ()) if "mesh" in node]
    triangles = max(sum(corners), sum(corners[number] for number in shown)) // 3
    if triangles > TRIANGLES_MAX:
        yield f"has {triangles:,} triangles, with every instance of each, more than {TRIANGLES_MAX:,}"
    pieces = [len(mesh["primitives"]) for mesh in meshes]
    parts = max(sum(pieces), sum(pieces[number] for number in shown))
    if parts > PARTS_MAX:
        yield f"has {parts:,} parts, with every instance of each, more than {PARTS_MAX:,}: join meshes"


def _deeper(nodes: list[dict[str, Any]], most: int) -> bool:
    """Whether nodes are nested deeper than ``most``, such as in a circle."""
    level = set(range(len(nodes)))
    for _ in range(most):
        level = {child for number in level for child in nodes[number].get("children", ())}
        if not level:
            return False
    return True
