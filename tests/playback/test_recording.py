"""The recording, read back chunk by chunk."""

import dataclasses
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr

from swarmsim.playback.recording import write_recording
from swarmsim.playback.story import page as summary_page
from swarmsim.results.record import Event, MissionRecord, Samples
from swarmsim.site.model import SiteModel
from tests import synthetic

TIMELINE = "sim_time"


class Recording:
    """Columns of a recording by entity, with its rows in time order."""

    def __init__(self, path: Path):
        self.tables: dict[str, list[pa.RecordBatch]] = {}
        for chunk in rr.chunk.RrdReader(path).stream():
            self.tables.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())

    def rows(self, entity: str, component: str) -> tuple[np.ndarray, list]:
        """Times in s and values of ``component``; time is NaN where the data are static."""
        times, values = [], []
        for batch in self.tables[entity]:
            names = batch.schema.names
            match = [name for name in names if name.endswith(component)]
            if not match:
                continue
            column = batch.column(match[0])
            if TIMELINE in names:
                time_s = batch.column(TIMELINE).cast(pa.int64()).to_numpy() / 1e9
            else:
                time_s = np.full(len(column), np.nan)
            for when, value in zip(time_s, column.to_pylist(), strict=True):
                if value is not None:
                    times.append(when)
                    values.append(value)
        order = np.argsort(times, kind="stable")
        return np.array(times)[order], [values[k] for k in order]


