"""Import of a source file and its specification as arrays: terrain, surface, obstacles, clearance, cost."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from swarmsim.config.errors import InputError, Problem
from swarmsim.config.site import Plane, SiteSpec
from swarmsim.site import traversability
from swarmsim.site.elevation import elevation_ground, elevation_mesh, read_elevation
from swarmsim.site.ground import THICKNESS, Ground, complete_ground, found_ground, named_ground
from swarmsim.site.mesh_parts import NO_COLOUR, Part
from swarmsim.site.meshes import Mesh, read_mesh
from swarmsim.site.model import VisualMesh
from swarmsim.site.obstacles import Box
from swarmsim.site.part_rules import (
    BOXES_MAX,
    check_patterns,
    described,
    find_obstacles,
    matches,
    unlike_told,
    unnamed_told,
)
from swarmsim.site.raster import Floats, Grid, faces_on, top_of_cells
from swarmsim.site.size_checks import check_cells, check_extent
from swarmsim.site.source_files import TIFF_SUFFIXES, check_file
from swarmsim.site.start_places import start_places
from swarmsim.site.step_edges import StepRasters, find_steps
from swarmsim.site.survey import check_zones, survey_area
from swarmsim.site.visual import visual_mesh

Mask = NDArray[np.bool_]

POINTS_MAX = 200_000_000
"""Points on the surfaces of a mesh that are looked at: a scene of this many takes half a minute."""
FLUSH_M = 0.02  # what rises no further above the ground does not stand on it
COARSE_M = 0.3  # cells of the raster of clearances that a user is told of
BARE_SHARE = 0.05  # of a site that is traversable: below it there is hardly any ground
GROUND_SHARE = 0.4  # of a model's extent that is ground, below which the user is asked whether it has one
FAR_BELOW_M = 100.0  # level ground this far below or above a model is not under it
PLANE = "level ground"  # name of the part that `SiteSpec.plane` adds


@dataclass(frozen=True)
class RawSite:
    """Result of an import as plain arrays (double precision, materials by name); the content of the cache."""

    grid: Grid
    terrain: Floats  # [ny, nx] m
    surface: Floats  # [ny, nx] m
    clearance: Floats  # [f ny, f nx] m
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


@dataclass(frozen=True)
class _Separated:
    """A mesh split into ground and what stands on it."""

    bare: Mask  # [t] triangles that are ground, or lie below it
    ground: Ground
    surface: Floats  # [ny, nx] m
    warnings: list[str]


def _from_mesh(path: Path, spec: SiteSpec) -> RawSite:
    if spec.orthophoto is not None:
        message = "is for elevation models: a mesh has colours of its own"
        raise InputError.of(message, path="orthophoto", given=spec.orthophoto, suggestion="leave it out")
    mesh = read_mesh(path, spec)
    parts = mesh.parts if spec.plane is None else [*mesh.parts, _plane(mesh, spec.plane, path)]
    check_patterns(parts, spec, path)
    corners = np.concatenate([part.corners for part in parts])
    grid = _grid_of(corners, spec, path)
    check_zones(grid, spec)
    _check_effort(corners, grid, path)
    found = _separate(parts, corners, grid, spec, path)
    ground = found.ground
    things = find_obstacles(parts, found.bare, spec)
    stopping = [box for box, free in zip(things.boxes, things.passable, strict=True) if not free]
    clear = traversability.clearance(
        grid, ground.height, ground.outside, corners[things.stops], stopping, spec.zones, spec.traversability
    )
    carries = found.bare | things.stops
    coarse = traversability.at_centres(clear, grid)
    steps = find_steps(grid, ground.height, coarse, corners[carries], spec.traversability.step_max_m)
    boxes = things.boxes
    kept = sorted(np.argsort([-box.volume for box in boxes], kind="stable")[:BOXES_MAX])
    told = described(parts, found.bare, spec)
    report = {
        "parts": told,
        "boxes_left_out": len(boxes) - len(kept),
        "shift_m": list(mesh.shift_m),
        "warnings": [*mesh.warnings, *found.warnings, *unnamed_told(told, spec), *unlike_told(things.unlike)],
    }
    return _finish(
        grid, ground, found.surface, clear, steps, [boxes[i] for i in kept], [things.materials[i] for i in kept],
        visual_mesh(parts, found.bare, spec), spec, report,
    )  # fmt: skip


def _plane(mesh: Mesh, plane: Plane, path: Path) -> Part:
    """Level ground under the parts and around them."""
    points = np.concatenate([part.vertices[np.unique(part.triangles)] for part in mesh.parts])
    low, high = points.min(axis=0), points.max(axis=0)
    height = plane.height_m - mesh.shift_m[2]
    if not low[2] - FAR_BELOW_M <= height <= high[2] + FAR_BELOW_M:
        low_m, high_m = (round(float(value) + mesh.shift_m[2], 1) for value in (low[2], high[2]))
        raise InputError.of(
            f"the level ground is far from the model, which reaches from {low_m:g} m to {high_m:g} m", file=path,
            path="plane.height_m", given=f"{plane.height_m:g} m",
            suggestion=f"set its height (--set plane.height_m={low_m:g})",
        )  # fmt: skip
    (west, south), (east, north) = low[:2] - plane.margin_m, high[:2] + plane.margin_m
    vertices = np.array([[x, y, height] for y in (south, north) for x in (west, east)])
    colours = np.tile(np.array(NO_COLOUR, np.uint8), (2, 1))
    return Part((PLANE,), vertices, np.array([[0, 1, 3], [0, 3, 2]]), colours)


def _from_elevation(path: Path, spec: SiteSpec) -> RawSite:
    model = read_elevation(path, spec)
    extent = model.grid.cell * np.array([model.grid.nx, model.grid.ny])
    nx, ny = (int(side) for side in np.floor(extent / spec.cell_m + 0.5))
    shift = 0.5 * (spec.cell_m - model.grid.cell)
    origin = (model.grid.origin[0] + shift, model.grid.origin[1] + shift)
    grid = model.grid if spec.cell_m == model.grid.cell else Grid(origin, spec.cell_m, ny, nx)
    check_zones(grid, spec)
    ground = elevation_ground(model, grid, spec)
    nothing = np.empty((0, 3, 3))
    clear = traversability.clearance(grid, ground.height, ground.outside, nothing, [], spec.zones, spec.traversability)
    report = {"parts": [], "boxes_left_out": 0, "georeference": model.reference, "warnings": list(model.warnings)}
    return _finish(grid, ground, ground.height, clear, None, [], [], elevation_mesh(model, grid, ground), spec, report)


def _finish(
    grid: Grid, ground: Ground, surface: Floats, clear: Floats, steps: StepRasters | None,
    boxes: list[Box], names: list[str],
    mesh: VisualMesh, spec: SiteSpec, report: dict[str, Any],
) -> RawSite:  # fmt: skip
    rise = None if steps is None else steps.edge[..., 3]
    coarse = traversability.at_centres(clear, grid)
    cost = traversability.cost(grid, ground.height, coarse, spec.traversability, rise)
    inside = ~ground.outside
    slope = np.degrees(np.arctan(np.hypot(*np.gradient(ground.height, grid.cell))))
    area = survey_area(grid, inside, spec)
    starts = start_places(grid, ground.height, surface, coarse, cost, area, boxes)
    (west, south), (east, north) = grid.bounds
    report |= {
        "size_m": [grid.nx * grid.cell, grid.ny * grid.cell],
        "bounds_m": [west, south, east, north],
        "survey_area_m": np.round(area, 2).tolist(),
        "start_places_m": starts,
        "area_m2": float(inside.sum() * grid.cell**2),
        "relief_m": float(np.ptp(ground.height[inside])),
        "height_m": [float(ground.height[inside].min()), float(surface[inside].max())],
        "slope_max_deg": float(slope[inside].max()),
        "boxes": len(boxes),
        "triangles": len(mesh.triangles),
        "filled_cells": int(ground.filled.sum()),
        "outside_cells": int(ground.outside.sum()),
        "traversable_share": float(np.isfinite(cost)[inside].mean()),
        "clearance_cell_m": grid.cell * grid.ny / len(clear),
    }
    report["warnings"] += _warnings(report, ground, inside)
    return RawSite(grid, ground.height, surface, clear, cost, steps, boxes, names, area, mesh, report)


def _warnings(report: dict[str, Any], ground: Ground, inside: Mask) -> list[str]:
    """What a user should know of a site."""
    found = []
    if ground.filled.any():
        share = 100.0 * ground.filled.sum() / inside.sum()
        found.append(
            f"{ground.filled.sum()} cells ({share:.1f} % of the ground) are holes in the source, "
            "filled by interpolation"
        )
    if report["boxes_left_out"]:
        found.append(f"the {report['boxes_left_out']} smallest obstacles do not attenuate radiation")
    if report["boxes"] and report["clearance_cell_m"] > COARSE_M:
        found.append(
            f"the site is large: obstacles are known to {report['clearance_cell_m']:.2g} m only, which closes narrow "
            "gaps to rovers"
        )
    if report["traversable_share"] == 0.0:
        found.append("no cell is traversable: a rover cannot drive here")
    elif not report["start_places_m"]:
        found.append("there is no free place to start: everywhere something stands near, or the ground is steep")
    if report["traversable_share"] < BARE_SHARE and report["parts"]:
        found.append(
            "hardly any of it is open ground: if the model is a building without its surroundings, plane (--plane 20) "
            "lays level ground 20 m around it"
        )
    elif inside.mean() < GROUND_SHARE and report["parts"]:
        found.append(
            f"there is ground under {inside.mean():.0%} of the model's extent only, and what lies beside it is outside "
            "the site: if nothing in the model is ground, plane (--plane 20) lays level ground under and around it"
        )
    return found


def _grid_of(corners: Floats, spec: SiteSpec, path: Path) -> Grid:
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    east, north, up = high - low
    shape = f"{east:.4g} m east, {north:.4g} m north, {up:.4g} m up"
    if up > 2.0 * min(east, north):
        raise InputError.of(
            f"the site stands on its edge: {shape}", file=path, path="up_axis",
            suggestion="set up_axis (--up) to the axis that points up in the file, X, Y or Z; or, if it is a tower "
            "without its surroundings, lay level ground around it with plane (--plane 20)",
        )  # fmt: skip
    check_extent((float(east), float(north)), float(up), path)
    if not spec.extent_m[0] <= max(east, north) <= spec.extent_m[1]:
        small = max(east, north) < spec.extent_m[0]
        units = (
            "1.0 (metres) or 0.3048 (feet)" if small else "0.01 (centimetres), 0.0254 (inches) or 0.001 (millimetres)"
        )
        raise InputError.of(
            f"the site would be {'tiny' if small else 'huge'}: {shape}; the unit is probably wrong", file=path,
            path="unit_m", allowed=f"a longer side of {spec.extent_m[0]:g} to {spec.extent_m[1]:g} m (extent_m)",
            suggestion=f"set unit_m (--unit) to the length of the file's unit in metres, e.g. {units}; or, if the site "
            f"really is that {'small' if small else 'large'}, widen extent_m (--set 'extent_m=[1, 5000]')"
            + ("; plane (--plane 20) lays level ground around a single building" if small else ""),
        )  # fmt: skip
    nx, ny = (int(np.floor(side / spec.cell_m + 0.5 + 1e-6)) for side in (east, north))
    check_cells(nx, ny, spec, path)
    half = 0.5 * spec.cell_m
    return Grid((float(low[0]) + half, float(low[1]) + half), spec.cell_m, ny, nx)


def _check_effort(corners: Floats, grid: Grid, path: Path) -> None:
    """Raise `InputError` for triangles [t, 3, 3] that take more than `POINTS_MAX` points at the finest spacing."""
    sides = corners[:, 1:] - corners[:, :1]
    area = 0.5 * float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum())
    length = float(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1).sum())
    spacing = 0.5 * grid.cell / traversability.fine_factor(grid)
    if area / spacing**2 + length / spacing > POINTS_MAX:
        layers = area / (grid.nx * grid.ny * grid.cell**2)
        raise InputError.of(
            f"the surfaces of its {len(corners):,} triangles are {layers:,.0f} times as large as the site", file=path,
            suggestion="remove copies of meshes and what is hidden inside others, decimate the mesh, or choose larger "
            "cells: cell_m (--cell)",
        )  # fmt: skip


def _separate(parts: list[Part], corners: Floats, grid: Grid, spec: SiteSpec, path: Path) -> _Separated:
    """Ground and surface of a mesh with triangles ``corners`` [t, 3, 3]."""
    told: list[str] = []
    if spec.ground or spec.plane is not None:
        patterns = [*spec.ground, *([] if spec.plane is None else [PLANE])]
        named = [any(matches(part, pattern) for pattern in patterns) for part in parts]
        is_ground = np.repeat(named, [len(part.triangles) for part in parts])
        seen = named_ground(grid, corners[is_ground])
        bare = is_ground | (_near_ground(grid, seen, corners) if spec.plane is not None else False)
    else:
        seen, underlaid = found_ground(grid, corners)
        if underlaid:
            told.append(
                f"below {100 * underlaid:.0f} % of the ground lies another surface, taken as a slab under the scene "
                "and left out; if it is the ground, name its material or geometry: ground (--ground NAME)"
            )
        bare = _near_ground(grid, seen, corners)
    top = top_of_cells(grid, corners[~bare]) if not bare.all() else np.full(seen.shape, np.nan)
    try:
        ground = complete_ground(seen, np.isfinite(top), spec.holes_max)
    except InputError as error:
        raise InputError([Problem(**{**vars(problem), "file": str(path)}) for problem in error.problems]) from error
    bare |= _buried(grid, ground.height, corners)
    # Dilated by one cell, so that the bilinear surface is nowhere below the true one.
    grown = ndimage.maximum_filter(np.where(np.isfinite(top), top, -np.inf), 3, mode="nearest")
    return _Separated(bare, ground, np.maximum(ground.height, grown), told)


def _buried(grid: Grid, ground: Floats, corners: Floats) -> Mask:
    """Triangles [t] that lie wholly below the ``ground`` [ny, nx] or flush with it, such as slabs and foundations."""
    lowest_near = ndimage.minimum_filter(ground, 3, mode="nearest").ravel()
    below = (corners[..., 2] < lowest_near[grid.cell_of(corners[..., :2])] + FLUSH_M).all(axis=1)
    hits = faces_on(grid, corners[below])
    above = hits.height > ground.ravel()[hits.cell] + FLUSH_M
    index = np.flatnonzero(below)
    below[index[np.unique(hits.triangle[above])]] = False
    return below


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
