"""A program that was stopped, or whose computer was suspended: it notices, and sends nothing old."""

import math
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest

from swarmsim.autopilot.control import Control, State
from swarmsim.autopilot.guard import Guard
from swarmsim.autopilot.link import Mode, Setpoint
from swarmsim.autopilot.pulse import Pulse, since_boot_s
from swarmsim.config.autopilot import Autopilot, Watchdogs
from tests.autopilot.fake_link import FakeLink
from tests.autopilot.stick_peers import ardrone_link, ardrone_peer

QUICK = Autopilot(
    take_off_m=2.0, answer_s=1.0, take_off_s=10.0, land_s=20.0,
    watchdogs=Watchdogs(stale_s=1.0, hold_s=0.3, heartbeat_s=2.0),
)  # fmt: skip
OUTLINE_M = np.array([[-100.0, -100.0], [100.0, -100.0], [100.0, 100.0], [-100.0, 100.0]])
THERE = Setpoint(position_m=(0.5, 0.0, 2.0), velocity_m_s=(0.0, 0.0, 0.0))


class Clock:
    """Goes on as the others do, but for what a test adds: `time.monotonic` stands still while it is suspended."""

    def __init__(self):
        self.suspended_s = 0.0

    def __call__(self):
        return time.monotonic() + self.suspended_s


@pytest.fixture
def link():
    made = FakeLink(streams_first=False)
    yield made
    made.close()


def following(link, told=lambda _: None):
    """A vehicle that follows, and the clock of the computer that flies it."""
    guard, clock = Guard(limits=QUICK.limits, outline_m=OUTLINE_M, ground_m=0.0, flies=True), Clock()
    control = Control(link, QUICK, guard, True, told)
    control.stream.pulse = Pulse(1.0, clock)
    link.on_mode(control.on_telemetry)
    control.stream.start()
    assert control.start((0.0, 0.0, 2.0), 0.0)
    return control, clock


def flown(control, until, seconds=10.0):
    """Look after the vehicle and offer setpoints as a flight does."""
    end = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < end
        if control.watch():
            control.offer(THERE)
        time.sleep(0.02)


def test_a_pause_is_noticed_whoever_looks_first():
    clock = Clock()
    pulse = Pulse(1.0, clock)
    clock.suspended_s = 60.0
    assert pulse.pauses() == (0, 0.0)  # nobody has told yet that it runs
    pulse.beat()
    clock.suspended_s += 0.9
    assert pulse.pauses()[0] == 0
    pulse.beat()
    clock.suspended_s += 60.0
    count, paused_s = pulse.pauses()
    assert (count, paused_s) == (1, pytest.approx(60.0, abs=1.0))
    pulse.beat()
    assert pulse.pauses()[0] == 1
    assert pulse.just_woke()
    pulse.end()
    clock.suspended_s += 60.0
    assert pulse.pauses()[0] == 1


def test_the_clock_goes_on():
    before = since_boot_s()
    time.sleep(0.01)
    assert 0.0 < since_boot_s() - before < 5.0


def test_after_a_suspension_it_waits_for_a_heartbeat_but_not_for_ever():
    clock = Clock()
    pulse = Pulse(1.0, clock)
    pulse.settle(lambda: None, 60.0)  # there was no pause
    pulse.beat()
    clock.suspended_s = 60.0
    begin = time.monotonic()
    pulse.settle(lambda: begin, 0.3)  # what had queued up
    assert time.monotonic() - begin > 0.7
    begin = time.monotonic()
    pulse.settle(time.monotonic, 60.0)
    assert time.monotonic() - begin < 10.0


def test_a_suspended_computer_holds_the_vehicle_and_lands_it(link):
    control, clock = following(link)
    flown(control, lambda: len(link.sent) > 10)
    clock.suspended_s = 60.0
    sent = len(link.sent)
    control.offer(THERE)  # of a mission that does not know yet
    flown(control, lambda: control.alarm is not None)
    assert "60 s" in control.alarm.reason
    assert "suspended" in control.alarm.reason
    flown(control, lambda: control.state is State.ENDS)
    assert len(link.sent) - sent <= 1  # one may have been under way
    assert link.asked[-2:] == ["hold", "land"]


