"""Our physics behind firmware that answers as PX4 and ArduPilot do: the plant, the lockstep, its losses."""

import socket

import numpy as np
import pytest

import swarmsim
from swarmsim.autopilot.frames import Geodetic
from swarmsim.config.bare import bare_scenario
from swarmsim.config.mission import Timing
from swarmsim.config.sensors import Place
from swarmsim.sitl.ardupilot import ArdupilotLink
from swarmsim.sitl.link import FirmwareError, seat_of
from swarmsim.sitl.lockstep import Lockstep
from swarmsim.sitl.plant import ACTUATORS, Plant
from swarmsim.sitl.px4 import Px4Link
from swarmsim.sitl.report import summary_of, table_of
from swarmsim.sitl.settings import load_sitl_settings
from swarmsim.vehicles.state import GRAVITY_M_S2
from tests.autopilot.ports import free_port
from tests.sitl.firmwares import ArdupilotPeer, Px4Peer

ORIGIN = Geodetic(47.397742, 8.545594, 488.0)
PERIOD_S = 0.004


@pytest.fixture(scope="module")
def scenario():
    whole = swarmsim.load("recon", ["engine=analytic"])
    names = [member.name for member in whole.members]
    numbers = [names.index("orpheus"), names.index("uav1")]  # the rover first: groups are in another order
    return bare_scenario(
        whole, numbers, "sitl", Timing(control_period_s=PERIOD_S, physics_steps=1, judge_period_s=0.02)
    )


@pytest.fixture(scope="module")
def built(scenario):
    return Plant(scenario, Place(), load_sitl_settings("px4").sensors, seed=3)


@pytest.fixture
def plant(built):
    built.reset()
    return built


def hover_of(scenario):
    """Output that holds the UAV in the air: weight is four times c w^2."""
    spec = next(v for v in scenario.vehicles if v.kind == "multirotor")
    speed = np.sqrt(spec.mass_kg * GRAVITY_M_S2 / 4.0 / spec.rotor.thrust_coefficient_n_s2)
    return float(speed / spec.rotor.speed_max_rad_s)


@pytest.mark.slow
def test_at_rest_the_sensors_read_the_place(plant):
    for _ in range(500):
        t = plant.step(np.zeros((2, ACTUATORS)))
    assert plant.names == ["orpheus", "uav1"]
    assert plant.flies.tolist() == [False, True]
    np.testing.assert_allclose(np.linalg.norm(t.specific_force_m_s2, axis=1), GRAVITY_M_S2, atol=0.05)
    np.testing.assert_allclose(plant.sensed.accel_m_s2, t.specific_force_m_s2, atol=1.0)
    assert np.isfinite(plant.sensed.pressure_pa).all()  # also of the rover, which names no barometer
    assert plant.sensed.gnss_fix.min() >= 3.0
    assert np.abs(plant.sensed.gnss_position_m - t.position_m).max() < 10.0
    assert t.intact.all()


def test_a_rotor_pushes_as_the_closed_form_says(plant, scenario):
    actuators = np.zeros((2, ACTUATORS))
    actuators[1, :4] = 1.1 * hover_of(scenario)
    begin = plant.truth.position_m.copy()
    for _ in range(100):
        t = plant.step(actuators)
    # 1.1^2 of the weight, less what the climb takes of the thrust
    assert t.specific_force_m_s2[1, 2] == pytest.approx(1.21 * GRAVITY_M_S2, rel=0.05)
    assert t.position_m[1, 2] > begin[1, 2] + 0.05
    np.testing.assert_allclose(t.position_m[0], begin[0], atol=0.01)


def test_a_rover_turns_to_the_side_of_the_slower_wheels(plant):
    actuators = np.zeros((2, ACTUATORS))
    actuators[0, :2] = 0.2, 0.6
    for _ in range(500):
        t = plant.step(actuators)
    assert t.angular_velocity_rad_s[0, 2] > 0.1  # left wheels slower: to the left
    assert np.hypot(*t.velocity_m_s[0, :2]) > 0.1


def test_the_same_seed_flies_the_same_and_a_value_compiles_nothing(plant, scenario):
    def run():
        plant.reset()
        actuators = np.zeros((2, ACTUATORS))
        actuators[1, :4] = hover_of(scenario)
        for _ in range(50):
            t = plant.step(actuators)
        return t.position_m, plant.sensed.gyro_rad_s

    for one, other in zip(run(), run(), strict=True):
        np.testing.assert_array_equal(one, other)


def seats_of(scenario, settings):
    pairs = zip(scenario.members, scenario.vehicles, strict=True)
    return [seat_of(member.name, k, vehicle, settings, ORIGIN) for k, (member, vehicle) in enumerate(pairs)]


def px4(plant, scenario, peers, speed=0.0, **changes):
    """A lockstep with the peers that ``peers`` makes of ports, connected."""
    port = free_port(socket.SOCK_STREAM)
    settings = load_sitl_settings("px4").model_copy(update={"port": port, "port_step": 1, "lost_s": 1.0} | changes)
    seats = seats_of(scenario, settings)
    links = [Px4Link(seat, settings) for seat in seats]
    made = [peer(port + k) for k, peer in enumerate(peers)]
    lockstep = Lockstep(plant, links, settings, speed)
    try:
        lockstep.connect(lambda: None)
    except FirmwareError:
        closed(lockstep, made)
        raise
    return lockstep, made


