"""What is on the figures, asked of the figures themselves."""

import dataclasses
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection, PolyCollection
from matplotlib.contour import QuadContourSet
from matplotlib.patches import Ellipse

from swarmsim.playback import figures, plan
from swarmsim.playback.colours import TRUTH, away_from_pads, rate_scales
from swarmsim.results.record import MissionRecord
from swarmsim.site.model import SiteModel
from tests import synthetic
from tests.playback.prints import check_print, labels, texts

pytestmark = pytest.mark.usefixtures("print_style")


def check_plan(axes: Axes) -> None:
    """To scale, labelled with units, north up."""
    assert axes.get_aspect() == 1.0
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("East [m]", "North [m]")
    assert axes.get_ylim()[0] < axes.get_ylim()[1]
    (arrow,) = [text for text in axes.texts if text.get_text() == "N"]
    axes.figure.canvas.draw()
    assert not arrow.get_window_extent().overlaps(axes.get_window_extent())  # it hides nothing


def test_trajectories_show_every_track_over_the_buildings(found: MissionRecord, site: SiteModel) -> None:
    figure = figures.trajectories(found, site)
    axes = figure.axes[0]
    check_plan(axes)
    assert (*axes.get_xlim(), *axes.get_ylim()) == pytest.approx((-75, 75, -60, 60))
    assert labels(axes) == ["uav1", "uav2", "uav3", "orpheus", "true source", "start", "obstacles"]
    drawn = {line.get_label(): line.get_xydata() for line in axes.lines}
    for vehicle in found.vehicles:
        track = drawn[vehicle.name]
        assert np.ptp(track, axis=0) == pytest.approx(np.ptp(vehicle.position_m[:, :2], axis=0), abs=0.3)
    (shapes,) = [c for c in axes.collections if isinstance(c, PolyCollection)]
    points = np.stack(np.meshgrid(np.arange(-74.6, 75), np.arange(-59.6, 60)), axis=-1).reshape(-1, 2)
    inside = np.zeros(len(points), bool)
    for cx, cy, length, width, _ in synthetic.BUILDINGS:
        inside |= np.all(np.abs(points - (cx, cy)) <= (length / 2, width / 2), axis=1)
    shaded = np.any([path.contains_points(points) for path in shapes.get_paths()], axis=0)
    np.testing.assert_array_equal(shaded, inside)
    assert np.max(shapes.get_array()) == pytest.approx(max(height for *_, height in synthetic.BUILDINGS), abs=0.01)


def test_flown_measurements_are_all_there_in_the_colour_of_their_rate(found: MissionRecord, site: SiteModel) -> None:
    figure = figures.flown_measurements(found.phases[0], found, site)
    check_plan(figure.axes[0])
    (dots,) = [c for c in figure.axes[0].collections if isinstance(c, PathCollection)]
    samples = found.samples.of_phase("survey")
    np.testing.assert_allclose(np.asarray(dots.get_offsets()), samples.position_m[:, :2])
    rates = np.asarray(dots.get_array())
    expected = synthetic.rate_cps(samples.position_m)
    assert np.abs(rates - expected).mean() < 0.3 * np.sqrt(expected.mean())  # 0.8 / sqrt(11) and the ends
    assert "Count rate, 1 s mean [1/s]" in texts(figure)


def test_map_shows_truth_hotspot_and_the_ellipse_of_95_percent(found: MissionRecord, site: SiteModel) -> None:
    figure = figures.radiation_map(found, site)
    whole, close = figure.axes[:2]
    assert found.map is not None
    for axes in (whole, close):
        check_plan(axes)
        np.testing.assert_array_equal(np.asarray(axes.images[-1].get_array()), found.map.mean_cps)
        (ellipse,) = [p for p in axes.patches if isinstance(p, Ellipse)]
        assert found.survey_estimate is not None
        assert ellipse.center == pytest.approx(tuple(found.survey_estimate.position_m[:2]))
        variances = np.linalg.eigvalsh(found.survey_estimate.covariance_m2[:2, :2])
        assert ellipse.width == pytest.approx(2 * np.sqrt(5.991 * variances[1]), rel=1e-3)
        assert ellipse.height == pytest.approx(2 * np.sqrt(5.991 * variances[0]), rel=1e-3)
    assert (*whole.get_xlim(), *whole.get_ylim()) == pytest.approx((-75, 75, -60, 60))
    assert {"hotspot", "true source", "survey estimate, 95 % ellipse"} <= set(labels(whole))
    assert any(text.startswith("median standard deviation ") for text in texts(figure))
    contours = [text for text in texts(figure) if text.isdigit() and 95 < int(text) < 240]
    assert len(contours) >= 2


