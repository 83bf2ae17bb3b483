"""Flown by hand within a mission, over the simulated link: taken over, handed back, landed; UAV and rover."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from swarmsim.autopilot.flight import Flight
from swarmsim.autopilot.link import LinkError, Mode
from swarmsim.autopilot.manual.sticks import CENTRED, Event, Reading, Sticks
from swarmsim.autopilot.simulated import SimulatedLink, load_manners
from swarmsim.autopilot.standin.kinematic import KinematicBody
from swarmsim.config.autopilot import Autopilot, Watchdogs
from tests.autopilot.live_missions import ROVER, UAVS, prepared

SURVEY = (
    "{name: survey, who: [uav1], policy: waypoints, "
    "settings: {points: [[-70, -42], [-66, -42]], speed_m_s: 4.0, altitude_m: 6.0}, time_limit_s: 20.0}"
)
DRIVE = (
    "{name: drive, who: [orpheus], policy: waypoints, "
    "settings: {points: [[-76, -50]], speed_m_s: 0.9}, time_limit_s: 60.0}"
)
QUICK = Autopilot(
    take_off_m=2.0, answer_s=1.0, ready_s=1.0, take_off_s=20.0, land_s=30.0,
    watchdogs=Watchdogs(stale_s=1.5),  # a loaded machine pauses
)  # fmt: skip
MANNERS = load_manners().model_copy(update={"land_speed_m_s": 2.0, "land_speed_high_m_s": 2.0})
OUTLINE = np.array([[-100.0, -100.0], [100.0, -100.0], [100.0, 100.0], [-100.0, 100.0]])


class Script:
    """A pilot who does what a test says."""

    def __init__(self):
        self.sticks, self.lost, self._events = CENTRED, None, []

    def ask(self, event):
        self._events.append(event)

    def read(self, now_s):
        events, self._events = self._events, []
        return Reading(self.sticks if self.lost is None else CENTRED, tuple(events), self.lost)

    def told(self, flies):
        return "keys"


@pytest.fixture(scope="module")
def uav():
    return prepared("uav1", UAVS, SURVEY)


@pytest.fixture(scope="module")
def rover():
    return prepared("orpheus", ROVER, DRIVE)


def flown(live, script, flies=True, settings=QUICK):
    """A flight in which ``script(flight, pilot, link)`` runs beside it; the flight, and what was told."""
    live.start()
    pilot, told, errors = Script(), [], []
    link = SimulatedLink(KinematicBody(flies=flies), MANNERS)
    flight = Flight(link, live, settings, OUTLINE, flies, told.append, pilot=pilot)
    link.on_mode(flight.on_telemetry)

    def run():
        try:
            script(flight, pilot, link)
        except Exception as error:
            errors.append(error)
            link.request(Mode.LAND)  # the flight ends: somebody else seems to fly

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        flight.fly()
    finally:
        link.close()
        thread.join(10.0)
    if errors:
        raise errors[0]
    return flight, told


def until(condition, seconds=40.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def begun(flight):
    until(lambda: any(what == "mission" for _, what in flight.log.events))
    time.sleep(0.3)


def moved(link, pilot, sticks, seconds):
    before = np.array(link.telemetry().position_m)
    pilot.sticks = sticks
    time.sleep(seconds)
    pilot.sticks = CENTRED
    return np.array(link.telemetry().position_m) - before


@pytest.mark.slow
def test_taken_over_and_handed_back_the_mission_goes_on(uav):
    seen = {}

    def script(flight, pilot, link):
        begun(flight)
        until(lambda: flight.log.rows)  # a loaded machine pauses
        pilot.ask(Event.TAKE_OVER)
        until(lambda: flight.helm.flies)
        until(lambda: flight.helm._pilot.holds)
        assert "YOU fly" in flight.helm.line()
        heading = np.array([1.0, 0.0])
        seen["left"] = moved(link, pilot, Sticks(left=1.0), 2.0)[:2] @ np.array([-heading[1], heading[0]])
        seen["up"] = moved(link, pilot, Sticks(up=1.0), 1.5)[2]
        until(lambda: flight.helm._pilot.holds)
        seen["time"] = flight.live.time_s
        time.sleep(0.5)
        assert flight.live.time_s > seen["time"]  # the team goes on
        seen["place"] = np.array(link.telemetry().position_m)
        pilot.ask(Event.TAKE_OVER)
        until(lambda: not flight.helm.flies)
        assert "policy" in flight.helm.line()

    flight, told = flown(uav, script)
    assert flight.log.ended == ""
    assert flight.control.alarm is None
    assert seen["left"] > 2.0
    assert seen["up"] > 0.7
    assert [text for text in told if "pilot" in text] == ["the pilot takes over", "the pilot hands it back"]
    assert told[-1] == "landed"
    rows, by_hand = np.array(flight.log.rows), np.array(flight.log.by_hand)
    assert by_hand.any()
    assert not by_hand[0]
    assert not by_hand[-1]
    assert rows[:, 8].max() > -66.5  # the end of its path was reached
    assert flight.log.cross_track_m().max() < 1.0
    # over half a second, since telemetry comes in bursts
    late = np.searchsorted(rows[:, 1], rows[:, 1] + 0.5)
    first = np.flatnonzero(by_hand & (late < len(rows)))
    seconds = rows[late[first], 1] - rows[first, 1]
    speed = np.linalg.norm(rows[late[first], 8:11] - rows[first, 8:11], axis=1) / seconds
    assert np.nanmax(speed) < 6.0  # not at once back to its line


def test_flown_by_hand_from_the_ground_up_and_landed(uav):
    def script(flight, pilot, link):
        pilot.ask(Event.TAKE_OVER)  # before it is armed
        begun(flight)
        assert flight.helm.flies
        moved(link, pilot, Sticks(forward=1.0), 2.0)
        pilot.ask(Event.LAND)

    flight, told = flown(uav, script)
    assert "the pilot will fly as soon as it follows" in told
    assert all(flight.log.by_hand)
    assert flight.log.ended == "land: the pilot asked for it"
    assert flight.control.alarm is None
    assert told[-2:] == ["land", "landed"]
    assert np.array(flight.log.rows)[-1, 8] > -73.0


@pytest.mark.slow
def test_a_rover_is_driven_and_goes_on(rover):
    seen = {}

    def script(flight, pilot, link):
        begun(flight)
        pilot.ask(Event.TAKE_OVER)
        until(lambda: flight.helm.flies)
        before = np.array(link.telemetry().position_m)
        moved(link, pilot, Sticks(forward=1.0, left=1.0), 2.0)
        c, s = np.array(link.telemetry().quaternion)[[0, 3]]
        seen["yaw"] = 2.0 * np.arctan2(s, c)
        seen["way"] = np.linalg.norm(np.array(link.telemetry().position_m) - before)
        pilot.ask(Event.TAKE_OVER)

    flight, told = flown(rover, script, flies=False)
    assert flight.log.ended == ""
    assert 0.3 < seen["way"] < 2.5 * rover.speed_max_m_s
    assert told[-1] == "disarmed"
    assert seen["yaw"] > 0.5
    assert any(flight.log.by_hand)
    assert np.array(flight.log.rows)[-1, 8] < -75.5


def test_a_lost_device_holds_and_the_operator_still_takes_over(uav):
    seen = {}

    def script(flight, pilot, link):
        begun(flight)
        pilot.ask(Event.TAKE_OVER)
        until(lambda: flight.helm.flies)
        pilot.sticks = Sticks(forward=1.0)
        time.sleep(1.0)
        pilot.lost = "the gamepad has gone"
        until(lambda: flight.helm._pilot.holds)
        assert "gone" in flight.helm.line()
        pilot.lost, pilot.sticks = None, CENTRED
        time.sleep(0.2)
        link.request(Mode.HOLD)  # the operator
        seen["sent"] = link.telemetry().position_m
        until(lambda: flight.control.stream.halted)
        pilot.ask(Event.TAKE_OVER)
        pilot.sticks = Sticks(up=1.0)

    flight, told = flown(uav, script)
    assert flight.control.takeover_s is not None
    assert "operator" in flight.log.ended
    assert any("gone: sticks are centred" in text for text in told)
    assert "the pilot is heard again" in told
    assert "somebody else" in flight.helm.line()


@pytest.mark.slow
def test_a_pilot_who_flies_past_the_end_of_the_mission_flies_on(uav):
    settings = QUICK.model_copy(update={"at_end": "land"})

    def script(flight, pilot, link):
        begun(flight)
        until(lambda: np.array(link.telemetry().position_m)[0] > -66.5)
        pilot.ask(Event.HOLD)
        until(lambda: flight.helm.flies)
        until(lambda: flight.live.time_s > 21.5, 90.0)  # its time limit has passed
        time.sleep(1.0)
        assert link.telemetry().mode is Mode.FOLLOW
        pilot.ask(Event.TAKE_OVER)

    flight, told = flown(uav, script, settings=settings)
    assert flight.log.ended == ""
    assert told[-1] == "landed"


def test_a_device_that_fails_ends_the_vehicles_part(uav):
    def script(flight, pilot, link):
        begun(flight)
        pilot.ask(Event.TAKE_OVER)
        until(lambda: flight.helm.flies)
        pilot.told = None
        pilot.read = None

    flight, told = flown(uav, script)
    assert "flying by hand has failed" in flight.log.ended
    assert "land" in told


def test_a_link_that_breaks_while_a_pilot_flies_is_told(uav):
    def script(flight, pilot, link):
        begun(flight)
        pilot.ask(Event.TAKE_OVER)
        until(lambda: flight.helm.flies)
        link._error = LinkError("it is a test")

    with pytest.raises(LinkError, match="has failed"):
        flown(uav, script)


@pytest.mark.parametrize("within_a_period", [False, True])
def test_handed_back_between_phases_it_holds_again(uav, monkeypatch, within_a_period):
    goes_on, stands = threading.Event(), threading.Event()
    goes_on.set()

    def waiting(*a):
        stands.set()
        goes_on.wait(10.0)
        return replace(step(*a), in_phase=False, begins=(), over=False)

    def script(flight, pilot, link):
        monkeypatch.setattr(uav, "step", waiting)
        monkeypatch.setattr(uav, "has_phase_to_come", lambda: True)
        begun(flight)
        until(lambda: flight._waits)
        if within_a_period:  # the mission sees nothing of the pilot's flight but its end
            goes_on.clear()
            stands.clear()
            until(stands.is_set)
        flight.helm.setpoint = None
        pilot.ask(Event.TAKE_OVER)
        until(lambda: flight.helm.setpoint is not None)
        pilot.ask(Event.TAKE_OVER)
        until(lambda: flight.helm.handed_back() is not None or not flight.helm.flies)
        goes_on.set()
        until(lambda: not flight.helm.flies)
        time.sleep(3.0 * QUICK.watchdogs.stale_s)
        assert flight.control.alarm is None
        monkeypatch.setattr(uav, "has_phase_to_come", lambda: False)

    step = uav.step
    flight, _ = flown(uav, script)
    assert flight.log.ended == ""
