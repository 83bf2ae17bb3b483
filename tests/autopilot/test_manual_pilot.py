"""The pilot's setpoints: right is right, and none of them is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.autopilot.guard import Guard
from swarmsim.autopilot.link import Setpoint, Telemetry
from swarmsim.autopilot.manual.pilot import Pilot
from swarmsim.autopilot.manual.rejoin import JOINED_M, Rejoin
from swarmsim.autopilot.manual.sticks import CENTRED, Sticks
from swarmsim.config.autopilot import SetpointLimits
from swarmsim.config.manual import Manual

OUTLINE = np.array([[-50.0, -50.0], [50.0, -50.0], [50.0, 50.0], [-50.0, 50.0]])
LIMITS = SetpointLimits(floor_m=1.0, ceiling_m=30.0)
MANUAL = Manual()
DT = 0.05


def guard_of(flies=True, limits=LIMITS):
    return Guard(limits=limits, outline_m=OUTLINE, ground_m=0.0, flies=flies)


def quaternion(yaw):
    return (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))


class Flown:
    """A point that follows setpoints as told, and a pilot with a guard that looks at each of them."""

    def __init__(self, flies=True, yaw=0.0, place=(0.0, 0.0, 5.0), lag_s=0.2, **fields):
        self.guard = guard_of(flies)
        self.pilot = Pilot(MANUAL, self.guard, **({"speed_max_m_s": 10.0} | fields))
        self.place, self.velocity, self.yaw, self.now, self.lag = np.array(place), np.zeros(3), yaw, 0.0, lag_s
        self.pilot.begin(self.telemetry)

    @property
    def telemetry(self):
        return Telemetry(
            position_m=tuple(map(float, self.place)), velocity_m_s=tuple(map(float, self.velocity)),
            quaternion=quaternion(self.yaw),
        )  # fmt: skip

    def fly(self, sticks, seconds):
        for _ in range(round(seconds / DT)):
            last = self.guard.check(self.pilot.setpoint(sticks, self.telemetry, self.now), self.now)
            self.now += DT
            wanted = np.array(last.velocity_m_s)
            if last.body:
                c, s = math.cos(self.yaw), math.sin(self.yaw)
                wanted = np.array([c * wanted[0] - s * wanted[1], s * wanted[0] + c * wanted[1], wanted[2]])
            if last.position_m is not None:
                wanted = wanted + (np.array(last.position_m) - self.place)
            self.velocity = self.velocity + min(1.0, DT / self.lag) * (wanted - self.velocity)
            self.place = self.place + DT * self.velocity
            self.yaw += DT * (last.yaw_rate_rad_s or 0.0)
        return last


@pytest.mark.parametrize("yaw", [0.0, 1.0, math.pi / 2, -2.5])
@pytest.mark.parametrize(
    ("sticks", "body"),
    [
        (Sticks(forward=1.0), (1.0, 0.0, 0.0)),
        (Sticks(forward=-1.0), (-1.0, 0.0, 0.0)),
        (Sticks(left=1.0), (0.0, 1.0, 0.0)),
        (Sticks(left=-1.0), (0.0, -1.0, 0.0)),
        (Sticks(up=1.0), (0.0, 0.0, 1.0)),
        (Sticks(up=-1.0), (0.0, 0.0, -1.0)),
    ],
)
def test_a_copter_moves_in_the_frame_of_its_heading(yaw, sticks, body):
    flown = Flown(yaw=yaw, place=(0.0, 0.0, 15.0))
    last = flown.fly(sticks, 3.0)
    c, s = math.cos(yaw), math.sin(yaw)
    speed = MANUAL.climb_m_s if body[2] else MANUAL.speed_m_s
    expected = speed * np.array([c * body[0] - s * body[1], s * body[0] + c * body[1], body[2]])
    assert not last.body
    np.testing.assert_allclose(last.velocity_m_s, expected, atol=1e-6)
    assert last.yaw_rate_rad_s == 0.0


@pytest.mark.parametrize("flies", [True, False])
def test_turning_to_the_left_is_counter_clockwise(flies):
    flown = Flown(flies)
    last = flown.fly(Sticks(turn=1.0), 1.0)
    assert last.yaw_rate_rad_s == pytest.approx(math.radians(MANUAL.yaw_rate_deg_s))
    assert flown.yaw > 0.5
    assert flown.fly(Sticks(turn=-0.5), 1.0).yaw_rate_rad_s == pytest.approx(-math.radians(30.0))


def test_a_rover_drives_and_turns():
    flown = Flown(flies=False, yaw=2.0, speed_max_m_s=0.9)
    last = flown.fly(Sticks(forward=1.0), 2.0)
    assert last == Setpoint(velocity_m_s=(0.9, 0.0, 0.0), yaw_rate_rad_s=0.0, body=True)
    assert flown.fly(Sticks(left=1.0), 1.0).yaw_rate_rad_s > 1.0  # the same hand steers
    assert flown.fly(Sticks(forward=-1.0), 3.0).velocity_m_s[0] == -0.9
    assert flown.fly(CENTRED, 3.0) == Setpoint(velocity_m_s=(0.0, 0.0, 0.0), yaw_rate_rad_s=0.0, body=True)
    assert Flown(flies=False, reverses=False).fly(Sticks(forward=-1.0), 1.0).velocity_m_s[0] == 0.0


def test_commands_change_gradually():
    flown, before = Flown(), np.zeros(3)
    for k in range(100):
        sticks = Sticks(forward=(-1.0) ** (k // 10), up=1.0, turn=1.0)
        now = np.array(flown.fly(sticks, DT).velocity_m_s)
        assert np.linalg.norm((now - before)[:2]) <= MANUAL.acceleration_m_s2 * DT + 1e-9
        assert abs((now - before)[2]) <= MANUAL.acceleration_m_s2 * DT + 1e-9
        before = now


def test_a_takeover_begins_with_the_velocity_that_it_has():
    flown = Flown()
    flown.velocity = np.array([4.0, -3.0, 1.0])
    flown.pilot.begin(flown.telemetry)
    first = flown.pilot.setpoint(CENTRED, flown.telemetry, 0.0)
    np.testing.assert_allclose(first.velocity_m_s, (4.0, -3.0, 1.0))
    assert flown.fly(CENTRED, 0.2).velocity_m_s[0] < 4.0


def test_released_sticks_brake_and_hold_the_place():
    flown = Flown()
    flown.fly(Sticks(forward=1.0, up=0.5), 2.0)
    assert not flown.pilot.holds
    last = flown.fly(CENTRED, 3.0)
    assert flown.pilot.holds
    held, place = last.position_m, flown.place.copy()
    assert last.velocity_m_s == (0.0, 0.0, 0.0)
    assert (last.yaw_rad, last.yaw_rate_rad_s) == (0.0, None)
    flown.place = flown.place + np.array([1.0, 0.5, -0.3])  # a gust
    assert flown.fly(CENTRED, 6.0).position_m == held
    assert math.dist(flown.place, place) < 0.3
    turned = flown.fly(Sticks(turn=1.0), 1.0)
    assert turned.position_m == held  # it turns where it is
    assert turned.yaw_rate_rad_s > 0.0
    still = flown.fly(CENTRED, 1.0)
    assert (still.position_m, still.yaw_rad) == (held, pytest.approx(flown.yaw, abs=0.2))
    assert flown.fly(Sticks(left=0.2), 0.1).position_m is None


def test_without_a_known_speed_the_place_is_held_after_a_while():
    flown = Flown()
    blind = replace(flown.telemetry, velocity_m_s=None)
    times = np.arange(0.0, 2.0 * MANUAL.brake_s, DT)
    held = [flown.pilot.setpoint(CENTRED, blind, float(now)).position_m for now in times]
    assert held[0] is None
    assert held[-1] == blind.position_m
    unknown = replace(blind, position_m=None)
    flown.pilot.begin(unknown)
    assert flown.pilot.setpoint(CENTRED, unknown, 99.0).velocity_m_s == (0.0, 0.0, 0.0)


def test_the_height_is_kept_while_it_moves_level():
    flown = Flown()
    flown.fly(Sticks(forward=1.0), 1.0)
    flown.place[2] -= 0.5
    flown.fly(Sticks(forward=1.0), 5.0)
    assert flown.place[2] == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize("flies", [True, False])
@pytest.mark.parametrize("yaw", [0.0, 0.6, 2.0, -1.2])
def test_it_stops_at_the_edge_of_where_it_may_go(flies, yaw):
    flown = Flown(flies, yaw=yaw, place=(0.0, 0.0, 25.0 if flies else 0.0))
    flown.fly(Sticks(forward=1.0, up=1.0), 60.0)
    assert np.abs(flown.place[:2]).max() < 50.0 - LIMITS.margin_m
    assert np.abs(flown.place[:2]).max() > 45.0
    assert flown.place[2] <= 30.0
    flown.fly(CENTRED, 5.0)
    before = flown.place.copy()
    flown.fly(Sticks(forward=-1.0), 3.0)  # and goes back
    assert np.linalg.norm(flown.place[:2]) < np.linalg.norm(before[:2]) - 3.0


def test_one_that_is_outside_is_brought_back():
    flown = Flown(place=(70.0, 0.0, 5.0))
    flown.fly(CENTRED, 20.0)
    assert flown.place[0] < 50.0
    assert flown.pilot.holds
    assert flown.fly(CENTRED, DT).position_m[0] <= 50.0 - LIMITS.margin_m


DEFLECTION = st.sampled_from([-1.0, 0.0, 0.0, 1.0]) | st.floats(-1, 1)
STICKS = st.builds(Sticks, DEFLECTION, DEFLECTION, DEFLECTION, DEFLECTION) | st.just(CENTRED)
ODD = st.floats(allow_nan=True, allow_infinity=True, width=32)
TELEMETRY = st.builds(
    Telemetry,
    position_m=st.none() | st.tuples(*3 * [st.floats(-200, 200)]) | st.tuples(*3 * [ODD]),
    velocity_m_s=st.none() | st.tuples(*3 * [st.floats(-30, 30)]) | st.tuples(*3 * [ODD]),
    quaternion=st.none() | st.floats(-4, 4).map(quaternion) | st.tuples(*4 * [ODD]),
)
PACE = st.sampled_from([0.0, DT, DT, DT, 0.3, 5.0])
SLOW = SetpointLimits(speed_m_s=1.0, climb_m_s=0.3, acceleration_m_s2=0.5, yaw_rate_deg_s=20.0, floor_m=0.0)


@settings(max_examples=300, deadline=None)
@given(
    st.lists(st.tuples(STICKS, TELEMETRY, PACE), max_size=30), st.booleans(), st.booleans(),
    st.sampled_from([LIMITS, SLOW]),
)  # fmt: skip
def test_whatever_the_sticks_and_the_telemetry_do_no_setpoint_is_refused(history, flies, reverses, limits):
    guard = guard_of(flies, limits)
    pilot = Pilot(MANUAL, guard, speed_max_m_s=20.0, reverses=reverses)
    pilot.begin(history[0][1] if history else Telemetry())
    now = 0.0
    for sticks, telemetry, pause in history:
        now += pause
        setpoint = guard.check(pilot.setpoint(sticks, telemetry, now), now)
        assert setpoint.body is not flies
        assert reverses or flies or setpoint.velocity_m_s[0] >= 0.0


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(STICKS, st.floats(0.05, 4.0)), max_size=12), st.booleans(), st.floats(-4, 4))
def test_whatever_is_flown_no_setpoint_is_refused_and_it_stays_inside(history, flies, yaw):
    flown = Flown(flies, yaw=yaw, place=(40.0, -40.0, 5.0 if flies else 0.0))
    for sticks, seconds in history:
        flown.fly(sticks, seconds)
        assert np.abs(flown.place[:2]).max() < 50.0


@settings(max_examples=100, deadline=None)
@given(st.tuples(*2 * [st.floats(-48.9, 48.9)], st.floats(0, 29)), st.tuples(*2 * [st.floats(-80, 80)], ODD))
def test_the_way_back_is_slow_and_is_not_refused(policy, place):
    guard = guard_of()
    here = replace(Telemetry(), position_m=place)
    way, wanted = Rejoin(MANUAL, guard, here, 0.0), Setpoint(position_m=policy, velocity_m_s=(0, 0, 0), yaw_rad=1.0)
    before, now = None, 0.0
    for _ in range(4000):
        now += DT
        setpoint = way.setpoint(wanted, here, now)
        if setpoint is None:
            break
        guard.check(setpoint, now)
        if before is not None:
            assert math.dist(before, setpoint.position_m) <= MANUAL.speed_m_s * DT + 1e-6
        before = setpoint.position_m
        here = replace(here, position_m=before)
    assert setpoint is None
    assert before is None or math.dist(before, policy) < JOINED_M + MANUAL.speed_m_s * DT


@pytest.mark.parametrize("speed", [0.5, 2.5, 6.0])
def test_the_way_back_catches_up_with_a_policy_that_flies_on(speed):
    guard, here, now = guard_of(), Telemetry(position_m=(-45.0, -3.0, 5.0)), 0.0
    way, place, v = Rejoin(MANUAL, guard, here, 0.0), np.array([-45.0, 0.0, 8.0]), np.array([speed, 0.0, 0.3])
    while now < 10.0:
        now += DT
        place = place + DT * v
        setpoint = way.setpoint(Setpoint(position_m=tuple(place), velocity_m_s=tuple(v)), here, now)
        if setpoint is None:
            return
        guard.check(setpoint, now)
        here = replace(here, position_m=setpoint.position_m)
    pytest.fail(f"still {math.dist(place, here.position_m):.1f} m away")


def test_the_way_back_waits_for_a_vehicle_that_does_not_follow():
    here = Telemetry(position_m=(0.0, 0.0, 5.0))
    way = Rejoin(MANUAL, guard_of(), here, 0.0)
    wanted = Setpoint(position_m=(40.0, 0.0, 5.0), velocity_m_s=(0, 0, 0))
    for k in range(400):
        setpoint = way.setpoint(wanted, here, DT * k)
    assert setpoint.position_m[0] < 2.5
    assert setpoint.velocity_m_s == (0.0, 0.0, 0.0)
    assert way.setpoint(Setpoint(velocity_m_s=(1.0, 0.0, 0.0)), here, 99.0) is None