@pytest.mark.parametrize("mode", [Mode.OTHER, Mode.HOLD, Mode.LAND])
@pytest.mark.parametrize("stuck", [False, True])
def test_an_operator_who_takes_over_while_it_is_suspended_is_not_overruled(link, mode, stuck):
    """Of the vehicle nothing new is known at first: what was heard before says that it follows."""
    control, clock = following(link)
    flown(control, lambda: len(link.sent) > 10)
    asked = list(link.asked)
    link.heard = False
    clock.suspended_s = 60.0

    def hear():
        link.heard = True
        link.change(mode)

    threading.Timer(0.7, hear).start()
    if stuck:  # nobody but the stream looks after it
        time.sleep(2.5)
    else:
        flown(control, lambda: control.state is State.RELEASED)
    assert link.asked == asked
    assert link.mode is mode
    assert control.takeover_s is not None
    assert control.stream.halted


def test_a_vehicle_holds_after_a_suspension_though_the_flight_is_stuck(link):
    control, clock = following(link)
    flown(control, lambda: len(link.sent) > 10)
    control.hold()  # for a long time, while the mission plans
    clock.suspended_s = 60.0
    end = time.monotonic() + 10.0
    while link.armed:
        assert time.monotonic() < end
        time.sleep(0.02)
    assert [what for what in link.asked if what.startswith("request")] == ["request hold", "request land"]


def test_a_pause_on_the_ground_is_none_of_the_flights(link):
    guard, clock = Guard(limits=QUICK.limits, outline_m=OUTLINE_M, ground_m=0.0, flies=True), Clock()
    control = Control(link, QUICK, guard, True, lambda _: None)
    control.stream.pulse = Pulse(1.0, clock)
    control.stream.start()
    time.sleep(0.2)
    clock.suspended_s = 60.0
    assert control.start((0.0, 0.0, 2.0), 0.0)
    assert control.watch()


def test_a_vehicle_that_is_flown_by_sticks_forgets_its_setpoint_in_a_pause(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("swarmsim.autopilot.stick_link.since_boot_s", clock)
    with ardrone_peer() as peer, ardrone_link(peer) as link:
        with link._lock:
            link._goal = math.inf, THERE
        time.sleep(0.3)
        assert link._goal is not None
        clock.suspended_s = 60.0
        end = time.monotonic() + 10.0
        while link._goal is not None:
            assert time.monotonic() < end
            time.sleep(0.01)


STOPPED = """
    import time
    from swarmsim.autopilot.guard import Guard
    from tests.autopilot.test_pauses import THERE, FakeLink, following, flown

    link = FakeLink(streams_first=False)
    control, clock = following(link, lambda text: print(text, flush=True))
    flown(control, lambda: len(link.sent) > 5)
    print("flies", flush=True)
    flown(control, lambda: control.alarm is not None, 60.0)
    times = [when for when, _ in link.sent]
    gaps = [(b - a, len(times) - 2 - k) for k, (a, b) in enumerate(zip(times, times[1:])) if b - a > 2.0]
    print("sent after the pause:", gaps[0][1] + 1 if gaps else 0, control.alarm.reason, flush=True)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="this system stops no programs")
def test_a_stopped_program_sends_nothing_old_when_it_goes_on():
    child = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(STOPPED)], stdout=subprocess.PIPE, text=True, env=os.environ
    )
    try:
        lines = iter(child.stdout.readline, "")
        assert any(line == "flies\n" for line in lines)
        child.send_signal(signal.SIGSTOP)
        time.sleep(3.0)
        child.send_signal(signal.SIGCONT)
        last = next(line for line in lines if line.startswith("sent"))
        assert int(last.split(":")[1].split()[0]) <= 1, last  # one may have been under way
        assert "this program was stopped" in last
    finally:
        child.kill()
        child.wait()
        child.stdout.close()
