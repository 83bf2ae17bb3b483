"""The simulated vehicle behind `VehicleLink`, over a body without physics."""

import math
import threading
import time

import numpy as np
import pytest

from swarmsim.autopilot.frames import yaw_of_quaternion
from swarmsim.autopilot.link import LinkError, Mode, Setpoint
from swarmsim.autopilot.simulated import SimulatedLink, load_manners
from swarmsim.autopilot.standin.kinematic import KinematicBody

FAST = load_manners().model_copy(update={"setpoint_s": 0.3, "land_speed_m_s": 1.5, "return_wait_s": 0.1})


@pytest.fixture(params=[True, False], ids=["copter", "rover"])
def link(request):
    made = SimulatedLink(KinematicBody(flies=request.param), FAST)
    yield made
    made.close()


def until(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def under_way(link, height_m=2.0):
    link.preflight(lambda _: None, 1.0)
    ground_m = link.telemetry().position_m[2]
    link.follow(1.0)
    link.arm(1.0)
    link.take_off(height_m, 1.0)
    if link.identity.vehicle == "copter":
        until(lambda: link.telemetry().position_m[2] - ground_m > 0.85 * height_m)


def streamed(link, setpoint, seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        link.send(setpoint)
        time.sleep(0.02)


def test_it_moves_as_it_is_told_and_holds_without_setpoints(link):
    copter = link.identity.vehicle == "copter"
    told = []
    link.on_mode(lambda t: told.append((t.mode, t.armed, t.failsafe)))
    link.align((10.0, 20.0, 5.0))
    assert np.allclose(link.telemetry().position_m, (10.0, 20.0, 5.0))
    under_way(link)
    begin = np.array(link.telemetry().position_m)
    streamed(link, Setpoint(velocity_m_s=(1.0, 0.0, 0.0), yaw_rate_rad_s=0.5, body=not copter), 1.0)
    moved, yaw = np.array(link.telemetry().position_m) - begin, yaw_of_quaternion(link.telemetry().quaternion)
    assert moved[0] > 0.5
    assert yaw > 0.3  # counter-clockwise
    assert moved[1] > 0.1 or copter  # the rover's way bends to its left
    until(lambda: link.telemetry().mode is Mode.HOLD)
    assert told == [(Mode.FOLLOW, False, False), (Mode.FOLLOW, True, False), (Mode.HOLD, True, True)]
    assert "no setpoint" in link.messages()[0]
    assert link.messages() == []


def test_a_position_is_that_of_the_missions_world():
    link = SimulatedLink(KinematicBody(), FAST)
    try:
        link.align((100.0, -50.0, 7.0))
        under_way(link)
        streamed(link, Setpoint(position_m=(102.0, -50.0, 9.0), velocity_m_s=(0.0, 0.0, 0.0), yaw_rad=1.0), 4.0)
        assert math.dist(link.telemetry().position_m, (102.0, -50.0, 9.0)) < 0.3
        assert abs(yaw_of_quaternion(link.telemetry().quaternion) - 1.0) < 0.01
        link.send(Setpoint(velocity_m_s=(2.0, 0.0, 0.0), body=True))
        time.sleep(0.2)
        vx, vy, _ = link.telemetry().velocity_m_s
        assert vy > vx > 0.0  # forward, at a heading of 57 degrees
    finally:
        link.close()


@pytest.mark.parametrize("mode", [Mode.LAND, Mode.RETURN])
def test_a_copter_lands_and_disarms(mode):
    link = SimulatedLink(KinematicBody(), FAST)
    try:
        under_way(link, 1.0)
        with pytest.raises(LinkError, match="flies"):
            link.disarm(1.0)
        link.enter(mode, 1.0)
        until(lambda: link.telemetry().armed is False, 60.0)
        assert link.telemetry().on_ground
        assert math.hypot(*link.telemetry().position_m[:2]) < 0.5
    finally:
        link.close()


def test_a_rover_is_disarmed_where_it_stands():
    link = SimulatedLink(KinematicBody(flies=False), FAST)
    try:
        under_way(link)
        link.enter(Mode.LAND, 1.0)
        assert link.telemetry().armed
        link.disarm(1.0)
        assert link.telemetry().armed is False
    finally:
        link.close()


def test_what_it_cannot_do_is_told(link):
    with pytest.raises(LinkError, match="armed"):
        link.take_off(2.0, 1.0)
    with pytest.raises(LinkError, match="hold, land, return"):
        link.request(Mode.OTHER)


class Broken(KinematicBody):
    def step(self, motion, armed):
        raise ArithmeticError("the integrator has failed")


def test_physics_that_fails_is_told_by_the_next_call():
    link = SimulatedLink(Broken(), FAST)
    try:
        until(lambda: not link._thread.is_alive())
        with pytest.raises(LinkError, match="integrator"):
            link.arm(1.0)
        with pytest.raises(LinkError, match="integrator"):
            link.send(Setpoint(velocity_m_s=(0.0, 0.0, 0.0)))
    finally:
        link.close()


def test_who_listens_may_wait_for_who_sends():
    """A callback that waits for a lock that the sender holds: the flight's stream does that."""
    link = SimulatedLink(KinematicBody(), FAST)
    lock, called = threading.Lock(), []

    def halt(t):
        with lock:
            called.append(t.mode)

    def send():
        for _ in range(200):
            with lock:
                time.sleep(0.001)
                link.send(Setpoint(velocity_m_s=(0.0, 0.0, 0.0)))

    try:
        under_way(link)
        link.on_mode(halt)
        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        for mode in [Mode.HOLD, Mode.LAND] * 20:
            link.request(mode)
            time.sleep(0.002)
        thread.join(10.0)
        assert not thread.is_alive()
        assert len(called) == 40
    finally:
        link.close()
