"""The stand-in over the simulator's physics: a copter flies and lands, a rover drives."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from swarmsim.autopilot.standin.body import Motion, SimulatedBody, scenario_alone
from swarmsim.autopilot.standin.settings import load_settings
from swarmsim.config.errors import InputError
from tests.autopilot.standins import BODY, POSITION, VELOCITY, Bench

STEP_S = load_settings("px4").step_s


def body_of(mission=None, vehicle=None, seed=0) -> SimulatedBody:
    default = load_settings("px4").default.model_dump()
    return SimulatedBody(scenario_alone(mission, vehicle, STEP_S, default), seed)


def test_px4_takes_off_flies_a_square_comes_back_and_lands():
    bench = Bench("px4", body=body_of()).advance(6.0)
    bench.stream(1.5, position=(0.0, 0.0, -6.0))
    assert bench.set_mode(6) == [0, 0]
    assert bench.arm() == [0]
    bench.stream(9.0, position=(0.0, 0.0, -6.0))
    for north, east in ((10.0, 0.0), (10.0, 10.0)):
        bench.stream(10.0, position=(north, east, -6.0), yaw=1.0, mask=POSITION & ~0x400)
        assert bench.position == pytest.approx((north, east, -6.0), abs=0.3)
    assert bench.last("ATTITUDE").yaw == pytest.approx(1.0, abs=0.05)
    bench.stream(4.0, mask=VELOCITY, velocity=(-2.0, 0.0, 0.0))
    assert bench.last("LOCAL_POSITION_NED").vx == pytest.approx(-2.0, abs=0.2)
    assert bench.set_mode(4, 5) == [0, 0]
    bench.until(lambda: not bench.standin.armed, 90.0)
    assert math.hypot(*bench.position[:2]) < 0.5
    assert bench.standin.body.sensed.intact
    assert bench.last("SYS_STATUS").battery_remaining < 100


def test_ardupilot_takes_off_by_command_lands_and_takes_off_again():
    bench = Bench("ardupilot", body=body_of(seed=3)).advance(6.0)
    bench.telemetry("EXTENDED_SYS_STATE", "BATTERY_STATUS", hz=2.0)
    assert bench.set_mode(4) == [0]
    for height in (4.0, 3.0):
        assert bench.arm() == [0]
        bench.stream(1.0, position=(5.0, 0.0, -10.0))  # does not lift it
        assert bench.height < 0.1
        assert bench.command(mav.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height) == [0]
        bench.advance(10.0)
        assert bench.height == pytest.approx(height, abs=0.3)
        assert bench.last("EXTENDED_SYS_STATE").landed_state == mav.MAV_LANDED_STATE_IN_AIR
        assert bench.arm(0) == [mav.MAV_RESULT_FAILED]
        bench.set_mode(9)
        bench.until(lambda: not bench.standin.armed, 40.0)
        assert bench.height == pytest.approx(0.0, abs=0.1)
        assert bench.set_mode(4) == [0]
    assert bench.standin.body.sensed.intact


def test_motors_that_stop_in_the_air_let_it_fall_and_crash():
    body = body_of()
    bench = Bench("px4", body=body).advance(6.0)
    bench.arm()
    bench.command(mav.MAV_CMD_NAV_TAKEOFF, *[math.nan] * 7)
    bench.until(lambda: bench.standin.mode == "AUTO.LOITER", 20.0)
    bench.standin.disarm_unexpectedly()
    bench.advance(0.3)
    assert bench.last("LOCAL_POSITION_NED").vz > 1.0
    bench.advance(3.0)
    assert bench.height < 0.3
    assert not body.sensed.intact
    assert bench.arm() != [0]


def test_a_disarmed_vehicle_rests():
    body = body_of()
    here = body.sensed.position_m
    for _ in range(50):
        body.step(Motion(position_m=(0.0, 0.0, 99.0), hold_position=True), armed=False)
    assert np.array_equal(body.sensed.position_m, here)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["px4", "ardupilot"])
def test_a_rover_of_a_mission_drives_to_a_point_along_a_velocity_and_home(kind):
    bench = Bench(kind, body=body_of("recon", "orpheus")).advance(6.0)
    bench.stream(1.5, position=(0.0, 0.0, 0.0))
    bench.set_mode(6 if kind == "px4" else 15)
    assert bench.arm() == [0]
    bench.stream(14.0, position=(4.0, 6.0, 0.0))
    assert bench.position[:2] == pytest.approx((4.0, 6.0), abs=0.3)
    bench.stream(6.0, mask=VELOCITY, velocity=(0.0, 0.8, 0.0))
    assert bench.position[1] > 8.5
    before = bench.standin.body.sensed.angular_velocity_rad_s[2]
    bench.stream(3.0, mask=0xDC7 & ~0x800, frame=BODY, velocity=(0.3, 0.0, 0.0), rate=-0.5)
    assert bench.standin.body.sensed.angular_velocity_rad_s[2] - before == pytest.approx(0.5, abs=0.2)
    assert bench.set_mode(*((4, 5) if kind == "px4" else (11,)))[-1] == 0
    bench.advance(35.0)
    assert math.hypot(*bench.position[:2]) < 0.8


def test_a_vehicle_that_the_mission_does_not_have_is_refused():
    with pytest.raises(InputError, match="orpheus"):
        scenario_alone("recon", "orfeus", STEP_S, {})
