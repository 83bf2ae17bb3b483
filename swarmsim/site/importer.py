"""Import of a source file and its specification as arrays: terrain, surface, obstacles, clearance, cost."""

from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from swarmsim.config.errors import InputError, Problem, raise_if_any
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.site import ObstacleMaterial, SiteSpec
from swarmsim.site import traversability
from swarmsim.site.elevation import elevation_ground, elevation_mesh, read_elevation
from swarmsim.site.ground import THICKNESS, Ground, complete_ground, found_ground, named_ground
from swarmsim.site.meshes import Part, read_mesh
from swarmsim.site.model import VisualMesh
from swarmsim.site.obstacles import Box, boxes_of, components
from swarmsim.site.raster import Floats, Grid, faces_on, top_of_cells
from swarmsim.site.source_files import TIFF_SUFFIXES, check_file
from swarmsim.site.step_edges import StepRasters, find_steps
from swarmsim.site.survey import survey_area
from swarmsim.site.visual import visual_mesh

Mask = NDArray[np.bool_]

CELLS_MAX = 4_000_000
AIR = "air"  # material of parts painted on others, such as windows, which get no box
BOXES_MAX = 1024  # the largest are kept: every ray is intersected with every box


@dataclass(frozen=True)
class RawSite:
    """Result of an import as plain arrays (double precision, materials by name); the content of the cache."""

    grid: Grid
    terrain: Floats  # [ny, nx] m
    surface: Floats  # [ny, nx] m
    clearance: Floats  # [ny, nx] m
    cost: Floats  # [ny, nx]
    steps: StepRasters | None
    boxes: list[Box]
    box_materials: list[str]
    survey_area: Floats  # [v, 2] m
    mesh: VisualMesh
    report: dict[str, Any] = field(default_factory=dict)


def build(path: Path, spec: SiteSpec) -> RawSite:
    """Import the source file ``path``; raises `InputError` when it cannot be read as a site."""
    check_file(path, spec.max_file_mb)
    return _from_elevation(path, spec) if path.suffix.lower() in TIFF_SUFFIXES else _from_mesh(path, spec)


def _from_mesh(path: Path, spec: SiteSpec) -> RawSite:
    parts = read_mesh(path, spec)
    _check_patterns(parts, spec, path)
    corners = np.concatenate([part.corners for part in parts])
    grid = _grid_of(corners, spec, path)
    is_ground, ground, surface = _separate(parts, corners, grid, spec, path)
    boxes, names, solid, passable = _obstacles(parts, is_ground, spec)
    stopping = [box for box, free in zip(boxes, passable, strict=True) if not free]
    clear = traversability.clearance(
        grid, ground.height, ground.outside, corners[solid], stopping, spec.zones, spec.traversability
    )
    carries = is_ground | solid
    steps = find_steps(grid, ground.height, clear, corners[carries], spec.traversability.step_max_m)
    kept = sorted(np.argsort([-box.volume for box in boxes], kind="stable")[:BOXES_MAX])
    report = {
        "parts": [
            {"names": list(part.names), "triangles": len(part.triangles), "is": _is(part, share, spec)}
            for part, share in zip(parts, _shares(parts, is_ground), strict=True)
        ],
        "boxes_left_out": len(boxes) - len(kept),
    }
    return _finish(
        grid, ground, surface, clear, steps, [boxes[i] for i in kept], [names[i] for i in kept],
        visual_mesh(parts, is_ground, spec), spec, report,
    )  # fmt: skip


def _from_elevation(path: Path, spec: SiteSpec) -> RawSite:
    model = read_elevation(path, spec)
    extent = model.grid.cell * np.array([model.grid.nx, model.grid.ny])
    nx, ny = (int(side) for side in np.floor(extent / spec.cell_m + 0.5))
    check_cells(nx, ny, spec, path)
    shift = 0.5 * (spec.cell_m - model.grid.cell)
    origin = (model.grid.origin[0] + shift, model.grid.origin[1] + shift)
    grid = model.grid if spec.cell_m == model.grid.cell else Grid(origin, spec.cell_m, ny, nx)
    ground = elevation_ground(model, grid, spec)
    nothing = np.empty((0, 3, 3))
    clear = traversability.clearance(grid, ground.height, ground.outside, nothing, [], spec.zones, spec.traversability)
    report = {"parts": [], "boxes_left_out": 0, "georeference": model.reference}
    return _finish(grid, ground, ground.height, clear, None, [], [], elevation_mesh(model, grid, ground), spec, report)


