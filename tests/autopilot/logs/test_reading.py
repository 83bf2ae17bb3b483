"""Flights read back from logs of all three kinds, from damaged ones, and from what is no log."""

import contextlib
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.frames import Geodetic, enu_of_geodetic
from swarmsim.autopilot.logs.flight_log import Change, readable
from swarmsim.autopilot.logs.reading import read_log
from swarmsim.config.errors import InputError
from tests.autopilot.logs import writers

TRUTH = writers.flight()
WRITTEN = {"tlog": writers.tlog(TRUTH), "bin": writers.dataflash(TRUTH), "ulg": writers.ulog(TRUTH)}
EXPECTED = {
    "tlog": ("px4", "copter", 1, "OFFBOARD", "AUTO_LOITER"),
    "bin": ("ardupilot", "copter", 7, "GUIDED", "LOITER"),
    "ulg": ("px4", "copter", 9, "OFFBOARD", "AUTO_LOITER"),
}


def read(tmp_path, kind, data=None, **options):
    path = tmp_path / f"flight.{kind}"
    path.write_bytes(WRITTEN[kind] if data is None else data)
    return read_log(path, **options)


@pytest.mark.parametrize("kind", WRITTEN)
def test_a_flight_is_read_back(kind, tmp_path):
    log = read(tmp_path, kind)
    autopilot, vehicle, system, follow, before = EXPECTED[kind]
    assert (log.format, log.autopilot, log.vehicle, log.system) == (kind, autopilot, vehicle, system)
    assert log.notes == ()
    np.testing.assert_allclose(log.time_s, TRUTH.time_s, atol=1e-3)
    np.testing.assert_allclose(log.position_m, TRUTH.position_m, atol=1e-5)
    np.testing.assert_allclose(log.velocity_m_s, TRUTH.velocity_m_s, atol=1e-5)
    turned = np.abs(np.sum(log.quaternion * TRUTH.quaternion, axis=1))
    np.testing.assert_allclose(turned, 1.0, atol=1e-6)
    assert np.allclose(enu_of_geodetic(log.origin, writers.ORIGIN), 0.0, atol=0.02)
    assert [change.name for change in log.modes][:2] == [before, follow]
    assert Change(pytest.approx(writers.ARMED_S, abs=0.01), "armed") in log.armed
    assert log.spans_s() == [pytest.approx((writers.ARMED_S, writers.LEFT_S), abs=0.01)]
    assert log.battery.values[0] == pytest.approx(1.0)
    assert log.battery.values[-1] == pytest.approx(0.705, abs=0.01)
    inside = (log.setpoints.time_s > 6.0) & (log.setpoints.time_s < 20.0)
    wanted = [np.interp(log.setpoints.time_s[inside], TRUTH.time_s, TRUTH.position_m[:, k]) for k in range(3)]
    np.testing.assert_allclose(log.setpoints.values[inside], np.stack(wanted, axis=1), atol=1e-3)
    if kind != "bin":
        assert any("Takeoff detected" in message.name for message in log.messages)


@pytest.mark.parametrize("kind", WRITTEN)
def test_the_kind_is_told_by_the_content(kind, tmp_path):
    path = tmp_path / "flight.log"
    path.write_bytes(WRITTEN[kind])
    assert read_log(path).format == kind


@pytest.mark.parametrize("kind", WRITTEN)
@pytest.mark.parametrize("share", [0.5, 0.83])
def test_a_log_that_breaks_off_is_read_as_far_as_it_goes(kind, share, tmp_path):
    data = WRITTEN[kind]
    log = read(tmp_path, kind, data[: int(share * len(data)) + 5])
    assert share * 30.0 - 2.0 < log.time_s[-1] < share * 30.0 + 2.0
    assert any("breaks off" in note or "skipped" in note for note in log.notes)
    assert ("ends while the vehicle is armed" in " ".join(log.notes)) is (share < writers.LEFT_S / 30.0)
    np.testing.assert_allclose(log.position_m, TRUTH.position_m[: len(log.time_s)], atol=1e-5)


