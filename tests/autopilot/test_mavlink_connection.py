"""Link strings, bytes that are no messages, signatures, TCP, statistics."""

import contextlib
import os
import secrets
import select
import socket
import threading
import time
import tty

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.link import LinkError, Setpoint
from swarmsim.autopilot.mavlink import Connection, MavlinkVehicle
from swarmsim.autopilot.mavlink.transport import LinkAddress, parse_link
from swarmsim.autopilot.mavlink.wire import Protocol, is_unknown, origin_of, read_key
from swarmsim.config.errors import InputError
from tests.autopilot import test_mavlink_peer as peers
from tests.autopilot.ports import free_port
from tests.autopilot.test_mavlink_peer import eventually

KEY = bytes(range(32))
HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 0x81, 6 << 16, 4, 3)


def heartbeats(count: int, system=7, key=None) -> list[bytes]:
    sender = Protocol(system, 1, key)
    return [sender.bytes_of(HEARTBEAT) for _ in range(count)]


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("udpin:14540", LinkAddress("udpin", "127.0.0.1", 14540)),
        ("udpin:0.0.0.0:14540", LinkAddress("udpin", "0.0.0.0", 14540)),
        ("udpout:192.168.4.1:14555", LinkAddress("udpout", "192.168.4.1", 14555)),
        ("tcp:localhost:5760", LinkAddress("tcp", "localhost", 5760)),
        ("tcpin:[::1]:5760", LinkAddress("tcpin", "::1", 5760)),
        (" tcp:5760 ", LinkAddress("tcp", "127.0.0.1", 5760)),
        ("serial:/dev/ttyUSB0:921600", LinkAddress("serial", "/dev/ttyUSB0", 921600)),
        ("serial:/dev/ttyACM0", LinkAddress("serial", "/dev/ttyACM0", 57600)),
        ("serial:COM3:57600", LinkAddress("serial", "COM3", 57600)),
    ],
)
def test_link_strings(text, address):
    assert parse_link(text) == address


@pytest.mark.parametrize(
    "text",
    [
        "",
        "14540",
        "udp:127.0.0.1:14540",
        "udpin:",
        "udpin:host:",
        "udpin::14540",
        "udpin:host:port",
        "udpin:0",
        "tcp:h:65536",
        "tcp:h:-1",
        "tcp:h:9999999999999999999",
        "tcp:a host:5760",
        "tcp:h:٥٧٦٠",
        "serial:",
        "serial:/dev/ttyUSB0:fast",
        "serial::57600",
    ],
)
def test_wrong_link_strings_are_told_the_allowed_forms(text):
    with pytest.raises(InputError, match=r"no link to a vehicle(.|\n)*udpin:"):
        parse_link(text)


@given(st.text(max_size=30))
def test_any_text_is_a_link_or_an_input_error(text):
    with contextlib.suppress(InputError):
        assert isinstance(parse_link(text), LinkAddress)


def test_links_that_cannot_be_opened():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(LinkError, match="another program"):
            Connection(f"udpin:{port}", print)
    with pytest.raises(LinkError, match="start the autopilot"):
        Connection(f"tcp:{port}", print)
    with pytest.raises(LinkError, match="plugged in"):
        Connection("serial:/dev/there-is-none:57600", print)
    with pytest.raises(LinkError, match="cannot be opened"):
        Connection(f"tcp:{'a' * 64}:5", print)


def test_a_log_that_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="log cannot be written"):
        Connection(f"udpin:{free_port()}", print, log=tmp_path / "file" / "flight.tlog")


# bytes


@given(st.lists(st.binary(max_size=400), max_size=20), st.booleans())
def test_whatever_comes_nothing_is_raised_and_the_next_messages_are_heard(junk, datagram):
    parser = Protocol(245, 191)
    for data in junk:
        parser.messages_of(data, datagram)
    heard: list = []
    for data in heartbeats(40):  # a length of 255 that junk announced swallows the next 280 bytes of a stream
        heard += parser.messages_of(data, datagram)[0]
    good = [m for m in heard if not is_unknown(m)]
    assert len(good) >= (39 if datagram else 20)
    assert {m.get_type() for m in good} == {"HEARTBEAT"}


