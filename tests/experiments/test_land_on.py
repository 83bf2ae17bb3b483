"""The landing campaign: its routes, how it judges a landing, and its table."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from swarmsim.results.record import Event

PATH = Path(__file__).parents[2] / "experiments" / "flight" / "land_on.py"
STEP_S = 0.05
FEET = np.array([[0.1, 0.1, -0.2], [-0.1, 0.1, -0.2], [-0.1, -0.1, -0.2], [0.1, -0.1, -0.2]])


@pytest.fixture(scope="module")
def campaign():
    spec = importlib.util.spec_from_file_location("land_on_experiment", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def record(offset_m=(0.05, 0.02), fall_at_s=None, event=None):
    """A UAV that comes down at 0.5 m/s on a rover that drives north at 1 m/s, touches at 4 s and is done at 5 s."""
    time = STEP_S * np.arange(1, 300)
    ahead = np.stack([0.0 * time, time, 0.0 * time], -1)
    turned = np.tile([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], (len(time), 1))  # it looks north
    north = np.tile([0.0, 1.0, 0.0], (len(time), 1))
    height = np.maximum(0.5 * (4.0 - time), 0.0)
    if fall_at_s is not None:
        height = np.where(time > fall_at_s, -0.3, height)
    along, across = offset_m
    place = ahead + np.stack([0.0 * time - across, 0.0 * time + along, 0.3 + 0.2 + height], -1)
    down = north - np.array([0.0, 0.0, 0.5]) * (time < 4.0)[:, None]
    uav = SimpleNamespace(name="uav", time_s=time, position_m=place, quaternion=turned, velocity_m_s=down)
    rover = SimpleNamespace(name="rover", time_s=time, position_m=ahead, quaternion=turned, velocity_m_s=north)
    events = [Event(5.0, "uav", "finished", "")] + ([Event(6.0, "uav", event, "")] if event else [])
    return SimpleNamespace(seed=2, vehicles=(uav, rover), events=tuple(events))


def deck(campaign):
    return campaign.Deck(half_m=np.array([0.375, 0.21]), height_m=0.3, feet_m=FEET)


def test_a_landing_is_measured_where_it_touches_the_deck(campaign):
    row = campaign.judge(record(), deck(campaign))
    assert row["success"]
    assert (row["along_m"], row["across_m"]) == pytest.approx((0.05, 0.02), abs=1e-6)
    assert row["touchdown_s"] == pytest.approx(4.0, abs=2 * STEP_S)
    assert (row["slip_m_s"], row["sink_m_s"]) == pytest.approx((0.0, 0.5), abs=1e-6)
    assert row["feet_margin_m"] == pytest.approx(0.21 - 0.1 - 0.02, abs=1e-6)
    assert row["go_arounds"] == 0


@pytest.mark.parametrize(
    ("changes", "landed", "stays"),
    [
        ({"fall_at_s": 7.0}, True, False),
        ({"event": "crash"}, True, True),
        ({"offset_m": (0.0, 0.3)}, False, False),
    ],
)
def test_what_falls_crashes_or_misses_the_deck_is_no_success(campaign, changes, landed, stays):
    row = campaign.judge(record(**changes), deck(campaign))
    assert (row["landed"], row["stays"], row["success"]) == (landed, stays, False)
    text = campaign.table([row, campaign.judge(record(), deck(campaign))], "test")
    assert "1 of 2: 50.0 %" in text
    assert "not met" in text


def test_routes_and_starts_stay_on_the_field_and_every_second_route_bends(campaign):
    drawn = campaign.draw(range(64))
    routes = np.array(drawn["phases.drive.settings.points"])
    starts = np.array(drawn["vehicles.uav.position_m"])
    assert np.abs(routes - campaign.MIDDLE_M).max() < 45.0
    assert np.abs(starts - campaign.MIDDLE_M).max() < 60.0
    legs = np.diff(routes, axis=1)
    turn = np.abs(legs[:, 0, 0] * legs[:, 1, 1] - legs[:, 0, 1] * legs[:, 1, 0]) / campaign.LEG_M**2
    np.testing.assert_array_equal(turn > 0.1, np.arange(64) % 2 == 1)
