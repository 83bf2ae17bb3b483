"""Bodies from URDF and xacro files against what the files say."""

import numpy as np
import pytest

from swarmsim.config.errors import InputError
from swarmsim.config.vehicles import BodyFile
from swarmsim.vehicles.bodies import read_body, read_rover_body, with_file_body
from tests.flights import spec_of
from tests.vehicles.skid_steer_files import ROVER


def written(folder, text=ROVER, name="rover.urdf.xacro", **args) -> BodyFile:
    path = folder / name
    path.write_text(text)
    return BodyFile(file=str(path), args=args)


def test_mass_centre_and_inertia_are_those_of_the_links(tmp_path):
    body = read_rover_body(written(tmp_path))
    assert body.mass_kg == pytest.approx(26.0)
    centre = np.array([0.02, 0.0, 0.1]) * 20.0 / 26.0
    corners = np.array([[0.2, 0.25, 0], [0.2, -0.25, 0], [-0.2, 0.25, 0], [-0.2, -0.25, 0]])
    np.testing.assert_allclose(body.wheel_position_m, corners - centre, atol=1e-9)
    points = [(20.0, np.array([0.02, 0, 0.1]), np.diag([0.5, 0.8, 1.1]))]
    points += [(1.5, corner, np.diag([0.009, 0.017, 0.009])) for corner in corners]
    expected = sum(
        own + m * ((r - centre) @ (r - centre) * np.eye(3) - np.outer(r - centre, r - centre)) for m, r, own in points
    )
    np.testing.assert_allclose(body.inertia_kg_m2, expected, atol=1e-9)


def test_wheels_are_found_in_any_order_and_axle_direction(tmp_path):
    body = read_rover_body(written(tmp_path))
    assert (body.wheel_radius_m, body.wheel_width_m, body.wheel_mass_kg) == (0.15, 0.08, 1.5)
    assert body.wheel_inertia_kg_m2 == pytest.approx((0.017, 0.009))
    rear, front, right, left = body.outline_m
    assert front - rear == pytest.approx(0.7)
    assert left - right == pytest.approx(0.58)


def test_xacro_arguments_reach_the_body(tmp_path):
    body = read_rover_body(written(tmp_path, payload=5.0, radius=0.2))
    assert body.mass_kg == pytest.approx(31.0)
    assert body.wheel_radius_m == pytest.approx(0.2)


def test_the_mesh_stands_in_the_body_frame(tmp_path):
    mesh = read_body(written(tmp_path)).mesh()
    assert mesh is not None
    low, high = mesh.bounds
    np.testing.assert_allclose(high - low, [0.6, 0.3, 0.2], atol=1e-6)
    np.testing.assert_allclose(
        0.5 * (low + high), np.array([0, 0, 0.1]) - [0.02 * 20 / 26, 0, 0.1 * 20 / 26], atol=1e-6
    )


def test_a_file_that_draws_nothing_has_no_mesh(tmp_path):
    lines = [line for line in ROVER.splitlines() if "<visual>" not in line]
    assert read_body(written(tmp_path, "\n".join(lines))).mesh() is None


FAULTS = {
    "not well-formed XML": ROVER.replace("</robot>", ""),
    "cannot expand": ROVER.replace("${x} ${y}", "${nonsense} ${y}"),
    "four wheels on continuous joints": ROVER.replace('<xacro:wheel name="rl" x="-0.2" y="0.25"/>', ""),
    "same radius, width and mass": ROVER.replace('mass value="1.5"', "mass value=\"${1.5 if name != 'rl' else 2.5}\""),
    "along y": ROVER.replace('rpy="${-pi / 2} 0 0"', 'rpy="0 0 0"'),
    "one on each side": ROVER.replace('x="-0.2" y="0.25"', 'x="-0.2" y="-0.35"'),
    "needs a cylinder": ROVER.replace('<cylinder radius="${r}" length="0.08"/>', '<box size="0.3 0.3 0.08"/>'),
    "not positive": ROVER.replace('ixx="0.5" iyy="0.8" izz="1.1"', 'ixx="-50" iyy="0.8" izz="1.1"'),
}


@pytest.mark.parametrize("sentence", FAULTS)
def test_a_faulty_file_is_an_input_error(tmp_path, sentence):
    with pytest.raises(InputError, match=sentence):
        read_rover_body(written(tmp_path, FAULTS[sentence]))


def test_a_body_without_mass_is_refused(tmp_path):
    with pytest.raises(InputError, match="no mass"):
        read_body(written(tmp_path, "<robot name='r'><link name='base_link'/></robot>", name="r.urdf"))


def test_a_missing_file_is_named():
    with pytest.raises(InputError, match=r"/nowhere/rover\.urdf: there is no such body file"):
        read_body(BodyFile(file="/nowhere/rover.urdf"))


def test_an_unknown_argument_lists_the_known_ones(tmp_path):
    with pytest.raises(InputError, match=r"unknown xacro argument payloat[\s\S]*payload, radius"):
        read_body(written(tmp_path, payloat=3.0))


def test_a_multirotor_takes_the_full_tensor_of_its_file(tmp_path):
    text = """<robot name="uav"><link name="base_link"><inertial><mass value="2.5"/>
      <inertia ixx="0.05" iyy="0.06" izz="0.09" ixy="0.01" ixz="{ixz}" iyz="0"/></inertial></link></robot>"""
    spec = spec_of()
    tilted = with_file_body(spec.model_copy(update={"body": written(tmp_path, text.format(ixz=-0.005), "tilted.urdf")}))
    assert tilted.mass_kg == 2.5
    assert tilted.inertia_kg_m2 == pytest.approx((0.05, 0.06, 0.09, 0.01, -0.005, 0.0))
    level = text.replace('ixy="0.01"', 'ixy="0"').format(ixz=0)
    level = with_file_body(spec.model_copy(update={"body": written(tmp_path, level, "level.urdf")}))
    assert level.inertia_kg_m2 == pytest.approx((0.05, 0.06, 0.09))
