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


def message_of(*overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        load_scenario("recon", overrides)
    return str(caught.value)


ROTORS = {
    "on one line": (["0.1, 0.2", "0.2, 0.4", "0.3, 0.6", "0.4, 0.8"], "stand on one line seen from above"),
    "at one point": (["0.1, 0.2"] * 4, "stand at one point seen from above"),
    "in the middle": (["0.0, 0.0"] * 4, "stand at one point seen from above"),
    "of one sense on each side": (
        ["0.2, 0.2", "0.2, -0.2", "-0.2, 0.2", "-0.2, -0.2"],
        "neighbours that turn opposite",
    ),
    "three": (["0.2, 0.2", "0.2, -0.2", "-0.2, 0.0"], "it takes four or more"),
    "in front": (
        ["1.2, 0.2", "0.8, 0.2", "1.2, -0.2", "0.8, -0.2"],
        "cannot hold the vehicle level: it takes thrusts of",
    ),
}


@pytest.mark.parametrize(("places", "fragment"), ROTORS.values(), ids=ROTORS)
def test_rotors_that_cannot_hold_a_vehicle(places: list[str], fragment: str) -> None:
    spins = ["ccw", "ccw", "cw", "cw"] if "neighbours" in fragment else ["ccw", "cw", "cw", "ccw"]
    rotors = [f"{{position_m: [{xy}, 0.05], spin: {spin}}}" for xy, spin in zip(places, spins, strict=False)]
    message = message_of(f"definitions.vehicles.tarot_t650.rotors=[{', '.join(rotors)}]")
    assert fragment in message
    assert "allowed" not in message


UNSOUND = {
    "tarot_t650.feet.positions_m=[[0.1, 0, -0.2], [0, 0, -0.2], [-0.1, 0, -0.2]]": "the vehicle falls over",
    "tarot_t650.feet.positions_m=[[0.2, 0.1, -0.2], [0.2, -0.1, -0.2], [0.1, 0, -0.2]]": "the vehicle falls over",
    "tarot_t650.feet.positions_m=[[0.2, 0.1, 0.2], [0.2, -0.1, -0.2], [-0.2, 0, -0.2]]": "the feet must lie below",
    "tarot_t650.rotor.speed_min_rad_s=600": "so that it never comes down",
    "tarot_t650.rotor.speed_max_voltage_v=100": "at the 24.6 V of its full battery the rotors lift",
    "tarot_t650.battery.cells=1": "at the 4.1 V of its full battery the rotors lift",
    "tarot_t650.collision_radius_m=0.1": "collision_radius_m must take in propellers and feet, which reach 0.515 m",
    "tarot_t650.collision_height_m=0.1": "collision_height_m must take in the feet and the rotors",
    "orpheus.wheels.wheel_base_m=0.3": "the wheels of a side overlap",
    "orpheus.wheels.track_m=0.05": "the wheels of an axle overlap",
    "orpheus.chassis_height_m=0.1": "the chassis reaches into the ground",
    "orpheus.motor.torque_max_nm=0.5": "the wheels push with 10 N at most, and roll against 15 N",
    "orpheus.wheels.friction=0.02": "the wheels push with 10 N at most, and roll against 15 N",
}


@pytest.mark.parametrize(("override", "fragment"), UNSOUND.items())
def test_a_vehicle_that_can_neither_fly_nor_drive_nor_stand(override: str, fragment: str) -> None:
    assert fragment in message_of(f"definitions.vehicles.{override}")
