"""The link to an AR.Drone 2.0 against a peer of ours: watchdogs, emergencies, takeovers, refusals, losses."""

import math
import time

import numpy as np
import pytest

from swarmsim.autopilot.ardrone import at
from swarmsim.autopilot.ardrone.navdata import Control, State
from swarmsim.autopilot.link import LinkError, Mode, Setpoint
from swarmsim.autopilot.settings import load_settings
from swarmsim.autopilot.standin.ardrone import ArdroneStandin, ArdroneStandinSettings
from swarmsim.autopilot.standin.kinematic import KinematicBody
from swarmsim.config.errors import InputError
from tests.autopilot.ports import free_port
from tests.autopilot.stick_peers import airborne, ardrone_link, ardrone_peer, until


def test_it_climbs_goes_where_it_is_told_and_lands(tmp_path):
    log = tmp_path / "flight.log"
    with ardrone_peer() as peer, ardrone_link(peer, log=log) as link:
        told = []
        assert link.telemetry().mode_name == "BOOTSTRAP"
        link.preflight(told.append, 10.0)
        assert peer.config["control:outdoor"] == "TRUE"
        assert float(peer.config["control:euler_angle_max"]) == pytest.approx(math.radians(20.0), abs=1e-6)
        assert peer.config["control:control_vz_max"] == "1000"
        assert any("dead reckoning" in line for line in told)
        link.align((10.0, 20.0, 5.0))
        t = link.telemetry()
        assert t.position_m == pytest.approx((10.0, 20.0, 5.0))
        assert (t.armed, t.on_ground, t.gnss_fix, t.angular_velocity_rad_s) == (False, True, None, None)
        link.follow(3.0)
        link.arm(3.0)
        assert link.telemetry().mode is Mode.FOLLOW
        link.take_off(1.5, 20.0)
        assert link.telemetry().armed
        goal = Setpoint(position_m=(12.0, 21.0, 7.0), yaw_rad=0.5)
        for _ in range(160):
            link.send(goal)
            time.sleep(0.05)
            if np.allclose(link.telemetry().position_m, goal.position_m, atol=0.1):
                break
        assert np.allclose(link.telemetry().position_m, goal.position_m, atol=0.3)
        assert np.allclose(peer.body.sensed.position_m, (2.0, 1.0, 2.0), atol=0.4)
        assert link.telemetry().mode_name == "FLYING"
        link.enter(Mode.HOLD, 3.0)
        until(lambda: peer.control is Control.HOVERING)
        link.enter(Mode.LAND, 3.0)
        until(lambda: link.telemetry().armed is False)
        assert link.telemetry().on_ground
        assert link.telemetry().battery == pytest.approx(1.0, abs=0.02)
    lines = log.read_text().splitlines()
    assert any(bytes.fromhex(line.split()[2]).startswith(b"AT*") for line in lines if line.split()[1] == ">")
    assert any(line.split()[1] == "<" for line in lines)


def test_without_fresh_setpoints_it_hovers():
    with ardrone_peer() as peer, ardrone_link(peer) as link:
        airborne(link)
        link.send(Setpoint(velocity_m_s=(1.0, 0.0, 0.0)))
        until(lambda: peer.control is Control.FLYING)
        until(lambda: peer.control is Control.HOVERING)
        assert link.telemetry().mode is Mode.FOLLOW


@pytest.mark.parametrize(
    ("happens", "mode", "failsafe", "word"),
    [
        (lambda peer: peer.operator_lands(), Mode.LAND, False, "LANDING"),
        (lambda peer: peer.cut(State.ANGLES), Mode.OTHER, True, "tilted"),
        (lambda peer: peer.cut(State.USER_EMERGENCY), Mode.OTHER, True, "operator"),
    ],
)
def test_what_others_do_with_it_stops_this_side_at_once(happens, mode, failsafe, word):
    with ardrone_peer() as peer, ardrone_link(peer) as link:
        airborne(link)
        seen = []
        link.on_mode(seen.append)
        happens(peer)
        until(lambda: bool(seen))
        assert (seen[0].mode, seen[0].failsafe) == (mode, failsafe)
        assert word in seen[0].mode_name
        heard = peer._number
        for _ in range(10):
            link.send(Setpoint(velocity_m_s=(1.0, 0.0, 0.0)))  # not taken any more
            time.sleep(0.02)
        assert peer._sticks is None or not peer.armed or peer.control is Control.LANDING
        if mode is Mode.LAND:
            assert peer._number <= heard + 1  # what was under way
        assert link.messages()


def test_an_emergency_on_the_ground_is_cleared_by_preflight():
    with ardrone_peer() as peer, ardrone_link(peer) as link:
        peer.cut(State.ANGLES)
        told = []
        link.preflight(told.append, 10.0)
        assert not peer.emergency
        assert any("cleared" in line for line in told)


@pytest.mark.parametrize(
    ("fault", "step", "word"),
    [
        ("unacknowledged", "preflight", "general:navdata_demo"),
        ("deaf", "preflight", "general:navdata_demo"),
        ("grounded", "take off", "take off"),
    ],
)
def test_what_it_refuses_is_told(fault, step, word):
    with ardrone_peer() as peer, ardrone_link(peer) as link:
        setattr(peer.faults, fault, True)
        if step == "take off":
            link.preflight(lambda _: None, 5.0)
            link.align((0.0, 0.0, 0.0))
            link.follow(2.0)
        with pytest.raises(LinkError, match=word):
            link.take_off(1.0, 1.0) if step == "take off" else link.preflight(lambda _: None, 2.0)
        if step == "take off":  # called off: it does not take off later
            peer.faults.grounded = False
            until(lambda: not peer._wants_air)
            time.sleep(0.3)
            assert peer.control is Control.LANDED


