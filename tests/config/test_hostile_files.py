"""Files that no user writes on purpose: each is told in a sentence, within two seconds of the processor."""

import os
import time
from pathlib import Path

import pytest

from swarmsim.cli import main

LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{new}: &{new} [{','.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)
TEAM = "extends: recon\nphases: [{name: a, who: all, policy: hold, time_limit_s: 10}]\nvehicles: "
FORMATION = "[{{name: v, type: tarot_t650, position_m: {}, formation: {{count: 2000, columns: 50, spacing_m: {}}}}}]\n"
FILES = {
    "a number of 5000 digits": ("name: x\nseed: " + "9" * 5000, "more than 18 digits"),
    "a list of 100,000": ("sources: [" + "1, " * 100_000 + "]", "too many values"),
    "a fault after 29,000 values": ("x: [" + "1," * 29_000 + "\n}\n", "is not valid YAML"),
    "a field of 29,000 words": (
        f"extends: recon\nphases: [{{name: a, policy: hold, who: [{', '.join(f'q{i}' for i in range(29_000))}]}}]",
        "this field is missing",
    ),
    "3,000 unknown types": (
        f"extends: recon\nvehicles: [{', '.join(f'{{name: u{i}, type: t{i}, x: [1, 2]}}' for i in range(3000))}]",
        "there are more problems",
    ),
    "brackets": ("x: " + "[" * 100_000, "nested too deeply"),
    "laughs": (LAUGHS, "too many values"),
    "fifty megabytes": ("#" * 50_000_000, "too large for a configuration file"),
    "a megabyte of comment": ("#" * 999_000, "is empty"),
    "a megabyte of text": ('x: "' + "a b\\n" * 190_000 + '"', "this field is missing"),
    "many fields": ("".join(f"k{i}: {i}\n" for i in range(14_000)), "there are more problems"),
    "a name many times": ("name: x\n" * 14_000, "given twice"),
    "a long name of a field": ("x" * 100_000 + "y: 1", "is not valid YAML"),
    "a field's name of 300 letters": ("x" * 300 + ": 1", "at most 200 characters"),
    "many phases": (
        "extends: recon\nphases: [" + "{name: a, who: b, policy: c}, " * 2500 + "]",
        "there are more problems",
    ),
    "many unknown names": (
        f"extends: recon\nphases: {{survey: {{who: [{', '.join(f'q{i}' for i in range(2000))}]}}}}",
        "no vehicle of the team is meant by 'q0'",
    ),
    "a team on one place": (TEAM + FORMATION.format([-60, -45], 0.01), "too near"),
    "control characters": ('extends: recon\nname: "\\e[31m"', "\\x1b[31m"),
    "half a character": ('extends: recon\nsite: "\\ud800"', "surrogates"),
    "an unknown user": ('extends: recon\nphases: {survey: {policy: "~nobody-here/x.py:P"}}', "there is no file"),
    "a null character": ('extends: "a/\\0b"', "to extend"),
    "too long a path": (f"extends: {'y' * 5000}/x.yaml", "there is no mission 'yyyy"),
    "a device to extend": ("extends: /dev/zero", "there is no mission '/dev/zero' to extend"),
    "a former field": ("extends: recon\ntime_step_s: 1e-320", "timing.physics_steps"),
    "not finite": ("extends: recon\nwind: {speed_m_s: .nan}", "not a finite number"),
}


def check(path: Path | str, capsys: pytest.CaptureFixture[str]) -> str:
    """What ``swarmsim check`` says of a file that it refuses."""
    started = time.process_time()
    assert main(["check", str(path)]) == 2
    assert time.process_time() - started < 2.0
    said = capsys.readouterr().err
    assert len(said) < 100_000
    return " ".join(said.split())


@pytest.mark.parametrize(("text", "told"), FILES.values(), ids=FILES)
def test_a_text_that_is_too_much(mission: Path, text: str, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = mission.with_name("hostile.yaml")
    path.write_text(text)
    assert told in check(path, capsys)


def test_what_is_no_file(mission: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(mission.with_name("pipe.yaml"))
    mission.with_name("device.yaml").symlink_to("/dev/zero")
    mission.with_name("circle.yaml").symlink_to("circle.yaml")
    assert "not a regular file" in check(mission.with_name("pipe.yaml"), capsys)
    assert "not a regular file" in check(mission.with_name("device.yaml"), capsys)
    assert "is a link to nothing" in check(mission.with_name("circle.yaml"), capsys)
    assert "there is no file" in check("x" * 300 + ".yaml", capsys)
    assert "not a regular file" in check("/dev/zero", capsys)
    mission.with_name("ext.yaml").write_text("extends: pipe\n")
    assert "not a regular file" in check(mission.with_name("ext.yaml"), capsys)


def test_a_long_chain_of_files(mission: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for i in range(40):
        mission.with_name(f"m{i}.yaml").write_text(f"extends: m{i + 1}\n")
    assert "too long a chain" in check(mission.with_name("m0.yaml"), capsys)


def test_what_stands_where_a_mission_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_folder").mkdir()
    (tmp_path / "a_file").touch()
    os.mkfifo(tmp_path / "a_pipe")
    (tmp_path / "dangling.yaml").symlink_to("nowhere.yaml")
    told = {
        "a_folder": "a_folder: is a folder, not a file",
        "a_pipe": "a_pipe: is not a regular file",
        "a_file": "if the file is meant, write './a_file'",
        "dangling.yaml": "'dangling.yaml' is a link to nothing",
        "dangling.yml": "there is no file 'dangling.yml'",
    }
    for name, sentence in told.items():
        assert main(["run", name]) == 2
        said = " ".join(capsys.readouterr().err.split())
        assert sentence in said
        assert "did you mean" not in said
