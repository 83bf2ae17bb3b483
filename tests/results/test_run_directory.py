"""A run on disk: what is in the files, and that a run is complete or absent whatever goes wrong."""

import dataclasses
import json
import os
import shutil
import types
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from swarmsim.config.errors import InputError
from swarmsim.results import run_directory
from swarmsim.results.batch import batch_row
from swarmsim.results.out_folder import EXPORT, READ_LOG, RUN, check_folder, check_out
from swarmsim.results.record import MissionRecord
from swarmsim.results.run_directory import Built, write_run
from swarmsim.results.summary import Timings
from swarmsim.site.model import SiteModel
from tests import synthetic

TIMINGS = Timings(compile_s=1.0, run_s=2.0)
YAML = "name: synthetic\nseed: 0\n"
ALL = {
    "scenario.yaml",
    "summary.json",
    "measurements.parquet",
    "spectrum.parquet",
    "trajectories.parquet",
    "radiation_map.npz",
    "mission.rrd",
    "figures",
}


@pytest.fixture(scope="module")
def site() -> SiteModel:
    return synthetic.site_model(mesh_step_m=5.0)


def built(site: SiteModel, yaml: str = YAML) -> Built:
    """Stand-in for a simulation: what the files say of it."""
    return types.SimpleNamespace(scenario=types.SimpleNamespace(to_yaml=lambda: yaml), site_model=site)


@pytest.fixture(scope="module")
def record() -> MissionRecord:
    return synthetic.mission(log_hz=5.0, sample_hz=2.0)


