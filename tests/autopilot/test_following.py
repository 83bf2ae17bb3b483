"""A vehicle that its setpoints do not reach any more, though all its telemetry goes on."""

import math
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.autopilot.control import Control, State
from swarmsim.autopilot.guard import Guard
from swarmsim.autopilot.link import LinkError, Mode, Setpoint, Telemetry
from swarmsim.autopilot.watch import Action, Following
from swarmsim.config.autopilot import Autopilot, SetpointLimits, Watchdogs
from tests.autopilot.fake_link import FakeLink

DOGS = Watchdogs()
STILL = (0.0, 0.0, 0.0)
OUTLINE_M = np.array([[-100.0, -100.0], [100.0, -100.0], [100.0, 100.0], [-100.0, 100.0]])
PERIOD_S = 0.1


def at(place):
    return Telemetry(position_m=tuple(float(x) for x in place), armed=True, mode=Mode.FOLLOW)


def to(place):
    return Setpoint(position_m=tuple(float(x) for x in place), velocity_m_s=STILL)


def seen(history):
    """The first alarm, and when it came; ``history`` has the vehicle and its setpoint a period apart."""
    watch = Following(DOGS)
    for k, (t, setpoint) in enumerate(history):
        alarm = watch.check(t, setpoint, PERIOD_S * k)
        if alarm is not None:
            return alarm, PERIOD_S * k
    return None, math.inf


def followed(path, gain_1_s, lag_s=0.0, gust_m=None):
    """A vehicle that flies after a reference as a policy's, which waits for it from 1 to 2 m on."""
    speed, place, along, told = 4.0, np.array(path[0], float), 0.0, []
    arcs = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    rows = []
    while along < arcs[-1] and len(rows) < 3000:
        reference = np.array([np.interp(along, arcs, column) for column in np.transpose(path)])
        told.append(reference)
        late = told[max(0, len(told) - 1 - round(lag_s / PERIOD_S))]
        pace = min(1.0, max(0.0, 2.0 - float(np.linalg.norm(reference - place))))
        along += PERIOD_S * pace * speed
        place = place + PERIOD_S * gain_1_s * (late - place)
        blown = np.zeros(3) if gust_m is None else gust_m(len(rows))
        rows.append((at(place + blown), to(reference)))
    return rows


def test_a_vehicle_that_brakes_two_metres_behind_its_reference_is_seen():
    rows = followed(np.array([[0.0, 0.0, 5.0], [200.0, 0.0, 5.0]]), 1.0)
    assert seen(rows)[0] is None
    stands = rows[100][0]
    ahead = to(np.add(stands.position_m, (1.99, 0.0, 0.0)))  # the reference waits: it never gets farther
    alarm, when = seen(rows[:100] + 200 * [(stands, ahead)])
    assert alarm.action is Action.HOLD
    assert not alarm.takeover
    assert "does not follow" in alarm.reason
    assert when - 100 * PERIOD_S == pytest.approx(DOGS.stuck_s, abs=0.6)


def test_a_vehicle_that_drifts_away_is_seen():
    rows = [(at((0.2 * k, 0.0, 5.0)), to((0.0, 0.0, 5.0))) for k in range(200)]
    alarm, when = seen(rows)
    assert alarm.action is Action.HOLD
    assert when == pytest.approx(DOGS.away_m / 2.0 + DOGS.away_s, abs=0.3)


@pytest.mark.parametrize("gain_1_s", [0.4, 1.0, 2.0])
@pytest.mark.parametrize("lag_s", [0.0, 0.4])
def test_lags_corners_and_gusts_are_none(gain_1_s, lag_s):
    rng = np.random.default_rng(0)
    gusts = np.convolve(rng.normal(size=4000), np.ones(20) / 20.0, "same")
    path = np.array([[0.0, 0, 5], [40, 0, 5], [40, 40, 5], [0, 40, 9], [0, 0, 9]])
    rows = followed(path, gain_1_s, lag_s, lambda k: np.array([4.0 * gusts[k], 0.0, 0.0]))
    assert seen(rows)[0] is None


