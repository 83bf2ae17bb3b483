"""From a document to a validated model, with every error of pydantic told in a user's words."""

import json
from functools import cache
from typing import Any

from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from swarmsim.config.allowed import Shape, item, shape_of
from swarmsim.config.documents import Document, Place, beginning, dump_yaml
from swarmsim.config.errors import PROBLEMS_MAX, InputError, Problem
from swarmsim.config.former import former_problems
from swarmsim.config.mission import Mission
from swarmsim.config.names import did_you_mean, one_of

_NOT = {
    "string": "a text",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "tuple": "a list",
    "list": "a list",
    "dict": "a mapping",
    "model": "a mapping",
    "model_attributes": "a mapping",
}
_CHARACTERS_SHOWN = 100


@cache
def _adapter(cls: Any) -> TypeAdapter[Any]:
    return TypeAdapter(cls)


def validate(document: Document, cls: Any) -> Any:
    """The model ``cls`` of the document's data; raises one `InputError` with everything that is wrong.

    Validation is strict (``true`` is no number, ``"3"`` is no number), as in JSON, so that lists stand for tuples.
    """
    try:
        return _adapter(cls).validate_json(json.dumps(document.data), strict=True)
    except ValidationError as error:
        raise InputError(problems_of(error, document, cls)) from None


def problems_of(error: ValidationError, document: Document, cls: Any) -> list[Problem]:
    """Each error of a `ValidationError` as a `Problem`, in the order of the lines; one for each place."""
    shape = shape_of(cls)
    former = former_problems(document) if cls is Mission else []
    explained = {tuple((problem.path or "").split("."))[:1] for problem in former}
    found: dict[Place, Problem] = {}
    whole: set[Place] = set()  # of them, mappings and lists that are not of the kind that may stand there
    for details in error.errors(include_url=False):
        if len(found) > PROBLEMS_MAX:
            break
        place = _place(details, document.data)
        if place in explained or (former and place == ("phases",) and details["type"] == "missing"):
            continue
        if details["type"] == "too_short" and any(p[: len(place)] == place and p != place for p in found):
            continue  # pydantic counts only the items that passed: the items' own problems say more
        if isinstance(place[-1] if place else None, int) and details["type"] == "missing":
            place = place[:-1]
        if isinstance(details["input"], dict | list) and _is_of_type(details):
            whole.add(place)
        found.setdefault(place, _problem(details, place, document, shape))
    # a list where one word or several may stand is no word: its items' own problems say more
    told = [problem for p, problem in found.items() if p not in whole or not any(p == q[: len(p)] != q for q in found)]
    return sorted([*former, *told], key=lambda problem: problem.line or 0)


def _is_of_type(details: ErrorDetails) -> bool:
    return details["type"] == "literal_error" or details["type"].endswith("_type")


def _place(details: ErrorDetails, data: Any) -> Place:
    """The place that pydantic's ``loc`` means: without the names of the union's members, which it puts in between."""
    loc, missing = details["loc"], details["type"] == "missing"
    place: list[str | int] = []
    for i, step in enumerate(loc):
        inside = isinstance(data, dict) if isinstance(step, str) else isinstance(data, list)
        if inside and (isinstance(step, int) or step in data or (missing and i == len(loc) - 1)):
            place.append(step)
            data = item(data, step)
    return tuple(place)


def _problem(details: ErrorDetails, place: Place, document: Document, shape: Shape) -> Problem:
    data, kind, context = document.data, details["type"], details.get("ctx", {})
    name = str(place[-1]) if place else ""
    if kind == "extra_forbidden":
        fields = shape.fields(place[:-1], data)
        return document.problem(
            place, f"there is no field '{name}' here", allowed=one_of(fields), suggestion=did_you_mean(name, fields)
        )
    whole = kind == "value_error" and isinstance(details["input"], dict)  # its sentence says what is wrong in there
    given = None if whole else shown(details["input"])
    allowed = None if whole else shape.describe(place, data)
    if kind == "missing" and isinstance(details["loc"][-1], str):
        return document.problem(place, "this field is missing", allowed=allowed)
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        tag = context["discriminator"].strip("'")
        tags = [word.strip(" '") for word in context.get("expected_tags", "").split(",") if word] or None
        value = context.get("tag")
        return document.problem(
            (*place, tag),
            "names no known kind" if value else "this field is missing",
            given=value,
            allowed=one_of(tags) if tags else "one of multirotor, skid_steer",
            suggestion=did_you_mean(value, tags or ()) if value else None,
        )
    choices = shape.choices(place, data)
    suggestion = did_you_mean(given, choices) if given and kind == "literal_error" else _hint(details["input"], kind)
    return document.problem(place, _message(details), given=given, allowed=allowed, suggestion=suggestion)


def _message(details: ErrorDetails) -> str:
    kind, context = details["type"], details.get("ctx", {})
    if kind == "value_error":
        return str(context["error"])
    if kind in ("greater_than", "greater_than_equal"):
        return "is too small"
    if kind in ("less_than", "less_than_equal"):
        return "is too large"
    if kind in ("too_short", "missing"):
        return "has too few values"
    if kind == "too_long":
        return "has too many values"
    if kind in ("literal_error", "enum"):
        return "is not one of the choices"
    if kind == "finite_number":
        return "is not a finite number"
    if kind == "string_pattern_mismatch":
        return "is not a valid name"
    if kind == "string_too_long":
        return "is too long"
    if kind == "string_too_short":
        return "is empty"
    if kind == "int_from_float":
        return "is not a whole number"
    return f"is not {_NOT[word]}" if (word := kind.removesuffix("_type")) in _NOT else details["msg"]


def _hint(value: Any, kind: str) -> str | None:
    if isinstance(value, str) and kind in ("float_type", "int_type"):
        if value.count(",") == 1 and value.replace(",", "").strip("+-").isdigit():
            return "write a decimal point instead of the comma"
        return "give the bare number, without quotes or unit: the unit stands in the field's name"
    if kind == "bool_type" and isinstance(value, str):
        word = {"yes": "true", "on": "true", "no": "false", "off": "false"}.get(value.lower())
        return f"write {word}" if word else None
    if kind == "string_type" and isinstance(value, bool | int | float):
        return f'put it in quotes: "{str(value).lower() if isinstance(value, bool) else value}"'
    return None


def shown(value: Any) -> str:
    """``value`` as it would be written in YAML, shortened."""
    if value is None:
        return "nothing"
    if isinstance(value, float | int | bool | str):
        text = str(value).lower() if isinstance(value, bool) else str(value)
    elif isinstance(value, list):
        text = json.dumps(beginning(value), ensure_ascii=False)
    else:
        text = " ".join(dump_yaml(beginning(value)).split())
    return text if len(text) <= _CHARACTERS_SHOWN else text[: _CHARACTERS_SHOWN - 3] + "…"
