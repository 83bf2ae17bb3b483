"""What the guard refuses before a byte leaves, over random setpoints as well."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.autopilot.guard import Guard, RefusedError
from swarmsim.autopilot.link import Setpoint
from swarmsim.config.autopilot import SetpointLimits

OUTLINE = np.array([[-50.0, -50.0], [50.0, -50.0], [50.0, 50.0], [-50.0, 50.0]])
LIMITS = SetpointLimits()


def guard(flies=True):
    return Guard(limits=LIMITS, outline_m=OUTLINE, ground_m=10.0, flies=flies)


@pytest.mark.parametrize(
    ("setpoint", "why"),
    [
        (Setpoint(), "neither"),
        (Setpoint(position_m=(0.0, 0.0, 15.0), body=True), "body frame"),
        (Setpoint(velocity_m_s=(0.0, 0.0, 0.0), yaw_rad=0.0, yaw_rate_rad_s=0.0), "both a yaw"),
        (Setpoint(position_m=(math.nan, 0.0, 15.0)), "finite"),
        (Setpoint(velocity_m_s=(0.0, math.inf, 0.0)), "finite"),
        (Setpoint(position_m=(0.0, 0.0, 15.0), yaw_rad=math.nan), "finite"),
        (Setpoint(velocity_m_s=(8.1, 0.0, 0.0)), "speed"),
        (Setpoint(velocity_m_s=(0.0, 0.0, -3.1)), "climbs"),
        (Setpoint(velocity_m_s=(0.0, 0.0, 0.0), acceleration_m_s2=(6.1, 0.0, 0.0)), "acceleration"),
        (Setpoint(velocity_m_s=(0.0, 0.0, 0.0), yaw_rate_rad_s=2.2), "turns"),
        (Setpoint(position_m=(49.5, 0.0, 15.0)), "0.5 m inside"),
        (Setpoint(position_m=(0.0, -60.0, 15.0)), "10.0 m outside"),
        (Setpoint(position_m=(0.0, 0.0, 4.0)), "height"),
        (Setpoint(position_m=(0.0, 0.0, 131.0)), "height"),
    ],
)
def test_a_setpoint_is_refused_with_its_reason(setpoint, why):
    with pytest.raises(RefusedError, match=why):
        guard().check(setpoint, 0.0)


def test_positions_do_not_jump_but_after_a_pause():
    one = guard()
    one.check(Setpoint(position_m=(0.0, 0.0, 15.0)), 0.0)
    with pytest.raises(RefusedError, match=r"jumps by 5\.0 m"):
        one.check(Setpoint(position_m=(5.0, 0.0, 15.0)), 0.05)
    one.check(Setpoint(position_m=(5.0, 0.0, 15.0)), 1.0)  # 8.5 m/s in a second
    one.forget()
    one.check(Setpoint(position_m=(40.0, 0.0, 15.0)), 1.05)


NUMBER = st.floats(allow_nan=True, allow_infinity=True, width=32)
VECTOR = st.none() | st.tuples(NUMBER, NUMBER, NUMBER)


@given(st.builds(
    Setpoint, position_m=VECTOR, velocity_m_s=VECTOR, acceleration_m_s2=VECTOR,
    yaw_rad=st.none() | NUMBER, yaw_rate_rad_s=st.none() | NUMBER, body=st.booleans(),
))  # fmt: skip
def test_whatever_passes_is_finite_and_within_the_limits(setpoint):
    try:
        passed = guard().check(setpoint, 0.0)
    except RefusedError:
        return
    assert passed.position_m is not None or passed.velocity_m_s is not None
    for value in (passed.position_m, passed.velocity_m_s, passed.acceleration_m_s2, passed.yaw_rad):
        assert value is None or np.isfinite(value).all()
    if passed.position_m is not None:
        assert max(map(abs, passed.position_m[:2])) <= 49.0
        assert 5.0 <= passed.position_m[2] <= 130.0
    if passed.velocity_m_s is not None:
        assert math.hypot(*passed.velocity_m_s[:2]) <= 8.01
