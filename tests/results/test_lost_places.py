"""A flight is not lost with the place for its results: too little room, a full disk, two runs into one folder."""

import dataclasses
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from swarmsim.atomic_folder import claimed
from swarmsim.config.errors import InputError
from swarmsim.results import out_folder, run_directory
from swarmsim.results.out_folder import check_space
from swarmsim.results.record import MissionRecord
from swarmsim.results.run_directory import write_run
from swarmsim.site.model import SiteModel
from tests import synthetic
from tests.results.test_run_directory import ALL, built

HOLDER = """
import sys, time
from pathlib import Path
from swarmsim.atomic_folder import claimed
with claimed(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture(scope="module")
def site() -> SiteModel:
    return synthetic.site_model(mesh_step_m=5.0)


@pytest.fixture(scope="module")
def record() -> MissionRecord:
    return synthetic.mission(log_hz=5.0, sample_hz=2.0)


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where results are kept when they cannot be written; the disk of ``tmp_path / "disk"`` is full for recordings."""
    places, disk = tmp_path / "temporary", tmp_path / "disk"
    places.mkdir()
    disk.mkdir()
    monkeypatch.setattr(out_folder.tempfile, "gettempdir", lambda: str(places))
    monkeypatch.setenv("HOME", str(disk))
    monkeypatch.setattr(run_directory.figures, "write", lambda record, site, folder: folder.mkdir())

    def write_recording(record: MissionRecord, site: SiteModel, path: Path) -> None:
        if path.is_relative_to(disk):
            raise OSError(28, "No space left on device")
        path.write_bytes(b"rrd")

    monkeypatch.setattr(run_directory, "write_recording", write_recording)
    return places


def test_results_that_cannot_be_written_are_kept(
    kept: Path, record: MissionRecord, site: SiteModel, tmp_path: Path
) -> None:
    out = tmp_path / "disk" / "recon"
    with pytest.raises(InputError, match="No space left on device") as caught:
        write_run(built(site), [record], out, keep=True)
    (folder,) = kept.iterdir()
    assert str(folder) in str(caught.value)
    assert {path.name for path in folder.iterdir()} == ALL
    assert list(out.parent.iterdir()) == []


def test_results_are_kept_where_the_place_was_taken_meanwhile(
    kept: Path, record: MissionRecord, site: SiteModel, tmp_path: Path
) -> None:
    out = tmp_path / "elsewhere" / "recon"
    write_run(built(site), [record], out)
    with pytest.raises(InputError, match=r"(?s)results already.*are kept in"):
        write_run(built(site), [record], out, keep=True)
    (folder,) = kept.iterdir()
    assert {path.name for path in folder.iterdir()} == ALL


def test_a_bug_in_one_file_keeps_the_others(
    kept: Path, record: MissionRecord, site: SiteModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(run_directory.figures, "write", broken)
    with pytest.raises(ZeroDivisionError) as caught:
        write_run(built(site), [record], tmp_path / "run", keep=True)
    folders = [folder for folder in kept.iterdir() if str(folder) in "".join(caught.value.__notes__)]
    assert len(folders) == 1
    assert {path.name for path in folders[0].iterdir()} == ALL - {"figures"}


def test_too_little_room_is_told_before_the_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_space(tmp_path / "new" / "run")
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(out_folder.shutil, "disk_usage", lambda _: usage._replace(free=30_000_000))
    with pytest.raises(InputError, match=r"(?s)too little room.*30 MB free.*at least 100 MB"):
        check_space(tmp_path / "new" / "run")
    assert list(tmp_path.iterdir()) == []


def test_a_second_run_into_a_folder_is_refused_and_a_dead_one_is_cleared_away(tmp_path: Path) -> None:
    out = tmp_path / "runs" / "recon"
    command = [sys.executable, "-c", HOLDER, str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(InputError, match=f"another run is being written there .process {other.pid}."), claimed(out):
            pytest.fail("two hold the folder")
        with claimed(out.with_name("another")):
            pass
        other.send_signal(signal.SIGKILL)
        other.wait()
    assert len(list(out.parent.iterdir())) == 1  # what the dead process left
    with claimed(out), claimed(out) as work:
        assert list(out.parent.iterdir()) == [work]
    assert list(out.parent.iterdir()) == []


def test_a_batch_is_kept_too(kept: Path, record: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    batch = [record, dataclasses.replace(record, seed=1)]
    with pytest.raises(InputError):
        write_run(built(site), batch, tmp_path / "disk" / "batch", keep=True)
    (folder,) = kept.iterdir()
    assert {path.name for path in folder.iterdir()} == ALL | {"missions.parquet", "sources.parquet"}


def test_a_recording_that_rerun_cannot_write_is_told(
    kept: Path, record: MissionRecord, site: SiteModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_recording(record: MissionRecord, site: SiteModel, path: Path) -> None:
        raise RuntimeError("File-writer thread shut down prematurely")  # what Rerun raises on a full disk

    monkeypatch.setattr(run_directory, "write_recording", write_recording)
    for free, told in ((1000, "No space left on device"), (10**9, "File-writer thread")):
        usage = shutil.disk_usage(tmp_path)._replace(free=free)
        monkeypatch.setattr(run_directory.shutil, "disk_usage", lambda _, usage=usage: usage)
        with pytest.raises(InputError, match=told):
            write_run(built(site), [record], tmp_path / "run")