def test_a_hover_in_gusts_is_none():
    rng = np.random.default_rng(1)
    gusts = np.convolve(rng.normal(size=6000), np.ones(30) / 30.0, "same")
    assert np.abs(8.0 * gusts).max() > 2.5
    assert seen([(at((8.0 * g, 0.0, 5.0)), to((0.0, 0.0, 5.0))) for g in gusts])[0] is None


@given(st.floats(0.3, 8.0), st.floats(0.0, 9.9))
def test_one_that_moves_behind_its_reference_is_none(speed, behind):
    moves = [(at((speed * PERIOD_S * k, 0, 5)), to((speed * PERIOD_S * k + behind, 0, 5))) for k in range(300)]
    assert seen(moves)[0] is None


def test_velocities_alone_are_not_judged():
    drive = Setpoint(velocity_m_s=(1.0, 0.0, 0.0), body=True)
    assert seen(600 * [(at((0.0, 0.0, 0.0)), drive)])[0] is None
    assert seen(600 * [(Telemetry(), to((9.0, 0.0, 0.0)))])[0] is None


def test_what_was_not_looked_at_does_not_count():
    watch, t, far = Following(DOGS), at(STILL), to((50.0, 0.0, 0.0))
    assert watch.check(t, far, 0.0) is None
    assert watch.check(t, far, 60.0) is None  # the process was stopped, or the mission planned
    assert watch.check(t, None, 60.5) is None
    assert watch.check(t, far, 61.0) is None
    assert all(watch.check(t, far, 61.0 + 0.5 * k) is None for k in range(11))
    assert watch.check(t, far, 66.6) is not None


QUICK = Autopilot(
    take_off_m=2.0, answer_s=1.0, take_off_s=10.0, land_s=20.0,
    watchdogs=Watchdogs(stale_s=5.0, hold_s=0.1, stuck_s=1.0), limits=SetpointLimits(jump_m=5.0),
)  # fmt: skip


class OneWay(FakeLink):
    """Once its uplink is lost, setpoints do not reach it: it brakes, and says that it follows."""

    uplink = True

    def send(self, setpoint):
        if self.uplink:
            super().send(setpoint)
        else:
            self._goal = None


@pytest.fixture
def link():
    made = OneWay(streams_first=False)
    yield made
    made.close()


def following(link):
    guard = Guard(limits=QUICK.limits, outline_m=OUTLINE_M, ground_m=0.0, flies=True)
    control = Control(link, QUICK, guard, True, lambda _: None)
    link.on_mode(control.on_telemetry)
    control.stream.start()
    assert control.start((0.0, 0.0, 2.0), 0.0)
    return control


def watched(control, seconds, **how):
    """Fly a reference that waits 2 m ahead, as a policy's does; whether it is still ours."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and control.watch():
        x, y, z = control.link.telemetry().position_m
        control.offer(Setpoint(position_m=(x + 1.9, y, z), velocity_m_s=STILL), **how)
        time.sleep(0.05)
    return control.alarm is None


def test_a_vehicle_that_nothing_reaches_is_held_and_landed_for_good(link):
    control = following(link)
    assert watched(control, 2.0)
    link.uplink = False
    assert not watched(control, 10.0)
    assert "does not follow" in control.alarm.reason
    assert link.asked[-2:] == ["hold", "land"]
    link.uplink = True
    control.offer(Setpoint(position_m=(1.0, 0.0, 2.0), velocity_m_s=STILL))
    assert control.stream.halted
    assert not control.watch()
    assert control.state is State.ENDS


def test_a_command_that_does_not_reach_it_either_is_told(link):
    control = following(link)
    link.uplink, link.refuse = False, {"hold"}
    with pytest.raises(LinkError, match="hold"):
        watched(control, 10.0)
    assert "does not follow" in control.alarm.reason
    assert control.stream.halted
    control.emergency()
    assert link.asked[-1] == "request land"


def test_a_pilot_sees_himself_whether_it_follows(link):
    control = following(link)
    link.uplink = False
    assert watched(control, 2.0, by_hand=True)
