"""The command line: what it prints, where, with which exit code, and what it leaves behind."""

import json
import os
import re
import subprocess
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from swarmsim import cli
from swarmsim.cli.files import kind_of_file
from swarmsim.cli.run import summary_table
from swarmsim.config.files import packaged_dir
from swarmsim.config.scenario import Scenario, load_scenario
from swarmsim.config.site_checks import check_site
from swarmsim.runtime.progress import Progress
from tests.config.project import line_of, make_project, spoil

ALTITUDE = "phases.survey.settings.altitude_m=30"
COMMANDS = ("run", "view", "check", "schema", "list", "init", "import-site", "export-n42")
SUMMARY: dict[str, Any] = {
    "status": "located",
    "finding": "Co-60 of 171 MBq at (12.1, 4.0)",
    "warnings": ["a collision may have gone unnoticed"],
    "phases": {
        "survey": {"duration_s": 305.2, "in_time": True, "path_length_m": 2104.0, "measurements": 10234},
        "search": {"duration_s": 210.0, "in_time": False, "path_length_m": 180.0, "count_rate_max_cps": None},
    },
    "hotspot": {"position_m": [12.3, 4.1], "error_m": 0.32},
    "source": {
        "position_m": [12.1, 4.0, 1.0],
        "error_m": 0.1,
        "activity_mbq": 171.2,
        "activity_std_mbq": 3.47,
        "activity_error_percent": 0.7,
    },
    "noticed_mbq": {"Co-60": 4.14, "Cs-137": 12.3, "Am-241": None},
    "nuclide": {"name": "Co-60", "confidence": 0.999},
    "real_time_factor": 55.5,
    "timing": {"compile_s": 20.0, "run_s": 10.0, "write_s": 0.5},
    "vehicles": [{"name": "uav1", "state": "collided with a vehicle", "crashed": True, "energy_wh": 42.0}],
    "events": [{"time_s": 12.3, "vehicle": "uav1", "kind": "vehicle", "detail": "collided with another vehicle"}],
}
Fly = Callable[..., None]


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project folder, which is the working folder."""
    make_project(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def fly(monkeypatch: pytest.MonkeyPatch) -> Callable[[Fly], None]:
    """Put a function in the place of the rollout."""

    def put(function: Fly) -> None:
        module = types.ModuleType("swarmsim.runtime.run")
        module.run = function  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "swarmsim.runtime.run", module)

    return put


def write_results(scenario: Scenario, out: Path, missions: int, progress: Progress, *, force: bool) -> None:
    """Stand in for the rollout: report two phases and write what a run writes at the least."""
    progress.phase("survey", 300.0)
    progress.advance(100.0, 1, 3)
    progress.advance(300.0, 3, 3)
    progress.message("three UAVs landed")
    progress.phase("estimate", 0.0)
    out.mkdir(parents=True, exist_ok=True)
    many = {"metrics": {"source_error_m": {"median": 0.05, "min": 0.01, "max": 0.25, "found": missions - 1}}}
    told = SUMMARY | {"seed": scenario.mission.seed, "missions": missions} | (many if missions > 1 else {})
    (out / "summary.json").write_text(json.dumps(told))
    (out / "scenario.yaml").write_text(scenario.to_yaml())
    (out / "mission.rrd").write_bytes(b"RRF2")


def everything(folder: Path) -> set[Path]:
    return set(folder.rglob("*"))


def test_the_help_is_quick_and_says_what_there_is() -> None:
    start = time.perf_counter()
    result = subprocess.run([sys.executable, "-m", "swarmsim", "--help"], capture_output=True, text=True, check=True)
    took = time.perf_counter() - start
    for word in (*COMMANDS, "Examples:", "swarmsim run recon", "Exit codes"):
        assert word in result.stdout
    assert result.stderr == ""
    assert took < 5.0  # 0.15 s on a quiet machine; an import of jax alone costs more than this under load


def test_the_help_imports_nothing_heavy() -> None:
    code = "import sys; from swarmsim.cli import main; main(['--help']); print(*sys.modules, file=sys.stderr)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(result.stderr.split())
    assert "swarmsim.cli" in loaded
    assert not loaded & {"jax", "mujoco", "rerun", "numpy", "pydantic", "trimesh", "matplotlib"}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_examples(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert "For example:" in text
    assert text.count(f"swarmsim {command} ") + text.count(f"swarmsim {command}\n") >= 3  # usage and two examples


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("swarmsim")


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        (["soar"], 'Unknown command "soar"'),
        (["run"], "requires an argument"),
        (["run", "recon", "--sed", "1"], "Did you mean --seed?"),
        (["run", "recon", "--seed", "one"], "a whole number is needed, not 'one'"),
        (["run", "recon", "--seed", "-1"], "--seed"),
        (["draw", "random_recon", "--seed", "1.5"], "1.5"),
        (["run", "recon", "--missions", "2.5"], "2.5"),
        (["bench", "recon", "--missions", "3.5"], "3.5"),
        (["bench", "recon", "--repeats", "1.5"], "1.5"),
        (["run", "recon", "--missions", "0"], "--missions"),
        (["schema", "vehicl"], "vehicle"),
        (["check"], "name at least one file"),
        (["run", "recon", "recon_paper", "mixed"], "one argument too many, or an unknown one: 'recon_paper', 'mixed'"),
    ],
)
def test_a_wrong_command_line(arguments: list[str], fragment: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 2
    printed = capsys.readouterr()
    assert fragment in printed.err
    assert printed.out == ""


def test_run_flies_the_mission_and_prints_the_summary(
    project: Path, fly: Callable[[Fly], None], capsys: pytest.CaptureFixture[str]
) -> None:
    flown: list[tuple[Scenario, Path, int]] = []

    def rollout(scenario: Scenario, out: Path, missions: int, progress: Progress, *, force: bool) -> None:
        flown.append((scenario, out, missions))
        write_results(scenario, out, missions, progress, force=force)

    fly(rollout)
    assert cli.main(["run", "recon", "--seed", "5", "--set", ALTITUDE, "--set", "wind.speed_m_s=1"]) == 0
    (scenario, out, missions), printed = flown[0], capsys.readouterr()
    assert (scenario.mission.seed, scenario.settings[0].altitude_m, scenario.mission.wind.speed_m_s) == (5, 30, 1)
    assert (out, missions) == (Path("runs/recon"), 1)
    for fragment in (
        "Co-60",
        "10,234",
        "[12.3, 4.1]",
        "171.2",
        "3.47",
        "uav1",
        "a collision may have gone unnoticed",
        "survey: path, all vehicles",
        "search: duration",
        "by its time limit",
        "collided with a vehicle, 42",
        "vehicle: collided with another vehicle",
        "swarmsim view runs/recon",
        "4.1 MBq Co-60",
    ):
        assert fragment in printed.out
    assert "three UAVs landed" in printed.err


def test_a_large_team_is_summed_up(capsys: pytest.CaptureFixture[str]) -> None:
    vehicles = [{"name": f"uav{k}", "state": "intact", "crashed": False, "energy_wh": 2.0} for k in range(200)]
    vehicles[7]["state"] = "crashed"
    events = [SUMMARY["events"][0] | {"vehicle": f"uav{k}"} for k in range(20)]
    Console(width=200).print(summary_table(SUMMARY | {"vehicles": vehicles, "events": events}, "swarm"))
    printed = capsys.readouterr().out
    for line in (
        "Vehicles intact +│ +199 ",
        "Vehicles crashed +│ +1 ",
        "Energy, all vehicles +│ +400 ",
        "8 more events",
    ):
        assert re.search(line, printed), line
    assert [f"uav{k} at 12 s" in printed for k in (11, 12)] == [True, False]


def test_run_again_from_what_a_run_left_behind(project: Path, fly: Callable[[Fly], None]) -> None:
    fly(write_results)
    assert cli.main(["run", "recon", "--seed", "4"]) == 0
    assert cli.main(["run", "runs/recon/scenario.yaml", "--out", "runs/again"]) == 0
    assert (project / "runs/again/scenario.yaml").read_text() == (project / "runs/recon/scenario.yaml").read_text()


def test_a_batch_prints_every_number(
    project: Path, fly: Callable[[Fly], None], capsys: pytest.CaptureFixture[str]
) -> None:
    fly(write_results)
    assert cli.main(["run", "recon", "--missions", "4", "--out", "runs/four"]) == 0
    printed = capsys.readouterr().out
    assert "recon, 4 missions" in printed
    assert "timing.compile_s" in printed
    assert re.search(r"source_error_m +│ +0\.05 +│ +0\.01 +│ +0\.25 +│ +3 ", printed)


def test_results_are_not_replaced_without_force(
    project: Path, fly: Callable[[Fly], None], capsys: pytest.CaptureFixture[str]
) -> None:
    fly(write_results)
    assert cli.main(["run", "recon"]) == 0
    assert cli.main(["run", "recon"]) == 2
    assert "--force" in capsys.readouterr().err
    assert cli.main(["run", "recon", "--seed", "9", "--force"]) == 0
    assert json.loads((project / "runs/recon/summary.json").read_text())["seed"] == 9


def test_an_empty_folder_is_a_place_for_results(project: Path, fly: Callable[[Fly], None]) -> None:
    forced: list[bool] = []

    def rollout(scenario: Scenario, out: Path, missions: int, progress: Progress, *, force: bool) -> None:
        forced.append(force)
        write_results(scenario, out, missions, progress, force=force)

    fly(rollout)
    (project / "empty").mkdir()
    assert cli.main(["run", "recon", "--out", "empty"]) == 0
    assert cli.main(["run", "recon", "--out", "new"]) == 0
    assert forced == [False, False]


def test_force_never_replaces_what_is_no_run(
    project: Path, fly: Callable[[Fly], None], capsys: pytest.CaptureFixture[str]
) -> None:
    fly(write_results)
    (project / "notes").mkdir()
    (project / "notes" / "diary.txt").write_text("dear diary")
    (project / "file").write_text("")
    before = everything(project)
    for out, message in (
        ("notes", "the folder holds something else than a run, and is not replaced"),
        ("file", "there is something else than a folder where the results should go"),
        ("file/x", "the results cannot be written there"),
    ):
        assert cli.main(["run", "recon", "--force", "--out", out]) == 2
        printed = capsys.readouterr().err
        assert f"--out: {message}" in printed
        assert f"given:   {out}\n" in printed
    assert everything(project) == before
    assert (project / "notes" / "diary.txt").read_text() == "dear diary"


def test_wrong_input_writes_nothing_and_shows_no_traceback(project: Path) -> None:
    mission = project / "configs/missions/recon.yaml"
    spoil(mission, "altitude_m: 20.0", "altitude_m: -1")
    spoil(mission, "nuclide: Co-60", "nuclide: Co60")
    before = everything(project)
    command = [sys.executable, "-m", "swarmsim", "run", "recon", "--set", "arial.x=1"]
    source = str(Path(cli.__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": source, "PYTHONDONTWRITEBYTECODE": "1"}
    result = subprocess.run(command, cwd=project, capture_output=True, text=True, check=False, env=environment)
    assert result.returncode == 2
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    assert result.stderr.startswith("3 problems\n")
    for text, fragment in (("altitude_m", "greater than 1"), ("nuclide: Co60", "did you mean 'Co-60'?")):
        assert f"configs/missions/recon.yaml:{line_of(mission, text)}" in result.stderr
        assert fragment in result.stderr
    assert "--set arial" in result.stderr
    assert everything(project) == before


@pytest.mark.parametrize(
    "arguments",
    [["run", "recon", "--seed", "+-3"], ["run", "recon", "--seed", "\u0663"], ["bench", "recon", "--fleet", "1.5"]],
)
def test_numbers_that_are_not_whole(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 2
    assert f"a whole number is needed, not '{arguments[-1]}'" in capsys.readouterr().err


def test_seeds_beyond_the_end(project: Path, fly: Callable[[Fly], None], capsys: pytest.CaptureFixture[str]) -> None:
    fly(write_results)
    assert cli.main(["run", "recon", "--seed", str(2**31 - 2), "--missions", "3"]) == 2
    assert "grow too large" in capsys.readouterr().err


def test_ctrl_c_ends_with_one_line(
    project: Path, fly: Callable[[Fly], None], capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(scenario: Scenario, out: Path, missions: int, progress: Progress, *, force: bool) -> None:
        progress.phase("survey", 300.0)
        raise KeyboardInterrupt

    fly(interrupted)
    before = everything(project)
    assert cli.main(["run", "recon"]) == 130
    assert capsys.readouterr().err.strip().split("\n")[-1].startswith("stopped with Ctrl-C")
    assert everything(project) == before


def test_an_error_of_the_program_keeps_its_traceback(project: Path, fly: Callable[[Fly], None]) -> None:
    def broken(scenario: Scenario, out: Path, missions: int, progress: Progress, *, force: bool) -> None:
        raise ZeroDivisionError("a bug")

    fly(broken)
    with pytest.raises(ZeroDivisionError):
        cli.main(["run", "recon"])


def test_view_opens_the_recording(
    project: Path, fly: Callable[[Fly], None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    commands: list[list[str]] = []

    def started(command: list[str], check: bool) -> types.SimpleNamespace:
        commands.append(command[1:])
        return types.SimpleNamespace(returncode=len(commands) - 3)

    monkeypatch.setattr("swarmsim.playback.viewer.subprocess.run", started)
    assert cli.main(["view", "runs/recon"]) == 2
    assert "there is none in runs/ yet" in capsys.readouterr().err
    fly(write_results)
    assert cli.main(["run", "recon"]) == 0
    assert cli.main(["view", "runs/recn"]) == 2
    assert "one of runs/recon" in capsys.readouterr().err
    (project / "runs" / "batch").mkdir()
    assert cli.main(["view", "runs/batch"]) == 2
    assert "holds no recording" in capsys.readouterr().err
    for arguments in (["runs/recon"], ["runs/recon/mission.rrd", "--web"], ["runs/recon"]):
        cli.main(["view", *arguments])
    assert commands[0] == ["-m", "rerun", "runs/recon/mission.rrd", "--bind", "127.0.0.1"]
    assert commands[1] == ["-m", "rerun", "runs/recon/mission.rrd", "--bind", "127.0.0.1", "--web-viewer"]
    assert "viewer ended with exit code -2" in capsys.readouterr().err


def test_the_shipped_missions_fit_their_site() -> None:
    for path in sorted((packaged_dir() / "missions").glob("*.yaml")):
        assert kind_of_file(path) == "missions"
        assert check_site(load_scenario(path)) == []


def test_a_reader_that_has_seen_enough_is_no_error(project: Path) -> None:
    command = f"'{sys.executable}' -m swarmsim schema | head -n 1"
    environment = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[2])}
    result = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True, env=environment)
    assert (result.stdout, result.stderr) == ("{\n", "")


def test_an_impossible_place_for_the_results_is_told(
    project: Path, fly: Callable[[Fly], None], capsys: pytest.CaptureFixture[str]
) -> None:
    fly(write_results)
    assert cli.main(["run", "recon", "--out", "x" * 300]) == 2
    assert "cannot be written there (File name too long)" in capsys.readouterr().err


def test_a_working_folder_that_is_gone_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    assert cli.main(["list"]) == 2
    assert "working folder cannot be used (No such file" in capsys.readouterr().err
