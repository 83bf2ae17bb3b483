"""The link to an AscTec Pelican against a peer of ours, in each of its modes; takeovers, refusals, losses."""

import os
import time

import numpy as np
import pytest

from swarmsim.autopilot.link import LinkError, Mode, Setpoint
from swarmsim.autopilot.pelican import PelicanSettings, PelicanVehicle, packets
from swarmsim.autopilot.pelican.packets import Control, FlightMode
from swarmsim.autopilot.settings import load_settings
from swarmsim.autopilot.standin.kinematic import KinematicBody
from swarmsim.autopilot.standin.pelican import PelicanStandin, PelicanStandinSettings
from tests.autopilot.stick_peers import airborne, pelican_link, pelican_peer, until


@pytest.mark.slow
@pytest.mark.parametrize("switch", ["gps", "height", "attitude"])
def test_it_climbs_goes_where_it_is_told_and_lands(switch, tmp_path):
    log = tmp_path / "flight.log"
    with pelican_peer(switch) as peer, pelican_link(peer, log=log) as link:
        told = []
        link.preflight(told.append, 10.0)
        assert any(switch.upper() in line for line in told)
        link.align((10.0, 20.0, 5.0))
        t = link.telemetry()
        assert t.position_m == pytest.approx((10.0, 20.0, 5.0), abs=0.05)
        assert (t.armed, t.on_ground, t.gnss_fix, t.estimate_ok) == (False, True, 3, True)
        link.follow(3.0)
        assert link.telemetry().mode is Mode.FOLLOW
        link.arm(5.0)
        assert peer.motors_on
        link.take_off(1.5, 20.0)
        goal = Setpoint(position_m=(12.0, 21.0, 7.0), yaw_rad=0.5)
        for _ in range(160):
            link.send(goal)
            time.sleep(0.05)
            if np.allclose(link.telemetry().position_m, goal.position_m, atol=0.1):
                break
        assert np.allclose(link.telemetry().position_m, goal.position_m, atol=0.3)
        assert np.allclose(peer.body.sensed.position_m, (2.0, 1.0, 2.0), atol=0.5)
        link.enter(Mode.HOLD, 3.0)
        place = peer.body.sensed.position_m
        time.sleep(1.0)
        assert np.allclose(peer.body.sensed.position_m, place, atol=0.5)
        link.enter(Mode.LAND, 3.0)
        until(lambda: link.telemetry().armed is False)
        assert peer.body.sensed.landed
        assert peer.log == ["motors on", "motors off"]
        assert peer.bad == 0
    assert "3e2a3e6469" in log.read_text()  # >*>di


def test_the_operator_takes_over_with_the_switch():
    with pelican_peer() as peer, pelican_link(peer) as link:
        airborne(link)
        seen = []
        link.on_mode(seen.append)
        peer.serial_enabled = False
        until(lambda: bool(seen))
        assert (seen[0].mode, seen[0].failsafe) == (Mode.OTHER, False)
        time.sleep(0.3)  # what was on the line before the takeover was seen has come
        peer._control = None
        peer.serial_enabled = True  # given back: this side does not take it again by itself
        for _ in range(10):
            link.send(Setpoint(velocity_m_s=(1.0, 0.0, 0.0)))
            time.sleep(0.05)
        assert peer._control is None
        assert any("switched" in line for line in link.messages())


def test_a_lost_remote_control_is_a_failsafe():
    with pelican_peer() as peer, pelican_link(peer) as link:
        airborne(link)
        peer.remote_lost = True
        until(lambda: link.telemetry().failsafe)
        assert link.telemetry().mode is Mode.OTHER
        assert "EMERGENCY" in link.telemetry().mode_name


def test_the_mode_switch_may_be_moved_in_flight():
    with pelican_peer("gps") as peer, pelican_link(peer) as link:
        airborne(link, 2.0)
        goal = Setpoint(position_m=(11.0, 20.0, 7.0), velocity_m_s=(0.0, 0.0, 0.0))
        for switch in ("height", "attitude", "gps"):
            peer.switch = switch
            for _ in range(40):
                link.send(goal)
                time.sleep(0.05)
        assert np.allclose(peer.body.sensed.position_m, (1.0, 0.0, 2.0), atol=0.6)


def test_without_setpoints_it_holds_its_place():
    with pelican_peer("height") as peer, pelican_link(peer) as link:
        airborne(link)
        for _ in range(20):
            link.send(Setpoint(velocity_m_s=(1.0, 0.0, 0.0)))
            time.sleep(0.05)
        time.sleep(4.0)
        assert np.linalg.norm(peer.body.sensed.velocity_m_s) < 0.15
        assert link.telemetry().mode is Mode.FOLLOW


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"serial_enabled": False}, "serial interface is off"),
        ({"battery_v": 10.0}, "battery is at 7 %"),
        ({"remote_lost": True}, "remote control is not heard"),
    ],
)
def test_what_it_is_not_ready_for_is_told(change, word):
    with pelican_peer() as peer, pelican_link(peer) as link:
        for name, value in change.items():
            setattr(peer, name, value)
        time.sleep(0.1)  # what is under way
        with pytest.raises(LinkError, match=word):
            link.preflight(lambda _: None, 1.0)


