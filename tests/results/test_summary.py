"""The summary of a mission and of a batch, against numbers worked out by hand."""

import dataclasses
import json

import numpy as np
import pytest

from swarmsim.results.batch import batch_row, batch_summary
from swarmsim.results.record import Departures, Event, MissionRecord, Phase, Samples, TrueSource, VehicleRecord
from swarmsim.results.summary import STATES, Timings, real_time_factor, succeeded, summary
from swarmsim.world.events import KINDS
from tests import synthetic

TIMINGS = Timings(compile_s=12.0, run_s=4.0, write_s=1.5)


@pytest.fixture(scope="module")
def found() -> MissionRecord:
    return synthetic.mission()


@pytest.fixture(scope="module")
def nothing() -> MissionRecord:
    return synthetic.mission(found=False)


def track(name: str, kind: str, corners: list[list[float]], times: list[float]) -> VehicleRecord:
    n = len(corners)
    return VehicleRecord(
        name=name,
        type="any",
        kind=kind,
        time_s=np.array(times),
        position_m=np.array(corners),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        velocity_m_s=np.zeros((n, 3)),
        energy_wh=np.linspace(0.0, 5.0, n),
        battery_fraction=np.ones(n),
        crashed=False,
    )


def small(found: MissionRecord) -> MissionRecord:
    """Two UAVs that fly 7 m and 5 m in the survey, a rover that drives 4 m in the search, four samples."""
    times = [0.0, 5.0, 10.0, 20.0]
    vehicles = (
        track("a", "multirotor", [[0, 0, 0], [3, 4, 0], [3, 4, 2], [9, 9, 9]], times),
        track("b", "multirotor", [[0, 0, 0], [0, 0, 5], [0, 0, 5], [0, 0, 5]], times),
        track("r", "skid_steer", [[0, 0, 0], [0, 0, 0], [1, 0, 0], [5, 0, 0]], times),
    )
    counts = np.array([6.0, 9.0, 3.0, 400.0])
    exposure = np.array([0.1, 0.1, 0.1, 1.0])
    samples = Samples(
        vehicle=np.array([0, 1, 0, 2], np.int32),
        phase=np.array(["survey", "survey", "survey", "search"]),
        time_s=np.array([1.0, 2.0, 3.0, 15.0]),
        position_m=np.zeros((4, 3)),
        counts=counts,
        exposure_s=exposure,
        count_rate_cps=counts / exposure,
    )
    phases = (Phase("survey", "lines", (0, 1), 0.0, 10.0, True), Phase("search", "orbit", (2,), 10.0, 20.0, False))
    return dataclasses.replace(found, vehicles=vehicles, samples=samples, phases=phases)


def test_phases_by_hand(found: MissionRecord) -> None:
    made = summary(small(found), TIMINGS)
    assert made["phases"] == {
        "survey": {
            "policy": "lines",
            "vehicles": ["a", "b"],
            "start_s": 0.0,
            "duration_s": 10.0,
            "in_time": True,
            "path_length_m": pytest.approx(7.0 + 5.0),
            "measurements": 3,
            "count_rate_min_cps": pytest.approx(30.0),
            "count_rate_max_cps": pytest.approx(90.0),
        },
        "search": {
            "policy": "orbit",
            "vehicles": ["r"],
            "start_s": 10.0,
            "duration_s": 10.0,
            "in_time": False,
            "path_length_m": pytest.approx(4.0),
            "measurements": 1,
            "count_rate_min_cps": 400.0,
            "count_rate_max_cps": 400.0,
        },
    }
    assert made["real_time_factor"] == pytest.approx(20.0 / 4.0)
    assert made["timing"] == {"compile_s": 12.0, "run_s": 4.0, "write_s": 1.5}


def test_overlapping_phases_are_simulated_once(found: MissionRecord) -> None:
    two = (Phase("survey", "lines", (0, 1), 0.0, 100.0, True), Phase("search", "orbit", (3,), 40.0, 120.0, True))
    assert summary(dataclasses.replace(found, phases=two), TIMINGS)["real_time_factor"] == pytest.approx(120.0 / 4.0)


def test_where_a_counter_was_saturated_no_standard_deviation_is_stated(found: MissionRecord) -> None:
    estimate = dataclasses.replace(found.estimate, errors_known=False)
    made = summary(dataclasses.replace(found, estimate=estimate, status="saturated"), TIMINGS)["source"]
    known = summary(found, TIMINGS)["source"]
    left_out = {"position_std_m", "position_covariance_m2", "activity_std_mbq", "dose_rate_1m_std_usv_h"}
    left_out |= {"kerma_rate_1m_std_ugy_h", "beside_noticed_mbq"}
    assert {key for key in known if known[key] != made[key]} <= left_out
    assert all(made[key] is None for key in left_out)
    row = batch_row(dataclasses.replace(found, estimate=estimate))
    assert row["source_std_east_m"] is None
    assert row["source_covariance_east_north_m2"] is None
    assert row["source_east_m"] == pytest.approx(known["position_m"][0])


