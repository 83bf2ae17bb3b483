"""The links to firmware: what is sent in which units and frames, whose actuator is which, and what hostile bytes do."""

import math
import socket
import struct
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.autopilot.frames import Geodetic
from swarmsim.config.errors import InputError
from swarmsim.config.load import load_named
from swarmsim.sitl.ardupilot import ArdupilotLink, outputs_of, state_line
from swarmsim.sitl.link import FirmwareError, Seat, ordered, seat_of
from swarmsim.sitl.plant import ACTUATORS, Sensed, Truth
from swarmsim.sitl.px4 import Px4Link, distance_sensor, hil_gps, hil_sensor, hil_state, pressure_height_m
from swarmsim.sitl.settings import load_sitl_settings
from tests.autopilot.ports import free_port

ORIGIN = Geodetic(47.397742, 8.545594, 488.0)
SEAT = Seat("uav1", 0, True, (0, 1, 2, 3), ORIGIN)
SQUARE = math.sqrt(0.5)


def truth(**changes):
    fields = {
        "time_s": 1.5,
        "position_m": np.array([[10.0, 20.0, 5.0]]),
        "velocity_m_s": np.array([[1.0, 2.0, 3.0]]),
        "quaternion": np.array([[1.0, 0.0, 0.0, 0.0]]),  # nose east, level
        "angular_velocity_rad_s": np.array([[0.1, 0.2, 0.3]]),
        "specific_force_m_s2": np.array([[0.5, 0.25, 9.80665]]),
        "air_velocity_m_s": np.array([[3.0, 4.0, 0.0]]),
        "charge": np.array([0.9]),
        "intact": np.array([True]),
    }
    return Truth(**(fields | changes))


def sensed(**changes):
    on, off = np.array([True]), np.array([False])
    fields = {
        "imu_fresh": on,
        "gyro_rad_s": np.array([[0.1, 0.2, 0.3]]),
        "accel_m_s2": np.array([[0.5, 0.25, 9.81]]),
        "gnss_fresh": on,
        "gnss_position_m": np.array([[0.0, 0.0, 12.0]]),
        "gnss_velocity_m_s": np.array([[3.0, 4.0, -1.0]]),
        "gnss_eph_m": np.array([0.5]),
        "gnss_epv_m": np.array([np.inf]),
        "gnss_fix": np.array([6.0]),
        "barometer_fresh": on,
        "pressure_pa": np.array([95_000.0]),
        "temperature_k": np.array([293.15]),
        "magnetometer_fresh": off,
        "magnetic_field_t": np.array([[2e-5, 1e-5, -4e-5]]),
        "rangefinder_fresh": off,
        "range_m": np.array([np.nan]),
        "range_valid": off,
        "airspeed_fresh": off,
        "differential_pressure_pa": np.array([np.nan]),
    }
    return Sensed(**(fields | changes))


def test_hil_sensor_is_frd_with_the_bits_of_what_is_new():
    m = hil_sensor(sensed(), 0, 5000)
    assert (m.xacc, m.yacc, m.zacc) == pytest.approx((0.5, -0.25, -9.81))
    assert (m.xgyro, m.ygyro, m.zgyro) == pytest.approx((0.1, -0.2, -0.3))
    assert (m.xmag, m.ymag, m.zmag) == pytest.approx((0.2, -0.1, 0.4))  # gauss
    assert m.abs_pressure == pytest.approx(950.0)  # hPa
    assert m.temperature == pytest.approx(20.0)
    assert m.fields_updated == 0x3F | 0x1A00
    assert m.diff_pressure == 0.0  # there is no airspeed sensor, and its bit says so
    everything = sensed(magnetometer_fresh=np.array([True]), airspeed_fresh=np.array([True]))
    assert hil_sensor(everything, 0, 1).fields_updated == 0x1FFF


def test_the_pressure_altitude_of_the_standard_atmosphere():
    # ICAO Doc 7488: 101325 Pa at 0 m, 89874.6 Pa at 1000 m, 54019.9 Pa at 5000 m
    for pressure, height in ((101_325.0, 0.0), (89_874.6, 1000.0), (54_019.9, 5000.0)):
        assert pressure_height_m(pressure) == pytest.approx(height, abs=0.5)


def test_hil_gps_is_the_place_on_the_earth():
    m = hil_gps(SEAT, sensed(), 0, 5000, 14)
    assert (m.lat, m.lon) == (473977420, 85455940)
    assert m.alt == 500_000
    assert (m.vn, m.ve, m.vd) == (400, 300, 100)
    assert m.vel == 500
    assert m.cog == round(100 * math.degrees(math.atan2(3.0, 4.0)))
    assert (m.eph, m.epv, m.fix_type, m.satellites_visible) == (50, 65534, 6, 14)


def test_hil_state_is_the_truth_in_ned():
    m = hil_state(SEAT, truth(), 0, 5000)
    assert m.attitude_quaternion == pytest.approx([SQUARE, 0.0, 0.0, SQUARE])  # nose east is a yaw of 90 degrees
    assert (m.vx, m.vy, m.vz) == (200, 100, -300)
    assert m.true_airspeed == 500
    assert (m.xacc, m.yacc, m.zacc) == (51, -25, -1000)  # mg
    assert m.alt == pytest.approx(493_000, abs=1)


def test_a_rangefinder_that_sees_nothing_tells_no_distance():
    seen = sensed(range_m=np.array([2.344]), range_valid=np.array([True]))
    assert distance_sensor(seen, 0, 5000).current_distance == 234
    assert distance_sensor(sensed(range_m=np.array([40.0])), 0, 5000).current_distance == 0


