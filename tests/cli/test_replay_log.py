"""``swarmsim replay-log``: tables, folders and errors, as a user meets them."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.compare import Planned, Simulated, Track
from swarmsim.autopilot.frames import geodetic_of_enu, ned_of_enu
from swarmsim.autopilot.simulated_track import write_simulated
from swarmsim.cli.entry import main
from swarmsim.config.scenario import load_scenario
from swarmsim.playback.viewer import recording_of
from tests.autopilot.logs import writers

MISSION = """
name: circle
site: works_yard
engine: analytic
sources: []
vehicles: [{name: uav, type: tarot_t650, position_m: [-62, -42]}]
phases:
  - name: round
    who: uav
    policy: waypoints
    settings: {points: [[-70, -42]], speed_m_s: 2, altitude_m: 6}
    time_limit_s: 60
"""
TRUTH = writers.flight()
START_M = np.array([-62.0, -42.0, 0.5])  # of the simulated vehicle


@pytest.fixture(autouse=True)
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flight.tlog").write_bytes(writers.tlog(TRUTH))
    (tmp_path / "flight.ulg").write_bytes(writers.ulog(TRUTH))
    (tmp_path / "flight.bin").write_bytes(writers.dataflash(TRUTH))


@pytest.fixture
def run(tmp_path):
    """A run whose simulated vehicle flew the same circle, 0.1 m below its path, while there were setpoints."""
    (tmp_path / "circle.yaml").write_text(MISSION, encoding="utf-8")
    folder = tmp_path / "runs" / "circle"
    folder.mkdir(parents=True)
    (folder / "scenario.yaml").write_text(load_scenario(tmp_path / "circle.yaml").to_yaml(), encoding="utf-8")
    (folder / "flown.json").write_text('{"vehicle": "uav"}', encoding="utf-8")
    judged = (TRUTH.time_s >= writers.ARMED_S) & (TRUTH.time_s < writers.LEFT_S)
    place = TRUTH.position_m[judged] - TRUTH.position_m[judged][0] + START_M
    track = Track(TRUTH.time_s[judged] - writers.ARMED_S, place)
    path = Planned("round", place + np.array([0.0, 0.0, 0.1]))
    write_simulated(folder, Simulated(track, np.zeros(len(place), int)), (path,))
    return folder


@pytest.mark.parametrize("kind", ["tlog", "bin", "ulg"])
def test_a_log_alone(kind, tmp_path, capsys):
    assert main(["replay-log", f"flight.{kind}"]) == 0
    folder = tmp_path / "runs" / "log_flight"
    said = json.loads((folder / "log.json").read_text(encoding="utf-8"))
    assert said["format"] == kind
    assert said["duration_s"] == pytest.approx(29.9, abs=0.01)
    assert "comparison" not in said
    table = pq.read_table(folder / "track.parquet").to_pydict()
    np.testing.assert_allclose(table["north_m"], TRUTH.position_m[:, 1], atol=1e-5)
    assert table["mode"][100] in ("OFFBOARD", "GUIDED")
    assert table["armed"][100] is True
    assert table["battery"][-1] == pytest.approx(0.705, abs=0.01)
    assert recording_of(folder).stat().st_size > 1000
    assert (folder / "figures" / "flown.png").is_file()
    out = capsys.readouterr().out
    assert "copter" in out
    assert "5.0 s to 25.0 s" in out


def test_a_flight_over_its_run(run, tmp_path, capsys):
    assert main(["replay-log", "flight.ulg", "--run", str(run), "--out", "out"]) == 0
    said = json.loads((tmp_path / "out" / "log.json").read_text(encoding="utf-8"))
    assert said["vehicle_of_mission"] == "uav"
    assert said["aligned"] == "where the flight began"
    made = said["comparison"]
    assert made["time_shift_s"] == pytest.approx(writers.ARMED_S, abs=0.05)
    assert made["whole"]["synchronised"]["rms_m"] < 0.02
    assert made["whole"]["cross_track"]["rms_m"] < 0.02
    assert made["whole"]["above_path"]["rms_m"] == pytest.approx(0.1, abs=0.01)
    assert made["phases"][0]["phase"] == "round"
    out = capsys.readouterr().out
    assert "shifted by 5.0" in out
    assert main(["replay-log", "flight.ulg", "--run", str(run), "--out", "out"]) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["replay-log", "flight.bin", "--run", str(run), "--out", "out", "--force"]) == 0
    assert json.loads((tmp_path / "out" / "log.json").read_text(encoding="utf-8"))["format"] == "bin"


def test_a_flight_laid_over_by_its_place_on_the_earth(run, tmp_path, capsys):
    """The mission's origin lies where the flight then begins 0.3 m east of its start."""
    armed = int(np.searchsorted(TRUTH.time_s, writers.ARMED_S))
    origin = geodetic_of_enu(TRUTH.position_m[armed] - START_M - np.array([0.3, 0.0, 0.0]), writers.ORIGIN)
    text = f"{origin.latitude_deg:.9f},{origin.longitude_deg:.9f},{origin.altitude_m:.4f}"
    assert main(["replay-log", "flight.ulg", "--run", str(run), "--origin", text, "--out", "out"]) == 0
    made = json.loads((tmp_path / "out" / "log.json").read_text(encoding="utf-8"))["comparison"]
    assert 0.1 < made["whole"]["from_simulated_track"]["rms_m"] < 0.35
    capsys.readouterr()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["missing.tlog"], "No such file"),
        (["flight.tlog", "--vehicle", "uav"], "--mission or --run"),
        (["flight.tlog", "--run", "nowhere"], "not the folder of a run"),
        (["flight.tlog", "--run", "runs/circle", "--mission", "circle.yaml"], "not both"),
        (["flight.tlog", "--run", "runs/circle", "--vehicle", "none"], "no such vehicle"),
        (["flight.tlog", "--mission", "circle.yaml"], "which vehicle"),
        (["flight.tlog", "--system", "9"], "no such system"),
        (["flight.tlog", "--seed", "4"], "--seed: of which mission"),
        (["flight.tlog", "--set", "seed=3"], "--set: of which mission"),
        (["flight.tlog", "--out", "b" * 300], "cannot be written"),
        (["flight.tlog", "--run", "b" * 300], "cannot be read"),
        (["b" * 300 + ".tlog"], "File name too long"),
        (["flight.tlog", "--origin", "49,16"], "LAT,LON,ALT"),
        (["flight.tlog", "--origin", "nan,16,0"], "LAT,LON,ALT"),
        (["circle.yaml"], "no log"),
        (["flight.tlog", "--out", "runs/circle", "--force"], "something else"),
        (["flight.tlog", "--out", "flight.bin"], "something else than a folder"),
    ],
)
def test_wrong_input_is_told(arguments, said, run, tmp_path, capsys):
    del run
    assert main(["replay-log", *arguments]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "runs" / "log_flight").exists()


