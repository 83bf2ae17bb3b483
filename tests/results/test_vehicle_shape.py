"""The shape to draw, against the specifications that are shipped."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from swarmsim.config.vehicles import Multirotor, SkidSteer
from swarmsim.results.vehicle_shape import shape_of

VEHICLES = Path(__file__).parents[2] / "configs" / "vehicles"


@pytest.mark.parametrize("name", ["tarot_t650", "x500"])
def test_multirotor(name: str) -> None:
    spec = Multirotor(**yaml.safe_load((VEHICLES / f"{name}.yaml").read_text()))
    shape = shape_of(spec)
    np.testing.assert_allclose(shape.hubs_m, [rotor.position_m for rotor in spec.rotors])
    assert shape.radius_m == spec.rotor.radius_m
    low, high = (shape.box_centre_m[2] + half * shape.box_size_m[2] for half in (-0.5, 0.5))
    assert min(foot[2] for foot in spec.feet.positions_m) < low < high <= shape.hubs_m[:, 2].max() + 1e-9


def test_rover_stands_on_its_wheels_with_its_chassis_at_its_height() -> None:
    spec = SkidSteer(**yaml.safe_load((VEHICLES / "orpheus.yaml").read_text()))
    shape = shape_of(spec)
    ground = shape.hubs_m[:, 2] - shape.radius_m
    assert np.ptp(ground) == pytest.approx(0.0)
    assert shape.box_centre_m[2] - ground[0] == pytest.approx(spec.chassis_height_m)
    assert np.ptp(shape.hubs_m[:, 0]) == pytest.approx(spec.wheels.wheel_base_m)
    assert tuple(shape.box_size_m) == spec.chassis_size_m
