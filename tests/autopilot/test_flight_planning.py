"""What happens to a vehicle while the mission plans its next phase, which may take minutes."""

import threading
import time

import pytest

from swarmsim.autopilot.link import Mode
from tests.autopilot.fake_link import FakeLink
from tests.autopilot.live_missions import UAVS, prepared
from tests.autopilot.test_flight import QUICK, flown, reached

TWICE = (
    "{name: first, who: [uav1], policy: waypoints, "
    "settings: {points: [[-60, -42]], speed_m_s: 4.0, altitude_m: 4.0}, time_limit_s: 3.0}, "
    "{name: second, who: [uav1], policy: waypoints, start: {after: first}, "
    "settings: {points: [[-64, -46]], speed_m_s: 4.0, altitude_m: 4.0}, time_limit_s: 20.0}"
)
PLANS = "plan second"


class Planning:
    """Planning of the second phase that lasts as long as a test needs it to."""

    def __init__(self, live):
        self._begin, self._calls, self.error = live.begin_phases, 0, None
        self.may_end, self.ended_s = threading.Event(), None

    def __call__(self):
        self._calls += 1
        if self._calls == 2:
            assert self.may_end.wait(30.0)
        if self._calls == 2 and self.error is not None:
            raise self.error
        begun = self._begin()
        self.ended_s = time.monotonic()
        return begun


@pytest.fixture(scope="module")
def twice():
    return prepared("uav1", UAVS, TWICE)


@pytest.fixture
def planning(twice, monkeypatch):
    planning = Planning(twice)
    monkeypatch.setattr(twice, "begin_phases", planning)
    return planning


def eventually(condition, seconds=5.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.slow
def test_a_vehicle_holds_while_its_next_phase_is_planned_and_flies_it_then(twice, planning):
    link, seen = FakeLink(), {}

    def user(flight, link):
        reached(flight, link, PLANS, 1.5)
        seen.update(mode=link.mode, before=len(link.sent), place=link.place.copy())
        time.sleep(0.5)
        seen.update(drift=float(abs(link.place - seen["place"]).max()), after=len(link.sent))
        planning.may_end.set()

    flight, error, _ = flown(twice, link, during=user)
    assert error is None
    assert flight.log.ended == ""
    assert seen["mode"] is Mode.FOLLOW
    assert seen["after"] > seen["before"]  # the stream goes on
    assert seen["drift"] < 0.05
    second = [what for _, what in flight.log.events].index(PLANS)
    assert "mission" not in [what for _, what in flight.log.events][second:]  # it goes on from where it holds
    assert min(s.position_m[1] for _, s in link.sent if s.position_m is not None) < -44.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "reason"),
    [({"battery": 0.1}, "battery"), ({"estimate": False}, "estimate"), ({"heard": False}, "no heartbeat")],
)
def test_what_the_watchdogs_see_while_it_plans_is_acted_on_at_once(twice, planning, fault, reason):
    link, landed = FakeLink(), []

    def fail(flight, link):
        reached(flight, link, PLANS, 0.2)
        vars(link).update(fault)
        eventually(lambda: "land" in link.asked, 5.0 + QUICK.watchdogs.heartbeat_s)
        landed.append(planning.ended_s)
        planning.may_end.set()

    flight, error, _ = flown(twice, link, during=fail)
    assert error is None
    assert reason in flight.log.ended
    assert len(landed) == 1
    assert landed[0] < planning.ended_s  # that of the first phase: the second was being planned
    assert link.asked.count("land") == 1


@pytest.mark.slow
def test_a_hold_ends_while_it_still_plans(twice, planning):
    link = FakeLink()
    dogs = QUICK.watchdogs.model_copy(update={"planning_s": 1.0})
    settings = QUICK.model_copy(update={"watchdogs": dogs})

    def user(flight, link):
        reached(flight, link, PLANS, 0.0)
        eventually(lambda: "land" in link.asked)
        planning.may_end.set()

    flight, error, _ = flown(twice, link, settings, during=user)
    assert error is None
    assert "land" in link.asked
    assert flight.log.ended != ""
    assert not link.armed


def test_a_takeover_while_it_plans_is_left_alone(twice, planning):
    link = FakeLink()

    def operator(flight, link):
        reached(flight, link, PLANS, 0.2)
        link.change(Mode.OTHER)
        time.sleep(0.3)
        planning.may_end.set()

    flight, error, _ = flown(twice, link, during=operator)
    assert error is None
    assert "operator" in flight.log.ended
    assert link.asked[-1] == "arm"
    assert link.armed


def test_stopped_by_the_user_while_it_plans_it_lands_at_once(twice, planning, monkeypatch):
    link, landed = FakeLink(), []

    def user(flight, link):
        reached(flight, link, PLANS, 0.2)
        watch = flight.control.watch

        def stop(renew=True):
            monkeypatch.setattr(flight.control, "watch", watch)
            raise KeyboardInterrupt

        monkeypatch.setattr(flight.control, "watch", stop)
        eventually(lambda: "land" in link.asked)
        landed.append(planning.ended_s)
        time.sleep(0.5)
        planning.may_end.set()

    with pytest.raises(KeyboardInterrupt):
        flown(twice, link, during=user)
    assert link.asked[-1] == "land"
    assert not link.armed
    assert landed[0] < planning.ended_s  # fly ended after the planner, whose buffers are whole again


def test_an_error_of_the_planner_brings_the_vehicle_down(twice, planning):
    link = FakeLink()
    planning.error = ValueError("the phase cannot begin")
    planning.may_end.set()
    with pytest.raises(ValueError, match="cannot begin"):
        flown(twice, link)
    assert link.asked[-1] == "request land"