def test_what_lies_in_another_box_has_no_outline_of_its_own(site: SiteModel) -> None:
    boxes = site.site.obstacles
    half, centre = np.asarray(boxes.half_extent_m).copy(), np.asarray(boxes.centre_m).copy()
    half[1], centre[1] = 0.3 * half[0], centre[0]  # in the first one, with sides along others
    half[3], centre[3] = half[2], centre[2]  # as the third one
    axis = np.asarray(boxes.axis).copy()
    axis[1] = (0.6, 0.8)
    obstacles = dataclasses.replace(boxes, half_extent_m=half, centre_m=centre, axis=axis)
    axes = plan.new_figure(3.5, 3.0).add_axes((0.0, 0.0, 1.0, 1.0))
    plan.outline_site(axes, dataclasses.replace(site, site=dataclasses.replace(site.site, obstacles=obstacles)))
    (shapes,) = axes.collections
    assert len(shapes.get_paths()) == len(synthetic.BUILDINGS) - 2


def test_counts_above_the_pads_do_not_set_the_scale_of_a_survey(found: MissionRecord, site: SiteModel) -> None:
    phase, samples = found.phases[0], found.samples
    pads = np.array([vehicle.position_m[0, :2] for vehicle in found.vehicles])
    near = np.linalg.norm(samples.position_m[:, :2] - pads[samples.vehicle], axis=1) < 2.0
    assert near.any()
    loud = np.where(near & (samples.phase == phase.name), 50.0, 1.0) * samples.counts
    record = dataclasses.replace(found, samples=dataclasses.replace(samples, counts=loud))
    scale, louder = (rate_scales(each)["flown"].limits_cps[1] for each in (found, record))
    assert louder == pytest.approx(scale)
    figure = figures.flown_measurements(phase, record, site)
    (dots,) = [c for c in figure.axes[0].collections if isinstance(c, PathCollection)]
    assert np.asarray(dots.get_array()).max() > 2.0 * dots.norm.vmax
    assert dots.colorbar is not None
    assert dots.colorbar.extend == "max"
    still = dataclasses.replace(found.vehicles[0], position_m=np.tile(found.vehicles[0].position_m[0], (2, 1)))
    own = samples.rows(near & (samples.vehicle == 0))
    assert away_from_pads(dataclasses.replace(found, vehicles=(still,)), own).all()  # rather than nothing


def test_an_estimate_whose_errors_are_not_known_has_no_ellipse(found: MissionRecord, site: SiteModel) -> None:
    assert found.survey_estimate is not None
    doubtful = dataclasses.replace(found.survey_estimate, errors_known=False)
    figure = figures.radiation_map(dataclasses.replace(found, survey_estimate=doubtful), site)
    for axes in figure.axes[:2]:
        assert not [p for p in axes.patches if isinstance(p, Ellipse)]
    assert "survey estimate (saturated counter)" in labels(figure.axes[0])
    check_print(figure)


@pytest.fixture
def three(found: MissionRecord) -> MissionRecord:
    """The mission with two further sources, one of them on its close-up and one far off."""
    survey, final = found.survey_estimate, found.estimate
    assert survey is not None
    assert final is not None
    places = (np.array([18.0, -1.0, 1.0]), np.array([-40.0, -30.0, 1.0]))
    return dataclasses.replace(
        found,
        survey_further=tuple(dataclasses.replace(survey, position_m=place + 0.5) for place in places),
        further=tuple(dataclasses.replace(final, position_m=place) for place in places),
    )


