"""What a vehicle looks like, from its specification: the little that a picture needs."""

import numpy as np

from swarmsim.config.vehicles import Multirotor, SkidSteer
from swarmsim.results.record import Shape
from swarmsim.vehicles.rover_body import rover_body


def shape_of(spec: Multirotor | SkidSteer) -> Shape:
    """The shape of ``spec`` in its body frame (FLU, origin in the centre of mass).

    A multirotor's box is its hub, below the rotors; a rover's is its chassis.
    """
    return _multirotor(spec) if isinstance(spec, Multirotor) else _rover(spec)


def _multirotor(spec: Multirotor) -> Shape:
    hubs = np.array([rotor.position_m for rotor in spec.rotors], float)
    feet = np.array(spec.feet.positions_m, float)
    side = 0.8 * float(np.linalg.norm(hubs[:, :2], axis=1).mean())
    top, bottom = float(hubs[:, 2].mean()), float(feet[:, 2].mean())
    height = max(0.4 * (top - bottom), 0.25 * side)
    return Shape(
        hubs_m=hubs,
        radius_m=spec.rotor.radius_m,
        width_m=0.0,
        box_centre_m=np.array([0.0, 0.0, top - 0.5 * height]),
        box_size_m=np.array([side, 0.7 * side, height]),
    )


def _rover(spec: SkidSteer) -> Shape:
    body = rover_body(spec)
    hubs = np.asarray(body.wheel_position_m, float)
    ground = float(hubs[:, 2].mean()) - body.wheel_radius_m
    return Shape(
        hubs_m=hubs,
        radius_m=body.wheel_radius_m,
        width_m=body.wheel_width_m,
        box_centre_m=np.array([*hubs[:, :2].mean(axis=0), ground + spec.chassis_height_m]),
        box_size_m=np.array(spec.chassis_size_m, float),
    )
