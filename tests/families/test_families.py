"""Families of missions: what depends on what, regions of a site, and missions that fly."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

import swarmsim
from swarmsim.cli import main
from swarmsim.config.site_ground import Ground
from swarmsim.config.values import with_values

SEEDS = range(60)
BATCH = 8  # missions that fly together, in all tests by the same programs
STAND = """
name: stand
site: meadows
engine: analytic
timing: {decision_period_s: 0.5}
sources: [{nuclide: Co-60, position_m: [-200, 60], height_m: 0.5, activity_mbq: 2000}]
vehicles: [{name: uav, type: tarot_t650, position_m: [-190, 40]}]
phases: [{name: up, who: uav, policy: 'my.py:Stand', settings: {height_m: 6}, time_limit_s: 3}]
vary:
  sources: {count: [1, 3]}
  sources.*.nuclide: {any_nuclide: {yield_min_percent: 50}}
  sources.*.position_m: {place: {region: survey_area, apart_m: 20}}
  sources.*.activity_mbq: {log_uniform: [20, 500]}
  phases.up.settings.height_m: {uniform: [4, 8]}
  wind.speed_m_s: {uniform: [0, 5]}
"""
POLICY = '''
import jax.numpy as jnp
import swarmsim


class Stand:
    """Stand."""

    class Settings(swarmsim.PolicySettings):
        height_m: float = 5.0

    def start(self, task, key):
        return jnp.zeros(())

    def act(self, task, memory, view, key):
        return memory, swarmsim.go_to(view.position_m)
'''


@pytest.fixture(scope="module", params=["works_yard", "meadows"])
def yard(request):
    return swarmsim.build(swarmsim.load("random_recon", [f"site={request.param}", "engine=analytic"]))


@pytest.fixture(scope="module")
def standing(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stand")
    (folder / "my.py").write_text(POLICY, encoding="utf-8")
    (folder / "stand.yaml").write_text(STAND, encoding="utf-8")
    return swarmsim.build(swarmsim.load(folder / "stand.yaml"))


def test_a_mission_draws_the_same_alone_in_a_batch_and_in_any_order(yard):
    together = yard.draw(SEEDS)
    backwards = yard.draw(SEEDS[::-1])
    for seed in (0, 7, 31, 59):
        alone = yard.draw(seed)
        assert alone.told(0) == together.told(seed) == backwards.told(len(SEEDS) - 1 - seed)
        assert {path: each[seed] for path, each in together.values.items()} == {
            path: each for path, (each,) in alone.values.items()
        }


def test_another_path_changes_nothing_in_the_others():
    few = swarmsim.build(swarmsim.load("random_recon", ["engine=analytic"])).draw(SEEDS)
    changes = ["engine=analytic", "vary.radio.loss={uniform: [0, 0.5]}", "vary.wind.from_deg=null"]
    more = swarmsim.build(swarmsim.load("random_recon", changes)).draw(SEEDS)
    assert set(more.values) - set(few.values) == {"radio.loss"}
    assert set(few.values) - set(more.values) == {"wind.from_deg"}
    for path in set(few.values) & set(more.values):
        assert few.values[path] == more.values[path]


def test_a_larger_count_moves_no_source_that_was_there():
    few, more = (
        swarmsim.build(swarmsim.load("random_recon", ["engine=analytic", f"vary.sources={{count: [{n}, {n}]}}"])).draw(
            SEEDS
        )
        for n in (2, 4)
    )
    for path in ("sources.0.position_m", "sources.1.position_m", "sources.1.nuclide", "sources.1.activity_mbq"):
        assert few.values[path] == more.values[path]
    assert "sources.3.position_m" in more.told(0)


def test_sources_are_where_their_region_says_and_apart(yard):
    """Against the site's boxes, in other ways than the regions are computed."""
    ground = Ground(yard.site_model.site, yard.scenario)
    solid = np.flatnonzero(~ground.porous & np.all(ground.half > 0, axis=1))
    draws = yard.draw(SEEDS)
    regions = []
    for index in range(len(SEEDS)):
        told = draws.told(index)
        count = told["sources.count"]
        assert 1 <= count <= 3
        assert f"sources.{count}.position_m" not in told
        places = np.array([told[f"sources.{k}.position_m"] for k in range(count)])
        apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e9 * np.eye(count)
        assert apart.min() >= 15.0
        for k, xy in enumerate(places):
            regions.append(told[f"sources.{k}.region"])
            x0, y0, x1, y1 = *ground.area.min(axis=0), *ground.area.max(axis=0)
            assert x0 <= xy[0] <= x1
            assert y0 <= xy[1] <= y1
            height = told[f"sources.{k}.height_m"]
            assert 0.5 <= height <= 1.5
            inside, near = footprint_distances(ground, xy)
            if regions[-1] == "indoors":
                rooms = [box for box in inside if ground.wall[box] > 0 and ground.half[box, 2] > 1.0]
                assert rooms
            else:
                assert not inside
                assert near.min() >= (3.0 if regions[-1] == "open" else 0.5)
                if regions[-1] == "behind_walls":
                    tops = ground.centre[solid, 2] + ground.half[solid, 2]
                    assert np.any((near[solid] <= 3.0) & (tops > ground.terrain.min() + height))
    assert set(regions) == {"open", "indoors", "behind_walls"}