def _finish(
    grid: Grid, ground: Ground, surface: Floats, clear: Floats, steps: StepRasters | None,
    boxes: list[Box], names: list[str],
    mesh: VisualMesh, spec: SiteSpec, report: dict[str, Any],
) -> RawSite:  # fmt: skip
    rise = None if steps is None else steps.edge[..., 3]
    cost = traversability.cost(grid, ground.height, clear, spec.traversability, rise)
    inside = ~ground.outside
    slope = np.degrees(np.arctan(np.hypot(*np.gradient(ground.height, grid.cell))))
    report |= {
        "size_m": [grid.nx * grid.cell, grid.ny * grid.cell],
        "area_m2": float(inside.sum() * grid.cell**2),
        "relief_m": float(np.ptp(ground.height[inside])),
        "height_m": [float(ground.height[inside].min()), float(surface[inside].max())],
        "slope_max_deg": float(slope[inside].max()),
        "boxes": len(boxes),
        "triangles": len(mesh.triangles),
        "filled_cells": int(ground.filled.sum()),
        "outside_cells": int(ground.outside.sum()),
        "traversable_share": float(np.isfinite(cost)[inside].mean()),
        "warnings": [],
    }
    if ground.filled.any():
        report["warnings"].append(f"{ground.filled.sum()} cells are holes in the source, filled by interpolation")
    if report["boxes_left_out"]:
        report["warnings"].append(f"the {report['boxes_left_out']} smallest obstacles do not attenuate radiation")
    if not np.isfinite(cost).any():
        report["warnings"].append("no cell is traversable: a rover cannot drive here")
    area = survey_area(grid, inside, spec)
    return RawSite(grid, ground.height, surface, clear, cost, steps, boxes, names, area, mesh, report)


def _matches(part: Part, pattern: str) -> bool:
    return any(fnmatchcase(name.casefold(), pattern.casefold()) for name in part.names)


def _rule(part: Part, spec: SiteSpec) -> ObstacleMaterial:
    """The first rule of the specification that matches a part."""
    default = ObstacleMaterial(match="*", material=spec.default_material)
    return next((rule for rule in spec.obstacles if _matches(part, rule.match)), default)


def _check_patterns(parts: list[Part], spec: SiteSpec, path: Path) -> None:
    names = sorted({name for part in parts for name in part.names})
    shown = one_of(names[:40]) + (f" … ({len(names)} names)" if len(names) > 40 else "")
    given = [("ground", pattern) for pattern in spec.ground] + [("obstacles", rule.match) for rule in spec.obstacles]
    raise_if_any(
        [
            Problem(
                f"no mesh material or geometry matches '{pattern}' of '{key}'", file=str(path), path=key,
                given=pattern, allowed=shown, suggestion=did_you_mean(pattern, names),
            )
            for key, pattern in given
            if not any(_matches(part, pattern) for part in parts)
        ]
    )  # fmt: skip


def _grid_of(corners: Floats, spec: SiteSpec, path: Path) -> Grid:
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    east, north, up = high - low
    shape = f"{east:.4g} m east, {north:.4g} m north, {up:.4g} m up"
    if up > 2.0 * min(east, north):
        raise InputError.of(
            f"the site stands on its edge: {shape}", file=path, path="up_axis",
            suggestion="set up_axis to the axis that points up in the file (X, Y or Z)",
        )  # fmt: skip
    if not spec.extent_m[0] <= max(east, north) <= spec.extent_m[1]:
        small = max(east, north) < spec.extent_m[0]
        units = (
            "1.0 (metres) or 0.3048 (feet)" if small else "0.01 (centimetres), 0.0254 (inches) or 0.001 (millimetres)"
        )
        raise InputError.of(
            f"the site would be {'tiny' if small else 'huge'}: {shape}; the unit is probably wrong", file=path,
            path="unit_m", allowed=f"a longer side of {spec.extent_m[0]:g} to {spec.extent_m[1]:g} m (extent_m)",
            suggestion=f"set unit_m to the length of the file's unit in metres, e.g. {units}; "
            "or widen extent_m if the site really is that large",
        )  # fmt: skip
    nx, ny = (int(np.floor(side / spec.cell_m + 0.5 + 1e-6)) for side in (east, north))
    check_cells(nx, ny, spec, path)
    half = 0.5 * spec.cell_m
    return Grid((float(low[0]) + half, float(low[1]) + half), spec.cell_m, ny, nx)


