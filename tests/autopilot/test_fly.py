"""``swarmsim fly`` against the stand-in: from the link string to the run's folder."""

import json
import socket
import sys
import threading
import time
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from swarmsim.autopilot.flown import FlownLog
from swarmsim.autopilot.link import Identity, LinkError, Setpoint, Telemetry
from swarmsim.autopilot.standin.kinematic import KinematicBody
from swarmsim.autopilot.standin.settings import load_settings
from swarmsim.autopilot.standin.sockets import open_link
from swarmsim.autopilot.standin.vehicle import Standin
from swarmsim.autopilot.under_way import Mark
from swarmsim.cli.entry import main
from swarmsim.cli.fly import EXIT_FLIGHT, _free, _outcome, _write
from swarmsim.results.out_folder import check_out
from tests.autopilot.ports import free_port

BLOCK = """
name: block
site: works_yard
engine: analytic
sources: [{nuclide: Co-60, position_m: [-60, -35], height_m: 0.5, activity_mbq: 100}]
vehicles:
  - {name: uav, type: tarot_t650, position_m: [-74, -42]}
  - {name: rover, type: orpheus, position_m: [-70, -50]}
phases:
  - name: block
    who: uav
    policy: waypoints
    settings: {points: [[-70, -42], [-60, -42]], speed_m_s: 2.3, altitude_m: 6.0}
    time_limit_s: 60
  - {name: drive, who: rover, policy: waypoints, settings: {points: [[-64, -50]], speed_m_s: 0.9}, time_limit_s: 40}
autopilot: {take_off_m: 2.0, ready_s: 20, land_s: 15, watchdogs: {heartbeat_s: 2.5, stale_s: 10}}
"""


@contextmanager
def standing_in(autopilot: str, *, flies: bool = True):
    """A stand-in that runs; itself, and the link string of who flies it."""
    if autopilot == "px4":
        port = free_port(socket.SOCK_DGRAM)
        theirs, ours = f"udpout:127.0.0.1:{port}", f"udpin:127.0.0.1:{port}"
    else:
        port = free_port(socket.SOCK_STREAM)
        theirs, ours = f"tcpin:127.0.0.1:{port}", f"tcp:127.0.0.1:{port}"
    settings = load_settings(autopilot)
    wire = open_link(theirs)
    try:
        with Standin(KinematicBody(flies=flies), settings, wire) as standin:
            yield standin, ours
    finally:
        wire.close()


@pytest.fixture(autouse=True)
def mission(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "block.yaml").write_text(BLOCK, encoding="utf-8")
    interval = sys.getswitchinterval()
    yield
    sys.setswitchinterval(interval)


