"""Commands that work on files: check, schema, list, init and import-site."""

import io
import json
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from swarmsim import cli
from swarmsim.config.files import KINDS, packaged_dir
from tests.config.project import make_project, spoil


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project folder, which is the working folder."""
    make_project(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def everything(folder: Path) -> set[Path]:
    return set(folder.rglob("*"))


def test_check_tells_all_problems_of_all_files(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    configs = project / "configs"
    spoil(configs / "vehicles/x500.yaml", "mass_kg", "mas_kg")
    spoil(configs / "nuclides/Co-57.yaml", "half_life_s", "half_life")
    files = ["vehicles/x500.yaml", "nuclides/Co-57.yaml", "nuclides/Co-60.yaml", "materials/air.yaml", "missing.yaml"]
    assert cli.main(["check", *(f"configs/{file}" for file in files)]) == 2
    printed = capsys.readouterr()
    assert printed.out == "ok  configs/nuclides/Co-60.yaml (nuclide)\nok  configs/materials/air.yaml (material)\n"
    for fragment in ("did you mean 'mass_kg'", "did you mean 'half_life_s'", "no file 'configs/missing.yaml'"):
        assert fragment in printed.err


TORN = {
    "a detector": ("vehicles/tarot_t650", "model: nai_1p5x1p5", "model: nai_1p5x1", "detector.model", "nai_1p5x1p5"),
    "a sensor": ("vehicles/x500", "bmi088", "bmi08", "sensors.0", "bmi088"),
    "a crystal": ("detectors/nai_2x2", "crystal: sodium", "crystal: sodiu", "crystal", "sodium_iodide"),
    "a housing": ("detectors/nai_2x2", "aluminium", "aluminum", "housing.material", "aluminium"),
}


@pytest.mark.parametrize(("file", "old", "new", "place", "near"), TORN.values(), ids=TORN)
def test_check_follows_what_a_file_names(
    project: Path, capsys: pytest.CaptureFixture[str], file: str, old: str, new: str, place: str, near: str
) -> None:
    spoil(project / f"configs/{file}.yaml", old, new)
    assert cli.main(["check", f"configs/{file}.yaml"]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"configs/{file}.yaml:")
    assert f" {place}: " in printed
    assert "that does not exist" in printed
    assert f"did you mean '{near}'?" in printed


def test_check_tells_faults_of_what_a_file_names(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    configs = project / "configs"
    spoil(configs / "materials/aluminium.yaml", "density_kg_m3", "density")
    assert cli.main(["check", "configs/vehicles/tarot_t650.yaml"]) == 2
    assert "configs/materials/aluminium.yaml" in capsys.readouterr().err
    vehicle = configs / "vehicles/orpheus.yaml"
    vehicle.write_text(vehicle.read_text() + "\nbody: {file: body.urdf}\n")
    (configs / "vehicles/body.urdf").write_text("<robot name='r'><link name='a'/></robot>")
    spoil(configs / "materials/aluminium.yaml", "density", "density_kg_m3")
    assert cli.main(["check", "configs/vehicles/orpheus.yaml"]) == 2
    told = capsys.readouterr().err
    assert "body.file: the body has no mass" in told
    assert str(vehicle.name) in told


def test_check_cannot_tell_the_kind_of_anything(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (project / "x.yaml").write_text("colour: red\n")
    (project / "empty").mkdir()
    assert cli.main(["check", "x.yaml", "empty"]) == 2
    printed = capsys.readouterr().err
    assert "cannot tell what this file describes" in printed
    assert "holds no YAML file" in printed


def test_init_copies_everything_and_check_finds_it_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["init", "mine"]) == 0
    assert "cd mine && swarmsim run recon" in capsys.readouterr().out
    suffixes = (".yaml", ".yml", ".dae", ".urdf", ".xacro", ".stl", ".obj")  # not the scripts that generate data
    shipped = {path.relative_to(packaged_dir()) for path in packaged_dir().rglob("*") if path.suffix in suffixes}
    copied = tmp_path / "mine" / "configs"
    assert {path.relative_to(copied) for path in copied.rglob("*") if path.is_file()} == shipped
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["configs"]
    monkeypatch.chdir(tmp_path / "mine")
    kinds = [kind for kind in KINDS if kind in {path.parts[0] for path in shipped}]
    assert cli.main(["check", *(f"configs/{kind}" for kind in kinds)]) == 0
    count = sum(path.suffix == ".yaml" and path.parts[0] in KINDS for path in shipped)
    assert capsys.readouterr().out.count("ok  configs/") == count


def test_init_never_overwrites(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.read_bytes() for path in everything(project) if path.is_file()}
    assert cli.main(["init", "."]) == 2
    assert "not overwritten" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in everything(project) if path.is_file()} == before
    (project / "file").write_text("")
    assert cli.main(["init", "file"]) == 2


def test_an_init_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(source: Path, target: Path, **_: Any) -> None:
        (target / "vehicles").mkdir()
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("swarmsim.cli.files.shutil.copytree", interrupted)
    assert cli.main(["init", "mine"]) == 130
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_takes_no_files_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    mesh = packaged_dir() / "sites" / "works_yard" / "works_yard.dae"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("swarmsim.atomic_folder.tempfile.TemporaryDirectory", full)
    for command in (["init", "mine"], ["import-site", str(mesh), "--out", "yard"], ["run", "recon", "--out", "run"]):
        assert cli.main(command) == 2
        assert "there (No space left on device)" in " ".join(capsys.readouterr().err.split())
    assert list(tmp_path.iterdir()) == []


def test_list(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spoil(project / "configs/nuclides/Co-57.yaml", "half_life_s", "half_life")
    assert cli.main(["list"]) == 0
    printed = capsys.readouterr().out
    for word in (
        "tarot_t650",
        "works_yard",
        "recon_paper",
        "nai_2x2",
        "Cs-137",
        "661.66 keV",
        "concrete",
        "2300 kg/m3",
    ):
        assert word in printed
    assert "parallel_lines" in printed
    assert "not valid: 2 problems, see swarmsim check" in printed
    assert cli.main(["list", "vehicles"]) == 0
    assert "Cs-137" not in capsys.readouterr().out


def test_schema_is_json_of_the_model(capsys: pytest.CaptureFixture[str]) -> None:
    for kind, field in (("mission", "phases"), ("nuclide", "half_life_s"), ("site", "cell_m")):
        assert cli.main(["schema", kind]) == 0
        schema = json.loads(capsys.readouterr().out)
        assert field in schema["properties"]
        assert schema["additionalProperties"] is False
    assert cli.main(["schema", "vehicle"]) == 0
    assert set(json.loads(capsys.readouterr().out)["discriminator"]["mapping"]) == {"multirotor", "skid_steer"}


def test_import_site(project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    given: list[Any] = []

    def imported(file: Path, out: Path, options: Any) -> types.SimpleNamespace:
        given.append((file, out, options))
        out.mkdir(parents=True)
        parts = [
            {"names": [name], "is": what}
            for name, what in (("lawn [0]", "ground"), ("[red]shed", "wood"), ("hut", "wood"))
        ]
        return types.SimpleNamespace(
            name=options.name or out.name,
            report={"area_m2": 123.0, "warnings": ["[bold]loud[/bold]"], "parts": parts, "guesses": ["[blue]: wood"]},
        )

    monkeypatch.setattr("swarmsim.site.import_site", imported)
    command = ["import-site", "yard.obj", "--out", "configs/sites/yard", "--unit", "0.01", "--up", "Y", "--cell", "1"]
    assert (
        cli.main(
            [*command, "--ground", "soil*", "--ground", "grass*", "--licence", "CC0-1.0", "--set", "holes_max=0.3"]
        )
        == 0
    )
    file, out, options = given[0]
    assert (file, out, options.cell_m, options.overwrite) == (Path("yard.obj"), Path("configs/sites/yard"), 1.0, False)
    assert options.licence == "CC0-1.0"
    assert options.fields == {"unit_m": 0.01, "up_axis": "Y", "ground": ["soil*", "grass*"], "holes_max": 0.3}
    printed = capsys.readouterr().out
    for fragment in (
        "area_m2",
        "ground: lawn [0]",
        "wood: [red]shed, hut",
        "warning: [bold]loud[/bold]",
        "[blue]: wood",
    ):
        assert fragment in printed
    assert cli.main(command) == 2
    assert "--force" in capsys.readouterr().err


def test_import_site_under_a_name_or_with_a_unit_that_cannot_be(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (project / "yard.obj").write_text("v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n")
    before = everything(project)
    assert cli.main(["import-site", "yard.obj", "--out", "configs/sites/höf ü"]) == 2
    assert "--out: is the folder of no name that a site can have" in capsys.readouterr().err
    assert cli.main(["import-site", "yard.obj", "--out", "configs/sites/yard", "--height-unit", "2"]) == 2
    assert "--height-unit: is of elevation models only" in capsys.readouterr().err
    assert cli.main(["import-site", "yard.obj", "--out", "yard.obj/site"]) == 2
    assert "yard.obj' is no folder" in " ".join(capsys.readouterr().err.split())
    wrong = {
        "--cell": ["--cell", "1e-9"], "--unit": ["--unit", "1e30"], "--set unit_m": ["--set", "unit_m=1e30"],
        "--set holes_max": ["--set", "holes_max=7"],
    }  # fmt: skip
    for where, options in wrong.items():
        assert cli.main(["import-site", "yard.obj", "--out", "configs/sites/yard", *options]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"{where}: is too ")
        assert "site.yaml" not in said
    assert everything(project) == before


def test_check_begins_the_missions_of_users_policies(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (project / "mine.py").write_text(
        "import jax.numpy as jnp\nimport swarmsim\n\n\nclass Up:\n    vehicles = ('multirotor',)\n\n"
        "    def start(self, task, key):\n        return jnp.zeros(2)\n\n"
        "    def act(self, task, memory, view, key):\n        return memory, swarmsim.fly_velocity(jnp.ones(3))\n\n\n"
        "class Early(Up):\n    def task(self, assignment):\n        raise RuntimeError('no task')\n\n\n"
        "class Late(Up):\n    def start(self, task, key):\n        raise KeyError('no start')\n"
    )
    mission = project / "configs/missions/mine.yaml"
    wrong = {"Early": "mine.py:17: RuntimeError: no task", "Late": "mine.py:22: KeyError: 'no start'"}
    for name in ("Up", *wrong):
        mission.write_text(
            "extends: landing\nname: mine\nphases:\n"
            f"  - {{name: up, who: uav, policy: '../../mine.py:{name}', time_limit_s: 20}}\n"
        )
        assert cli.main(["check", "configs/missions/mine.yaml"]) == (2 if name in wrong else 0)
        assert wrong.get(name, "") in capsys.readouterr().err
    with mission.open("a") as file:  # of a family they are begun as well
        file.write("vary: {wind.speed_m_s: {uniform: [0, 2]}}\n")
    assert cli.main(["check", "configs/missions/mine.yaml"]) == 2
    assert wrong["Late"] in capsys.readouterr().err


def test_import_site_of_a_missing_file(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = everything(project)
    assert cli.main(["import-site", "no.dae", "--out", "configs/sites/new"]) == 2
    assert "no.dae" in capsys.readouterr().err
    assert everything(project) == before


@pytest.mark.parametrize("command", [["init", "a\0b"], ["replay-log", "a\0b.tlog"], ["check", "a\0b/c.yaml"]])
def test_a_null_character_in_a_name_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(command) == 2
    assert "a\\x00b" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_name_that_no_file_can_have_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["import-site", "b" * 300, "--out", "o"]) == 2
    assert "so long a name: 'bbbb" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_check_tells_the_kind_by_what_a_file_extends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text("extends: recon\nname: mine\n")
    assert cli.main(["check", "mine.yaml"]) == 0


def test_a_name_that_the_output_cannot_show_is_told_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "m\u00fc.yaml").write_text("extends: recon\nname: mine\n")
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding="ascii"))
    assert cli.main(["check", "m\u00fc.yaml"]) == 0
    sys.stdout.flush()
    assert b"m\\xfc.yaml" in shown.getvalue()


def test_cells_of_next_to_nothing_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = packaged_dir() / "sites" / "works_yard" / "works_yard.dae"
    monkeypatch.chdir(tmp_path)
    assert cli.main(["import-site", str(mesh), "--out", "o", "--cell", "1e-308"]) == 2
    assert "--cell: is too small" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