def check_cells(nx: int, ny: int, spec: SiteSpec, path: Path) -> None:
    """Raise `InputError` for a grid of fewer than 3 x 3 or more than `CELLS_MAX` cells."""
    if min(nx, ny) < 3 or nx * ny > CELLS_MAX:
        raise InputError.of(
            f"cells of {spec.cell_m:g} m give a grid of {nx} x {ny}", file=path, path="cell_m",
            allowed=f"at least 3 x 3 and at most {CELLS_MAX:,} cells",
            suggestion="choose smaller cells" if min(nx, ny) < 3 else "choose larger cells",
        )  # fmt: skip


def _separate(
    parts: list[Part], corners: Floats, grid: Grid, spec: SiteSpec, path: Path
) -> tuple[Mask, Ground, Floats]:
    """Which triangles [t] are ground, the ground, and the surface [ny, nx]."""
    if spec.ground:
        named = [any(_matches(part, pattern) for pattern in spec.ground) for part in parts]
        is_ground = np.repeat(named, [len(part.triangles) for part in parts])
        seen = named_ground(grid, corners[is_ground])
    else:
        seen = found_ground(grid, corners)
        is_ground = _near_ground(grid, seen, corners)
    top = top_of_cells(grid, corners[~is_ground]) if not is_ground.all() else np.full(seen.shape, np.nan)
    try:
        ground = complete_ground(seen, np.isfinite(top), spec.holes_max)
    except InputError as error:
        raise InputError([Problem(**{**vars(problem), "file": str(path)}) for problem in error.problems]) from error
    # Dilated by one cell, so that the bilinear surface is nowhere below the true one.
    grown = ndimage.maximum_filter(np.where(np.isfinite(top), top, -np.inf), 3, mode="nearest")
    return is_ground, ground, np.maximum(ground.height, grown)


def _near_ground(grid: Grid, seen: Floats, corners: Floats) -> Mask:
    """Triangles [t] that are part of the ground ``seen`` [ny, nx]."""
    flat = seen.ravel()
    hits = faces_on(grid, corners)
    gap = np.abs(hits.height - flat[hits.cell])
    off = ~(gap <= THICKNESS)
    count = len(corners)
    touched = np.bincount(hits.triangle, minlength=count)
    away = np.bincount(hits.triangle, off, count)
    # On a slope, a corner may differ from the centre of its cell by half the rise over a cell.
    north, east = np.gradient(seen, grid.cell)
    allowance = THICKNESS + np.nan_to_num(np.hypot(north, east)).ravel() * grid.cell
    cell = grid.cell_of(corners[..., :2])
    near = np.abs(corners[..., 2] - flat[cell]) <= allowance[cell]
    return np.where(touched > 0, away <= 0.5 * touched, near.all(axis=1))


def _obstacles(parts: list[Part], is_ground: Mask, spec: SiteSpec) -> tuple[list[Box], list[str], Mask, list[bool]]:
    """Boxes, their materials, triangles [t] that stop a rover, and whether a rover can pass each box."""
    boxes: list[Box] = []
    names: list[str] = []
    passable: list[bool] = []
    stops = ~is_ground
    start = 0
    for part in parts:
        span = slice(start, start + len(part.triangles))
        start = span.stop
        rule = _rule(part, spec)
        stops[span] &= not rule.traversable
        own = part.triangles[~is_ground[span]] if rule.material != AIR else part.triangles[:0]
        for piece in components(part.vertices, own) if len(own) else ():
            found = boxes_of(part.vertices[own[piece]], rule.wall_m)
            boxes += found
            names += [rule.material] * len(found)
            passable += [rule.traversable] * len(found)
    return boxes, names, stops, passable


def _shares(parts: list[Part], is_ground: Mask) -> list[float]:
    edges = np.cumsum([len(part.triangles) for part in parts])[:-1]
    return [float(piece.mean()) for piece in np.split(is_ground, edges)]


def _is(part: Part, ground_share: float, spec: SiteSpec) -> str:
    return "ground" if ground_share > 0.5 else _rule(part, spec).material
