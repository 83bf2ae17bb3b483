"""Vehicles as a user writes them: every number in SI, every number with its source."""

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from swarmsim.config.base import (
    Acceleration,
    Damping,
    Fraction,
    Friction,
    Gain,
    Lag,
    Mass,
    Model,
    Name,
    Part,
    Power,
    RotationSpeed,
    Speed,
    Stiffness,
    Vec3,
)
from swarmsim.config.radiation import DetectorMount
from swarmsim.config.sensors import SensorNames
from swarmsim.config.sourced import Sourced
from swarmsim.config.vehicle_checks import multirotor_fault, skid_steer_fault


def _inertia(numbers: tuple[float, ...]) -> tuple[float, ...]:
    """The numbers of a tensor of inertia that a body can have; ValueError otherwise."""
    if len(numbers) not in (3, 6):
        raise ValueError("give three principal moments, or the six elements Ixx, Iyy, Izz, Ixy, Ixz, Iyz of the tensor")
    moments = np.linalg.eigvalsh(inertia_tensor(numbers))
    words = ", ".join(f"{moment:.6g}" for moment in moments)
    if moments[0] <= 1e-12:
        raise ValueError(f"the tensor of inertia must be positive definite: its principal moments are {words}")
    if moments[2] > (1.0 + 1e-6) * (moments[0] + moments[1]):
        raise ValueError(f"no body has these principal moments: the largest of {words} exceeds the sum of the others")
    return numbers


def inertia_tensor(numbers: tuple[float, ...]) -> np.ndarray:
    """Tensor [3, 3] (kg m^2) of an `Inertia`."""
    xx, yy, zz, xy, xz, yz = (*numbers, 0.0, 0.0, 0.0)[:6]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


Moment = Annotated[float, Field(ge=-1e6, le=1e6)]  # kg m2
Inertia = Annotated[tuple[Moment, ...], Field(min_length=3, max_length=6), AfterValidator(_inertia)]
"""Inertia about the centre of mass (kg m^2, body FLU): the three principal moments where the body's axes are the
principal ones, or the six elements [Ixx, Iyy, Izz, Ixy, Ixz, Iyz] of the tensor, in the order of MuJoCo's
``fullinertia``. As there and in URDF the last three are the elements themselves, Ixy the integral of -x y dm."""


Drag = Annotated[float, Field(ge=0, le=1000)]  # kg/m
Argument = Annotated[float, Field(ge=-1e9, le=1e9)] | Annotated[int, Field(ge=-(10**9), le=10**9)]


class BodyFile(Model):
    """A URDF or xacro file that gives the body (mass, inertia, visual geometry), with its xacro arguments."""

    file: str = Field(min_length=1)
    args: dict[str, str | Argument | bool] = Field(default_factory=dict)


class Battery(Model):
    """Energy store: capacity, efficiency from battery to shaft, and what the avionics draw."""

    capacity_wh: Annotated[float, Field(ge=1e-3, le=1e6)]
    drive_efficiency: Annotated[float, Field(gt=0, le=1)]
    avionics_power_w: Power


class FlightBattery(Battery):
    """Lithium-polymer pack of a multirotor: its cells in series and its resistance."""

    cells: Annotated[int, Field(ge=1, le=100)]
    resistance_ohm: Annotated[float, Field(ge=0, le=100)]


class Rotor(Model):
    """One rotor's place (body FLU) and the sense in which it turns seen from above."""

    position_m: Vec3
    spin: Literal["ccw", "cw"]


class RotorModel(Model):
    """Propeller and motor: thrust = k w^2, yaw torque = c thrust, first-order lag of the speed.

    The motor turns between ``speed_min_rad_s`` (idle) and ``speed_max_rad_s``, or stands still when it is disarmed;
    below ``speed_max_voltage_v`` at the battery the largest speed falls with the voltage. ``figure_of_merit`` is ideal
    over shaft power in hover. ``solidity`` (blade area over disc area) makes the thrust depend on the air's motion,
    ``drag_kg`` and ``rolling_moment_kg_m`` are N and N m per rotor speed and speed across the rotor's axis,
    ``speed_noise`` is the standard deviation of a rotor's speed about what is commanded, over it; what is not given is
    left out.
    """

    thrust_coefficient_n_s2: Annotated[float, Field(ge=1e-12, le=100)]
    moment_constant_m: Annotated[float, Field(ge=1e-6, le=10)]
    time_constant_up_s: Lag
    time_constant_down_s: Lag
    speed_min_rad_s: Annotated[float, Field(ge=0, le=1e5)]
    speed_max_rad_s: RotationSpeed
    speed_max_voltage_v: Annotated[float, Field(ge=0.1, le=1000)]
    inertia_kg_m2: Annotated[float, Field(ge=0, le=100)]
    radius_m: Part
    figure_of_merit: Annotated[float, Field(gt=0, le=1)]
    solidity: Annotated[float, Field(ge=1e-3, le=1)] | None = None
    drag_kg: Annotated[float, Field(ge=0, le=1)] | None = None
    rolling_moment_kg_m: Annotated[float, Field(ge=0, le=1)] | None = None
    speed_noise: Annotated[float, Field(ge=0, le=0.2)] | None = None


class Feet(Model):
    """Spring-damper landing feet (body FLU, from the centre of mass) with regularised Coulomb friction.

    Stiffness and damping are those of one foot, normal to the ground; ``tangential_stiffness_n_m`` is the elastic give
    of a foot that sticks.
    """

    positions_m: tuple[Vec3, ...] = Field(min_length=3, max_length=32)
    stiffness_n_m: Stiffness
    tangential_stiffness_n_m: Stiffness
    damping_n_s_m: Damping
    friction: Friction