@given(st.data())
def test_truncated_and_altered_messages_are_counted(data):
    original = heartbeats(1)[0]
    cut = data.draw(st.integers(1, len(original) - 1))
    place = data.draw(st.integers(10, len(original) - 1))
    altered = bytearray(original)
    altered[place] ^= data.draw(st.integers(1, 255))
    parser = Protocol(245, 191)
    assert parser.messages_of(original[:cut], True) == ([], 0)
    messages, bad = parser.messages_of(original, True)
    assert [m.get_type() for m in messages] == ["HEARTBEAT"]
    assert bad == 1
    assert parser.messages_of(bytes(altered), True) == ([], 1)


@given(st.lists(st.integers(1, 60), min_size=1, max_size=30))
def test_a_stream_may_be_cut_anywhere(pieces):
    stream = b"".join(heartbeats(12))
    parser, heard, at = Protocol(245, 191), 0, 0
    for length in [*pieces, len(stream)]:
        messages, bad = parser.messages_of(stream[at : at + length], False)
        heard += len(messages)
        assert bad == 0
        at += length
    assert heard == 12


def test_messages_of_unknown_kinds_count_but_are_not_taken():
    sender = Protocol(7, 1)
    frame = bytes([0xFD, 1, 0, 0, 9, 7, 1, 0xFF, 0xFF, 0x7F, 0, 0, 0])
    parser = Protocol(245, 191)
    messages, bad = parser.messages_of(frame + sender.bytes_of(HEARTBEAT), True)
    assert [is_unknown(m) for m in messages] == [True, False]
    assert [origin_of(m) for m in messages] == [(7, 1, 9), (7, 1, 0)]
    assert bad == 0


@given(st.lists(st.binary(min_size=1, max_size=300), min_size=1, max_size=15))
def test_a_vehicle_is_flown_through_junk(junk):
    port = free_port()
    heard: list = []
    connection = Connection(f"udpin:{port}", heard.append)
    try:
        connection.select(7, 1)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for data, good in zip(junk, heartbeats(len(junk)), strict=True):
                sender.sendto(data, ("127.0.0.1", port))
                sender.sendto(good, ("127.0.0.1", port))
            assert eventually(lambda: connection.statistics.received >= len(junk))
        assert sum(m.get_type() == "HEARTBEAT" for m in heard) >= len(junk)
        assert connection.statistics.errors == 0
    finally:
        connection.close()


def test_losses_are_counted_by_the_sequence_number():
    port = free_port()
    connection = Connection(f"udpin:{port}", lambda message: None)
    try:
        connection.select(7, 1)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for number, data in enumerate(heartbeats(300)):
                if number not in (10, 11, 200, 256):
                    sender.sendto(data, ("127.0.0.1", port))
                    time.sleep(0.0005)
            assert eventually(lambda: connection.statistics.received == 296)
        assert connection.statistics.lost == 4
        assert connection.statistics.bad == 0
    finally:
        connection.close()


# signing


def test_keys(tmp_path):
    (tmp_path / "raw").write_bytes(KEY)
    (tmp_path / "hex").write_text(KEY.hex() + "\n")
    (tmp_path / "bad").write_text("password")
    assert read_key(tmp_path / "raw") == read_key(tmp_path / "hex") == KEY
    with pytest.raises(InputError, match="no signing key"):
        read_key(tmp_path / "bad")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="no regular file"):
        read_key(tmp_path / "pipe")


def test_only_signed_messages_are_accepted():
    signed, unsigned, other = heartbeats(1, key=KEY)[0], heartbeats(1)[0], heartbeats(1, key=bytes(32))[0]
    parser = Protocol(245, 191, KEY)
    assert parser.messages_of(unsigned, True) == ([], 1)
    assert parser.messages_of(other, True) == ([], 1)
    messages, bad = parser.messages_of(signed, True)
    assert (len(messages), bad) == (1, 0)
    assert messages[0].get_signed()


def test_a_replayed_message_is_refused():
    signed = heartbeats(1, key=KEY)[0]
    parser = Protocol(245, 191, KEY)
    assert len(parser.messages_of(signed, True)[0]) == 1
    assert parser.messages_of(signed, True) == ([], 1)


def test_a_forged_time_stamp_does_not_shut_the_vehicle_out():
    """pymavlink takes the time stamp of a message before it checks the signature."""
    sender = Protocol(7, 1, KEY)
    parser = Protocol(245, 191, KEY)
    first = sender.bytes_of(HEARTBEAT)
    assert len(parser.messages_of(first, True)[0]) == 1
    forged = bytearray(first)
    forged[-8] = 0xFF  # the highest byte of the time stamp
    assert parser.messages_of(bytes(forged), True) == ([], 1)
    assert len(parser.messages_of(sender.bytes_of(HEARTBEAT), True)[0]) == 1


