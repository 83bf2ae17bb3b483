"""Malformed scenarios: each must give the message that a user needs, with its file, line and remedy."""

from pathlib import Path

import pytest

from swarmsim.config.errors import InputError
from swarmsim.config.load import load_model
from swarmsim.config.mission import Mission
from swarmsim.config.scenario import load_scenario
from swarmsim.config.vehicles import Vehicle
from tests.config.project import line_of, spoil

# One edit of recon.yaml each: what is replaced, by what, and fragments of the message. "@text" stands for the place
# ``configs/missions/recon.yaml:LINE`` of that text in the spoilt file.
EDITS = {
    "unknown field": ("seed: 0", "sead: 0", ["@sead", "no field 'sead'", "did you mean 'seed'", "timing"]),
    "unknown nested field": (
        "  altitude_m: 20.0",
        "  altitude: 20.0",
        [
            "@  altitude:",
            "phases.0.settings.altitude:",
            "did you mean 'altitude_m'",
            "phases.0.settings.altitude_m: this field is missing",
        ],
    ),
    "missing field": ("site: works_yard\n", "", ["recon.yaml:3 site: this field is missing", "a name of letters"]),
    "misspelt section": (
        "mapping: {cell_m: 2.0,",
        "maping: {cell_m: 2.0,",
        ["@maping", "no field 'maping'", "did you mean 'mapping'"],
    ),
    "too small": (
        "activity_mbq: 170.0",
        "activity_mbq: -1",
        ["@- {nuclide", "given:   -1", "a number from 0 to 1e+09"],
    ),
    "too large": (
        "altitude_m: 20.0",
        "altitude_m: 2000",
        ["@altitude_m", "is too large", "given:   2000", "greater than 1 and at most 200"],
    ),
    "zero where positive": ("window_s: 1.0", "window_s: 0", ["@window_s", "is too small", "from 0.001 to 3600"]),
    "word for a number": (
        "speed_m_s: 2.5",
        "speed_m_s: fast",
        ["@speed_m_s: fast", "is not a number", "given:   fast"],
    ),
    "number with a unit": ("speed_m_s: 2.5", "speed_m_s: 2.5 m/s", ["given:   2.5 m/s", "unit stands in the field"]),
    "decimal comma": ("altitude_m: 20.0", 'altitude_m: "20,5"', ["given:   20,5", "decimal point"]),
    "letter in a number": ("altitude_m: 20.0", "altitude_m: 2O.0", ["@altitude_m", "is not a number", "given:   2O.0"]),
    "boolean for a number": ("altitude_m: 20.0", "altitude_m: true", ["is not a number", "given:   true"]),
    "not a number": ("altitude_m: 20.0", "altitude_m: .nan", ["is not a finite number", "given:   nan"]),
    "infinite": ("time_limit_s: 600.0", "time_limit_s: .inf", ["is not a finite number", "given:   inf"]),
    "null": (
        "altitude_m: 20.0",
        "altitude_m:",
        ["phases.0.settings.altitude_m", "is not a number", "given:   nothing"],
    ),
    "fraction for a count": (
        "sources_max: 4",
        "sources_max: 4.5",
        ["@sources_max", "is not a whole number", "from 1 to 8"],
    ),
    "yes for true": ("gusts: true", "gusts: yes", ["wind.gusts", "true or false", "write true"]),
    "not a choice": ("engine: mjx", "engine: mxj", ["@engine", "one of mjx, analytic", "did you mean 'mjx'"]),
    "number for a name": ("name: recon", "name: 42", ["recon.yaml:3 name: is not a text", 'put it in quotes: "42"']),
    "name with a blank": ("name: recon", "name: my recon", ["is not a valid name", "given:   my recon", "letters"]),
    "empty name": ("name: recon", 'name: ""', ["recon.yaml:3 name: is empty"]),
    "short pair": (
        "position_m: [12.0, 4.0]",
        "position_m: [12.0]",
        ["sources.0.position_m: has too few values", "2 values"],
    ),
    "long pair": ("position_m: [12.0, 4.0]", "position_m: [1, 2, 3]", ["has too many values", "given:   [1, 2, 3]"]),
    "list for a mapping": (
        "wind: {speed_m_s: 2.0, from_deg: 240.0, gusts: true}",
        "wind: [2]",
        ["wind: is not a mapping"],
    ),
    "mapping for a list": (
        "  - {nuclide: Co-60,",
        "  {nuclide: Co-60,",
        ["sources: is not a list", "at most 16 values"],
    ),
    "area of two corners": (
        "      altitude_m",
        "      area_m: [[0, 0], [9, 9]]\n      altitude_m",
        ["phases.0.settings.area_m: has too few", "3 to 32"],
    ),
    "area on a line": (
        "      altitude_m",
        "      area_m: [[0, 0], [9, 9], [18, 18]]\n      altitude_m",
        ["@area_m", "has no area"],
    ),
    "area with a dent": (
        "      altitude_m",
        "      area_m: [[0, 0], [50, 0], [10, 10], [0, 50]]\n      altitude_m",
        ["phases.0.settings.area_m", "not convex"],
    ),
    "area that crosses itself": (
        "      altitude_m",
        "      area_m: [[0, 10], [6, -8], [-9, 3], [9, 3], [-6, -8]]\n      altitude_m",
        ["phases.0.settings.area_m", "crosses itself"],
    ),
    "unknown site": (
        "site: works_yard",
        "site: work_yard",
        ["recon.yaml:5", "no site 'work_yard'", "did you mean 'works_yard'"],
    ),
    "unknown vehicle": (
        "type: tarot_t650",
        "type: tarot_t60",
        ["@tarot_t60,", "vehicles.0.type", "did you mean 'tarot_t650'", "x500"],
    ),
    "unknown nuclide": ("nuclide: Co-60", "nuclide: Co60", ["sources.0.nuclide", "did you mean 'Co-60'", "Cs-137"]),
    "unknown presumed nuclide": (
        "nuclides: [Co-60]",
        "nuclides: [cs-137]",
        ["knowledge.nuclides.0", "did you mean 'Cs-137'"],
    ),
    "same name": ("name: uav2", "name: uav1", ["vehicles.1.name", "vehicles.0 has the same name", "given:   uav1"]),
    "same place": ("[-60.0, -5.0]", "[-60.0, -45.0]", ["vehicles.1.position_m", "'uav2' starts too near to 'uav1'"]),
    "faster than the vehicle": (
        "  speed_m_s: 2.5",
        "  speed_m_s: 30",
        ["phases.0.settings.speed_m_s", "faster than the vehicle type 'tarot_t650' can fly", "at most 8"],
    ),
    "rover too fast": (
        "speed_m_s: 0.9",
        "speed_m_s: 4.5",
        ["phases.1.settings.speed_m_s", "'orpheus' can drive", "at most 2"],
    ),
    "no vehicle": ("vehicles:", "vehicles: []\nteam:", ["vehicles: has too few values", "no field 'team'"]),
    "twice the same field": (
        "seed: 0",
        "seed: 0\nname: other",
        ["recon.yaml:7 name: is given twice, on lines 3 and 7"],
    ),
    "tab": ("      altitude_m", "\taltitude_m", ["@\taltitude_m", "is not valid YAML", "indent with spaces"]),
    "open bracket": ("[12.0, 4.0]", "[12.0, 4.0", ["is not valid YAML", "unclosed bracket"]),
    "two colons": ("site: works_yard", "site: works: yard", ["recon.yaml:5", "is not valid YAML", "second ':'"]),
    "second document": ("seed: 0", "---\nseed: 0", ["@---", "more than one document"]),
    "own tag": ("seed: 0", "seed: !!python/object:os.system 0", ["@seed", "tag that is not understood"]),
    "alias of itself": ("site: works_yard", "site: &a [*a]", ["recon.yaml:5", "an alias refers to the thing"]),
    "extends nothing": (
        "name: recon",
        "extends: reccon_paper\nname: recon",
        ["recon.yaml:3 extends", "did you mean 'recon_paper'"],
    ),
    "extends itself": ("name: recon", "extends: recon\nname: recon", ["recon.yaml:3 extends", "extends itself"]),
    "extends a list": ("name: recon", "extends: [a]\nname: recon", ["extends: is not a name"]),
    "definition under another name": (
        "seed: 0",
        "definitions: {nuclides: {Xx-1: {name: Xx-2, half_life_s: 1.0, source: s,\n"
        "  lines: [{energy_kev: 500.0, yield_percent: 1.0}]}}}",
        ["definitions.nuclides.Xx-1.name", "given:   Xx-2", "allowed: Xx-1"],
    ),
}

