"""What a policy is asked: one task per phase, for one mission."""

import jax

from swarmsim.pytree import pytree, static


@pytree
class AerialTask:
    """Survey an area with U multirotors; answered by one path per UAV (every field of `Path` gains an axis U)."""

    area_m: jax.Array  # [V, 2] convex polygon, ENU
    home_m: jax.Array  # [U, 2] where each UAV starts and lands, ENU
    altitude_m: jax.Array  # [] above ground
    line_spacing_m: jax.Array  # []
    sweep_rad: jax.Array  # [] direction of the lines, counter-clockwise from east
    obstacle_clearance_m: jax.Array  # [] kept above the highest surface nearby
    speed_m_s: jax.Array  # []
    climb_speed_m_s: jax.Array  # []
    descent_speed_m_s: jax.Array  # []
    touchdown_speed_m_s: jax.Array  # []
    acceleration_m_s2: jax.Array  # []
    lines_max: int = static()  # most lines that the area can need
    points: int = static()  # points of a path


@pytree
class GroundTask:
    """Drive a rover to a target and around it; answered by one `Path`."""

    start_m: jax.Array  # [2] ENU
    target_m: jax.Array  # [2] ENU, the estimated source
    standoff_m: jax.Array  # [] distance at which to look at the target
    speed_m_s: jax.Array  # []
    acceleration_m_s2: jax.Array  # []
    rover_radius_m: jax.Array  # [] clearance that the rover needs
    viewpoints: int = static()  # places round the target to visit
    laps: int = static()  # times round the target
    block: int = static()  # cells of the site's rasters along one edge of a planning cell
    window: int = static()  # planning cells that a route round the target may stray from it
    points: int = static()  # points of the path
