"""The cascaded controller: allocation, tracking in wind, mass error, landing, yaw and recovery."""

from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.config.vehicle_checks import effectiveness
from swarmsim.control.commands import PositionCommand
from swarmsim.control.multirotor import LANDED_AFTER_S, rotor_commands
from tests.flights import airborne, attitude, fly_controlled, hover_speed, params_of, plane, spec_of

FOOT = 0.22
torques = st.floats(-1.0, 1.0)


def achieved(thrust, torque, name="tarot_t650"):
    """Thrust and torques that the commanded speeds give."""
    commands = np.asarray(rotor_commands(params_of(name).control, jnp.float32(thrust), jnp.array(torque, jnp.float32)))
    rotor = spec_of(name).rotor
    assert (commands >= rotor.speed_min_rad_s * (1 - 1e-4)).all()
    assert (commands <= rotor.speed_max_rad_s * (1 + 1e-4)).all()
    return effectiveness(spec_of(name)) @ (rotor.thrust_coefficient_n_s2 * commands.astype(np.float64) ** 2)


@given(st.floats(25.0, 45.0), torques, torques, st.floats(-0.1, 0.1))
def test_allocation_gives_what_is_asked(thrust, roll, pitch, yaw):
    np.testing.assert_allclose(achieved(thrust, [roll, pitch, yaw]), [thrust, roll, pitch, yaw], rtol=1e-3, atol=2e-3)


@given(st.floats(0.0, 120.0), st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.floats(-3.0, 3.0))
def test_yaw_and_thrust_give_way_to_roll_and_pitch(thrust, roll, pitch, yaw):
    found = achieved(thrust, [roll, pitch, yaw])
    np.testing.assert_allclose(found[1:3], [roll, pitch], atol=1e-2)
    assert found[3] * np.sign(yaw) >= -1e-3
    assert abs(found[3]) <= abs(yaw) + 1e-3


def test_yaw_gives_way_before_thrust():
    thrust, _, _, yaw = achieved(35.0, [0.0, 0.0, 5.0])
    assert thrust == pytest.approx(35.0, rel=1e-3)
    assert 0.3 < yaw < 2.0


def survey_line(time):
    """Climb to 20 m at 2 m/s, then a line to the east that speeds up to 2.5 m/s."""
    run = jnp.maximum(time - 12.0, 0.0)
    zero = 0.0 * time
    up = jnp.clip(2 * time, 0.0, 20.0)
    east = jnp.where(run < 2.5, 0.5 * run**2, 2.5 * run - 3.125)
    return PositionCommand(
        position_m=jnp.stack([east, zero, up + FOOT]),
        velocity_m_s=jnp.stack([jnp.minimum(run, 2.5), zero, jnp.where(time < 10.0, 2.0, 0.0)]),
        acceleration_m_s2=jnp.stack([jnp.where((run > 0) & (run < 2.5), 1.0, 0.0), zero, zero]),
        yaw_rad=zero,
    )


@pytest.mark.parametrize("name", ["tarot_t650", "x500"])
@pytest.mark.parametrize(("wind", "mass"), [(2.0, 1.0), (5.0, 1.0), (5.0, 0.8), (5.0, 1.2)])
def test_tracks_a_survey_line_in_gusts(name, wind, mass):
    params = params_of(name)
    params = replace(params, mass_kg=mass * params.mass_kg)
    states, _, _ = fly_controlled(params, survey_line, 40.0, wind=wind, gusts=True, name=name)
    time = 0.01 * np.arange(1, 4001)
    east = np.where(time < 14.5, 0.5 * np.maximum(time - 12, 0) ** 2, 2.5 * (time - 12) - 3.125)
    wanted = np.stack([east, 0 * time, np.clip(2 * time, 0, 20) + FOOT], -1)
    error = np.linalg.norm(states.body.position_m - wanted, axis=1)
    assert error[time > 16].max() < 0.5
    assert error.max() < 1.5


TYPES = ("tarot_t650", "x500", "dji_f550")
GENTLE = ("ar_drone_2", "crazyflie_2_1")  # climb at 1 m/s and fly at 4 and 1.5


@cache
def response(name, metres, axis):
    """Position along ``axis`` over the step's ``metres``, every 10 ms after it; it comes after a second of hover."""
    there = jnp.asarray(np.eye(3)[axis], jnp.float32)

    def at(time):
        zero = jnp.zeros(3)
        place = jnp.array([0.0, 0.0, 100.0]) + jnp.where(time > 1.0, metres, 0.0) * there
        return PositionCommand(position_m=place, velocity_m_s=zero, acceleration_m_s2=zero, yaw_rad=0.0 * time)

    params = params_of(name)
    start = airborne(params, height=100.0, speed=hover_speed(params))
    states, _, _ = fly_controlled(params, at, 17.0 if name in GENTLE else 13.0, state=start, name=name)
    return (states.body.position_m[100:, axis] - (100.0 if axis == 2 else 0.0)) / metres


