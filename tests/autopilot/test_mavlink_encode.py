"""Setpoints to the fields of SET_POSITION_TARGET_LOCAL_NED."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.frames import Alignment
from swarmsim.autopilot.link import Setpoint
from swarmsim.autopilot.mavlink.encode import LARGEST, encode
from swarmsim.autopilot.mavlink.profile import AUTOPILOTS, VEHICLES, load_profile

PROFILES = {(a, v): load_profile(a, v) for a in AUTOPILOTS for v in VEHICLES}
COPTERS = [key for key in PROFILES if key[1] == "copter"]
ROVERS = [key for key in PROFILES if key[1] == "rover"]
ALIGNMENT = Alignment((100.0, 50.0, 5.0), (1.0, -2.0, 0.5))

metres = st.floats(-1e4, 1e4)
vectors = st.tuples(metres, metres, metres)
angles = st.floats(-10.0, 10.0)
bad_numbers = st.sampled_from([math.nan, math.inf, -math.inf, 1e30, -2 * LARGEST])


@st.composite
def world_setpoints(draw):
    position = draw(st.none() | vectors)
    velocity = draw(vectors if position is None else st.none() | vectors)
    acceleration = None if velocity is None else draw(st.none() | vectors)
    yaw = draw(st.none() | angles)
    rate = draw(st.none() | angles) if yaw is None else None
    return Setpoint(position, velocity, acceleration, yaw, rate)


def packed(target):
    """The fields as they arrive at the other end."""
    fields = (*target.position, *target.velocity, *target.acceleration, target.yaw, target.yaw_rate)
    sender = mavlink.MAVLink(None, 245, 191)
    data = mavlink.MAVLink_set_position_target_local_ned_message(0, 7, 1, target.frame, target.mask, *fields)
    return mavlink.MAVLink(None).parse_buffer(data.pack(sender))[0]


def test_the_masks_that_were_flown():
    ardupilot, px4 = PROFILES["ardupilot", "copter"], PROFILES["px4", "copter"]
    position, velocity = (110.0, 70.0, 9.0), (1.0, 2.0, 3.0)
    assert encode(Setpoint(position), px4, ALIGNMENT).mask == 3576
    assert encode(Setpoint(velocity_m_s=velocity), px4, ALIGNMENT).mask == 3527
    assert encode(Setpoint(position, velocity, velocity), px4, ALIGNMENT).mask == 0x0C00
    assert encode(Setpoint(position, yaw_rad=0.0), ardupilot, ALIGNMENT).mask == 2552
    # without a heading ArduPilot is told a yaw rate of zero, or it turns to where it flies
    assert encode(Setpoint(position), ardupilot, ALIGNMENT).mask == 3576 & ~0x800
    assert encode(Setpoint(position), PROFILES["ardupilot", "rover"], ALIGNMENT).mask == 3576


@pytest.mark.parametrize("key", PROFILES)
@given(setpoint=world_setpoints())
def test_what_is_sent_stands_in_ned_and_what_is_not_is_ignored(key, setpoint):
    profile = PROFILES[key]
    target = encode(setpoint, profile, ALIGNMENT)
    if target.frame != 1:  # a rover that stands
        assert key in ROVERS
        assert math.hypot(*setpoint.velocity_m_s[:2]) <= profile.kind.setpoints.still_m_s
        return
    message = packed(target)
    told = {
        "position": None if message.type_mask & 0x007 else (message.x, message.y, message.z),
        "velocity": None if message.type_mask & 0x038 else (message.vx, message.vy, message.vz),
        "acceleration": None if message.type_mask & 0x1C0 else (message.afx, message.afy, message.afz),
    }
    for bits in (0x007, 0x038, 0x1C0):
        assert message.type_mask & bits in (0, bits)
    assert not message.type_mask & 0x200  # no force
    assert told["position"] or told["velocity"]
    if told["position"] is not None:
        np.testing.assert_allclose(told["position"], ALIGNMENT.to_local(setpoint.position_m), rtol=1e-6, atol=1e-3)
    assert (told["position"] is None) == (setpoint.position_m is None)
    for name, given_ in (("velocity", setpoint.velocity_m_s), ("acceleration", setpoint.acceleration_m_s2)):
        if told[name] is not None:
            north, east, down = told[name]
            np.testing.assert_allclose((east, north, -down), given_, rtol=1e-6, atol=1e-6)
        elif key in COPTERS:
            assert given_ is None


@pytest.mark.parametrize("key", COPTERS)
@given(setpoint=world_setpoints())
def test_headings_of_copters(key, setpoint):
    message = packed(encode(setpoint, PROFILES[key], ALIGNMENT))
    yaw_sent, rate_sent = not message.type_mask & 0x400, not message.type_mask & 0x800
    assert not (yaw_sent and rate_sent)
    if setpoint.yaw_rad is not None:
        assert yaw_sent
        nose = np.exp(1j * setpoint.yaw_rad)
        assert abs(math.cos(message.yaw) - nose.imag) < 1e-5  # north
        assert abs(math.sin(message.yaw) - nose.real) < 1e-5  # east
    elif setpoint.yaw_rate_rad_s is not None:
        assert rate_sent
        assert message.yaw_rate == pytest.approx(-setpoint.yaw_rate_rad_s, rel=1e-6)
    else:
        assert rate_sent == (key[0] == "ardupilot")
        assert message.yaw_rate == 0.0


@pytest.mark.parametrize("key", COPTERS)
@given(velocity=vectors, rate=st.none() | angles)
def test_body_frame_of_copters(key, velocity, rate):
    target = encode(Setpoint(velocity_m_s=velocity, yaw_rate_rad_s=rate, body=True), PROFILES[key], ALIGNMENT)
    assert target.frame == {"px4": 8, "ardupilot": 9}[key[0]]
    assert target.mask & 0x03F == 0x007
    np.testing.assert_array_equal(target.velocity, np.array(velocity) * [1.0, -1.0, -1.0])


@given(forward=st.floats(-5.0, 5.0), rate=st.floats(-3.0, 3.0))
def test_an_ardupilot_rover_is_driven_by_speed_and_yaw_rate(forward, rate):
    setpoint = Setpoint(velocity_m_s=(forward, 0.0, 0.0), yaw_rate_rad_s=rate, body=True)
    target = encode(setpoint, PROFILES["ardupilot", "rover"], ALIGNMENT)
    assert (target.frame, target.mask) == (9, 0x5C7)
    assert target.velocity == (forward, 0.0, 0.0)
    assert target.yaw_rate == -rate


@given(forward=st.floats(0.0, 5.0), rate=st.floats(-3.0, 3.0))
def test_a_px4_rover_is_driven_by_the_direction_of_its_velocity(forward, rate):
    rover = PROFILES["px4", "rover"]
    target = encode(Setpoint(velocity_m_s=(forward, 0.0, 0.0), yaw_rate_rad_s=rate, body=True), rover, ALIGNMENT)
    assert (target.frame, target.mask) == (8, 0xDC7)
    ahead, right, down = target.velocity
    assert math.hypot(ahead, right) == pytest.approx(max(forward, 0.01))
    turn = rover.kind.setpoints.turn_gain_1_s * math.atan2(right, ahead)
    assert turn == pytest.approx(-rate, abs=1e-9)
    assert down == 0.0


@pytest.mark.parametrize("key", ROVERS)
@given(climb=metres, acceleration=st.none() | vectors)
def test_a_rover_that_stands_is_not_turned_to_the_north(key, climb, acceleration):
    """Both autopilots head for the direction of the velocity, and that of a vanishing one is north."""
    still = Setpoint(velocity_m_s=(0.0, 0.0, climb), acceleration_m_s2=acceleration)
    target = encode(still, PROFILES[key], ALIGNMENT)
    assert target.frame in (8, 9)
    assert target.velocity[1] == 0.0
    assert target.yaw_rate == 0.0
    assert 0.0 <= target.velocity[0] <= 0.01


@pytest.mark.parametrize("key", PROFILES)
@given(setpoint=world_setpoints(), number=bad_numbers, place=st.integers(0, 10))
def test_a_number_that_is_not_finite_is_refused(key, setpoint, number, place):
    names = ("position_m", "velocity_m_s", "acceleration_m_s2", "yaw_rad", "yaw_rate_rad_s")
    name = names[min(place // 3, 3) + (place == 10)]
    value = getattr(setpoint, name)
    if name.startswith("yaw"):
        spoilt = replace(setpoint, **{name: number})
    else:
        vector = list(value or (0.0, 0.0, 0.0))
        vector[place % 3] = number
        spoilt = replace(setpoint, **{name: tuple(vector)})
    with pytest.raises(ValueError, match=f"{name} is not finite|yaw"):
        encode(spoilt, PROFILES[key], ALIGNMENT)


@pytest.mark.parametrize(
    ("setpoint", "reason"),
    [
        (Setpoint(), "needs a position or a velocity"),
        (Setpoint(yaw_rad=1.0), "needs a position or a velocity"),
        (Setpoint((1.0, 2.0, 3.0), acceleration_m_s2=(0.0, 0.0, 0.0)), "give the velocity"),
        (Setpoint((1.0, 2.0, 3.0), yaw_rad=1.0, yaw_rate_rad_s=1.0), "not both"),
        (Setpoint((1.0, 2.0, 3.0), body=True), "has no position"),
        (Setpoint(velocity_m_s=(1.0, 0.0, 0.0), yaw_rad=1.0, body=True), "not a yaw"),
        (Setpoint((1.0, 2.0)), "has 2 numbers"),  # type: ignore[arg-type]
        (Setpoint(velocity_m_s=(1.0, 0.5, 0.0), body=True), "sideways"),
        (Setpoint(velocity_m_s=(-1.0, 0.0, 0.0), body=True), "backwards"),
    ],
)
def test_what_cannot_be_meant_is_refused(setpoint, reason):
    with pytest.raises(ValueError, match=reason):
        encode(setpoint, PROFILES["px4", "rover"], ALIGNMENT)
