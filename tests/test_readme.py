"""What the README shows is run as it stands."""

import re
import shlex
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml

import swarmsim
from swarmsim.cli.files import kind_of_file
from swarmsim.config.files import packaged_dir
from swarmsim.config.load import load_named
from swarmsim.config.scenario import load_scenario

pytestmark = pytest.mark.optimised

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README.read_text(encoding="utf-8"), re.S)
PYTHON = [text for language, text in BLOCKS if language == "python"]
CLIMBING = next(text for language, text in BLOCKS if language == "yaml" and "climb.py:Climb" in text)
SWEEP = next(text for text in PYTHON if "swarmsim.run(" in text)
CONFIGURATIONS = {"nuclides": "Y-88", "detectors": "nai_1x1", "vehicles": "heavy_t650"}


def test_the_python_example_flies_and_steps(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(PYTHON[0], str(README), "exec"), {})
    said = capsys.readouterr().out
    assert "Co-60" in said
    assert "4.0" in said  # 400 ticks of 0.01 s
    assert (tmp_path / "runs" / "by_hand" / "summary.json").is_file()


@pytest.mark.slow
def test_the_policy_example_climbs_towards_the_source(tmp_path):
    policy = next(text for text in PYTHON if "class Climb" in text)
    (tmp_path / "climb.py").write_text(policy, encoding="utf-8")
    mission = tmp_path / "climb.yaml"
    mission.write_text(CLIMBING, encoding="utf-8")
    simulation = swarmsim.build(swarmsim.load(mission))
    batch = simulation.rollout(range(8))
    ends = []
    for index in range(8):
        record = swarmsim.mission_record(simulation, batch, index)
        assert not record.vehicles[0].crashed
        ends.append(np.linalg.norm(record.vehicles[0].position_m[-1, :2] - record.sources[0].position_m[:2]))
    assert np.median(ends) < 25.0  # from 60 m away


def test_the_sweep_runs_a_scenario_for_each_value(monkeypatch):
    ran = {}

    def run(scenario, out, missions):
        ran[out] = (scenario.mission.knowledge.pose_std_m, missions)
        return ()

    monkeypatch.setattr(swarmsim, "run", run)
    exec(compile(SWEEP, str(README), "exec"), {})
    assert ran == {f"runs/pose_{std}": (std, 2) for std in (0.02, 0.1, 0.5)}


def test_the_study_of_dead_time_is_read():
    shown = next(text for language, text in BLOCKS if language == "sh" and "dead_time" in text)
    _, _, name, *options = shlex.split(shown.replace("\\\n", " "))
    scenario = load_scenario(name, [value for option, value in pairwise(options) if option == "--set"])
    assert scenario.detectors["nai_2x2"].dead_time.paralyzable_us == 10.0
    assert [varied.path for varied in scenario.family] == ["sources.0.activity_mbq"]


def test_the_phases_shown_are_read(tmp_path):
    shown = next(text for language, text in BLOCKS if language == "yaml" and "name: survey" in text)
    rest = yaml.safe_load((packaged_dir() / "missions" / "recon.yaml").read_text(encoding="utf-8"))
    rest["vehicles"][3]["name"] = "rover"
    path = tmp_path / "shown.yaml"
    path.write_text(yaml.safe_dump(rest | yaml.safe_load(shown)), encoding="utf-8")
    assert [phase.name for phase in swarmsim.load(path).mission.phases] == ["survey", "look"]


def test_the_family_shown_is_read(tmp_path):
    shown = next(text for language, text in BLOCKS if language == "yaml" and "random_yard" in text)
    path = tmp_path / "random_yard.yaml"
    path.write_text(shown, encoding="utf-8")
    assert swarmsim.load(path).family
    assert kind_of_file(path) == "missions"


@pytest.mark.parametrize("kind", CONFIGURATIONS)
def test_the_added_files_are_found_and_valid(kind, tmp_path, monkeypatch):
    texts = [text for language, text in BLOCKS if language == "yaml"]
    text = next(t for t in texts if yaml.safe_load(t).get("name") == CONFIGURATIONS[kind])
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
        assert len(text.splitlines()) <= 30


def test_the_folders_named_exist():
    root = packaged_dir().parent
    for name in ("swarmsim", "configs", "experiments", "tests"):
        assert (root / name).is_dir()
    assert sys.version_info >= (3, 11)
