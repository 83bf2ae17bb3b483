"""A flight's stages, and every way in which it may end, on a vehicle without dynamics and without MAVLink."""

import threading
import time

import numpy as np
import pytest

from swarmsim.autopilot.flight import Flight, place_in_mission
from swarmsim.autopilot.flown import report
from swarmsim.autopilot.frames import Geodetic, geodetic_of_enu
from swarmsim.autopilot.link import LinkError, Mode, Telemetry
from swarmsim.config.autopilot import Autopilot, Origin, Watchdogs
from tests.autopilot.fake_link import FakeLink
from tests.autopilot.live_missions import UAVS, prepared

SURVEY = (
    "{name: survey, who: [uav1], policy: waypoints, "
    "settings: {points: [[-70, -42], [-66, -42]], speed_m_s: 4.0, altitude_m: 6.0}, time_limit_s: 60.0}"
)
QUICK = Autopilot(
    take_off_m=2.0, answer_s=1.0, ready_s=1.0, take_off_s=10.0, land_s=20.0,
    watchdogs=Watchdogs(heartbeat_s=5.0, position_s=4.0, stale_s=20.0, hold_s=0.1),  # a loaded machine pauses
)  # fmt: skip
LATE = (
    "{name: first, who: [uav2], policy: waypoints, "
    "settings: {points: [[-74, -47]], speed_m_s: 4.0, altitude_m: 3.0}, time_limit_s: 3.0}, "
    "{name: second, who: [uav1], policy: waypoints, start: {after: first}, "
    "settings: {points: [[-72, -42]], speed_m_s: 4.0, altitude_m: 4.0}, time_limit_s: 20.0}"
)


@pytest.fixture(scope="module")
def live():
    return prepared("uav1", UAVS, SURVEY)


@pytest.fixture(scope="module")
def late():
    return prepared("uav1", UAVS, LATE)


def flown(live, link, settings=QUICK, during=None):
    """The flight, and the error that ended it, if one did."""
    live.start()
    outline = np.array([[-100.0, -100.0], [100.0, -100.0], [100.0, 100.0], [-100.0, 100.0]])
    told: list[str] = []
    flight = Flight(link, live, settings, outline, link.flies, told.append)
    link.on_mode(flight.on_telemetry)
    if during is not None:
        threading.Thread(target=during, args=(flight, link), daemon=True).start()
    error = None
    try:
        flight.fly()
    except LinkError as found:
        error = found
    finally:
        link.close()
    return flight, error, told


def reached(flight, link, stage="mission", seconds=1.0):
    """Wait until the flight has been in a stage for a while."""
    deadline = time.monotonic() + 30.0
    while stage not in [what for _, what in flight.log.events]:
        assert time.monotonic() < deadline, (flight.log.ended, flight.log.events)
        time.sleep(0.01)
    time.sleep(seconds)


@pytest.mark.parametrize("streams_first", [True, False])
def test_a_vehicle_flies_its_part_and_lands(live, streams_first):
    link = FakeLink(streams_first=streams_first)
    flight, error, _ = flown(live, link)
    assert error is None
    expected = ["preflight", "follow", "arm"] + ([] if streams_first else ["take_off"])
    assert link.asked[: len(expected)] == expected
    assert link.asked[-1] == "land"
    assert not link.armed
    summary = report(flight.log, flight.control.stream.gaps_s(), link.identity, "uav1", None)
    assert summary["ended"] == "as planned"
    assert summary["cross_track"]["samples"] > 10
    assert summary["cross_track"]["rms_m"] < 0.5
    assert summary["stream"]["gap_max_s"] < QUICK.watchdogs.stale_s
    positions = np.array([s.position_m for _, s in link.sent if s.position_m is not None])
    assert np.ptp(positions[:, 0]) > 3.5