@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("metres", [2.0, 5.0, 10.0])
@pytest.mark.parametrize("name", [*TYPES, "asctec_pelican", *GENTLE])
def test_steps_hardly_overshoot_and_settle(name, metres, axis):
    x = response(name, metres, axis)
    assert x.max() < 1.03
    outside = np.flatnonzero(np.abs(x - 1.0) > 0.02)[-1] * 0.01
    limit = 3.0 if metres <= 5.0 else 4.5  # 10 m up take 3.3 s at the largest rate of climb
    if name in GENTLE and (metres > 2.0 or axis == 2):
        control = params_of(name).control
        limit = 4.0 + metres / float(control.climb_rate_max_m_s if axis == 2 else control.speed_max_m_s)
    assert outside < limit
    assert abs(x[-1] - 1.0) < 0.002


@pytest.mark.parametrize("name", GENTLE)
def test_what_a_gale_carries_off_leans_against_it(name):
    """14 m/s at 100 m: it drifts, but slower; the moment of air that it does not meet is not fed forward."""

    def at(time):
        zero = jnp.zeros(3)
        return PositionCommand(
            position_m=jnp.array([0.0, 0.0, 100.0]), velocity_m_s=zero, acceleration_m_s2=zero, yaw_rad=0.0 * time
        )

    params = params_of(name)
    start = airborne(params, height=100.0, speed=hover_speed(params))
    states, _, _ = fly_controlled(params, at, 40.0, state=start, wind=9.0, name=name)
    up = attitude(states.body.quaternion[-1])[:, 2]
    assert up[0] < -0.15
    assert states.body.velocity_m_s[-1, 0] < 0.8 * 14.0


@pytest.mark.parametrize("wind", [0.0, 5.0])
@pytest.mark.parametrize("name", TYPES)
def test_keeps_up_at_the_largest_speed(name, wind):
    params = params_of(name)
    top = float(params.control.speed_max_m_s)

    def at(time):
        ramp = jnp.minimum(time, top / 2.0)
        east, zero = ramp * ramp + top * (time - ramp), 0.0 * time
        acceleration = jnp.where(time < top / 2.0, 2.0, 0.0)
        return PositionCommand(
            position_m=jnp.stack([east, zero, zero + 100.0]), velocity_m_s=jnp.stack([2.0 * ramp, zero, zero]),
            acceleration_m_s2=jnp.stack([acceleration, zero, zero]), yaw_rad=zero,
        )  # fmt: skip

    start = airborne(params, height=100.0, speed=hover_speed(params))
    states, _, _ = fly_controlled(params, at, 20.0, state=start, wind=wind, name=name)
    time = 0.01 * np.arange(1, 2001)
    ramp = np.minimum(time, top / 2)
    behind = ramp**2 + top * (time - ramp) - states.body.position_m[:, 0]
    assert np.abs(behind).max() < 0.08 * top
    assert np.abs(behind[-1]) < 0.01 * top


def landing(time):
    """Down from 3 m at 0.5 m/s, on into the ground."""
    zero = 0.0 * time
    return PositionCommand(
        position_m=jnp.stack([zero, zero, jnp.maximum(3.0 - 0.5 * time, -1.0)]),
        velocity_m_s=jnp.stack([zero, zero, jnp.where(time < 8.0, -0.5, 0.0)]),
        acceleration_m_s2=jnp.zeros(3),
        yaw_rad=zero,
    )


@cache
def landed(name, slope_deg, mass, wind):
    params = params_of(name)
    params = replace(params, mass_kg=mass * params.mass_kg)
    start = airborne(params, height=3.0, speed=hover_speed(params))  # the controller has yet to learn its true weight
    return fly_controlled(params, landing, 14.0, state=start, wind=wind, ground=plane(slope_deg), name=name)


@pytest.mark.parametrize("name", ["tarot_t650", "x500"])
@pytest.mark.parametrize(("slope_deg", "mass", "wind"), [(0.0, 1.0, 0.0), (0.0, 0.8, 4.0), (10.0, 1.2, 4.0)])
def test_lands_softly_and_switches_off(name, slope_deg, mass, wind):
    states, memory, commands = landed(name, slope_deg, mass, wind)
    assert states.body.velocity_m_s[300:, 2].min() > -0.8
    assert np.linalg.norm(states.body.velocity_m_s[-1]) < 2e-3
    up = attitude(states.body.quaternion[-1])[:, 2]
    assert up @ np.asarray(plane(slope_deg).normal) > np.cos(np.radians(1.0))
    assert memory.stuck_s[-1] >= LANDED_AFTER_S
    np.testing.assert_array_equal(commands[-1], 0.0)
    np.testing.assert_array_equal(states.rotor_speed_rad_s[-1] < 1.0, True)
    first_off = np.argmax((commands == 0.0).all(axis=1))
    height = states.body.position_m[first_off] @ np.asarray(plane(slope_deg).normal)
    assert height < 0.30  # only on the ground


