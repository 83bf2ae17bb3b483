"""Whole flights of an AR.Drone 2.0 and a Pelican by the same `Flight`, over their own links against our peers."""

import threading
import time
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from swarmsim.autopilot.ardrone.navdata import State
from swarmsim.autopilot.flight import Flight
from swarmsim.autopilot.flown import report
from swarmsim.autopilot.link import LinkError
from swarmsim.config.autopilot import Autopilot, Watchdogs
from tests.autopilot.live_missions import UAVS, prepared
from tests.autopilot.stick_peers import ardrone_link, ardrone_peer, pelican_link, pelican_peer

SURVEY = (
    "{name: survey, who: [uav1], policy: waypoints, settings: {points: [[-70, -42], [-66, -42]], "
    "speed_m_s: 1.5, altitude_m: 3.0, climb_speed_m_s: 0.7, descent_speed_m_s: 0.7}, time_limit_s: 60.0}"
)
SETTINGS = Autopilot(
    take_off_m=1.5, answer_s=5.0, ready_s=10.0, take_off_s=20.0, land_s=40.0,
    watchdogs=Watchdogs(heartbeat_s=4.0, position_s=3.0, stale_s=3.0, hold_s=0.1),  # a loaded machine pauses
)  # fmt: skip
OUTLINE = np.array([[-100.0, -100.0], [100.0, -100.0], [100.0, 100.0], [-100.0, 100.0]])


@pytest.fixture(scope="module")
def live():
    return prepared("uav1", UAVS, SURVEY)


@contextmanager
def opened(kind):
    """A peer and the link to it."""
    with ExitStack() as stack:
        peer = stack.enter_context(ardrone_peer() if kind == "ardrone2" else pelican_peer())
        yield peer, stack.enter_context(ardrone_link(peer) if kind == "ardrone2" else pelican_link(peer))


def flown(live, link, happens=None):
    """The flight, and the error that ended it, if one did; ``happens`` in the mission."""
    live.start()
    flight = Flight(link, live, SETTINGS, OUTLINE, True, lambda _: None)
    link.on_mode(flight.on_telemetry)

    def during():
        while "mission" not in [what for _, what in flight.log.events]:
            time.sleep(0.01)
        time.sleep(0.5)
        happens()

    if happens is not None:
        threading.Thread(target=during, daemon=True).start()
    error = None
    try:
        flight.fly()
    except LinkError as found:
        error = found
    return flight, error


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ardrone2", "pelican"])
def test_a_vehicle_flies_its_part_and_lands(live, kind):
    with opened(kind) as (peer, link):
        flight, error = flown(live, link)
        assert error is None
        assert not peer.armed
        assert peer.body.sensed.intact
    summary = report(flight.log, flight.control.stream.gaps_s(), link.identity, "uav1", None)
    assert summary["ended"] == "as planned"
    assert summary["autopilot"]["autopilot"] == kind
    assert summary["cross_track"]["samples"] > 10
    assert summary["cross_track"]["rms_m"] < 0.5
    assert [what for _, what in flight.log.events][-1] == "landed"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "happens", "reason"),
    [
        ("ardrone2", lambda peer: peer.operator_lands(), "operator took over with mode LANDING"),
        ("ardrone2", lambda peer: peer.cut(State.ANGLES), "disarmed"),
        ("pelican", lambda peer: setattr(peer, "serial_enabled", False), "operator took over"),
        ("pelican", lambda peer: setattr(peer, "remote_lost", True), "failsafe"),
        ("pelican", lambda peer: setattr(peer, "battery_v", 10.0), "battery"),
    ],
)
def test_what_happens_to_it_ends_its_flight(live, kind, happens, reason):
    with opened(kind) as (peer, link):
        flight, error = flown(live, link, lambda: happens(peer))
        assert error is None
        assert reason in flight.log.ended
        if reason == "battery":
            assert not peer.armed  # it was brought down
        elif "operator" in reason:
            assert flight.control.takeover_s is not None