@pytest.mark.parametrize("content", ["{", "[]", "{}"])
def test_a_damaged_report_of_the_run_is_told(content, run, capsys):
    (run / "flown.json").write_text(content, encoding="utf-8")
    assert main(["replay-log", "flight.tlog", "--run", str(run)]) == 2
    assert "--vehicle" in capsys.readouterr().err


def test_with_the_vehicle_named_a_damaged_report_is_told_and_the_mission_simulated(run, tmp_path, capsys, monkeypatch):
    from swarmsim.autopilot import simulated_track

    whole = simulated_track.read_simulated(run)
    monkeypatch.setattr(simulated_track, "simulate_vehicle", lambda simulation, vehicle: whole)
    monkeypatch.setattr(simulated_track, "read_simulated", lambda folder: pytest.fail("whose it is, is not known"))
    (run / "flown.json").write_text("{", encoding="utf-8")
    assert main(["replay-log", "flight.tlog", "--run", str(run), "--vehicle", "uav", "--out", "out"]) == 0
    assert "flown.json of the run is damaged" in capsys.readouterr().out
    made = json.loads((tmp_path / "out" / "log.json").read_text(encoding="utf-8"))["comparison"]
    assert made["time_shift_s"] == pytest.approx(writers.ARMED_S, abs=0.05)


def test_a_log_without_a_place_on_the_earth(tmp_path, capsys):
    data = writers.tlog(TRUTH)
    first = 8 + 12 + data[9]
    (tmp_path / "flight.tlog").write_bytes(data[first:])  # without its origin
    assert main(["replay-log", "flight.tlog", "--origin", "49,16,200"]) == 2
    assert "leave --origin out" in capsys.readouterr().err
    assert main(["replay-log", "flight.tlog"]) == 0


NO_NUMBERS = {"nan": [np.nan], "text": ["here"], "nothing": [None]}


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("simulated.parquet", lambda table: table.slice(0, 0)),
        ("simulated.parquet", lambda table: table.set_column(0, "time_s", pa.array([1.0] * len(table)))),
        *(
            (
                name,
                lambda table, v=values: table.set_column(
                    table.column_names.index("east_m"), "east_m", pa.array(v * len(table))
                ),
            )
            for name in ("simulated.parquet", "planned.parquet")
            for values in NO_NUMBERS.values()
        ),
    ],
)
def test_damaged_tracks_of_the_run_are_told(name, spoil, run, capsys):
    table = spoil(pq.read_table(run / name))
    pq.write_table(table, run / name)
    assert main(["replay-log", "flight.tlog", "--run", str(run)]) == 2
    assert "is damaged" in capsys.readouterr().err


def test_a_flight_that_was_taken_off_by_hand_begins_where_it_was_armed(run, tmp_path, capsys):
    """Armed 8 m west of where it begins to follow setpoints, 3 m lower."""
    log, before = writers.Tlog(), np.array([-8.0, 0.0, -3.0])
    first = int(np.searchsorted(TRUTH.time_s, writers.ARMED_S))
    place = TRUTH.position_m.copy()
    place[:first] = place[first] + np.linspace(1.0, 0.0, first)[:, None] * before
    for k, t in enumerate(TRUTH.time_s):
        mode = 6 << 16 if k >= first and t < writers.LEFT_S else 3 << 16
        log.put(t, mavlink.MAVLink_heartbeat_message(2, 12, 1 | 128, mode, 4, 3))
        log.put(t, mavlink.MAVLink_local_position_ned_message(
            round(t * 1e3), *ned_of_enu(place[k]), *ned_of_enu(TRUTH.velocity_m_s[k])))  # fmt: skip
    (tmp_path / "hand.tlog").write_bytes(bytes(log.data))
    assert main(["replay-log", "hand.tlog", "--run", str(run), "--out", "out"]) == 0
    made = json.loads((tmp_path / "out" / "log.json").read_text(encoding="utf-8"))["comparison"]
    assert made["whole"]["synchronised"]["rms_m"] == pytest.approx(8.0, abs=0.1)
    assert made["whole"]["above_simulated"]["rms_m"] == pytest.approx(3.0, abs=0.1)
    capsys.readouterr()


def test_an_origin_elsewhere_on_the_earth_is_told(run, capsys):
    assert main(["replay-log", "flight.tlog", "--run", str(run), "--origin", "49.4,16.5747,280"]) == 0
    said = capsys.readouterr().out
    assert "19.2 km" in said or "19.1 km" in said
    assert "is --origin right" in said
