"""The link to a vehicle against a small autopilot on loopback: telemetry, setpoints, losses, preflight."""

import struct
import threading
import time

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.link import LinkError, Mode, Setpoint, VehicleLink
from swarmsim.autopilot.mavlink import MavlinkVehicle
from swarmsim.autopilot.mavlink.decode import Heard, hear, telemetry_of
from swarmsim.autopilot.mavlink.profile import detect_profile
from swarmsim.autopilot.mavlink.vehicle import moves
from swarmsim.config.errors import InputError
from tests.autopilot import test_mavlink_peer as peers
from tests.autopilot.ports import free_port
from tests.autopilot.test_mavlink_peer import ARDUPILOT, COPTER, LOITER, OFFBOARD, POSITION, PX4, ROVER, eventually

SET_MODE, ARM, TAKEOFF = 176, 400, 22


def flying(vehicle: VehicleLink) -> VehicleLink:
    """For mypy and for readers: a `MavlinkVehicle` is a `VehicleLink`."""
    return vehicle


@pytest.mark.parametrize(
    ("autopilot", "kind", "names"),
    [
        (PX4, COPTER, ("px4", "copter")),
        (PX4, ROVER, ("px4", "rover")),
        (ARDUPILOT, COPTER, ("ardupilot", "copter")),
        (ARDUPILOT, ROVER, ("ardupilot", "rover")),
    ],
)
def test_the_vehicle_is_found(linked, autopilot, kind, names):
    peer, vehicle = linked({"autopilot": autopilot, "kind": kind})
    known = flying(vehicle).identity
    assert (known.autopilot, known.vehicle) == names
    assert vehicle.streams_first == (autopilot == PX4)
    assert (known.system, known.component, known.version) == (7, 1, "1.17.1")
    asked = peer.commands(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL)
    assert eventually(lambda: (32, 20_000) in {(m.param1, m.param2) for m in asked + peer.commands(511)})
    assert eventually(lambda: peer.of("HEARTBEAT"))
    heartbeat = peer.of("HEARTBEAT")[0]
    assert (heartbeat.type, heartbeat.autopilot, heartbeat.get_srcSystem()) == (18, 8, 245)


def test_another_vehicle_than_expected_is_refused():
    port = free_port()
    with (
        peers.peer_on(port, autopilot=ARDUPILOT, kind=ROVER),
        pytest.raises(LinkError, match="is ardupilot rover, not px4 copter"),
    ):
        MavlinkVehicle(f"udpin:127.0.0.1:{port}", autopilot="px4", vehicle="copter", system=7)


def test_a_vehicle_of_an_unknown_kind_is_refused():
    port = free_port()
    with peers.peer_on(port, kind=1), pytest.raises(LinkError, match="MAV_TYPE 1"):
        MavlinkVehicle(f"udpin:127.0.0.1:{port}", system=7)


def test_a_silent_port():
    with pytest.raises(LinkError, match="nothing at all"):
        MavlinkVehicle(f"udpin:127.0.0.1:{free_port()}", timeout_s=0.2)


def test_the_wrong_system():
    port = free_port()
    with peers.peer_on(port), pytest.raises(LinkError, match="heard: system 7 component 1"):
        MavlinkVehicle(f"udpin:127.0.0.1:{port}", system=3, timeout_s=0.5)


def test_two_vehicles_on_one_port_must_be_told_apart():
    port = free_port()
    with (
        peers.peer_on(port, system=1),
        peers.peer_on(port, system=2),
        pytest.raises(LinkError, match=r"systems (1, 2|2, 1)"),
    ):
        MavlinkVehicle(f"udpin:127.0.0.1:{port}")


def test_what_others_say_is_not_heard(linked):
    peer, vehicle = linked()
    with peers.peer_on(peer.address[1], system=8) as other, peers.peer_on(peer.address[1], system=7) as twin:
        for one in (other, twin):
            one.position, one.custom_mode = [500.0, 500.0, 500.0], POSITION
        assert eventually(lambda: vehicle.statistics.foreign > 50)
        assert vehicle.telemetry().position_m == pytest.approx((-2.0, 1.0, -0.5))
        assert vehicle.telemetry().mode is Mode.HOLD
    assert vehicle.statistics.lost == 0


def test_a_wrong_link_string(tmp_path):
    with pytest.raises(InputError, match="no link"):
        MavlinkVehicle("udp:14540")
    with pytest.raises(InputError, match="key cannot be read"):
        MavlinkVehicle("udpin:14540", key_file=tmp_path / "none")


