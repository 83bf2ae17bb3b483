"""A vehicle's body from a URDF or xacro file: mass, inertia, wheels and the mesh to draw.

xacro is expanded by xacrodoc with the arguments of the specification, URDF is read by yourdfpy. Both read only what
lies in the robot's folder (`swarmsim.vehicles.expansion.robot_folder`). Frames: the URDF's root link is taken as the
body frame (x forward, y left, z up, as REP 103 has it), moved into the centre of mass.
"""

import io
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import yourdfpy
from numpy.typing import NDArray
from pydantic import ValidationError

from swarmsim.config.errors import InputError
from swarmsim.config.vehicles import BodyFile, Multirotor
from swarmsim.vehicles.expansion import URDF_BYTES, expand, robot_folder
from swarmsim.vehicles.rover_body import RoverBody, steiner

Floats = NDArray[np.float64]

_XACRO = "{http://www.ros.org/wiki/xacro}"
_ROUNDING = 1e-6  # products of inertia below this share of the least moment are none
_LEVEL_M = 1e-3  # wheels of a rover agree to this


@dataclass(frozen=True)
class Link:
    """One link of the file at its joints' zero: its inertial, in the root link's frame."""

    name: str
    mass_kg: float
    centre_m: Floats  # [3]
    inertia_kg_m2: Floats  # [3, 3] about its own centre


@dataclass(frozen=True)
class FileBody:
    """What a body file says. Vectors in the root link's axes, relative to the centre of mass of the whole."""

    mass_kg: float
    centre_m: Floats  # [3] of mass, in the root link's frame
    inertia_kg_m2: Floats  # [3, 3] about the centre of mass
    robot: yourdfpy.URDF
    links: tuple[Link, ...]
    file: str

    def mesh(self) -> trimesh.Trimesh | None:
        """Visual geometry in the body frame (origin in the centre of mass); None when the file draws nothing."""
        if self.robot.scene is None or not self.robot.scene.geometry:
            return None
        mesh = self.robot.scene.to_mesh()
        mesh.apply_translation(-self.centre_m)
        return mesh


def read_body(source: BodyFile) -> FileBody:
    """What the file ``source`` says.

    Raises `InputError` for a missing file, bad xacro or URDF, an undeclared argument and a body without mass.
    """
    path = Path(source.file)
    if not path.is_file():
        raise InputError.of("there is no such body file", file=path)
    robot = _parse(_urdf_text(path, source.args), path)
    links = tuple(_link(robot, name) for name, link in robot.link_map.items() if link.inertial is not None)
    mass = sum(link.mass_kg for link in links)
    if not mass > 0.0:
        raise InputError.of("the body has no mass: give its links an <inertial> with a <mass> above zero", file=path)
    centre = sum((link.mass_kg * link.centre_m for link in links), start=np.zeros(3)) / mass
    inertia = sum((_about(link, centre) for link in links), start=np.zeros((3, 3)))
    if np.linalg.eigvalsh(inertia).min() <= 0.0:
        raise InputError.of("the body's inertia is not positive: check the <inertia> of its links", file=path)
    return FileBody(mass_kg=mass, centre_m=centre, inertia_kg_m2=inertia, robot=robot, links=links, file=str(path))


