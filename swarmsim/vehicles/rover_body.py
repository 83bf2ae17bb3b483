"""Masses and shape of a rover on the host, as its specification describes them or as a URDF file gives them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.vehicles import SkidSteer

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RoverBody:
    """Masses and shape of a rover on the host; body frame FLU with its origin in the rover's centre of mass."""

    mass_kg: float  # the whole rover
    inertia_kg_m2: Floats  # [3, 3] the whole rover about its centre of mass
    wheel_position_m: Floats  # [4, 3] wheel centres
    wheel_radius_m: float
    wheel_width_m: float
    wheel_mass_kg: float
    wheel_inertia_kg_m2: tuple[float, float]  # about the axle, across the axle
    outline_m: tuple[float, float, float, float]  # rear, front, right, left bounds of the plan view (x, x, y, y)


def rover_body(spec: SkidSteer) -> RoverBody:
    """Body of ``spec``: what its file says, or else a uniform box between four uniform discs, upright on level ground.

    Raises `InputError` when the file cannot be used.
    """
    if spec.body is not None:
        # The URDF libraries take half a second to import: only a rover that comes from a file pays for them.
        from swarmsim.vehicles.bodies import read_rover_body

        return read_rover_body(spec.body)
    wheels = spec.wheels
    behind = 0.5 if wheels.castors is None else wheels.castors.load_share
    ahead, back, y = behind * wheels.wheel_base_m, (1.0 - behind) * wheels.wheel_base_m, 0.5 * wheels.track_m
    chassis_mass = spec.mass_kg - 4.0 * wheels.mass_kg
    height = (chassis_mass * spec.chassis_height_m + 4.0 * wheels.mass_kg * wheels.radius_m) / spec.mass_kg
    hub = wheels.radius_m - height
    wheel_position = np.array([[ahead, y, hub], [ahead, -y, hub], [-back, y, hub], [-back, -y, hub]])
    axle = 0.5 * wheels.mass_kg * wheels.radius_m**2
    across = wheels.mass_kg * (3.0 * wheels.radius_m**2 + wheels.width_m**2) / 12.0
    sides = np.square(spec.chassis_size_m)
    inertia = chassis_mass / 12.0 * np.diag(sides.sum() - sides)
    offset = -wheels.mass_kg * wheel_position[:, 0].sum() / chassis_mass  # of the box, which the wheels balance
    inertia += steiner(chassis_mass, np.array([offset, 0.0, spec.chassis_height_m - height]))
    for position in wheel_position:
        inertia += np.diag([across, axle, across]) + steiner(wheels.mass_kg, position)
    front = max(0.5 * spec.chassis_size_m[0], ahead + wheels.radius_m)
    rear = max(0.5 * spec.chassis_size_m[0], back + wheels.radius_m)
    side = max(0.5 * spec.chassis_size_m[1], y + 0.5 * wheels.width_m)
    return RoverBody(
        mass_kg=spec.mass_kg,
        inertia_kg_m2=inertia,
        wheel_position_m=wheel_position,
        wheel_radius_m=wheels.radius_m,
        wheel_width_m=wheels.width_m,
        wheel_mass_kg=wheels.mass_kg,
        wheel_inertia_kg_m2=(axle, across),
        outline_m=(-rear, front, -side, side),
    )


def steiner(mass_kg: float, offset_m: Floats) -> Floats:
    """Inertia [3, 3] that ``mass_kg`` gains when its centre stands at ``offset_m`` [3] (parallel axes)."""
    return mass_kg * (np.eye(3) * (offset_m @ offset_m) - np.outer(offset_m, offset_m))
