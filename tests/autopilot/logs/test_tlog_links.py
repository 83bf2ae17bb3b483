"""Telemetry logs of real links: told twice, told rarely, told late, and before there is an estimate."""

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.frames import enu_of_geodetic, ned_of_enu
from swarmsim.autopilot.logs.reading import read_log
from tests.autopilot.logs import writers

TRUTH = writers.flight()


def read(tmp_path, data):
    path = tmp_path / "flight.tlog"
    path.write_bytes(data)
    return read_log(path)


def test_what_a_second_slower_link_tells_again_is_heard_once(tmp_path):
    log = writers.Tlog()
    for k, t in enumerate(np.repeat(TRUTH.time_s, 2)):
        late = 1.5 if k % 2 else 0.0
        ms, row = round((t + 100.0) * 1e3), k // 2
        position = ned_of_enu(TRUTH.position_m[row]), ned_of_enu(TRUTH.velocity_m_s[row])
        log.put(t + late, mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 4, 3))
        log.put(t + late, mavlink.MAVLink_local_position_ned_message(ms, *position[0], *position[1]))
    data = bytes(log.data)
    rows = sorted(_frames(data))  # in the order of reception
    found = read(tmp_path, b"".join(rows))
    assert not found.notes
    np.testing.assert_allclose(found.time_s, TRUTH.time_s, atol=2e-3)
    np.testing.assert_allclose(found.position_m, TRUTH.position_m, atol=1e-5)


def _frames(data):
    start = 0
    while start < len(data):
        size = 8 + 12 + data[start + 9]
        yield data[start : start + size]
        start += size


@pytest.mark.parametrize("lost", ["first", "all"])
def test_local_positions_before_there_is_an_estimate(lost, tmp_path):
    log = writers.Tlog()
    for k, t in enumerate(TRUTH.time_s):
        ms, none = round(t * 1e3), [np.nan] * 6
        known = lost == "first" and t >= 5.0
        local = [*ned_of_enu(TRUTH.position_m[k]), *ned_of_enu(TRUTH.velocity_m_s[k])] if known else none
        log.put(t, mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 4, 3))
        log.put(t, mavlink.MAVLink_local_position_ned_message(ms, *local))
        log.put(t, _globe(ms, TRUTH.position_m[k]))
    found = read(tmp_path, bytes(log.data))
    assert np.isfinite(found.position_m).all()
    assert np.allclose(
        enu_of_geodetic(found.origin, writers.ORIGIN), 0.0 if lost == "first" else TRUTH.position_m[0], atol=0.03
    )


def _globe(ms, place_m):
    place = writers.at(place_m)
    numbers = (place.latitude_deg * 1e7, place.longitude_deg * 1e7, place.altitude_m * 1e3)
    return mavlink.MAVLink_global_position_int_message(ms, *(round(v) for v in numbers), 0, 0, 0, 0, 0)


@pytest.mark.parametrize("after_s", [0.05, 0.1, 0.15])
def test_the_origin_of_positions_told_in_turn(after_s, tmp_path):
    """Local and global positions at 5 Hz each, never at the same time."""
    log = writers.Tlog()
    for t in np.arange(0.0, 20.0, 0.2):
        log.put(t, mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 4, 3))
        log.put(t, mavlink.MAVLink_local_position_ned_message(round(t * 1e3), 0.0, 6.0 * t, -5.0, 0.0, 6.0, 0.0))
        log.put(t + after_s, _globe(round((t + after_s) * 1e3), np.array([6.0 * (t + after_s), 0.0, 5.0])))
    found = read(tmp_path, bytes(log.data))
    assert np.allclose(enu_of_geodetic(found.origin, writers.ORIGIN), 0.0, atol=0.02)


def test_of_rare_local_and_frequent_global_positions_the_latter_are_taken(tmp_path):
    log = writers.Tlog()
    for k, t in enumerate(TRUTH.time_s):
        ms = round(t * 1e3)
        log.put(t, mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 4, 3))
        if k % 10 == 0:
            both = (*ned_of_enu(TRUTH.position_m[k]), *ned_of_enu(TRUTH.velocity_m_s[k]))
            log.put(t, mavlink.MAVLink_local_position_ned_message(ms, *both))
        log.put(t, _globe(ms, TRUTH.position_m[k]))
    found = read(tmp_path, bytes(log.data))
    assert len(found.time_s) == len(TRUTH.time_s)
    assert any("local positions are rare" in note for note in found.notes)
    np.testing.assert_allclose(found.position_m, TRUTH.position_m, atol=0.03)


def test_words_are_put_on_the_clock_of_a_simulator_that_falls_behind(tmp_path):
    """For 40 s it makes half of the pace: the modes are told at twice the vehicle's own times, then 20 s late."""
    truth = writers.flight()
    log = writers.Tlog()
    for k, t in enumerate(truth.time_s):
        when = 2.0 * min(t, 20.0) + max(t - 20.0, 0.0)
        mode = 6 << 16 if 10.0 <= t < 25.0 else 4 << 16 | 3 << 24
        log.put(when, mavlink.MAVLink_heartbeat_message(2, 12, 1 | 128, mode, 4, 3))
        log.put(when, mavlink.MAVLink_local_position_ned_message(
            round((t + 50.0) * 1e3), *ned_of_enu(truth.position_m[k]), *ned_of_enu(truth.velocity_m_s[k])))  # fmt: skip
    found = read(tmp_path, bytes(log.data))
    assert found.spans_s() == [pytest.approx((10.0, 25.0), abs=0.6)]
    np.testing.assert_allclose(found.position_m, truth.position_m, atol=1e-5)
