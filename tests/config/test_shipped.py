"""Every configuration that the package carries is valid, and its schema says so too."""

from dataclasses import replace
from pathlib import Path

import pytest
from pydantic import TypeAdapter

from swarmsim.cli.files import kind_of_file
from swarmsim.config.catalogue import MODELS
from swarmsim.config.files import KINDS, packaged_dir
from swarmsim.config.load import load_named, read_document
from swarmsim.config.scenario import load_scenario
from swarmsim.config.site_checks import check_site
from swarmsim.config.vehicles import Multirotor

MISSIONS = sorted(path.stem for path in (packaged_dir() / "missions").glob("*.yaml"))
FILES = sorted(path for kind in KINDS for path in (packaged_dir() / kind).rglob("*.yaml"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(packaged_dir())))
def test_a_shipped_file_is_valid(path: Path) -> None:
    kind = path.relative_to(packaged_dir()).parts[0]
    model = load_named(kind, path)
    assert model.name == (path.parent.name if kind == "sites" else path.stem)
    schema = TypeAdapter(MODELS[kind]).json_schema()
    properties = schema.get("properties") or schema["$defs"][type(model).__name__]["properties"]
    assert set(read_document(path, kind).data) <= set(properties)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(packaged_dir())))
def test_the_kind_of_a_shipped_file_is_told_from_its_fields(path: Path, tmp_path: Path) -> None:
    kind = path.relative_to(packaged_dir()).parts[0]
    copy = tmp_path / "file.yaml"
    copy.write_bytes(path.read_bytes())
    assert kind_of_file(copy) == kind


@pytest.mark.parametrize("name", MISSIONS)
def test_a_shipped_mission_resolves_fits_its_site_and_is_read_back(name: str, tmp_path: Path) -> None:
    scenario = load_scenario(name)
    assert scenario.mission.name == name
    assert len(scenario.vehicles) == len(scenario.members)
    assert check_site(scenario) == []
    written = tmp_path / "scenario.yaml"
    written.write_text(scenario.to_yaml(), encoding="utf-8")
    again = load_scenario(written)
    assert again.settings == scenario.settings
    assert again.mission.phases == scenario.mission.phases
    assert replace(again, mission=scenario.mission) == scenario
    assert again.to_yaml() == scenario.to_yaml()


def test_the_paper_mission_differs_in_detector_background_and_knowledge_only() -> None:
    physical, paper = load_scenario("recon").mission, load_scenario("recon_paper").mission
    assert paper.detection == "paper_ideal"
    assert paper.background == physical.background.model_copy(update={"ground_share": 0.0})
    assert paper.knowledge.site == "exact"
    assert paper.knowledge.pose_std_m == paper.knowledge.sensitivity_std == 0.0
    changes = {"name": "recon_paper", "detection": "paper_ideal", "background": paper.background}
    changes |= {"knowledge": paper.knowledge, "description": paper.description}
    assert paper == physical.model_copy(update=changes)


def test_the_mixed_mission_has_three_types_of_uav_and_overlapping_phases() -> None:
    scenario = load_scenario("mixed")
    rotors = [len(vehicle.rotors) for vehicle in scenario.vehicles if isinstance(vehicle, Multirotor)]
    assert rotors == [4, 4, 4, 6]
    assert [vehicle.kind for vehicle in scenario.vehicles].count("skid_steer") == 2
    assert [phase.start.when for phase in scenario.mission.phases] == [None, None, "hotspot", None, None]


def test_the_swarm_is_two_hundred_vehicles_in_one_entry() -> None:
    scenario = load_scenario("swarm")
    assert len(scenario.members) == 200
    assert len(scenario.mission.vehicles) == 1
    assert scenario.phase_members == (tuple(range(200)),)
