"""Scenarios against the ground of a site with one hollow building, one solid wall and one hedge."""

import json
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.scenario import load_scenario
from swarmsim.config.site import SiteSpec
from swarmsim.config.site_checks import check_site
from swarmsim.site.model import Obstacles, Site, SiteModel, VisualMesh
from tests.config.project import line_of, spoil

LINE = "nuclide: Co-60, activity_mbq: 1, height_m: 1, line_m"
SURVEY, FIRST = "phases.survey.settings", "phases.0.settings"
ROUND = (
    "{name: b, who: orpheus, policy: waypoints, settings: {speed_m_s: 1, points: [[0, 30], [0, -71]]}, time_limit_s: 9}"
)

OVER = (
    "{name: b, who: uav1, policy: waypoints, time_limit_s: 9, "
    "settings: {speed_m_s: 1, altitude_m: 9, points: [[-60, 24], [60, 24]]}}"
)

CIRCLE = (
    "phases.1={{name: b, who: uav1, policy: orbit, time_limit_s: 9, start: {{after: survey}}, "
    "settings: {{radius_m: {}, altitude_m: 9, speed_m_s: 1, target: {}}}}}"
)

# 160 m x 140 m around the origin, 2 m high ground. Boxes: a building of 20 x 10 x 6 m with walls of 0.3 m, turned by
# 90 degrees; a solid wall of 20 x 1 x 4 m; a hedge of 4 x 4 x 2 m; a place holder of no size.
CENTRES = [[0.0, 0.0, 5.0], [40.0, 20.0, 4.0], [-30.0, 30.0, 3.0], [0.0, 0.0, 2.0]]
HALVES = [[10.0, 5.0, 3.0], [10.0, 0.5, 2.0], [2.0, 2.0, 1.0], [0.0, 0.0, 0.0]]
MATERIALS = ["brick", "concrete", "vegetation", "concrete"]


@pytest.fixture
def site() -> SiteModel:
    names = ("air", "brick", "concrete", "soil", "vegetation")
    raster = np.full((140, 160), 2.0, np.float32)
    clearance = np.full((140, 160), 3.0, np.float32)
    clearance[:, :10] = -1.0
    ground = Site(
        origin_m=jnp.array([-79.5, -69.5]),
        cell_m=jnp.array(1.0),
        terrain_m=jnp.array(raster),
        surface_m=jnp.array(raster),
        clearance_m=jnp.array(clearance),
        cost=jnp.array(raster),
        obstacles=Obstacles(
            centre_m=jnp.array(CENTRES),
            half_extent_m=jnp.array(HALVES),
            axis=jnp.array([[0.0, 1.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.0]]),
            wall_m=jnp.array([0.3, 0.0, 0.0, 0.0]),
            material=jnp.array([names.index(name) for name in MATERIALS], jnp.int32),
        ),
        survey_area_m=jnp.array([[-70.0, -60.0], [70.0, -60.0], [70.0, 60.0], [-70.0, 60.0]]),
        ground_material=jnp.array(3, jnp.int32),
        material_names=names,
    )
    mesh = VisualMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32), np.zeros((0, 4), np.uint8))
    spec = SiteSpec(name="made_up", file="made_up.dae", licence="CC0-1.0", cell_m=1.0)
    return SiteModel(name="made_up", spec=spec, site=ground, mesh=mesh, report={})


def test_the_mission_fits(mission: Path, site: SiteModel) -> None:
    assert check_site(load_scenario(mission), site) == []