@pytest.mark.parametrize("kind", ["tlog", "bin"])
@pytest.mark.parametrize("damage", [b"", b"\0" * 300, b"\xa3\x95\x80" * 40, b"\xfd\xfe" * 100])
def test_damage_in_the_middle_costs_only_what_was_there(kind, damage, tmp_path):
    data, half = WRITTEN[kind], len(WRITTEN[kind]) // 2
    log = read(tmp_path, kind, data[:half] + damage + data[half + 200 :])
    assert log.time_s[-1] == pytest.approx(29.9, abs=0.01)
    assert len(log.time_s) > 285
    assert "skipped" in " ".join(log.notes)
    truth = np.stack([np.interp(log.time_s, TRUTH.time_s, column) for column in TRUTH.position_m.T], axis=1)
    np.testing.assert_allclose(log.position_m, truth, atol=0.02)


@pytest.mark.parametrize("kind", WRITTEN)
@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "empty"),
        (b"\n", "no|is no"),
        (b"PK\x03\x04" + bytes(5000), "no "),
        (bytes(100), "no "),
        (None, "position"),
    ],
)
def test_what_is_no_log_is_refused_in_a_sentence(kind, data, said, tmp_path):
    if data is None:  # a log without positions
        empty = writers.Truth(*(each[:0] for each in vars(TRUTH).values()))
        data = {"tlog": writers.tlog, "bin": writers.dataflash, "ulg": writers.ulog}[kind](empty)
        said = "position|no vehicle"
    with pytest.raises(InputError, match=said):
        read(tmp_path, kind, data)


@pytest.mark.parametrize("kind", ["bin", "ulg"])
def test_numbers_that_make_no_sense_are_left_out(kind, tmp_path):
    """These two have no checksums: damage inside of a message is read."""
    damaged = writers.Truth(*(each.copy() for each in vars(TRUTH).values()))
    damaged.position_m[100] = (1e30, -5.0, 2.0)
    damaged.position_m[101, 2] = 500.0
    damaged.velocity_m_s[150, 0] = 1e35
    damaged.time_s[200] = 1e12
    write = {"bin": writers.dataflash, "ulg": writers.ulog}[kind]
    log = read(tmp_path, kind, write(damaged))
    assert len(log.time_s) == 297
    assert log.time_s[-1] == pytest.approx(29.9, abs=0.01)
    assert np.abs(log.position_m).max() < 20.0
    assert np.isnan(log.velocity_m_s).any(axis=1).sum() == 1
    assert any("3 positions" in note for note in log.notes)


def test_words_come_without_the_colours_of_terminals():
    assert readable("[commander] \x1b[32mReady for takeoff!\x1b[0m\t") == "[commander] Ready for takeoff!"
    assert readable("a\x00b\x9bc") == "a b c"


def test_files_that_cannot_be_read_are_told(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        read_log(tmp_path / "missing.tlog")
    with pytest.raises(InputError, match="folder"):
        read_log(tmp_path)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), kind=st.sampled_from(sorted(WRITTEN)))
def test_hostile_bytes_are_an_error_in_words_or_a_flight(data, kind, tmp_path):
    content = bytearray(WRITTEN[kind][: data.draw(st.integers(20, 40_000))])
    for _ in range(data.draw(st.integers(1, 12))):
        place = data.draw(st.integers(0, len(content) - 1))
        piece = data.draw(st.binary(min_size=1, max_size=40))
        content[place : place + data.draw(st.integers(0, 40))] = piece
    with contextlib.suppress(InputError):
        log = read(tmp_path, kind, bytes(content))
        assert len(log.time_s)
        assert np.isfinite(log.position_m).all()
        assert (np.diff(log.time_s) > 0.0).all()


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=300), kind=st.sampled_from(sorted(WRITTEN)))
def test_noise_behind_a_right_beginning(content, kind, tmp_path):
    with contextlib.suppress(InputError):
        read(tmp_path, kind, WRITTEN[kind][:16] + content)


def test_topics_without_end_are_refused(tmp_path):
    nested = tuple(f"t{k}:uint64_t timestamp;t{k + 1}[60000] x;" for k in range(6))
    for formats in (("loop:uint64_t timestamp;loop x;",), nested):
        with pytest.raises(InputError, match="no end"):
            read(tmp_path, "ulg", writers.ulog(TRUTH, extra_formats=formats))


