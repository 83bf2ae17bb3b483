"""Errors of a flown track: known offsets and delays are found again."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.autopilot.along_track import nearest
from swarmsim.autopilot.compare import (
    Planned,
    Simulated,
    Track,
    compare,
    leg_ends_m,
    on_lines,
    statistics,
    time_shift_s,
)

SQUARE = np.array([[0.0, 0, 5], [20, 0, 5], [20, 20, 5], [0, 20, 5]])


def along(path: np.ndarray, speed: float = 2.0, start_s: float = 0.0, rate_hz: float = 20.0) -> Track:
    """A vehicle that follows a path at constant speed."""
    arc = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    time = np.arange(0.0, arc[-1] / speed, 1.0 / rate_hz)
    place = np.stack([np.interp(time * speed, arc, column) for column in path.T], axis=1)
    return Track(time + start_s, place)


def simulated(track: Track) -> Simulated:
    return Simulated(track, np.zeros(len(track.time_s), int))


def moved(track: Track, shift_s: float = 0.0, offset_m=(0.0, 0.0, 0.0)) -> Track:
    return Track(track.time_s + shift_s, track.position_m + np.asarray(offset_m))


@settings(max_examples=25, deadline=None)
@given(
    shift=st.floats(-500.0, 500.0),
    up=st.floats(-2.0, 2.0),
    rate=st.sampled_from([5.0, 20.0, 50.0, 133.0]),
)
def test_a_known_delay_and_height_are_found(shift, up, rate):
    model = along(SQUARE)
    flown = moved(along(SQUARE, rate_hz=rate), shift, (0.0, 0.0, up))
    made = compare(flown, [Planned("square", SQUARE)], simulated(model))
    assert made.shift_s == pytest.approx(shift, abs=0.02)
    whole = made.report()["whole"]
    assert whole["synchronised"]["rms_m"] < 0.05
    assert whole["above_simulated"]["rms_m"] == pytest.approx(abs(up), abs=0.02)
    assert whole["above_path"]["rms_m"] == pytest.approx(abs(up), abs=0.02)
    assert whole["cross_track"]["max_m"] < 0.1


@settings(max_examples=25, deadline=None)
@given(offset=st.floats(0.01, 3.0), angle=st.floats(0.0, 2.0 * np.pi), shift=st.floats(-50.0, 50.0))
def test_a_constant_offset_is_the_synchronised_error(offset, angle, shift):
    """A loop comes back to where it began: an offset cannot be taken for a delay."""
    loop = np.concatenate([SQUARE, SQUARE[:1]])
    away = (offset * np.cos(angle), offset * np.sin(angle), 0.0)
    made = compare(moved(along(loop), shift, away), (), simulated(along(loop)))
    told = made.report()["whole"]["synchronised"]
    assert told["rms_m"] == pytest.approx(offset, rel=0.05)
    assert made.shift_s == pytest.approx(shift, abs=0.1 + 0.05 * offset)


def test_cross_track_of_a_parallel_line():
    line = np.array([[0.0, 0, 3], [30, 0, 3]])
    flown = moved(along(line), 0.0, (0.0, 0.4, -0.5))
    made = compare(flown, [Planned("line", line)])
    assert made.shift_s is None
    assert np.isnan(made.synchronised_m).all()
    assert np.allclose(made.cross_track_m, 0.4)
    assert np.allclose(made.above_path_m, -0.5)
    report = made.report()
    assert report["whole"]["synchronised"] is None
    assert report["phases"][0]["phase"] == "line"
    told = report["whole"]["cross_track"]
    assert told["samples"] == len(made.time_s)
    assert [told[name] for name in ("rms_m", "p95_m", "max_m")] == pytest.approx([0.4, 0.4, 0.4])


def test_a_lag_is_a_synchronised_error_and_no_geometric_one():
    """A vehicle that is 1 s late on the second half alone."""
    line = np.array([[0.0, 0, 3], [80, 0, 3]])
    model = along(line)
    late = np.where(model.time_s > 20.0, model.time_s - np.minimum(model.time_s - 20.0, 1.0), model.time_s)
    flown = Track(model.time_s, np.stack([2.0 * late, np.zeros(len(late)), np.full(len(late), 3.0)], axis=1))
    made = compare(flown, [Planned("line", line)], simulated(model))
    whole = made.report()["whole"]
    assert whole["cross_track"]["max_m"] < 1e-6
    assert whole["from_simulated_track"]["max_m"] < 1e-6
    assert 0.9 < whole["synchronised"]["rms_m"] < 1.1  # one shift makes half of the 2 m of each part
    assert 0.4 < made.shift_s < 0.6


def test_corners_are_told_from_lines():
    speed = np.array([2.0, 2.1, 1.4, 0.2, np.nan])
    assert on_lines(speed).tolist() == [True, True, False, False, False]
    assert not on_lines(np.array([np.nan])).any()
    assert leg_ends_m(SQUARE) == pytest.approx([20.0, 40.0])
    fine = along(SQUARE, rate_hz=100.0).position_m
    assert leg_ends_m(fine) == pytest.approx([20.0, 40.0], abs=0.1)
    assert len(leg_ends_m(SQUARE[:2])) == 0
    legs = compare(along(SQUARE), [Planned("square", SQUARE)]).report()["legs"]
    assert [leg["leg"] for leg in legs] == [1, 2, 3]


def test_phases_are_judged_by_their_own_paths():
    """The second phase flies the first one's path 3 m beside: the nearest path would hide it."""
    first = np.array([[0.0, 0, 5], [40, 0, 5]])
    second = first + np.array([0.0, 3.0, 0.0])
    a, b = along(first), along(second, start_s=25.0)
    model = Track(np.r_[a.time_s, b.time_s], np.concatenate([a.position_m, b.position_m]))
    phase = np.r_[np.zeros(len(a.time_s), int), np.ones(len(b.time_s), int)]
    flown = Track(model.time_s, np.concatenate([a.position_m, b.position_m - [0.0, 3.0, 0.0]]))
    made = compare(flown, [Planned("one", first), Planned("two", second)], Simulated(model, phase))
    one, two = (entry["cross_track"]["rms_m"] for entry in made.report()["phases"])
    assert one < 0.2
    assert two > 2.5