@pytest.mark.parametrize(
    ("override", "path", "fragments"),
    [
        ("sources.0.position_m=[90, 0]", "sources.0.position_m", ["outside the site", "x from -80 to 80"]),
        ("sources.0.position_m=[4.85, 3]", "sources.0.position_m", ["inside the wall of a building of brick"]),
        ("sources.0.position_m=[3, 9.85]", "sources.0.position_m", ["inside the wall of a building of brick"]),
        ("sources.0.position_m=[45, 20.2]", "sources.0.position_m", ["inside a solid obstacle of concrete"]),
        (f"sources.0={{{LINE}: [[0, 40], [0, 75]]}}", "sources.0.line_m", ["outside the site", "[0.0, 75.0]"]),
        (f"sources.0={{{LINE}: [[40, 10], [40, 30]]}}", "sources.0.line_m", ["2 of the 24 points of the"]),
        ("vehicles.uav1.position_m=[-85, 0]", "vehicles.0.position_m", ["'uav1' starts outside the site", "x from"]),
        ("vehicles.uav1.position_m=[-79.8, 0]", "vehicles.0.position_m", ["outside the fence", "x from -79.5 to 79.5"]),
        ("vehicles.uav1.position_m=[0, 8]", "vehicles.0.position_m", ["'uav1' starts inside an obstacle of brick"]),
        ("vehicles.uav1.position_m=[5.2, 0]", "vehicles.0.position_m", ["or touches it", "from every obstacle"]),
        ("vehicles.orpheus.position_m=[-69.9, 0]", "vehicles.3.position_m", ["'orpheus' starts where a rover cannot"]),
        ("vehicles.orpheus.position_m=[-75, 0]", "vehicles.3.position_m", ["'orpheus' starts where a rover cannot"]),
        (f"{SURVEY}.area_m=[[0, 0], [200, 0], [0, 60]]", f"{FIRST}.area_m", ["reaches beyond the site", "[200, 0]"]),
        (f"{SURVEY}.area_m=[[0, 0], [5, 0], [5, 60], [0, 60]]", f"{FIRST}.area_m", ["no room for one", "10 m"]),
        (
            "definitions.vehicles.tarot_t650.feet.stiffness_n_m=1e9", "vehicles.0.type",
            ["a time step of 0.005 s is too long for the feet of tarot_t650"],
        ),
        ("failsafes.fence.margin_m=70", "failsafes.fence.margin_m", ["leaves nothing of the site", "less than 69.5"]),
        ("traffic.separation_m=220", "traffic.separation_m", ["the UAVs of the team can nowhere", "the 212.6 m from"]),
        ("phases.search.settings.standoff_m=220", "phases.1.settings.standoff_m", ["no viewpoint so far", "212.6"]),
        (CIRCLE.format(61, "[20, 0]"), "phases.1.settings.radius_m", ["leads over the fence", "come to [81, 0]"]),
        (CIRCLE.format(72, "hotspot"), "phases.1.settings.radius_m", ["round any target", "at most 69.5"]),
        ("mapping.cell_m=0.05", "mapping.cell_m", ["a map of 2800 x 2400 cells", "at most 250000", "larger cell_m"]),
        ("mapping.length_scale_m=0.01", "mapping.length_scale_m", ["too short", "at most 1024", "given:   0.01"]),
        (f"{SURVEY}.line_spacing_m=130", FIRST, ["no room for one survey line", "smaller line_spacing_m"]),
        (
            f"{SURVEY}.area_m=[[-79, -60], [70, -60], [70, 60], [-79, 60]]", f"{FIRST}.area_m",
            ["a survey line ends so near to the fence", "0.5 m from the fence, at [-79, ", "at least 1.78 m"],
        ),
        (f"{SURVEY}.speed_m_s=8", f"{FIRST}.speed_m_s", ["at 8 m/s could not stop", "9.5 m from", "at least 11.2 m"]),
        ("failsafes.fence.margin_m=8.4", f"{FIRST}.speed_m_s", ["1.1 m from the fence", "a lower speed_m_s"]),
        ("phases.search.settings.target=[0, 90]", "phases.1.settings.target", ["the target lies outside"]),
        (f"phases.1={ROUND}", "phases.1.settings.points.1", ["the waypoint lies outside the site", "y from -70 to 70"]),
    ],
)  # fmt: skip
def test_what_does_not_fit(mission: Path, site: SiteModel, override: str, path: str, fragments: list[str]) -> None:
    problems = check_site(load_scenario(mission, [override]), site)
    assert [problem.path for problem in problems] == [path]
    for fragment in fragments:
        assert fragment in str(problems[0])


@pytest.mark.parametrize(
    "override",
    [
        "sources.0.position_m=[0, 8]",  # in the hollow of the building, which is longer along y
        "sources.0.position_m=[-30, 30]",  # in the hedge
        "sources.0.position_m=[45, 22]",  # beside the wall
        f"sources.0={{{LINE}: [[45, 22], [35, 22]]}}",  # along it
        "sources.0={nuclide: Co-60, activity_mbq: 1, on: uav1}",
        "sources.0={nuclide: Co-60, position_m: [45, 20], height_m: 4.5, activity_mbq: 1}",  # on top of the wall
        "vehicles.uav1.position_m=[8, 0]",  # beside the building
        f"{SURVEY}.area_m=[[0, 0], [12, 0], [12, 60], [0, 60]]",  # one line and a bit
    ],
)
def test_what_fits_though_it_is_near(mission: Path, site: SiteModel, override: str) -> None:
    assert check_site(load_scenario(mission, [override]), site) == []


@pytest.mark.parametrize("override", ["[-70, -60], [-77.7, 0], [-70, 60]", "[-77, 0], [0, -69.9], [77, 0], [0, 69.9]"])
def test_lines_may_end_as_near_to_the_fence_as_a_vehicle_stops(mission: Path, site: SiteModel, override: str) -> None:
    scenario = load_scenario(mission, [f"{SURVEY}.area_m=[{override}]", f"{SURVEY}.line_spacing_m=7"])
    assert check_site(scenario, site) == []