@pytest.fixture(scope="module")
def path(found: MissionRecord, site: SiteModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "mission.rrd"
    write_recording(found, site, path)
    return path


@pytest.fixture(scope="module")
def recording(path: Path) -> Recording:
    return Recording(path)


def verify(path: Path) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "rerun", "rrd", "verify", str(path)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_rerun_verifies_it_and_refuses_a_truncated_one(path: Path, tmp_path: Path) -> None:
    assert verify(path).returncode == 0
    broken = tmp_path / "broken.rrd"
    broken.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert verify(broken).returncode != 0


def test_written_in_a_second_and_ten_megabytes(site: SiteModel, tmp_path: Path) -> None:
    record = synthetic.mission(sample_hz=14.0)
    assert len(record.samples.time_s) > 10_000
    assert len(site.mesh.triangles) > 30_000
    assert sum(len(v.time_s) for v in record.vehicles) > 4 * 6000
    best = np.inf
    for k in range(3):
        start = time.process_time()  # of all its threads: other work on the machine is none of the writer's
        write_recording(record, site, tmp_path / f"{k}.rrd")
        best = min(best, time.process_time() - start)
    assert best < 1.0
    assert (tmp_path / "0.rrd").stat().st_size < 10e6


def test_poses_are_those_of_the_record_at_ten_hertz(recording: Recording, found: MissionRecord) -> None:
    for vehicle in found.vehicles:
        times, positions = recording.rows(f"/world/vehicles/{vehicle.name}", "Transform3D:translation")
        assert times[0] == vehicle.time_s[0]
        assert times[-1] == pytest.approx(vehicle.time_s[-1], abs=1e-6)
        assert np.diff(times[:-1]) == pytest.approx(0.1, abs=1e-6)
        expected = np.stack([np.interp(times, vehicle.time_s, vehicle.position_m[:, k]) for k in range(3)], -1)
        np.testing.assert_allclose(np.array(positions)[:, 0], expected, atol=1e-3)
        _, turns = recording.rows(f"/world/vehicles/{vehicle.name}", "Transform3D:quaternion")
        wxyz = np.array(turns)[:, 0][:, [3, 0, 1, 2]]
        keep = np.searchsorted(vehicle.time_s, times - 1e-6)
        np.testing.assert_allclose(wxyz, vehicle.quaternion[keep], atol=1e-5)


def test_vehicle_of_a_later_phase_waits_where_it_will_start(
    found: MissionRecord, site: SiteModel, tmp_path: Path
) -> None:
    *flying, rover = found.vehicles
    late = np.flatnonzero(rover.time_s > found.phases[1].start_s)
    arrays = ("time_s", "position_m", "quaternion", "velocity_m_s", "energy_wh", "battery_fraction")
    rover = dataclasses.replace(rover, **{name: getattr(rover, name)[late] for name in arrays})
    path = tmp_path / "late.rrd"
    write_recording(dataclasses.replace(found, vehicles=(*flying, rover)), site, path)
    times, positions = Recording(path).rows(f"/world/vehicles/{rover.name}", "Transform3D:translation")
    assert times[:2] == pytest.approx([found.phases[0].start_s, rover.time_s[0]])
    np.testing.assert_allclose(np.array(positions)[:2, 0], rover.position_m[[0, 0]], atol=1e-4)


def test_every_vehicle_has_a_solid_body_and_its_name(recording: Recording, found: MissionRecord) -> None:
    for vehicle in found.vehicles:
        _, (triangles,) = recording.rows(f"/world/vehicles/{vehicle.name}/body", "Mesh3D:triangle_indices")
        assert len(triangles) > 200
        _, (labels,) = recording.rows(f"/world/vehicles/{vehicle.name}/label", "Points3D:labels")
        assert labels == [vehicle.name]


def test_every_sample_is_a_point_that_appears_when_it_was_taken(recording: Recording, found: MissionRecord) -> None:
    for phase in ("survey", "search"):
        samples = found.samples.of_phase(phase)
        for index in np.unique(samples.vehicle):
            mine = samples.vehicle == index
            entity = f"/world/measurements/{phase}/{found.vehicles[index].name}"
            times, rows = recording.rows(entity, "Points3D:positions")
            np.testing.assert_allclose(np.concatenate(rows), samples.position_m[mine], atol=1e-3)
            for when, row in zip(times[:5], np.cumsum([len(r) for r in rows])[:5], strict=True):
                assert samples.time_s[mine][row - 1] == pytest.approx(when, abs=1e-6)
            assert max(len(row) for row in rows) <= 1.1 * max(1.0, 10.8) + 1  # no more than a second in a row


def test_measurement_colours_follow_the_count_rate(recording: Recording, found: MissionRecord) -> None:
    _, rows = recording.rows("/world/measurements/search/orpheus", "Points3D:colors")
    samples = found.samples.of_phase("search")
    colours = np.concatenate(rows).astype(np.int64)
    green = (colours >> 16) & 255  # of RGBA in one integer; green grows all along viridis
    assert np.corrcoef(green, np.log(samples.count_rate_cps))[0, 1] > 0.95


def test_trails_join_up_into_the_track(recording: Recording, found: MissionRecord) -> None:
    times, strips = recording.rows("/world/trails/uav2", "LineStrips3D:strips")
    segments = np.array(strips)[:, 0]
    assert (np.diff(times) > 0).all()
    np.testing.assert_allclose(segments[1:, 0], segments[:-1, 1], atol=0.06)
    flown = np.linalg.norm(np.diff(found.vehicles[1].position_m, axis=0), axis=1).sum()
    assert np.linalg.norm(segments[:, 1] - segments[:, 0], axis=-1).sum() == pytest.approx(flown, rel=0.01)


def test_map_grows_and_ends_as_the_missions_own(recording: Recording, found: MissionRecord) -> None:
    times, triangles = recording.rows("/world/map", "Mesh3D:triangle_indices")
    sizes = [len(t) for t in triangles]
    assert len(times) > 20
    assert sizes == sorted(sizes)
    assert sizes[0] < 0.2 * sizes[-1]
    ny, nx = found.map.mean_cps.shape
    assert sizes[-1] == 2 * (ny - 1) * (nx - 1)
    assert times[-1] == pytest.approx(found.phases[0].end_s)
    _, colours = recording.rows("/world/map", "Mesh3D:vertex_colors")
    green = (np.array(colours[-1]) >> 16) & 255
    assert np.corrcoef(green, found.map.mean_cps.reshape(-1))[0, 1] > 0.95


def test_map_has_triangles_whenever_it_has_points(recording: Recording, found: MissionRecord) -> None:
    """What the viewer finds at any time, looking back from it: points alone are a mesh that it cannot load."""
    columns = {
        name: recording.rows("/world/map", f"Mesh3D:{name}")
        for name in ("vertex_positions", "triangle_indices", "vertex_colors")
    }
    assert len(columns["vertex_positions"][0]) > 0
    changes = np.unique([when for times, _ in columns.values() for when in np.nan_to_num(times)])
    for now in np.r_[-1.0, 0.0, changes, changes - 1e-6, changes + 1e-6, found.end_s, np.inf]:
        seen = {}
        for name, (times, values) in columns.items():
            past = np.flatnonzero(np.isnan(times) | (times <= now))  # static data hold at all times
            seen[name] = values[past[-1]] if len(past) else []
        points, triangles = len(seen["vertex_positions"]), seen["triangle_indices"]
        assert (points > 0) == (len(triangles) > 0) == (now >= changes[0]), f"at {now} s"
        if points:
            assert np.max(triangles) < points == len(seen["vertex_colors"])


def test_survey_that_missed_the_map_is_recorded_without_one(
    found: MissionRecord, site: SiteModel, tmp_path: Path
) -> None:
    unknown = dataclasses.replace(found.map, mean_cps=np.full_like(found.map.mean_cps, np.nan))
    away = dataclasses.replace(found.samples, position_m=found.samples.position_m + np.array([1e3, 0.0, 0.0]))
    path = tmp_path / "away.rrd"
    write_recording(dataclasses.replace(found, map=unknown, samples=away), site, path)
    assert verify(path).returncode == 0
    assert "/world/map" not in Recording(path).tables


def test_map_lies_just_above_the_ground(recording: Recording) -> None:
    _, (points,) = recording.rows("/world/map", "Mesh3D:vertex_positions")
    x, y, z = np.array(points).T
    above = z - synthetic.ground(x, y)
    assert above.min() > 0.2
    assert above.max() < 0.5


def test_truth_is_static_and_estimates_come_when_they_are_made(recording: Recording, found: MissionRecord) -> None:
    when, (place,) = recording.rows("/world/truth/0/pin/place", "Points3D:positions")
    assert np.isnan(when).all()
    np.testing.assert_allclose(place[0], synthetic.SOURCE_M, atol=1e-4)
    assert found.survey_estimate is not None
    assert found.estimate is not None
    for name, estimate, phase in (("survey", found.survey_estimate, 0), ("final", found.estimate, 1)):
        entity = f"/world/estimate/{name}/0/ellipsoid"
        when, (half_sizes,) = recording.rows(entity, "Ellipsoids3D:half_sizes")
        assert when == pytest.approx([found.phases[phase].end_s])
        expected = np.sqrt(7.815 * np.linalg.eigvalsh(estimate.covariance_m2))
        np.testing.assert_allclose(sorted(half_sizes[0]), expected, rtol=1e-3)


def test_plots_hold_every_rate_and_the_battery_in_percent(recording: Recording, found: MissionRecord) -> None:
    samples = found.samples.of_phase("survey")
    times, values = recording.rows("/plots/samples/survey/uav1", "Scalars:scalars")
    mine = samples.vehicle == 0
    np.testing.assert_allclose(np.array(values)[:, 0], samples.count_rate_cps[mine])
    np.testing.assert_allclose(times, samples.time_s[mine], atol=1e-6)
    _, mean = recording.rows("/plots/rate/survey/uav1", "Scalars:scalars")
    assert np.std(mean) < 0.9 * np.std(values)
    _, battery = recording.rows("/plots/battery/orpheus", "Scalars:scalars")
    assert battery[0][0] == pytest.approx(100.0)
    assert battery[-1][0] == pytest.approx(100.0 * found.vehicles[3].battery_fraction[-1], abs=1e-3)


def test_spectrum_keeps_every_count_and_labels_its_lines(recording: Recording, found: MissionRecord) -> None:
    assert found.spectrum is not None
    _, (values,) = recording.rows("/spectrum/measured", "BarChart:values")
    assert sum(
        values[0]["buffer"]["inner"] if "inner" in values[0]["buffer"] else values[0]["buffer"]
    ) == pytest.approx(found.spectrum.counts.sum())
    assert {"/spectrum/Co-60_1173_keV", "/spectrum/Co-60_1332_keV", "/spectrum/fit"} <= set(recording.tables)


def test_log_tells_the_mission_in_order(recording: Recording, found: MissionRecord) -> None:
    times, texts = recording.rows("/log/mission", "TextLog:text")
    told = [text[0] for text in texts]
    assert told[0] == "survey begins"
    assert any(text.startswith("uav2: finished") for text in told)
    assert any(text.startswith("final estimate: 12.12 ± 0.14 m east") for text in told)
    assert found.finding in told
    assert (np.diff(times) >= 0).all()


def test_planned_path_comes_with_its_phase(recording: Recording, found: MissionRecord) -> None:
    when, (strips,) = recording.rows("/world/paths/orpheus", "LineStrips3D:strips")
    assert when == pytest.approx([found.phases[1].start_s])
    np.testing.assert_allclose(np.array(strips[0])[:, :2], found.paths_m[3][:, :2], atol=1e-4)
    assert not any(entity.startswith("/world/paths/uav") for entity in recording.tables)


def test_only_the_missions_own_timeline(recording: Recording) -> None:
    names = {name for batches in recording.tables.values() for batch in batches for name in batch.schema.names}
    assert TIMELINE in names
    assert not {"log_time", "log_tick"} & names


def test_blueprint_is_stored_with_it(path: Path) -> None:
    assert len(rr.chunk.RrdReader(path).blueprints()) == 1


def test_mission_without_a_source(nothing: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    path = tmp_path / "nothing.rrd"
    write_recording(nothing, site, path)
    assert verify(path).returncode == 0
    recording = Recording(path)
    entities = set(recording.tables)
    assert not any(
        e.startswith(("/world/estimate", "/world/truth", "/world/paths", "/world/hotspots")) for e in entities
    )
    _, (note,) = recording.rows("/spectrum", "TextDocument:text")
    assert "nothing was found" in note[0]
    _, texts = recording.rows("/log/mission", "TextLog:text")
    assert texts[-1] == ["No source above background."]


def test_crash_is_an_error_in_the_log_and_a_broken_track_does_no_harm(
    found: MissionRecord, site: SiteModel, tmp_path: Path
) -> None:
    lost = found.vehicles[1].position_m.copy()
    lost[2000:] = np.nan
    vehicles = list(found.vehicles)
    vehicles[1] = dataclasses.replace(vehicles[1], position_m=lost, crashed=True)
    events = (Event(100.0, "uav2", "non_finite", "position"), *found.events)
    record = dataclasses.replace(found, vehicles=tuple(vehicles), events=events)
    path = tmp_path / "crash.rrd"
    write_recording(record, site, path)
    assert verify(path).returncode == 0
    recording = Recording(path)
    times, texts = recording.rows("/log/mission", "TextLog:text")
    _, levels = recording.rows("/log/mission", "TextLog:level")
    at = [text[0] for text in texts].index("uav2: non finite (position)")
    assert levels[at] == ["ERROR"]
    assert times[at] == 100.0
    _, positions = recording.rows("/world/vehicles/uav2", "Transform3D:translation")
    assert np.isfinite(np.array(positions)).all()


def test_a_swarm_is_small_and_all_of_it_is_drawn(swarm: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    path = tmp_path / "swarm.rrd"
    write_recording(swarm, site, path)
    assert path.stat().st_size < 10e6
    assert verify(path).returncode == 0
    recording = Recording(path)
    entities = sorted(entity for entity in recording.tables if entity.startswith("/world/vehicles/"))
    assert len(entities) == 5  # one for each colour
    drawn = 0
    for entity in entities:
        times, positions = recording.rows(entity, "InstancePoses3D:translations")
        assert np.diff(times).max() < 1.0
        assert (times[0], times[-1]) == pytest.approx((0.0, 300.0))
        first, last = np.array(positions[0]), np.array(positions[-1])
        for start, end in zip(first, last, strict=True):
            one = min(swarm.vehicles, key=lambda v: np.linalg.norm(v.position_m[0] - start))
            np.testing.assert_allclose(start, one.position_m[0], atol=1e-3)
            np.testing.assert_allclose(end, one.position_m[-1], atol=1e-3)
        drawn += len(first)
    assert drawn == 200
    _, strips = recording.rows("/world/trails/x500_1", "LineStrips3D:strips")
    flown = sum(np.linalg.norm(np.diff(v.position_m, axis=0), axis=1).sum() for v in swarm.vehicles[::5])
    steps = np.concatenate([np.array(row) for row in strips])
    assert np.linalg.norm(steps[:, 1] - steps[:, 0], axis=-1).sum() == pytest.approx(flown, rel=0.01)
    _, least = recording.rows("/plots/battery/least", "Scalars:scalars")
    assert least[-1][0] == pytest.approx(100.0 * min(v.battery_fraction[-1] for v in swarm.vehicles), abs=1e-3)
    outside = ("/world/measurements", "/world/map", "/world/legend", "/spectrum", "/plots/rate")
    assert not any(entity.startswith(outside) for entity in recording.tables)


def test_a_large_team_measures_together_and_not_too_much(swarm: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    time = np.repeat(np.arange(1.0, 301.0), 400)  # 120,000 samples, each vehicle two a second
    vehicle = np.tile(np.repeat(np.arange(200, dtype=np.int32), 2), 300)
    counts, phase = np.full(len(time), 90.0), np.full(len(time), "cover")
    samples = Samples(vehicle, phase, time, np.zeros((len(time), 3)), counts, np.ones_like(time), counts)
    path = tmp_path / "counting.rrd"
    write_recording(dataclasses.replace(swarm, samples=samples), site, path)
    assert path.stat().st_size < 10e6
    _, rows = Recording(path).rows("/world/measurements/cover/all", "Points3D:positions")
    assert sum(map(len, rows)) == 60_000


def test_awkward_names_and_no_vehicle_shape(found: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    vehicles = tuple(dataclasses.replace(v, name=f"{v.name}-no.1", shape=None) for v in found.vehicles)
    path = tmp_path / "names.rrd"
    write_recording(dataclasses.replace(found, vehicles=vehicles), site, path)
    assert "/world/vehicles/uav1-no.1" in Recording(path).tables


def test_rerun_errors_are_raised_and_the_global_mode_is_left_alone(site: SiteModel, tmp_path: Path) -> None:
    before = rr.strict_mode()
    with pytest.raises(Exception, match=r"."):
        write_recording(synthetic.mission(), site, tmp_path / "no" / "such" / "folder" / "mission.rrd")
    assert rr.strict_mode() == before


def test_lines_and_areas_have_outlines_and_a_carried_source_moves(
    found: MissionRecord, site: SiteModel, tmp_path: Path
) -> None:
    record = synthetic.forms(found)
    write_recording(record, site, tmp_path / "forms.rrd")
    assert verify(tmp_path / "forms.rrd").returncode == 0
    made = Recording(tmp_path / "forms.rrd")
    for k, closed in ((0, False), (1, True)):
        when, ((strip,),) = made.rows(f"/world/truth/{k}/outline", "LineStrips3D:strips")
        assert np.isnan(when).all()
        corners = np.asarray(record.sources[k].corners_m)
        np.testing.assert_allclose(strip, [*corners, corners[0]] if closed else corners, atol=1e-4)
        _, (points,) = made.rows(f"/world/truth/{k}/points", "Points3D:positions")
        np.testing.assert_allclose(points, np.asarray(record.sources[k].points_m), atol=1e-4)
    _, (label,) = made.rows("/world/labels/truth/0", "Points3D:labels")
    assert label == ["true Cs-137, 300 MBq, a line of 20 m"]
    _, (label,) = made.rows("/world/labels/truth/1", "Points3D:labels")
    assert label == ["true I-131, 500 MBq, an area of 80 m2"]
    for entity in ("/world/truth/2/pin", "/world/labels/truth/2"):
        when, places = made.rows(entity, "Transform3D:translation")
        track = record.track_of(record.sources[2])
        times = record.vehicles[3].time_s
        expected = np.stack([np.interp(when, times, track[:, k]) for k in range(3)], -1)
        np.testing.assert_allclose(np.array(places)[:, 0], expected, atol=1e-3)
        assert when[0] <= record.phases[0].start_s
    page = summary_page(record)
    assert "300 MBq over a line of 20 m round -10.0 m east" in page
    assert f"100 MBq on {record.vehicles[3].name}, at first at" in page