def test_setpoints_stop_at_once_when_the_operator_takes_over(live):
    link, when = FakeLink(), []

    def operator(flight, link):
        reached(flight, link)
        when.append(time.monotonic())
        link.change(Mode.OTHER)
        when.append(time.monotonic())

    flight, error, _ = flown(live, link, during=operator)
    assert error is None
    assert "operator" in flight.log.ended
    assert flight.control.takeover_s is not None
    assert link.sent[-1][0] <= when[1]
    assert link.asked[-1] == "arm"  # nothing was asked of it afterwards
    assert link.armed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "reason", "last"),
    [
        ({"battery": 0.1}, "battery", "land"),
        ({"estimate": False}, "estimate", "land"),
        ({"posed": False}, "no position", "land"),
        ({"heard": False}, "no heartbeat", "land"),
    ],
)
def test_what_the_watchdogs_see_ends_the_flight(live, fault, reason, last):
    link = FakeLink()

    def fail(flight, link):
        reached(flight, link)
        vars(link).update(fault)

    flight, error, _ = flown(live, link, during=fail)
    assert error is None
    assert reason in flight.log.ended
    assert link.asked[-1] == last


@pytest.mark.parametrize(("mode", "failsafe", "armed"), [(Mode.RETURN, True, None), (Mode.FOLLOW, False, False)])
def test_a_vehicle_that_acts_by_itself_is_left_alone(live, mode, failsafe, armed):
    link = FakeLink()

    def fail(flight, link):
        reached(flight, link)
        link.change(mode, failsafe=failsafe, armed=armed)

    flight, error, _ = flown(live, link, during=fail)
    assert error is None
    assert ("failsafe" if failsafe else "disarmed") in flight.log.ended
    assert link.asked[-1] == "arm"


@pytest.mark.parametrize("refused", ["preflight", "follow", "arm", "take_off"])
def test_a_refusal_ends_the_flight_on_the_ground(live, refused):
    link = FakeLink(streams_first=False)
    link.refuse = {refused}
    _, error, _ = flown(live, link)
    assert error is not None
    assert refused in str(error)
    assert not link.sent


def test_a_link_that_fails_in_flight_asks_for_landing(live):
    link = FakeLink()

    def fail(flight, link):
        reached(flight, link)
        link.refuse = {"send"}

    flight, error, _ = flown(live, link, during=fail)
    assert error is None
    assert "could not be sent" in flight.log.ended
    assert link.asked[-1] == "land"


def test_a_vehicle_under_way_is_not_taken(live):
    link = FakeLink()
    link.armed, link.place = True, np.array([0.0, 0.0, 5.0])
    _, error, _ = flown(live, link)
    assert error is not None
    assert "--recover" in str(error)
    assert link.asked == []


@pytest.mark.slow
def test_a_vehicle_whose_phase_begins_later_waits_on_the_ground(late):
    link, when = FakeLink(), {}
    flight, error, _ = flown(late, link, during=lambda flight, link: when.update(armed=link.armed))
    assert error is None
    assert flight.log.ended == ""
    events = [what for _, what in flight.log.events]
    assert events.index("plan second") < events.index("arm") < events.index("mission")
    farthest = max(s.position_m[0] for _, s in link.sent if s.position_m is not None)
    assert farthest > -72.75  # the point at -72 m, where it turns back, is passed half a metre before
    assert not link.armed


def test_a_takeover_in_the_climb_is_seen_at_once(live):
    link, when = FakeLink(), []
    settings = QUICK.model_copy(update={"take_off_m": 50.0})

    def operator(flight, link):
        reached(flight, link, "take off", 0.5)
        link.change(Mode.OTHER)
        when.append(time.monotonic())

    flight, error, _ = flown(live, link, settings, during=operator)
    assert error is None
    assert "operator" in flight.log.ended
    assert link.sent[-1][0] <= when[0]
    assert link.asked[-1] == "arm"


def test_that_the_others_go_on_after_a_takeover_is_told(live, monkeypatch):
    link = FakeLink()
    answers = iter([False, False])
    monkeypatch.setattr(live, "over_without_vehicle", lambda: next(answers, True))

    def operator(flight, link):
        reached(flight, link)
        link.change(Mode.OTHER)

    _, error, told = flown(live, link, during=operator)
    assert error is None
    for sentence in ("the operator took over", "the other vehicles go on"):
        assert any(sentence in line for line in told[-2:]), told


def test_a_takeover_while_it_holds_is_not_overruled(live):
    link = FakeLink()
    dogs = QUICK.watchdogs.model_copy(update={"hold_s": 3.0})

    def stall(flight, link):
        reached(flight, link, seconds=0.3)
        flight.control._on_stale(0.5)
        reached(flight, link, "hold", 0.5)
        link.change(Mode.OTHER)

    flight, error, _ = flown(live, link, QUICK.model_copy(update={"watchdogs": dogs}), during=stall)
    assert error is None
    assert link.asked[-1] == "hold"
    assert link.armed
    assert any("operator" in what for _, what in flight.log.events)


