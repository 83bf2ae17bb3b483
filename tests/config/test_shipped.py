"""Every configuration that the package carries is valid, and its schema says so too."""

from pathlib import Path

import pytest
from pydantic import TypeAdapter

from swarmsim.cli_files import kind_of_file
from swarmsim.config.catalogue import MODELS
from swarmsim.config.files import KINDS, packaged_dir
from swarmsim.config.load import load_named, read_document
from swarmsim.config.scenario import load_scenario

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


@pytest.mark.parametrize("name", sorted(path.stem for path in (packaged_dir() / "missions").glob("*.yaml")))
def test_a_shipped_mission_resolves(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.mission.name == name
    assert len(scenario.vehicles) == len(scenario.mission.vehicles)


def test_the_paper_mission_differs_in_the_detector_only() -> None:
    physical, paper = load_scenario("recon").mission, load_scenario("recon_paper").mission
    assert paper.detection == "paper_ideal"
    assert paper == physical.model_copy(update={"name": "recon_paper", "detection": "paper_ideal"})