def test_a_message_of_length_zero_does_not_hang(tmp_path):
    bad = b"\xa3\x95\x80" + bytes([142, 0]) + b"ZERO" + bytes(80)
    log = read(tmp_path, "bin", bad + WRITTEN["bin"])
    assert len(log.time_s) == 300


def test_of_several_vehicles_one_is_chosen(tmp_path):
    other = writers.Truth(TRUTH.time_s, TRUTH.position_m + 100.0, TRUTH.velocity_m_s, TRUTH.quaternion)
    both = WRITTEN["tlog"] + writers.tlog(other, system=2, autopilot=3)
    with pytest.raises(InputError, match=r"1 \(px4 copter\), 2 \(ardupilot copter\)"):
        read(tmp_path, "tlog", both)
    log = read(tmp_path, "tlog", both, system=2)
    assert (log.autopilot, log.system) == ("ardupilot", 2)
    np.testing.assert_allclose(log.position_m, other.position_m, atol=1e-4)
    assert [change.name for change in log.modes] == ["LOITER", "GUIDED", "LOITER"]
    with pytest.raises(InputError, match="no such system"):
        read(tmp_path, "tlog", both, system=3)
    for kind in ("bin", "ulg"):
        with pytest.raises(InputError, match="no such system"):
            read(tmp_path, kind, system=77)


def test_a_ground_station_alone_is_no_vehicle(tmp_path):
    log = writers.Tlog(255)
    for k in range(20):
        log.put(0.1 * k, mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    with pytest.raises(InputError, match="no vehicle"):
        read(tmp_path, "tlog", bytes(log.data))


def test_a_slow_link_does_not_shift_positions(tmp_path):
    """Receptions are late by up to 0.3 s, the vehicle's clock is not."""
    random = np.random.default_rng(3)
    late = random.uniform(0.0, 0.3, 5000)
    log = read(tmp_path, "tlog", writers.tlog(TRUTH, delay=lambda k: late[k]))
    np.testing.assert_allclose(log.time_s, TRUTH.time_s, atol=2e-3)
    assert log.spans_s()[0][0] == pytest.approx(writers.ARMED_S, abs=0.35)


def test_a_vehicle_that_was_switched_on_twice(tmp_path):
    second = writers.tlog(TRUTH, boot_s=3.0)
    stamped = bytearray(second)
    position = 0
    while position < len(stamped):  # an hour later
        stamp = struct.unpack_from(">Q", stamped, position)[0] + 3_600_000_000
        struct.pack_into(">Q", stamped, position, stamp)
        position += 8 + 12 + stamped[position + 9]
    log = read(tmp_path, "tlog", WRITTEN["tlog"] + bytes(stamped))
    assert any("switched on 2 times" in note for note in log.notes)
    assert log.time_s[-1] == pytest.approx(3629.9, abs=0.01)


def test_global_positions_alone_do(tmp_path):
    log = writers.Tlog()
    log.put(0.0, mavlink.MAVLink_heartbeat_message(10, 3, 1, 15, 4, 3))
    for k, t in enumerate(TRUTH.time_s):
        place = writers.at(TRUTH.position_m[k])
        north, east, down = (round(100.0 * v) for v in (TRUTH.velocity_m_s[k][[1, 0, 2]] * [1, 1, -1]))
        ms = round(1e3 * (t + 9.0))
        log.put(t, mavlink.MAVLink_global_position_int_message(
            ms, round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7), round(place.altitude_m * 1e3), 0,
            north, east, down, 0))  # fmt: skip
        log.put(t, mavlink.MAVLink_attitude_message(ms, *writers.ned_euler(TRUTH.quaternion[k]), 0, 0, 0))
    found = read(tmp_path, "tlog", bytes(log.data))
    assert "global ones are taken" in " ".join(found.notes)
    assert found.vehicle == "rover"
    moved = found.moved_to(writers.ORIGIN)
    np.testing.assert_allclose(moved.position_m, TRUTH.position_m, atol=0.02)
    np.testing.assert_allclose(np.abs(np.sum(found.quaternion * TRUTH.quaternion, axis=1)), 1.0, atol=1e-6)