def test_only_the_spans_are_judged():
    line = np.array([[0.0, 0, 3], [30, 0, 3]])
    track = along(line)
    made = compare(track, [Planned("line", line)], None, [(2.0, 4.0), (6.0, 7.0)])
    assert made.time_s.min() >= 2.0
    assert made.time_s.max() <= 7.0
    assert not ((made.time_s > 4.01) & (made.time_s < 5.99)).any()


def test_without_a_common_part_there_is_no_shift():
    track = along(SQUARE)
    assert time_shift_s(Track(track.time_s[:1], track.position_m[:1]), track) is None
    assert time_shift_s(Track(np.zeros(0), np.zeros((0, 3))), track) is None
    made = compare(Track(np.zeros(0), np.zeros((0, 3))), [Planned("square", SQUARE)], simulated(track))
    assert made.report()["whole"]["cross_track"] is None
    gaps = Track(track.time_s[::100], track.position_m[::100])  # 5 s apart: nothing is known in between
    assert time_shift_s(gaps, track) is None


def test_a_flight_that_was_broken_off_is_compared():
    model = along(SQUARE)
    flown = moved(Track(model.time_s[:300], model.position_m[:300]), 7.0)
    assert time_shift_s(flown, model) == pytest.approx(7.0, abs=0.02)


LAWN = np.array([[0.0, 0, 5], [5, 30, 5], [45, 30, 5], [45, 18, 5], [5, 18, 5], [5, 6, 5], [45, 6, 5], [0, 0, 5]])


def joined(parts, rate_hz=20.0):
    """Tracks one after the other, standing still for the seconds in between, on one clock that begins at 0."""
    times, places, now = [], [], 0.0
    for part in parts:
        if isinstance(part, float):
            count = int(part * rate_hz)
            times.append(now + np.arange(count) / rate_hz)
            places.append(np.repeat(places[-1][-1:] if places else LAWN[:1], count, axis=0))
            now += count / rate_hz
        else:
            times.append(now + part.time_s - part.time_s[0])
            places.append(part.position_m)
            now = float(times[-1][-1]) + 1.0 / rate_hz
    return Track(np.concatenate(times), np.concatenate(places))


