"""Definitions that overrides and ``vary`` change: copied into the mission from the files that they stand in."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarmsim.config import files
from swarmsim.config.allowed import item
from swarmsim.config.documents import Document, Place
from swarmsim.config.errors import InputError, Problem
from swarmsim.config.load import read_document
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.overrides import ORIGIN
from swarmsim.config.references import known_names

if TYPE_CHECKING:
    from swarmsim.config.scenario import Scenario

KINDS = ("vehicles", "detectors", "sensors", "nuclides", "materials")


def bring_in_definitions(
    document: Document, texts: Sequence[str], near: Path, problem: Callable[..., Problem]
) -> list[Problem]:
    """Copy into ``definitions`` what overrides or `vary` change: ``definitions.vehicles.tarot_t650.mass_kg=4``.

    Returns what is wrong with the names, each as a ``problem(message, path=..., ...)``, and with the files.
    """
    problems: list[Problem] = []
    for text, (kind, name) in _named(texts):
        place: Place = ("definitions", kind, name)
        if item(item(item(document.data, "definitions"), kind), name) is not None:
            continue
        known = known_names(document.data, kind, near)
        if name not in known:
            message, hint = f"there is no {kind.removesuffix('s')} '{name}'", did_you_mean(name, known)
            path = text.partition("=")[0].strip()
            problems.append(problem(message, path=path, allowed=one_of(known), suggestion=hint))
            continue
        try:
            source = read_document(files.available(kind, near)[name], kind)
        except InputError as error:
            problems += error.problems
            continue
        kinds = _table(document.data, "definitions")
        named = None if kinds is None else _table(kinds, kind)
        if named is None:
            continue  # of what is no table the check tells
        named[name] = _beside(source, files.available(kind, near)[name])
        document.marks |= {(*place, *inner): mark for inner, mark in source.marks.items()}
    return problems


def unused_definitions(scenario: Scenario, overrides: Sequence[str]) -> list[Problem]:
    """Definitions that are changed on the command line though the mission uses none of that name."""
    used = {
        "vehicles": sorted({member.type for member in scenario.members}),
        "detectors": sorted(scenario.detectors),
        "sensors": sorted(scenario.sensors),
    }
    return [
        Problem(
            f"changes nothing: the mission has no {kind.removesuffix('s')} '{name}'",
            file=ORIGIN,
            path=text.partition("=")[0].strip(),
            allowed=one_of(used[kind]),
            suggestion=did_you_mean(name, used[kind]),
        )
        for text, (kind, name) in _named(overrides)
        if kind in used and name not in used[kind]
    ]


def _named(texts: Sequence[str]) -> Iterator[tuple[str, tuple[str, str]]]:
    """The texts that reach into a definition, with its kind and name."""
    for text in texts:
        steps = text.partition("=")[0].strip().split(".")
        if steps[0] == "definitions" and len(steps) > 3 and steps[1] in KINDS:
            yield text, (steps[1], steps[2])


def _beside(source: Document, path: Path) -> dict[str, Any]:
    """The data of a file, with the path of a vehicle's body made absolute."""
    body = item(item(source.data, "body"), "file")
    if isinstance(body, str):
        source.data["body"]["file"] = str(files.resolved(path.parent) / body)
    return source.data


def _table(parent: dict[str, Any], key: str) -> dict[str, Any] | None:
    """The table under a key, a new one where there is nothing; None where there is something else."""
    if parent.get(key) is None:
        parent[key] = {}
    found = parent[key]
    return found if isinstance(found, dict) else None