def hop(time):
    """On the ground for 3 s after touch-down, then up again to 2 m."""
    zero = 0.0 * time
    down, up = 1.0 - 0.5 * time, -0.5 + 1.0 * (time - 6.0)
    high = jnp.where(time < 6.0, jnp.maximum(down, -0.5), jnp.minimum(up, 2.0))
    climb = jnp.where(time < 3.0, -0.5, jnp.where((time > 6.0) & (up < 2.0), 1.0, 0.0))
    return PositionCommand(
        position_m=jnp.stack([zero, zero, high]),
        velocity_m_s=jnp.stack([zero, zero, climb]),
        acceleration_m_s2=jnp.zeros(3),
        yaw_rad=zero,
    )


def test_takes_off_again_after_landing():
    params = params_of()
    start = airborne(params, height=1.0, speed=hover_speed(params))
    states, _, commands = fly_controlled(params, hop, 14.0, state=start)
    np.testing.assert_array_equal(commands[590], 0.0)
    np.testing.assert_allclose(states.body.position_m[-1], [0, 0, 2.0], atol=0.1)


def turn(time):
    zero = 0.0 * time
    return PositionCommand(
        position_m=jnp.stack([zero, zero, zero + 30.0]),
        velocity_m_s=jnp.zeros(3),
        acceleration_m_s2=jnp.zeros(3),
        yaw_rad=zero + 3.0,
    )


def test_turns_to_the_heading_the_short_way_and_stays_in_place():
    params = params_of()
    start = airborne(params, height=30.0, speed=hover_speed(params), q=(np.cos(-1.4), 0, 0, np.sin(-1.4)))  # -2.8 rad
    states, _, _ = fly_controlled(params, turn, 8.0, state=start)
    frame = attitude(states.body.quaternion)
    heading = np.unwrap(np.arctan2(frame[:, 1, 0], frame[:, 0, 0]))
    assert heading[-1] == pytest.approx(3.0 - 2 * np.pi, abs=0.02)
    assert heading.max() < -2.75
    assert np.linalg.norm(states.body.position_m - [0, 0, 30.0], axis=1).max() < 0.2


@pytest.mark.parametrize("name", ["tarot_t650", "x500"])
def test_recovers_from_upside_down(name):
    params = params_of(name)
    start = airborne(params, height=30.0, speed=hover_speed(params), q=(0.05, 0.9987, 0, 0))
    states, _, _ = fly_controlled(params, turn, 12.0, state=start, name=name)
    assert states.body.position_m[:, 2].min() > 10.0
    np.testing.assert_allclose(states.body.position_m[-1], [0, 0, 30.0], atol=0.3)


@pytest.mark.parametrize("name", ["tarot_t650", "x500"])
def test_one_that_circles_its_place_comes_to_it(name):
    # with an integral that winds up while the feedback is at its limit, this circle of 8 m goes on for ever
    params = params_of(name)
    start = airborne(params, height=30.0, speed=hover_speed(params))
    body = replace(start.body, position_m=jnp.array([8.0, 0.0, 30.0]), velocity_m_s=jnp.array([0.0, 7.5, 0.0]))
    states, _, _ = fly_controlled(params, turn, 20.0, state=replace(start, body=body), name=name)
    np.testing.assert_allclose(states.body.position_m[-1], [0, 0, 30.0], atol=0.1)


def stay(time):
    zero = 0.0 * time
    return PositionCommand(
        position_m=jnp.stack([zero, zero, 20.0 + zero]),
        velocity_m_s=jnp.zeros(3),
        acceleration_m_s2=jnp.zeros(3),
        yaw_rad=zero,
    )


@pytest.mark.parametrize(("name", "least_tilt_deg"), [("tarot_t650", 44.5), ("x500", 30.0)])
def test_in_too_strong_a_wind_it_keeps_height_and_heading_and_drifts_steadily(name, least_tilt_deg):
    params = params_of(name)
    start = airborne(params, height=20.0, speed=hover_speed(params))
    states, memory, _ = fly_controlled(params, stay, 20.0, state=start, wind=16.0, name=name)
    late = states.body.velocity_m_s[-500:]
    assert 1.0 < np.linalg.norm(late[-1, :2]) < 8.0
    assert np.ptp(late, axis=0).max() < 0.1
    np.testing.assert_allclose(states.body.position_m[-500:, 2], 20.0, atol=0.4)
    up = attitude(states.body.quaternion[-500:])
    assert np.degrees(np.arccos(up[:, 2, 2])).min() > least_tilt_deg  # it uses all it has
    assert np.abs(np.arctan2(up[:, 1, 0], up[:, 0, 0])).max() < 0.2
    assert np.abs(memory.rate_integral_rad_s[-1]).max() < 1.0
