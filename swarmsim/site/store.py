"""Sites on disk: loading a site by its name, the cache of import results, and importing a user's file as a site."""

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from swarmsim.atomic_folder import atomic_folder
from swarmsim.config.documents import dump_yaml, shown_path
from swarmsim.config.errors import InputError, Problem, file_errors_told
from swarmsim.config.files import available, find
from swarmsim.config.load import load_all, load_model, load_named
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.site import SiteSpec
from swarmsim.pytree import on_device
from swarmsim.site.material_guesses import Guess, guesses
from swarmsim.site.model import Obstacles, Site, SiteModel, Steps, VisualMesh, walls_among
from swarmsim.site.source_files import MAX_FILE_MB, MESH_SUFFIXES, check_file, material_files
from swarmsim.site.terrain_crossing import ceilings

Arrays = dict[str, np.ndarray]

UNKNOWN_WALL_M = 0.2
"""Thickness of the shells of obstacles of which nothing is known, in the specification of an imported mesh."""


@dataclass(frozen=True)
class ImportOptions:
    """Options of `import_site`: the fields of `SiteSpec` other than its file, and what to write."""

    name: str | None = None  # of the site; the output folder's by default
    licence: str = "not stated"
    cell_m: float | None = None  # 0.5 m for a mesh, the file's own for an elevation model
    fields: dict[str, Any] | None = None  # further fields of SiteSpec, e.g. {"unit_m": 0.01, "ground": ["Ground*"]}
    overwrite: bool = False
    preview: bool = True  # write preview.png
    guess: bool = True  # write rules for what the names of the mesh say of its materials


def load_site(
    name_or_path: str | Path, material_names: Sequence[str], densities_kg_m3: Sequence[float] | None = None
) -> SiteModel:
    """The site of that name in ``configs/sites``, or of that folder or ``site.yaml``.

    ``material_names`` is the order of the materials table, to which the obstacles' indices refer, and
    ``densities_kg_m3`` their bulk densities, for ``Site.wall_kg_m3``. The source file named in the specification is
    imported, and the result is cached in the user's cache folder under a hash of the file, the specification and the
    importer's code; a damaged entry is rebuilt. Raises `InputError` for a site that cannot be loaded.
    """
    path = find("sites", name_or_path)
    spec: SiteSpec = load_named("sites", path)
    _check_materials(spec, material_names, path)
    return _model(spec, _arrays(spec, path), material_names, densities_kg_m3)


def _check_materials(spec: SiteSpec, known: Sequence[str], path: Path) -> None:
    used = {
        "ground_material": spec.ground_material,
        "default_material": spec.default_material,
        **{f"obstacles.{i}.material": rule.material for i, rule in enumerate(spec.obstacles)},
    }
    problems = [
        Problem(
            "there is no such material", file=str(path), path=place, given=name, allowed=one_of(known),
            suggestion=did_you_mean(name, known),
        )
        for place, name in used.items()
        if name not in known
    ]  # fmt: skip
    if problems:
        raise InputError(problems)


def cache_folder() -> Path:
    """Cache folder of imported sites: ``$XDG_CACHE_HOME/swarmsim/sites``, or the platform's equivalent."""
    return Path(platformdirs.user_cache_dir("swarmsim", appauthor=False)) / "sites"


def _arrays(spec: SiteSpec, site_file: Path) -> Arrays:
    """The import result of a site, from the cache when there is a valid entry."""
    source = site_file.parent / spec.file
    check_file(source, spec.max_file_mb)
    entry = cache_folder() / f"{spec.name}-{_key(spec, source)}.npz"
    damaged = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
    with contextlib.suppress(*damaged), entry.open("rb") as file, np.load(file) as arrays:
        return _checked(dict(arrays))
    from swarmsim.site.importer import build

    try:
        fresh = _pack(build(source, spec))
    except InputError as error:
        here = shown_path(site_file)
        raise InputError(replace(told, file=told.file or here) for told in error.problems) from error
    with contextlib.suppress(OSError):  # a cache that cannot be written only costs time
        entry.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=entry.parent, suffix=".tmp", delete=False) as beside:
            np.savez(beside, allow_pickle=False, **fresh)
        os.replace(beside.name, entry)
    return fresh


