"""Mesh files (COLLADA, OBJ, glTF binary, STL) as named, coloured parts in metres, z up."""

import io
import logging
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.config.site import SiteSpec
from swarmsim.site.collada_reader import read_collada
from swarmsim.site.glb_checks import check_glb
from swarmsim.site.mesh_parts import TRIANGLES_MAX, Floats, Part, RawMesh
from swarmsim.site.obj_reader import read_obj
from swarmsim.site.polygons import PolygonError
from swarmsim.site.trimesh_parts import parts_of

FAR_M = 10_000.0
"""Distance from the origin beyond which a mesh is moved to it: float32 resolves 1 mm there."""
FAR_UP_M = 1000.0
"""The same of heights: at 1000 m float32 resolves 0.06 mm, and what settles on the ground moves by less in a step."""
COORDINATE_MAX_M = 1e9
"""Largest coordinate in a file: that of a projection has 7 or 8 digits, and double precision resolves 0.1 um there."""
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
    shift_m: tuple[float, float, float]  # ENU of the site's origin in the file's coordinates
    warnings: list[str]  # what was left out, and what was assumed


def read_mesh(path: Path, spec: SiteSpec) -> Mesh:
    """The parts of a mesh file in metres, ENU, moved to the origin if it lies farther than `FAR_M` from it, and down if
    it lies higher or lower than `FAR_UP_M`.

    COLLADA and glTF state their unit and up axis; OBJ and STL do not, and are read as metres with z up. ``spec.unit_m``
    and ``spec.up_axis`` take precedence. Raises `InputError` when the file cannot be read or holds no triangles.
    """
    suffix = path.suffix.lower()
    reader: Callable[[Path], RawMesh] = {".dae": read_collada, ".obj": read_obj}.get(suffix, _read_with_trimesh)
    try:
        with _quiet():
            raw = reader(path)
    except InputError:
        raise
    except PolygonError as error:
        raise InputError.of(str(error), file=path, suggestion="triangulate its faces when you export it") from error
    except Exception as error:  # the readers pass on the exceptions of their XML, JSON and number parsers
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError.of(
            f"cannot be read as {suffix} ({reason})", file=path, suggestion="export it again from its program"
        ) from error
    parts = [part for part in raw.parts if len(part.triangles)]
    if sum(len(part.triangles) for part in parts) > TRIANGLES_MAX:
        raise InputError.of(
            "has too many triangles, with every instance of each mesh", file=path, allowed=f"at most {TRIANGLES_MAX:,}",
            suggestion="decimate the mesh (100,000 triangles are plenty for a site)",
        )  # fmt: skip
    if not parts:
        raise InputError.of("holds no triangles", file=path, suggestion="export the surfaces, not lines or points")
    if not all(_sound(part) for part in parts):
        raise InputError.of("has vertices that are not finite or triangles that name missing vertices", file=path)
    unit = spec.unit_m or raw.unit_m
    if unit is not None and not 0.0 < unit <= COORDINATE_MAX_M:
        raise InputError.of(
            f"states its unit of length as {unit:g} m", file=path, path="unit_m", allowed="a positive number of metres",
            suggestion="set unit_m to the length of its unit in metres (--unit 1 for metres)",
        )  # fmt: skip
    if spec.up_axis is None and raw.up_axis is not None and raw.up_axis not in _TO_ENU:
        raise InputError.of(
            f"states the axis that points up as '{raw.up_axis}'", file=path, path="up_axis",
            allowed="X_UP, Y_UP or Z_UP", suggestion="set up_axis to it (--up Z)",
        )  # fmt: skip
    scale = unit or 1.0
    _check_near(parts, scale, path)
    if raw.up_axis is None and spec.up_axis is None:
        _check_upright(parts, path)
    turn = scale * _TO_ENU[spec.up_axis or raw.up_axis or "Z"]
    turned = [replace(part, vertices=part.vertices @ turn.T) for part in parts]
    told = [f"{raw.lines} sets of lines or points are left out: only triangles are read"] if raw.lines else []
    if raw.crossed:
        told.append(
            f"faces that cross themselves: {raw.crossed}; parts of them may be left out or covered twice (triangulate "
            "the faces on export if so)"
        )
    shift, more = _far_off(parts, turned, scale, suffix, path)
    told += more
    if shift.any():
        turned = [replace(part, vertices=part.vertices - shift) for part in turned]
    if raw.unit_m is None and spec.unit_m is None:
        low, high = _bounds(turned)
        told.append(
            f"{suffix} files state no unit: taken as metres, {high[0] - low[0]:.4g} m by {high[1] - low[1]:.4g} m by "
            f"{high[2] - low[2]:.4g} m high; set unit_m (--unit) if that is wrong"
        )
    east, north, up = (float(value) for value in shift)
    return Mesh(turned, (east, north, up), told)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the warnings of numpy and of the readers, which would stand before the sentence that the user is told."""
    log = logging.getLogger("trimesh")
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(before)


def _sound(part: Part) -> bool:
    bounds = bool(part.triangles.min() >= 0 and part.triangles.max() < len(part.vertices))
    return bounds and bool(np.isfinite(part.vertices).all())


def _bounds(parts: list[Part]) -> tuple[Floats, Floats]:
    """Least and largest coordinates [3] of the corners that triangles use."""
    used = [part.vertices[np.unique(part.triangles)] for part in parts]
    return np.min([p.min(axis=0) for p in used], axis=0), np.max([p.max(axis=0) for p in used], axis=0)


def _check_near(parts: list[Part], scale: float, path: Path) -> None:
    """Raise `InputError` for coordinates larger than any on Earth, which double precision does not resolve."""
    largest = float(np.abs(_bounds(parts)).max()) * scale
    if largest > COORDINATE_MAX_M:
        raise InputError.of(
            f"its coordinates go up to {largest:.3g} m", file=path, path="unit_m",
            allowed=f"at most {COORDINATE_MAX_M:g} m",
            suggestion="move the scene to the origin in its program and export it again, or set unit_m (--unit) to the "
            "length of its unit in metres",
        )  # fmt: skip


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
    """What to take off the coordinates [3], ENU, of a mesh far from its origin, and what to say of it.

    Raises `InputError` when its coordinates have been rounded to more than `ROUNDING_MAX_M`.
    """
    low, high = _bounds(turned)
    reach = np.maximum(np.abs(low), np.abs(high))
    aside, aloft = bool(reach[:2].max() > FAR_M), bool(reach[2] > FAR_UP_M)
    if not aside and not aloft:
        return np.zeros(3), []
    with np.errstate(over="ignore"):
        single = all(np.array_equal(part.vertices, part.vertices.astype(np.float32)) for part in parts)
    largest = float(np.abs(_bounds(parts)).max())
    rounding = float(np.spacing(np.float32(largest))) * scale if single else 0.0
    if rounding > ROUNDING_MAX_M and suffix in (".glb", ".stl"):
        raise InputError.of(
            f"its coordinates, up to {largest * scale:,.0f} m, are stored in single precision, rounded to "
            f"{rounding:.2g} m",
            file=path,
            suggestion="move the scene to the origin in its program and export it again, or export it as .obj or .dae",
        )
    middle, lowest = np.round(0.5 * (low + high)), np.round(low[2])
    shift, told = np.zeros(3), []
    if aside:
        shift[:2] = middle[:2]
        told.append(
            f"moved to the origin: the site's origin is at {shift[0]:.0f} m east, {shift[1]:.0f} m north in the file"
        )
    if aloft:
        shift[2] = lowest
        told.append(
            f"moved down: a height of 0 m is {lowest:.0f} m in the file"
            if lowest > 0.0
            else f"moved up: a height of 0 m is {lowest:.0f} m in the file"
        )
    if rounding > 0.01:
        told.append(f"the coordinates are rounded to {rounding:.2g} m, since they are stored far from the origin")
    return shift, told


def _read_with_trimesh(path: Path) -> RawMesh:
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    if kind == "glb":
        check_glb(path)
    else:
        _check_whole(path)
    # glTF from memory: it may name other files, which are looked for beside a file with a name. STL gives its name to
    # what it holds.
    source = io.BytesIO(path.read_bytes()) if kind == "glb" else str(path)
    raw = parts_of(trimesh.load_scene(source, file_type=kind, process=False))
    # glTF 2.0 (3.4): metres, +Y up. STL has neither unit nor axis.
    return replace(raw, unit_m=1.0, up_axis="Y") if kind == "glb" else raw


def _check_whole(path: Path) -> None:
    """Raise `InputError` for an STL file that is cut short, of which trimesh reads what there is."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(84)
        file.seek(max(0, size - 1000))
        tail = file.read()
    count = int.from_bytes(head[80:84], "little")
    if size == 84 + 50 * count:
        return
    if head.lstrip()[:5].lower() != b"solid":
        problem = f"announces {count:,} triangles, which are {84 + 50 * count:,} bytes, but has {size:,}"
    elif not re.search(rb"endsolid[^\n]*\s*$", tail, re.IGNORECASE):
        problem = "does not end with endsolid"
    else:
        return
    raise InputError.of(f"{problem}: it is no STL, or cut short", file=path, suggestion="export or download it again")
