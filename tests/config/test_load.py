"""Finding, composing and overriding configurations."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swarmsim.config import files
from swarmsim.config.bare import bare_scenario
from swarmsim.config.documents import Mark
from swarmsim.config.errors import InputError, Problem
from swarmsim.config.load import load_all, load_model, load_named, read_document
from swarmsim.config.mission import Mission, Trigger
from swarmsim.config.names import did_you_mean, nearest
from swarmsim.config.policies import ParallelLines, line_spacing
from swarmsim.config.scenario import load_scenario, scenario_of
from swarmsim.config.values import with_values
from swarmsim.config.vehicles import Multirotor, Vehicle
from tests.config.project import line_of, spoil


def test_a_problem_reads_as_a_block() -> None:
    problem = Problem("is too small", "a.yaml", 3, "x.y", "-1", "a number at least 0", "try 1")
    assert str(problem) == (
        "a.yaml:3 x.y: is too small\n    given:   -1\n    allowed: a number at least 0\n    hint:    try 1"
    )
    assert str(Problem("alone")) == "alone"
    error = InputError.of("gone", file=Path("b.yaml"))
    assert error.problems == (Problem("gone", "b.yaml"),)
    with pytest.raises(ValueError, match="at least one"):
        InputError([])


def test_nearest_names() -> None:
    assert nearest("co60", ["Cs-137", "Co-60", "Co-57"]) == "Co-60"
    assert did_you_mean("zebra", ["Cs-137", "Co-60"]) is None


def test_the_working_folder_comes_before_the_package(mission: Path) -> None:
    assert files.available("missions")["recon"].resolve() == mission
    assert files.config_dirs()[-1] == files.packaged_dir()


def test_the_working_folder_overrides_a_vehicle_of_a_packaged_mission(
    mission: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packaged = mission.parents[1].rename(tmp_path / "_configs")
    monkeypatch.setattr(files, "packaged_dir", lambda: packaged)
    own = tmp_path / "configs" / "vehicles" / "orpheus.yaml"
    own.parent.mkdir(parents=True)
    own.write_text((packaged / "vehicles" / "orpheus.yaml").read_text())
    assert load_scenario("recon").vehicles[3].mass_kg == 51.0
    spoil(own, "mass_kg: 51.0", "mass_kg: 61.0")
    assert load_scenario("recon").vehicles[3].mass_kg == 61.0


def test_names_beside_a_mission_file_are_found_from_anywhere(
    mission: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicles = mission.parents[1] / "vehicles"
    (vehicles / "mine.yaml").write_text((vehicles / "tarot_t650.yaml").read_text())
    spoil(vehicles / "mine.yaml", "name: tarot_t650", "name: mine")
    spoil(mission, "type: tarot_t650", "type: mine")
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    assert load_scenario(mission).vehicles[0].name == "mine"


def test_a_mission_extends_another_deeply(mission: Path) -> None:
    child = mission.with_name("child.yaml")
    child.write_text("extends: recon_paper\nname: child\nmapping: {cell_m: 3.0}\nsources: []\n")
    parent, loaded = load_model(mission, Mission), load_model(child, Mission)
    assert loaded.detection == "paper_ideal"
    assert loaded.mapping == parent.mapping.model_copy(update={"cell_m": 3.0})
    assert loaded.sources == ()
    assert loaded.vehicles == parent.vehicles


def test_a_mission_changes_named_items_of_the_one_that_it_extends(mission: Path) -> None:
    child = mission.with_name("child.yaml")
    child.write_text(
        "extends: recon\nname: child\n"
        "vehicles: {uav2: {heading_deg: 90.0}}\n"
        "phases:\n  survey: {settings: {altitude_m: 30.0}}\n  search: {time_limit_s: 300.0}\n"
    )
    scenario = load_scenario(child)
    assert [member.heading_deg for member in scenario.members] == [0, 90, 0, 0]
    assert scenario.settings[0].altitude_m == 30
    assert scenario.settings[0].speed_m_s == 2.5
    assert [phase.time_limit_s for phase in scenario.mission.phases] == [600, 300]
    spoil(child, "altitude_m: 30.0", "altitude_m: 0.0")
    spoil(child, "heading_deg: 90.0", "heading_deg: 900.0")
    with pytest.raises(InputError) as caught:
        load_scenario(child)
    assert {(p.path, p.file, p.line) for p in caught.value.problems} == {
        ("vehicles.1.heading_deg", "configs/missions/child.yaml", 3),
        ("phases.0.settings.altitude_m", "configs/missions/child.yaml", 5),
    }
    spoil(child, "survey:", "surwey:")
    with pytest.raises(InputError, match=r"child\.yaml:5 phases\.surwey: there is no item 'surwey' to change"):
        load_scenario(child)


def test_a_value_keeps_the_file_and_line_where_it_stands(mission: Path) -> None:
    child = mission.with_name("child.yaml")
    child.write_text("extends: recon.yaml\nname: child\n\nwind: {speed_m_s: 99}\n")
    spoil(mission, "cell_m: 2.0", "cell_m: -1")
    with pytest.raises(InputError) as caught:
        load_model(child, Mission)
    assert {(p.path, p.file, p.line) for p in caught.value.problems} == {
        ("wind.speed_m_s", "configs/missions/child.yaml", 4),
        ("mapping.cell_m", "configs/missions/recon.yaml", line_of(mission, "cell_m")),
    }


def test_a_longer_cycle_of_extends_is_told(mission: Path) -> None:
    for name, other in (("a", "b"), ("b", "c"), ("c", "a")):
        mission.with_name(f"{name}.yaml").write_text(f"extends: {other}\nname: {name}\n")
    with pytest.raises(InputError, match="extends itself: a -> b -> c -> a"):
        load_scenario("a")


def test_a_vehicle_extends_another(mission: Path) -> None:
    path = mission.parents[1] / "vehicles" / "heavy.yaml"
    path.write_text("extends: tarot_t650\nname: heavy\nmass_kg: 4.5\n")
    base, heavy = load_named("vehicles", "tarot_t650"), load_named("vehicles", "heavy")
    sources = base.sources | {"mass_kg": "heavy.yaml gives no source"}
    assert heavy == base.model_copy(update={"name": "heavy", "mass_kg": 4.5, "sources": sources})
    assert isinstance(load_model(path, Vehicle), Multirotor)


@pytest.mark.parametrize(
    ("changes", "cited", "gone"),
    [
        ("mass_kg: 4.5\nsources: {mass_kg: weighed}", {"mass_kg": "weighed"}, ()),
        ("rotor: {radius_m: 0.2}", {"rotor.radius_m": "child.yaml gives no source"}, ()),
        ("rotor: {radius_m: 0.2}\nsources: {rotor: data sheet}", {"rotor": "data sheet"}, ("rotor.radius_m",)),
        ("feet: {friction: 0.123}", {"feet.friction": "child.yaml gives no source"}, ()),
        ("rotor: {solidity: null}", {}, ("rotor.solidity",)),
        (
            "inertia_kg_m2: [0.1, 0.1, 0.18]\nsources: {inertia_kg_m2.2: a swing}",
            {"inertia_kg_m2.2": "a swing", "inertia_kg_m2": "child.yaml gives no source"},
            (),
        ),
    ],
)
def test_an_inherited_source_is_not_that_of_a_changed_value(
    changes: str, cited: dict[str, str], gone: tuple[str, ...], mission: Path
) -> None:
    folder = mission.parents[1] / "vehicles"
    (folder / "child.yaml").write_text(f"extends: tarot_t650\nname: child\n{changes}\n")
    base, child = load_named("vehicles", "tarot_t650"), load_named("vehicles", "child")
    expected = {path: text for path, text in (base.sources | cited).items() if path not in gone}
    assert child.sources == expected
    (folder / "grandchild.yaml").write_text("extends: child\nname: grandchild\ncollision_radius_m: 0.6\n")
    last = load_named("vehicles", "grandchild").sources
    assert last == expected | {"collision_radius_m": "grandchild.yaml gives no source"}


def test_a_value_that_is_stated_again_keeps_its_source(mission: Path) -> None:
    folder, base = mission.parents[1] / "vehicles", load_named("vehicles", "tarot_t650")
    (folder / "same.yaml").write_text(f"extends: tarot_t650\nname: same\nmass_kg: {base.mass_kg}\n")
    assert load_named("vehicles", "same").sources == base.sources


def test_a_detector_and_a_nuclide_do_not_pass_on_sources_of_what_was_changed(mission: Path) -> None:
    folder = mission.parents[1]
    spoil(
        folder / "detectors" / "nai_1p5x1p5.yaml", "{all: made up for the tests}", "{length_mm: made up, housing: so}"
    )
    (folder / "detectors" / "thin.yaml").write_text("extends: nai_1p5x1p5\nname: thin\nlength_mm: 5.0\n")
    (folder / "nuclides" / "Co-60m.yaml").write_text("extends: Co-60\nname: Co-60m\nhalf_life_s: 628.0\n")
    thin, base = load_named("detectors", "thin"), load_named("detectors", "nai_1p5x1p5")
    assert thin.sources == base.sources | {"length_mm": "thin.yaml gives no source"}
    short, long = load_named("nuclides", "Co-60m"), load_named("nuclides", "Co-60")
    assert short.source == f"Co-60m.yaml gives no source of half_life_s; the rest: {long.source}"


def test_an_override_of_a_definition_is_not_cited_as_what_it_replaces(mission: Path) -> None:
    detector = mission.parents[1] / "detectors" / "nai_1p5x1p5.yaml"
    spoil(detector, "{all: made up for the tests}", "{dead_time: made up}")
    mass = "definitions.vehicles.tarot_t650.mass_kg=4.2"
    dead = "definitions.detectors.nai_1p5x1p5.dead_time={model: paralyzable, paralyzable_us: 8}"
    half_life = "definitions.nuclides.Co-60.half_life_s=1e3"
    scenario = load_scenario("recon", [mass, dead, half_life])
    assert scenario.vehicles[0].sources["mass_kg"] == "--set gives no source"
    assert scenario.detectors["nai_1p5x1p5"].sources["dead_time"] == "--set gives no source"
    assert scenario.nuclides["Co-60"].source.startswith("--set gives no source of half_life_s; the rest: ")
    assert "--set gives no source" in scenario.to_yaml()
    weighed = load_scenario("recon", [mass, "definitions.vehicles.tarot_t650.sources.mass_kg=weighed"])
    assert weighed.vehicles[0].sources["mass_kg"] == "weighed"


def test_a_mission_that_changes_a_definition_of_the_one_it_extends_does_not_pass_on_its_source(mission: Path) -> None:
    resolved, child = mission.with_name("resolved.yaml"), mission.with_name("child.yaml")
    resolved.write_text(load_scenario("recon").to_yaml().replace("name: recon", "name: resolved", 1))
    child.write_text("extends: resolved\nname: child\ndefinitions: {vehicles: {tarot_t650: {mass_kg: 4.2}}}\n")
    assert load_scenario("child").vehicles[0].sources["mass_kg"] == "child.yaml gives no source"


def test_overrides_change_values_by_field_index_and_name(mission: Path) -> None:
    changed = load_scenario(
        "recon",
        [
            "phases.survey.settings.altitude_m=30",
            "sources.0.activity_mbq=5e1",
            "vehicles.uav2.heading_deg=90",
            "phases.0.settings.line_spacing_m=12",
            "phases.0.settings.area_m=[[-50, -40], [50, -40], [50, 40]]",
            "phases.search.start={after: survey, delay_s: 5}",
            "wind.gusts=false",
        ],
        seed=7,
    )
    survey = changed.settings[0]
    assert isinstance(survey, ParallelLines)
    assert (survey.altitude_m, line_spacing(survey)) == (30, 12)
    assert survey.area_m == ((-50, -40), (50, -40), (50, 40))
    changed = changed.mission
    assert changed.phases[0].settings["altitude_m"] == 30
    assert changed.phases[1].start == Trigger(after="survey", delay_s=5)
    assert changed.sources[0].activity_mbq == 50
    assert [member.heading_deg for member in changed.vehicles] == [0, 90, 0, 0]
    assert not changed.wind.gusts
    assert changed.seed == 7


def test_an_override_is_told_as_such(mission: Path) -> None:
    document = read_document(mission, "missions", ["sources.0={nuclide: Cs-137}"])
    assert document.mark(("sources", 0, "nuclide")) == Mark("--set", None)
    assert document.mark(("sources",)) == Mark("configs/missions/recon.yaml", line_of(mission, "sources:"))


def test_a_value_given_in_python_is_told_as_such(mission: Path) -> None:
    scenario = load_scenario("recon")
    with pytest.raises(InputError, match=r"^values wind\.speed_m_s: is too large"):
        with_values(scenario, {"wind.speed_m_s": 99})
    with pytest.raises(InputError, match=r"^values wind\.sped_m_s: wind has no field 'sped_m_s'"):
        with_values(scenario, {"wind.sped_m_s": 9})


def test_an_override_reaches_into_a_vehicle(mission: Path) -> None:
    scenario = load_scenario("recon", ["definitions.vehicles.tarot_t650.mass_kg=4.0"])
    assert scenario.vehicles[0].mass_kg == 4.0
    base = load_named("vehicles", "tarot_t650")
    sources = base.sources | {"mass_kg": "--set gives no source"}
    assert scenario.vehicles[0] == base.model_copy(update={"mass_kg": 4.0, "sources": sources})
    assert scenario.vehicles[3] == load_named("vehicles", "orpheus")


def test_an_override_reaches_into_a_material(mission: Path) -> None:
    scenario = load_scenario("recon", ["definitions.materials.concrete.density_kg_m3=1000"])
    assert scenario.materials["concrete"].density_kg_m3 == 1000
    assert scenario.materials["brick"] == load_named("materials", "brick")
    assert "density_kg_m3: 1000" in scenario.to_yaml()


def test_an_override_leaves_a_body_beside_its_vehicle(mission: Path) -> None:
    vehicles = mission.parents[1] / "vehicles"
    (vehicles / "body.urdf").write_text("<robot name='r'/>")
    orpheus = vehicles / "orpheus.yaml"
    orpheus.write_text(orpheus.read_text() + "\nbody: {file: body.urdf}\n")
    scenario = load_scenario("recon", ["definitions.vehicles.orpheus.mass_kg=60"])
    assert scenario.vehicles[3].body is not None
    assert Path(scenario.vehicles[3].body.file) == vehicles / "body.urdf"


def test_what_an_autopilot_flies_keeps_the_materials_of_the_mission(mission: Path) -> None:
    site = mission.parents[1] / "sites" / "works_yard" / "site.yaml"
    site.write_text(site.read_text() + "ground_material: mud\n")
    mud = "{name: mud, density_kg_m3: 1500, composition: {O: 0.5, Si: 0.5}, source: made up for the test}"
    whole = load_scenario("recon", [f"definitions.materials={{mud: {mud}}}"])
    assert bare_scenario(whole, [0], "bare", whole.mission.timing).site.ground_material == "mud"


def test_a_library_without_air_is_told(mission: Path) -> None:
    written = mission.with_name("written.yaml")
    written.write_text(load_scenario("recon").to_yaml(), encoding="utf-8")
    spoil(written, "    air:\n      name: air\n", "    gas:\n      name: gas\n")
    with pytest.raises(InputError, match="what lies between obstacles is of a material 'air' that does not exist"):
        load_scenario(written)


def test_the_area_is_turned_counter_clockwise(mission: Path) -> None:
    scenario = load_scenario("recon", ["phases.survey.settings.area_m=[[0, 0], [0, 9], [9, 9], [9, 0]]"])
    assert scenario.settings[0].area_m == ((9, 0), (9, 9), (0, 9), (0, 0))


def test_zero_activity_and_no_sources_are_missions(mission: Path) -> None:
    assert load_scenario("recon", ["sources.0.activity_mbq=0"]).mission.sources[0].activity_mbq == 0
    assert load_scenario("recon", ["sources=[]"]).mission.sources == ()


def test_a_body_file_is_found_beside_its_vehicle(mission: Path) -> None:
    vehicles = mission.parents[1] / "vehicles"
    (vehicles / "body.urdf").write_text("<robot name='r'/>")
    orpheus = vehicles / "orpheus.yaml"
    orpheus.write_text(orpheus.read_text() + "\nbody: {file: body.urdf}\n")
    assert Path(load_named("vehicles", "orpheus").body.file) == vehicles / "body.urdf"


def test_a_scenario_written_out_is_the_same_scenario(mission: Path) -> None:
    scenario = load_scenario("recon_paper", ["definitions.vehicles.tarot_t650.mass_kg=4.0"], seed=3)
    written = mission.parents[2] / "runs" / "one" / "scenario.yaml"
    written.parent.mkdir(parents=True)
    written.write_text(scenario.to_yaml(), encoding="utf-8")
    spoil(mission.parents[1] / "vehicles" / "orpheus.yaml", "mass_kg: 51.0", "mass_kg: 61.0")
    (mission.parents[1] / "nuclides" / "Zz-1.yaml").write_text("not: valid\n")
    again = load_scenario(written)
    assert again == replace(scenario, mission=again.mission)
    assert again.vehicles == scenario.vehicles
    assert again.detectors == scenario.detectors
    assert again.nuclides == scenario.nuclides
    assert again.materials == scenario.materials
    dropped = {"definitions", "versions"}
    assert again.mission.model_dump(exclude=dropped) == scenario.mission.model_dump(exclude=dropped)
    assert again.mission.versions == scenario.versions()
    assert again.to_yaml() == scenario.to_yaml()


def test_a_mission_made_in_python_is_checked_too(mission: Path) -> None:
    made = load_model(mission, Mission)
    assert scenario_of(made).vehicles == load_scenario("recon").vehicles
    with pytest.raises(InputError, match="no site 'nowhere'"):
        scenario_of(made.model_copy(update={"site": "nowhere"}))


def test_every_broken_file_of_a_kind_is_told(mission: Path) -> None:
    nuclides = mission.parents[1] / "nuclides"
    for name in ("Co-60", "Cs-137"):
        spoil(nuclides / f"{name}.yaml", "half_life_s", "halflife_s")
    with pytest.raises(InputError) as caught:
        load_all("nuclides")
    assert {Path(p.file).stem for p in caught.value.problems if p.file} == {"Co-60", "Cs-137"}


@pytest.mark.parametrize("name", [None, 3, b"recon", ["recon"], object()])
def test_what_cannot_name_a_mission(mission: Path, name: Any) -> None:
    with pytest.raises(InputError, match="a mission is named by a text or a path"):
        load_scenario(name)


@pytest.mark.parametrize("overrides", [None, 3, "seed=3", b"seed=3", [b"seed=3"], [3], ["seed=3", None]])
def test_what_are_no_overrides(mission: Path, overrides: Any) -> None:
    with pytest.raises(InputError, match="are no overrides"):
        load_scenario("recon", overrides)


CIRCLE: list[Any] = []
CIRCLE.append(CIRCLE)


@pytest.mark.parametrize(
    "value", [{None: 1}, {"uniform": {1: 2}}, [{(1, 2): 3}], b"x", {1, 2}, 1j, object(), Path("x"), CIRCLE]
)
def test_what_is_no_value(mission: Path, value: Any) -> None:
    with pytest.raises(InputError, match=r"^values sources: is no value of a configuration"):
        with_values(load_scenario("recon"), {"sources": value})


def test_arrays_within_a_value_are_lists(mission: Path) -> None:
    value = [np.float32(1.0), np.array(2.0)]
    assert with_values(load_scenario("recon"), {"sources.0.position_m": value}).mission.sources[0].position_m == (1, 2)


def test_what_is_no_mission(mission: Path) -> None:
    for given in (None, {"name": "x"}, "recon"):
        with pytest.raises(InputError, match="is no mission"):
            scenario_of(given)  # type: ignore[arg-type]
    made = load_model(mission, Mission)
    with pytest.raises(InputError, match="versions: a field's name must be a text"):
        scenario_of(made.model_copy(update={"versions": {None: "1.0"}}))
    with pytest.raises(InputError, match="sources: is not a list"):
        scenario_of(made.model_copy(update={"sources": {"x": 1}}))
