"""A scenario with other values: what a sweep or a batch of missions varies."""

import copy
import json
from collections.abc import Mapping
from typing import Any

from swarmsim.config.allowed import shape_of
from swarmsim.config.documents import Document, other_key
from swarmsim.config.errors import InputError
from swarmsim.config.files import SHOWN
from swarmsim.config.mission import Mission
from swarmsim.config.overrides import apply_overrides
from swarmsim.config.scenario import Scenario, resolve

ORIGIN = "values"
"""What messages name as the place of such a value."""


def with_values(scenario: Scenario, values: Mapping[str, Any]) -> Scenario:
    """The scenario with ``values`` at dotted paths (``sources.0.activity_mbq``), checked as a whole.

    It is a single scenario: of a family, nothing is drawn any more. Raises `InputError` with everything that is wrong
    with the paths, the values and what they make of the scenario.
    """
    own = scenario.document
    data = {key: copy.deepcopy(value) for key, value in own.data.items() if key not in ("vary", "definitions")}
    if "definitions" in own.data:  # the largest part, which only values in it change
        changed = any(path.startswith("definitions") for path in values)
        data["definitions"] = copy.deepcopy(own.data["definitions"]) if changed else own.data["definitions"]
    document = Document(data, dict(own.marks), own.files)
    texts = [f"{path}={_text(path, value)}" for path, value in values.items()]
    apply_overrides(document, texts, shape_of(Mission), ORIGIN)
    return resolve(document, scenario.mission_file, [], like=scenario)


def _text(path: str, value: Any) -> str:
    """A value as it is written in an override; raises `InputError` for what no configuration can hold."""
    try:
        text = json.dumps(value, default=_array)
        other = other_key(value)
    except (TypeError, ValueError, RecursionError):
        other, text = (value,), ""
    if other is None:
        return text
    allowed = "numbers, texts, true and false, lists and arrays, and mappings whose keys are texts"
    raise InputError.of(
        "is no value of a configuration", file=ORIGIN, path=str(path), given=repr(value)[:SHOWN], allowed=allowed
    )


def _array(value: Any) -> Any:
    found = plain(value)
    if found is value:
        raise TypeError
    return found


def plain(value: Any) -> Any:
    """Numbers and arrays of numpy and JAX as Python's."""
    return value.tolist() if hasattr(value, "tolist") else value
