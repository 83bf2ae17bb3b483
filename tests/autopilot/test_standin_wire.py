"""The stand-in on the wire: requests, links, faults of the link, and bytes that nobody should send."""

import math
import random
import socket
import struct
import time
from contextlib import closing

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav

from swarmsim.autopilot.standin.kinematic import KinematicBody
from swarmsim.autopilot.standin.settings import load_settings
from swarmsim.autopilot.standin.sockets import CLIENTS_MAX, open_link
from swarmsim.autopilot.standin.vehicle import Standin
from swarmsim.config.errors import InputError
from tests.autopilot.standins import POSITION, Bench, ardupilot_flying, px4_flying

KINDS = ("px4", "ardupilot")


@pytest.mark.parametrize("kind", KINDS)
class TestRequests:
    def test_version_home_and_origin_on_request(self, kind):
        bench = Bench(kind).advance(6.0)
        for number in (mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION, mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN):
            assert bench.command(mav.MAV_CMD_REQUEST_MESSAGE, number) == [0]
        assert bench.last("AUTOPILOT_VERSION").flight_sw_version >> 24 == load_settings(kind).version[0]
        assert bench.command(mav.MAV_CMD_GET_HOME_POSITION) == [0]
        home, origin = bench.last("HOME_POSITION"), bench.last("GPS_GLOBAL_ORIGIN")
        assert (home.latitude, home.longitude) == (origin.latitude, origin.longitude)

    def test_a_message_that_there_is_not_is_refused(self, kind):
        bench = Bench(kind).advance(1.0)
        assert bench.command(mav.MAV_CMD_REQUEST_MESSAGE, 39) == [mav.MAV_RESULT_UNSUPPORTED]
        assert bench.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 39, 1e5) != [0]
        assert bench.command(mav.MAV_CMD_DO_PARACHUTE) == [mav.MAV_RESULT_UNSUPPORTED]

    def test_intervals_are_kept_and_told(self, kind):
        bench = Bench(kind).advance(6.0)
        bench.telemetry("VFR_HUD", hz=4.0)
        assert bench.command(mav.MAV_CMD_GET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_VFR_HUD) == [0]
        assert bench.last("MESSAGE_INTERVAL").interval_us == 250_000
        bench.forget()
        assert len(bench.advance(5.0).all("VFR_HUD")) == pytest.approx(20, abs=1)

    def test_there_is_no_mission(self, kind):
        bench = Bench(kind).advance(1.0)
        bench.standin.deliver(mav.MAVLink_mission_request_list_message(1, 1, 0), system=42)
        assert (bench.last("MISSION_COUNT").count, bench.last("MISSION_COUNT").target_system) == (0, 42)
        bench.standin.deliver(mav.MAVLink_mission_count_message(1, 1, 3, 0))
        assert bench.last("MISSION_ACK").type == mav.MAV_MISSION_UNSUPPORTED

    def test_timesync_and_ping_are_answered(self, kind):
        bench = Bench(kind).advance(2.0)
        bench.standin.deliver(mav.MAVLink_timesync_message(0, 123456789))
        assert bench.last("TIMESYNC").ts1 == 123456789
        assert bench.last("TIMESYNC").tc1 == pytest.approx(2e9, abs=1e8)
        bench.standin.deliver(mav.MAVLink_ping_message(5, 7, 0, 0), system=9)
        assert (bench.last("PING").seq, bench.last("PING").target_system) == (7, 9)

    def test_what_is_for_another_system_is_not_heard(self, kind):
        bench = Bench(kind, system=3).advance(6.0)
        bench.standin.deliver(mav.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))
        assert not bench.all("COMMAND_ACK")
        bench.standin.deliver(mav.MAVLink_param_request_list_message(3, 1))
        assert bench.all("PARAM_VALUE")

    def test_position_on_the_earth_agrees_with_the_local_one(self, kind):
        bench = px4_flying() if kind == "px4" else ardupilot_flying()
        bench.telemetry("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED")
        bench.stream(12.0, position=(30.0, -20.0, -5.0))
        there, local = bench.last("GLOBAL_POSITION_INT"), bench.last("LOCAL_POSITION_NED")
        origin = bench.standin.pilot.origin
        north = math.radians(there.lat * 1e-7 - origin.latitude_deg) * 6.36e6
        assert north == pytest.approx(local.x, rel=5e-3)
        assert there.relative_alt * 1e-3 == pytest.approx(-local.z, abs=0.05)
        assert there.hdg == pytest.approx(9000, abs=100)  # east

    def test_global_setpoints_move_it(self, kind):
        bench = px4_flying() if kind == "px4" else ardupilot_flying()
        goal = bench.standin.pilot.origin_of(np.array([-6.0, 8.0, 0.0]))
        message = mav.MAVLink_set_position_target_global_int_message(
            0, 1, 1, 6, POSITION, round(goal.latitude_deg * 1e7), round(goal.longitude_deg * 1e7), 7.0, *[0.0] * 8
        )
        for _ in range(240):
            bench.standin.deliver(message)
            bench.advance(0.05)
        assert bench.position == pytest.approx((8.0, -6.0, -7.0), abs=0.3)

    def test_reposition_flies_to_a_place(self, kind):
        bench = px4_flying() if kind == "px4" else ardupilot_flying()
        goal = bench.standin.pilot.origin_of(np.array([5.0, 0.0, 9.0]))
        place = round(goal.latitude_deg * 1e7), round(goal.longitude_deg * 1e7), goal.altitude_m
        bench.standin.deliver(mav.MAVLink_command_int_message(1, 1, 5, 192, 0, 0, -1, 1, 0, math.nan, *place))
        assert bench.last("COMMAND_ACK").result == 0
        bench.advance(15.0)
        assert bench.position == pytest.approx((0.0, 5.0, -9.0), abs=0.4)