def _key(spec: SiteSpec, source: Path) -> str:
    """Hash of all that the import depends on: file and those beside it, specification and the importer's code."""
    digest = hashlib.sha256(spec.model_dump_json().encode())
    files = [source, *material_files(source)] + ([source.parent / spec.orthophoto] if spec.orthophoto else [])
    for file in [*files, *sorted(Path(__file__).parent.glob("*.py"))]:
        digest.update(hashlib.sha256(file.read_bytes() if file.is_file() else b"").digest())
    return digest.hexdigest()[:24]


def _pack(raw: Any) -> Arrays:
    """A `swarmsim.site.importer.RawSite` as named arrays of numbers and text."""
    boxes = np.array([(*b.centre, *b.half, *b.axis, b.wall) for b in raw.boxes], np.float32).reshape(-1, 9)
    return {
        "grid": np.array([*raw.grid.origin, raw.grid.cell]),
        "terrain": raw.terrain.astype(np.float32),
        "surface": raw.surface.astype(np.float32),
        "clearance": raw.clearance.astype(np.float32),
        "cost": raw.cost.astype(np.float32),
        **_pack_steps(raw.steps),
        "boxes": boxes,
        "box_materials": np.array(raw.box_materials, dtype=np.str_),
        "survey_area": raw.survey_area.astype(np.float32),
        "vertices": raw.mesh.vertices_m,
        "triangles": raw.mesh.triangles,
        "colours": raw.mesh.colours,
        "report": np.array(json.dumps(raw.report)),
    }


def _pack_steps(steps: Any) -> Arrays:
    if steps is None:
        return {}
    return {"step_floor": steps.floor.astype(np.float32), "step_edge": steps.edge.astype(np.float32)}


def _checked(arrays: Arrays) -> Arrays:
    """The arrays of a cache entry; raises `KeyError` or `ValueError` when they are not those of a site."""
    shapes = {arrays[key].shape for key in ("terrain", "surface", "cost")}
    more = {"grid", "clearance", "boxes", "box_materials", "survey_area"}
    complete = more | {"vertices", "triangles", "colours", "report"}
    if len(shapes) != 1 or not complete <= arrays.keys() or not np.isfinite(arrays["terrain"]).all():
        raise ValueError("damaged cache entry")
    return arrays


def _model(
    spec: SiteSpec, arrays: Arrays, material_names: Sequence[str], densities_kg_m3: Sequence[float] | None = None
) -> SiteModel:
    names = list(material_names)
    boxes = arrays["boxes"]
    material = np.array([names.index(str(m)) for m in arrays["box_materials"]], np.int32)
    if len(boxes) == 0:
        boxes = np.array([[0, 0, 0, 0, 0, 0, 1, 0, 0]], np.float32)
        material = np.zeros(1, np.int32)
    obstacles = Obstacles(
        centre_m=on_device(boxes[:, :3]),
        half_extent_m=on_device(boxes[:, 3:6]),
        axis=on_device(boxes[:, 6:8]),
        wall_m=on_device(boxes[:, 8]),
        material=on_device(material, np.int32),
    )
    site = Site(
        origin_m=on_device(arrays["grid"][:2]),
        cell_m=on_device(arrays["grid"][2]),
        terrain_m=on_device(arrays["terrain"]),
        surface_m=on_device(arrays["surface"]),
        clearance_m=on_device(arrays["clearance"]),
        cost=on_device(arrays["cost"]),
        obstacles=obstacles,
        survey_area_m=on_device(arrays["survey_area"]),
        steps=_steps(arrays),
        above=ceilings(arrays["terrain"]),
        wall_kg_m3=None if densities_kg_m3 is None else on_device(walls_among(densities_kg_m3)),
        ground_material=on_device(names.index(spec.ground_material), np.int32),
        material_names=tuple(names),
    )
    mesh = VisualMesh(arrays["vertices"], arrays["triangles"], arrays["colours"])
    return SiteModel(name=spec.name, spec=spec, site=site, mesh=mesh, report=json.loads(str(arrays["report"])))


def _steps(arrays: Arrays) -> Steps | None:
    if "step_edge" not in arrays:
        return None
    return Steps(floor_m=on_device(arrays["step_floor"]), edge=on_device(arrays["step_edge"]))