@settings(max_examples=40, deadline=None)
@given(
    shift=st.floats(-300.0, 300.0),
    stood=st.floats(0.0, 120.0),
    share=st.floats(0.15, 1.0),
    noise=st.floats(0.0, 0.5),
    after=st.sampled_from(["nothing", "stands", "flies home", "flies home and stands"]),
    seed=st.integers(0, 1000),
)
def test_the_shift_of_a_flight_that_was_broken_off_is_found(shift, stood, share, noise, after, seed):
    """It may stand on the ground before, for longer than it flies, and fly home where no simulated vehicle does."""
    model = along(LAWN)
    count = int(share * len(model.time_s))
    flight = Track(model.time_s[:count], model.position_m[:count])
    home = along(np.array([flight.position_m[-1], [0.0, 0.0, 5.0]]), 6.0)
    tail = {"nothing": [], "stands": [40.0], "flies home": [home], "flies home and stands": [home, 60.0]}[after]
    whole = joined([stood, flight, *tail])
    blur = noise * np.random.default_rng(seed).normal(size=whole.position_m.shape)
    flown = moved(Track(whole.time_s, whole.position_m + blur), shift)
    began = int(stood * 20.0) / 20.0
    assert time_shift_s(flown, model) == pytest.approx(shift + began, abs=0.05 + 0.4 * noise)


@settings(max_examples=20, deadline=None)
@given(share=st.floats(0.1, 0.95), stood=st.floats(0.0, 60.0))
def test_a_flight_broken_off_on_laps_is_that_of_the_first_ones(share, stood):
    lap = np.concatenate([SQUARE, SQUARE[:1]])
    model = along(np.concatenate([lap, lap[1:], lap[1:]]))
    count = int(share * len(model.time_s))
    flown = joined([stood, Track(model.time_s[:count], model.position_m[:count])])
    assert time_shift_s(flown, model) == pytest.approx(int(stood * 20.0) / 20.0, abs=0.05)


def test_a_flight_that_is_slower_all_along_has_the_shift_of_the_least_rms():
    line = np.array([[0.0, 0, 3], [200, 0, 3]])
    model, flown = along(line, 4.0), along(line, 3.0)
    found = time_shift_s(flown, model)
    error = {s: np.nanmean((flown.at(model.time_s + s) - model.position_m)[:, 0] ** 2) for s in (found - 3, found, 0.0)}
    assert error[found] < error[0.0]
    made = compare(flown, (), simulated(model)).report()["whole"]["synchronised"]
    assert made["rms_m"] < 25.0


def test_gaps_are_not_bridged():
    track = Track(np.array([0.0, 0.5, 3.0, 3.5]), np.zeros((4, 3)))
    assert np.isfinite(track.at([0.2, 3.2])).all()
    assert np.isnan(track.at([1.0, 2.9, -0.1, 3.6])).all()
    assert Track(np.zeros(0), np.zeros((0, 3))).at([1.0]).shape == (1, 3)


@settings(max_examples=50, deadline=None)
@given(
    points=st.lists(st.tuples(*[st.floats(-50.0, 50.0)] * 3), min_size=1, max_size=8),
    place=st.tuples(*[st.floats(-60.0, 60.0)] * 2),
)
def test_the_nearest_place_is_the_nearest(points, place):
    path = np.array(points)
    distance, height, along_m = nearest(np.array([place]), path)
    dense = path
    if len(path) > 1:
        dense = np.concatenate([a + (b - a) * np.linspace(0.0, 1.0, 200)[:, None] for a, b in pairwise(path)])
    brute = np.linalg.norm(dense[:, :2] - np.array(place), axis=1)
    assert distance[0] <= brute.min() + 1e-6
    assert distance[0] >= brute.min() - 1.0
    assert path[:, 2].min() - 1e-6 <= height[0] <= path[:, 2].max() + 1e-6
    assert along_m[0] >= 0.0


def test_statistics_of_magnitudes():
    assert statistics(np.array([np.nan, np.inf])) is None
    told = statistics(np.array([-3.0, 4.0, np.nan]))
    assert told == {"samples": 2, "rms_m": pytest.approx(12.5**0.5), "p95_m": pytest.approx(3.95), "max_m": 4.0}


def test_on_the_way_up_and_where_a_path_crosses_itself_the_height_is_that_of_its_own_part():
    """Up to 8 m over the start, away, and back over the first leg at 14 m."""
    path = np.array([[0.0, 0, 0], [0, 0, 8], [20, 0, 8], [20, 10, 14], [10, -10, 14]])
    fine = np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(path)])
    flown = along(path)
    distance, height, _ = nearest(flown.position_m, fine)
    np.testing.assert_allclose(height, flown.position_m[:, 2], atol=0.1)
    assert distance.max() < 0.01
    lifted = moved(flown, offset_m=(0.0, 0.3, 0.5))
    level = lifted.position_m[:, 0] > 1.0
    distance, height, _ = nearest(lifted.position_m[level], fine)
    assert np.median(lifted.position_m[level, 2] - height) == pytest.approx(0.5, abs=0.05)
    assert distance.max() < 0.31
