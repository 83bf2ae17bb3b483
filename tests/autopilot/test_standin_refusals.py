"""The stand-in at what autopilots leave undone: setpoints that say nothing, fences, lost stations, other systems."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from tests.autopilot.standins import BODY, POSITION, VELOCITY, Bench, ardupilot_flying, px4_flying, px4_mode

GUIDED, RTL, LAND = 4, 6, 9
POSCTL = px4_mode(3)
NONE = (math.nan, math.nan, math.nan)


def beat(bench: Bench) -> None:
    bench.standin.deliver(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))


def told(bench: Bench) -> str:
    return " | ".join(message.text for message in bench.all("STATUSTEXT"))


def fenced(*, flies: bool = True) -> Bench:
    bench = ardupilot_flying() if flies else Bench("ardupilot", flies=False).advance(6.0)
    bench.standin.pilot.parameters.put("FENCE_ENABLE", 1)
    bench.standin.pilot.parameters.put("FENCE_RADIUS", 20.0)
    return bench


@pytest.mark.parametrize(
    "setpoint",
    [
        {"mask": 0xFFF},
        {"mask": 0xDFF},  # without the bit that asks for a force
        {"mask": 0x9FF, "yaw": 1.0},  # a heading alone
        {"mask": POSITION, "frame": BODY, "position": (5.0, 0.0, 0.0)},
        {"mask": POSITION, "position": NONE},
        {"mask": 0xE3F, "position": NONE, "velocity": NONE},
    ],
)
def test_what_commands_nothing_does_not_keep_px4_in_offboard(setpoint):
    assert px4_flying().stream(4.0, **setpoint).custom_mode == POSCTL


@pytest.mark.parametrize("mode", [5, 6])
def test_px4_cannot_be_armed_in_return_and_land(mode):
    bench = Bench("px4").advance(6.0)
    bench.set_mode(4, mode)
    assert bench.arm() == [mav.MAV_RESULT_TEMPORARILY_REJECTED]
    assert bench.advance(1.0).custom_mode == px4_mode(4, mode)


@pytest.mark.parametrize(("autopilot", "bytewise"), [("px4", True), ("ardupilot", False)])
def test_it_tells_how_parameters_travel(autopilot, bytewise):
    bench = Bench(autopilot).advance(1.0)
    bench.command(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    assert bool(bench.last("AUTOPILOT_VERSION").capabilities & 16) == bytewise


def test_no_command_leads_out_of_the_fence():
    bench = fenced()
    there = bench.standin.pilot.place()
    place = (there.latitude_deg + 60.0 / 111_320.0, there.longitude_deg, there.altitude_m)
    assert bench.command(mav.MAV_CMD_DO_REPOSITION, -1, 1, 0, math.nan, *place) == [mav.MAV_RESULT_FAILED]
    assert abs(bench.advance(10.0).position[0]) < 0.3


def test_the_fence_holds_a_rover_too():
    bench = fenced(flies=False)
    bench.set_mode(15)
    bench.arm()
    bench.stream(40.0, hz=5.0, mask=VELOCITY, velocity=(2.0, 0.0, 0.0))
    assert 16.0 < math.hypot(*bench.position[:2]) <= 18.1


def test_refused_positions_do_not_keep_a_velocity_alive():
    bench = fenced()
    bench.setpoint(mask=VELOCITY, velocity=(1.0, 0.0, 0.0))
    bench.stream(10.0, hz=5.0, position=(60.0, 0.0, -5.0))
    assert bench.position[0] < 5.0


def test_numbers_that_are_to_be_ignored_may_be_none():
    bench = ardupilot_flying()
    bench.standin.deliver(
        mav.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, POSITION, 8.0, 0.0, -5.0, *NONE, *NONE, 0.0, 0.0)
    )
    assert bench.advance(10.0).position[0] == pytest.approx(8.0, abs=0.3)


def test_after_a_lost_station_it_is_not_armed_again():
    bench = ardupilot_flying()
    bench.standin.pilot.parameters.put("FS_GCS_ENABLE", 1)
    beat(bench)
    bench.until(lambda: not bench.standin.armed, 120.0)
    bench.set_mode(GUIDED)
    assert bench.arm() == [mav.MAV_RESULT_FAILED]
    assert "GCS failsafe on" in told(bench)
    beat(bench)
    assert "GCS Failsafe Cleared" in told(bench.advance(0.2))
    assert bench.arm() == [0]


def test_a_station_that_is_lost_already_counts_when_its_failsafe_is_enabled():
    bench = ardupilot_flying()
    beat(bench)
    bench.advance(8.0)
    assert "GCS" not in told(bench)
    bench.standin.pilot.parameters.put("FS_GCS_ENABLE", 1)
    assert bench.advance(1.1).custom_mode == RTL


def test_a_station_that_pauses_is_no_failsafe_where_there_is_none():
    bench = ardupilot_flying()
    beat(bench)
    bench.advance(7.0)
    beat(bench)
    assert "GCS" not in told(bench.advance(0.5))


def test_a_failed_estimate_stays_critical_when_the_station_is_heard():
    bench = ardupilot_flying()
    bench.standin.faults.estimate_lost = True
    bench.advance(0.2)
    beat(bench)
    bench.forget()
    assert bench.advance(1.1).last("HEARTBEAT").system_status == mav.MAV_STATE_CRITICAL


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_a_companion_computer_of_the_same_system_is_heard(autopilot):
    bench = Bench(autopilot).advance(1.0)
    request = mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION
    assert bench.command(*request, system=1, component=191) == [0]
    assert bench.command(*request, system=1, component=1) == []  # its own words


@pytest.mark.parametrize(
    ("autopilot", "mode", "told_as"), [("ardupilot", GUIDED, 11), ("px4", POSCTL, mav.MAV_CMD_DO_SET_MODE)]
)
def test_the_message_that_sets_a_mode_is_acknowledged_once(autopilot, mode, told_as):
    """PX4 1.17 was seen to answer so, ArduPilot's code does."""
    bench = Bench(autopilot).advance(6.0)
    bench.standin.deliver(mav.MAVLink_set_mode_message(1, 1, mode))
    assert [(answer.command, answer.result) for answer in bench.all("COMMAND_ACK")] == [(told_as, 0)]
    assert bench.advance(1.1).custom_mode == mode


def test_intervals_of_what_is_not_and_of_what_never_comes():
    bench = Bench("px4").advance(1.0)
    get = mav.MAV_CMD_GET_MESSAGE_INTERVAL
    assert bench.command(get, 9999) == [0]
    assert bench.last("MESSAGE_INTERVAL").interval_us == 0
    attitude = mav.MAVLINK_MSG_ID_ATTITUDE
    assert bench.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, attitude, 1e12) == [0]
    assert bench.command(get, attitude) == [0]
    assert bench.last("MESSAGE_INTERVAL").interval_us == 2**31 - 1
