"""What a vehicle is told, against a small autopilot: modes, arming, take-off; answers, refusals, silence."""

import threading
import time

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from swarmsim.autopilot.link import LinkError, Mode
from tests.autopilot import test_mavlink_peer as peers
from tests.autopilot.test_mavlink_peer import ARDUPILOT, POSITION, ROVER

SET_MODE, ARM, TAKEOFF = 176, 400, 22


def test_modes_and_arming_are_confirmed_by_the_heartbeat(linked):
    peer, vehicle = linked()
    peer.answers[SET_MODE] = [0, 0]  # as PX4 does
    vehicle.follow(3.0)
    assert peer.custom_mode == peers.OFFBOARD
    assert vehicle.telemetry().mode is Mode.FOLLOW
    vehicle.arm(3.0)
    assert vehicle.telemetry().armed
    vehicle.enter(Mode.LAND, 3.0)
    assert (vehicle.telemetry().mode, vehicle.telemetry().mode_name) == (Mode.LAND, "AUTO_LAND")
    vehicle.disarm(3.0)
    assert vehicle.telemetry().armed is False
    with pytest.raises(ValueError, match="cannot be commanded"):
        vehicle.request(Mode.OTHER)


def test_two_acceptances_do_not_make_a_mode(linked):
    peer, vehicle = linked()
    peer.answers[SET_MODE], peer.obeys = [0, 0], set()
    with pytest.raises(LinkError, match=r"did not follow \(OFFBOARD\)(.|\n)*ACCEPTED(.|\n)*mode AUTO_LOITER"):
        vehicle.follow(0.3)


def test_a_refusal_that_came_true_all_the_same_is_believed(linked):
    """PX4 answers both, 0 and 1, when the stream is missing: the heartbeat alone tells."""
    peer, vehicle = linked()
    peer.answers[SET_MODE] = [1, 0]
    vehicle.follow(3.0)


def test_a_refusal_says_why_and_what_to_do(linked):
    peer, vehicle = linked()
    peer.answers[ARM], peer.obeys, peer.ready = [1], set(), False
    peer.ill = mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    peer.say("Arming denied: compass not calibrated")
    with pytest.raises(LinkError) as caught:
        vehicle.arm(0.5)
    for word in ("TEMPORARILY_REJECTED", "disarmed", "3d mag", "compass not calibrated", "what to do"):
        assert word in str(caught.value)


def test_no_answer_is_asked_again(linked):
    peer, vehicle = linked()
    peer.answers[ARM], peer.obeys = [], set()

    def late() -> None:
        time.sleep(1.2)
        peer.obeys = {ARM}

    thread = threading.Thread(target=late)
    thread.start()
    vehicle.arm(5.0)
    thread.join()
    assert [m.confirmation for m in peer.commands(ARM)] == [0, 1, 2]


def test_an_operator_is_not_overruled(linked):
    peer, vehicle = linked()
    peer.obeys = set()

    def take_over() -> None:
        time.sleep(0.3)
        peer.custom_mode = POSITION

    thread = threading.Thread(target=take_over)
    thread.start()
    with pytest.raises(LinkError, match="mode became POSCTL"):
        vehicle.enter(Mode.LAND, 10.0)
    thread.join()
    asked = len(peer.commands(SET_MODE))
    time.sleep(1.2)
    assert len(peer.commands(SET_MODE)) == asked


def entering(vehicle, mode, timeout_s=10.0):
    """Ask for a mode beside; what came of it is in the list once the thread has ended."""
    errors: list[LinkError] = []

    def enter() -> None:
        try:
            vehicle.enter(mode, timeout_s)
        except LinkError as error:
            errors.append(error)

    thread = threading.Thread(target=enter)
    thread.start()
    return thread, errors


def test_an_operator_who_takes_over_in_a_gap_of_the_link_is_not_overruled(linked):
    peer, vehicle = linked()
    peer.obeys, peer.deaf = set(), {"HEARTBEAT"}
    thread, errors = entering(vehicle, Mode.LAND)
    assert peers.eventually(lambda: peer.commands(SET_MODE))
    peer.custom_mode, peer.obeys = POSITION, {SET_MODE}  # from now on a repetition would be obeyed
    time.sleep(2.5)
    assert len(peer.commands(SET_MODE)) == 1
    peer.deaf = set()
    thread.join()
    assert "mode became POSCTL" in str(errors[0])
    assert peer.custom_mode == POSITION


def test_a_mode_is_asked_for_again_once_a_heartbeat_tells_that_nothing_has_changed(linked):
    peer, vehicle = linked()
    peer.obeys, peer.deaf = set(), {"HEARTBEAT"}
    thread, errors = entering(vehicle, Mode.LAND)
    assert peers.eventually(lambda: peer.commands(SET_MODE))
    peer.obeys = {SET_MODE}
    time.sleep(1.0)
    peer.deaf = set()
    thread.join()
    assert not errors
    assert peer.custom_mode == peers.LAND
    assert [m.confirmation for m in peer.commands(SET_MODE)] == [0, 1]


def test_arming_and_take_off_are_not_repeated_into_silence(linked):
    peer, vehicle = linked({"autopilot": ARDUPILOT})
    peer.obeys, peer.deaf, peer.answers = set(), {"HEARTBEAT"}, {ARM: [], TAKEOFF: []}
    for number, ask in ((ARM, lambda: vehicle.arm(2.0)), (TAKEOFF, lambda: vehicle.take_off(5.0, 2.0))):
        with pytest.raises(LinkError, match="asked once"):
            ask()
        assert len(peer.commands(number)) == 1


def test_a_lost_link_is_told_when_a_command_fails(linked):
    peer, vehicle = linked()
    peer.close()
    with pytest.raises(LinkError, match=r"link is lost(.|\n)*answered nothing"):
        vehicle.arm(2.3)


def test_answers_to_another_ground_station_are_not_ours(linked):
    peer, vehicle = linked()
    peer.ack_target, peer.obeys = (255, 190), set()
    with pytest.raises(LinkError, match="answered nothing"):
        vehicle.arm(0.3)


def test_take_off_of_ardupilot_waits_for_the_climb(linked):
    peer, vehicle = linked({"autopilot": ARDUPILOT})
    peer.answers[TAKEOFF], peer.obeys = [4], set()
    with pytest.raises(LinkError, match=r"did not take off(.|\n)*FAILED(.|\n)*GUIDED"):
        vehicle.take_off(5.0, 0.3)
    peer.answers[TAKEOFF], peer.obeys = [0], {TAKEOFF}
    vehicle.take_off(5.0, 3.0)
    assert peer.position[2] == pytest.approx(-4.5)
    assert peer.commands(TAKEOFF)[-1].param7 == 5.0
    with pytest.raises(ValueError, match="height_m"):
        vehicle.take_off(float("nan"), 1.0)


def test_px4_and_rovers_need_no_take_off(linked):
    for how in ({}, {"autopilot": ARDUPILOT, "kind": ROVER}):
        peer, vehicle = linked(how)
        vehicle.take_off(5.0, 0.1)
        assert not peer.commands(TAKEOFF)