def footprint_distances(ground: Ground, xy: np.ndarray) -> tuple[list[int], np.ndarray]:
    """Boxes whose footprint holds a place, and the distance to each footprint, by the nearest point of its outline."""
    inside, near = [], np.full(len(ground.half), np.inf)
    for k, (centre, half, (c, s)) in enumerate(zip(ground.centre, ground.half, ground.axis, strict=True)):
        own = np.array([[c, s], [-s, c]]) @ (xy - centre[:2])
        closest = np.clip(own, -half[:2], half[:2])
        near[k] = np.linalg.norm(own - closest)
        if near[k] == 0.0:
            inside.append(k)
    return inside, near


def test_hidden_places_see_less_of_the_horizon_than_open_ones(yard):
    """Rays in small steps, so that the test of the region is tested."""
    ground = Ground(yard.site_model.site, yard.scenario)
    draws = yard.draw(SEEDS)
    seen: dict[str, list[float]] = {"open": [], "behind_walls": []}
    for index in range(40):
        for path, region in draws.regions[index].items():
            if region in seen:
                point = ground.above(np.array([draws.values[path][index]]), 1.0)[0]
                seen[region].append(free_share(ground, point, 3.0))
    assert max(seen["behind_walls"]) <= 0.93
    assert min(seen["open"]) == 1.0


def free_share(ground: Ground, point: np.ndarray, reach: float) -> float:
    """Share of 72 horizontal directions in which no solid box lies within ``reach``."""
    angles = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
    steps = np.arange(0.02, reach + 0.02, 0.02)
    ways = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    points = point + steps[:, None, None] * ways
    solid = ~ground.porous & np.all(ground.half > 0, axis=1)
    thin = np.maximum(0.011 - ground.half, 0.0)  # a step must not lead over a fence of sheet metal
    met = np.stack([np.all((ground.depth(row) + thin)[:, solid] > 0, axis=2).any(axis=1) for row in points])
    return 1.0 - float(met.any(axis=0).mean())


def test_nuclides_are_those_with_a_strong_line(yard):
    values = yard.draw(range(200)).values
    drawn = {name for k in range(3) for name in values[f"sources.{k}.nuclide"]}
    strong = {n.name for n in yard.scenario.nuclides.values() if max(line.yield_percent for line in n.lines) >= 10.0}
    assert drawn - {"Co-60"} <= strong
    assert drawn >= strong - {min(strong)}


@pytest.mark.slow
def test_missions_of_a_family_fly_by_the_same_programs(standing):
    standing.rollout(range(BATCH), values={"sources.0.activity_mbq": [1000.0] * BATCH})
    batch = standing.rollout(range(BATCH, 2 * BATCH))
    assert not batch.clock.compiled
    single = swarmsim.build(swarmsim.load(standing.scenario.mission_file, ["vary={}", SOURCES]))
    assert not single.rollout(range(BATCH)).clock.compiled  # the family's programs are those of a single mission
    assert len({len(swarmsim.mission_record(standing, batch, k).sources) for k in range(BATCH)}) > 1


SOURCES = "sources=[" + ", ".join(
    f"{{nuclide: Co-60, position_m: [{x}, 60], height_m: 0.5, activity_mbq: 10}}" for x in (-200, -150, -100)
) + "]"  # fmt: skip


