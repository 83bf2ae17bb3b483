"""What navigation sensors measure: the motion of one vehicle as it is."""

import jax

from swarmsim.pytree import pytree


@pytree
class Truth:
    """One vehicle at one time. World ENU, body FLU, SI."""

    position_m: jax.Array  # [3] world, from the mission's origin
    velocity_m_s: jax.Array  # [3] world
    quaternion: jax.Array  # [4] w x y z, body to world
    angular_velocity_rad_s: jax.Array  # [3] body
    specific_force_m_s2: jax.Array  # [3] body: what an ideal accelerometer reads, +9.81 along z at rest
    air_velocity_m_s: jax.Array  # [3] body: of the vehicle relative to the air
    height_m: jax.Array  # [] of the vehicle's origin above the ground below it
