"""Every number of every configuration has a lower and an upper bound, and every list a largest length."""

from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import TypeAdapter

from swarmsim.config.catalogue import MODELS
from swarmsim.config.errors import InputError
from swarmsim.config.policies import SETTINGS
from swarmsim.config.scenario import load_scenario

EVERY = MODELS | SETTINGS


def unbounded(schema: Any, path: str) -> Iterator[str]:
    """Places of a JSON schema where a number without both bounds, or a list without a largest length, may stand."""
    if isinstance(schema, list):
        for inner in schema:
            yield from unbounded(inner, path)
    if not isinstance(schema, dict):
        return
    bounds = ({"minimum", "exclusiveMinimum"}, {"maximum", "exclusiveMaximum"})
    if schema.get("type") in ("number", "integer") and not all(either & set(schema) for either in bounds):
        yield path
    if schema.get("type") == "array" and "maxItems" not in schema:
        yield path
    for key, inner in schema.items():
        if key in ("properties", "$defs"):
            for name, field in inner.items():
                yield from unbounded(field, f"{path}.{name}")
        elif key not in ("default", "const", "enum"):
            yield from unbounded(inner, path)


@pytest.mark.parametrize("kind", [kind for kind in EVERY if kind != "sites"])
def test_every_number_and_every_list_is_bounded(kind: str) -> None:
    assert list(unbounded(TypeAdapter(EVERY[kind]).json_schema(), kind)) == []


@pytest.mark.parametrize(
    "override",
    [
        "failsafes.return_clearance_m=5e6",
        "failsafes.link.after_s=9e18",
        "sources.0.activity_mbq=1e12",
        "sources.0.position_m=[1e9, 0]",
        "localisation.window_s=1e-30",
        "phases.survey.time_limit_s=1e9",
        "phases.survey.settings.obstacle_clearance_m=5e6",
        "phases.survey.settings.line_spacing_m=1e-9",
        "definitions.vehicles.tarot_t650.mass_kg=1e-30",
        "definitions.detectors.nai_2x2.sample_period_s=1e9",
    ],
)
def test_a_value_that_nobody_has_is_refused_with_what_is_allowed(override: str) -> None:
    with pytest.raises(InputError) as caught:
        load_scenario("recon", [override])
    (problem,) = caught.value.problems
    assert problem.path is not None
    assert override.startswith(problem.path.rpartition(".")[0][:7])
    assert "a number from" in (problem.allowed or "")
    assert problem.message in ("is too large", "is too small")