def test_missing_satellites_are_told():
    with pelican_peer() as peer, pelican_link(peer) as link:
        peer.faults.no_satellites = True
        time.sleep(0.1)
        with pytest.raises(LinkError, match="satellites"):
            link.preflight(lambda _: None, 1.0)
        until(lambda: link.telemetry().gnss_fix == 1)


def test_motors_that_do_not_start_are_told():
    with pelican_peer() as peer, pelican_link(peer) as link:
        peer.faults.motors_stuck = True
        link.preflight(lambda _: None, 10.0)
        link.align((0.0, 0.0, 0.0))
        link.follow(2.0)
        with pytest.raises(LinkError, match="start its motors"):
            link.arm(0.8)


def test_motors_are_stopped_on_the_ground_alone():
    with pelican_peer() as peer, pelican_link(peer) as link:
        link.preflight(lambda _: None, 10.0)
        link.align((0.0, 0.0, 0.0))
        link.follow(2.0)
        link.arm(5.0)
        link.disarm(5.0)
        assert not peer.motors_on
        link.follow(2.0)
        link.arm(5.0)
        link.take_off(1.2, 20.0)
        with pytest.raises(LinkError, match="in the air"):
            link.disarm(1.0)
        assert peer.motors_on


def test_a_line_that_falls_silent_is_seen():
    with pelican_peer() as peer, pelican_link(peer) as link:
        airborne(link)
        peer.faults.corrupt = True
        until(lambda: link._replies.bad > 3)
        heard = link.telemetry().heard_s
        time.sleep(0.6)
        assert link.telemetry().heard_s == heard
        with pytest.raises(LinkError, match="nothing is heard"):
            link.enter(Mode.LAND, 1.2)
        peer.faults.corrupt = False
        until(lambda: not peer.motors_on)  # it was told to land, and does


def test_nobody_at_the_other_end_is_told():
    with pelican_peer() as peer:
        peer.faults.silent = True
        with pytest.raises(LinkError, match="baud rate"), pelican_link(peer, timeout_s=0.3):
            pass
    with pytest.raises(LinkError, match="plugged in"):
        PelicanVehicle("/dev/no_such_device", load_settings("pelican", PelicanSettings))


def test_a_dry_link_moves_nothing():
    with pelican_peer() as peer, pelican_link(peer, dry=True) as link:
        airborne(link)
        link.enter(Mode.LAND, 1.0)
        assert peer._control is None
        assert any("dry" in line for line in link.messages())


# the peer itself, stepped without a clock


@pytest.fixture
def pelican():
    peer = PelicanStandin(KinematicBody(), load_settings("standin_pelican", PelicanStandinSettings))
    os.set_blocking(peer._other, False)
    yield peer
    peer.close()


def stepped(pelican, seconds, control=None):
    for _ in range(round(seconds / pelican.body.step_s)):
        if control is not None:
            os.write(pelican._other, packets.encode_control(control))
        pelican.step()


COMBINATION = Control(yaw=-2047, ctrl=packets.YAW | packets.THRUST)


def test_the_peer_switches_its_motors_as_long_as_the_combination_is_held(pelican):
    stepped(pelican, 0.5, COMBINATION)
    assert not pelican.motors_on
    stepped(pelican, 0.5, COMBINATION)
    assert pelican.motors_on
    stepped(pelican, 0.9, COMBINATION)
    assert not pelican.motors_on


def test_the_peer_lets_go_of_sticks_that_do_not_come(pelican):
    stepped(pelican, 1.0, COMBINATION)
    stepped(pelican, 2.0, Control(pitch=1000, thrust=3000))
    assert pelican.flight_mode & FlightMode.SERIAL_ACTIVE
    stepped(pelican, 3.0)
    assert not pelican.flight_mode & FlightMode.SERIAL_ACTIVE
    assert np.linalg.norm(pelican.body.sensed.velocity_m_s) < 0.1


def test_the_peer_follows_the_axes_that_are_enabled_alone(pelican):
    stepped(pelican, 1.0, COMBINATION)
    stepped(pelican, 2.0, Control(pitch=1000, roll=1000, thrust=3000, ctrl=packets.THRUST | packets.ROLL))
    east, north, up = pelican.body.sensed.velocity_m_s
    assert abs(east) < 1e-6
    assert north < -0.5  # to the right of a nose that points east
    assert up > 0.5


def test_the_peer_answers_when_it_is_polled_alone(pelican):
    stepped(pelican, 0.2)
    with pytest.raises(BlockingIOError):
        os.read(pelican._other, 100)
    os.write(pelican._other, packets.encode_poll(packets.POLL_STATUS))
    pelican.step()
    (status,) = packets.Replies().feed(os.read(pelican._other, 1000))
    assert status == pelican.status()


def test_the_peer_ignores_a_wrong_checksum(pelican):
    data = bytearray(packets.encode_control(COMBINATION))
    data[-1] ^= 1
    for _ in range(60):
        os.write(pelican._other, bytes(data))
        pelican.step()
    assert pelican.bad == 60
    assert not pelican.motors_on