def test_every_source_found_is_drawn_under_one_entry(three: MissionRecord, site: SiteModel) -> None:
    of_map, of_search = (
        figures.figures_of(three)[name](three, site) for name in ("radiation_map", "measurements_search")
    )
    for figure, estimates, name in ((of_map, three.survey_estimates, "survey"), (of_search, three.estimates, "final")):
        places = [one.position_m[:2] for one in estimates]
        for axes in figure.axes[:2]:
            np.testing.assert_allclose([p.center for p in axes.patches if isinstance(p, Ellipse)], places)
            (dots,) = [line for line in axes.lines if str(line.get_label()).startswith(name)]
            np.testing.assert_allclose(dots.get_xydata(), places)
        assert [each for each in labels(figure.axes[0]) if name in each] == [f"{name} estimates, 95 % ellipses"]
        check_print(figure)


def test_sources_with_and_without_known_errors_have_an_entry_each(three: MissionRecord, site: SiteModel) -> None:
    near, far = three.survey_further
    mixed = (dataclasses.replace(near, errors_known=False), far)
    figure = figures.radiation_map(dataclasses.replace(three, survey_further=mixed), site)
    entries = {"survey estimates, 95 % ellipses", "survey estimate (saturated counter)"}
    assert entries <= set(labels(figure.axes[0]))
    assert len([p for p in figure.axes[0].patches if isinstance(p, Ellipse)]) == 2
    check_print(figure)


def test_a_close_up_of_ground_counts_shows_the_source_that_was_examined(three: MissionRecord, site: SiteModel) -> None:
    """The surest source is another one."""
    assert three.estimate is not None
    place = three.estimate.position_m[:2] + np.array([14.0, 0.0])
    examined = dataclasses.replace(three.estimate, position_m=np.array([*place, 1.0]))
    swapped = dataclasses.replace(three, estimate=three.further[1], further=(examined,))
    close = figures.driven_measurements(three.phases[1], swapped, site).axes[1]
    low, high = np.transpose([close.get_xlim(), close.get_ylim()])
    assert np.all((low + 3.0 <= place) & (place <= high - 3.0))


def test_ellipse_holds_95_percent_of_a_normal_distribution(found: MissionRecord) -> None:
    assert found.survey_estimate is not None
    covariance = found.survey_estimate.covariance_m2
    points = np.random.default_rng(1).multivariate_normal(np.zeros(2), covariance[:2, :2], 40_000)
    width, height, angle = plan.ellipse_95(covariance)
    turn = np.radians(angle)
    along = points @ np.array([np.cos(turn), np.sin(turn)])
    across = points @ np.array([-np.sin(turn), np.cos(turn)])
    assert np.mean((2 * along / width) ** 2 + (2 * across / height) ** 2 < 1) == pytest.approx(0.95, abs=0.005)


def test_driven_measurements_on_a_log_scale_with_a_close_up(found: MissionRecord, site: SiteModel) -> None:
    figure = figures.driven_measurements(found.phases[1], found, site)
    whole, close, bar = figure.axes
    check_plan(whole)
    check_plan(close)
    assert bar.get_yscale() == "log"
    low, high = np.transpose([close.get_xlim(), close.get_ylim()])
    assert found.estimate is not None
    samples = found.samples.of_phase("search")
    strongest = samples.position_m[np.argmax(figures.smoothed_rate(samples)), :2]
    for place in (found.estimate.position_m[:2], strongest):
        assert np.all((low + 3.0 <= place) & (place <= high - 3.0))
    assert np.ptp(close.get_xlim()) == pytest.approx(20.0)
    dots = [c for c in close.collections if isinstance(c, PathCollection)]
    assert len(dots[0].get_offsets()) == len(found.samples.of_phase("search").time_s)
    assert "planned path" in labels(whole)