@given(st.integers(1, 10_000))
def test_signatures_are_not_guessed(seed):
    message = bytearray(heartbeats(1, key=KEY)[0])
    place = seed % len(message[10:]) + 10
    message[place] ^= 1 + seed % 255
    assert Protocol(245, 191, KEY).messages_of(bytes(message), True) == ([], 1)


def test_a_vehicle_that_signs(tmp_path):
    (tmp_path / "key").write_text(KEY.hex())
    port = free_port()
    with peers.peer_on(port, key=KEY) as peer:
        vehicle = MavlinkVehicle(f"udpin:{port}", system=7, key_file=tmp_path / "key")
        try:
            vehicle.follow(3.0)
            vehicle.send(Setpoint(velocity_m_s=(1.0, 0.0, 0.0)))
            assert eventually(lambda: peer.of("SET_POSITION_TARGET_LOCAL_NED"))
            assert all(m.get_signed() for m in peer.heard)
        finally:
            vehicle.close()


def test_a_vehicle_with_another_key(tmp_path):
    (tmp_path / "key").write_text(secrets.token_hex())
    port = free_port()
    with peers.peer_on(port, key=KEY), pytest.raises(LinkError, match=r"no valid heartbeat(.|\n)*signing key"):
        MavlinkVehicle(f"udpin:{port}", system=7, key_file=tmp_path / "key", timeout_s=0.5)


# TCP


def test_a_tcp_link_comes_back():
    heard: list = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5.0)
        connection = Connection(f"tcp:{server.getsockname()[1]}", heard.append)
        try:
            for round_ in (1, 2):
                peer, _ = server.accept()
                with peer:
                    peer.settimeout(5.0)
                    peer.sendall(heartbeats(3)[0])
                    assert eventually(lambda count=round_: len(heard) == count)
                    assert Protocol(7, 1).messages_of(peer.recv(100), False)[0]
        finally:
            connection.close()


def test_a_tcp_server_that_starts_later_is_waited_for():
    port, made = free_port(socket.SOCK_STREAM), []
    later = threading.Timer(0.6, lambda: made.append(socket.create_server(("127.0.0.1", port))))
    later.start()
    connection = Connection(f"tcp:{port}", print, refused_s=20.0)
    connection.close()
    later.join()
    made[0].close()


def test_a_link_that_waits_for_tcp():
    port, heard = free_port(), []
    connection = Connection(f"tcpin:{port}", heard.append)
    try:
        for round_ in (1, 2):
            with socket.create_connection(("127.0.0.1", port), 5.0) as peer:
                peer.settimeout(5.0)
                peer.sendall(heartbeats(1)[0])
                assert eventually(lambda count=round_: len(heard) == count)
                assert peer.recv(100)[0] == 0xFD
    finally:
        connection.close()


def test_a_serial_port():
    ours, theirs = os.openpty()
    heard: list = []
    try:
        tty.setraw(ours)
        connection = Connection(f"serial:{os.ttyname(theirs)}:115200", heard.append)
        try:
            os.write(ours, heartbeats(1)[0])
            assert eventually(lambda: heard)
            assert select.select([ours], [], [], 5.0)[0]
            assert os.read(ours, 100)[0] == 0xFD
        finally:
            connection.close()
    finally:
        os.close(ours)
        os.close(theirs)


def test_a_stuck_tcp_peer_is_given_up():
    with socket.create_server(("127.0.0.1", 0)) as server:
        connection = Connection(f"tcp:{server.getsockname()[1]}", print)
        try:
            peer, _ = server.accept()
            with peer:
                long = mavlink.MAVLink_statustext_message(6, b"x" * 50)
                begin = time.monotonic()
                while connection.send(long) and time.monotonic() - begin < 20.0:
                    pass
                assert connection.statistics.unsent == 1
            second, _ = server.accept()
            second.close()
        finally:
            connection.close()


def test_udpout_speaks_first_and_hears_its_peer_alone():
    heard: list = []
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        vehicle.bind(("127.0.0.1", 0))
        vehicle.settimeout(5.0)
        connection = Connection(f"udpout:{vehicle.getsockname()[1]}", heard.append)
        try:
            _, ours = vehicle.recvfrom(100)
            other.sendto(heartbeats(1)[0], ours)
            vehicle.sendto(heartbeats(1, system=9)[0], ours)
            assert eventually(lambda: heard)
            assert [m.get_srcSystem() for m in heard] == [9]
        finally:
            connection.close()
