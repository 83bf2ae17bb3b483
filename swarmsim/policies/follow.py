"""Follow a path: the policy that every planner's vehicles run, one class for each way of moving."""

import jax
import jax.numpy as jnp

from swarmsim.control.commands import DriveToCommand, PositionCommand
from swarmsim.policies.path import reference
from swarmsim.policies.view import Task, View
from swarmsim.pytree import pytree, static
from swarmsim.site import sample

START_SPEED_M_S = 0.3  # a reference at rest at the start of its path sets out at this speed
PACE_M_S2 = 2.5  # the reference stops and sets out again with this, or the vehicle would overshoot it and fly back
LAG_M = 1.0  # the reference waits for a vehicle that is further behind than this
LANDING_PATH_M = 1.0  # within this rest of its path a vehicle that stands on the ground has landed
LANDED_SPEED_M_S = 0.15
LANDED_HEIGHT_M = 0.1
LANDS_BELOW_M = 0.5  # a path that ends no higher above the ground than this ends with a landing

ROVER_START_SPEED_M_S = 0.2  # a path starts at rest, a rover on it at this speed
ARRIVED_M = 0.2  # a rover this close to the end of its path, its reference being there, has arrived
ARRIVED_SPEED_M_S = 0.1


@pytree
class Progress:
    """How far along its path a follower's reference is."""

    progress_m: jax.Array  # [] arc length
    pace: jax.Array  # [] speed of the reference over that of the path
    lands: jax.Array  # [] bool: the path ends on the ground


@pytree
class FollowByAir:
    """Fly along a path: the reference waits for traffic and for a vehicle that lags behind."""

    control_period_s: float = static()

    def start(self, task: Task, key: jax.Array) -> Progress:
        """At the beginning of the path."""
        assert task.path is not None
        end = task.path.points_m[-1]
        lands = end[2] < sample(task.site.terrain_m, task.site, end[:2]) + LANDS_BELOW_M
        return Progress(progress_m=jnp.zeros(()), pace=jnp.zeros(()), lands=lands)

    def act(self, task: Task, memory: Progress, view: View, key: jax.Array) -> tuple[Progress, PositionCommand]:
        """Position and velocity of the reference, displaced by what traffic asks for."""
        path = task.path
        assert path is not None
        here = reference(path, memory.progress_m, START_SPEED_M_S)
        offset = here.position_m - view.position_m
        lag = jnp.sqrt(jnp.sum(offset * offset) + 1e-12)
        allowed = jnp.where(view.hold, 0.0, jnp.clip(2.0 - lag / LAG_M, 0.0, 1.0))
        change = PACE_M_S2 * self.control_period_s / jnp.maximum(here.speed_m_s, START_SPEED_M_S)
        pace = memory.pace + jnp.clip(allowed - memory.pace, -change, change)
        progress = jnp.minimum(memory.progress_m + pace * here.speed_m_s * self.control_period_s, path.length_m)
        command = PositionCommand(
            position_m=here.position_m + view.push_m,
            velocity_m_s=pace * here.velocity_m_s,
            acceleration_m_s2=pace * pace * here.acceleration_m_s2,
            yaw_rad=task.yaw_rad,
            hold_position=jnp.ones(()),
        )
        return Progress(progress_m=progress, pace=pace, lands=memory.lands), command

    def done(self, task: Task, memory: Progress, view: View) -> jax.Array:
        """Whether [] it has landed at the end of its path, or hovers there."""
        assert task.path is not None
        near = task.path.length_m - memory.progress_m < LANDING_PATH_M
        slow = jnp.sum(view.velocity_m_s**2) < LANDED_SPEED_M_S**2
        return near & slow & (~memory.lands | (view.height_m < LANDED_HEIGHT_M))


@pytree
class FollowByGround:
    """Drive along a path by pure pursuit of a point that keeps a lookahead ahead of the rover."""

    control_period_s: float = static()

    def start(self, task: Task, key: jax.Array) -> Progress:
        """At the beginning of the path."""
        return Progress(progress_m=jnp.zeros(()), pace=jnp.zeros(()), lands=jnp.array(True))

    def act(self, task: Task, memory: Progress, view: View, key: jax.Array) -> tuple[Progress, DriveToCommand]:
        """The pursued point; it moves on as fast as is needed, at most at three times the speed of the path."""
        path = task.path
        assert path is not None
        ahead = reference(path, memory.progress_m)
        offset = ahead.position_m[:2] - view.position_m[:2]
        gap = jnp.sqrt(jnp.sum(offset * offset) + 1e-12)
        lookahead = task.params.lookahead_m
        behind = reference(path, memory.progress_m - jnp.minimum(gap, lookahead), ROVER_START_SPEED_M_S)
        pace = jnp.where(view.hold, 0.0, 1.0)
        advance = pace * jnp.clip(lookahead - gap, 0.0, 3.0 * behind.speed_m_s * self.control_period_s)
        progress = jnp.minimum(memory.progress_m + advance, path.length_m)
        command = DriveToCommand(position_m=ahead.position_m[:2], speed_m_s=pace * behind.speed_m_s)
        return Progress(progress_m=progress, pace=pace, lands=memory.lands), command

    def done(self, task: Task, memory: Progress, view: View) -> jax.Array:
        """Whether [] it stands at the end of its path."""
        path = task.path
        assert path is not None
        offset = view.position_m[:2] - path.points_m[-1, :2]
        near = jnp.sum(offset * offset) < ARRIVED_M**2
        slow = jnp.sum(view.velocity_m_s**2) < ARRIVED_SPEED_M_S**2
        return near & slow & (memory.progress_m >= path.length_m)
