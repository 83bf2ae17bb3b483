"""Control of a vehicle when something goes wrong at the worst moment, without a mission and without dynamics."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from swarmsim.autopilot.control import Control, State
from swarmsim.autopilot.guard import Guard
from swarmsim.autopilot.link import LinkError, Mode, Setpoint, Telemetry
from swarmsim.autopilot.under_way import recover
from swarmsim.autopilot.watch import Action, Alarm, Watch
from swarmsim.config.autopilot import Autopilot, SetpointLimits, Watchdogs
from tests.autopilot.fake_link import FakeLink

QUICK = Autopilot(
    take_off_m=2.0, answer_s=1.0, take_off_s=10.0, land_s=20.0, watchdogs=Watchdogs(stale_s=0.5, hold_s=0.1)
)
OUTLINE_M = np.array([[-100.0, -100.0], [100.0, -100.0], [100.0, 100.0], [-100.0, 100.0]])
ABOVE_M = (0.0, 0.0, 2.0)


@pytest.fixture
def link():
    made = FakeLink(streams_first=False)
    yield made
    made.close()


def controlled(link, settings=QUICK, stage=lambda _: None):
    guard = Guard(limits=settings.limits, outline_m=OUTLINE_M, ground_m=0.0, flies=True)
    control = Control(link, settings, guard, link.flies, stage)
    link.on_mode(control.on_telemetry)
    control.stream.start()
    return control


def test_a_vehicle_that_somebody_else_has_armed_is_left_to_him(link):
    control = controlled(link)
    link.armed, link.mode, link.place = True, Mode.OTHER, np.array([0.0, 0.0, 20.0])
    assert not control.start((0.0, 0.0, 22.0), 0.0)
    assert link.asked == []
    assert control.state is State.RELEASED
    assert control.alarm.takeover


def test_an_operator_who_takes_over_as_it_arms_is_not_overruled(link, monkeypatch):
    control = controlled(link)
    monkeypatch.setattr(link, "arm", lambda timeout_s: link.change(Mode.OTHER, armed=True))
    assert not control.start(ABOVE_M, 0.0)
    assert "take_off" not in link.asked
    assert control.state is State.RELEASED


def take_off_alone(link, monkeypatch):
    """The motors of an AR.Drone start with take-off: it has no arming."""
    climbs = FakeLink.take_off

    def take_off(height_m, timeout_s):
        link.change(Mode.FOLLOW, armed=True)
        climbs(link, height_m, timeout_s)

    link.arms = False
    monkeypatch.setattr(link, "arm", lambda timeout_s: None)
    monkeypatch.setattr(link, "take_off", take_off)


def test_a_vehicle_without_arming_is_not_taken_for_disarmed_before_it_takes_off(link, monkeypatch):
    take_off_alone(link, monkeypatch)
    control = controlled(link)
    assert control.start(ABOVE_M, 0.0)
    assert control.state is State.FOLLOWS
    link.change(Mode.FOLLOW, armed=False)
    assert "disarmed" in control.alarm.reason


def test_a_vehicle_without_arming_that_an_operator_takes_does_not_take_off(link, monkeypatch):
    take_off_alone(link, monkeypatch)
    monkeypatch.setattr(link, "arm", lambda timeout_s: link.change(Mode.OTHER))
    control = controlled(link)
    assert not control.start(ABOVE_M, 0.0)
    assert "take_off" not in link.asked
    assert control.state is State.RELEASED


@pytest.mark.parametrize(
    ("east_m", "ceiling_m", "reason"), [(150.0, 120.0, "outline"), (0.0, 1.0, "height")], ids=["outside", "too high"]
)
def test_what_may_not_be_sent_in_the_air_keeps_it_on_the_ground(link, east_m, ceiling_m, reason):
    control = controlled(link, QUICK.model_copy(update={"limits": SetpointLimits(ceiling_m=ceiling_m)}))
    assert not control.start((east_m, 0.0, 2.0), 0.0)
    assert link.asked == []
    assert control.state is State.STANDS
    assert reason in control.alarm.reason


def test_a_vehicle_with_an_alarm_does_not_take_off_again(link):
    control = controlled(link)
    control.failed("something broke while it landed")
    assert not control.start(ABOVE_M, 0.0)
    assert link.asked == []
    assert not link.armed


def test_a_landing_that_is_not_heard_of_is_asked_for_again(link, monkeypatch):
    control = controlled(link)
    assert control.start(ABOVE_M, 0.0)
    told = FakeLink.request
    lost = iter([True, False])
    monkeypatch.setattr(link, "request", lambda mode: None if next(lost) else told(link, mode))
    control.emergency()
    assert link.mode is Mode.LAND


def test_what_an_emergency_brought_about_is_told(link):
    told = []
    control = controlled(link, stage=told.append)
    assert control.start(ABOVE_M, 0.0)
    control.emergency()
    assert told[-1].startswith("it is in mode LAND")


def test_an_operator_who_takes_over_in_an_emergency_is_not_overruled(link, monkeypatch):
    control = controlled(link)
    assert control.start(ABOVE_M, 0.0)
    asked = []
    monkeypatch.setattr(link, "request", lambda mode: (asked.append(mode), link.change(Mode.OTHER)))
    control.emergency()
    assert asked == [Mode.LAND]
    assert link.mode is Mode.OTHER


def test_a_vehicle_that_is_silent_is_asked_once_and_given_up(link, monkeypatch):
    control = controlled(link, QUICK.model_copy(update={"land_s": 1.5}))
    assert control.start(ABOVE_M, 0.0)
    link.heard = False
    asked = []
    monkeypatch.setattr(link, "request", asked.append)
    control.emergency()
    assert asked == [Mode.LAND]


def test_a_landing_that_was_asked_of_a_silent_vehicle_is_not_asked_for_again_before_it_is_heard(link, monkeypatch):
    """An operator may have taken over meanwhile."""
    control = controlled(link, QUICK.model_copy(update={"land_s": 1.5}))
    assert control.start(ABOVE_M, 0.0)
    link.heard = False

    def enter(mode, timeout_s):
        link.asked.append(f"blind {mode.value}")
        time.sleep(0.2)
        raise LinkError("nothing is heard of it")

    monkeypatch.setattr(link, "enter", enter)
    control.alarm = Alarm(Action.END, "the link is lost")
    with pytest.raises(LinkError):
        control.watch()
    threading.Timer(0.5, lambda: vars(link).update(mode=Mode.OTHER, heard=True)).start()
    control.emergency()
    assert link.asked[-1] == "blind land"
    assert link.mode is Mode.OTHER


@pytest.mark.parametrize("stops", [LinkError("it was refused"), KeyboardInterrupt()], ids=["refused", "stopped"])
def test_a_vehicle_that_was_to_hold_for_a_while_is_not_left_in_the_air(link, monkeypatch, stops):
    control = controlled(link)
    assert control.start(ABOVE_M, 0.0)

    def enter(mode, timeout_s):
        if mode is Mode.LAND:
            raise stops
        link.change(mode)

    monkeypatch.setattr(link, "enter", enter)
    control.alarm = Alarm(Action.HOLD, "this computer is too slow")
    with pytest.raises(type(stops)):
        control.watch()
    assert link.mode is Mode.HOLD
    monkeypatch.undo()
    if isinstance(stops, KeyboardInterrupt):
        control.stop()
    else:
        control.emergency()
    assert link.mode is Mode.LAND


def test_a_vehicle_holds_though_the_thread_of_the_flight_is_stuck(link):
    control = controlled(link)
    assert control.start(ABOVE_M, 0.0)
    control.offer(Setpoint(position_m=(0.5, 0.0, 2.0)))
    deadline = time.monotonic() + 10.0
    while link.mode is not Mode.HOLD:  # nobody calls `watch` meanwhile
        assert time.monotonic() < deadline
        time.sleep(0.01)
    sent = len(link.sent)
    control.offer(Setpoint(position_m=(1.0, 0.0, 2.0)))
    time.sleep(0.2)
    assert len(link.sent) == sent
    assert "too slow" in control.alarm.reason
    control.stop()
    assert link.mode is Mode.LAND


def test_a_vehicle_whose_origin_is_another_is_not_flown_on():
    now = time.monotonic()
    t = Telemetry(heard_s=now, pose_s=now, position_m=(0.0, 0.0, 2.0), armed=True, mode=Mode.FOLLOW)
    watch = Watch(Watchdogs())
    assert watch.check(t, now) is None
    assert watch.check(replace(t, position_m=None), now).action is Action.END


@pytest.mark.parametrize(
    ("place_m", "reason"), [((120.0, 0.0, 2.0), "20.0 m outside"), ((0.0, 0.0, 150.0), "150.0 m above")]
)
def test_a_vehicle_that_leaves_the_volume_is_brought_down(link, place_m, reason):
    dogs = QUICK.watchdogs.model_copy(update={"jump_m": 1000.0})
    control = controlled(link, QUICK.model_copy(update={"watchdogs": dogs}))
    assert control.start(ABOVE_M, 0.0)
    assert control.watch()
    link.place = np.array(place_m)  # as a wind, or velocities without a position, may take it
    assert not control.watch()
    assert reason in control.alarm.reason
    assert link.asked[-1] == "land"


def test_a_vehicle_lands_though_the_thread_of_the_flight_stays_stuck(link):
    control = controlled(link)
    assert control.start(ABOVE_M, 0.0)
    control.offer(Setpoint(position_m=(0.5, 0.0, 2.0)))
    deadline = time.monotonic() + 10.0
    while link.armed:  # nobody calls `watch` meanwhile
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert [what for what in link.asked if what.startswith("request")] == ["request hold", "request land"]
    assert not control.watch()  # it wakes up, and takes its own landing for nobody else's
    deadline = time.monotonic() + 10.0
    while not control.stands():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert control.state is State.STANDS
    assert not control.alarm.takeover


def test_one_that_wakes_up_in_time_acts_itself(link):
    control = controlled(link, QUICK.model_copy(update={"watchdogs": Watchdogs(stale_s=0.2, hold_s=1.0)}))
    assert control.start(ABOVE_M, 0.0)
    control.offer(Setpoint(position_m=(0.5, 0.0, 2.0)))
    while link.mode is not Mode.HOLD:
        time.sleep(0.01)
    control.watch()
    assert "request land" not in link.asked
    assert link.asked[-2:] == ["hold", "land"]


def test_a_hold_while_the_mission_plans_lasts_no_longer_than_it_may(link):
    settings = QUICK.model_copy(update={"watchdogs": Watchdogs(stale_s=0.3, hold_s=60.0, planning_s=1.0)})
    control = controlled(link, settings)
    assert control.start(ABOVE_M, 0.0)
    control.hold()
    begin = time.monotonic()
    while time.monotonic() - begin < 1.5:  # waited for by somebody who looks after it
        assert control.watch()
        time.sleep(0.05)
    while link.mode is not Mode.HOLD:  # and now nobody does
        assert time.monotonic() - begin < 15.0
        time.sleep(0.01)
    assert time.monotonic() - begin > 2.4
    assert "no setpoint for 1.0 s" in control.alarm.reason


def test_a_vehicle_that_arms_after_it_was_given_up_is_disarmed(link, monkeypatch):
    control = controlled(link)

    def late(timeout_s):
        threading.Timer(0.3, lambda: link.change(link.mode, armed=True)).start()
        raise LinkError("it was not armed within 0.1 s")

    def disarm(timeout_s):
        time.sleep(0.6)  # commands are done in their order
        link.asked.append("disarm")
        link.change(link.mode, armed=False)

    monkeypatch.setattr(link, "arm", late)
    monkeypatch.setattr(link, "disarm", disarm)
    with pytest.raises(LinkError):
        control.start(ABOVE_M, 0.0)
    control.emergency()
    assert link.asked[-1] == "disarm"
    assert not link.armed


@pytest.mark.parametrize(
    ("moved_m", "speed_m_s", "jumped"), [(2.5, 0.0, False), (6.0, 0.0, True), (6.0, 8.0, False), (6.0, 2.0, True)]
)
def test_a_state_estimate_that_was_reset_is_seen(moved_m, speed_m_s, jumped):
    now, watch = time.monotonic(), Watch(Watchdogs())
    t = Telemetry(
        heard_s=now, pose_s=now, position_m=(0.0, 0.0, 5.0), velocity_m_s=(speed_m_s, 0.0, 0.0), armed=True,
        mode=Mode.FOLLOW,
    )  # fmt: skip
    assert watch.check(t, now) is None
    alarm = watch.check(replace(t, pose_s=now + 0.2, position_m=(0.0, moved_m, 5.0)), now + 0.2)
    assert (alarm is not None) == jumped
    if jumped:
        assert alarm.action is Action.END
        assert "jumped by 6.0 m" in alarm.reason


def test_what_is_recovered_is_left_to_an_operator_who_takes_it_over(link):
    link.armed, link.mode, link.place = True, Mode.HOLD, np.array([0.0, 0.0, 20.0])
    threading.Timer(0.3, lambda: link.change(Mode.OTHER)).start()
    with pytest.raises(LinkError, match="operator took over"):
        recover(link, "land", QUICK, lambda _: None)
    assert link.asked == ["land"]