@pytest.mark.slow
def test_what_was_drawn_is_flown_and_written(standing, tmp_path):
    batch = standing.rollout(range(BATCH))
    records = [swarmsim.mission_record(standing, batch, k) for k in range(BATCH)]
    for k, record in enumerate(records):
        told, world = standing.draw(k).told(0), batch.worlds.of(k)
        assert record.drawn == told
        assert len(record.sources) == told["sources.count"]
        for number, source in enumerate(record.sources):
            assert source.nuclide == told[f"sources.{number}.nuclide"]
            assert source.activity_mbq == pytest.approx(told[f"sources.{number}.activity_mbq"])
            assert source.position_m[:2] == pytest.approx(told[f"sources.{number}.position_m"], abs=1e-4)
        assert float(world.air.speed_m_s) == pytest.approx(told["wind.speed_m_s"])
        assert np.count_nonzero(world.sources.activity_bq) == told["sources.count"]
        np.testing.assert_array_equal(standing.world_of(k).sources.position_m, world.sources.position_m)
    swarmsim.write_run(standing, records, tmp_path / "batch")
    rows = pq.read_table(tmp_path / "batch" / "missions.parquet").to_pylist()
    for row, record in zip(rows, records, strict=True):
        assert row["drawn_wind_speed_m_s"] == record.drawn["wind.speed_m_s"]
        assert row["drawn_sources_count"] == len(record.sources)
        assert row["drawn_sources_0_position_east_m"] == record.drawn["sources.0.position_m"][0]
        there = record.drawn["sources.count"] > 1
        assert (row.get("drawn_sources_1_nuclide") is not None) == there
    again = swarmsim.load(tmp_path / "batch" / "scenario.yaml", seed=2)
    (record,) = swarmsim.run(again, tmp_path / "single")
    summary = json.loads((tmp_path / "single" / "summary.json").read_text(encoding="utf-8"))
    assert summary["drawn"] == json.loads(json.dumps(dict(records[2].drawn))) == dict(record.drawn)
    assert len(summary["true_sources"]) == summary["drawn"]["sources.count"]


@pytest.mark.slow
def test_given_values_come_before_drawn_ones(standing):
    seeds = range(3, 3 + BATCH)
    draws = standing.draw(seeds)
    winds, heights = [0.5 * k for k in range(BATCH)], [4.0 + 0.5 * k for k in range(BATCH)]
    batch = standing.rollout(seeds, values={"wind.speed_m_s": winds, "phases.up.settings.height_m": heights})
    told = [swarmsim.mission_record(standing, batch, k).drawn for k in range(BATCH)]
    assert [row["wind.speed_m_s"] for row in told] == winds
    assert [row["phases.0.settings.height_m"] for row in told] == heights
    assert told[0] | {"wind.speed_m_s": 0, "phases.0.settings.height_m": 0} == draws.told(0) | {
        "wind.speed_m_s": 0,
        "phases.0.settings.height_m": 0,
    }
    same = standing.rollout(seeds, values=draws.values)
    assert (
        dict(swarmsim.mission_record(standing, same, 1).drawn).items()
        >= {path: value for path, value in draws.told(1).items() if not path.endswith("region")}.items()
    )


def test_what_are_no_seeds_or_no_values_for_them(standing):
    for seeds in ([], -1, [0, 2**31], 1.5, "x", None, [[0, 1]]):
        with pytest.raises(swarmsim.InputError, match="are no seeds"):
            standing.draw(seeds)
        with pytest.raises(swarmsim.InputError, match="are no seeds"):
            standing.rollout(seeds)
    for value in (3.0, np.array(3.0), "12", [1.0, 2.0, 3.0]):
        with pytest.raises(swarmsim.InputError, match=r"wind\.speed_m_s: needs a value for each mission"):
            standing.rollout([3, 4], values={"wind.speed_m_s": value})
    with pytest.raises(swarmsim.InputError, match="are no values"):
        standing.rollout([3, 4], values=[1.0, 2.0])


def test_wrong_values_are_told_as_given_and_not_as_drawn(standing):
    with pytest.raises(swarmsim.InputError, match=r"^values sources\.0\.nuclide: there is no nuclide 'Zz'"):
        standing.rollout([3, 4], values={"sources.0.nuclide": ["Co-60", "Zz"]})
    with pytest.raises(swarmsim.InputError, match=r"^values wind\.speed_m_s: "):
        standing.rollout([3, 4], values={"wind.speed_m_s": [1.0, -1.0]})
    of_the_library = "definitions.vehicles.tarot_t650.battery.capacity_wh"
    with pytest.raises(swarmsim.InputError, match="is in no definition of the mission") as told:
        standing.rollout([3, 4], values={of_the_library: [100.0, 90.0]})
    assert f'swarmsim.load(mission, ["{of_the_library}=' in str(told.value)


def test_values_in_the_stead_of_a_family_make_a_single_scenario(standing):
    row = {path: value for path, (value,) in standing.draw(5).values.items()}
    alone = with_values(standing.scenario, row)
    assert not alone.family
    assert alone.mission.wind.speed_m_s == row["wind.speed_m_s"]


LINE_SOURCE = "{nuclide: Cs-137, line_m: [[-10, -30], [10, -30]], height_m: 0, activity_mbq: 50}"


