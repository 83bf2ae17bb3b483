"""Where along a track a vehicle was: late, aside, beyond its end; against exact geometry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.autopilot.along_track import distance_from, matched, nearest
from swarmsim.autopilot.compare import Planned, Simulated, Track, compare, time_shift_s

LINES = np.array([[0.0, 0, 10], [40, 0, 10], [40, 200, 10], [80, 200, 10]])  # three phases at right angles
PATHS = tuple(Planned(name, LINES[k : k + 2]) for k, name in enumerate("abc"))
ENDS_M = np.array([0.0, 40.0, 240.0, 280.0])


def flown(speeds, step_s=0.1):
    """Along the lines, each at its speed; with the phase of each place."""
    times = np.r_[0.0, np.cumsum(np.diff(ENDS_M) / speeds)]
    time = np.arange(0.0, times[-1], step_s)
    way = np.interp(time, times, ENDS_M)
    place = np.stack([np.interp(way, ENDS_M, column) for column in LINES.T], axis=1)
    return Track(time, place), np.clip(np.searchsorted(ENDS_M, way, "right") - 1, 0, 2)


MODEL = Simulated(*flown([5.0, 5.0, 5.0], 0.05))


@pytest.mark.parametrize("speed", [2.0, 4.0, 4.5, 4.9, 7.0])
def test_a_vehicle_that_is_late_in_one_phase_has_no_cross_track_error(speed):
    made = compare(flown([5.0, speed, 5.0])[0], PATHS, MODEL)
    report = made.report()
    assert report["whole"]["cross_track"]["max_m"] < 0.3  # where a phase begins, to its sampling
    assert report["whole"]["from_simulated_track"]["max_m"] < 0.3
    assert np.all(np.diff(made.phase) >= 0)
    assert set(made.phase) == {0, 1, 2}


def test_what_is_flown_after_the_simulated_track_counts():
    line = np.array([[0.0, 0, 5], [200, 0, 5]])
    time = np.arange(0.0, 40.0, 0.05)
    model = Simulated(
        Track(time, np.stack([5.0 * time, 0.0 * time, 5.0 + 0.0 * time], axis=1)), np.zeros(len(time), int)
    )
    time = np.arange(0.0, 66.0, 0.1)
    aside = np.where(time > 54.0, 20.0, 0.0)
    made = compare(Track(time, np.stack([3.0 * time, aside, 5.0 + 0.0 * time], axis=1)), [Planned("line", line)], model)
    report = made.report()
    assert report["to_s"] > 65.0 > report["common_to_s"]
    assert report["whole"]["cross_track"]["max_m"] == pytest.approx(20.0, abs=0.01)
    assert report["whole"]["cross_track"]["rms_m"] == pytest.approx(np.sqrt(np.mean(aside**2)), abs=0.3)


@pytest.mark.parametrize("jitter_s", [0.0, 0.02])
@pytest.mark.parametrize("period_s", [0.2, 1.0, 1.02])
def test_positions_of_a_radio_link_are_compared(period_s, jitter_s):
    track = flown([5.0, 5.0, 5.0], period_s)[0]
    times = track.time_s + jitter_s * np.random.default_rng(1).uniform(-1.0, 1.0, len(track.time_s))
    place = np.stack([np.interp(times, MODEL.track.time_s, column) for column in MODEL.track.position_m.T], axis=1)
    made = compare(Track(times, place), PATHS, MODEL)
    assert made.shift_s == pytest.approx(0.0, abs=0.05)
    assert np.isfinite(made.synchronised_m).mean() > 0.95
    assert made.report()["whole"]["cross_track"]["rms_m"] < 0.2


@pytest.mark.parametrize("offset", [(15.0, 0.0), (30.0, 0.0), (0.0, -20.0)])
def test_a_flight_far_aside_is_not_said_to_have_no_common_part(offset):
    time = np.arange(0.0, 30.0, 0.05)
    circle = Track(time, np.stack([12.0 * np.cos(0.2 * time), 12.0 * np.sin(0.2 * time), 5.0 + 0.0 * time], axis=1))
    away = Track(time + 5.0, circle.position_m + np.array([*offset, 0.0]))
    made = compare(away, [Planned("circle", circle.position_m)], Simulated(circle, np.zeros(len(time), int)))
    assert made.shift_s == pytest.approx(5.0, abs=0.01)
    np.testing.assert_allclose(np.nanmax(made.synchronised_m), np.hypot(*offset), rtol=0.01)
    assert made.report()["whole"]["cross_track"]["samples"] == len(made.time_s)
    assert time_shift_s(away, circle) == made.shift_s


def test_a_match_is_the_cheapest_that_never_goes_back():
    rng = np.random.default_rng(3)
    places, track = rng.normal(size=(6, 3)), rng.normal(size=(5, 3))
    scale = np.array([1.0, 1.0, 0.1])
    cost = np.linalg.norm((places[:, None] - track[None]) * scale, axis=2)
    found = matched(places, track)
    assert np.all(np.diff(found) >= 0)
    every = np.array(list(_never_back(6, 5)))
    assert cost[np.arange(6), found].sum() == pytest.approx(cost[np.arange(6), every].sum(axis=1).min())


def _never_back(rows, columns, first=0):
    if rows == 0:
        yield []
        return
    for column in range(first, columns):
        for rest in _never_back(rows - 1, columns, column):
            yield [column, *rest]


@given(st.integers(0, 2**31 - 1), st.integers(2, 30), st.sampled_from([0.01, 1.0, 30.0]))
def test_distances_are_those_of_exact_geometry(seed, count, scale):
    rng = np.random.default_rng(seed)
    track = np.cumsum(rng.normal(scale=scale, size=(count, 3)), axis=0)
    places = rng.normal(scale=2.0 * scale * count**0.5, size=(40, 3))
    exact = nearest(places[:, :2], track)[0]
    np.testing.assert_allclose(distance_from(places, track), exact, atol=0.06 if scale < 1.0 else 0.03)


def test_a_vehicle_that_stood_has_one_place():
    track = np.zeros((50, 3))
    np.testing.assert_allclose(distance_from(np.array([[3.0, 4.0, 0.0]]), track), [5.0])
    assert list(matched(np.zeros((4, 3)), track[:1])) == [0, 0, 0, 0]