def read_rover_body(source: BodyFile) -> RoverBody:
    """Body of a skid-steer rover: its wheels are the links of the four continuous joints.

    Each wheel has a cylinder or sphere as collision (or visual) geometry. Raises `InputError` as `read_body` does, and
    for a robot that is not such a rover.
    """
    body = read_body(source)
    robot, path = body.robot, Path(body.file)
    joints = [joint for joint in robot.joint_map.values() if joint.type == "continuous"]
    if len(joints) != 4:
        names = ", ".join(joint.name for joint in joints) or "none"
        raise InputError.of(
            f"a skid-steer rover has four wheels on continuous joints, this file has {len(joints)} ({names})", file=path
        )
    wheels = sorted(joints, key=lambda joint: _wheel_order(robot, joint, body.centre_m))
    frames = [robot.get_transform(joint.child, robot.base_link) for joint in wheels]
    positions = np.array([frame[:3, 3] for frame in frames]) - body.centre_m
    signs = np.sign(positions[:, :2])
    if not np.array_equal(signs, [[1, 1], [1, -1], [-1, 1], [-1, -1]]):
        raise InputError.of("the wheels must stand one on each side, front and rear, of the centre of mass", file=path)
    for joint, frame in zip(wheels, frames, strict=True):
        axle = frame[:3, :3] @ np.asarray(joint.axis, float)
        if abs(axle[1]) < 0.999 * np.linalg.norm(axle):
            raise InputError.of(f"the axle of wheel joint {joint.name!r} must lie along y (left)", file=path)
    sizes = np.array([_wheel_size(robot, joint.child, path) for joint in wheels])
    masses = np.array([_named(body, joint.child, path).mass_kg for joint in wheels])
    if np.ptp(sizes, axis=0).max() > _LEVEL_M or np.ptp(masses) > 1e-3 * masses.mean():
        raise InputError.of("the four wheels must have the same radius, width and mass", file=path)
    inertia = np.mean([_named(body, joint.child, path).inertia_kg_m2 for joint in wheels], axis=0)
    radius, width = sizes.mean(axis=0)
    bounds = _outline(robot, body.centre_m, positions, radius, width)
    return RoverBody(
        mass_kg=body.mass_kg,
        inertia_kg_m2=body.inertia_kg_m2,
        wheel_position_m=positions,
        wheel_radius_m=float(radius),
        wheel_width_m=float(width),
        wheel_mass_kg=float(masses.mean()),
        wheel_inertia_kg_m2=(float(inertia[1, 1]), float(0.5 * (inertia[0, 0] + inertia[2, 2]))),
        outline_m=bounds,
    )


def with_file_body(spec: Multirotor) -> Multirotor:
    """``spec`` with the mass and the inertia of its body file; as it is when it names none.

    Raises `InputError` as `read_body` does, and for a body with which the vehicle could not fly.
    """
    if spec.body is None:
        return spec
    body = read_body(spec.body)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = body.inertia_kg_m2.tolist()
    skew = max(map(abs, (xy, xz, yz))) > _ROUNDING * min(xx, yy, zz)
    inertia = (xx, yy, zz, xy, xz, yz) if skew else (xx, yy, zz)
    try:
        return Multirotor.model_validate(spec.model_dump() | {"mass_kg": body.mass_kg, "inertia_kg_m2": inertia})
    except ValidationError as error:
        told = "; ".join(str(each.get("ctx", {}).get("error", each["msg"])) for each in error.errors())
        raise InputError.of(f"its body does not suit the vehicle '{spec.name}': {told}", file=body.file) from error


def _urdf_text(path: Path, args: dict[str, str | float | int | bool]) -> str:
    """URDF of the file, xacro expanded; an argument that the file does not declare is an error."""
    if path.stat().st_size > URDF_BYTES:
        raise InputError.of(f"is larger than {URDF_BYTES / 1e6:g} MB", file=path)
    _refuse_entities(path.read_bytes(), path)
    try:
        tree = ElementTree.parse(path)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError.of(f"not well-formed XML: {error}", file=path) from error
    declared = {element.get("name", "") for element in tree.iter(f"{_XACRO}arg")}
    included = any(True for _ in tree.iter(f"{_XACRO}include"))
    unknown = [] if included else [name for name in args if name not in declared]
    if unknown:
        known = ", ".join(sorted(declared)) or "none"
        raise InputError.of(f"unknown xacro argument {', '.join(unknown)}", file=path, allowed=f"arguments: {known}")
    # xacrodoc hands the arguments on as text; xacro writes booleans in small letters.
    text = {name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in args.items()}
    urdf = expand(path, text)
    _refuse_entities(urdf.encode(), path)
    return urdf


