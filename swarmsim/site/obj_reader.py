"""OBJ files as parts: faces of any number of corners, and the names of materials and textures."""

import io
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.site.mesh_parts import NO_COLOUR, Floats, Part, RawMesh
from swarmsim.site.polygons import Cutter
from swarmsim.site.source_files import material_files
from swarmsim.site.trimesh_parts import parts_of


def read_obj(path: Path) -> RawMesh:
    """An OBJ file, with the names of its materials and textures even where the files that describe them are missing."""
    import trimesh

    cutter = Cutter()
    text = _plain(path.read_text(encoding="utf-8", errors="replace"), path, cutter)
    described = "\n".join(file.read_text(encoding="utf-8", errors="replace") for file in material_files(path))
    used = set(re.findall(r"^usemtl[ \t]+(.*\S)", text, re.MULTILINE))
    bare = used - set(re.findall(r"^\s*newmtl[ \t]+(.*\S)", described, re.MULTILINE))
    table = described + "".join(f"\nnewmtl {name}" for name in sorted(bare))
    whole = io.StringIO(f"mtllib {_Materials.NAME}\n{text}" if used else text)
    scene = trimesh.load_scene(
        whole, file_type="obj", resolver=_Materials(path.parent, table), process=False, split_objects=True,
        group_material=True,
    )  # fmt: skip
    raw = parts_of(scene)
    textures = _textures(described)

    def named(part: Part) -> Part:
        names = [*part.names, *(textures[name] for name in part.names if name in textures)]
        colours = np.full_like(part.colours, NO_COLOUR) if part.names[0] in bare else part.colours
        return replace(part, names=tuple(dict.fromkeys(names)), colours=colours)

    return replace(raw, parts=[named(part) for part in raw.parts], crossed=cutter.crossed)


def _plain(text: str, path: Path, cutter: Cutter) -> str:
    """The text of an OBJ file with triangles in place of all faces, named by numbers that count from the first vertex.

    trimesh cuts every face as a fan from its first corner, counts negative numbers from the end of the file and takes
    0 for 1. Raises `InputError` for faces that name no vertex.
    """
    lines = [line.strip() for line in text.replace("\\\n", " ").replace("\t", " ").split("\n")]
    counts = {"v": 0, "vt": 0, "vn": 0}
    places: list[str] = []
    polygons: list[int] = []  # numbers of lines
    corners_of: list[list[str]] = []
    named: list[int] = []
    largest, worst = 0, 0
    for number, line in enumerate(lines):
        kind, _, rest = line.partition(" ")
        if kind in counts:
            counts[kind] += 1
            if kind == "v":
                places.append(rest)
                lines[number] = line.partition("#")[0]
        elif kind == "f":
            corners = rest.partition("#")[0].split()
            try:
                if "-" in rest:
                    corners = [_counted(corner, counts) for corner in corners]
                own = [int(corner.partition("/")[0]) for corner in corners]
            except ValueError as error:
                raise _face_error(path, number, "names its corners by something else than whole numbers") from error
            if len(corners) < 3 or min(own) < 1:
                what = "names a vertex before the first" if len(corners) >= 3 else "has fewer than three corners"
                raise _face_error(path, number, what)
            if max(own) > largest:
                largest, worst = max(own), number
            if len(corners) > 3:
                polygons.append(number)
                corners_of.append(corners)
                named += own
            lines[number] = "f " + " ".join(corners)
    if largest > len(places):
        raise _face_error(path, worst, f"names vertex {largest:,}, but there are {len(places):,}")
    if polygons:
        vertices = np.array([place.split()[:3] for place in places], np.float64)
        for number, cut in zip(polygons, _cut(vertices[np.array(named) - 1], corners_of, cutter), strict=True):
            lines[number] = cut
    return "\n".join(lines)


def _face_error(path: Path, line: int, what: str) -> InputError:
    return InputError.of(f"a face {what}", file=path, line=line + 1, suggestion="export it again from its program")


def _counted(corner: str, counts: dict[str, int]) -> str:
    """A corner ``v/vt/vn`` whose negative numbers count back from the last vertex above it, by positive ones."""
    numbers = zip(corner.split("/"), counts.values(), strict=False)
    return "/".join(str(int(n) + 1 + count) if n.startswith("-") else n for n, count in numbers)


def _cut(points: Floats, corners: list[list[str]], cutter: Cutter) -> Iterator[str]:
    """The lines with triangles for each of several faces with these ``corners``, which lie at ``points`` [c, 3]."""
    counts = np.array([len(own) for own in corners])
    triangles, polygon = cutter.cut(points, counts)
    within = (triangles - (np.cumsum(counts) - counts)[polygon][:, None]).tolist()
    ends = np.cumsum(np.bincount(polygon, minlength=len(corners))).tolist()
    start = 0
    for own, end in zip(corners, ends, strict=True):
        yield "\n".join(f"f {own[a]} {own[b]} {own[c]}" for a, b, c in within[start:end])
        start = end


class _Materials(dict[str, bytes]):
    """Where trimesh finds the files beside an OBJ file; the table of materials is given as text."""

    NAME = "materials-of-the-file.mtl"

    def __init__(self, folder: Path, table: str):
        super().__init__({self.NAME: table.encode()})
        self.folder = folder

    def __missing__(self, name: str) -> bytes:
        path = self.folder / name.replace("\\", "/")
        if not os.path.isfile(path):  # a pipe would be waited for
            raise FileNotFoundError(path)
        return path.read_bytes()

    def get(self, name: str, default: Any = None) -> Any:
        """The file's content; raises `OSError` where it is missing, as trimesh expects."""
        return self[name]


def _textures(table: str) -> dict[str, str]:
    """Name of the texture of each material of an MTL file."""
    found: dict[str, str] = {}
    material = ""
    for line in table.splitlines():
        key, _, value = line.strip().partition(" ")
        if key.lower() == "newmtl":
            material = value.strip()
        elif key.lower() == "map_kd" and value.strip():
            found[material] = PurePath(value.strip().replace("\\", "/")).stem
    return found