def test_lines_and_carriers_are_values_as_long_as_the_number_of_points_stays():
    moved = "vary.sources.0.line_m={choice: [[[-10, -30], [10, -30]], [[0, -30], [0, -10]]]}"
    driven = "vary.sources.1.on={choice: [orpheus, uav1]}"
    carried = "{nuclide: F-18, on: uav2, activity_mbq: 5}"
    built = swarmsim.build(
        swarmsim.load("recon", [f"sources=[{LINE_SOURCE}, {carried}]", moved, driven, "engine=analytic"])
    )
    built.check_family()
    worlds = [built.world_of(seed) for seed in range(12)]
    assert {int(world.emission.carrier[0]) for world in worlds} == {0, 3}
    assert {float(np.ptp(world.sources.position_m[:-1, 0])) > 1.0 for world in worlds} == {True, False}
    longer = "vary.sources.0.line_m={choice: [[[-10, -30], [10, -30]], [[0, -30], [9, -30]]]}"
    with pytest.raises(swarmsim.InputError, match="changes more than a value"):
        swarmsim.build(swarmsim.load("recon", [f"sources=[{LINE_SOURCE}]", longer, "engine=analytic"])).check_family()


def test_a_source_that_is_placed_keeps_away_from_lines():
    placed = "vary.sources.1.position_m={place: {region: open, apart_m: 20}}"
    point = "{nuclide: F-18, position_m: [0, 0], height_m: 1, activity_mbq: 5}"
    built = swarmsim.build(swarmsim.load("recon", [f"sources=[{LINE_SOURCE}, {point}]", placed, "engine=analytic"]))
    xy = np.array(built.draw(range(60)).values["sources.1.position_m"])
    away = np.hypot(np.maximum(np.abs(xy[:, 0]) - 10.0, 0.0), xy[:, 1] + 30.0)
    assert 20.0 <= away.min() + 0.5 < 30.0  # points stand half a metre from the ends of the line


def test_a_source_drawn_into_a_wall_is_told_with_its_seed():
    inside = ["vary.sources.0.position_m={choice: [[4.8, 4.0]]}", "engine=analytic"]
    with pytest.raises(swarmsim.InputError, match=r"inside the wall of a building.* \(in the mission of seed 0\)"):
        swarmsim.build(swarmsim.load("recon", inside))


def test_only_sources_that_a_family_draws_are_checked_against_the_site():
    placed = "vary.sources.*.position_m={place: {region: open, apart_m: 20}}"
    in_a_wall = "{nuclide: Co-60, position_m: [4.8, 4.0], height_m: 1, activity_mbq: 50}"
    own = [f"sources=[{in_a_wall}]", "vary.sources={count: [1, 3]}", placed, "engine=analytic"]
    built = swarmsim.build(swarmsim.load("recon", own))
    counts = {int(np.sum(np.asarray(built.world_of(seed).sources.activity_bq) > 0.0)) for seed in range(12)}
    assert counts == {1, 2, 3}


def test_a_path_of_its_own_comes_before_a_wildcard():
    settings = ["engine=analytic", "vary.sources.1.activity_mbq={choice: [7.0]}"]
    draws = swarmsim.build(swarmsim.load("random_recon", settings)).draw(SEEDS)
    assert {v for v in draws.values["sources.1.activity_mbq"] if v > 0.0} == {7.0}
    assert min(v for v in draws.values["sources.0.activity_mbq"] if v > 0.0) >= 20.0


def test_a_child_replaces_a_distribution_of_its_parent(tmp_path):
    text = "extends: random_recon\nname: child\nvary: {wind.speed_m_s: {choice: [2.5]}, wind.from_deg: null}\n"
    (tmp_path / "child.yaml").write_text(text, encoding="utf-8")
    scenario = swarmsim.load(tmp_path / "child.yaml")
    paths = {varied.path: varied.distribution for varied in scenario.family}
    assert paths["wind.speed_m_s"].choice == (2.5,)
    assert "wind.from_deg" not in paths


def test_the_command_line_shows_and_checks_families(capsys):
    assert main(["draw", "random_recon", "--missions", "2", "--seed", "5"]) == 0
    shown = capsys.readouterr().out
    assert "seed 5" in shown
    assert "sources.0.region" in shown
    assert main(["check", "configs/missions/random_recon.yaml"]) == 0
    shown = capsys.readouterr().out
    assert "a family that varies" in shown
    assert "sources.*.activity_mbq, sources.*.height_m" in shown
    assert main(["draw", "recon"]) == 2
    assert "single mission" in capsys.readouterr().err
