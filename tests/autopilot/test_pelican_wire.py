"""Packets of the AscTec low-level processor: published forms, round trips, broken and hostile bytes; sticks."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.autopilot.outer_loop import Demand
from swarmsim.autopilot.pelican import PelicanSettings, packets
from swarmsim.autopilot.pelican.packets import Control, FlightMode, Gps, Imu, Poll, Status
from swarmsim.autopilot.pelican.sticks import Sticks
from swarmsim.autopilot.settings import load_settings

STATUS = Status(11.87, True, FlightMode.ATTITUDE | FlightMode.HEIGHT | FlightMode.SERIAL_ENABLED)
IMU = Imu(1.234, -2.5, 271.125, 3.25, -0.4)
GPS = Gps(48.0741234, 11.2684321, 1.25, -0.5, 1.5, 9, True)
shorts = st.integers(-2047, 2047)
controls = st.builds(Control, shorts, shorts, shorts, st.integers(0, 4095), st.integers(0, 63))


def test_the_command_to_switch_the_motors_is_that_of_the_drivers():
    # asctec_proc.cpp: yaw -2047, ctrl 0b1100, checksum their sum less 21846 as a short
    data = packets.encode_control(Control(yaw=-2047, ctrl=0b1100))
    assert data[:5] == b">*>di"
    assert struct.unpack("<6h", data[5:]) == (0, 0, -2047, 0, 12, -2047 + 12 - 21846)


def test_the_checksum_is_that_of_the_manual():
    # the manual's is the CCITT polynomial, bits reflected, begun at 0x00FF
    def reflected(data):
        crc = 0xFF
        for byte in data:
            crc ^= byte
            for _ in range(8):
                crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
        return crc

    for data in (b"", b"\0", b"123456789", bytes(range(92))):
        assert packets.crc16(data) == reflected(data)


@pytest.mark.parametrize(("packet", "descriptor", "size"), [(STATUS, 0x02, 16), (IMU, 0x03, 92), (GPS, 0x29, 60)])
def test_structures_have_the_published_sizes_and_come_back(packet, descriptor, size):
    data = packets.encode(packet)
    assert data[:3] == b">*>"
    assert struct.unpack_from("<HB", data, 3) == (size, descriptor)
    assert data[-3:] == b"<#<"
    assert packets.Replies().feed(data) == [packet]


def test_fields_lie_where_the_manual_has_them():
    payload = packets.encode(STATUS)[6:-5]
    assert struct.unpack_from("<h", payload, 0)[0] == 11870  # battery_voltage_1, mV
    assert payload[10] == payload[11] == 1  # flying, motors_on
    assert struct.unpack_from("<h", payload, 12)[0] == 0x23  # flightMode
    payload = packets.encode(IMU)[6:-5]
    assert struct.unpack_from("<3i", payload) == (1234, -2500, 271125)
    assert struct.unpack_from("<2i", payload, 76) == (3250, -400)  # height, dheight
    payload = packets.encode(GPS)[6:-5]
    assert struct.unpack_from("<i", payload, 40)[0] == 3  # status
    assert struct.unpack_from("<4i", payload, 44) == (480741234, 112684321, 1250, -500)


@given(st.lists(controls | st.builds(Poll, st.integers(0, 0xFFFF)), max_size=6), st.integers(1, 7))
def test_requests_come_back_however_they_are_cut(requests, size):
    whole = b"".join(
        packets.encode_poll(r.packets) if isinstance(r, Poll) else packets.encode_control(r) for r in requests
    )
    parser, found = packets.Requests(), []
    for begin in range(0, len(whole), size):
        found += parser.feed(whole[begin : begin + size])
    assert found == requests
    assert parser.bad == 0


@given(st.binary(max_size=40), st.integers(1, 11))
def test_replies_are_found_among_noise(noise, size):
    data = noise.replace(b">", b"x") + packets.encode(STATUS) + packets.acknowledgement(0x17) + packets.encode(GPS)
    parser, found = packets.Replies(), []
    for begin in range(0, len(data), size):
        found += parser.feed(data[begin : begin + size])
    assert found == [STATUS, GPS]


@given(st.binary(max_size=6000))
def test_no_bytes_break_the_parsers(data):
    replies, requests = packets.Replies(), packets.Requests()
    replies.feed(data)
    replies.feed(b">*>" + data)
    requests.feed(b">*>di" + data)
    requests.feed(b">*>")


@given(st.integers(5, 100), st.integers(1, 255))
def test_a_changed_byte_is_not_believed(place, change):
    data = bytearray(packets.encode(IMU))
    data[place] = (data[place] + change) % 256
    parser = packets.Replies()
    found = parser.feed(bytes(data) + packets.encode(STATUS) * 12)
    assert IMU not in found
    assert found[-1] == STATUS


def test_a_wrong_checksum_of_a_command_is_ignored():
    data = bytearray(packets.encode_control(Control(pitch=100)))
    data[6] ^= 1
    parser = packets.Requests()
    assert parser.feed(bytes(data) + packets.encode_poll(1)) == [Poll(1)]
    assert parser.bad == 1


def test_a_stick_out_of_range_is_refused():
    for control in (Control(pitch=2048), Control(yaw=-2048), Control(thrust=-1), Control(thrust=4096)):
        with pytest.raises(ValueError, match="range"):
            packets.encode_control(control)


# sticks

SETTINGS = load_settings("pelican", PelicanSettings)
GPS_MODE = FlightMode.ATTITUDE | FlightMode.HEIGHT | FlightMode.POSITION
HEIGHT_MODE = FlightMode.ATTITUDE | FlightMode.HEIGHT


def test_sticks_mean_velocities_with_the_switch_at_gps():
    demand = Demand((1.5, 0.0, 1.0), (9.0, 9.0), math.radians(12.0))
    c = Sticks(SETTINGS).of(demand, 0.0, 0.0, GPS_MODE, 0.05)
    assert (c.pitch, c.roll, c.yaw, c.thrust) == (1024, 0, -100, 3070)
    c = Sticks(SETTINGS).of(demand, -0.5 * math.pi, 0.0, GPS_MODE, 0.05)  # the nose to the south: east is to the left
    assert (c.pitch, c.roll) == (0, -1024)


def test_sticks_mean_angles_with_the_switch_at_height():
    # k_stick of 25: 0.025 degrees a count
    demand = Demand((0.0, 0.0, -2.0), (9.80665 * math.tan(math.radians(10.0)), 0.0), 0.0)
    c = Sticks(SETTINGS).of(demand, 0.0, 0.0, HEIGHT_MODE, 0.05)
    assert (c.pitch, c.roll, c.thrust) == (400, 0, 0)


def test_in_attitude_mode_the_thrust_carries_the_weight_and_more():
    still = Demand((0.0, 0.0, 0.0), (0.0, 0.0), 0.0)
    sticks = Sticks(SETTINGS)
    assert sticks.of(still, 0.0, 0.0, FlightMode.ATTITUDE, 0.05).thrust == round(4095 * SETTINGS.scales.hover_thrust)
    low = [sticks.of(still, 0.0, -0.5, FlightMode.ATTITUDE, 0.05).thrust for _ in range(10)]
    assert low == sorted(low)
    assert low[-1] > low[0] > 2048


@given(st.tuples(*[st.floats(-50, 50)] * 3), st.floats(-9, 9), st.floats(-20, 20), st.sampled_from([1, 3, 7]))
def test_sticks_stay_in_range_and_never_switch_the_motors(velocity, yaw, turn, mode):
    demand = Demand(velocity, (velocity[1], velocity[0]), turn)
    c = Sticks(SETTINGS).of(demand, yaw, -velocity[2], FlightMode(mode), 0.05)
    packets.encode_control(c)
    assert abs(c.yaw) <= 1700
