"""``vary`` of a mission: its paths looked up, and its distributions held against what may stand there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from swarmsim.config.allowed import Schema, Shape, item, shape_of
from swarmsim.config.documents import Document, Place, dotted
from swarmsim.config.errors import InputError, Problem
from swarmsim.config.overrides import ORIGIN, known_step
from swarmsim.config.vary import SOURCES_MAX, Distribution

COUNT = "sources"
"""The path whose ``count`` is varied."""
CAN_VARY = (
    "what leaves names, sizes and structure as they are: sources.*.nuclide, position_m, height_m and activity_mbq, the "
    "number of sources (sources: {count: [1, 3]}), vehicles.*.position_m and heading_deg, wind, background, failsafes, "
    "traffic, radio.range_m and radio.loss, most numbers of knowledge, mapping, localisation and identification, "
    "phases.*.settings, phases.*.start.at_s and delay_s, and numbers in definitions other than materials"
)
_FIXED_SECTIONS = {
    "name", "description", "site", "seed", "engine", "detection", "timing", "versions", "vary", "effects",
    "autopilot",
}  # fmt: skip
_FIXED_FIELDS = {
    "vehicles": {"name", "type", "formation"},
    "phases": {"name", "who", "policy", "time_limit_s", "end"},
}
_FIXED_PLACES: set[Place] = {
    ("radio", "delay_s"),
    ("radio", "mates"),
    ("mapping", "cell_m"),
    ("mapping", "hotspots_max"),
    ("definitions", "complete"),
}


@dataclass(frozen=True)
class Varied:
    """A value of the mission that is drawn for every mission."""

    place: Place  # of the value, e.g. ("sources", 0, "activity_mbq"); ("sources",) for their number
    key: str  # the path in ``vary``, which may have wildcards
    distribution: Distribution
    whole: bool = False  # it is a whole number

    @property
    def path(self) -> str:
        """Dotted path, e.g. ``sources.0.activity_mbq``."""
        return dotted(self.place)


def ends_of(varied: Varied) -> tuple[Any, ...]:
    """Values that bound what is drawn: the ends of an interval, the least and greatest of numbers, all of others."""
    drawn = varied.distribution
    if drawn.interval is not None:
        low, high = drawn.interval
        return (int(low), int(high)) if varied.whole else (low, high)
    values = drawn.choice or ()
    if values and all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return min(values), max(values)
    return values


def varied_paths(document: Document) -> list[str]:
    """The paths of ``vary`` as they are written."""
    vary = item(document.data, "vary")
    return list(vary) if isinstance(vary, dict) else []


def add_sources(document: Document) -> None:
    """List as many sources as may be there: those that the mission does not list are like the last one."""
    ends = item(item(item(document.data, "vary"), COUNT), "count")
    sources = document.data.get("sources")
    most = ends[1] if isinstance(ends, list) and len(ends) == 2 else 0
    if isinstance(sources, list) and sources and isinstance(most, int) and len(sources) < most <= SOURCES_MAX:
        last = sources[-1]
        copies = [dict(last) if isinstance(last, dict) else last for _ in range(most - len(sources))]
        document.data["sources"] = [*sources, *copies]


def set_and_varied(document: Document, overrides: Sequence[str]) -> list[Problem]:
    """Values that are set on the command line though every mission draws them, so that setting them changes nothing."""
    problems = []
    for text in overrides:
        path = text.partition("=")[0].strip()
        steps = path.split(".")
        for key in varied_paths(document):
            drawn = key.split(".")
            hidden = len(steps) >= len(drawn) > 1 and all(
                known in ("*", step) for known, step in zip(drawn, steps, strict=False)
            )
            if hidden and item(document.data["vary"], key) is not None:
                hint = f"leave it out with {ORIGIN} vary.{key}=null, or set its distribution, vary.{key}"
                message = "is drawn for every mission, so that setting it changes nothing"
                problems.append(Problem(message=message, file=ORIGIN, path=path, suggestion=hint))
    return problems


def read_family(document: Document, near: Path | None) -> tuple[tuple[Varied, ...], list[Problem]]:
    """What is varied, wildcards written out, and what is wrong with it; the document is a valid mission's.

    A path without wildcards comes before one with them.
    """
    found: dict[Place, Varied] = {}
    problems: list[Problem] = []
    vary: dict[str, Any] = document.data.get("vary") or {}
    for key in sorted(vary, key=lambda key: "*" in key):
        if vary[key] is None:
            continue
        distribution = Distribution.model_validate(_tuples(vary[key]))
        try:
            for place in _places(document, key, near):
                schema = _schema(document, place, near)
                _check(document, key, place, schema, distribution)
                if place in found and "*" not in key:
                    raise InputError([document.problem(("vary", key), f"is varied by '{found[place].key}' too")])
                found.setdefault(place, Varied(place, key, distribution, schema.get("type") == "integer"))
        except InputError as error:
            problems += error.problems
    problems += _overlaps(document, found)
    in_order = sorted(found, key=lambda place: [(isinstance(step, str), step) for step in place])
    return tuple(found[place] for place in in_order), problems


def canonical(document: Document, path: str, near: Path | None) -> str:
    """A path with the indices of what it names, as draws are listed by; as it is where there is no such thing."""
    try:
        (place,) = _places(document, path, near)
    except (InputError, ValueError):
        return path
    return dotted(place)


def _tuples(value: Any) -> Any:
    """Lists as tuples, but for the values of a choice, which are left as they are."""
    if isinstance(value, dict):
        return {k: tuple(v) if k == "choice" and isinstance(v, list) else _tuples(v) for k, v in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _overlaps(document: Document, found: dict[Place, Varied]) -> Iterator[Problem]:
    """Values that are drawn as a whole and in part."""
    for place, varied in found.items():
        for length in range(1, len(place)):
            around = found.get(place[:length])
            if around is not None and around.distribution.count is None:
                message = f"is varied as a part of '{around.key}' too: vary the one or the other"
                yield document.problem(("vary", varied.key), message)


def _places(document: Document, key: str, near: Path | None) -> Iterator[Place]:
    """The places that a path of ``vary`` means; raises `InputError` with the nearest name for one that there is not."""
    open_places: list[Place] = [()]
    steps = key.split(".")
    for i, step in enumerate(steps):
        wider = []
        for place in open_places:
            node = _at(document.data, place)
            if step == "*":
                if not isinstance(node, list):
                    here = dotted(place) or "the top level"
                    message = f"'*' stands for the items of a list, and {here} is none"
                    raise InputError([document.problem(("vary", key), message)])
                wider += [(*place, k) for k in range(len(node))]
            else:
                wider.append((*place, _step(document, key, place, node, step, near)))
        open_places = wider
        if i == 0 and step in _FIXED_SECTIONS:
            raise InputError([_refused(document, key)])
    yield from open_places


def _step(document: Document, key: str, place: Place, node: Any, step: str, near: Path | None) -> str | int:
    shape, data, inside = _shape(document, place, near)
    try:
        return known_step({} if node is None else node, step, inside, Document(data), shape)
    except InputError as error:
        (problem,) = error.problems
        hints = {"allowed": problem.allowed, "suggestion": problem.suggestion}
        raise InputError([document.problem(("vary", key), problem.message, given=key, **hints)]) from None


def _shape(document: Document, place: Place, near: Path | None) -> tuple[Shape, Any, Place]:
    """The shape that tells what may stand at ``place``, its data, and the place within it: a policy's has its own."""
    from swarmsim.config.mission import Mission

    if len(place) >= 3 and place[0] == "phases" and place[2] == "settings":
        from swarmsim.policies import registry

        phase = document.data["phases"][place[1]]
        return shape_of(registry.settings_model(phase["policy"], near)), phase.get("settings") or {}, place[3:]
    return shape_of(Mission), document.data, place


