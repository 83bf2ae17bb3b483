"""``swarmsim sitl`` as a user meets it: start commands, wrong input, and real firmware where there is some."""

import json
import os
import shlex
import signal
import socket
import sys
import threading
import time

import numpy as np
import pyarrow.parquet as pq
import pytest

from swarmsim.autopilot.frames import Geodetic
from swarmsim.cli.entry import main
from swarmsim.cli.sitl import _make
from swarmsim.config.errors import InputError
from swarmsim.config.load import load_named
from swarmsim.sitl.firmware import STARTS, Firmware, parameters_of
from swarmsim.sitl.link import FirmwareError, Seat
from tests.autopilot.ports import free_port

SEAT = Seat("uav1", 2, True, (0, 1, 2, 3), Geodetic(47.4, 8.5, 488.0))
MISSION = """
name: block
site: works_yard
engine: analytic
sources: [{nuclide: Co-60, position_m: [-60, -35], height_m: 0.5, activity_mbq: 100}]
vehicles: [{name: uav1, type: tarot_t650, position_m: [-74, -42]}]
phases:
  - name: block
    who: uav1
    policy: waypoints
    settings: {points: [[-70, -42], [-50, -42], [-50, -37], [-70, -37]], speed_m_s: 2.3, altitude_m: 8.0}
    time_limit_s: 200
"""
PEER = """
import sys, time
from tests.sitl.firmwares import Px4Peer
peer = Px4Peer(int(sys.argv[1]) + int(sys.argv[2]), lambda heard: [0.3] * 4)
print("firmware", sys.argv[2], "at work", flush=True)
time.sleep(60)
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in STARTS.values():
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "block.yaml").write_text(MISSION, encoding="utf-8")
    return tmp_path


def started(command, folder):
    return Firmware(command, "px4", SEAT, load_named("vehicles", "x500"), folder / "uav1")


def test_a_start_command_is_told_what_differs(folder):
    one = started("echo {instance} {sysid} {kind} {home} {params} $PX4_PARAM_CA_ROTOR0_PX; pwd; sleep 60", folder)
    try:
        deadline = time.monotonic() + 10.0
        while one.log.read_text().count("\n") < 2 and time.monotonic() < deadline:
            time.sleep(0.02)
        said = one.log.read_text().split()
        one.check()
    finally:
        one.stop()
    assert said[:4] == ["2", "3", "copter", "47.4000000,8.5000000,488,0"]
    assert said[5:] == ["0.174", str(folder / "uav1")]
    with pytest.raises(FirmwareError, match="has ended"):
        one.check()


def test_a_firmware_that_ends_tells_what_it_printed_last(folder):
    one = started("echo no airframe of that name; exit 3", folder)
    one._process.wait(10.0)
    with pytest.raises(FirmwareError, match=r"code 3(.|\n)*no airframe of that name"):
        one.check()
    one.stop()


def test_what_a_start_command_started_ends_with_it(folder):
    one = started("sleep 77 & echo $!; wait", folder)
    deadline = time.monotonic() + 10.0
    while not one.log.read_text().strip() and time.monotonic() < deadline:
        time.sleep(0.02)
    child = int(one.log.read_text())
    one.stop()
    deadline = time.monotonic() + 5.0
    while os.path.exists(f"/proc/{child}") and "Z" not in state_of(child) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not os.path.exists(f"/proc/{child}") or "Z" in state_of(child)


def test_stopped_twice_nothing_is_left_of_a_firmware_that_does_not_end(folder, monkeypatch):
    one = started("trap '' TERM; echo up; sleep 60", folder)
    while "up" not in one.log.read_text(encoding="utf-8"):
        time.sleep(0.01)

    def interrupted(_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(time, "sleep", interrupted)
        with pytest.raises(KeyboardInterrupt):
            one.stop()
    assert one._process.wait(10.0) == -signal.SIGKILL


def state_of(process):
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0]
    except OSError:
        return "Z"


def test_an_unknown_name_in_braces_is_told(folder):
    with pytest.raises(InputError, match="instance"):
        started("px4 {number}", folder)
    with pytest.raises(InputError, match="twice"):
        started("px4 ${HOME", folder)


def test_parameters_hold_the_vehicle_in_the_air():
    x500 = load_named("vehicles", "x500")
    px4 = parameters_of("px4", x500)
    # weight / 4 = c w^2: sqrt(2.0643 * 9.81 / 4 / 8.54858e-6) = 769.6 of 1000 rad/s
    assert px4["MPC_THR_HOVER"] == pytest.approx(0.7696, abs=1e-3)
    assert px4["CA_ROTOR0_PY"] == pytest.approx(0.174)  # the front right one, FRD
    assert px4["CA_ROTOR_COUNT"] == 4
    assert px4["CA_ROTOR2_KM"] < 0.0 < px4["CA_ROTOR0_KM"]
    ardupilot = parameters_of("ardupilot", x500)
    assert ardupilot["MOT_THST_HOVER"] == pytest.approx(0.7696**2, abs=1e-3)
    assert parameters_of("ardupilot", load_named("vehicles", "dji_f550"))["FRAME_CLASS"] == 2
    husky = load_named("vehicles", "husky")
    drive = parameters_of("px4", husky)
    assert drive["RD_WHEEL_TRACK"] == husky.wheels.track_m
    assert drive["RO_MAX_THR_SPEED"] == drive["RO_SPEED_LIM"] == husky.control.speed_max_m_s
    assert drive["RO_YAW_RATE_LIM"] == pytest.approx(np.degrees(husky.control.yaw_rate_max_rad_s), abs=0.01)
    cruise = parameters_of("ardupilot", husky)  # the throttle that drives at this speed: full output, full speed
    assert cruise["CRUISE_SPEED"] / husky.control.speed_max_m_s == cruise["CRUISE_THROTTLE"] / 100.0


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--vehicle", "nobody"], "uav1"),
        (["--vehicles", "5"], "fewer"),
        (["--vehicles", "1", "--vehicle", "uav1"], "either"),
        (["--speed", "-1"], "speed"),
        (["--set", "autopilot.origin={latitude_deg: 95, longitude_deg: 0, altitude_m: 0}"], "latitude_deg"),
    ],
)
def test_wrong_input_is_told(arguments, word, capsys):
    assert main(["sitl", "block.yaml", "--autopilot", "px4", *arguments]) == 2
    assert word in capsys.readouterr().err


def test_an_earlier_session_is_replaced_only_when_asked(folder, capsys):
    (folder / "out").mkdir()
    (folder / "out" / "thesis.tex").write_text("all of it", encoding="utf-8")
    for force in ([], ["--force"]):
        assert main(["sitl", "block.yaml", "--autopilot", "px4", "--out", "out", *force]) == 2
        assert "--force" in capsys.readouterr().err
    assert (folder / "out" / "thesis.tex").is_file()


def test_a_session_whose_firmware_did_not_start_is_replaced_when_asked(folder):
    _make(folder / "out", force=False)
    started("echo broken; exit 1", folder / "out").stop()
    with pytest.raises(InputError):
        _make(folder / "out", force=False)
    _make(folder / "out", force=True)
    assert list((folder / "out").iterdir()) == []


@pytest.mark.slow
def test_a_session_from_start_to_report(folder, monkeypatch, capsys):
    (folder / "peer.py").write_text(PEER, encoding="utf-8")
    port = free_port(socket.SOCK_STREAM)
    settings_of(monkeypatch, port)
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    start = f"PYTHONPATH={shlex.quote(root)} exec {sys.executable} {folder / 'peer.py'} {port} {{instance}}"
    arguments = ["sitl", "block.yaml", "--autopilot", "px4", "--speed", "0", "--duration", "1", "--out", "out"]
    assert main([*arguments, "--start", start]) == 0
    assert "x real time" in capsys.readouterr().out
    report = json.loads((folder / "out" / "sitl.json").read_text(encoding="utf-8"))
    assert report["vehicles"][0]["missed"] == 0
    assert report["simulated_s"] == pytest.approx(1.0, abs=0.01)
    assert report["vehicles"][0]["restarts"] == 0
    assert 0.99 < report["vehicles"][0]["battery_left"] < 1.0
    table = pq.read_table(folder / "out" / "sitl.parquet").to_pydict()
    assert np.isfinite(table["position_z_m"]).all()
    assert table["battery_left"][0] > table["battery_left"][-1] == report["vehicles"][0]["battery_left"]
    assert "at work" in (folder / "out" / "uav1" / "firmware.log").read_text(encoding="utf-8")
    assert main([*arguments, "--start", "echo broken; exit 1"]) == 2  # there is a session already
    one_step = [*arguments[:6], "--duration", "0.001", "--out", "out", "--force", "--start", start]
    assert main(one_step) == 0
    assert len(pq.read_table(folder / "out" / "sitl.parquet")) == 1
    assert main([*arguments, "--force", "--start", "echo broken; exit 1"]) == 4
    assert "broken" in capsys.readouterr().err


def settings_of(monkeypatch, port):
    from swarmsim.sitl import settings

    original = settings.load_sitl_settings
    monkeypatch.setattr(
        settings, "load_sitl_settings", lambda kind: original(kind).model_copy(update={"port": port, "start_s": 60.0})
    )


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_real_firmware_flies_its_part_of_a_mission(autopilot, folder, capsys):
    """`fly` on top of `sitl`: the firmware arms, takes off, flies its lines in our physics, and lands."""
    start = os.environ.get(STARTS[autopilot]) or _REAL.get(autopilot)
    if not start:
        pytest.skip(f"no firmware: {STARTS[autopilot]} is not set to its start command")
    physics = [
        "sitl",
        "block.yaml",
        "--autopilot",
        autopilot,
        "--out",
        "physics",
        "--duration",
        "150",
        "--start",
        start,
    ]
    codes = []
    thread = threading.Thread(target=lambda: codes.append(main(physics)), daemon=True)
    thread.start()
    link = {"px4": "udpin:127.0.0.1:14540", "ardupilot": "tcp:127.0.0.1:5760"}[autopilot]
    deadline = time.monotonic() + 120.0
    while not list((folder / "physics").glob("uav1/firmware.log")) and time.monotonic() < deadline:
        time.sleep(0.5)
    time.sleep(10.0)
    assert main(["fly", "block.yaml", "--vehicle", "uav1", "--link", link, "--out", "flown"]) == 0
    report = json.loads((folder / "flown" / "flown.json").read_text(encoding="utf-8"))
    assert report["ended"] == "as planned"
    assert report["cross_track"]["rms_m"] <= 0.5
    thread.join(300.0)
    assert codes == [0]
    capsys.readouterr()


_REAL = {kind: os.environ.get(name) for kind, name in STARTS.items()}  # before a fixture takes them away