@pytest.mark.slow
def test_a_takeover_while_it_lands_ends_the_wait(live):
    link = FakeLink()
    link.sinks_m_s = 0.01

    def operator(flight, link):
        reached(flight, link, "land", 0.3)
        link.change(Mode.OTHER)

    flight, error, _ = flown(live, link, during=operator)
    assert error is None
    assert "operator" in flight.log.ended
    assert link.armed


def test_a_mode_that_changed_unnoticed_is_not_overruled(live):
    link = FakeLink()

    def operator(flight, link):
        reached(flight, link)
        link.mode = Mode.OTHER  # the callback never comes: telemetry alone shows it
        link.battery = 0.05

    _, error, _ = flown(live, link, during=operator)
    assert error is None
    assert link.asked[-1] == "arm"
    assert link.armed


def test_a_fault_of_our_own_brings_the_vehicle_down(live, monkeypatch):
    link = FakeLink()

    def broken(*_):
        raise ZeroDivisionError("a fault in a policy")

    def fail(flight, link):
        reached(flight, link)
        monkeypatch.setattr(flight.live, "step", broken)

    with pytest.raises(ZeroDivisionError):
        flown(live, link, during=fail)
    assert link.asked[-1] == "request land"


def test_a_refused_setpoint_ends_the_flight(live):
    settings = QUICK.model_copy(update={"limits": QUICK.limits.model_copy(update={"speed_m_s": 1.0})})
    link = FakeLink()
    flight, error, _ = flown(live, link, settings)
    assert error is None
    assert "limits.speed_m_s" in flight.log.ended
    assert link.asked[-1] == "land"
    assert not link.armed


HERE = Geodetic(47.397742, 8.545594, 488.0)


def stated(**changes):
    origin = Origin(latitude_deg=HERE.latitude_deg, longitude_deg=HERE.longitude_deg, altitude_m=HERE.altitude_m)
    return QUICK.model_copy(update={"origin": origin} | changes)


def test_a_stated_origin_says_where_the_vehicle_stands():
    start = (-74.0, -42.0, 1.0)
    there = geodetic_of_enu((-73.0, -43.0, 12.0), HERE)
    place = place_in_mission(Telemetry(place=there), start, stated())
    assert place == pytest.approx((-73.0, -43.0, 1.0), abs=1e-3)  # the height is that of its start
    assert place_in_mission(Telemetry(place=there), start, QUICK) == start
    with pytest.raises(LinkError, match=r"stands 1\.4 m from its start.*\+1\.0 m east and -1\.0 m north"):
        place_in_mission(Telemetry(place=there), start, stated(start_m=1.0))
    with pytest.raises(LinkError, match="no place on the Earth"):
        place_in_mission(Telemetry(), start, stated())


def test_stopping_twice_does_not_leave_the_vehicle_in_the_air(live, monkeypatch):
    link = FakeLink()

    def stop(*_):
        raise KeyboardInterrupt

    def user(flight, link):
        reached(flight, link)
        monkeypatch.setattr(link, "enter", stop)  # while it is asked to land
        monkeypatch.setattr(flight.live, "step", stop)

    with pytest.raises(KeyboardInterrupt):
        flown(live, link, during=user)
    assert link.asked[-1] == "request land"
    assert link.mode is Mode.LAND


def test_what_no_autopilot_takes_is_refused_on_the_ground(live, monkeypatch):
    def refused(command):
        raise LinkError("the policy commands attitudes")

    monkeypatch.setattr("swarmsim.autopilot.flight.setpoint_of", refused)
    link = FakeLink()
    _, error, _ = flown(live, link)
    assert "attitudes" in str(error)
    assert "arm" not in link.asked
    assert not link.sent


def test_a_phase_that_is_over_before_the_take_off_is_not_flown(live, monkeypatch):
    link, phases = FakeLink(), iter([0])
    monkeypatch.setattr(live, "phase", lambda: next(phases, None))  # there when it begins, and done at once
    monkeypatch.setattr(live, "over_without_vehicle", lambda: True)
    _, error, _ = flown(live, link)
    assert error is None
    assert link.asked == ["preflight"]
