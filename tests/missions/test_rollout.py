"""The shipped mission: what it finds, what it records, and that a batch equals its missions one by one."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest

import swarmsim
from experiments.validation.missions import detectable_ratios
from swarmsim.results.names import MEASUREMENTS, MISSIONS, TRAJECTORIES
from swarmsim.runtime.mission_run import MissionRun
from swarmsim.runtime.progress import SilentProgress
from swarmsim.runtime.simulation import Simulation

pytestmark = pytest.mark.optimised

RECON = ("engine=analytic", "seed=5")


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return swarmsim.build(swarmsim.load("recon", RECON))


@pytest.fixture(scope="module")
def batch(simulation):
    # two missions with an activity each, as in the README's example, so that they share their programs
    return simulation.rollout([5, 6], values={"sources.0.activity_mbq": [170.0, 170.0]})


@pytest.fixture(scope="module")
def records(simulation, batch):
    return [swarmsim.mission_record(simulation, batch, index) for index in range(2)]


@pytest.mark.slow
def test_validation_knows_that_the_source_can_be_found(simulation, batch, records):
    ratios = detectable_ratios(simulation, batch)
    assert [ratio.shape for ratio in ratios] == [(1,), (1,)]
    for ratio, record in zip(ratios, records, strict=True):
        # at the true place the counts ask for it about as much as where it was found
        assert float(ratio[0]) == pytest.approx(record.estimate.detection, rel=0.02)


def test_the_mission_finds_locates_and_names_the_source(records):
    for record in records:
        truth = record.sources[0]
        assert not any(vehicle.crashed for vehicle in record.vehicles)
        # from 20 m up a source is a spot of 31 m full width at half maximum (1/r^2)
        assert np.linalg.norm(record.map.hotspots_m[0] - truth.position_m[:2]) < 16.0
        assert np.linalg.norm(record.estimate.position_m[:2] - truth.position_m[:2]) < 1.0
        assert record.estimate.activity_mbq == pytest.approx(truth.activity_mbq, rel=0.15)
        assert record.spectrum.nuclide == truth.nuclide
        assert record.spectrum.confidence > 0.9
        assert "Co-60" in record.finding


def test_a_mission_knows_what_is_a_wall(simulation):
    """Of the true site and of the presumed one: air and leaves surround, all else counts by its density."""
    materials = simulation.scenario.materials
    for site in (simulation.world.site, simulation.plan.presumed.site):
        expected = [materials[name].density_kg_m3 for name in site.material_names]
        expected = [
            0.0 if name in ("air", "vegetation") else d for name, d in zip(site.material_names, expected, strict=True)
        ]
        np.testing.assert_allclose(site.wall_kg_m3, expected)
        assert 0.0 in expected


def test_phases_follow_one_another_and_vehicles_end_at_rest(records):
    for record in records:
        survey, search = record.phases
        assert survey.end_s <= search.start_s < survey.end_s + 1.0 < search.end_s
        for vehicle in record.vehicles:
            assert np.all(np.diff(vehicle.time_s) > 0)
            assert np.linalg.norm(vehicle.velocity_m_s[-1]) < 0.3
            assert np.all(np.diff(vehicle.energy_wh) >= 0)
            np.testing.assert_allclose(np.linalg.norm(vehicle.quaternion, axis=1), 1.0, atol=1e-4)
        assert {e.kind for e in record.events} == {"finished"}
        assert np.all(np.diff(record.samples.time_s) >= 0)


def test_uavs_fly_the_lines_at_the_height_above_ground(simulation, records):
    from swarmsim.site import sample

    site, task = simulation.world.site, simulation.plan.phases[0].task
    for vehicle in records[0].vehicles[:2]:
        over = (vehicle.position_m[:, 0] > -4) & (vehicle.position_m[:, 0] < 14)
        height = vehicle.position_m[over, 2] - np.asarray(sample(site.terrain_m, site, vehicle.position_m[over, :2]))
        assert np.percentile(np.abs(height - 20.0), 90) < 0.6
    assert float(task.line_spacing_m) == 10.0


def test_mission_k_of_a_batch_is_the_mission_of_its_seed(simulation, batch, records):
    alone = swarmsim.mission_record(simulation, simulation.rollout(6), 0)
    together = records[1]
    # Programs of different batch sizes round differently. Flights stay alike to millimetres, the survey's estimate to a
    # fifth of its standard deviation; the route, planned in cells, may move by one cell.
    for one, other in zip(alone.vehicles, together.vehicles, strict=True):
        count = min(len(one.time_s), len(other.time_s))
        tolerance = 0.005 if one.kind == "multirotor" else 1.5
        np.testing.assert_allclose(one.position_m[:count], other.position_m[:count], atol=tolerance)
    counts = [record.samples.of_phase("survey").counts for record in (alone, together)]
    assert len(counts[0]) == len(counts[1])
    assert np.mean(counts[0] != counts[1]) < 0.005
    spread = np.sqrt(np.diag(alone.survey_estimate.covariance_m2))
    assert np.all(np.abs(alone.survey_estimate.position_m - together.survey_estimate.position_m) < 0.2 * spread)
    spread = np.sqrt(np.diag(alone.estimate.covariance_m2))
    assert np.all(np.abs(alone.estimate.position_m - together.estimate.position_m) < 0.2 * spread)
    assert alone.estimate.activity_mbq == pytest.approx(together.estimate.activity_mbq, rel=0.005)
    assert alone.spectrum.nuclide == together.spectrum.nuclide


@pytest.mark.parametrize("index", [-1, 2])
def test_there_are_records_of_the_batchs_missions_alone(simulation, batch, index):
    with pytest.raises(swarmsim.InputError, match="no such mission in the batch"):
        swarmsim.mission_record(simulation, batch, index)


def test_seeds_differ(records):
    first, second = (record.samples.of_phase("survey").counts for record in records)
    count = min(len(first), len(second))
    assert np.mean(first[:count] != second[:count]) > 0.5


def test_detection_limits_are_those_of_the_last_estimate(batch):
    assert np.isinf(batch.conclusion.survey.estimated.noticed_bq).all()
    assert np.isfinite(batch.conclusion.estimated.noticed_bq).all()


@pytest.mark.slow
def test_where_the_search_never_began_the_counts_are_still_looked_at(simulation, batch):
    """As of a mission that was over before; what its search would have learnt was never asked for."""
    phases = tuple(
        replace(state, asked_s=jnp.full_like(state.asked_s, jnp.inf).at[1].set(state.asked_s[1])) if asks else state
        for asks, state in zip([False, True], batch.end.phases, strict=True)
    )
    nothing = jax.tree.map(jnp.zeros_like, batch.end.survey)
    survey = jax.tree.map(lambda zero, known: zero.at[1].set(known[1]), nothing, batch.end.survey)
    end = replace(batch.end, phases=phases, survey=survey)
    of = MissionRun(simulation._batches[2], batch.worlds, batch.plans, simulation.plan, SilentProgress())
    found, asked = of.conclude(end), batch.conclusion
    assert float(np.asarray(found.survey.map.mean_cps)[0].max()) > 50.0
    assert bool(np.asarray(found.survey.found)[0])
    place = np.asarray(found.estimated.fits.position_m)
    np.testing.assert_allclose(place[:, 0, :2], np.asarray(asked.estimated.fits.position_m)[:, 0, :2], atol=0.3)
    # what is known of the other one stays as it was
    np.testing.assert_array_equal(found.survey.map.mean_cps[1], asked.survey.map.mean_cps[1])


def test_where_a_counter_was_saturated_no_errors_are_stated(simulation, batch, monkeypatch):
    monkeypatch.setattr("swarmsim.results.saturation.SATURATED_SHARE", 1e-6)
    record = swarmsim.mission_record(simulation, batch, 0)
    assert record.status == "saturated"
    assert record.estimates
    assert record.survey_estimates
    assert not any(one.errors_known for one in (*record.estimates, *record.survey_estimates))
    assert "±" not in record.finding


def test_no_activity_is_a_clear_finding(simulation):
    world = simulation.world
    silent = swarmsim.build(swarmsim.load("recon", (*RECON, "sources.0.activity_mbq=0")))
    assert jax.tree.structure(silent.world) == jax.tree.structure(world)
    record = swarmsim.mission_record(silent, silent.rollout(1), 0)
    assert record.finding.startswith("no source above background (in free view, over 95% of the survey area, one would")
    # of those of 40 MBq in the open nine of ten are found: those at the weakest places are not
    assert 25.0 < record.noticed_mbq["Co-60"] < 55.0
    assert record.noticed_mbq["Pu-239"] > 100.0 * record.noticed_mbq["Co-60"]
    assert set(record.noticed_mbq) == set(silent.plan.detectors[0].nuclide_names)
    assert record.estimate is None
    assert record.spectrum is None
    assert len(record.map.hotspots_m) == 0
    assert len(record.samples.of_phase("search").counts) == 0
    rover = record.vehicles[-1]
    assert np.ptp(rover.position_m[:, :2], axis=0).max() < 0.05


@pytest.mark.slow
def test_a_run_is_written_whole_and_flies_again(simulation, records, tmp_path):
    swarmsim.write_run(simulation, records, tmp_path / "first")
    rows = pq.read_table(tmp_path / "first" / MISSIONS).to_pylist()
    assert [row["seed"] for row in rows] == [5, 6]
    assert [row["drawn_sources_0_activity_mbq"] for row in rows] == [170.0, 170.0]  # what `rollout` was given
    assert [row["success"] for row in rows] == [record.status == "located" for record in records]
    # the one doubt that is left of an answer that is right: errors of the model of walls look like a further source
    assert all(row["success"] or "but a further source is suspected" in row["finding"] for row in rows)
    for name in (MEASUREMENTS, TRAJECTORIES, "mission.rrd", "radiation_map.npz", "summary.json", "scenario.yaml"):
        assert (tmp_path / "first" / name).stat().st_size > 0
    again = swarmsim.load(tmp_path / "first" / "scenario.yaml")
    # a copy of the mission flies by the same programs
    assert jax.tree.structure(swarmsim.build(again).plan) == jax.tree.structure(simulation.plan)
    (record,) = swarmsim.run(again, tmp_path / "second")
    summary = json.loads((tmp_path / "second" / "summary.json").read_text(encoding="utf-8"))
    assert summary["source"]["position_m"] == pytest.approx(list(record.estimate.position_m), abs=1e-3)
    assert summary["seed"] == 5
    assert summary["real_time_factor"] > 0
    assert rows[0]["source_activity_mbq"] == pytest.approx(summary["source"]["activity_mbq"], rel=0.02)
    with pytest.raises(swarmsim.InputError, match="results already"):
        swarmsim.run(again, tmp_path / "second")
    assert {path.name for path in tmp_path.iterdir()} == {"first", "second"}
