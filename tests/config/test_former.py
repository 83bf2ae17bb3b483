"""Scenarios written before missions had phases: each former field says how to write it now."""

from pathlib import Path

import pytest
import yaml

from swarmsim.config.errors import InputError
from swarmsim.config.load import load_model
from swarmsim.config.mission import Mission
from swarmsim.config.scenario import load_scenario
from tests.config.project import FORMER_SECTIONS, line_of, spoil


@pytest.fixture
def former(mission: Path) -> Path:
    """recon.yaml as it was written before."""
    text = mission.read_text()
    text = text[: text.index("identification:")].replace("timing: {control_period_s: 0.01, physics_steps: 2}\n", "")
    mission.write_text(text + FORMER_SECTIONS)
    return mission


def problems_of(path: Path, *overrides: str) -> dict[str | None, str]:
    with pytest.raises(InputError) as caught:
        load_scenario(path, overrides)
    return {problem.path: str(problem) for problem in caught.value.problems}


def test_each_former_field_is_told_once_with_its_line(former: Path) -> None:
    with pytest.raises(InputError) as caught:
        load_scenario(former)
    lines = {problem.path: problem.line for problem in caught.value.problems}
    assert len(lines) == len(caught.value.problems)
    assert lines == {
        "time_step_s": line_of(former, "time_step_s"),
        "aerial": line_of(former, "aerial:"),
        "aerial.separation_m": line_of(former, "separation_m: 6"),
        "ground": line_of(former, "ground:"),
        "ground.spectrum_radius_m": line_of(former, "spectrum_radius_m"),
        "ground.confidence_min": line_of(former, "confidence_min"),
    }
    with pytest.raises(InputError, match="aerial: is a phase now"):
        load_model(former, Mission)


def test_what_the_messages_say_to_write_is_the_mission_of_today(former: Path) -> None:
    told = problems_of(former)
    assert "is now timing.physics_steps" in told["time_step_s"]
    assert "is now traffic.separation_m" in told["aerial.separation_m"]
    text = former.read_text()
    text = text[: text.index("time_step_s:")]
    phases = []
    for path, message in told.items():
        written = message.partition("write ")[2]
        if path in ("aerial", "ground"):
            phases += yaml.safe_load(written.partition("phases: ")[2])
        elif path != "ground.confidence_min":
            text += written + "\n"
    text = text.replace("{spectrum_radius_m: 12.0}", "{spectrum_radius_m: 12.0, confidence_min: 0.9}")
    former.write_text(text + yaml.safe_dump({"phases": phases}))
    scenario = load_scenario(former)
    assert [phase.name for phase in scenario.mission.phases] == ["survey", "search"]
    assert [phase.time_limit_s for phase in scenario.mission.phases] == [600, 500]
    assert scenario.settings[0].altitude_m == 20
    assert scenario.mission.traffic.separation_m == 6
    assert scenario.mission.timing.time_step_s == pytest.approx(0.005)
    assert scenario.mission.identification.spectrum_radius_m == 12


def test_a_former_mission_that_extends_one_of_today(mission: Path) -> None:
    child = mission.with_name("child.yaml")
    child.write_text("extends: recon\nname: child\naerial: {altitude_m: 30.0}\n")
    told = problems_of(child)
    assert list(told) == ["aerial"]
    assert "child.yaml:3 aerial: stands in the phases now" in told["aerial"]
    assert "write phases: {survey: {settings: {altitude_m: 30.0}}}" in told["aerial"]
    child.write_text("extends: recon\nname: child\nphases: {survey: {settings: {altitude_m: 30.0}}}\n")
    assert load_scenario(child).settings[0].altitude_m == 30


@pytest.mark.parametrize(
    ("override", "now"),
    [
        ("aerial.altitude_m=30", "phases.survey.settings.altitude_m"),
        ("aerial.policy=orbit", "phases.survey.policy"),
        ("aerial.time_limit_s=30", "phases.survey.time_limit_s"),
        ("aerial.separation_m=3", "traffic.separation_m"),
        ("ground.laps=2", "phases.search.settings.laps"),
        ("ground.spectrum_radius_m=9", "identification.spectrum_radius_m"),
        ("ground.confidence_min=0.5", "identification.confidence_min"),
    ],
)
def test_a_former_override_says_where_its_value_stands_now(mission: Path, override: str, now: str) -> None:
    path, _, value = override.partition("=")
    told = problems_of(mission, override)
    assert list(told) == [path]
    assert f"--set {path}: is now {now}\n" in told[path]
    assert f"write --set {now}={value}" in told[path]


def test_a_former_time_step_is_written_as_physics_steps(mission: Path) -> None:
    told = problems_of(mission, "time_step_s=0.002")
    assert "is now timing.physics_steps" in told["time_step_s"]
    assert "write --set timing.physics_steps=5" in told["time_step_s"]
    assert load_scenario(mission, ["timing.physics_steps=5"]).mission.timing.time_step_s == pytest.approx(0.002)


def test_a_former_override_finds_the_phase_by_its_policy(mission: Path) -> None:
    spoil(mission, "name: survey", "name: mow")
    spoil(mission, "after: survey", "after: mow")
    assert "is now phases.mow.settings.altitude_m" in problems_of(mission, "aerial.altitude_m=30")["aerial.altitude_m"]
