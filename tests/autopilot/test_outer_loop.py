"""The loop from setpoints to tilt, climb and turn: closed forms, limits, and that it settles."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.autopilot.link import Setpoint, Telemetry
from swarmsim.autopilot.outer_loop import GRAVITY_M_S2, LoopSettings, OuterLoop

SETTINGS = LoopSettings(
    position_gain_1_s=0.8, velocity_gain_1_s=1.4, velocity_integral_1_s2=0.3, height_gain_1_s=1.0, yaw_gain_1_s=1.5,
    speed_max_m_s=4.0, climb_max_m_s=1.0, tilt_max_deg=15.0, turn_max_deg_s=90.0,
)  # fmt: skip
REST = Telemetry(position_m=(0.0, 0.0, 5.0), velocity_m_s=(0.0, 0.0, 0.0))
numbers = st.floats(-1e3, 1e3)
vectors = st.tuples(numbers, numbers, numbers)


def test_at_its_place_nothing_is_demanded():
    demand = OuterLoop(SETTINGS).step(Setpoint(position_m=(0.0, 0.0, 5.0), yaw_rad=0.3), REST, 0.3, 0.02)
    assert demand.velocity_m_s == (0.0, 0.0, 0.0)
    assert demand.acceleration_m_s2 == (0.0, 0.0)
    assert demand.turn_rad_s == 0.0


def test_gains_multiply():
    demand = OuterLoop(SETTINGS).step(Setpoint(position_m=(1.0, 0.0, 5.5), yaw_rad=0.2), REST, 0.0, 0.0)
    assert demand.velocity_m_s == pytest.approx((0.8, 0.0, 0.5))
    assert demand.acceleration_m_s2 == pytest.approx((1.4 * 0.8, 0.0))
    assert demand.turn_rad_s == pytest.approx(1.5 * 0.2)


def test_tilt_and_velocity_are_in_the_heading():
    demand = OuterLoop(SETTINGS).step(Setpoint(velocity_m_s=(1.0, 0.0, 0.0)), REST, 0.5 * math.pi, 0.0)
    forward, left = demand.tilt(0.5 * math.pi)  # the nose to the north: east is to the right
    assert (forward, left) == pytest.approx((0.0, -math.atan(1.4 / GRAVITY_M_S2)), abs=1e-12)
    assert demand.level_velocity(0.5 * math.pi) == pytest.approx((0.0, -1.0), abs=1e-12)


def test_body_velocities_turn_with_the_heading():
    demand = OuterLoop(SETTINGS).step(Setpoint(velocity_m_s=(1.0, 0.0, 0.0), body=True), REST, 0.5 * math.pi, 0.0)
    assert demand.velocity_m_s == pytest.approx((0.0, 1.0, 0.0), abs=1e-12)


def test_without_a_heading_the_one_it_has_is_kept():
    loop = OuterLoop(SETTINGS)
    loop.step(Setpoint(velocity_m_s=(0.0, 0.0, 0.0)), REST, 1.0, 0.02)
    assert loop.step(Setpoint(velocity_m_s=(0.0, 0.0, 0.0)), REST, 0.9, 0.02).turn_rad_s == pytest.approx(0.15)
    loop.reset()
    assert loop.step(Setpoint(velocity_m_s=(0.0, 0.0, 0.0)), REST, 0.9, 0.02).turn_rad_s == 0.0


def test_headings_turn_the_short_way():
    turn = OuterLoop(SETTINGS).step(Setpoint(velocity_m_s=(0.0, 0.0, 0.0), yaw_rad=3.1), REST, -3.1, 0.02).turn_rad_s
    assert turn == pytest.approx(-1.5 * (2.0 * math.pi - 6.2))


@given(vectors, vectors, vectors, st.floats(-10, 10), st.floats(0, 10))
def test_limits_hold_whatever_is_asked(place, velocity, has, yaw, dt):
    loop = OuterLoop(SETTINGS)
    now = Telemetry(position_m=has, velocity_m_s=has)
    for _ in range(5):
        demand = loop.step(Setpoint(position_m=place, velocity_m_s=velocity, yaw_rad=yaw), now, -yaw, dt)
    assert math.hypot(*demand.velocity_m_s[:2]) <= SETTINGS.speed_max_m_s * (1 + 1e-9)
    assert abs(demand.velocity_m_s[2]) <= SETTINGS.climb_max_m_s
    assert math.atan(math.hypot(*demand.acceleration_m_s2) / GRAVITY_M_S2) <= math.radians(15.0) * (1 + 1e-9)
    assert abs(demand.turn_rad_s) <= math.radians(90.0)


def test_a_point_mass_with_drag_and_wind_settles_at_the_place():
    loop = OuterLoop(SETTINGS)
    x = v = 0.0
    for _ in range(int(40.0 / 0.03)):
        now = Telemetry(position_m=(x, 0.0, 5.0), velocity_m_s=(v, 0.0, 0.0))
        forward, _ = loop.step(Setpoint(position_m=(10.0, 0.0, 5.0)), now, 0.0, 0.03).tilt(0.0)
        v += 0.03 * (GRAVITY_M_S2 * math.tan(forward) - 0.3 * (v - 2.0))  # 2 m/s of wind
        x += 0.03 * v
    assert x == pytest.approx(10.0, abs=0.05)


def test_a_vehicle_that_tells_no_position_is_not_flown():
    with pytest.raises(ValueError, match="position"):
        OuterLoop(SETTINGS).step(Setpoint(position_m=(0.0, 0.0, 0.0)), Telemetry(), 0.0, 0.02)