class TestFaults:
    def test_a_silent_link_ends_offboard_and_is_not_heard(self):
        bench = px4_flying()
        bench.standin.faults.silent = True
        bench.forget()
        bench.stream(4.0, position=(9.0, 0.0, -5.0))
        assert not bench.heard
        assert bench.standin.mode == "POSCTL"

    def test_a_share_of_packets_is_lost_both_ways(self):
        bench = Bench("px4").advance(6.0)
        bench.standin.faults.drop_share = 0.5
        bench.forget()
        bench.advance(20.0)
        assert 120 < len(bench.all("ATTITUDE")) < 280
        answers = [bench.command(mav.MAV_CMD_GET_HOME_POSITION) for _ in range(100)]
        assert 10 < sum(bool(answer) for answer in answers) < 45

    def test_a_battery_level_is_told(self):
        bench = Bench("px4").advance(2.0)
        assert bench.last("SYS_STATUS").battery_remaining == 100
        bench.standin.faults.battery = 0.12
        bench.advance(2.0)
        assert bench.last("SYS_STATUS").battery_remaining == 12
        assert bench.last("BATTERY_STATUS").battery_remaining == 12


def frame(number: int, payload: bytes, extra: int) -> bytes:
    """A MAVLink 2 packet with a valid checksum around any payload."""
    head = struct.pack("<BBBBBBBHB", 0xFD, len(payload), 0, 0, 0, 255, 190, number & 0xFFFF, number >> 16)
    crc = mav.x25crc(head[1:] + payload)
    crc.accumulate(bytes([extra]))
    return head + payload + struct.pack("<H", crc.crc)


def commanded(kind: str, flies: bool) -> Bench:
    """A vehicle that follows setpoints."""
    if flies:
        return px4_flying() if kind == "px4" else ardupilot_flying()
    bench = Bench(kind, flies=False).advance(6.0).stream(1.5)
    bench.set_mode(6 if kind == "px4" else 15)
    assert bench.arm() == [0]
    return bench


@pytest.mark.parametrize("kind", KINDS)
class TestHostileBytes:
    def test_noise_and_truncated_packets_do_no_harm(self, kind):
        bench, rng = Bench(kind).advance(6.0), random.Random(1)
        whole = mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mav.MAVLink(None, 255, 190))
        for _ in range(400):
            bench.standin.receive(("noise", 1), rng.randbytes(rng.randrange(1, 400)))
            bench.standin.receive(("cut", 2), whole[: rng.randrange(1, len(whole))])
        bench.standin.receive(("fresh", 3), whole)
        assert bench.standin.pilot.heard[255] == pytest.approx(bench.standin.time_s)
        assert bench.command(mav.MAV_CMD_GET_HOME_POSITION) == [0]

    @pytest.mark.parametrize("flies", [True, False])
    def test_valid_packets_of_any_content_do_no_harm(self, kind, flies):
        rng = random.Random(7)
        bench = commanded(kind, flies)
        odd = [struct.pack("<f", x) for x in (math.nan, math.inf, -math.inf, 1e38, -1.0)]
        numbers = [number for name in HANDLED for number in [getattr(mav, f"MAVLINK_MSG_ID_{name}")] * 40]
        numbers += rng.sample(sorted(mav.mavlink_map), 120)
        for number in numbers:
            cls = mav.mavlink_map[number]
            size = struct.calcsize(cls.unpacker.format)
            payload = bytearray(rng.randbytes(size) if rng.random() < 0.5 else bytes(size))
            for place in range(0, size - 3, 4):
                if rng.random() < 0.4:
                    payload[place : place + 4] = rng.choice(odd)
            if cls.msgname.startswith("SET_POSITION") and rng.random() < 0.5:
                payload[size - 5 : size] = struct.pack("<HBBB", rng.choice([0, POSITION, 0xDC7]), 1, 1, 1)
            bench.standin.receive(("fuzz", number), frame(number, bytes(payload), cls.crc_extra))
            if bench.standin.exit_code is not None:
                assert kind == "ardupilot"
                assert cls.msgname.startswith("SET_POSITION")
                bench = commanded(kind, flies)
            bench.advance(0.04)
        assert np.all(np.isfinite(bench.standin.body.sensed.position_m))
        assert bench.command(mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES) == [0]


