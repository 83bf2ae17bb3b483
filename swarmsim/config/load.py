"""YAML files to validated models: composition with ``extends``, overrides, and one error that says all."""

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from swarmsim.config import files
from swarmsim.config.allowed import shape_of
from swarmsim.config.catalogue import MODELS, kind_of_model
from swarmsim.config.citations import restate
from swarmsim.config.documents import Document, Place, read_file
from swarmsim.config.errors import InputError, Problem
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.overrides import apply_overrides
from swarmsim.config.validation import validate

EXTENDS_MAX = 20


def load_model(path: str | Path, cls: Any) -> Any:
    """The validated model ``cls`` of the YAML file ``path``; raises `InputError` with every problem of the file.

    ``cls`` is a model or a union of models (`swarmsim.config.vehicles.Vehicle`).
    """
    return validate(read_document(Path(path), kind_of_model(cls)), cls)


def load_named(kind: str, name: str | Path, near: Path | None = None) -> Any:
    """The validated configuration ``name`` (or the file) of a kind of `swarmsim.config.files.KINDS`.

    Every kind but a mission must carry the name of its file (of its folder for a site). A vehicle's body file is
    found beside the vehicle's file.
    """
    path = files.find(kind, name, near)
    document = read_document(path, kind)
    model = validate(document, MODELS[kind])
    known_as = path.parent.name if kind == "sites" and path.name == "site.yaml" else path.stem
    if kind != "missions" and model.name != known_as:
        problem = document.problem(
            ("name",),
            f"the name inside differs from the {'folder' if kind == 'sites' else 'file'}'s",
            given=model.name,
            allowed=known_as,
            suggestion=f"write 'name: {known_as}', or rename the file",
        )
        raise InputError([problem])
    return _with_body(model, path, document) if kind == "vehicles" else model


def _with_body(vehicle: Any, path: Path, document: Document) -> Any:
    """The vehicle with its body's file, written relative to the folder of the vehicle's file, made absolute."""
    if vehicle.body is None:
        return vehicle
    file = files.resolved(files.resolved(path.parent) / vehicle.body.file)
    if not files.is_file(file):
        place = ("body", "file")
        raise InputError([document.problem(place, "there is no such file", given=vehicle.body.file)])
    return vehicle.model_copy(update={"body": vehicle.body.model_copy(update={"file": str(file)})})


def load_all(kind: str, near: Path | None = None) -> dict[str, Any]:
    """Every configuration of a kind by its name, in the order of the names; raises with the problems of all of them."""
    models: dict[str, Any] = {}
    problems: list[Problem] = []
    for name, path in files.available(kind, near).items():
        try:
            models[name] = load_named(kind, path, near)
        except InputError as error:
            problems += error.problems
    if problems:
        raise InputError(problems)
    return models


def read_document(path: Path, kind: str | None = None, overrides: Sequence[str] = ()) -> Document:
    """The plain data of a file with what it extends merged in and the ``path=value`` overrides applied."""
    document = _extended(path, kind, ())
    if overrides and kind is not None:
        apply_overrides(document, overrides, shape_of(MODELS[kind]))
    return document


def _extended(path: Path, kind: str | None, chain: tuple[Path, ...]) -> Document:
    document = read_file(path)
    if kind is None or "extends" not in document.data:
        return document
    place = ("extends",)
    parent = document.data["extends"]
    if not isinstance(parent, str):
        allowed = f"the name of one of the {kind}, or the path of a file"
        raise InputError([document.problem(place, "is not a name", given=str(parent), allowed=allowed)])
    chain = (*chain, files.resolved(path))
    if len(chain) > EXTENDS_MAX:
        allowed = f"at most {EXTENDS_MAX} files that extend each other"
        raise InputError([document.problem(place, "is the end of too long a chain", given=parent, allowed=allowed)])
    parent_path = _parent_path(document, kind, parent, path)
    if files.resolved(parent_path) in chain:
        loop = " -> ".join(p.stem for p in (*chain, parent_path))
        raise InputError([document.problem(place, f"extends itself: {loop}", given=parent)])
    base = _extended(parent_path, kind, chain)
    merged = Document(base.data, base.marks, (path, *base.files))
    merged.marks[()] = document.marks[()]
    document.data.pop("extends")
    replaced: dict[Place, Place] = {}
    before = copy.deepcopy(base.data)
    _merge(merged, document, merged.data, document.data, (), (), replaced)
    restate(kind, merged.data, before, document.data, replaced, path.name)
    _take_marks(merged, document, replaced)
    return merged


