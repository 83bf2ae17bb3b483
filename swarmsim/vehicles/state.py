"""What a vehicle's physics carries from step to step: the poses, the speeds and what has been used of the battery.

World frame ENU (x east, y north, z up), body frame FLU (x forward, y left, z up), SI units, float32. Positions are
those of the vehicle's centre of mass. One vehicle each: the missions layer adds the axes (mission, vehicle).
"""

import jax

from swarmsim.config.vehicle_checks import GRAVITY_M_S2 as GRAVITY_M_S2
from swarmsim.pytree import pytree


@pytree
class RigidState:
    """Pose and twist of a rigid body."""

    position_m: jax.Array  # [3] m, world: centre of mass
    quaternion: jax.Array  # [4] w x y z, body to world
    velocity_m_s: jax.Array  # [3] m/s, world: of the centre of mass
    angular_velocity_rad_s: jax.Array  # [3] rad/s, body


@pytree
class MultirotorState:
    """A multirotor: body, rotor speeds, contact with the ground, and energy used."""

    body: RigidState
    rotor_speed_rad_s: jax.Array  # [R] rad/s, magnitude (the sense of each rotor stands in the parameters)
    contact_slip_m: jax.Array  # [C, 3] m, body: elastic tangential give of each contact point, zero in the air
    ground_force_n: jax.Array  # [] N, of the ground along its normal during the last step: the landing gear's switch
    energy_j: jax.Array  # [] J drawn from the battery's cells since the start
    voltage_v: jax.Array  # [] V at the battery's terminals during the last step


@pytree
class SkidSteerState:
    """A four-wheel skid-steer rover; wheels in the order front left, front right, rear left, rear right."""

    body: RigidState
    wheel_angle_rad: jax.Array  # [4] rad, positive when rolling forward
    wheel_speed_rad_s: jax.Array  # [4] rad/s, positive when rolling forward
    wheel_torque_nm: jax.Array  # [4] N m at the wheel, after the motor's lag
    energy_j: jax.Array  # [] J drawn from the battery since the start
