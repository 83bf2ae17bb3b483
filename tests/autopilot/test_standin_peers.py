"""Programs of others fly the stand-in: MAVSDK and MAVProxy, where they are installed."""

import asyncio
import importlib.util
import shutil
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable

import pytest

from swarmsim.autopilot.standin.kinematic import KinematicBody
from swarmsim.autopilot.standin.settings import load_settings
from swarmsim.autopilot.standin.sockets import open_link
from swarmsim.autopilot.standin.vehicle import Standin
from tests.autopilot.ports import free_port

SPEED = 3.0


def mavsdk_system():
    """MAVSDK's class for a vehicle, of releases before 4; the test is skipped where there is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its own, of a new name
        try:
            from mavsdk import System
        except ImportError:
            pytest.skip("mavsdk is not installed (pip install 'mavsdk<4')")
    return System


@pytest.mark.filterwarnings("ignore")  # of grpc and of MAVSDK's server, which is left to end by itself
def test_mavsdk_arms_takes_off_and_lands():
    system = mavsdk_system()
    port, server = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
    heights: list[float] = []

    async def fly() -> None:
        drone = system(port=server)
        await drone.connect(system_address=f"udpin://127.0.0.1:{port}")
        async for health in drone.telemetry.health():
            if health.is_global_position_ok and health.is_home_position_ok and health.is_armable:
                break
        await drone.action.set_takeoff_altitude(4.0)
        await drone.action.arm()
        await drone.action.takeoff()
        async for position in drone.telemetry.position():
            heights.append(position.relative_altitude_m)
            if heights[-1] > 3.0:
                break
        await drone.action.land()
        async for armed in drone.telemetry.armed():
            if not armed:
                break

    link = open_link(f"udpout:127.0.0.1:{port}")
    with Standin(KinematicBody(), load_settings("px4"), link, speed=SPEED) as standin:
        asyncio.run(asyncio.wait_for(fly(), 60.0))
        assert not standin.armed
        assert standin.body.sensed.height_m < 0.1
    assert heights[-1] > 3.0


def test_mavproxy_arms_takes_off_and_lands(tmp_path):
    command = shutil.which("mavproxy.py")
    if command is None or importlib.util.find_spec("MAVProxy") is None:
        pytest.skip("MAVProxy is not installed (pip install MAVProxy)")
    link = open_link("tcpin:127.0.0.1:0")
    arguments = [sys.executable, command, f"--master={link.address}", "--streamrate=4"]
    with (
        Standin(KinematicBody(), load_settings("ardupilot"), link, speed=SPEED) as standin,
        open(tmp_path / "output", "w") as output,
        subprocess.Popen(
            arguments, cwd=tmp_path, text=True, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT
        ) as proxy,
    ):

        def say(line: str, condition: Callable[[], bool]) -> None:
            proxy.stdin.write(f"{line}\n")
            proxy.stdin.flush()
            wait_for(condition, 20.0)

        try:
            wait_for(lambda: "online system 1" in (tmp_path / "output").read_text(), 30.0)
            wait_for(lambda: standin.pilot.ready, 10.0)  # or GUIDED is refused
            say("mode GUIDED", lambda: standin.mode == "GUIDED")
            say("arm throttle", lambda: standin.armed)
            say("takeoff 4", lambda: standin.body.sensed.height_m > 3.5)
            say("mode LAND", lambda: not standin.armed)
        finally:
            proxy.terminate()
            proxy.stdin.close()
    assert standin.body.sensed.height_m < 0.1


def wait_for(condition: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)