def test_what_would_have_been_noticed_is_told_by_nuclide(found: MissionRecord) -> None:
    noticed = dataclasses.replace(found, noticed_mbq={"Co-60": 30.0, "Cs-137": 70.0, "Pu-239": np.inf})
    assert summary(noticed, TIMINGS)["noticed_mbq"] == {"Co-60": 30.0, "Cs-137": 70.0, "Pu-239": None}
    row = batch_row(noticed)
    assert (row["noticed_least_mbq"], row["noticed_most_mbq"]) == (30.0, None)
    row = batch_row(dataclasses.replace(found, noticed_mbq={"Cs-137": 70.0, "Co-60": 30.0}))
    assert (row["noticed_least_mbq"], row["noticed_most_mbq"]) == (30.0, 70.0)
    assert batch_row(found)["noticed_least_mbq"] is None


def test_every_key_that_users_rely_on(found: MissionRecord) -> None:
    made = summary(found, TIMINGS)
    assert list(made["phases"]) == ["survey", "search"]
    assert set(made["hotspot"]) == {"position_m", "error_m"}
    source = {"position_m", "position_std_m", "error_m", "activity_mbq", "activity_error_percent"}
    assert source <= set(made["source"])
    assert set(made["survey_estimate"]) == set(made["source"])
    assert set(made["nuclide"]) == {"name", "confidence", "of_source"}
    assert set(made["timing"]) == {"compile_s", "run_s", "write_s"}
    assert all({"name", "state", "crashed", "energy_wh"} <= set(vehicle) for vehicle in made["vehicles"])
    assert {"real_time_factor", "events", "finding", "warnings", "success", "seed", "versions"} <= set(made)
    assert {"python", "swarmsim", "jax", "mujoco", "rerun-sdk"} <= set(made["versions"])


def test_states_of_vehicles_are_what_ended_them(found: MissionRecord) -> None:
    events = (
        Event(3.0, "uav1", "obstacle", ""),
        Event(4.0, "uav2", "battery_empty", ""),
        Event(5.0, "uav3", "finished", ""),
    )
    record = dataclasses.replace(found, events=events, warnings=("crowded",))
    made = summary(record, TIMINGS)
    states = [vehicle["state"] for vehicle in made["vehicles"]]
    assert states == ["collided with an obstacle", "battery empty", "intact", "intact"]
    assert made["warnings"] == ["crowded"]
    assert set(STATES) == set(KINDS)


def test_errors_against_the_truth(found: MissionRecord) -> None:
    made = summary(found, TIMINGS)
    assert made["source"]["error_m"] == pytest.approx(np.sqrt(0.12**2 + 0.09**2 + 0.2**2))
    assert made["source"]["error_horizontal_m"] == pytest.approx(0.15)
    assert made["source"]["position_std_m"] == pytest.approx([np.sqrt(0.020), np.sqrt(0.012), 0.3])
    assert made["source"]["activity_error_percent"] == pytest.approx(100 * 4.0 / 170.0)
    assert made["hotspot"]["error_m"] == pytest.approx(0.8 * np.sqrt(2))
    assert made["nuclide"] == {"name": "Co-60", "confidence": 0.9997, "of_source": 0}


def test_an_estimate_has_its_nuclide_the_true_one_and_the_covariance_of_its_place(found: MissionRecord) -> None:
    assert found.estimate is not None
    other = dataclasses.replace(found, estimate=dataclasses.replace(found.estimate, nuclide="Co-57"))
    made = summary(other, TIMINGS)
    assert (made["source"]["nuclide"], made["source"]["true_nuclide"]) == ("Co-57", "Co-60")
    covariance = np.array(made["source"]["position_covariance_m2"])
    np.testing.assert_allclose(covariance, found.estimate.covariance_m2)
    row = batch_row(other)
    assert (row["source_nuclide"], row["source_true_nuclide"]) == ("Co-57", "Co-60")
    assert row["source_covariance_east_north_m2"] == pytest.approx(covariance[0, 1])
    assert row["source_covariance_north_up_m2"] == pytest.approx(covariance[1, 2])


