"""Mesh files (COLLADA, OBJ, glTF binary, STL) as named, coloured parts in metres, z up."""

import io
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.config.site import SiteSpec
from swarmsim.site.collada_reader import read_collada
from swarmsim.site.mesh_parts import NO_COLOUR, Bytes, Floats, Part, RawMesh
from swarmsim.site.source_files import material_files

FAR_M = 10_000.0
"""Distance from the origin beyond which a mesh is moved to it: float32 resolves 1 mm there."""
ROUNDING_MAX_M = 0.1
"""Largest rounding of coordinates that a mesh may have from being stored far from its origin."""
FACING = 0.9  # cosine of 26 degrees: faces this close to an axis face along it
SIDEWAYS = 1.5  # more area by this factor facing along another axis than up: the site lies on its side

# Rows: east, north and up in the axes of a file. COLLADA 1.4.1 (<up_axis>): right, in, up are -Y, +Z, +X for X_UP;
# +X, +Z, +Y for Y_UP; +X, -Y, +Z for Z_UP; north is away from the viewer, against "in". glTF 2.0 is Y up.
_TO_ENU = {
    "X": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "Y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "Z": np.eye(3),
}


@dataclass(frozen=True)
class Mesh:
    """A mesh in metres, ENU, near its origin."""

    parts: list[Part]
    shift_m: tuple[float, float]  # east and north of the site's origin in the file's coordinates
    warnings: list[str]  # what was left out, and what was assumed


def read_mesh(path: Path, spec: SiteSpec) -> Mesh:
    """The parts of a mesh file in metres, ENU, moved to the origin if it lies farther than `FAR_M` from it.

    COLLADA and glTF state their unit and up axis; OBJ and STL do not, and are read as metres with z up. ``spec.unit_m``
    and ``spec.up_axis`` take precedence. Raises `InputError` when the file cannot be read or holds no triangles.
    """
    suffix = path.suffix.lower()
    reader: Callable[[Path], RawMesh] = {".dae": read_collada, ".obj": _read_obj}.get(suffix, _read_with_trimesh)
    try:
        raw = reader(path)
    except InputError:
        raise
    except Exception as error:  # the readers pass on the exceptions of their XML, JSON and number parsers
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError.of(
            f"cannot be read as {suffix} ({reason})", file=path, suggestion="export it again from its program"
        ) from error
    parts = [part for part in raw.parts if len(part.triangles)]
    if not parts:
        raise InputError.of("holds no triangles", file=path, suggestion="export the surfaces, not lines or points")
    if not all(_sound(part) for part in parts):
        raise InputError.of("has vertices that are not finite or triangles that name missing vertices", file=path)
    if raw.up_axis is None and spec.up_axis is None:
        _check_upright(parts, path)
    scale = spec.unit_m or raw.unit_m or 1.0
    turn = scale * _TO_ENU[spec.up_axis or raw.up_axis or "Z"]
    turned = [replace(part, vertices=part.vertices @ turn.T) for part in parts]
    told = [f"{raw.lines} sets of lines or points are left out: only triangles are read"] if raw.lines else []
    shift, more = _far_off(parts, turned, scale, suffix, path)
    told += more
    if shift.any():
        turned = [replace(part, vertices=part.vertices - [*shift, 0.0]) for part in turned]
    if raw.unit_m is None and spec.unit_m is None:
        low, high = _bounds(turned)
        told.append(
            f"{suffix} files state no unit: taken as metres, {high[0] - low[0]:.4g} m by {high[1] - low[1]:.4g} m by "
            f"{high[2] - low[2]:.4g} m high; set unit_m (--unit) if that is wrong"
        )
    return Mesh(turned, (float(shift[0]), float(shift[1])), told)


def _sound(part: Part) -> bool:
    bounds = bool(part.triangles.min() >= 0 and part.triangles.max() < len(part.vertices))
    return bounds and bool(np.isfinite(part.vertices).all())


def _bounds(parts: list[Part]) -> tuple[Floats, Floats]:
    """Least and largest coordinates [3] of the corners that triangles use."""
    used = [part.vertices[np.unique(part.triangles)] for part in parts]
    return np.min([p.min(axis=0) for p in used], axis=0), np.max([p.max(axis=0) for p in used], axis=0)


def _check_upright(parts: list[Part], path: Path) -> None:
    """Raise `InputError` for a file without an up axis whose surfaces say that it lies on its side."""
    low, high = _bounds(parts)
    size = high - low
    corners = np.concatenate([part.corners for part in parts])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    along = [float(area[np.abs(normal[:, k]) > FACING * area].sum()) for k in range(3)]
    best = int(np.argmax(along))
    flat = int(np.argmin(size))
    if best == 2 or flat != best or along[best] < SIDEWAYS * along[2]:
        return
    axis = "XYZ"[best]
    raise InputError.of(
        f"the site lies on its side, or stands on its edge: with z up it would be {size[2]:.4g} units high, and more "
        f"of its surface faces along {axis} than up",
        file=path,
        path="up_axis",
        suggestion=f"set up_axis to {axis} (--up {axis}); or to Z (--up Z) if it is right as it is",
    )