def _parent_path(document: Document, kind: str, parent: str, path: Path) -> Path:
    if files.looks_like_path(parent):
        beside = path.parent / parent
        if files.is_file(beside):
            return beside
    known = files.available(kind, path)
    own = {name: p for name, p in known.items() if files.resolved(p) != files.resolved(path)}
    if parent in own:
        return own[parent]
    if parent in known or parent == path.stem:
        raise InputError([document.problem(("extends",), f"extends itself: {parent}", given=parent)])
    problem = document.problem(
        ("extends",),
        f"there is no {kind.removesuffix('s')} '{parent}' to extend",
        given=parent,
        allowed=", ".join(own) or "nothing: there are none",
        suggestion=did_you_mean(parent, own),
    )
    raise InputError([problem])


def _merge(
    into: Document,
    source: Document,
    old: Any,
    new: dict[str, Any],
    place: Place,
    origin: Place,
    replaced: dict[Place, Place],
) -> None:
    """Merge mappings deeply; lists and single values replace those below them.

    A mapping over a list changes the items that it names (``phases: {survey: {time_limit_s: 300}}``). ``place`` is
    where ``old`` stands in the merged document, ``origin`` is where ``new`` stands in its own. Each value that is
    replaced adds both of its places to ``replaced``.
    """
    for key, value in new.items():
        there = (*origin, key)
        known = _place_in(into, source, old, key, there)
        here = (*place, known)
        below = old.get(known) if isinstance(old, dict) else old[known]
        whole = place == ("vary",)  # a distribution replaces another one, of whatever kind
        if not whole and isinstance(value, dict) and (isinstance(below, dict) or _items_named(below)):
            into.marks[here] = source.marks[there]
            _merge(into, source, below, value, here, there, replaced)
        else:
            old[known] = value
            replaced[here] = there


def _take_marks(into: Document, source: Document, replaced: dict[Place, Place]) -> None:
    """Marks of the values of ``source`` that stand in ``into`` now, in the stead of those of what they replaced."""
    origins = {there: here for here, there in replaced.items()}
    kept = {place: mark for place, mark in into.marks.items() if _beginning_of(place, replaced) is None}
    for place, mark in source.marks.items():
        there = _beginning_of(place, origins)
        if there is not None:
            kept[(*origins[there], *place[len(there) :])] = mark
    into.marks = kept


def _beginning_of(place: Place, known: Mapping[Place, Place]) -> Place | None:
    """The key of ``known`` that ``place`` begins with; None when there is none."""
    return next((place[:n] for n in range(1, len(place) + 1) if place[:n] in known), None)


def _place_in(into: Document, source: Document, old: Any, key: str, there: Place) -> str | int:
    """The key of a mapping, or the index of the item of a list that has this name."""
    if isinstance(old, dict):
        return key
    names = _items_named(old)
    if key in names:
        return names.index(key)
    hint, allowed = did_you_mean(key, names), one_of(names)
    if not any("name" in item for item in old):
        hint, allowed = "write the whole list", "nothing: the items of this list have no names to change them by"
    raise InputError([source.problem(there, f"there is no item '{key}' to change", allowed=allowed, suggestion=hint)])


def _items_named(value: Any) -> list[str]:
    """Names of the items of a list of named mappings; empty for anything else."""
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        return []
    return [str(item.get("name")) for item in value]