def test_a_close_up_stays_on_the_site_however_little_is_known(found: MissionRecord, site: SiteModel) -> None:
    assert found.survey_estimate is not None
    vague = dataclasses.replace(
        found.survey_estimate, position_m=np.array([70.0, -58.0, 1.0]), covariance_m2=np.diag([900.0, 900.0, 1.0])
    )
    whole, close, _ = figures.radiation_map(dataclasses.replace(found, survey_estimate=vague), site).axes
    for inner, outer in zip((close.get_xlim(), close.get_ylim()), (whole.get_xlim(), whole.get_ylim()), strict=True):
        assert outer[0] <= inner[0] < inner[1] <= outer[1]
        assert np.ptp(inner) < 0.75 * np.ptp(outer)


def test_close_up_of_a_phase_far_from_the_estimate_shows_its_greatest_rate(
    found: MissionRecord, site: SiteModel
) -> None:
    assert found.estimate is not None
    elsewhere = dataclasses.replace(found.estimate, position_m=np.array([50.0, 45.0, 1.0]))
    figure = figures.driven_measurements(found.phases[1], dataclasses.replace(found, estimate=elsewhere), site)
    centre = np.mean([figure.axes[1].get_xlim(), figure.axes[1].get_ylim()], axis=1)
    assert np.linalg.norm(centre - synthetic.SOURCE_M[:2]) < 6.0


NAMES = ["trajectories", "measurements_survey", "measurements_search", "radiation_map", "spectrum"]


@pytest.mark.parametrize("name", NAMES)
def test_print_quality(name: str, found: MissionRecord, site: SiteModel) -> None:
    figure = figures.figures_of(found)[name](found, site)
    check_print(figure)


@pytest.mark.parametrize("times", [1.0, 3e4])
def test_rates_of_many_digits_leave_room_for_their_label(times: float, found: MissionRecord, site: SiteModel) -> None:
    """A map that was cut off at nothing has no contour along the cut."""
    assert found.map is not None
    samples = dataclasses.replace(found.samples, counts=times * np.asarray(found.samples.counts))
    cells = np.maximum(times * (found.map.mean_cps - np.median(found.map.mean_cps)), 0.0)
    loud = dataclasses.replace(found, samples=samples, map=dataclasses.replace(found.map, mean_cps=cells))
    check_print(figures.figures_of(loud)["measurements_survey"](loud, site))
    figure = figures.radiation_map(loud, site)
    check_print(figure)
    (contours,) = [c for c in figure.axes[0].collections if isinstance(c, QuadContourSet)]
    assert min(contours.levels) > 0.0


@pytest.mark.parametrize("times", [0.003, 0.01, 0.03, 1.0, 3e4])
def test_labels_of_contours_tell_their_levels(times: float, found: MissionRecord, site: SiteModel) -> None:
    """Those of a Geiger tube are of few counts a second."""
    assert found.map is not None
    scaled = dataclasses.replace(found.map, mean_cps=times * found.map.mean_cps)
    figure = figures.radiation_map(dataclasses.replace(found, map=scaled), site)
    (contours,) = [c for c in figure.axes[0].collections if isinstance(c, QuadContourSet)]
    told = {text.get_text() for text in contours.labelTexts}
    assert sorted(map(float, told)) == pytest.approx(list(contours.levels[:3]), rel=1e-6)
    assert max(map(len, told)) <= 7


def test_rates_of_a_geiger_tube_on_the_ground_have_ticks_of_plain_numbers(
    found: MissionRecord, site: SiteModel
) -> None:
    samples = dataclasses.replace(found.samples, counts=0.01 * np.asarray(found.samples.counts))
    figure = figures.driven_measurements(found.phases[1], dataclasses.replace(found, samples=samples), site)
    figure.canvas.draw()
    ticks = [text.get_text() for text in figure.axes[2].get_yticklabels()]
    assert {"2", "5", "10", "20", "50"} <= set(ticks)


@pytest.mark.parametrize("count", [1, 12, 13])
def test_trajectories_of_any_team_have_room_for_their_legend(count: int, site: SiteModel) -> None:
    team = synthetic.swarm(count, 30.0)
    figure = figures.trajectories(team, site)
    check_print(figure)
    named = [vehicle.name for vehicle in team.vehicles] if count <= 12 else ["13 x500"]
    assert labels(figure.axes[0]) == [*named, "start", "obstacles"]