# Whole contents of a mission file.
CONTENTS = {
    "empty": (b"", ["bad.yaml: is empty"]),
    "only a comment": (b"# nothing\n", ["bad.yaml: is empty"]),
    "a list": (b"- 1\n", ["bad.yaml:1: is not a mapping", "a list"]),
    "a word": (b"hello\n", ["bad.yaml:1: is not a mapping", "a single value"]),
    "not UTF-8": (b"name: a\nsite: caf\xe9\n", ["bad.yaml:2: is not UTF-8 text", "byte 0xe9"]),
    "a control character": (b"name: a\nsite: \x01\n", ["bad.yaml:2: holds a character"]),
    "no names for fields": (b"~: 2\n[1]: 3\n", ["bad.yaml:1: a field's name must be", "bad.yaml:2: a field's name"]),
    "numbers for names": (b"1: 2\n", ["bad.yaml:1 1: there is no field '1' here", "bad.yaml:1 site: this field is"]),
    "nested without end": (b"a: " + b"[" * 5000, ["bad.yaml:1: is nested too deeply"]),
    "huge": (b"#" * 5_000_000, ["bad.yaml: is too large", "5.0 MB", "at most 1 MB"]),
}

OVERRIDES = {
    "unknown field": ("wind.sped_m_s=3", ["--set wind.sped_m_s", "did you mean 'speed_m_s'"]),
    "unknown section": ("mappin.cell_m=3", ["--set mappin", "the top level has no field", "did you mean 'mapping'"]),
    "no equals sign": ("wind.speed_m_s", ["--set: is not of the form path=value", "given:   wind.speed_m_s"]),
    "empty step": ("wind..speed_m_s=3", ["not of the form path=value"]),
    "index too large": ("sources.3.activity_mbq=1", ["--set sources.3", "an index from 0 to 0"]),
    "unknown item": ("vehicles.uav9.heading_deg=1", ["no item 'uav9'", "uav1, uav2, uav3, orpheus"]),
    "inside a number": ("seed.x=1", ["--set seed.x", "has nothing inside"]),
    "bad value": (
        "phases.survey.settings.altitude_m=high",
        ["--set phases.0.settings.altitude_m: is not a number", "given:   high", "at most 200"],
    ),
    "bad YAML": ("phases.0.settings.area_m=[[1,", ["--set phases.0.settings.area_m", "is not valid YAML"]),
    "unknown name": ("site=mars", ["--set site: there is no site 'mars'"]),
    "unknown definition": (
        "definitions.vehicles.x600.mass_kg=1",
        ["there is no vehicle 'x600'", "did you mean 'x500'"],
    ),
    "unknown material": (
        "definitions.materials.concret.density_kg_m3=2000",
        [
            "--set definitions.materials.concret.density_kg_m3: there is no material 'concret'",
            "did you mean 'concrete'",
        ],
    ),
    "bad material": (
        "definitions.materials.concrete.density_kg_m3=-1",
        ["--set definitions.materials.concrete.density_kg_m3: is too small"],
    ),
    "definition with a path": (
        "definitions.vehicles./etc/passwd.mass_kg=1",
        ["--set definitions.vehicles./etc/passwd.mass_kg: there is no vehicle '/etc/passwd'"],
    ),
    "definition of what the team has not": (
        "definitions.vehicles.husky.mass_kg=60",
        ["--set definitions.vehicles.husky.mass_kg: changes nothing: the mission has no vehicle 'husky'", "tarot_t650"],
    ),
    "judged too seldom": (
        "timing.judge_period_s=0.2",
        ["--set timing.judge_period_s: the sample_period_s of 0.1 s of the detector 'nai", "at most 0.1"],
    ),
    "a nuclide twice": (
        "knowledge.nuclides=[Co-60, Cs-137, Co-60]",
        ["--set knowledge.nuclides.2: is named twice", "given:   Co-60"],
    ),
    "regions beyond the spectrum": (
        "definitions.detectors.nai_2x2.spectrometer.rois_kev=[10000, 20000]",
        ["definitions.detectors.nai_2x2.spectrometer: rois_kev lie beyond what is counted"],
    ),
    "line beyond crystals": (
        "definitions.nuclides.Co-60.lines=[{energy_kev: 6129, yield_percent: 67}]",
        ["--set definitions.nuclides.Co-60.lines.0.energy_kev: lies beyond the response", "at most 3400"],
    ),
    "landing that is a crash": (
        "definitions.vehicles.tarot_t650.impact_speed_max_m_s=0.3",
        ["phases.0.settings.touchdown_speed_m_s: is a crash for the vehicle type 'tarot_t650'", "at most 0.3"],
    ),
    "bad definition": (
        "definitions.vehicles.x500.mass_kg=-1",
        ["--set definitions.vehicles.x500.mass_kg", "too small"],
    ),
}


