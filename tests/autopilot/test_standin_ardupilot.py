"""The stand-in as ArduPilot: each point of the reference at which a companion computer may fail."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from tests.autopilot.standins import (
    BODY_OFFSET,
    OFFSET,
    POSITION,
    VELOCITY,
    Bench,
    ardupilot_flying,
)

STABILIZE, GUIDED, RTL, LAND = 0, 4, 6, 9


def beat(bench: Bench, system: int = 255) -> None:
    bench.standin.deliver(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), system=system)


def texts(bench: Bench) -> str:
    return " | ".join(message.text for message in bench.all("STATUSTEXT"))


def test_it_sends_heartbeats_alone_until_it_is_asked():
    bench = Bench("ardupilot").advance(8.0)
    assert {message.get_type() for _, message in bench.heard} == {"HEARTBEAT"}
    bench.telemetry("LOCAL_POSITION_NED", "EKF_STATUS_REPORT", hz=10.0)
    bench.advance(2.0)
    assert 18 <= len(bench.all("LOCAL_POSITION_NED")) <= 22
    bench.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED, -1)
    bench.forget()
    assert not bench.advance(1.0).all("LOCAL_POSITION_NED")


def test_ready_is_the_ekf_flag_and_the_prearm_bit():
    bench = Bench("ardupilot")
    bench.telemetry("SYS_STATUS", "EKF_STATUS_REPORT")
    bench.advance(1.0)
    assert not bench.last("EKF_STATUS_REPORT").flags & 0x10
    assert not bench.last("SYS_STATUS").onboard_control_sensors_health & mav.MAV_SYS_STATUS_PREARM_CHECK
    assert bench.set_mode(GUIDED) == [mav.MAV_RESULT_FAILED]
    assert bench.arm() == [mav.MAV_RESULT_FAILED]
    assert bench.command(mav.MAV_CMD_RUN_PREARM_CHECKS) == [0]
    assert "PreArm: AHRS" in texts(bench)
    bench.advance(5.0)
    assert bench.last("EKF_STATUS_REPORT").flags & 0x10
    assert bench.last("SYS_STATUS").onboard_control_sensors_health & mav.MAV_SYS_STATUS_PREARM_CHECK
    assert bench.set_mode(GUIDED) == [0]
    assert bench.arm() == [0]


def test_take_off_is_refused_while_disarmed():
    bench = Bench("ardupilot").advance(6.0)
    bench.set_mode(GUIDED)
    assert bench.command(mav.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 5.0) == [mav.MAV_RESULT_FAILED]


def test_a_setpoint_before_take_off_does_not_lift_it():
    bench = Bench("ardupilot").advance(6.0)
    bench.set_mode(GUIDED)
    bench.arm()
    bench.stream(5.0, position=(0.0, 0.0, -10.0))
    assert bench.height == pytest.approx(0.0, abs=0.01)


def test_disarming_in_the_air_is_refused_unless_forced():
    bench = ardupilot_flying()
    assert bench.arm(0) == [mav.MAV_RESULT_FAILED]
    assert bench.standin.armed
    assert bench.arm(0, 21196.0) == [0]
    bench.advance(5.0)
    assert bench.height == pytest.approx(0.0, abs=0.1)


def test_one_position_message_is_enough():
    bench = ardupilot_flying()
    bench.setpoint(POSITION, position=(10.0, -5.0, -8.0))
    bench.advance(15.0)
    assert bench.position == pytest.approx((10.0, -5.0, -8.0), abs=0.3)
    assert bench.custom_mode == GUIDED


@pytest.mark.parametrize("axis", [0x1, 0x2, 0x4])
def test_a_position_needs_all_three_axes(axis):
    bench = ardupilot_flying()
    bench.setpoint(POSITION | axis, position=(10.0, 10.0, -10.0))
    bench.advance(5.0)
    assert bench.position == pytest.approx((0.0, 0.0, -5.0), abs=0.4)


def test_a_velocity_times_out_after_three_seconds_and_it_stays_in_guided():
    bench = ardupilot_flying()
    bench.setpoint(VELOCITY, velocity=(2.0, 0.0, 0.0))
    bench.advance(2.9)
    assert 4.5 < bench.position[0] < 6.0
    bench.advance(2.0)
    there = bench.position[0]
    assert bench.advance(5.0).position[0] == pytest.approx(there, abs=0.3)
    assert bench.custom_mode == GUIDED


@pytest.mark.parametrize("frame", [OFFSET, BODY_OFFSET])
def test_offset_frames_move_it(frame):
    bench = ardupilot_flying()  # heads east
    bench.setpoint(POSITION, position=(6.0, 0.0, -8.0))
    bench.advance(12.0)
    here = bench.position
    bench.setpoint(POSITION, frame=frame, position=(4.0, 0.0, 0.0))
    bench.advance(12.0)
    moved = (here[0] + 4.0, here[1], here[2]) if frame == OFFSET else (here[0], here[1] + 4.0, here[2])
    assert bench.position == pytest.approx(moved, abs=0.4)


@pytest.mark.parametrize(
    "setpoint",
    [
        {"mask": VELOCITY, "frame": 2, "velocity": (3.0, 0.0, 0.0)},
        {"mask": 3576 & ~0x1C0, "position": (50.0, 0.0, -5.0)},
        {"mask": 0xFFF},
    ],
    ids=["frame", "position and acceleration without velocity", "ignore all"],
)
def test_what_it_does_not_understand_stops_it(setpoint):
    bench = ardupilot_flying()
    bench.setpoint(VELOCITY, velocity=(3.0, 0.0, 0.0))
    bench.advance(1.0)
    bench.setpoint(**setpoint)
    bench.advance(2.0)
    there = bench.position
    bench.advance(1.0)
    assert math.dist(bench.position, there) < 0.2
    assert there[0] < 6.0


def test_a_position_that_is_no_number_kills_it():
    bench = ardupilot_flying()
    bench.setpoint(POSITION, position=(math.nan, 0.0, -5.0))
    assert bench.standin.exit_code == 136
    assert "floating point exception" in bench.standin.pilot.log
    bench.forget()
    assert not bench.advance(2.0).heard


def test_gcs_failsafe_returns_and_stays_though_setpoints_go_on():
    bench = ardupilot_flying()
    bench.standin.deliver(mav.MAVLink_param_set_message(1, 1, b"FS_GCS_ENABLE", 1.0, 6))
    bench.standin.deliver(mav.MAVLink_param_set_message(1, 1, b"SYSID_MYGCS", 245.0, 6))
    for _ in range(5):
        beat(bench, 245)
        bench.stream(1.0, position=(20.0, 0.0, -5.0))
    assert bench.custom_mode == GUIDED
    bench.stream(4.5, position=(20.0, 0.0, -5.0))
    assert bench.custom_mode == GUIDED
    bench.stream(2.0, position=(20.0, 0.0, -5.0))
    assert bench.custom_mode == RTL
    assert "GCS Failsafe" in texts(bench)
    beat(bench, 245)
    bench.stream(2.0, position=(20.0, 0.0, -5.0))
    assert bench.custom_mode == RTL
    beat(bench, 245)
    assert bench.set_mode(GUIDED) == [0]


def test_a_position_that_is_no_number_does_no_harm_outside_of_guided():
    bench = ardupilot_flying()
    bench.standin.operator_mode("LOITER")
    bench.setpoint(POSITION, position=(math.nan, 0.0, -5.0))
    assert bench.standin.exit_code is None


def test_gcs_failsafe_of_a_rover_holds():
    bench = Bench("ardupilot", flies=False).advance(6.0)
    bench.standin.pilot.parameters.put("FS_GCS_ENABLE", 1)
    bench.set_mode(15)
    bench.arm()
    beat(bench)
    bench.stream(6.0, position=(20.0, 0.0, 0.0))
    assert bench.advance(1.1).custom_mode == 4
    here = bench.position
    assert bench.stream(2.0, position=(20.0, 0.0, 0.0)).position == pytest.approx(here, abs=0.2)


def test_gcs_failsafe_is_off_by_default():
    bench = ardupilot_flying()
    beat(bench)
    assert bench.advance(12.0).custom_mode == GUIDED


def test_circle_fence():
    bench = ardupilot_flying()
    parameters = bench.standin.pilot.parameters
    parameters.put("FENCE_ENABLE", 1)
    parameters.put("FENCE_RADIUS", 20.0)
    bench.setpoint(POSITION, position=(60.0, 0.0, -5.0))
    bench.advance(5.0)
    assert abs(bench.position[0]) < 0.3
    bench.stream(20.0, mask=VELOCITY, velocity=(4.0, 0.0, 0.0))
    assert bench.position[0] == pytest.approx(17.65, abs=0.6)


def test_return_waits_above_home_lands_and_disarms():
    bench = ardupilot_flying()
    bench.setpoint(POSITION, position=(15.0, 0.0, -5.0))
    bench.advance(12.0)
    assert bench.set_mode(RTL) == [0]
    bench.until(lambda: not bench.standin.armed, 120.0)
    assert math.hypot(*bench.position[:2]) < 0.5
    assert "Disarming" in texts(bench)


def test_land_disarms_at_touchdown_and_no_later_than_that():
    bench = ardupilot_flying()
    bench.set_mode(LAND)
    bench.until(lambda: not bench.standin.armed, 30.0)
    assert bench.height == pytest.approx(0.0, abs=0.05)
    assert bench.arm() == [mav.MAV_RESULT_FAILED]  # in LAND


def test_an_armed_vehicle_that_does_not_take_off_is_disarmed():
    bench = Bench("ardupilot").advance(6.0)
    bench.set_mode(GUIDED)
    bench.arm()
    assert 9.0 < bench.until(lambda: not bench.standin.armed, 12.0) < 11.0


def test_the_mode_that_the_operator_chooses_ends_following():
    bench = ardupilot_flying()
    bench.standin.operator_mode("LOITER")
    bench.stream(4.0, position=(30.0, 0.0, -5.0))
    assert abs(bench.position[0]) < 0.5
    with pytest.raises(ValueError, match="GUIDED"):
        bench.standin.operator_mode("OFFBOARD")


@pytest.mark.parametrize("fault", ["estimate_lost", "gnss_lost"])
def test_a_lost_estimate_lands_it(fault):
    bench = ardupilot_flying()
    bench.telemetry("GPS_RAW_INT", "EKF_STATUS_REPORT")
    setattr(bench.standin.faults, fault, True)
    bench.advance(2.0)
    assert (bench.last("GPS_RAW_INT").fix_type < 3) == (fault == "gnss_lost")
    bench.advance(5.0)
    assert bench.custom_mode == LAND
    assert not bench.last("EKF_STATUS_REPORT").flags & 0x10
    assert "EKF Failsafe" in texts(bench)


def test_motors_that_stop_in_the_air_let_it_fall():
    bench = ardupilot_flying()
    bench.standin.disarm_unexpectedly()
    bench.advance(3.0)
    assert not bench.last("HEARTBEAT").base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED
    assert bench.height == pytest.approx(0.0, abs=0.1)
    assert bench.arm() == [mav.MAV_RESULT_FAILED]  # it has crashed


def test_parameters_travel_by_value():
    bench = Bench("ardupilot").advance(1.0)
    bench.standin.deliver(mav.MAVLink_param_request_list_message(1, 1))
    answers = bench.all("PARAM_VALUE")
    assert len(answers) == answers[0].param_count
    assert {answer.param_index for answer in answers} == set(range(len(answers)))
    assert next(a for a in answers if a.param_id == "SYSID_MYGCS").param_value == 255.0


def test_a_rover_is_driven_in_guided_and_tells_that_its_target_is_old():
    bench = Bench("ardupilot", flies=False).advance(6.0)
    assert bench.set_mode(15) == [0]
    assert bench.arm() == [0]
    bench.stream(3.0, mask=0xDC7 & ~0x800, frame=BODY_OFFSET, velocity=(1.0, 0.0, 0.0), rate=0.3)
    assert bench.standin.body.sensed.angular_velocity_rad_s[2] == pytest.approx(-0.3, abs=0.05)  # counter-clockwise
    bench.advance(4.0)
    assert "target not received" in texts(bench)
    assert bench.custom_mode == 15
    assert bench.set_mode(11) == [0]
    bench.advance(30.0)
    assert math.hypot(*bench.position[:2]) < 0.7
