"""Who flies, pilot or policy, when a device is lost and found, a key is pressed twice, or the flight is stuck."""

import time

import numpy as np
import pytest

from swarmsim.autopilot.control import Control, State
from swarmsim.autopilot.guard import Guard
from swarmsim.autopilot.link import Mode, Setpoint
from swarmsim.autopilot.manual.helm import STUCK_S, Helm
from swarmsim.autopilot.manual.sticks import CENTRED, Event, Reading, Sticks
from swarmsim.config.autopilot import Autopilot, Watchdogs
from tests.autopilot.fake_link import FakeLink

SETTINGS = Autopilot(take_off_m=2.0, answer_s=1.0, take_off_s=10.0, watchdogs=Watchdogs(stale_s=20.0, hold_s=0.1))
OUTLINE_M = np.array([[-100.0, -100.0], [100.0, -100.0], [100.0, 100.0], [-100.0, 100.0]])
POLICY = Setpoint(position_m=(0.0, 0.0, 2.0), velocity_m_s=(0.0, 0.0, 0.0))


class Device:
    """Gives what a test sets."""

    def __init__(self):
        self.sticks, self.lost, self.events, self.now_s = CENTRED, None, [], 0.0

    def read(self, now_s):
        events, self.events = tuple(self.events), []
        return Reading(self.sticks if self.lost is None else CENTRED, events, self.lost)

    def told(self, flies):
        return ""


@pytest.fixture
def manned():
    """A vehicle that follows, its helm, the pilot's device; the helm looks when a test says so."""
    link, device = FakeLink(streams_first=False), Device()
    guard = Guard(limits=SETTINGS.limits, outline_m=OUTLINE_M, ground_m=0.0, flies=True)
    control = Control(link, SETTINGS, guard, True, lambda _: None)
    link.on_mode(control.on_telemetry)
    control.stream.start()
    assert control.start((0.0, 0.0, 2.0), 0.0)
    helm = Helm(device, control, guard, SETTINGS, 8.0, lambda _: None)
    yield link, control, helm, device
    control.stream.close()
    link.close()


def looked(helm, device, *events, seconds=0.4):
    """Let the helm look for a while; the fastest that it asked for meanwhile."""
    device.events = list(events)
    fastest = 0.0
    for _ in range(round(seconds / 0.05)):
        device.now_s += 0.05
        helm.look(device.now_s)
        if helm.flies and helm.setpoint is not None and helm.setpoint.velocity_m_s is not None:
            fastest = max(fastest, float(np.hypot(*helm.setpoint.velocity_m_s[:2])))
    return fastest


def test_a_device_that_is_found_again_counts_once_its_sticks_are_centred(manned):
    _, _, helm, device = manned
    device.sticks = Sticks(forward=1.0)
    assert looked(helm, device, Event.TAKE_OVER) > 0.5
    device.lost = "unplugged"
    looked(helm, device, seconds=3.0)
    assert helm.setpoint.velocity_m_s[:2] == (0.0, 0.0)
    device.lost = None  # plugged in with a stick pushed, or lying on it
    assert looked(helm, device, seconds=2.0) < 1e-6
    device.sticks = CENTRED
    looked(helm, device)
    device.sticks = Sticks(forward=1.0)
    assert looked(helm, device) > 0.5


@pytest.mark.parametrize("event", [Event.TAKE_OVER, Event.HOLD])
def test_a_pilot_takes_back_what_the_mission_has_not_taken_yet(manned, event):
    _, _, helm, device = manned
    looked(helm, device, Event.TAKE_OVER)
    looked(helm, device, Event.TAKE_OVER)
    assert helm.handed_back() is not None
    looked(helm, device, event)
    assert helm.handed_back() is None
    assert helm.flies
    assert not helm.resume()  # of a flight that had seen it handed back
    assert helm.flies
    device.sticks = CENTRED
    looked(helm, device)
    device.sticks = Sticks(left=1.0)
    assert looked(helm, device) > 0.5
    looked(helm, device, Event.TAKE_OVER)
    assert helm.resume()
    assert not helm.flies
    assert helm.offer(POLICY) is not None


@pytest.mark.parametrize(("event", "mode"), [(Event.LAND, Mode.LAND), (Event.RETURN, Mode.RETURN)])
def test_a_pilot_lands_it_though_the_flight_is_stuck(manned, event, mode):
    link, control, helm, device = manned
    looked(helm, device, Event.TAKE_OVER)
    looked(helm, device, event, seconds=0.8 * STUCK_S)
    assert link.mode is Mode.FOLLOW  # the flight is asked first
    looked(helm, device, seconds=0.5 * STUCK_S)
    assert link.mode is mode
    assert control.stream.halted
    looked(helm, device, seconds=2.0)
    assert [what for what in link.asked if what.startswith("request")] == [f"request {mode.value}"]
    assert control.watch()  # it is nobody else's: the flight goes on, and takes notice
    assert helm.wish() is event
    control.end(event.value)
    end = time.monotonic() + 10.0
    while not control.stands():
        assert time.monotonic() < end
        time.sleep(0.01)
    assert control.state is State.STANDS
    assert control.alarm is None


def test_an_operator_who_has_taken_over_is_asked_nothing_by_a_pilot(manned):
    link, _, helm, device = manned
    looked(helm, device, Event.TAKE_OVER)
    looked(helm, device, Event.LAND, seconds=0.2)
    link.change(Mode.OTHER)
    asked = list(link.asked)
    looked(helm, device, seconds=3.0)
    assert link.asked == asked