def test_a_low_battery_is_told():
    with ardrone_peer() as peer, ardrone_link(peer) as link:
        peer.body.sensed = type(peer.body.sensed)(**{**vars(peer.body.sensed), "charge": 0.1})
        with pytest.raises(LinkError, match="battery is at 10 %"):
            link.preflight(lambda _: None, 2.0)


def test_nobody_there_is_told():
    settings = load_settings("standin_ardrone2", ArdroneStandinSettings)
    peer = ArdroneStandin(KinematicBody(), settings, ports=(free_port(), free_port()))  # it does not run
    try:
        with pytest.raises(LinkError, match="wireless network"), ardrone_link(peer, timeout_s=0.3):
            pass
    finally:
        peer.close()


def test_lost_navdata_are_seen_and_break_the_position():
    with ardrone_peer() as peer, ardrone_link(peer) as link:
        airborne(link)
        link._reckoning._gap_s = 0.3
        peer.faults.silent = True
        heard = link.telemetry().heard_s
        time.sleep(0.8)
        assert link.telemetry().heard_s - heard < 0.3
        with pytest.raises(LinkError, match="nothing is heard"):
            link.enter(Mode.HOLD, 1.2)
        peer.faults.silent = False
        until(lambda: link.telemetry().estimate_ok is False)


def test_a_drone_that_has_lost_the_link_is_taken_back():
    with ardrone_peer(lost_s=0.3) as peer, ardrone_link(peer) as link:
        airborne(link)
        peer.faults.deaf = True
        until(lambda: bool(peer.state() & State.COM_LOST))
        until(lambda: peer.control is Control.HOVERING)
        until(lambda: link._has(State.COM_LOST))
        peer.faults.deaf = False
        until(lambda: not peer.state() & (State.COM_LOST | State.COM_WATCHDOG))
        until(lambda: link.telemetry().mode is Mode.FOLLOW)


def test_a_dry_link_moves_nothing():
    with ardrone_peer() as peer, ardrone_link(peer, dry=True) as link:
        airborne(link)
        link.enter(Mode.LAND, 1.0)
        assert peer.control is Control.LANDED
        assert not peer._wants_air
        assert any("dry" in line for line in link.messages())


def test_it_has_no_return_and_disarms_on_the_ground_alone():
    with ardrone_peer() as peer, ardrone_link(peer) as link:
        with pytest.raises(LinkError, match="at_end"):
            link.enter(Mode.RETURN, 1.0)
        link.disarm(2.0)
        airborne(link, 0.6)
        with pytest.raises(LinkError, match="in the air"):
            link.disarm(1.0)
        link.request(Mode.RETURN)  # in an emergency it lands
        until(lambda: peer.control is Control.LANDING)


def test_a_place_before_align_is_refused():
    with ardrone_peer() as peer, ardrone_link(peer) as link:
        with pytest.raises(LinkError, match="align"):
            link.send(Setpoint(position_m=(0.0, 0.0, 0.0)))
        with pytest.raises(LinkError, match="preflight"):
            link.align((0.0, 0.0, 0.0))  # in bootstrap it tells no position


# the peer itself, stepped without a clock


@pytest.fixture
def drone():
    settings = load_settings("standin_ardrone2", ArdroneStandinSettings)
    peer = ArdroneStandin(KinematicBody(), settings, ports=(free_port(), free_port()))
    yield peer
    peer.close()


def stepped(drone, seconds, *commands):
    for _ in range(round(seconds / drone.body.step_s)):
        for command in commands:
            drone.hear(at.encode(command[0], drone._number + 1, *command[1:]))
        drone.step()


def test_the_peer_keeps_the_order_of_commands(drone):
    drone.hear(at.encode("REF", 10, at.REF_BASE | at.REF_START))
    drone.hear(at.encode("REF", 9, at.REF_BASE))
    assert drone._wants_air
    assert drone.ignored == 1
    drone.hear(at.encode("REF", 1, at.REF_BASE))  # number 1 resets
    assert not drone._wants_air


def test_the_peer_hovers_by_its_watchdog_and_tells_so_until_it_is_reset(drone):
    stepped(drone, 4.0, ("COMWDG",), ("REF", at.REF_BASE | at.REF_START))
    forward = ("PCMD", 1, 0.0, -0.5, 0.0, 0.0)
    stepped(drone, 0.5, ("COMWDG",), forward)
    assert drone.control is Control.FLYING
    stepped(drone, 0.2)
    assert drone.control is Control.HOVERING
    assert drone.state() & State.COM_WATCHDOG
    stepped(drone, 0.2, forward)
    assert drone.control is Control.FLYING
    assert drone.state() & State.COM_WATCHDOG
    stepped(drone, 0.2, ("COMWDG",), forward)
    assert not drone.state() & State.COM_WATCHDOG
    stepped(drone, 2.1)
    assert drone.state() & State.COM_LOST


def test_the_peer_cuts_its_motors_on_the_rising_edge_alone(drone):
    stepped(drone, 3.0, ("COMWDG",), ("REF", at.REF_BASE | at.REF_START))
    emergency = ("REF", at.REF_BASE | at.REF_START | at.REF_EMERGENCY)
    stepped(drone, 0.1, emergency)
    assert drone.emergency
    stepped(drone, 0.1, ("REF", at.REF_BASE))
    assert drone.emergency
    stepped(drone, 0.1, emergency)
    assert not drone.emergency


def test_ports_that_are_taken_are_told(drone):
    ports = tuple(int(port) for port in drone.address.split(":")[2:])
    with pytest.raises(InputError, match="cannot be opened"):
        ArdroneStandin(KinematicBody(), drone.settings, ports=ports)