@pytest.fixture(scope="module")
def run(record: MissionRecord, site: SiteModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "new" / "recon"
    write_run(built(site), [record], out, TIMINGS)
    return out


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins for the slow pictures, where a test is about the folder."""
    monkeypatch.setattr(run_directory.figures, "write", lambda record, site, folder: folder.mkdir())
    monkeypatch.setattr(run_directory, "write_recording", lambda record, site, path: path.write_bytes(b"rrd"))


def test_a_run_has_all_its_files_and_no_others(run: Path) -> None:
    assert {path.name for path in run.iterdir()} == ALL
    assert len(list((run / "figures").glob("*.png"))) == 5
    assert (run / "scenario.yaml").read_text() == YAML
    assert [path.name for path in run.parent.iterdir()] == ["recon"]
    content = json.loads((run / "summary.json").read_text())
    assert content["source"]["error_m"] == pytest.approx(0.25)
    assert content["timing"]["compile_s"] == 1.0
    assert 0.0 < content["timing"]["write_s"] < 60.0


def test_files_can_be_read_by_others(run: Path) -> None:
    umask = os.umask(0)
    os.umask(umask)
    assert run.stat().st_mode & 0o777 == 0o777 & ~umask


def test_measurements_as_they_were_made(run: Path, record: MissionRecord) -> None:
    table = pq.read_table(run / "measurements.parquet")
    samples = record.samples
    assert table.num_rows == len(samples.time_s)
    assert set(table.column_names) == {
        "vehicle",
        "phase",
        "time_s",
        "east_m",
        "north_m",
        "up_m",
        "counts",
        "exposure_s",
        "count_rate_cps",
    }
    names = [v.name for v in record.vehicles]
    assert table["vehicle"].to_pylist() == [names[k] for k in samples.vehicle]
    assert table["phase"].to_pylist() == samples.phase.tolist()
    np.testing.assert_array_equal(table["time_s"].to_numpy(), samples.time_s)
    np.testing.assert_array_equal(table["counts"].to_numpy(), samples.counts)
    np.testing.assert_allclose(table["up_m"].to_numpy(), samples.position_m[:, 2], rtol=1e-6)
    assert table.schema.metadata[b"seed"] == b"0"
    assert b"ENU" in table.schema.metadata[b"frame"]


def test_trajectories_as_they_were_flown(run: Path, record: MissionRecord) -> None:
    table = pq.read_table(run / "trajectories.parquet")
    assert table.num_rows == sum(len(v.time_s) for v in record.vehicles)
    rover = table.filter(pc.equal(table["vehicle"].cast("string"), "orpheus"))
    expected = record.vehicles[3]
    np.testing.assert_allclose(rover["north_m"].to_numpy(), expected.position_m[:, 1], rtol=1e-6)
    np.testing.assert_allclose(rover["quaternion_z"].to_numpy(), expected.quaternion[:, 3], atol=1e-6)
    np.testing.assert_allclose(rover["velocity_east_m_s"].to_numpy(), expected.velocity_m_s[:, 0], atol=1e-5)


def test_map_with_its_axes(run: Path, record: MissionRecord) -> None:
    with np.load(run / "radiation_map.npz") as made:
        np.testing.assert_array_equal(made["mean_cps"], record.map.mean_cps)
        assert made["mean_cps"].shape == (len(made["north_m"]), len(made["east_m"]))
        assert (made["east_m"][0], made["north_m"][0]) == (-65.0, -50.0)
        np.testing.assert_array_equal(made["hotspots_m"], record.map.hotspots_m)


@pytest.mark.usefixtures("quick")
def test_a_batch_has_a_row_for_each_mission(record: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    nothing = dataclasses.replace(synthetic.mission(found=False, log_hz=5.0, sample_hz=2.0), seed=2)
    batch = [record, dataclasses.replace(record, seed=1), nothing]
    content = write_run(built(site), batch, tmp_path / "batch", TIMINGS)
    assert {path.name for path in (tmp_path / "batch").iterdir()} == ALL | {"missions.parquet", "sources.parquet"}
    found = pq.read_table(tmp_path / "batch" / "sources.parquet").to_pylist()
    assert [(row["seed"], row["number"]) for row in found] == [
        (seed, n) for seed in (0, 1) for n in range(len(record.estimates))
    ]
    estimate = record.estimates[0]
    assert (found[0]["nuclide"], found[0]["east_m"]) == (estimate.nuclide, pytest.approx(estimate.position_m[0]))
    assert found[0]["std_east_m"] == pytest.approx(float(np.sqrt(estimate.covariance_m2[0][0])))
    table = pq.read_table(tmp_path / "batch" / "missions.parquet")
    assert table["seed"].to_pylist() == [0, 1, 2]
    assert table["source_error_m"].to_pylist() == [pytest.approx(0.25), pytest.approx(0.25), None]
    assert table["nuclide"].to_pylist() == ["Co-60", "Co-60", None]
    assert content == json.loads((tmp_path / "batch" / "summary.json").read_text())
    assert content["missions"] == 3


@pytest.mark.usefixtures("quick")
def test_a_batch_that_found_nothing_keeps_its_columns(site: SiteModel, tmp_path: Path) -> None:
    nothing = synthetic.mission(found=False, log_hz=5.0, sample_hz=2.0)
    write_run(built(site), [nothing, dataclasses.replace(nothing, seed=1)], tmp_path / "batch", TIMINGS)
    assert not (tmp_path / "batch" / "sources.parquet").exists()
    schema = pq.read_schema(tmp_path / "batch" / "missions.parquet")
    assert str(schema.field("source_error_m").type) == "double"
    assert str(schema.field("nuclide").type) == "string"


def test_a_mission_that_found_nothing_is_written_whole(site: SiteModel, tmp_path: Path) -> None:
    write_run(built(site), [synthetic.mission(found=False, log_hz=5.0, sample_hz=2.0)], tmp_path / "none", TIMINGS)
    assert {path.name for path in (tmp_path / "none").iterdir()} == ALL - {"spectrum.parquet"}
    assert json.loads((tmp_path / "none" / "summary.json").read_text())["source"]["position_m"] is None


def test_a_mission_without_a_map_has_no_file_of_one(site: SiteModel, tmp_path: Path) -> None:
    content = write_run(built(site), [synthetic.swarm(20, 30.0)], tmp_path / "swarm")
    assert {path.name for path in (tmp_path / "swarm").iterdir()} == ALL - {"radiation_map.npz", "spectrum.parquet"}
    assert [path.name for path in (tmp_path / "swarm" / "figures").glob("*.png")] == ["trajectories.png"]
    assert pq.read_table(tmp_path / "swarm" / "measurements.parquet").num_rows == 0
    assert content["success"]
    assert content["real_time_factor"] is None


def test_columns_of_a_phase_that_only_some_missions_came_to(record: MissionRecord) -> None:
    short = dataclasses.replace(record, seed=1, phases=record.phases[:1])
    for batch in ([record, short], [short, record]):
        rows = [batch_row(one) for one in batch]
        table = run_directory.missions_table(rows)
        assert table.column_names == list(batch_row(record))
        assert table["covered"].to_pylist() == [record.covered] * 2
        assert "standard deviations" in table.schema.metadata[b"content"].decode()
        assert table["search_duration_s"].to_pylist() == [row.get("search_duration_s") for row in rows]


@pytest.mark.parametrize(
    ("fault", "told", "text"),
    [
        (KeyboardInterrupt, KeyboardInterrupt, None),
        (OSError(28, "No space left on device"), InputError, "cannot be written there .No space left on device"),
        (MemoryError, MemoryError, None),
    ],
)
@pytest.mark.parametrize(
    "where", ["measurements_table", "trajectories_table", "_write_map", "write_recording", "summary"]
)
@pytest.mark.parametrize("earlier", [False, True])
@pytest.mark.usefixtures("quick")
def test_a_fault_leaves_the_place_as_it_was(
    where: str,
    fault: BaseException,
    told: type[BaseException],
    text: str | None,
    earlier: bool,
    record: MissionRecord,
    site: SiteModel,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "recon"
    if earlier:
        write_run(built(site, "the earlier one"), [record], out, TIMINGS)

    def fail(*_: object) -> None:
        raise fault

    monkeypatch.setattr(run_directory, where, fail)
    with pytest.raises(told, match=text):
        write_run(built(site), [record], out, TIMINGS, force=True)
    assert [path.name for path in tmp_path.iterdir()] == (["recon"] if earlier else [])
    if earlier:
        assert (out / "scenario.yaml").read_text() == "the earlier one"


@pytest.mark.parametrize("failing", [1, 2])
@pytest.mark.usefixtures("quick")
def test_a_fault_in_the_exchange_brings_the_earlier_run_back(
    failing: int, record: MissionRecord, site: SiteModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "recon"
    write_run(built(site, "the earlier one"), [record], out, TIMINGS)
    calls = 0
    rename = Path.rename

    def fail_once(self: Path, target: Path) -> Path:
        nonlocal calls
        calls += 1
        if calls == failing:
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail_once)
    with pytest.raises(KeyboardInterrupt):
        write_run(built(site), [record], out, TIMINGS, force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["recon"]
    assert (out / "scenario.yaml").read_text() == "the earlier one"


@pytest.mark.usefixtures("quick")
def test_force_replaces_a_run_and_leaves_nothing_of_it(record: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    out = tmp_path / "recon"
    write_run(built(site, "the earlier one"), [record, record], out, TIMINGS)
    write_run(built(site), [record], out, TIMINGS, force=True)
    assert {path.name for path in out.iterdir()} == ALL
    assert [path.name for path in tmp_path.iterdir()] == ["recon"]


@pytest.mark.usefixtures("quick")
def test_without_force_results_are_kept(record: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    out = tmp_path / "recon"
    write_run(built(site, "the earlier one"), [record], out, TIMINGS)
    with pytest.raises(InputError, match=r"(?s)results already.*--force"):
        write_run(built(site), [record], out, TIMINGS)
    assert (out / "scenario.yaml").read_text() == "the earlier one"


@pytest.mark.usefixtures("quick")
def test_a_run_that_finished_first_is_not_overwritten(
    record: MissionRecord, site: SiteModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "recon"

    def meanwhile(_: object, __: Path) -> None:
        out.mkdir()
        (out / "summary.json").write_text("of the other one")
        (out / "scenario.yaml").touch()

    monkeypatch.setattr(run_directory, "_write_map", meanwhile)
    with pytest.raises(InputError, match="results already"):
        write_run(built(site), [record], out, TIMINGS)
    assert (out / "summary.json").read_text() == "of the other one"
    assert [path.name for path in tmp_path.iterdir()] == ["recon"]


def test_a_folder_of_something_else_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(InputError, match="something else than a run"):
        check_out(tmp_path, force=True)
    with pytest.raises(InputError, match="something else than a folder"):
        check_out(tmp_path / "thesis.tex", force=True)
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(InputError, match="something else than a folder"):
        check_out(tmp_path / "link", force=True)
    with pytest.raises(InputError, match="cannot be written"):
        check_out(tmp_path / "thesis.tex" / "run", force=False)


@pytest.mark.parametrize("left", [("flown.json", "flown.parquet", "flight.tlog"), ("flight.log",), ("flown.parquet",)])
def test_what_a_flight_left_that_gave_up_early_may_be_replaced(tmp_path: Path, left: tuple[str, ...]) -> None:
    for name in left:
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=r"(?s)results already.*--force"):
        check_out(tmp_path, force=False)
    check_out(tmp_path, force=True)
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(InputError, match="something else than a run"):
        check_out(tmp_path, force=True)
    (tmp_path / "thesis.tex").unlink()
    (tmp_path / "flown").mkdir()
    with pytest.raises(InputError, match="something else than a run"):
        check_out(tmp_path, force=True)


def test_each_kind_of_results_replaces_its_own_alone(tmp_path: Path) -> None:
    made = {RUN: ("summary.json", "scenario.yaml"), READ_LOG: ("log.json", "track.parquet"), EXPORT: ("uav1.n42",)}
    for kind, files in made.items():
        folder = tmp_path / files[0]
        folder.mkdir()
        for file in files:
            (folder / file).touch()
        for other in made:
            if other is kind:
                check_folder(folder, True, other)
                with pytest.raises(InputError, match="already"):
                    check_folder(folder, False, other)
            else:
                with pytest.raises(InputError, match=f"something else than {other.what}"):
                    check_folder(folder, True, other)


def test_a_place_where_no_file_can_be_made_is_told_before_the_flight() -> None:
    if not Path("/proc/self").exists():
        pytest.skip("no file system here that takes no files")
    with pytest.raises(InputError, match="cannot be written there"):
        check_out(Path("/proc/run"), force=False)


@pytest.mark.usefixtures("quick")
def test_an_empty_folder_is_as_good_as_none(record: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    out = tmp_path / "recon"
    out.mkdir()
    write_run(built(site), [record], out, TIMINGS)
    assert {path.name for path in out.iterdir()} == ALL
    shutil.rmtree(out)


@pytest.mark.usefixtures("quick")
def test_relative_paths(
    record: MissionRecord, site: SiteModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_run(built(site), [record], "runs/recon", TIMINGS)
    assert (tmp_path / "runs" / "recon" / "summary.json").is_file()
