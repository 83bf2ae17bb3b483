"""Stay in place."""

from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.config.policies import Hold
from swarmsim.control.commands import DriveCommand, go_to
from swarmsim.policies.registry import register
from swarmsim.policies.view import Task, View
from swarmsim.vehicles.skid_steer import SkidSteerParams


@register("hold")
class HoldPlace:
    """Stay where the vehicle is when the phase begins: a flying multirotor hovers, one on the ground rests."""

    Settings = Hold
    period_s = 0.1

    def start(self, task: Task, key: jax.Array) -> jax.Array:
        """No place yet: the first view gives it."""
        return jnp.full(3, jnp.nan)

    def act(self, task: Task, memory: jax.Array, view: View, key: jax.Array) -> tuple[jax.Array, Any]:
        """The command to the place of the first view."""
        place = jnp.where(jnp.isfinite(memory), memory, view.position_m)
        if isinstance(task.params, SkidSteerParams):
            return place, DriveCommand(speed_m_s=jnp.zeros(()), yaw_rate_rad_s=jnp.zeros(()))
        return place, go_to(place, task.yaw_rad)
