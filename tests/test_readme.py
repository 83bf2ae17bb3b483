"""What the README shows is run as it stands."""

import re
import sys
from pathlib import Path

import pytest
import yaml

from swarmsim.config.files import packaged_dir
from swarmsim.config.load import load_named
from swarmsim.config.scenario import load_scenario

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README.read_text(encoding="utf-8"), re.S)
PYTHON = [text for language, text in BLOCKS if language == "python"]
CONFIGURATIONS = {"nuclides": "Zn-65", "detectors": "nai_1x1", "vehicles": "heavy_t650"}


def test_the_python_example_flies_and_steps(capsys):
    exec(compile(PYTHON[0], str(README), "exec"), {})
    said = capsys.readouterr().out
    assert "Co-60" in said
    assert "4.5" in said  # 50 ticks of 0.09 s


def test_the_policy_example_plans_crosswise(monkeypatch):
    from swarmsim.policies.registry import _policies

    names: dict = {}
    try:
        exec(compile(PYTHON[1], str(README), "exec"), names)
        assert names["scenario"].mission.aerial.policy == "crosswise_lines"
        assert _policies["aerial"]["crosswise_lines"] is names["crosswise_lines"]
    finally:
        _policies["aerial"].pop("crosswise_lines", None)


@pytest.mark.parametrize("kind", CONFIGURATIONS)
def test_the_added_files_are_found_and_valid(kind, tmp_path, monkeypatch):
    texts = [text for language, text in BLOCKS if language == "yaml"]
    text = next(t for t in texts if yaml.safe_load(t)["name"] == CONFIGURATIONS[kind])
    assert len(text.splitlines()) < 20
    folder = tmp_path / "configs" / kind
    folder.mkdir(parents=True)
    (folder / f"{CONFIGURATIONS[kind]}.yaml").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert load_named(kind, CONFIGURATIONS[kind]).name == CONFIGURATIONS[kind]


def test_an_added_vehicle_joins_a_team(tmp_path, monkeypatch):
    text = next(t for language, t in BLOCKS if language == "yaml" and "heavy_t650" in t)
    folder = tmp_path / "configs" / "vehicles"
    folder.mkdir(parents=True)
    (folder / "heavy_t650.yaml").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    scenario = load_scenario("recon", ["vehicles.0.type=heavy_t650"])
    assert scenario.vehicles[0].mass_kg == 4.2


def test_examples_are_short():
    for _, text in BLOCKS:
        assert len(text.splitlines()) <= 26


def test_the_folders_named_exist():
    root = packaged_dir().parent
    for name in ("swarmsim", "configs", "experiments", "tests"):
        assert (root / name).is_dir()
    assert sys.version_info >= (3, 11)