def import_site(
    file: str | Path,
    out_dir: str | Path,
    options: ImportOptions | None = None,
    material_names: Sequence[str] | None = None,
) -> SiteModel:
    """Make a site of a mesh or an elevation model: copy it to ``out_dir`` with a ``site.yaml`` and a preview.

    ``material_names`` is the order of the materials table, by default that of the configured materials. ``out_dir`` is
    complete or absent. Raises `InputError` when the file cannot be read as a site, or when ``out_dir`` exists and
    ``options.overwrite`` is not set or it is not a site.
    """
    options = options or ImportOptions()
    material_names = list(available("materials")) if material_names is None else material_names
    source, out = Path(file), Path(out_dir)
    largest = (options.fields or {}).get("max_file_mb")
    check_file(
        source, largest if isinstance(largest, float | int) else MAX_FILE_MB
    )  # the specification checks the rest
    data = _specification(source, out, options)
    told = file_errors_told("the site cannot be written there", file=out, suggestion="choose another folder")
    with told, atomic_folder(out, partial(_check_out, overwrite=options.overwrite)) as folder:
        try:
            model, found = _make(folder, source, data, material_names, options.guess)
        except InputError as error:
            raise InputError([_with_user_file(p, folder, out, source) for p in error.problems]) from error
        if options.preview:
            from swarmsim.site.preview import write_preview

            write_preview(model, folder / "preview.png")
    model.report["guesses"] = [str(each) for each in found]
    return model


def _check_out(out: Path, overwrite: bool) -> None:
    if out.exists() and not overwrite:
        raise InputError.of("there is something already", file=out, suggestion="choose another folder, or overwrite it")
    if out.exists() and not (out / "site.yaml").is_file():
        raise InputError.of(
            "is not a site, so it will not be overwritten", file=out, suggestion="choose another folder"
        )


def _make(
    folder: Path, source: Path, data: dict[str, Any], material_names: Sequence[str], guess: bool
) -> tuple[SiteModel, list[Guess]]:
    """Write a site's specification and files into the empty ``folder``, and load it; with the guesses written."""
    spec = _written(folder, data, material_names)
    shutil.copyfile(source, folder / spec.file)
    for beside in material_files(source):
        shutil.copyfile(beside, folder / beside.name)
    if spec.orthophoto is not None:
        shutil.copyfile(source.parent / spec.orthophoto, folder / spec.orthophoto)
    found: list[Guess] = []
    if guess and source.suffix.lower() in MESH_SUFFIXES:
        from swarmsim.site.importer import build

        known = {name: content for name, content in load_all("materials").items() if name in material_names}
        found = guesses(build(folder / spec.file, spec).report["parts"], known)
        rules = [*data.get("obstacles", ()), *(each.rule() for each in found)]
        # What nothing is known of is more often a building or a thing of sheets than a solid block.
        shell = {} if "default_wall_m" in data else {"default_wall_m": UNKNOWN_WALL_M}
        spec = _written(folder, data | shell | {"obstacles": rules}, material_names)
    return _model(spec, _arrays(spec, folder / "site.yaml"), material_names), found


def _written(folder: Path, data: dict[str, Any], material_names: Sequence[str]) -> SiteSpec:
    """The specification ``data``, written to ``folder`` and checked."""
    (folder / "site.yaml").write_text(dump_yaml(data), encoding="utf-8")
    spec: SiteSpec = load_model(folder / "site.yaml", SiteSpec)
    _check_materials(spec, material_names, folder / "site.yaml")
    return spec


def _with_user_file(problem: Problem, folder: Path, out: Path, source: Path) -> Problem:
    """``problem`` with the user's file in place of its copy in the temporary ``folder``."""
    if problem.file is None or Path(problem.file).resolve().parent != folder.resolve():
        return problem
    name = Path(problem.file).name
    return replace(problem, file=str(source if name == source.name else out / name), line=None)


def _specification(source: Path, out: Path, options: ImportOptions) -> dict[str, Any]:
    """The content of ``site.yaml``."""
    fields = dict(options.fields or {})
    cell = options.cell_m
    if cell is None:
        cell = _own_cell(source, fields.get("unit_m")) if source.suffix.lower() in (".tif", ".tiff") else 0.5
    if isinstance(fields.get("orthophoto"), str):
        picture = source.parent / fields["orthophoto"]
        if not picture.is_file():
            raise InputError.of("there is no such orthophoto", file=picture, path="orthophoto")
        fields["orthophoto"] = picture.name
    return {
        "name": options.name or out.name,
        "description": f"Imported from {source.name}",
        "file": source.name,
        "licence": options.licence,
        "cell_m": cell,
        **fields,
    }


def _own_cell(source: Path, unit_m: Any) -> float:
    from swarmsim.site.elevation import own_cell

    return own_cell(source, unit_m if isinstance(unit_m, float | int) and unit_m > 0 else None)