def _far_off(parts: list[Part], turned: list[Part], scale: float, suffix: str, path: Path) -> tuple[Floats, list[str]]:
    """What to take off the east and north coordinates [2] of a mesh far from its origin, and what to say of it.

    Raises `InputError` when its coordinates have been rounded to more than `ROUNDING_MAX_M`.
    """
    low, high = _bounds(turned)
    if max(np.abs(low[:2]).max(), np.abs(high[:2]).max()) <= FAR_M:
        return np.zeros(2), []
    single = all(np.array_equal(part.vertices, part.vertices.astype(np.float32)) for part in parts)
    largest = max(float(np.abs(part.vertices).max()) for part in parts)
    rounding = float(np.spacing(np.float32(largest))) * scale if single else 0.0
    if rounding > ROUNDING_MAX_M and suffix in (".glb", ".stl"):
        raise InputError.of(
            f"its coordinates, up to {largest * scale:,.0f} m, are stored in single precision, rounded to "
            f"{rounding:.2g} m",
            file=path,
            suggestion="move the scene to the origin in its program and export it again, or export it as .obj or .dae",
        )
    shift = np.round(0.5 * (low + high))[:2]
    told = [f"moved to the origin: the site's origin is at {shift[0]:.0f} m east, {shift[1]:.0f} m north in the file"]
    if rounding > 0.01:
        told.append(f"the coordinates are rounded to {rounding:.2g} m, since they are stored far from the origin")
    return shift, told


def _read_obj(path: Path) -> RawMesh:
    """An OBJ file, with the names of its materials and textures even where the files that describe them are missing."""
    import trimesh

    text = path.read_text(encoding="utf-8", errors="replace")
    described = "\n".join(file.read_text(encoding="utf-8", errors="replace") for file in material_files(path))
    used = set(re.findall(r"^usemtl[ \t]+(.*\S)", text, re.MULTILINE))
    bare = used - set(re.findall(r"^\s*newmtl[ \t]+(.*\S)", described, re.MULTILINE))
    table = described + "".join(f"\nnewmtl {name}" for name in sorted(bare))
    whole = io.StringIO(f"mtllib {_Materials.NAME}\n{text}" if used else text)
    scene = trimesh.load_scene(
        whole, file_type="obj", resolver=_Materials(path.parent, table), process=False, split_objects=True,
        group_material=True,
    )  # fmt: skip
    raw = _parts_of(scene)
    textures = _textures(described)

    def named(part: Part) -> Part:
        names = [*part.names, *(textures[name] for name in part.names if name in textures)]
        colours = np.full_like(part.colours, NO_COLOUR) if part.names[0] in bare else part.colours
        return replace(part, names=tuple(dict.fromkeys(names)), colours=colours)

    return replace(raw, parts=[named(part) for part in raw.parts])


class _Materials(dict[str, bytes]):
    """Where trimesh finds the files beside an OBJ file; the table of materials is given as text."""

    NAME = "materials-of-the-file.mtl"

    def __init__(self, folder: Path, table: str):
        super().__init__({self.NAME: table.encode()})
        self.folder = folder

    def __missing__(self, name: str) -> bytes:
        return (self.folder / name.replace("\\", "/")).read_bytes()

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


def _read_with_trimesh(path: Path) -> RawMesh:
    import trimesh

    raw = _parts_of(trimesh.load_scene(str(path), process=False))
    # glTF 2.0 (3.4): metres, +Y up. STL has neither unit nor axis.
    return replace(raw, unit_m=1.0, up_axis="Y") if path.suffix.lower() == ".glb" else raw


def _parts_of(scene: Any) -> RawMesh:
    """The triangles of a scene of trimesh; its file says no unit and no axis."""
    import trimesh

    parts, lines = [], 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh):
            lines += 1
            continue
        material = getattr(getattr(mesh.visual, "material", None), "name", None)
        names = tuple(dict.fromkeys(str(n) for n in (material, name, node) if n))
        vertices = trimesh.transform_points(np.asarray(mesh.vertices, np.float64), transform)
        parts.append(Part(names, vertices, np.asarray(mesh.faces, np.int64), _colours(mesh)))
    return RawMesh(parts, None, None, lines)


def _colours(mesh: Any) -> Bytes:
    visual = mesh.visual
    if visual.kind is None:
        return np.tile(np.array(NO_COLOUR, np.uint8), (len(mesh.faces), 1))
    if visual.kind == "texture":
        material = visual.material
        image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        if visual.uv is None or image is None or len(visual.uv) != len(mesh.vertices):
            return np.tile(np.asarray(material.main_color, np.uint8), (len(mesh.faces), 1))
        visual = visual.to_color()
    if visual.kind == "vertex":
        return np.asarray(visual.vertex_colors)[mesh.faces].mean(axis=1).astype(np.uint8)
    return np.asarray(visual.face_colors, np.uint8)