def closed(lockstep, peers):
    for one in (*lockstep.links, *peers):
        one.close()


def test_every_period_is_answered_before_the_next(plant, scenario):
    hover = hover_of(scenario)
    rover = lambda port: Px4Peer(port, lambda heard: [0.4, 0.2])  # noqa: E731
    copter = lambda port: Px4Peer(port, lambda heard: [hover] * 4)  # noqa: E731
    lockstep, peers = px4(plant, scenario, [rover, copter])
    try:
        lockstep.run(2.0, lambda: None)
    finally:
        closed(lockstep, peers)
    waits = lockstep.waits[1]
    assert waits.missed == 0
    assert waits.answers == pytest.approx(2.0 / PERIOD_S, abs=2)
    sensors = peers[1].heard["HIL_SENSOR"]
    steps = np.diff([m.time_usec for m in sensors])
    assert set(steps.tolist()) == {4000}
    assert len(peers[1].heard["HIL_GPS"]) >= 8  # 5 Hz or more
    assert len(peers[1].heard["HIL_STATE_QUATERNION"]) == pytest.approx(100, abs=2)
    t = plant.truth
    assert t.velocity_m_s[0, :2] @ t.velocity_m_s[0, :2] > 0.01  # the rover drives, though it is not waited for
    assert t.angular_velocity_rad_s[0, 2] > 0.0  # PX4's first channel is the right side
    report = summary_of(lockstep, "px4", "analytic")
    assert report["vehicles"][1]["answers"] == waits.answers
    table = table_of(lockstep).to_pydict()
    assert table["vehicle"][:2] == ["orpheus", "uav1"]
    assert table["actuator_0"][-1] == pytest.approx(hover)


def test_a_firmware_that_is_not_armed_moves_nothing(plant, scenario):
    idle = lambda port: Px4Peer(port, lambda heard: [0.9] * 4, armed=False)  # noqa: E731
    lockstep, peers = px4(plant, scenario, [idle, idle])
    begin = plant.truth.position_m.copy()
    try:
        lockstep.run(0.5, lambda: None)
    finally:
        closed(lockstep, peers)
    np.testing.assert_allclose(plant.truth.position_m, begin, atol=0.01)


def test_an_answer_that_never_comes_is_counted_and_gone_over(plant, scenario):
    quiet = lambda port: Px4Peer(port, lambda heard: [0.0] * 4, silent_at=20)  # noqa: E731
    lockstep, peers = px4(plant, scenario, [quiet, quiet], wait_s=0.1, first_wait_s=0.1)
    try:
        lockstep.run(0.3, lambda: None)
    finally:
        closed(lockstep, peers)
    assert lockstep.waits[1].missed == 1
    assert lockstep.waits[1].longest_s < 1.0


def test_a_firmware_that_ends_is_told(plant, scenario):
    answering = lambda port: Px4Peer(port, lambda heard: [0.0] * 4)  # noqa: E731
    lockstep, peers = px4(plant, scenario, [answering, answering])
    try:
        lockstep.run(0.1, lambda: None)
        peers[1].close()
        with pytest.raises(FirmwareError, match="PX4 of uav1 has closed its link"):
            lockstep.run(20.0, lambda: None)
    finally:
        closed(lockstep, peers)


def test_a_firmware_that_never_comes_is_told(plant, scenario):
    with pytest.raises(FirmwareError, match=r"no firmware came within 0\.2 s for orpheus.*uav1"):
        px4(plant, scenario, [], start_s=0.2)


@pytest.mark.parametrize("channels", [16, 32])
def test_ardupilot_asks_and_is_answered_once_a_frame(plant, scenario, channels):
    port = free_port(socket.SOCK_DGRAM)
    settings = load_sitl_settings("ardupilot").model_copy(
        update={"port": port, "port_step": 1, "lost_s": 1.0, "wait_s": 1.1}
    )
    pulse = round(1000.0 + 1000.0 * 1.05 * hover_of(scenario))
    seats = seats_of(scenario, settings)
    links = [ArdupilotLink(seat, settings) for seat in seats]
    rover = ArdupilotPeer(port, lambda states: [1600, 0, 1700], channels=channels)
    copter = ArdupilotPeer(port + 1, lambda states: [pulse] * 4, repeats=2, channels=channels)
    lockstep = Lockstep(plant, links, settings, 0.0)
    try:
        lockstep.connect(lambda: None)
        lockstep.run(1.0, lambda: None)
        missed = lockstep.waits[1].missed
        copter.close()
        with pytest.raises(FirmwareError, match="uav1"):
            lockstep.run(60.0, lambda: None)
    finally:
        closed(lockstep, [rover, copter])
    assert plant.truth.position_m[1, 2] > 0.0
    times = [state["timestamp"] for state in rover.states[:200]]
    np.testing.assert_allclose(np.diff(times), PERIOD_S, atol=1e-6)
    assert missed == 0
    assert plant.truth.angular_velocity_rad_s[0, 2] > 0.0  # its right side is faster


def test_it_keeps_the_pace_that_is_asked_for(plant, scenario):
    answering = lambda port: Px4Peer(port, lambda heard: [0.0] * 4)  # noqa: E731
    lockstep, peers = px4(plant, scenario, [answering, answering], speed=0.5)
    try:
        lockstep.run(0.5, lambda: None)
    finally:
        closed(lockstep, peers)
    assert lockstep.factor <= 0.51