def _schema(document: Document, place: Place, near: Path | None) -> Schema:
    shape, data, inside = _shape(document, place, near)
    return shape.at(inside, data) or {}


def _at(data: Any, place: Place) -> Any:
    for step in place:
        data = item(data, step)
    return data


def _refused(document: Document, key: str) -> Problem:
    return document.problem(("vary", key), "cannot be varied from mission to mission", given=key, allowed=CAN_VARY)


def _check(document: Document, key: str, place: Place, schema: Schema, drawn: Distribution) -> None:
    """Raise an `InputError` where a distribution does not suit its place."""

    def wrong(message: str, **details: str | None) -> InputError:
        return InputError([document.problem(("vary", key, drawn.kind), message, **details)])

    if drawn.count is not None and place != (COUNT,):
        raise wrong("is the number of sources", given=key, suggestion=f"write {COUNT}: {{count: …}}")
    if drawn.count is not None:
        if not document.data["sources"] and drawn.count[1]:
            raise wrong("there is no source that others could be like", suggestion="list one source")
        return
    source = place[0] == "sources" and len(place) >= 3
    fixed = place[2] in _FIXED_FIELDS.get(str(place[0]), ()) if len(place) > 2 else place[0] in ("vehicles", "phases")
    late = place[0] == "phases" and place[2:] in (("start",), ("start", "after"), ("start", "when"))
    fixed |= place[:2] == ("definitions", "materials")  # the site's walls are made of them once for all missions
    if fixed or late or place in _FIXED_PLACES or place[-1] == "name" or (place[0] == "sources" and not source):
        raise InputError([_refused(document, key)])
    for kind, field in (("place", "position_m"), ("any_nuclide", "nuclide")):
        if drawn.kind == kind and (not source or place[2:] != (field,)):
            raise wrong(f"is for sources.*.{field}", given=key)
    if drawn.place is not None and document.data["sources"][place[1]].get("position_m") is None:
        message = f"places point sources, and sources.{place[1]} has no position_m"
        raise wrong(message, given=key, suggestion="name the sources that are points, such as sources.0.position_m")
    if drawn.interval is not None:
        number = schema.get("type")
        if number not in ("number", "integer"):
            what = "true or false" if number == "boolean" else "no number"
            raise wrong(f"draws a number, and {dotted(place)} is {what}", suggestion="use choice")
        if number == "integer" and (drawn.uniform is None or not all(end == int(end) for end in drawn.uniform)):
            allowed = "uniform between whole numbers, or choice"
            raise wrong(f"draws fractions, and {dotted(place)} is a whole number", allowed=allowed)
        for end in drawn.interval:
            if fault := _beyond(end, schema):
                allowed = shape_of(Distribution).words(schema)
                hint = "give it min and max" if drawn.normal is not None else None
                raise wrong(f"can draw a value that {fault}", given=f"{end:g}", allowed=allowed, suggestion=hint)
    for value in drawn.choice or ():
        _check_choice(value, schema, wrong)


def _check_choice(value: Any, schema: Schema, wrong: Any) -> None:
    """What a number can be told of at once; everything else is told when the scenario is made with it."""
    if isinstance(value, float) and not math.isfinite(value):
        raise wrong("holds a number that is not finite", given=str(value))
    if isinstance(value, int | float) and not isinstance(value, bool) and (fault := _beyond(value, schema)):
        raise wrong(f"holds a value that {fault}", given=f"{value:g}", allowed=shape_of(Distribution).words(schema))


def _beyond(value: float, schema: Schema) -> str | None:
    """How a number leaves the bounds of a schema."""
    least, above = schema.get("minimum"), schema.get("exclusiveMinimum")
    most, below = schema.get("maximum"), schema.get("exclusiveMaximum")
    if (least is not None and value < least) or (above is not None and value <= above):
        return "is too small"
    if (most is not None and value > most) or (below is not None and value >= below):
        return "is too large"
    return None
