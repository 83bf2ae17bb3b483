"""The command `swarmsim autopilot-sim`: what it refuses, how it ends."""

import math
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing

import pytest
from pymavlink import mavutil

import swarmsim.autopilot.standin.body as body
from swarmsim.autopilot.standin.kinematic import KinematicBody
from swarmsim.cli.autopilot_sim import run_stand_in
from swarmsim.config.errors import InputError

START = """
import sys
import swarmsim.autopilot.standin.body as body
from swarmsim.autopilot.standin.kinematic import KinematicBody
from swarmsim.cli.autopilot_sim import run_stand_in

KinematicBody.name = "vehicle"
body.SimulatedBody = lambda scenario, seed: KinematicBody()
sys.exit(run_stand_in(None, None, "px4", "udpin:127.0.0.1:0", 1, 2.0, 0))
"""


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"mission": "reccon"}, "recon"),
        ({"vehicle": "uav9", "mission": "recon"}, "uav1"),
        ({"autopilot": "betaflight"}, "px4 or ardupilot"),
        ({"link": "carrier pigeon"}, "udpout"),
    ],
)
def test_wrong_input_is_told(changed, told):
    given = {"mission": None, "vehicle": None, "autopilot": "px4", "link": None, "system": 1, "speed": 1.0, "seed": 0}
    with pytest.raises(InputError, match=told):
        run_stand_in(**(given | changed))


def test_a_setpoint_that_is_no_number_ends_ardupilot_as_a_signal_does(monkeypatch, capsys):
    class Body(KinematicBody):
        name = "uav1"

        def __init__(self, scenario, seed):
            assert [member.name for member in scenario.members] == ["uav1"]
            assert scenario.vehicles[0].detector is None
            super().__init__()

    monkeypatch.setattr(body, "SimulatedBody", Body)
    with closing(mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=250)) as client:
        port = client.port.getsockname()[1]

        def kill() -> None:
            while client.recv_match(type="HEARTBEAT", blocking=True, timeout=5.0).system_status == 2:  # calibrating
                pass
            client.mav.command_long_send(1, 1, 176, 0, 1, 4, 0, 0, 0, 0, 0)
            client.recv_match(type="COMMAND_ACK", blocking=True, timeout=5.0)
            client.mav.set_position_target_local_ned_send(0, 1, 1, 1, 3576, math.nan, *[0.0] * 10)

        thread = threading.Thread(target=kill)
        thread.start()
        code = run_stand_in("recon", "uav1", "ardupilot", f"udpout:127.0.0.1:{port}", 1, 20.0, 0)
        thread.join()
    assert code == 136
    told = capsys.readouterr().out
    assert "floating point exception" in told


def test_ctrl_c_ends_it():
    with subprocess.Popen(
        [sys.executable, "-c", START], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    ) as process:  # fmt: skip
        assert "ends with Ctrl-C" in process.stdout.readline()
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        start = time.monotonic()
        try:
            _, errors = process.communicate(timeout=10.0)
        finally:
            process.kill()
    assert time.monotonic() - start < 3.0
    assert errors.rstrip().endswith("KeyboardInterrupt")