def test_written_at_300_dpi(found: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    written = figures.write(found, site, tmp_path / "figures")
    assert [path.stem for path in written] == NAMES
    for path in written:
        pixels = matplotlib.image.imread(path)
        assert pixels.shape[1] in (1050, 2148)
        colours = (pixels[::3, ::3, :3] * 255).astype(np.int64) @ [1, 256, 65536]
        assert len(np.unique(colours)) > 50
        ink = (pixels[..., :3] < 0.98).any(axis=-1)
        assert 0.03 < ink.mean() < 0.9
        assert path.with_suffix(".pdf").read_bytes().startswith(b"%PDF")


def test_mission_without_a_source(nothing: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    written = figures.write(nothing, site, tmp_path)
    assert [path.stem for path in written] == ["trajectories", "measurements_survey", "radiation_map"]
    figure = figures.radiation_map(nothing, site)
    check_print(figure)
    whole, *others = figure.axes
    assert labels(whole) == ["obstacles", "median standard deviation 1.8 1/s"]
    assert (*whole.get_xlim(), *whole.get_ylim()) == pytest.approx((-75, 75, -60, 60))
    # an even map is one colour; there is nothing to show close up
    assert whole.images[-1].norm.vmax > whole.images[-1].norm.vmin
    assert len(others) == 1  # the colour bar
    assert nothing.map is not None
    hotspot = dataclasses.replace(nothing.map, hotspots_m=np.array([[20.0, 10.0]]))
    both = figures.radiation_map(dataclasses.replace(nothing, map=hotspot), site).axes
    first, second = (axes.images[-1] for axes in both[:2])
    assert (first.norm.vmin, first.norm.vmax) == (second.norm.vmin, second.norm.vmax)


def test_flat_site_without_buildings_and_a_lost_vehicle(found: MissionRecord, site: SiteModel, tmp_path: Path) -> None:
    flat = dataclasses.replace(site, site=dataclasses.replace(site.site, surface_m=site.site.terrain_m))
    lost = dataclasses.replace(found.vehicles[0], position_m=np.full_like(found.vehicles[0].position_m, np.nan))
    record = dataclasses.replace(found, vehicles=(lost, *found.vehicles[1:]))
    assert len(figures.write(record, flat, tmp_path)) == 5


def test_a_swarm_that_sought_nothing_has_its_trajectories_alone(
    swarm: MissionRecord, site: SiteModel, tmp_path: Path
) -> None:
    assert [path.stem for path in figures.write(swarm, site, tmp_path)] == ["trajectories"]
    axes = figures.trajectories(swarm, site).axes[0]
    tracks = [line for line in axes.lines if line.get_linestyle() == "-" and len(np.asarray(line.get_xdata())) > 1]
    assert len(tracks) == 200
    assert labels(axes) == ["200 x500", "start", "obstacles"]


def test_figures_of_phases_with_any_name(found: MissionRecord) -> None:
    phase = dataclasses.replace(found.phases[0], name="by hand/1")
    samples = dataclasses.replace(found.samples, phase=np.full(len(found.samples.time_s), phase.name))
    record = dataclasses.replace(found, phases=(phase,), samples=samples)
    assert "measurements_by_hand_1" in figures.figures_of(record)


def test_lines_areas_and_tracks_of_sources_are_drawn(found: MissionRecord, site: SiteModel) -> None:
    record = synthetic.forms(found)
    axes = figures.trajectories(record, site).axes[0]
    drawn = [line.get_xydata() for line in axes.lines if line.get_color() == TRUTH and line.get_label()[0] == "_"]
    drawn = [each for each in drawn if len(each) > 1]  # the others are crosses
    assert [len(each) for each in drawn] == [2, 5, len(record.vehicles[3].time_s)]
    np.testing.assert_allclose(drawn[2], record.track_of(record.sources[2])[:, :2])
    assert labels(axes).count("true source") == 1