def message_of(path: Path | str, *overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        load_scenario(path, overrides)
    return str(caught.value)


@pytest.mark.parametrize(("old", "new", "fragments"), EDITS.values(), ids=EDITS)
def test_an_edit_that_spoils_the_mission(mission: Path, old: str, new: str, fragments: list[str]) -> None:
    spoil(mission, old, new)
    message = message_of(mission)
    for fragment in fragments:
        if fragment.startswith("@"):
            fragment = f"configs/missions/recon.yaml:{line_of(mission, fragment[1:])}"
        assert fragment in message


@pytest.mark.parametrize(("content", "fragments"), CONTENTS.values(), ids=CONTENTS)
def test_a_file_that_is_no_mission(mission: Path, content: bytes, fragments: list[str]) -> None:
    path = mission.with_name("bad.yaml")
    path.write_bytes(content)
    message = message_of(path)
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize(("override", "fragments"), OVERRIDES.values(), ids=OVERRIDES)
def test_an_override_that_spoils_the_mission(mission: Path, override: str, fragments: list[str]) -> None:
    message = message_of(mission, override)
    assert "this field is missing" not in message  # of a definition that is not there nothing else is told
    for fragment in fragments:
        assert fragment in message


def test_everything_is_told_at_once_in_the_order_of_the_file(mission: Path) -> None:
    spoil(mission, "site: works_yard", "site: nowhere")
    spoil(mission, "activity_mbq: 170.0", "activity_mbq: -1")
    spoil(mission, "type: tarot_t650", "type: nothing")
    spoil(mission, "altitude_m: 20.0", "altitude_m: 2O")
    with pytest.raises(InputError) as caught:
        load_scenario(mission, ["seed=-1", "wint.x=1"])
    problems = caught.value.problems
    places = {problem.path: (problem.file, problem.line) for problem in problems}
    file = "configs/missions/recon.yaml"
    assert places == {
        "wint": ("--set", None),
        "seed": ("--set", None),
        "sources.0.activity_mbq": (file, line_of(mission, "activity_mbq")),
        "phases.0.settings.altitude_m": (file, line_of(mission, "altitude_m")),
        "site": (file, line_of(mission, "\nsite:") + 1),
        "vehicles.0.type": (file, line_of(mission, "type: nothing")),
    }


def test_problems_of_other_files_name_those_files(mission: Path) -> None:
    configs = mission.parents[1]
    spoil(configs / "vehicles" / "orpheus.yaml", "radius_m: 0.2", "radius_m: -0.2")
    spoil(configs / "nuclides" / "Cs-137.yaml", "yield_percent", "yeild_percent")
    spoil(configs / "sites" / "works_yard" / "site.yaml", "cell_m: 0.5", "cell_m: none")
    message = message_of(mission)
    assert f"configs/vehicles/orpheus.yaml:{line_of(configs / 'vehicles/orpheus.yaml', 'radius_m: -0.2')}" in message
    assert "configs/nuclides/Cs-137.yaml" in message
    assert "did you mean 'yield_percent'" in message
    assert "configs/sites/works_yard/site.yaml:4 cell_m: is not a number" in message


def test_a_vehicle_with_an_unknown_detector(mission: Path) -> None:
    vehicles = mission.parents[1] / "vehicles"
    spoil(vehicles / "tarot_t650.yaml", "model: nai_1p5x1p5", "model: nai_1p5x1")
    with pytest.raises(InputError) as caught:
        load_scenario(mission)
    assert [problem.path for problem in caught.value.problems] == ["vehicles.0.type"]
    assert "a detector 'nai_1p5x1' that does not exist" in str(caught.value)
    assert "did you mean 'nai_1p5x1p5'" in str(caught.value)


def test_a_site_of_an_unknown_material(mission: Path) -> None:
    site = mission.parents[1] / "sites" / "works_yard" / "site.yaml"
    site.write_text(site.read_text() + "ground_material: soli\n")
    message = message_of(mission)
    assert "material 'soli' that does not exist" in message
    assert "did you mean 'soil'" in message


def test_a_file_whose_name_differs_from_the_name_inside(mission: Path) -> None:
    vehicles = mission.parents[1] / "vehicles"
    (vehicles / "mine.yaml").write_text((vehicles / "tarot_t650.yaml").read_text())
    spoil(mission, "type: tarot_t650", "type: mine")
    message = message_of(mission)
    assert "configs/vehicles/mine.yaml" in message
    assert "name: mine" in message


def test_a_body_file_that_does_not_exist(mission: Path) -> None:
    vehicle = mission.parents[1] / "vehicles" / "orpheus.yaml"
    vehicle.write_text(vehicle.read_text() + "\nbody: {file: no.urdf}\n")
    message = message_of(mission)
    assert "body.file: there is no such file" in message
    assert "no.urdf" in message


@pytest.mark.parametrize(
    ("name", "fragment"),
    [
        ("recn", "did you mean 'recon'"),
        ("configs/missions/recom.yaml", "did you mean 'configs/missions/recon.yaml'"),
        ("configs/missions", "is a folder"),
        ("no/such/file.yaml", "there is no file 'no/such/file.yaml'"),
        ("configs/vehicles/x500.yaml", "x500.yaml: is the file of a vehicle, not of a mission"),
        ("configs/sites/works_yard", "is a folder"),
        ("configs/sites/works_yard/site.yaml", "site.yaml: is the file of a site, not of a mission"),
    ],
)
def test_a_path_that_does_not_exist(mission: Path, name: str, fragment: str) -> None:
    assert fragment in message_of(name)


def test_an_item_without_a_name_is_not_changed_by_one(mission: Path) -> None:
    mission.with_name("mine.yaml").write_text("extends: recon\nname: mine\nsources: {0: {activity_mbq: 1}}\n")
    message = message_of("mine")
    assert "mine.yaml:3 sources.0: there is no item '0' to change" in message
    assert "have no names" in message


def test_a_vehicle_of_no_kind(tmp_path: Path) -> None:
    for text, fragment in (("kind: multirotr\n", "did you mean 'multirotor'"), ("name: a\n", "kind: this field is")):
        (tmp_path / "v.yaml").write_text(text)
        with pytest.raises(InputError, match=fragment):
            load_model(tmp_path / "v.yaml", Vehicle)


def test_load_model_tells_the_same(mission: Path) -> None:
    spoil(mission, "seed: 0", "seed: zero")
    with pytest.raises(InputError, match=r"recon\.yaml:6 seed: is not a whole number"):
        load_model(mission, Mission)


@pytest.mark.parametrize("given", ["", "{vehicles: }"])
def test_empty_definitions_are_those_of_none(mission: Path, given: str) -> None:
    path = mission.with_name("empty.yaml")
    path.write_text(f"extends: recon\nname: empty\ndefinitions: {given}\n")
    scenario = load_scenario(path, ["definitions.vehicles.tarot_t650.mass_kg=4"])
    assert [vehicle.mass_kg for vehicle in scenario.vehicles[:3]] == [4.0] * 3


@pytest.mark.parametrize("given", ["5", "[]", "{vehicles: [1]}"])
def test_definitions_that_are_no_table_are_told(mission: Path, given: str) -> None:
    path = mission.with_name("wrong.yaml")
    path.write_text(f"extends: recon\nname: wrong\ndefinitions: {given}\n")
    assert "definitions" in message_of(path, "definitions.vehicles.tarot_t650.mass_kg=4")


def test_a_surface_of_no_material_is_told(mission: Path) -> None:
    message = message_of(mission, "background.surfaces={concret: 1.5}")
    assert "background.surfaces.concret: a surface is of a material 'concret' that does not exist" in message
    assert "did you mean 'concrete'" in message