def test_the_state_line_is_compact_json_in_ned():
    line = state_line(truth(), sensed(range_m=np.array([3.0])), 0)
    assert line.startswith(b'\n{"timestamp":1.5,"imu":{"gyro":[0.1,-0.2,-0.3],"accel_body":[0.5,-0.25,-9.81]}')
    assert line.endswith(b"}\n")
    assert b" " not in line
    assert b'"position":[20.0,10.0,-5.0]' in line
    assert b'"velocity":[2.0,1.0,-3.0]' in line
    assert b'"rng_1":3.0' in line
    assert b"airspeed" not in line
    wind = state_line(truth(), sensed(differential_pressure_pa=np.array([61.25])), 0)
    assert b'"airspeed":10.0' in wind


def test_servo_pulses():
    copter = outputs_of(np.array([1000.0, 1500.0, 2000.0, 0.0, 2500.0]), flies=True)
    np.testing.assert_allclose(copter, [0.0, 0.5, 1.0, 0.0, 1.0])
    rover = outputs_of(np.array([1000.0, 1500.0, 2000.0, 0.0, 1750.0]), flies=False)
    np.testing.assert_allclose(rover, [-1.0, 0.0, 1.0, 0.0, 0.5])


@pytest.mark.parametrize("name", ["x500", "tarot_t650", "dji_f550", "ar_drone_2", "asctec_pelican", "crazyflie_2_1"])
def test_every_multirotor_of_the_catalogue_has_its_motors(name):
    vehicle = load_named("vehicles", name)
    settings = load_sitl_settings("ardupilot")
    if name == "asctec_pelican" and min(abs(r.position_m[1]) for r in vehicle.rotors) < 0.01:
        with pytest.raises(InputError, match="X frame"):  # its rotors form a plus
            seat_of(name, 0, vehicle, settings, ORIGIN)
        return
    seat = seat_of(name, 0, vehicle, settings, ORIGIN)
    assert sorted(seat.motors) == list(range(len(vehicle.rotors)))
    for rotor, motor in zip(vehicle.rotors, seat.motors, strict=True):
        azimuth = math.radians(settings.motors_deg[len(vehicle.rotors)][motor])
        x, y, _ = rotor.position_m
        assert math.hypot(x, y) * math.cos(azimuth) == pytest.approx(x, abs=0.1)
        assert -math.hypot(x, y) * math.sin(azimuth) == pytest.approx(y, abs=0.1)


def test_outputs_reach_the_rotors_that_they_are_for():
    seat = Seat("uav", 0, True, (2, 0, 3, 1), ORIGIN)
    np.testing.assert_allclose(ordered(seat, np.array([0.1, 0.2, 0.3, 0.4]))[:4], [0.3, 0.1, 0.4, 0.2])
    rover = Seat("rover", 0, False, (1, 0), ORIGIN)  # of PX4: left is channel 1
    np.testing.assert_allclose(ordered(rover, np.array([0.7, -0.2]))[:2], [-0.2, 0.7])
    assert len(ordered(seat, np.zeros(16))) == ACTUATORS


def test_a_rover_of_ardupilot_is_steered_by_servos_1_and_3():
    seat = seat_of("rover", 0, load_named("vehicles", "husky"), load_sitl_settings("ardupilot"), ORIGIN)
    assert seat.motors == (0, 2)
    assert not seat.flies


@pytest.mark.parametrize(("kind", "link"), [("px4", Px4Link), ("ardupilot", ArdupilotLink)])
def test_a_port_that_is_taken_is_told(kind, link):
    port = free_port(socket.SOCK_STREAM if kind == "px4" else socket.SOCK_DGRAM)
    settings = load_sitl_settings(kind).model_copy(update={"port": port})
    first = link(SEAT, settings)
    try:
        with pytest.raises(FirmwareError, match=f"port {port}.*another simulator"):
            link(SEAT, settings)
    finally:
        first.close()


@given(st.lists(st.binary(max_size=120), max_size=8))
def test_hostile_packets_are_no_requests(packets):
    port = free_port(socket.SOCK_DGRAM)
    link = ArdupilotLink(SEAT, load_sitl_settings("ardupilot").model_copy(update={"port": port}))
    try:
        for data in packets:
            link._take(data, ("127.0.0.1", 1))
        assert np.isfinite(link.actuators).all()
        assert np.all(np.abs(link.actuators) <= 1.0)
    finally:
        link.close()


@pytest.mark.parametrize(("kind", "link"), [("px4", Px4Link), ("ardupilot", ArdupilotLink)])
def test_one_that_talks_without_end_and_does_not_answer_is_not_waited_for(kind, link):
    stream = socket.SOCK_STREAM if kind == "px4" else socket.SOCK_DGRAM
    port = free_port(stream)
    made = link(SEAT, load_sitl_settings(kind).model_copy(update={"port": port}))
    peer, end = socket.socket(socket.AF_INET, stream), time.monotonic() + 3.0
    peer.connect(("127.0.0.1", port))

    def talk():
        while time.monotonic() < end:
            peer.send(b"no message")
            time.sleep(0.001)

    talker = threading.Thread(target=talk)
    talker.start()
    try:
        made.connected()
        assert not made.hear(0.1)
        assert time.monotonic() < end
    finally:
        talker.join()
        peer.close()
        made.close()


def test_a_firmware_that_begins_anew_is_counted():
    port = free_port(socket.SOCK_DGRAM)
    link = ArdupilotLink(SEAT, load_sitl_settings("ardupilot").model_copy(update={"port": port}))
    try:
        for frame in (0, 1, 2, 2, 0, 1):  # a request that is repeated is no new begin
            link._take(struct.pack("<HHI16H", 18458, 400, frame, *[1500] * 16), ("127.0.0.1", 1))
        assert link.restarts == 1
    finally:
        link.close()