@pytest.mark.parametrize(
    ("member", "given", "within_m"),
    [("uav1", [0, 8], 3.2), ("uav2", [-90, 70], 12.5), ("orpheus", [-75, 0], 9.2)],
)
def test_the_nearest_start_with_room_is_one(
    mission: Path, site: SiteModel, member: str, given: list[float], within_m: float
) -> None:
    with_room = check_site(load_scenario(mission, [f"vehicles.{member}.position_m={given}"]), site)[0].suggestion
    assert with_room is not None
    place = with_room.rpartition("about ")[2]
    assert check_site(load_scenario(mission, [f"vehicles.{member}.position_m={place}"]), site) == []
    assert np.hypot(*(np.array(json.loads(place)) - given)) < within_m


def test_no_start_is_told_where_there_is_none_near(mission: Path, site: SiteModel) -> None:
    problems = check_site(load_scenario(mission, ["vehicles.orpheus.position_m=[-400, 0]"]), site)
    assert "nearest place" in problems[0].suggestion  # from the site's edge on
    closed = replace(site, site=replace(site.site, clearance_m=-jnp.ones_like(site.site.clearance_m)))
    problems = check_site(load_scenario(mission, []), closed)
    assert ["nearest place" in (problem.suggestion or "") for problem in problems] == [False]


def test_the_members_of_a_formation_are_told_once(mission: Path, site: SiteModel) -> None:
    formation = "{name: f, type: x500, position_m: [60, 60], formation: {count: 12, columns: 6, spacing_m: 6}}"
    scenario = load_scenario(mission, [f"vehicles.uav3={formation}", "phases.survey.who=[f, uav1]"])
    problems = check_site(scenario, site)
    assert [(problem.path, problem.given) for problem in problems] == [("vehicles.2.position_m", "[84.0, 60.0]")]
    assert "'f5' (and 3 more of its formation) starts outside the site" in str(problems[0])


def test_everything_is_told_at_once_with_lines(mission: Path, site: SiteModel) -> None:
    spoil(mission, "[12.0, 4.0]", "[90.0, 4.0]")
    spoil(mission, "[-60.0, 35.0]", "[45.0, 20.0]")
    problems = check_site(load_scenario(mission), site)
    assert [(problem.path, problem.line) for problem in problems] == [
        ("sources.0.position_m", line_of(mission, "[90.0")),
        ("vehicles.2.position_m", line_of(mission, "[45.0")),
    ]


@pytest.mark.parametrize(
    ("override", "path", "given"),
    [
        ("mapping.cell_m=2", "phases.0.settings.altitude_m", "24 m above the terrain"),
        (f"{SURVEY}.area_m=[[0, 0], [50, 0], [50, 60], [0, 60]]", f"{FIRST}.area_m", "given:   obstacle_clearance_m 5"),
        (f"phases.1={OVER}", "phases.1.settings.points", "over what stands there"),
    ],
)
def test_a_way_over_a_thing_that_reaches_to_the_ceiling(
    mission: Path, site: SiteModel, override: str, path: str, given: str
) -> None:
    surface = np.array(site.site.surface_m)
    surface[90:97, 100:130] += 19.0  # a tower of 30 m by 7 m, and a mast of a single cell
    surface[20, 20] += 90.0
    high = replace(site, site=replace(site.site, surface_m=jnp.array(surface)))
    problems = check_site(load_scenario(mission, [override, "failsafes.fence.ceiling_m=22"]), high)
    assert path in [problem.path for problem in problems]
    assert given in "".join(str(problem) for problem in problems if problem.path == path)
    assert check_site(load_scenario(mission, [override, "failsafes.fence.ceiling_m=25"]), high) == []
    assert check_site(load_scenario(mission, [override, "failsafes.fence={ceiling_m: 22, action: none}"]), high) == []


def test_a_vehicle_whose_body_cannot_be_read(mission: Path, site: SiteModel) -> None:
    vehicles = mission.parents[1] / "vehicles"
    (vehicles / "body.urdf").write_text("<robot name='r'><link name='a'/></robot>")
    for name in ("orpheus", "tarot_t650"):
        vehicle = vehicles / f"{name}.yaml"
        vehicle.write_text(vehicle.read_text() + "\nbody: {file: body.urdf}\n")
    problems = check_site(load_scenario(mission), site)
    assert [(Path(problem.file or "").name, problem.message[:21]) for problem in problems] == [
        ("body.urdf", "the body has no mass:")
    ] * 2


def test_a_waypoint_between_the_fence_and_the_edge_of_the_site(mission: Path, site: SiteModel) -> None:
    phase = f"phases.1={OVER.replace('[60, 24]', '[77, 24]')}"
    scenario = load_scenario(mission, [phase, "failsafes.fence.margin_m=4", f"{SURVEY}.speed_m_s=1"])
    (problem,) = check_site(scenario, site)
    assert problem.path == "phases.1.settings.points.1"
    assert "the waypoint lies outside the fence" in str(problem)
    assert "x from -75.5 to 75.5" in str(problem)
    free = ["failsafes.fence={margin_m: 4, action: none}", f"{SURVEY}.speed_m_s=1"]
    assert check_site(load_scenario(mission, [phase, *free]), site) == []
