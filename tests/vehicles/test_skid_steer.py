"""The rover's specification, parameters and body against closed forms."""

import math

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from swarmsim.config.vehicles import BodyFile, SkidSteer
from swarmsim.vehicles.rover_body import rover_body
from swarmsim.vehicles.skid_steer import (
    FRICTION_RATIO,
    IMPEDANCE,
    SLIP_DAMPING_1_S,
    WHEELS,
    effective_track,
    skid_steer_mjcf,
    skid_steer_params,
    turning_force,
    tyre_creep,
    tyre_sinkage,
    wheel_inverse_mass,
)
from tests.physics.rovers import FILE, PARAMS, SPEC
from tests.vehicles.skid_steer_files import ROVER


def test_wheels_are_in_the_order_front_left_front_right_rear_left_rear_right():
    assert WHEELS == ("front_left", "front_right", "rear_left", "rear_right")
    np.testing.assert_array_equal(np.sign(PARAMS.wheel_position_m[:, :2]), [[1, 1], [1, -1], [-1, 1], [-1, -1]])


def test_the_body_is_the_sum_of_a_box_and_four_discs():
    body = rover_body(SPEC)
    wheels, box = SPEC.wheels, SPEC.mass_kg - 4 * SPEC.wheels.mass_kg
    height = (box * SPEC.chassis_height_m + 4 * wheels.mass_kg * wheels.radius_m) / SPEC.mass_kg
    assert body.wheel_position_m[0, 2] == pytest.approx(wheels.radius_m - height)
    length, width, _ = SPEC.chassis_size_m
    arm = 0.25 * (wheels.wheel_base_m**2 + wheels.track_m**2)
    disc = wheels.mass_kg * (3 * wheels.radius_m**2 + wheels.width_m**2) / 12
    yaw = box * (length**2 + width**2) / 12 + 4 * (disc + wheels.mass_kg * arm)
    assert body.inertia_kg_m2[2, 2] == pytest.approx(yaw)
    np.testing.assert_allclose(body.inertia_kg_m2, body.inertia_kg_m2.T)


def test_turning_force_and_track_balance_moments_and_power():
    base, track = SPEC.wheels.wheel_base_m, SPEC.wheels.track_m
    slip = np.array([-base / track, 1.0]) * 0.5 * base  # of a right wheel per yaw rate: ahead, aside
    force = -SPEC.wheels.friction * slip / np.linalg.norm(slip)  # per newton of load
    assert 0.5 * track * force[0] + 0.5 * base * force[1] == pytest.approx(0.0, abs=1e-12)
    assert float(turning_force(PARAMS, 1.0)) == pytest.approx(force[0], rel=1e-5)
    assert float(effective_track(PARAMS.wheel_position_m)) == pytest.approx(track + base**2 / track, rel=1e-6)


def test_sinkage_and_creep_are_those_of_the_specification():
    load = 0.25 * SPEC.mass_kg * 9.81
    assert float(tyre_sinkage(PARAMS)) == pytest.approx(load / SPEC.wheels.stiffness_n_m, rel=1e-5)
    damping = (
        FRICTION_RATIO * SLIP_DAMPING_1_S * IMPEDANCE / (1 - IMPEDANCE) / wheel_inverse_mass(SPEC, rover_body(SPEC))
    )
    np.testing.assert_allclose(tyre_creep(PARAMS), SPEC.wheels.friction * load / damping, rtol=1e-5)


def test_a_rover_from_a_urdf_takes_its_body_from_there(tmp_path):
    file = tmp_path / "rover.urdf.xacro"
    file.write_text(ROVER)
    spec = SPEC.model_copy(update={"body": BodyFile(file=str(file), args={"payload": 4})})
    params = skid_steer_params(spec)
    assert float(params.mass_kg) == pytest.approx(30.0)
    assert float(params.wheel_radius_m) == pytest.approx(0.15)
    assert float(params.torque_max_nm) == SPEC.motor.torque_max_nm
    assert 'size="0.15"' in skid_steer_mjcf(spec)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("wheels", "radius_m"), -0.2, "greater than"),
        (("wheels", "friction"), math.nan, "finite"),
        (("motor", "torque_max_nm"), 0.0, "greater than"),
        (("mass_kg",), 5.0, "four times"),
        (("bumper", "stiffness"), 1.0, "Extra inputs"),
    ],
)
def test_a_faulty_specification_is_refused(path, value, message):
    fields = yaml.safe_load(FILE.read_text())
    place = fields
    for name in path[:-1]:
        place = place[name]
    place[path[-1]] = value
    with pytest.raises(ValidationError, match=message):
        SkidSteer(**fields)