def test_telemetry_in_the_world(linked):
    peer, vehicle = linked()
    assert eventually(lambda: None not in (vehicle.telemetry().velocity_m_s, vehicle.telemetry().quaternion))
    told = vehicle.telemetry()
    assert told.position_m == pytest.approx((-2.0, 1.0, -0.5))
    assert told.velocity_m_s == pytest.approx((0.2, 0.1, -0.3))
    assert told.angular_velocity_rad_s == pytest.approx((0.01, -0.02, -0.03))
    np.testing.assert_allclose(np.abs(told.quaternion), [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], atol=1e-7)
    vehicle.align((100.0, 50.0, 5.0))
    assert vehicle.telemetry().position_m == pytest.approx((100.0, 50.0, 5.0))
    peer.position = [2.0, -2.0, -0.5]
    assert eventually(lambda: vehicle.telemetry().position_m == pytest.approx((100.0, 51.0, 6.0)))
    assert eventually(lambda: vehicle.telemetry().gnss_fix == 3 and vehicle.telemetry().estimate_ok)
    assert eventually(lambda: (vehicle.telemetry().battery, vehicle.telemetry().on_ground) == (0.8, True))


def test_numbers_that_are_not_finite_are_not_taken(linked):
    peer, vehicle = linked()
    good = vehicle.telemetry().position_m
    peer.position = [float("nan"), 0.0, float("inf")]
    time.sleep(0.2)
    assert vehicle.telemetry().position_m == good


def test_align_needs_a_position(linked):
    peer, vehicle = linked()
    peer.deaf = {"LOCAL_POSITION_NED"}
    with pytest.raises(LinkError, match="align"):
        vehicle.send(Setpoint((1.0, 2.0, 3.0)))
    time.sleep(2.1)
    with pytest.raises(LinkError, match="no position"):
        vehicle.align((0.0, 0.0, 0.0))


@pytest.mark.parametrize("deaf", [set(), {"LOCAL_POSITION_NED"}])
def test_a_restart_voids_the_alignment(linked, deaf):
    peer, vehicle = linked()
    vehicle.align((100.0, 50.0, 5.0))
    vehicle.send(Setpoint((1.0, 2.0, 3.0)))
    peer.deaf = deaf  # after a restart no position comes at first
    peer.boot_ms = 0
    assert eventually(lambda: any("restarted" in text for text in vehicle.messages()))
    with pytest.raises(LinkError, match="align"):
        vehicle.send(Setpoint((1.0, 2.0, 3.0)))
    time.sleep(0.2)
    assert vehicle.telemetry().position_m is None  # of a new origin it would be another place
    peer.deaf = set()
    assert eventually(lambda: vehicle._heard.position_ned_m is not None)
    vehicle.align((100.0, 50.0, 5.0))
    assert vehicle.telemetry().position_m == pytest.approx((100.0, 50.0, 5.0))


def test_setpoints_arrive(linked):
    peer, vehicle = linked()
    vehicle.align((100.0, 50.0, 5.0))
    vehicle.send(Setpoint((110.0, 70.0, 8.0), (1.0, 2.0, 3.0), yaw_rad=0.0))
    assert eventually(lambda: peer.of("SET_POSITION_TARGET_LOCAL_NED"))
    m = peer.of("SET_POSITION_TARGET_LOCAL_NED")[0]
    assert (m.x, m.y, m.z) == pytest.approx((21.0, 8.0, -2.5))
    assert (m.vx, m.vy, m.vz) == pytest.approx((2.0, 1.0, -3.0))
    assert m.yaw == pytest.approx(np.pi / 2)
    assert (m.target_system, m.target_component, m.coordinate_frame) == (7, 1, 1)


