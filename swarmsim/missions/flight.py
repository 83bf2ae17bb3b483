"""One multirotor on its path: reference, control, wind and physics for one tick, and what has happened to it since."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from swarmsim.control.multirotor import ControlMemory, Setpoint, control
from swarmsim.missions import events
from swarmsim.physics.contact import Plane
from swarmsim.physics.rotations import rotate
from swarmsim.physics.wind import GustState, gust_step, steady_wind
from swarmsim.policies.path import Path, reference
from swarmsim.pytree import pytree
from swarmsim.site import Site, sample, sample_with_gradient
from swarmsim.vehicles.multirotor import MultirotorParams
from swarmsim.vehicles.state import MultirotorState

START_SPEED_M_S = 0.3  # a reference at rest at the start of its path sets out at this speed
LAG_M = 1.0  # the reference waits for a vehicle that is further behind than this
LANDED_SPEED_M_S = 0.15
LANDED_HEIGHT_M = 0.1
TILT_LIMIT_COSINE = 0.3  # about 72 degrees: beyond it near the ground a multirotor has tipped over
OBSTACLE_HEIGHT_M = 0.4  # a surface this far above the terrain is an obstacle, not ground


@pytree
class Flight:
    """A multirotor under way."""

    vehicle: MultirotorState
    memory: ControlMemory
    gust: GustState
    progress_m: jax.Array  # [] arc length of the reference along the path
    event_time_s: jax.Array  # [kinds] first time of each kind of event, inf where there was none


@pytree
class Traffic:
    """What the other vehicles ask of this one."""

    hold: jax.Array  # [] bool: wait, another has the right of way
    push_m: jax.Array  # [3] displacement of the reference away from it, ENU
    collided: jax.Array  # [] bool


@pytree
class Air:
    """Wind of the mission."""

    speed_m_s: jax.Array  # [] at the reference height
    direction: jax.Array  # [2] unit vector that the air moves along, ENU
    gust_intensity: jax.Array  # [] 1 with gusts, 0 without


PhysicsStep = Callable[[MultirotorParams, MultirotorState, jax.Array, jax.Array, Plane], MultirotorState]


def ground_below(site: Site, position_m: jax.Array) -> Plane:
    """Tangent plane of the terrain below a position [3]."""
    height, slope = sample_with_gradient(site.terrain_m, site, position_m[:2])
    normal = jnp.append(-slope, 1.0)
    return Plane(point_m=jnp.append(position_m[:2], height), normal=normal / jnp.linalg.norm(normal))


def follow(path: Path, progress_m: jax.Array, position_m: jax.Array, traffic: Traffic, yaw: jax.Array, dt: float):  # type: ignore[no-untyped-def]
    """Setpoint on the path and the progress after ``dt``: the reference waits for traffic and for a vehicle behind."""
    here = reference(path, progress_m, START_SPEED_M_S)
    lag = jnp.linalg.norm(here.position_m - position_m)
    pace = jnp.where(traffic.hold, 0.0, jnp.clip(2.0 - lag / LAG_M, 0.0, 1.0))
    setpoint = Setpoint(
        position_m=here.position_m + traffic.push_m,
        velocity_m_s=pace * here.velocity_m_s,
        acceleration_m_s2=jnp.zeros(3),
        yaw_rad=yaw,
    )
    return setpoint, jnp.minimum(progress_m + pace * here.speed_m_s * dt, path.length_m)
