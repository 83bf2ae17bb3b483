"""The stand-in as PX4: each point of the reference at which a companion computer may fail."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from tests.autopilot.standins import BODY, BODY_OFFSET, OFFSET, POSITION, VELOCITY, Bench, px4_flying, px4_mode

OFFBOARD, POSCTL, HOLD = px4_mode(6), px4_mode(3), px4_mode(4, 3)
RTL, LAND, TAKEOFF = px4_mode(4, 5), px4_mode(4, 6), px4_mode(4, 2)


def test_it_tells_what_it_is_and_streams_without_being_asked():
    bench = Bench("px4").advance(7.0)
    beat = bench.last("HEARTBEAT")
    assert (beat.autopilot, beat.type) == (mav.MAV_AUTOPILOT_PX4, mav.MAV_TYPE_QUADROTOR)
    assert beat.custom_mode == HOLD
    assert not beat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED
    assert 6 <= len(bench.all("HEARTBEAT")) <= 8
    told = {message.get_type() for _, message in bench.heard}
    assert {"LOCAL_POSITION_NED", "ATTITUDE_QUATERNION", "SYS_STATUS", "ESTIMATOR_STATUS", "EXTENDED_SYS_STATE"} <= told
    assert "STATUSTEXT" not in told


def test_it_can_be_armed_only_when_its_estimate_is_ready():
    bench = Bench("px4").advance(1.0)
    assert bench.arm() == [mav.MAV_RESULT_TEMPORARILY_REJECTED]
    assert not bench.all("LOCAL_POSITION_NED")
    bench.advance(5.0)
    assert bench.last("ESTIMATOR_STATUS").flags & mav.ESTIMATOR_POS_HORIZ_ABS
    assert bench.arm() == [0]
    assert bench.advance(1.0).last("HEARTBEAT").base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED


def test_offboard_takes_off_by_itself_and_a_mode_command_is_answered_twice():
    bench = px4_flying(4.0)
    assert bench.custom_mode == OFFBOARD
    assert bench.last("EXTENDED_SYS_STATE").landed_state == mav.MAV_LANDED_STATE_IN_AIR


def test_without_a_stream_offboard_is_accepted_on_the_ground_and_arming_refused():
    bench = Bench("px4").advance(6.0)
    assert bench.set_mode(6) == [0, 0]
    assert bench.arm() == [mav.MAV_RESULT_TEMPORARILY_REJECTED]
    assert not bench.standin.armed


@pytest.mark.parametrize("seconds", [0.5, 1.2])
def test_offboard_asks_for_a_second_of_stream(seconds):
    bench = Bench("px4").advance(6.0)
    bench.set_mode(6)
    bench.stream(seconds, position=(0.0, 0.0, -3.0))
    assert bench.arm() == ([0] if seconds > 1.0 else [1])


def test_in_the_air_without_a_stream_the_mode_command_is_answered_both_ways():
    bench = px4_flying()
    bench.set_mode(4, 3)
    bench.advance(3.0)
    assert bench.set_mode(6) == [0, 1]
    assert bench.advance(1.1).custom_mode == HOLD


def test_a_lost_stream_ends_offboard_within_two_seconds():
    bench = px4_flying()
    lost = bench.standin.time_s
    bench.until(lambda: bench.custom_mode == POSCTL, 2.6)
    assert bench.standin.time_s - lost > 1.2
    assert bench.last("HEARTBEAT").system_status == mav.MAV_STATE_CRITICAL
    here = bench.position
    bench.advance(5.0)
    assert math.dist(bench.position, here) < 0.3
    assert not bench.all("STATUSTEXT")


@pytest.mark.parametrize(("hz", "mode"), [(1.5, OFFBOARD), (0.6, POSCTL)])
def test_how_slow_a_stream_may_be(hz, mode):
    bench = px4_flying()
    bench.stream(10.0, hz=hz, position=(0.0, 0.0, -5.0))
    assert bench.advance(0.3).custom_mode == mode


def test_it_enters_offboard_again_by_itself_when_the_stream_returns():
    bench = px4_flying().advance(4.0)
    assert bench.custom_mode == POSCTL
    bench.stream(2.5, position=(0.0, 0.0, -5.0)).stream(1.0, position=(0.0, 0.0, -5.0))
    assert bench.custom_mode == OFFBOARD
    assert bench.last("HEARTBEAT").system_status == mav.MAV_STATE_ACTIVE


def test_a_commanded_hold_is_not_overridden_by_the_stream():
    bench = px4_flying().advance(4.0)
    assert bench.set_mode(4, 3) == [0, 0]
    bench.stream(5.0, position=(0.0, 0.0, -5.0))
    assert bench.custom_mode == HOLD


def test_an_operators_mode_is_not_overridden_by_the_stream():
    bench = px4_flying()
    bench.standin.operator_mode("POSCTL")
    bench.stream(5.0, position=(20.0, 0.0, -5.0))
    assert bench.custom_mode == POSCTL
    assert math.hypot(*bench.position[:2]) < 1.0


@pytest.mark.parametrize(
    "setpoint",
    [{"frame": OFFSET}, {"frame": BODY_OFFSET}, {"mask": 0xFFF}, {"frame": 5}],
    ids=["offset", "body offset", "ignore all", "global"],
)
def test_setpoints_that_are_not_supported_count_as_none(setpoint):
    bench = px4_flying()
    bench.stream(5.0, **({"mask": POSITION, "position": (5.0, 0.0, -5.0)} | setpoint))
    assert bench.custom_mode == POSCTL


def test_velocity_in_the_body_frame_turns_with_the_heading_and_its_position_is_ignored():
    bench = px4_flying()  # heads east
    bench.stream(4.0, mask=0xDC0 & ~0x7, frame=BODY, position=(-50.0, -50.0, -50.0), velocity=(2.0, 0.0, 0.0))
    north, east, _ = bench.position
    assert east > 5.0
    assert abs(north) < 0.5
    assert bench.height == pytest.approx(5.0, abs=0.5)


def test_a_setpoint_that_is_no_number_makes_it_wait_in_offboard():
    bench = px4_flying()
    here = bench.position
    bench.stream(5.0, position=(math.nan, 5.0, -20.0))
    assert bench.custom_mode == OFFBOARD
    assert math.dist(bench.position, here) < 1.0
    bench.stream(6.0, position=(3.0, 0.0, -5.0))
    assert bench.position[0] == pytest.approx(3.0, abs=0.3)


def test_position_of_some_axes_and_velocity_of_others():
    bench = px4_flying()
    bench.stream(4.0, mask=0xDC0 | 0x3 | 0x20, position=(0.0, 0.0, -8.0), velocity=(1.0, 0.0, 0.0))
    assert bench.position[0] == pytest.approx(4.0, abs=0.7)
    assert bench.height == pytest.approx(8.0, abs=0.4)


def test_companion_heartbeats_do_not_matter_while_it_streams():
    bench = px4_flying()
    bench.standin.deliver(mav.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), system=245)
    bench.stream(10.0, position=(0.0, 0.0, -5.0))
    assert bench.custom_mode == OFFBOARD


def test_take_off_land_and_disarm():
    bench = Bench("px4").advance(6.0)
    bench.arm()
    assert bench.command(mav.MAV_CMD_NAV_TAKEOFF, *[math.nan] * 7) == [0]
    assert bench.advance(1.1).custom_mode == TAKEOFF
    bench.until(lambda: bench.standin.mode == "AUTO.LOITER", 20.0)
    assert bench.height == pytest.approx(2.5, abs=0.6)
    assert bench.arm(0) == [mav.MAV_RESULT_TEMPORARILY_REJECTED]
    assert bench.command(mav.MAV_CMD_NAV_LAND) == [0]
    bench.until(lambda: not bench.standin.armed, 20.0)
    assert bench.height == pytest.approx(0.0, abs=0.1)


def test_after_a_flight_in_offboard_it_stands_in_offboard_and_is_not_ready():
    bench = px4_flying()
    bench.set_mode(4, 6)
    bench.until(lambda: not bench.standin.armed, 20.0)
    assert bench.advance(1.0).custom_mode == OFFBOARD
    assert not bench.last("SYS_STATUS").onboard_control_sensors_health & mav.MAV_SYS_STATUS_PREARM_CHECK
    bench.set_mode(4, 3)
    bench.advance(1.0)
    assert bench.last("SYS_STATUS").onboard_control_sensors_health & mav.MAV_SYS_STATUS_PREARM_CHECK


def test_a_failsafe_is_over_when_it_is_disarmed():
    bench = px4_flying()
    bench.advance(3.0)
    assert bench.standin.pilot.failsafe
    bench.standin.disarm_unexpectedly()
    assert bench.advance(0.5).custom_mode == OFFBOARD
    assert not bench.standin.pilot.failsafe


def test_return_flies_home_at_its_height_and_disarms():
    bench = px4_flying()
    bench.stream(15.0, position=(40.0, 30.0, -5.0))
    assert bench.set_mode(4, 5) == [0, 0]
    highest = 0.0
    for _ in range(900):
        bench.advance(0.1)
        highest = max(highest, bench.height)
        if not bench.standin.armed:
            break
    assert not bench.standin.armed
    assert math.hypot(*bench.position[:2]) < 0.5
    assert highest == pytest.approx(20.0, abs=1.0)


def test_an_armed_vehicle_that_does_not_take_off_is_disarmed():
    bench = Bench("px4").advance(6.0)
    bench.arm()
    assert bench.until(lambda: not bench.standin.armed, 12.0) > 9.0


def test_integer_parameters_travel_as_bit_patterns():
    bench = Bench("px4").advance(1.0)
    bench.standin.deliver(mav.MAVLink_param_request_read_message(1, 1, b"COM_OBL_RC_ACT", -1))
    assert bench.last("PARAM_VALUE").param_type == mav.MAV_PARAM_TYPE_INT32
    bits = 7.006492321624085e-45  # five
    bench.standin.deliver(mav.MAVLink_param_set_message(1, 1, b"COM_OBL_RC_ACT", bits, mav.MAV_PARAM_TYPE_INT32))
    assert bench.last("PARAM_VALUE").param_value == bits
    assert bench.standin.pilot.parameters["COM_OBL_RC_ACT"] == 5
    bench.forget()
    bench.standin.deliver(mav.MAVLink_param_set_message(1, 1, b"COM_OBL_RC_ACT", 5.0, mav.MAV_PARAM_TYPE_REAL32))
    assert not bench.all("PARAM_VALUE")
    bench.standin.deliver(mav.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 3.0, mav.MAV_PARAM_TYPE_REAL32))
    assert bench.standin.pilot.parameters["COM_OF_LOSS_T"] == 3.0


def test_a_lost_estimate_lands_it():
    bench = px4_flying()
    bench.standin.faults.estimate_lost = True
    bench.stream(2.0, position=(0.0, 0.0, -5.0))
    assert bench.custom_mode == LAND
    assert bench.last("HEARTBEAT").system_status == mav.MAV_STATE_CRITICAL


def test_a_rover_takes_positions_and_velocities():
    bench = Bench("px4", flies=False).advance(6.0).stream(1.5, position=(0.0, 0.0, 0.0))
    assert bench.last("HEARTBEAT").type == mav.MAV_TYPE_GROUND_ROVER
    bench.set_mode(6)
    assert bench.arm() == [0]
    bench.stream(15.0, position=(4.0, 3.0, 0.0))
    assert bench.position[0] == pytest.approx(4.0, abs=0.3)
    assert bench.position[1] == pytest.approx(3.0, abs=0.3)
    bench.stream(5.0, mask=VELOCITY, velocity=(-1.0, 0.0, 0.0))
    assert bench.position[0] < 2.0