def test_what_was_drawn_within_the_knowledge_is_told_for_validation(found: MissionRecord) -> None:
    assert summary(found, TIMINGS)["departures"] is None
    made = Departures({"brick": 1.2}, {"nai_1p5x1p5": 0.97}, {"uav1": np.array([0.01, -0.02, 0.03], np.float32)})
    record = dataclasses.replace(found, departures=made)
    told = summary(record, TIMINGS)["departures"]
    assert told["thickness_factor"] == {"brick": 1.2}
    assert told["sensitivity_factor"] == {"nai_1p5x1p5": 0.97}
    assert told["pose_error_m"] == {"uav1": pytest.approx([0.01, -0.02, 0.03])}
    json.dumps(told)
    rows = [batch_row(record)] * 2
    assert rows[0]["true_thickness_factor_brick"] == 1.2
    assert rows[0]["true_sensitivity_factor_nai_1p5x1p5"] == 0.97
    assert not any(key.startswith("true_") for key in batch_summary(rows, [record] * 2, TIMINGS)["metrics"])


def test_activity_error_is_a_size_whatever_its_sign(found: MissionRecord) -> None:
    assert found.estimate is not None
    high = dataclasses.replace(found, estimate=dataclasses.replace(found.estimate, activity_mbq=187.0))
    assert summary(high, TIMINGS)["source"]["activity_error_percent"] == pytest.approx(10.0)


def test_where_no_nuclide_is_named_there_is_no_confidence(found: MissionRecord) -> None:
    """A spectrum that was taken near none of the sources, though it is one's beyond doubt."""
    apart = dataclasses.replace(found, examined=None)
    assert summary(apart, TIMINGS)["nuclide"] == {"name": None, "confidence": None, "of_source": None}
    for record, expected in ((found, ("Co-60", 0.9997)), (apart, (None, None))):
        row = batch_row(record)
        assert (row["nuclide"], row["nuclide_confidence"]) == expected


def test_of_several_sources_the_nearest_counts(found: MissionRecord) -> None:
    far = TrueSource("Cs-137", np.array([-40.0, -30.0, 1.0]), 5.0)
    several = dataclasses.replace(found, sources=(far, *found.sources))
    one, many = summary(found, TIMINGS), summary(several, TIMINGS)
    assert many["source"] == one["source"]
    assert many["hotspot"] == one["hotspot"]


def test_nothing_found_is_null_and_still_json(nothing: MissionRecord) -> None:
    made = json.loads(json.dumps(summary(nothing, TIMINGS), allow_nan=False))
    assert made["hotspot"] == {"position_m": None, "error_m": None}
    assert set(made["source"].values()) == {None}
    assert made["nuclide"] == {"name": None, "confidence": None, "of_source": None}
    assert list(made["phases"]) == ["survey"]
    assert made["phases"]["survey"]["measurements"] > 7000
    assert made["finding"] == "No source above background."


def test_estimate_where_there_is_no_source_has_no_error(found: MissionRecord) -> None:
    made = summary(dataclasses.replace(found, sources=()), TIMINGS)["source"]
    assert made["position_m"] is not None
    assert made["error_m"] is None
    assert made["activity_error_percent"] is None


def test_source_of_no_activity_has_no_percentage(found: MissionRecord) -> None:
    dead = (dataclasses.replace(found.sources[0], activity_mbq=0.0),)
    made = summary(dataclasses.replace(found, sources=dead), TIMINGS)["source"]
    assert made["error_m"] is not None
    assert made["activity_error_percent"] is None


def test_a_vehicle_lost_to_a_numerical_failure_spoils_no_number(found: MissionRecord) -> None:
    position = found.vehicles[0].position_m.copy()
    position[1000:] = np.nan
    energy = found.vehicles[0].energy_wh.copy()
    energy[1000:] = np.nan
    lost = dataclasses.replace(found.vehicles[0], position_m=position, energy_wh=energy, crashed=True)
    record = dataclasses.replace(found, vehicles=(lost, *found.vehicles[1:]))
    made = summary(record, TIMINGS)
    json.dumps(made, allow_nan=False)
    assert made["vehicles"][0]["energy_wh"] == pytest.approx(found.vehicles[0].energy_wh[999])
    whole = summary(found, TIMINGS)["phases"]["survey"]["path_length_m"]
    assert 0.5 < made["phases"]["survey"]["path_length_m"] / whole < 0.9


def test_success_means_located_named_in_time_and_nobody_crashed(found: MissionRecord, nothing: MissionRecord) -> None:
    assert succeeded(found)
    assert succeeded(nothing)
    crashed = dataclasses.replace(found.vehicles[0], crashed=True)
    assert not succeeded(dataclasses.replace(found, vehicles=(crashed, *found.vehicles[1:])))
    assert not succeeded(dataclasses.replace(found, estimate=None))
    assert not succeeded(dataclasses.replace(found, spectrum=None))
    assert not succeeded(dataclasses.replace(found, sources=()))
    assert found.spectrum is not None
    wrong = dataclasses.replace(found.spectrum, nuclide="Cs-137")
    assert not succeeded(dataclasses.replace(found, spectrum=wrong))
    assert not succeeded(dataclasses.replace(nothing, sources=found.sources))
    late = dataclasses.replace(found.phases[1], in_time=False)
    assert not succeeded(dataclasses.replace(found, phases=(found.phases[0], late)))


