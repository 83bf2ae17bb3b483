"""Citations of values that a file or an override changes: those that it inherits are of the values before.

Vehicles, sensors and detectors cite by path (``sources: {rotor.radius_m: data sheet}``; a path covers those below it),
nuclides and materials as a whole (``source``). Whoever changes a value and gives no source of its own is named in the
place of the citation that the value had.
"""

from collections.abc import Iterable, Iterator
from typing import Any

from swarmsim.config.allowed import item
from swarmsim.config.documents import Place, dotted

_ROOTED = ("vehicles", "detectors", "sensors", "nuclides", "materials")
_UNCITED = ("name", "description", "kind", "sources", "source")


def restate(
    kind: str, data: dict[str, Any], before: dict[str, Any], own: Any, changed: Iterable[Place], origin: str
) -> None:
    """Replace the citations in ``data`` that no longer hold.

    Args:
        kind: of the document, one of `swarmsim.config.files.KINDS`.
        data: of the document after the change; its citations are changed in place.
        before: its data before.
        own: what was merged into it, with its own ``sources`` or ``source``, laid out as ``data`` is.
        changed: where values were replaced.
        origin: who replaced them, such as ``heavy.yaml``.
    """
    places = [place for place in changed if _at(before, place) != _at(data, place)]
    for root in _roots(kind, before):
        inner = [place[len(root) :] for place in places if place[: len(root)] == root and len(place) > len(root)]
        inner = [place for place in inner if place[0] not in _UNCITED]
        old, new, mine = _at(before, root), _at(data, root), _at(own, root)
        if not inner or not isinstance(old, dict) or not isinstance(new, dict):
            continue
        if isinstance(old.get("sources"), dict) and isinstance(new.get("sources"), dict):
            given = item(mine, "sources")
            _restate_paths(new, old["sources"], set(given) if isinstance(given, dict) else set(), inner, origin)
        elif isinstance(old.get("source"), str) and item(mine, "source") is None:
            told = ", ".join(dotted(place) for place in inner)
            new["source"] = f"{origin} gives no source of {told}; the rest: {old['source']}"


def _restate_paths(
    new: dict[str, Any], inherited: dict[str, Any], given: set[str], changed: Iterable[Place], origin: str
) -> None:
    cited = new["sources"]
    for place in changed:
        path, value = dotted(place), _at(new, place)
        stale = [each for each in inherited if _covers(path, each) and each not in given]
        for each in stale:
            cited.pop(each, None)
        was_cited = path in stale or (any(_covers(each, path) for each in inherited) and _numbers(value))
        left = [leaf for leaf in _leaves(value, path) if not any(_covers(each, leaf) for each in given)]
        if (was_cited or stale) and left and value is not None:
            cited[path] = f"{origin} gives no source"


def _roots(kind: str, data: dict[str, Any]) -> Iterator[Place]:
    """Where the definitions begin that cite: the document, or those that a mission brings along."""
    if kind in _ROOTED:
        yield ()
        return
    for each in _ROOTED:
        named = item(item(data, "definitions"), each)
        yield from (("definitions", each, name) for name in (named if isinstance(named, dict) else ()))


def _at(data: Any, place: Place) -> Any:
    """The value at a place; None where there is none."""
    for step in place:
        data = item(data, step)
    return data


def _covers(source: str, path: str) -> bool:
    return path == source or path.startswith(f"{source}.")


def _leaves(value: Any, path: str) -> Iterator[str]:
    """Dotted path of every single value in nested mappings and lists."""
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(inner, f"{path}.{key}")
    else:
        yield path


def _numbers(value: Any) -> bool:
    """Whether there is a number in nested mappings and lists."""
    if isinstance(value, dict | list):
        return any(map(_numbers, value.values() if isinstance(value, dict) else value))
    return isinstance(value, int | float) and not isinstance(value, bool)