class MultirotorControl(Model):
    """Cascaded controller: natural frequencies and limits."""

    position_gain_1_s: Gain
    velocity_gain_1_s: Gain
    velocity_integral_1_s2: Annotated[float, Field(ge=0, le=1000)]
    attitude_gain_1_s: Gain
    yaw_gain_1_s: Gain
    rate_gain_1_s: Gain
    yaw_rate_max_deg_s: Annotated[float, Field(ge=0.1, le=10_000)]
    tilt_max_deg: float = Field(ge=0.1, lt=80)
    speed_max_m_s: Speed
    climb_rate_max_m_s: Speed
    acceleration_max_m_s2: Acceleration


class Multirotor(Sourced):
    """A multirotor (``configs/vehicles/<name>.yaml``).

    ``collision_radius_m`` and ``collision_height_m`` are those of the upright cylinder around the vehicle, propellers
    and feet included. ``drag_quadratic_kg_m`` is the airframe's drag over the squared airspeed, or one such number
    along each body axis. ``inertia_kg_m2`` are three principal moments or six elements of the tensor (`Inertia`).
    ``sensors`` are names of ``configs/sensors``, at most one of each kind; they cost nothing until they are read.
    """

    kind: Literal["multirotor"]
    name: Name
    description: str
    mass_kg: Mass
    inertia_kg_m2: Inertia
    rotors: tuple[Rotor, ...] = Field(min_length=3, max_length=32)
    rotor: RotorModel
    drag_quadratic_kg_m: Drag | tuple[Drag, Drag, Drag]
    feet: Feet
    collision_radius_m: Part
    collision_height_m: Part
    impact_speed_max_m_s: Speed
    battery: FlightBattery
    control: MultirotorControl
    detector: DetectorMount | None = None
    body: BodyFile | None = None
    sensors: SensorNames = ()

    @model_validator(mode="after")
    def _can_fly(self) -> "Multirotor":
        if fault := multirotor_fault(self):
            raise ValueError(fault)
        return self


class Castors(Model):
    """Castors in place of the rear wheels: a differential drive.

    Each is a wheel without a motor, of the size and on the track of the driven ones, that rolls ahead and slides to all
    sides against its own small ``friction``. ``load_share`` is the share of the weight on the two, on level ground.
    """

    friction: Annotated[float, Field(ge=1e-4, le=10)]
    load_share: float = Field(ge=1e-3, lt=1)


class Wheels(Model):
    """Four wheels: radius, mass, spacing and friction with the ground. All are driven where there are no ``castors``.

    ``stiffness_n_m`` is load over sinkage of one tyre, ``damping_ratio`` that of the rover bouncing on its four tyres.
    """

    radius_m: Part
    width_m: Part
    mass_kg: Mass
    wheel_base_m: Part
    track_m: Part
    friction: Annotated[float, Field(ge=1e-4, le=10)]
    rolling_resistance: Fraction
    stiffness_n_m: Stiffness
    damping_ratio: Annotated[float, Field(ge=1e-3, le=100)]
    castors: Castors | None = None


class WheelMotor(Model):
    """Wheel motor with its speed loop: torque limit, first-order torque lag, loop gain.

    ``rotor_inertia_kg_m2`` is that of rotor and gears as the wheel feels it, the square of the gear ratio included.
    """

    rotor_inertia_kg_m2: Annotated[float, Field(ge=0, le=1000)]
    torque_max_nm: Annotated[float, Field(ge=1e-4, le=1e5)]
    time_constant_s: Lag
    speed_gain_nm_s: Annotated[float, Field(ge=1e-5, le=1e5)]
    speed_max_rad_s: RotationSpeed


class Bumper(Model):
    """Spring-damper of each point of the chassis that meets ground or the edge of a step, with Coulomb friction."""

    stiffness_n_m: Stiffness
    damping_n_s_m: Damping
    friction: Friction


class SkidSteerControl(Model):
    """Path following of a skid-steer rover (pure pursuit)."""

    lookahead_m: Annotated[float, Field(ge=1e-3, le=100)]
    speed_max_m_s: Speed
    yaw_rate_max_rad_s: Annotated[float, Field(ge=1e-3, le=100)]
    acceleration_max_m_s2: Acceleration
    yaw_gain_1_s: Gain


class SkidSteer(Sourced):
    """A rover on four wheels, skid-steered or with castors behind (``configs/vehicles/<name>.yaml``).

    ``sensors`` are names of ``configs/sensors``, at most one of each kind; they cost nothing until they are read.
    """

    kind: Literal["skid_steer"]
    name: Name
    description: str
    mass_kg: Mass
    chassis_size_m: tuple[Part, Part, Part]
    chassis_height_m: Part
    wheels: Wheels
    motor: WheelMotor
    bumper: Bumper
    impact_speed_max_m_s: Speed
    slope_max_deg: float = Field(ge=0.1, lt=60)
    step_max_m: Part
    battery: Battery
    control: SkidSteerControl
    detector: DetectorMount | None = None
    body: BodyFile | None = None
    sensors: SensorNames = ()

    @model_validator(mode="after")
    def _can_drive(self) -> "SkidSteer":
        if fault := skid_steer_fault(self):
            raise ValueError(fault)
        return self


Vehicle = Annotated[Multirotor | SkidSteer, Field(discriminator="kind")]
VEHICLE_KINDS: tuple[str, ...] = ("multirotor", "skid_steer")