def test_a_failsafe_is_no_success_and_a_batch_tells_of_it(found: MissionRecord) -> None:
    events = (
        Event(3.0, "uav1", "fence", ""),
        Event(4.0, "uav1", "wind", ""),
        Event(5.0, "uav2", "crash", ""),
        Event(6.0, "uav3", "finished", ""),
    )
    saved = dataclasses.replace(found, events=events[:1])
    assert not succeeded(saved)
    records = [found, saved, dataclasses.replace(found, events=events)]
    rows = [batch_row(record) for record in records]
    assert [row["failsafes"] for row in rows] == [0, 1, 1]
    assert [row["incidents"] for row in rows] == ["", "uav1: fence", "uav1: fence, uav1: wind, uav2: crash"]
    assert batch_summary(rows, records, TIMINGS)["failsafe_vehicles"] == 2


def test_success_asks_for_no_more_than_was_sought(found: MissionRecord) -> None:
    unnamed = dataclasses.replace(found, spectrum=None, sought="source")
    assert succeeded(unnamed)
    assert not succeeded(dataclasses.replace(unnamed, estimate=None))
    flown = dataclasses.replace(found, sought="nothing", estimate=None, spectrum=None, map=None)
    assert succeeded(flown)
    assert summary(flown, TIMINGS)["hotspot"] == {"position_m": None, "error_m": None}


def test_batch_has_medians_extremes_and_how_many_found_one(found: MissionRecord, nothing: MissionRecord) -> None:
    assert found.estimate is not None
    worse = dataclasses.replace(found.estimate, position_m=synthetic.SOURCE_M + np.array([3.0, 0.0, 0.0]))
    records = [
        found,
        dataclasses.replace(found, seed=1, estimate=worse),
        dataclasses.replace(nothing, seed=2, sources=found.sources),
    ]
    rows = [batch_row(record) for record in records]
    made = json.loads(json.dumps(batch_summary(rows, records, TIMINGS), allow_nan=False))
    errors = made["metrics"]["source_error_m"]
    assert errors == {"median": pytest.approx((0.25 + 3.0) / 2), "min": pytest.approx(0.25), "max": 3.0, "found": 2}
    assert made["metrics"]["survey_measurements"]["found"] == 3
    assert made["metrics"]["search_measurements"]["found"] == 2
    assert made["success_rate"] == pytest.approx(2 / 3)
    assert (made["missions"], made["seed_first"], made["seed_last"]) == (3, 0, 2)
    assert made["real_time_factor"] == pytest.approx(sum(record.end_s for record in records) / 4.0)


def test_rows_are_flat_and_alike(found: MissionRecord, nothing: MissionRecord) -> None:
    one, other = batch_row(found), batch_row(nothing)
    assert [key for key in one if not key.startswith("search_")] == list(other)
    assert not any(isinstance(value, dict | list | np.ndarray) for value in one.values())
    assert one["source_east_m"] == pytest.approx(12.12)
    assert one["source_std_up_m"] == pytest.approx(0.3)
    assert other["source_east_m"] is None


def test_no_time_no_factor(found: MissionRecord) -> None:
    assert real_time_factor([found], Timings(compile_s=0.0, run_s=0.0)) is None


def test_lines_areas_and_carried_sources_are_told_as_what_they_are(found: MissionRecord) -> None:
    record = synthetic.forms(found)
    line, area, carried = json.loads(json.dumps(summary(record, TIMINGS)["true_sources"]))
    assert (line["form"], line["position_m"]) == ("line", [-10.0, -30.0, 1.0])
    assert line["corners_m"] == [[-20.0, -30.0, 1.0], [0.0, -30.0, 1.0]]
    assert (area["form"], len(area["corners_m"])) == ("area", 4)
    rover = record.vehicles[3]
    assert (carried["form"], carried["on"], carried["activity_mbq"]) == ("carried", rover.name, 100.0)
    assert carried["position_m"] == pytest.approx(list(record.track_of(record.sources[2])[0]))
    np.testing.assert_allclose(
        np.linalg.norm(record.track_of(record.sources[2]) - rover.position_m, axis=1), np.hypot(0.5, 0.2)
    )
    forward = np.array(carried["end_position_m"]) - rover.position_m[-1]
    w, x, y, z = rover.quaternion[-1]
    assert np.arctan2(forward[1], forward[0]) == pytest.approx(
        np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), abs=0.02
    )
    assert "form" not in summary(found, TIMINGS)["true_sources"][0]
