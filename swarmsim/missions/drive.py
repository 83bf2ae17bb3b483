"""One rover on its path: pursuit, control and physics for one tick, and what has happened to it since."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from swarmsim.control.skid_steer import wheel_speeds
from swarmsim.missions import events
from swarmsim.physics.skid_steer import Step
from swarmsim.physics.wheels import impact_speed
from swarmsim.policies.path import Path, reference
from swarmsim.pytree import pytree
from swarmsim.site import Site
from swarmsim.vehicles.skid_steer import SkidSteerParams
from swarmsim.vehicles.state import SkidSteerState

ARRIVED_M = 0.2  # a rover this close to the end of its path, its reference being there, has arrived
ARRIVED_SPEED_M_S = 0.1
START_SPEED_M_S = 0.2  # a path starts at rest, a rover on it at this speed
TILT_LIMIT_COSINE = 0.5  # a rover tilted by 60 degrees has tipped over


@pytree
class Drive:
    """A skid-steer rover under way."""

    vehicle: SkidSteerState
    progress_m: jax.Array  # [] arc length of the point it pursues along the path
    start_s: jax.Array  # [] mission clock when the drive began
    event_time_s: jax.Array  # [kinds] first time of each kind of event, inf where there was none


Guide = Callable[[SkidSteerState, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]
"""From state and progress to the wanted speed (m/s), yaw rate (rad/s) and the progress one control period later."""


def carrot(
    path: Path, lookahead_m: jax.Array, progress_m: jax.Array, position_m: jax.Array, dt: float
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The point [2] to pursue, the speed limit where the rover is, and the progress ``dt`` s later.

    The point keeps a lookahead ahead of the rover: it moves on as fast as is needed, at most at three times the speed.
    """
    ahead = reference(path, progress_m)
    gap = jnp.sqrt(jnp.sum((ahead.position_m[:2] - position_m[:2]) ** 2))
    behind = reference(path, progress_m - jnp.minimum(gap, lookahead_m), START_SPEED_M_S)
    advance = jnp.clip(lookahead_m - gap, 0.0, 3.0 * behind.speed_m_s * dt)
    return ahead.position_m[:2], behind.speed_m_s, jnp.minimum(progress_m + advance, path.length_m)


def drive_tick(
    params: SkidSteerParams,
    drive: Drive,
    guide: Guide,
    site: Site,
    *,
    step: Step,
    periods: int,
    substeps: int,
    dt: float,
) -> Drive:
    """Drive for one tick of ``periods`` control periods, each of ``substeps`` physics steps of ``dt`` s."""
    moving = events.under_way(drive.event_time_s)

    def control_period(
        carry: tuple[SkidSteerState, jax.Array], _: None
    ) -> tuple[tuple[SkidSteerState, jax.Array], None]:
        vehicle, progress = carry
        speed, yaw_rate, progress = guide(vehicle, progress)
        command = wheel_speeds(params, jnp.where(moving, speed, 0.0), jnp.where(moving, yaw_rate, 0.0), vehicle)
        # a loop and not unrolled: the contact solver takes long to compile
        vehicle = jax.lax.fori_loop(0, substeps, lambda _, moved: step(params, moved, command, site), vehicle)
        return (vehicle, progress), None

    vehicle, progress = jax.lax.scan(control_period, (drive.vehicle, drive.progress_m), None, length=periods)[0]
    return replace(drive, vehicle=vehicle, progress_m=progress)


def judge(
    params: SkidSteerParams,
    before: Drive,
    after: Drive,
    path_end_m: jax.Array,
    remaining_m: jax.Array,
    site: Site,
    now_s: jax.Array,
) -> Drive:
    """The drive after a tick, with its events recorded; a rover that has ended its part stands where it was.

    Args:
        params: of the rover.
        before, after: drive at the start and the end of the tick.
        path_end_m: [3] last point of the path.
        remaining_m: [] of the path ahead of the pursued point.
        site, now_s: the place, and the time at the end of the tick.
    """
    body = after.vehicle.body
    finite = jnp.all(jnp.isfinite(ravel_pytree(after.vehicle)[0]))
    near = jnp.linalg.norm(body.position_m[:2] - path_end_m[:2]) < ARRIVED_M
    still = jnp.linalg.norm(body.velocity_m_s) < ARRIVED_SPEED_M_S
    arrived = near & still & (remaining_m <= 0.0)
    upright = 1.0 - 2.0 * (body.quaternion[1] ** 2 + body.quaternion[2] ** 2)
    # the bumpers may have stopped the rover within the tick: a wall that it touches now was met at the speed before
    twist = replace(body, velocity_m_s=before.vehicle.body.velocity_m_s)
    hit = impact_speed(params, replace(after.vehicle, body=twist), site) > params.impact_speed_max_m_s
    empty = after.vehicle.energy_j > params.battery_capacity_j
    no = jnp.array(False)
    happened = jnp.stack([arrived, upright < TILT_LIMIT_COSINE, hit, no, empty, no]) & finite
    happened = happened.at[events.NON_FINITE].set(~finite)
    times = events.record(before.event_time_s, happened, now_s)
    ended = ~events.under_way(before.event_time_s) | ~finite
    held = jax.tree.map(lambda old, new: jnp.where(ended, old, new), before, after)
    return replace(held, event_time_s=times)