def test_positions_about_another_origin(tmp_path):
    log = read(tmp_path, "ulg")
    place = Geodetic(49.2281, 16.5739, 275.0)
    shift = enu_of_geodetic(writers.ORIGIN, place)
    moved = log.moved_to(place)
    np.testing.assert_allclose(moved.position_m, TRUTH.position_m + shift, atol=2e-3)
    np.testing.assert_allclose(moved.moved_to(writers.ORIGIN).position_m, TRUTH.position_m, atol=1e-5)
    shifted = log.shifted([1.0, 2.0, 3.0])
    np.testing.assert_allclose(shifted.position_m - log.position_m, [[1.0, 2.0, 3.0]] * 300)
    with pytest.raises(ValueError, match="origin"):
        shifted.moved_to(place)


def test_a_rover_of_ardupilot(tmp_path):
    log = read(tmp_path, "bin", writers.dataflash(TRUTH, "ArduRover"))
    assert log.vehicle == "rover"
    assert log.modes[1].name == "HOLD"  # 4, which is GUIDED of a copter


def test_a_gimbal_of_the_same_system_is_not_taken_for_the_vehicle(tmp_path):
    """It tells an attitude and a clock of its own."""
    gimbal = writers.Tlog(1)
    gimbal.link.srcComponent = mavlink.MAV_COMP_ID_GIMBAL
    messages, place = bytearray(), 0
    for k in range(400):
        length = 8 + 12 + WRITTEN["tlog"][place + 9]
        messages += WRITTEN["tlog"][place : place + length]
        place += length
        gimbal.data.clear()
        gimbal.put(0.07 * k, mavlink.MAVLink_attitude_message(70 * k, 0.5, -0.9, 1.2, 0, 0, 0))
        messages += gimbal.data
    log = read(tmp_path, "tlog", bytes(messages + WRITTEN["tlog"][place:]))
    assert log.notes == ()
    np.testing.assert_allclose(log.time_s, TRUTH.time_s, atol=1e-3)
    turned = np.abs(np.sum(log.quaternion * TRUTH.quaternion, axis=1))
    np.testing.assert_allclose(turned, 1.0, atol=1e-6)


@pytest.mark.parametrize("kind", WRITTEN)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_positions_that_are_no_numbers(kind, value, tmp_path):
    write = {"tlog": writers.tlog, "bin": writers.dataflash, "ulg": writers.ulog}[kind]
    position = TRUTH.position_m.copy()
    position[::7] = value
    log = read(tmp_path, kind, write(writers.Truth(TRUTH.time_s, position, TRUTH.velocity_m_s, TRUTH.quaternion)))
    assert len(log.time_s) == 257
    position[:] = value
    with pytest.raises(InputError, match="position"):
        read(tmp_path, kind, write(writers.Truth(TRUTH.time_s, position, TRUTH.velocity_m_s, TRUTH.quaternion)))


def test_a_format_that_is_told_again_otherwise_does_not_change_what_was_read(tmp_path):
    columns = b"TimeUS,C,VN,VE,VD,PN,PE,PD,a,b"
    again = b"\xa3\x95\x80" + bytes([136, 3 + 33 + 128]) + b"XKF1" + b"QBffffffZZ".ljust(16, b"\0")
    log = read(tmp_path, "bin", WRITTEN["bin"] + again + columns.ljust(64, b"\0"))
    np.testing.assert_allclose(log.position_m, TRUTH.position_m, atol=1e-5)


def test_times_that_go_back_are_told(tmp_path):
    log = read(tmp_path, "bin", WRITTEN["bin"] * 2)
    assert len(log.time_s) == 300
    assert any("times go back" in note for note in log.notes)


def test_a_battery_that_tells_no_share(tmp_path):
    """ArduPilot writes 255 where it does not know."""
    data = bytearray(WRITTEN["bin"])
    place = -1
    while (place := data.find(b"\xa3\x95\x8a", place + 1)) >= 0:
        data[place + 12] = 255
    assert len(read(tmp_path, "bin", bytes(data)).battery.values) == 0


def test_long_stretches_of_one_marker_do_not_take_for_ever(tmp_path):
    """The other marker is looked for once: again for each of them it would be hours."""
    log = read(tmp_path, "tlog", WRITTEN["tlog"] + b"\xfd" * 1_000_000)
    assert len(log.time_s) == 300