@pytest.mark.slow
def test_a_dry_run_prints_table_and_map_and_sends_nothing(capsys):
    assert main(["fly", "block.yaml", "--vehicle", "uav", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "0 refused" in said
    assert "***" in said
    assert "S" in said


@pytest.mark.slow
@pytest.mark.parametrize(("autopilot", "vehicle"), [("px4", "uav"), ("ardupilot", "rover")])
def test_a_vehicle_flies_its_part_of_the_mission(autopilot, vehicle, tmp_path, capsys):
    with standing_in(autopilot, flies=vehicle == "uav") as (standin, link):
        assert main(["fly", "block.yaml", "--vehicle", vehicle, "--link", link, "--out", "out"]) == 0
        assert not standin.armed
    said = json.loads((tmp_path / "out" / "flown.json").read_text(encoding="utf-8"))
    assert said["ended"] == "as planned"
    assert said["autopilot"]["autopilot"] == autopilot
    assert said["cross_track"]["rms_m"] < 0.5
    track = pq.read_table(tmp_path / "out" / "flown.parquet").to_pydict()
    assert max(track["measured_x_m"]) > (-61.0 if vehicle == "uav" else -64.5)
    assert (tmp_path / "out" / "flight.tlog").stat().st_size > 10_000
    assert (tmp_path / "out" / "summary.json").is_file()
    assert np.isfinite(track["measured_y_m"]).all()
    compared = said["comparison"]
    assert compared["whole"]["from_simulated_track"]["rms_m"] < 0.5
    assert compared["whole"]["synchronised"]["rms_m"] < 2.0
    assert abs(compared["time_shift_s"]) < 20.0
    for name in ("simulated.parquet", "planned.parquet", "mission.rrd", "figures/flown.png"):
        assert (tmp_path / "out" / name).is_file()
    capsys.readouterr()


def test_a_flight_without_an_estimate_leaves_nothing_of_an_earlier_run_beside_its_own(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    for name in ("summary.json", "scenario.yaml", "flown.json"):
        (folder / name).touch()
    flight_log = FlownLog()
    here = Telemetry(position_m=(0.0, 0.0, 2.0), velocity_m_s=(0.0, 0.0, 0.0))
    flight_log.row(0.0, Setpoint(position_m=(0.0, 0.0, 2.0)), here, lambda: None)
    control = SimpleNamespace(stream=SimpleNamespace(gaps_s=lambda: np.zeros(0)), takeover_s=None)
    flight = SimpleNamespace(log=flight_log, control=control)
    live = SimpleNamespace(result=lambda: SimpleNamespace(segments=()))
    vehicle = SimpleNamespace(identity=Identity("px4", "copter", 1, 1))
    log = tmp_path / "out.tlog"
    log.touch()
    _write(None, live, flight, vehicle, "uav", folder, log, True, Console(quiet=True))
    assert {path.name for path in folder.iterdir()} == {"flown.json", "flown.parquet", "flight.tlog"}
    check_out(folder, force=True)


def in_flight(standin, then):
    """Do something when the mission has been under way for a while."""

    def wait():
        deadline = time.monotonic() + 120.0
        while not (standin.armed and standin.body.sensed.position_m[2] > 2.5) and time.monotonic() < deadline:
            time.sleep(0.02)
        then()

    threading.Thread(target=wait, daemon=True).start()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("autopilot", "what", "reason"),
    [
        ("px4", "operator", "operator"),
        ("px4", "silent", "check the link"),
        ("px4", "disarm", "disarmed"),
        ("ardupilot", "estimate", "estimate|failsafe"),
    ],
)
def test_what_happens_to_the_vehicle_ends_the_flight(autopilot, what, reason, tmp_path, capsys):
    seen, marked = [], tmp_path / ".out.under-way"
    with standing_in(autopilot) as (standin, link):

        def happen():
            seen.append(marked.exists())
            if what == "operator":
                standin.operator_mode("AUTO.LOITER")
            elif what == "disarm":
                standin.disarm_unexpectedly()
            else:
                setattr(standin.faults, {"silent": "silent", "estimate": "estimate_lost"}[what], True)

        in_flight(standin, happen)
        code = main(["fly", "block.yaml", "--vehicle", "uav", "--link", link, "--out", "out"])
    assert code == 4
    assert seen == [True]
    assert not marked.exists()
    said = json.loads((tmp_path / "out" / "flown.json").read_text(encoding="utf-8"))
    assert any(word in said["ended"] for word in reason.split("|")), said["ended"]
    if what == "operator":
        assert said["takeover_to_silence_s"] < 0.1
    capsys.readouterr()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--vehicle", "nobody"], "uav"),
        (["--vehicle", "uav", "--link", "carrier:pigeon"], "udpin"),
        (["--vehicle", "uav", "--set", "autopilot.stream_hz=1"], "stream_hz"),
        (["--vehicle", "uav", "--link", "sim:somewhere"], "sim:"),
        (["--vehicle", "uav", "--link", "sim:", "--recover", "land"], "none to be found"),
        (["--vehicle", "uav", "--manual", "keyboard"], "standard input"),
        (["--vehicle", "uav", "--manual", "gamepad", "--set", "autopilot.manual.device=/nowhere"], "/nowhere"),
        (["--vehicle", "uav", "--manual", "keyboard", "--dry-run"], "--manual"),
        (["--vehicle", "uav", "--set", "autopilot.manual.keys.land=space"], "twice"),
    ],
)
def test_wrong_input_is_told(arguments, word, capsys):
    assert main(["fly", "block.yaml", *arguments]) == 2
    assert word in capsys.readouterr().err


def test_a_rover_is_not_flown_as_a_copter(capsys):
    with standing_in("px4", flies=False) as (_, link):
        assert main(["fly", "block.yaml", "--vehicle", "uav", "--link", link]) == 2
    assert "rover" in capsys.readouterr().err


def test_a_vehicle_that_is_armed_is_refused_until_it_was_brought_down(capsys):
    with standing_in("px4") as (standin, link):
        bench = ["fly", "block.yaml", "--vehicle", "uav", "--link", link]
        standin.pilot.armed, standin.pilot.armed_s = True, standin.time_s + 60.0  # it would disarm by itself
        assert main(bench) == 4
        assert "--recover" in capsys.readouterr().err
        assert main([*bench, "--recover", "land"]) == 0
        assert not standin.armed


def test_a_flight_whose_program_was_killed_is_not_gone_on_with_until_told(tmp_path, capsys):
    mark = Mark(tmp_path / "out", "uav", "udpin:127.0.0.1:1")
    mark.set()  # as a program leaves it that is killed in flight
    with standing_in("px4") as (_, link):
        bench = ["fly", "block.yaml", "--vehicle", "uav", "--link", link, "--out", "out"]
        for _ in range(2):
            assert main(bench) == 4
            assert "broken off" in (said := capsys.readouterr().err)
            assert "--recover land" in said
            assert "armed at 2" in said
        assert not (tmp_path / "out").exists()
        assert main([*bench, "--recover", "land"]) == 0
        assert "disarmed" in capsys.readouterr().out
    mark.refuse()
    (tmp_path / ".out.under-way").write_text("{cut", encoding="utf-8")
    with pytest.raises(LinkError, match="into this folder was broken off"):
        mark.refuse()


def test_the_log_of_an_earlier_flight_is_not_written_over(tmp_path):
    log = tmp_path / "recon_uav1.tlog"
    assert _free(log) == log
    log.write_bytes(b"why it came down")
    (tmp_path / "recon_uav1-2.tlog").touch()
    assert _free(log) == tmp_path / "recon_uav1-3.tlog"


@pytest.mark.parametrize(
    ("error", "code"), [(ZeroDivisionError("a fault in a policy"), EXIT_FLIGHT), (KeyboardInterrupt(), 0)]
)
def test_whatever_ends_a_flight_its_results_are_written_first(error, code):
    flight = SimpleNamespace(log=FlownLog(), fly=Mock(side_effect=error))
    assert _outcome(flight, nullcontext()) == (code, error)
    assert flight.log.ended == ("stopped by the user" if not code else f"an error of the program: {error!r}")
