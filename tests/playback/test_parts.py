"""The parts that recording and figures are made of: colours, bodies, the growing map, the viewer's command."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.config.errors import InputError
from swarmsim.playback import growing_map, viewer
from swarmsim.playback.bodies import shaded, vehicle_mesh
from swarmsim.playback.colours import linear_scale, log_scale, smoothed_rate, vehicle_colours
from swarmsim.playback.scene_marks import ellipsoid, in_cps, quaternion_of
from swarmsim.playback.story import describe
from swarmsim.results.finding import told_activity
from swarmsim.results.record import MissionRecord, Samples
from swarmsim.site.model import SiteModel
from tests import synthetic


def test_vehicles_have_colours_of_their_own(found: MissionRecord) -> None:
    colours = vehicle_colours(found)
    assert len(set(colours)) == len(found.vehicles)


def test_smoothed_rate_is_the_mean_of_each_vehicles_own_second() -> None:
    time = np.repeat(np.arange(1.0, 6.0, 0.1), 2)
    vehicle = np.tile([0, 1], len(time) // 2).astype(np.int32)
    counts = np.where(vehicle == 0, 10.0, 30.0)
    exposure = np.full(len(time), 0.1)
    phase = np.full(len(time), "survey")
    samples = Samples(vehicle, phase, time, np.zeros((len(time), 3)), counts, exposure, counts / exposure)
    np.testing.assert_allclose(smoothed_rate(samples), np.where(vehicle == 0, 100.0, 300.0))


def test_smoothed_rate_lowers_the_noise_as_poisson_says(found: MissionRecord) -> None:
    survey = found.samples.of_phase("survey")
    error = smoothed_rate(survey) - synthetic.rate_cps(survey.position_m)
    raw = survey.count_rate_cps - synthetic.rate_cps(survey.position_m)
    assert error.std() / raw.std() == pytest.approx(1 / np.sqrt(11), rel=0.25)


@pytest.mark.parametrize(
    ("rate", "said"), [(0.314, "0.314 cps"), (2.5, "2.5 cps"), (94.06, "94.1 cps"), (12345.6, "12346 cps")]
)
def test_a_slow_counter_does_not_show_zero(rate: float, said: str) -> None:
    assert in_cps(rate) == said


def test_the_log_tells_a_faint_source_with_its_standard_deviation_where_it_is_known(found: MissionRecord) -> None:
    assert found.estimate is not None
    faint = dataclasses.replace(found.estimate, nuclide="Co-60", activity_mbq=0.0312, activity_std_mbq=0.0041)
    assert describe(faint).endswith(" m up, 0.0312 ± 0.0041 MBq Co-60")
    assert describe(dataclasses.replace(faint, errors_known=False)).endswith(" m up, about 0.031 MBq Co-60")
    assert told_activity(dataclasses.replace(faint, errors_known=False)) == "0.031 MBq"


@pytest.mark.parametrize("scale_of", [linear_scale, log_scale])
@pytest.mark.parametrize("rates", [[], [0.0], [5.0, 5.0], [0.0, 1e5]])
def test_scales_take_anything(scale_of, rates: list[float]) -> None:
    scale = scale_of(np.array(rates, float))
    low, high = scale.limits_cps
    assert low < high
    assert scale(np.array([0.0, 10.0, 1e6])).shape == (3, 4)


@pytest.mark.parametrize("shape_given", [True, False])
def test_bodies_stand_on_their_feet_at_any_scale(found: MissionRecord, shape_given: bool) -> None:
    for vehicle in found.vehicles:
        one = vehicle if shape_given else dataclasses.replace(vehicle, shape=None)
        small, large = (vehicle_mesh(one, "#0072B2", scale) for scale in (1.0, 4.0))
        assert large.vertices_m[:, 2].min() == pytest.approx(small.vertices_m[:, 2].min(), abs=1e-6)
        assert np.ptp(large.vertices_m, axis=0) == pytest.approx(4 * np.ptp(small.vertices_m, axis=0), rel=1e-5)
        np.testing.assert_allclose(np.linalg.norm(small.normals, axis=1), 1.0, atol=1e-5)


def test_rover_and_rotors_have_the_size_of_the_shape(found: MissionRecord) -> None:
    rover = vehicle_mesh(found.vehicles[3], "#0072B2")
    assert np.ptp(rover.vertices_m[:, 0]) == pytest.approx(2 * (0.3 + 0.2), rel=0.01)
    quadrotor = vehicle_mesh(found.vehicles[0], "#0072B2")
    assert np.ptp(quadrotor.vertices_m[:, 0]) == pytest.approx(2 * (0.23 + 0.19), rel=0.01)


def test_shading_keeps_smooth_ground_whole_and_gives_a_box_its_edges() -> None:
    x, y = (grid.reshape(-1) for grid in np.meshgrid(np.arange(5.0), np.arange(5.0)))
    corner = (np.arange(4)[:, None] * 5 + np.arange(4)).reshape(-1, 1)
    triangles = (corner + np.array([[0, 1, 6, 0, 6, 5]])).reshape(-1, 3)
    colours = np.zeros((25, 4), np.uint8)
    flat = shaded(np.stack([x, y, 0.1 * x], -1), triangles, colours)
    assert len(flat.vertices_m) == 25
    np.testing.assert_allclose(flat.normals, np.tile([-0.1, 0.0, 1.0] / np.sqrt(1.01), (25, 1)), atol=1e-6)
    roof = shaded(np.stack([x, y, -2.0 * np.abs(x - 2.0)], -1), triangles, colours)
    x, y, _ = roof.vertices_m.T
    ridge = (np.abs(x - 2.0) < 1e-6) & (y > 0.5) & (y < 3.5)  # at the ends there is more of one face than of the other
    assert sorted(set(np.round(roof.normals[ridge, 0], 3).tolist())) == pytest.approx([-0.894, 0.0, 0.894], abs=1e-3)


def test_partial_map_is_right_where_it_was_flown_and_silent_elsewhere(found: MissionRecord) -> None:
    grid = growing_map.grid_of(found.map)
    early = found.samples.of_phase("survey").until(60.0)
    rate, seen = growing_map.partial_map(early, grid)
    assert 0.05 < seen.mean() < 0.6
    y, x = np.nonzero(seen)
    places = np.stack([grid.x_m[x], grid.y_m[y], np.full(len(x), 20.0)], -1)
    assert np.abs(rate[seen] / synthetic.rate_cps(places) - 1).mean() < 0.1
    flown = early.position_m[early.position_m[:, 2] > 19.0, :2]
    far = np.min(np.linalg.norm(places[:, None, :2] - flown[None, ::20], axis=-1), axis=1)
    assert far.max() < 20.0


def test_large_maps_are_thinned(found: MissionRecord) -> None:
    large = dataclasses.replace(found.map, mean_cps=np.ones((700, 500)), std_cps=np.ones((700, 500)), cell_m=0.2)
    grid = growing_map.grid_of(large)
    assert max(len(grid.x_m), len(grid.y_m)) <= 160
    assert grid.y_m[-1] == pytest.approx(large.origin_m[1] + 0.2 * 699, abs=0.2 * grid.stride)


def test_terrain_is_sampled_bilinearly_and_clamped(site: SiteModel) -> None:
    terrain = np.asarray(site.site.terrain_m)
    x, y = np.array([-74.5, -74.0, 500.0]), np.array([-59.5, -59.5, 500.0])
    expected = [terrain[0, 0], 0.5 * (terrain[0, 0] + terrain[0, 1]), terrain[-1, -1]]
    np.testing.assert_allclose(growing_map.raster_at(terrain, site.site, x, y), expected, rtol=1e-5)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=9, max_size=9))
def test_ellipsoid_rebuilds_its_covariance(entries: list[float]) -> None:
    half = np.reshape(entries, (3, 3))
    covariance = half @ half.T + 0.01 * np.eye(3)
    half_sizes, quaternion = ellipsoid(covariance)
    turn = _matrix(quaternion)
    np.testing.assert_allclose(turn @ np.diag(half_sizes**2 / 7.815) @ turn.T, covariance, atol=1e-8, rtol=1e-6)


def _matrix(xyzw: np.ndarray) -> np.ndarray:
    x, y, z, w = xyzw
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def test_quaternion_of_a_quarter_turn_about_up() -> None:
    quaternion = quaternion_of(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(np.abs(quaternion), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)
    assert quaternion[2] * quaternion[3] > 0


def test_viewer_command(tmp_path: Path) -> None:
    recording = tmp_path / "mission.rrd"
    recording.touch()
    assert viewer.recording_of(tmp_path) == recording
    assert viewer.recording_of(recording) == recording
    assert str(recording) in viewer.viewer_command(recording, web=False)
    web = viewer.viewer_command(recording, web=True)
    assert "--web-viewer" in web
    assert web[web.index("--bind") + 1] == "127.0.0.1"


def test_viewer_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="no such run"):
        viewer.open_recording(tmp_path / "none")
    with pytest.raises(InputError, match="holds no recording"):
        viewer.open_recording(tmp_path)
    (tmp_path / "mission.rrd").touch()
    monkeypatch.setattr(viewer, "viewer_command", lambda recording, web: ["false"])
    with pytest.raises(InputError, match=r"(?s)exit code 1.*--web"):
        viewer.open_recording(tmp_path)