def _refuse_entities(text: bytes, path: Path) -> None:
    """Entities of XML can read other files and grow without end; robots need none."""
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise InputError.of("declares a document type (DOCTYPE, ENTITY), which is not read", file=path)


def _parse(text: str, path: Path) -> yourdfpy.URDF:
    """The robot, its meshes loaded from the robot's folder."""
    folder = robot_folder(path)

    def local(fname: str) -> str:  # yourdfpy gives it by this name
        mesh = (path.parent / fname.removeprefix("file://")).resolve()
        if not mesh.is_relative_to(folder):
            raise InputError.of(f"names a mesh outside the robot's folder: {mesh}", file=path, allowed=f"in {folder}")
        return str(mesh)

    try:
        return yourdfpy.URDF.load(io.BytesIO(text.encode()), filename_handler=local, load_meshes=True)
    except (ValueError, KeyError, AttributeError, IndexError, TypeError, OSError) as error:
        raise InputError.of(f"not a URDF that can be read: {error}", file=path) from error


def _link(robot: yourdfpy.URDF, name: str) -> Link:
    """Inertial of a link in the root link's frame."""
    inertial = robot.link_map[name].inertial
    origin = np.eye(4) if inertial.origin is None else np.asarray(inertial.origin)
    frame = robot.get_transform(name, robot.base_link) @ origin
    own = np.zeros((3, 3)) if inertial.inertia is None else np.asarray(inertial.inertia)
    turned = frame[:3, :3] @ own @ frame[:3, :3].T
    return Link(name=name, mass_kg=float(inertial.mass or 0.0), centre_m=frame[:3, 3], inertia_kg_m2=turned)


def _about(link: Link, centre_m: Floats) -> Floats:
    """Inertia [3, 3] of ``link`` about ``centre_m`` [3]."""
    return link.inertia_kg_m2 + steiner(link.mass_kg, link.centre_m - centre_m)


def _named(body: FileBody, name: str, path: Path) -> Link:
    """The inertial link called ``name``."""
    for link in body.links:
        if link.name == name:
            return link
    raise InputError.of(f"wheel link {name!r} needs an <inertial>", file=path)


def _wheel_order(robot: yourdfpy.URDF, joint: yourdfpy.Joint, centre_m: Floats) -> tuple[bool, bool]:
    """Sorts front before rear, left before right."""
    x, y, _ = robot.get_transform(joint.child, robot.base_link)[:3, 3] - centre_m
    return bool(x < 0.0), bool(y < 0.0)


def _wheel_size(robot: yourdfpy.URDF, name: str, path: Path) -> tuple[float, float]:
    """Radius and width (m) of a wheel link's cylinder or sphere."""
    link = robot.link_map[name]
    for shape in (*link.collisions, *link.visuals):
        if shape.geometry.cylinder is not None:
            return float(shape.geometry.cylinder.radius), float(shape.geometry.cylinder.length)
        if shape.geometry.sphere is not None:
            return float(shape.geometry.sphere.radius), 0.0
    raise InputError.of(f"wheel link {name!r} needs a cylinder or sphere as collision geometry", file=path)


def _outline(
    robot: yourdfpy.URDF, centre_m: Floats, positions: Floats, radius: float, width: float
) -> tuple[float, float, float, float]:
    """Bounds (rear, front, right, left) of wheels and drawn geometry seen from above, from the centre of mass."""
    wheel = np.array([radius, 0.5 * width])
    low, high = positions[:, :2].min(axis=0) - wheel, positions[:, :2].max(axis=0) + wheel
    if robot.scene is not None and robot.scene.geometry:
        drawn = robot.scene.bounds[:, :2] - centre_m[:2]
        low, high = np.minimum(low, drawn[0]), np.maximum(high, drawn[1])
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])
