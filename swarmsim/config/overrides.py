"""Dotted overrides from the command line: ``wind.speed_m_s=3``, ``phases.survey.settings.altitude_m=30``."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from swarmsim.config.allowed import Shape
from swarmsim.config.citations import restate
from swarmsim.config.documents import Document, Mark, Place, dotted, parse_value
from swarmsim.config.errors import InputError, Problem
from swarmsim.config.former import former_override
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.vary import DISTRIBUTIONS

ORIGIN = "--set"
_CITING = "definitions"  # of the parts of a mission, those whose values have sources


def apply_overrides(document: Document, overrides: Sequence[str], shape: Shape, origin: str = ORIGIN) -> None:
    """Set each ``path=value`` in the document; raises one `InputError` with everything that is wrong with them.

    ``origin`` is where they were written, for messages.

    A list's items are named by index, or by their ``name`` field (``vehicles.uav1.heading_deg=90``); values are YAML.
    """
    problems: list[Problem] = []
    places: list[Place] = []
    before = copy.deepcopy(document.data) if any(text.strip().startswith(_CITING) for text in overrides) else {}
    for text in overrides:
        try:
            places.append(_apply(document, text, shape, origin))
        except InputError as error:
            problems += [replace(problem, file=origin) for problem in error.problems]
    if problems:
        raise InputError(problems)
    if before:
        restate("missions", document.data, before, _own_sources(places), places, ORIGIN)


def _own_sources(places: Sequence[Place]) -> dict[str, Any]:
    """The sources among what overrides set, laid out as in a mission."""
    own: dict[str, Any] = {_CITING: {}}
    for place in places:
        if len(place) > 3 and place[3] in ("source", "sources"):
            given = own[_CITING].setdefault(place[1], {}).setdefault(place[2], {})
            if place[3] == "source":
                given["source"] = ORIGIN
            else:
                given.setdefault("sources", {})[dotted(place[4:])] = ORIGIN
    return own


def _apply(document: Document, text: str, shape: Shape, origin: str) -> Place:
    """Set one; returns its place."""
    path, equals, value_text = text.partition("=")
    steps = path.strip().split(".")
    if not equals or not all(steps):
        raise InputError.of(
            "is not of the form path=value", file=ORIGIN, given=text, suggestion=f"e.g. {ORIGIN} wind.speed_m_s=3"
        )
    try:
        value = parse_value(value_text)
    except InputError as error:
        raise InputError([_at(tuple(steps), p.message, given=value_text) for p in error.problems]) from None
    former = former_override(tuple(steps), value, document.data)
    if former is not None and shape.at((steps[0],), document.data) is None:
        raise InputError([_at(tuple(steps), f"is now {former[0]}", suggestion=f"write {ORIGIN} {former[1]}")])
    steps = _with_whole_path(steps)
    place: Place = ()
    node: Any = document.data
    for i, step in enumerate(steps):
        known = known_step(node, step, place, document, shape)
        place = (*place, known)
        if i == len(steps) - 1:
            node[known] = value
        else:
            if isinstance(node, dict) and node.get(known) is None:
                node[known] = {}
            node = node[known]
    document.replace(place, {place: Mark(origin, None)})
    return place


def _with_whole_path(steps: list[str]) -> list[str]:
    """The steps of ``vary.wind.speed_m_s.uniform``, where the path of what is varied is a single one."""
    if steps[0] != "vary" or len(steps) < 3:
        return steps
    end = next((i for i, step in enumerate(steps) if i > 1 and step in DISTRIBUTIONS), len(steps))
    return ["vary", ".".join(steps[1:end]), *steps[end:]]


def known_step(node: Any, step: str, place: Place, document: Document, shape: Shape) -> str | int:
    """The key or index that ``step`` means in ``node``; raises with the nearest when there is none."""
    here = dotted(place) or "the top level"
    if isinstance(node, list):
        if step.isascii() and step.isdigit() and len(step) < 10 and int(step) < len(node):
            return int(step)
        names = [item["name"] for item in node if isinstance(item, dict) and isinstance(item.get("name"), str)]
        if step in names:
            return names.index(step)
        allowed = f"an index from 0 to {len(node) - 1}" if node else "nothing: the list is empty; set the whole list"
        allowed += f", or {one_of(names)}" if names else ""
        raise InputError(
            [_at((*place, step), f"{here} has no item '{step}'", allowed=allowed, suggestion=did_you_mean(step, names))]
        )
    if isinstance(node, dict):
        inner = shape.at((*place, step), document.data)
        if inner is not None:
            return step
        fields = shape.fields(place, document.data)
        message, hint = f"{here} has no field '{step}'", did_you_mean(step, fields)
        raise InputError([_at((*place, step), message, allowed=one_of(fields), suggestion=hint)])
    raise InputError([_at((*place, step), f"{here} is a single value and has nothing inside")])


def _at(place: Place, message: str, **details: Any) -> Problem:
    return Problem(message=message, file=ORIGIN, path=dotted(place), **details)