def test_nothing_of_a_bad_setpoint_is_sent(linked):
    peer, vehicle = linked()
    vehicle.align((0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="not finite"):
        vehicle.send(Setpoint((1.0, float("nan"), 3.0)))
    time.sleep(0.1)
    assert not peer.of("SET_POSITION_TARGET_LOCAL_NED")


def test_a_mode_change_is_told_at_once_in_the_reader_thread(linked):
    peer, vehicle = linked()
    told: list = []
    vehicle.on_mode(lambda telemetry: told.append((telemetry, time.monotonic(), threading.current_thread().name)))
    before = time.monotonic()
    peer.custom_mode = POSITION
    assert eventually(lambda: told)
    telemetry, at, thread = told[0]
    assert (telemetry.mode, telemetry.mode_name) == (Mode.OTHER, "POSCTL")
    assert at - before < 0.1
    assert thread.startswith("mavlink-read")
    peer.armed = True
    peer.status = mavlink.MAV_STATE_CRITICAL
    assert eventually(lambda: told[-1][0].armed and told[-1][0].failsafe)


def test_a_failing_listener_does_not_end_the_link(linked):
    peer, vehicle = linked()

    def fail(telemetry) -> None:
        raise RuntimeError("a listener's fault")

    told: list = []
    vehicle.on_mode(fail)
    vehicle.on_mode(told.append)
    peer.custom_mode = POSITION
    assert eventually(lambda: vehicle.statistics.errors == 1)
    assert [telemetry.mode_name for telemetry in told] == ["POSCTL"]
    peer.custom_mode = LOITER
    assert eventually(lambda: vehicle.telemetry().mode is Mode.HOLD)


def test_request_does_not_wait(linked):
    peer, vehicle = linked()
    peer.obeys = set()
    begin = time.monotonic()
    vehicle.request(Mode.LAND)
    assert time.monotonic() - begin < 0.05
    assert eventually(lambda: [m for m in peer.commands(SET_MODE) if (m.param2, m.param3) == (4, 6)])


def test_a_dry_run_sends_nothing_that_moves(linked):
    peer, vehicle = linked(wanted={"dry": True})
    vehicle.preflight(lambda text: None, 5.0)
    vehicle.align((0.0, 0.0, 0.0))
    vehicle.send(Setpoint((0.0, 0.0, 3.0)))
    vehicle.follow(1.0)
    vehicle.arm(1.0)
    vehicle.take_off(3.0, 1.0)
    vehicle.enter(Mode.HOLD, 1.0)
    vehicle.request(Mode.LAND)
    with pytest.raises(ValueError, match="not finite"):
        vehicle.send(Setpoint((float("nan"), 0.0, 3.0)))
    time.sleep(0.2)
    assert not [m for m in peer.heard if moves(m) and m.get_type() != "HEARTBEAT"]
    assert vehicle.withheld == 4  # a setpoint, and three copies of the request
    assert any("dry run" in text for text in vehicle.messages())


def test_what_moves():
    assert moves(mavlink.MAVLink_manual_control_message(1, 0, 0, 0, 0, 0))
    assert moves(mavlink.MAVLink_command_long_message(1, 1, ARM, 0, *[0.0] * 7))
    assert moves(mavlink.MAVLink_param_set_message(1, 1, b"X", 0.0, 9))
    assert not moves(mavlink.MAVLink_command_long_message(1, 1, 511, 0, *[0.0] * 7))


def test_messages_are_asked_for_again_while_they_do_not_come(linked):
    peer, _ = linked()
    peer.deaf = {"LOCAL_POSITION_NED"}
    count = len([m for m in peer.commands(511) if m.param1 == 32])
    assert eventually(lambda: len([m for m in peer.commands(511) if m.param1 == 32]) > count, 5.0)


def test_words_are_collected_and_put_together(linked):
    peer, vehicle = linked()
    peer.say("short")
    long = "a statement that is longer than fifty characters, so that it comes in two parts"
    for number, part in enumerate((long[:50], long[50:])):
        peer.send(mavlink.MAVLink_statustext_message(6, part.encode(), 3, number))
    told: list[str] = []
    assert eventually(lambda: told.extend(vehicle.messages()) or long in told)
    assert "short" in told
    assert vehicle.messages() == []


def test_preflight_passes_and_tells(linked):
    peer, vehicle = linked()
    bits = struct.unpack("<f", struct.pack("<i", 3))[0]  # PX4 sends integers as bit patterns
    peer.parameters = {
        "COM_OF_LOSS_T": (5.0, 9),
        "COM_LOW_BAT_ACT": (struct.unpack("<f", struct.pack("<i", 0))[0], 6),
        "GF_ACTION": (bits, 6),
        "NAV_DLL_ACT": (struct.unpack("<f", struct.pack("<i", -1))[0], 6),  # no number, taken as a float
    }
    told: list[str] = []
    vehicle.preflight(told.append, 10.0)
    assert any(text.startswith("warning: COM_OF_LOSS_T = 5") for text in told)
    assert any(text.startswith("warning: COM_LOW_BAT_ACT = 0") for text in told)
    assert any(text.startswith("GF_ACTION = 3:") for text in told)
    assert any(text.startswith("NAV_DLL_ACT = -1:") for text in told)
    assert any(text.startswith("estimate: ok") for text in told)


def test_a_px4_that_stands_in_offboard_after_a_flight_can_be_flown_again(linked):
    peer, vehicle = linked()
    peer.custom_mode = OFFBOARD
    assert eventually(lambda: vehicle.telemetry().mode is Mode.FOLLOW and vehicle.telemetry().ready_to_arm is False)
    told: list[str] = []
    vehicle.preflight(told.append, 10.0)
    assert peer.custom_mode == LOITER
    assert any("OFFBOARD since an earlier flight" in text for text in told)


def test_preflight_gives_every_reason(linked):
    peer, vehicle = linked({"autopilot": ARDUPILOT})
    peer.parameters = {"FRAME_CLASS": (0.0, 2), "GUID_TIMEOUT": (3.0, 9)}
    peer.flags, peer.fix, peer.battery, peer.ready = 0x400, 1, 5, False
    peer.status, peer.ill = mavlink.MAV_STATE_CRITICAL, mavlink.MAV_SYS_STATUS_SENSOR_GPS
    time.sleep(0.1)
    peer.say("PreArm: Battery 1 low voltage failsafe")
    told: list[str] = []
    timer = threading.Timer(0.5, peer.say, ["PreArm: GPS 1: Bad fix"])
    timer.start()
    with pytest.raises(LinkError) as caught:
        vehicle.preflight(told.append, 1.0)
    timer.join()
    for word in (
        "lacks attitude",
        "fix type 1",
        "5% left",
        "not healthy: gps",
        "failsafe is active",
        "FRAME_CLASS = 0",
        "Bad fix",
    ):
        assert word in str(caught.value)
    assert any("FS_GCS_ENABLE" in text or "ARMING_CHECK was not told" in text for text in told)


def test_a_link_that_is_lost_in_preflight_is_told_once(linked):
    peer, vehicle = linked()
    peer.close()
    told: list[str] = []
    with pytest.raises(LinkError, match="no heartbeat comes any more"):
        vehicle.preflight(told.append, 9.0)
    assert sum(text.startswith("link: no heartbeat") for text in told) == 1


def test_the_estimators_lacks_and_errors_are_told_apart(linked):
    peer, vehicle = linked({"autopilot": ARDUPILOT})
    peer.flags = 0xA7
    assert eventually(lambda: vehicle.telemetry().estimate_ok is False)
    with pytest.raises(LinkError, match=r"lacks absolute position and reports an error \(flags 0xa7\)"):
        vehicle.preflight(lambda _: None, 0.5)


def test_close_twice_and_the_log(linked, tmp_path):
    log = tmp_path / "logs" / "flight.tlog"
    peer, vehicle = linked(wanted={"log": log})
    vehicle.align((0.0, 0.0, 0.0))
    vehicle.send(Setpoint((0.0, 0.0, 3.0)))
    assert eventually(lambda: peer.of("HEARTBEAT"))
    vehicle.close()
    vehicle.close()
    vehicle.send(Setpoint((0.0, 0.0, 3.0)))  # unsent, no error
    data, kinds, times = log.read_bytes(), set(), []
    while data:
        (microseconds,) = struct.unpack_from(">Q", data)
        times.append(microseconds)
        length = 12 + data[9] + (13 if data[10] & 1 else 0)
        message = mavlink.MAVLink(None).parse_buffer(data[8 : 8 + length])[0]
        kinds.add((message.get_srcSystem(), message.get_type()))
        data = data[8 + length :]
    assert {(7, "HEARTBEAT"), (245, "HEARTBEAT"), (245, "SET_POSITION_TARGET_LOCAL_NED")} <= kinds
    assert abs(times[0] / 1e6 - time.time()) < 60.0


def test_a_state_from_before_the_link_was_lost_confirms_nothing(linked):
    peer, vehicle = linked()
    peer.close()
    with pytest.raises(LinkError, match="did not hold"):
        vehicle.enter(Mode.HOLD, 0.3)  # its last heartbeat said HOLD


def test_its_place_on_the_earth_is_told_from_the_first_fix_on():
    profile = detect_profile(12, 2)
    nothing = mavlink.MAVLink_global_position_int_message(1000, 0, 0, 488_000, 0, 0, 0, 0, 0)
    assert hear(Heard(), nothing, profile, 0.0).place is None
    fix = mavlink.MAVLink_global_position_int_message(1000, 473977420, 85455940, 488_250, 0, 0, 0, 0, 0)
    place = telemetry_of(hear(Heard(), fix, profile, 0.0), None).place
    assert (place.latitude_deg, place.longitude_deg, place.altitude_m) == pytest.approx((47.397742, 8.545594, 488.25))
