"""A xacro file reads only its own folder, and ends."""

import time
from pathlib import Path

import pytest
import trimesh

from swarmsim.config.errors import InputError
from swarmsim.config.vehicles import BodyFile
from swarmsim.vehicles import expansion
from swarmsim.vehicles.bodies import read_body
from swarmsim.vehicles.expansion import expand, robot_folder

ROBOT = """<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{}
<link name="base_link"><inertial><mass value="{}"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
MESH = '<link name="l"><visual><geometry><mesh filename="{}"/></geometry></visual></link>'


def written(path: Path, inside: str = "", mass: str = "2") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(ROBOT.format(inside, mass))
    return path


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "secret.yaml"
    path.write_text("mass: 7\n")
    (tmp_path / "secret.xacro").write_text(ROBOT.format('<xacro:property name="m" value="7"/>', "1"))
    return path


def test_files_of_the_folder_are_read(tmp_path: Path) -> None:
    robot = written(tmp_path / "robot" / "r.xacro", "", "${xacro.load_yaml('parts/numbers.yaml')['mass']}")
    (robot.parent / "parts").mkdir()
    (robot.parent / "parts" / "numbers.yaml").write_text("mass: 3.5\n")
    assert read_body(BodyFile(file=str(robot))).mass_kg == 3.5
    written(robot.parent / "parts" / "more.xacro", '<xacro:property name="m" value="4"/>')
    robot = written(robot, '<xacro:include filename="parts/more.xacro"/>', "${m}")
    assert '<mass value="4"/>' in expand(robot, {})


@pytest.mark.parametrize(
    ("inside", "mass"),
    [
        ("", "${xacro.load_yaml('../secret.yaml')['mass']}"),
        ("", "${xacro.load_yaml('SECRET')['mass']}"),
        ("", "${xacro.load_yaml('link.yaml')['mass']}"),
        ('<xacro:include filename="../secret.xacro"/>', "${m}"),
        ('<xacro:include filename="$(cwd)/../secret.xacro"/>', "${m}"),
    ],
)
def test_no_file_outside_the_folder_is_read(tmp_path: Path, secret: Path, inside: str, mass: str) -> None:
    robot = written(tmp_path / "robot" / "r.xacro", inside, mass.replace("SECRET", str(secret)))
    (robot.parent / "link.yaml").symlink_to(secret)
    with pytest.raises(InputError, match="outside the robot's folder"):
        expand(robot, {})


def test_a_package_is_one_folder(tmp_path: Path, secret: Path) -> None:
    robot = written(tmp_path / "package" / "urdf" / "r.xacro", "", "${xacro.load_yaml('../numbers.yaml')['mass']}")
    (tmp_path / "package" / "numbers.yaml").write_text("mass: 5\n")
    with pytest.raises(InputError, match="outside the robot's folder"):
        expand(robot, {})
    (tmp_path / "package" / "package.xml").touch()
    assert robot_folder(robot) == tmp_path.resolve() / "package"
    assert '<mass value="5"/>' in expand(robot, {})


@pytest.mark.parametrize(
    ("inside", "mass"),
    [
        ('<xacro:macro name="a"><xacro:a/></xacro:macro><xacro:a/>', "1"),
        ("", "${9**9**9}"),
        ("", "${len('x' * 10**11)}"),
        ('<xacro:include filename="r.xacro"/>', "1"),
    ],
)
def test_what_has_no_end_is_stopped(tmp_path: Path, inside: str, mass: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expansion, "TIME_LIMIT_S", 2.0)
    started = time.monotonic()
    with pytest.raises(InputError, match="xacro cannot expand this file"):
        expand(written(tmp_path / "r.xacro", inside, mass), {})
    assert time.monotonic() - started < 5.0


def test_a_mesh_of_the_folder_is_drawn(tmp_path: Path) -> None:
    trimesh.creation.box((0.2, 0.4, 0.6)).export(tmp_path / "cube.stl")
    joint = '<joint name="j" type="fixed"><parent link="base_link"/><child link="l"/></joint>'
    mesh = read_body(BodyFile(file=str(written(tmp_path / "r.urdf", MESH.format("cube.stl") + joint)))).mesh()
    assert mesh is not None
    assert mesh.extents == pytest.approx([0.2, 0.4, 0.6])


def test_meshes_outside_the_folder_and_entities_are_refused(tmp_path: Path) -> None:
    (tmp_path / "cube.stl").write_text("solid\nendsolid\n")
    robot = written(tmp_path / "robot" / "r.urdf", MESH.format("../cube.stl"))
    with pytest.raises(InputError, match="mesh outside the robot's folder"):
        read_body(BodyFile(file=str(robot)))
    robot.write_text('<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/hostname">]>' + ROBOT.format("&x;", "1"))
    with pytest.raises(InputError, match="document type"):
        read_body(BodyFile(file=str(robot)))
