"""A flight in a viewer that runs elsewhere, is slow, closes, or is not there."""

import socket
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from swarmsim.autopilot.link import Setpoint, Telemetry
from swarmsim.config.errors import InputError
from swarmsim.playback import live as live_module
from swarmsim.playback import viewer
from swarmsim.playback.live import WAITING, LiveView
from swarmsim.results.record import VehicleRecord
from tests.autopilot.ports import free_port

NAMES = ("uav1", "rover")


class FakeMission:
    """Two vehicles that move."""

    def __init__(self):
        self.asked = 0

    def team(self):
        self.asked += 1
        place = np.array([0.5 * self.asked, 0.0, 3.0])
        return tuple((name, place, np.array([1.0, 0.0, 0.0, 0.0])) for name in NAMES)

    def count_rates_cps(self):
        return {"uav1": 120.0}

    def path_m(self):
        return np.array([[0.0, 0, 3], [10, 0, 3]])


@pytest.fixture
def simulation(site):
    members = [SimpleNamespace(name=name) for name in NAMES]
    scenario = SimpleNamespace(members=members, mission=SimpleNamespace(name="block"))
    return SimpleNamespace(scenario=scenario, site_model=site)


@pytest.fixture(autouse=True)
def still(monkeypatch):
    def vehicle(simulation, number):
        nothing = np.zeros(0)
        kind = "multirotor" if number == 0 else "skid_steer"
        return VehicleRecord(NAMES[number], kind, kind, nothing, nothing, nothing, nothing, nothing, nothing, False)

    monkeypatch.setattr(live_module, "still_vehicle", vehicle)
    monkeypatch.setattr(live_module, "RATE_HZ", 1e6)


def fly(view, steps, seconds=0.0):
    """The longest that one call took."""
    longest = 0.0
    for k in range(steps):
        telemetry = Telemetry(position_m=(0.0, 0.0, 3.0), mode_name="OFFBOARD", armed=True, battery=0.9)
        setpoint = Setpoint(position_m=(1.0, 0.0, 3.0)) if k % 3 else None
        began = time.perf_counter()
        view.observe(SimpleNamespace(time_s=0.05 * k), setpoint, telemetry)
        longest = max(longest, time.perf_counter() - began)
        time.sleep(seconds)
    return longest


@pytest.fixture
def stream(monkeypatch):
    """What is logged, in place of a connection to a viewer."""
    logged = []

    class Stream:
        def __init__(self, *args, **options):
            self.hold = None

        def __getattr__(self, name):
            def call(*args, **options):
                if name == "log":
                    if self.hold is not None:
                        self.hold.wait(10.0)
                    logged.append(args[0])

            return call

    made = Stream()
    made.logged = logged
    monkeypatch.setattr(live_module.rr, "RecordingStream", lambda *a, **o: made)
    return made


def test_every_step_is_shown(simulation, stream):
    view = LiveView(simulation, FakeMission(), "uav1", "rerun+http://127.0.0.1:1/proxy")
    fly(view, 20, 0.02)
    view.close()
    assert view.dropped == 0
    assert stream.logged.count("world/vehicles/uav1") == 20
    assert stream.logged.count("world/trails/rover") >= 19
    assert stream.logged.count("world/planned") == 1
    assert stream.logged.count("log/vehicle") == 1
    assert stream.logged.count("plots/rate/uav1") >= 20
    assert "world/setpoint" in stream.logged


def test_a_viewer_that_hangs_costs_steps_and_no_time(simulation, stream):
    stream.hold = threading.Event()
    mission = FakeMission()
    view = LiveView(simulation, mission, "uav1", "rerun+http://127.0.0.1:1/proxy")
    assert fly(view, 200) < 0.5
    assert view.dropped >= 200 - WAITING - 2
    assert mission.asked <= WAITING + 2
    stream.hold.set()
    view.close()


def test_a_viewer_that_is_gone_disturbs_nothing(simulation):
    view = LiveView(simulation, FakeMission(), "uav1", f"rerun+http://127.0.0.1:{free_port(socket.SOCK_STREAM)}/proxy")
    assert fly(view, 50, 0.002) < 0.5
    began = time.perf_counter()
    view.close()
    assert time.perf_counter() - began < 20.0


def test_wrong_addresses_are_refused(simulation):
    with pytest.raises(InputError, match="no address"):
        LiveView(simulation, FakeMission(), "uav1", "nonsense")
    for url in ("http://127.0.0.1:9876", "rerun+http://127.0.0.1/proxy", "rerun+http://[::1", "nonsense"):
        with pytest.raises(InputError, match="no address"):
            viewer.live_address(url)
    with pytest.raises(InputError, match="no viewer answers"):
        viewer.live_address(f"rerun+http://127.0.0.1:{free_port(socket.SOCK_STREAM)}/proxy")


def test_a_viewer_that_runs_is_used(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        url = f"rerun+http://127.0.0.1:{port}/proxy"
        assert viewer.live_address(url) == url
        assert viewer.live_address(None, port) == url


def test_a_viewer_that_cannot_open_is_told(monkeypatch):
    port = free_port(socket.SOCK_STREAM)
    with pytest.raises(InputError, match="exit code 3"):
        viewer._start_viewer([sys.executable, "-c", "raise SystemExit(3)"], port)
    monkeypatch.setattr(viewer, "_START_S", 0.5)
    with pytest.raises(InputError, match="did not answer"):
        viewer._start_viewer([sys.executable, "-c", "import time; time.sleep(60)"], port)