HANDLED = (
    "HEARTBEAT", "COMMAND_LONG", "COMMAND_INT", "SET_MODE", "SET_POSITION_TARGET_LOCAL_NED",
    "SET_POSITION_TARGET_GLOBAL_INT", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET", "MISSION_REQUEST_LIST",
    "MISSION_COUNT", "MISSION_CLEAR_ALL", "REQUEST_DATA_STREAM", "TIMESYNC", "PING",
)  # fmt: skip


def client_of(link: str):
    kind, host, port = link.split(":")
    return mavutil.mavlink_connection(f"{kind if kind == 'tcp' else 'udpout'}:{host}:{port}", source_system=250)


@pytest.mark.parametrize("link", ["udpin:127.0.0.1:0", "tcpin:127.0.0.1:0"])
def test_it_serves_a_client_in_real_time(link):
    wire = open_link(link)
    standin = Standin(KinematicBody(), load_settings("px4"), wire, speed=20.0)
    with standin, closing(client_of(wire.address)) as client:
        client.mav.ping_send(0, 1, 0, 0)  # a server of datagrams knows its peer by what comes
        assert client.wait_heartbeat(timeout=5.0) is not None
        assert client.recv_match(type="LOCAL_POSITION_NED", blocking=True, timeout=5.0) is not None
        client.mav.command_long_send(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
        assert client.recv_match(type="COMMAND_ACK", blocking=True, timeout=5.0).result == 0
        assert standin.armed
    with pytest.raises(InputError, match="cannot be opened"):
        open_link("udpin:203.0.113.1:14550")  # no address of this machine


def test_it_calls_a_client_that_waits_and_survives_that_nobody_does():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with Standin(KinematicBody(), load_settings("ardupilot"), open_link(f"udpout:127.0.0.1:{port}"), speed=20.0):
        time.sleep(0.2)
        with closing(mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=250)) as client:
            assert client.wait_heartbeat(timeout=5.0) is not None


def test_tcp_clients_come_and_go():
    wire = open_link("tcpin:127.0.0.1:0")
    port = int(wire.address.rsplit(":", 1)[1])
    with Standin(KinematicBody(), load_settings("px4"), wire, speed=20.0):
        for _ in range(CLIENTS_MAX + 4):
            with closing(socket.create_connection(("127.0.0.1", port))) as client:
                client.settimeout(5.0)
                assert client.recv(10)
                client.sendall(b"\xfd\xff")


@pytest.mark.parametrize("link", ["udp:1", "serial:/dev/ttyUSB0:57600", "udpout:127.0.0.1:0", "tcpin:x:99999", ""])
def test_a_link_that_cannot_be_understood_is_refused(link):
    with pytest.raises(InputError, match="link"):
        open_link(link)


def test_servers_bind_the_loopback_interface_unless_told_otherwise():
    for kind in ("udpin", "tcpin"):
        with closing(open_link(f"{kind}::0")) as link:
            assert link.address.split(":")[1] == "127.0.0.1"


def test_an_error_of_a_thread_is_not_lost():
    class Broken(KinematicBody):
        def step(self, motion, armed):
            raise RuntimeError("broken body")

    standin = Standin(Broken(), load_settings("px4"))
    standin.start()
    assert standin.wait(5.0)
    with pytest.raises(RuntimeError, match="broken body"):
        standin.stop()


def test_the_same_seed_gives_the_same_flight():
    tracks = [np.array(px4_flying().stream(5.0, position=(3.0, 4.0, -6.0)).position) for _ in range(2)]
    assert np.array_equal(*tracks)
