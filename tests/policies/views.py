"""Views and tasks of one vehicle, as policies are given them."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np

from swarmsim.policies.path import Path
from swarmsim.policies.view import Task, View
from tests.policies.sites import block_site

SITE = block_site(extent=(40.0, 40.0))
LOOKAHEAD_M = 1.0


def view(position_m: Any = (0.0, 0.0, 0.0), velocity_m_s: Any = (0.0, 0.0, 0.0), **changes: Any) -> View:
    """What a vehicle sees that is alone, with a full battery and no radio."""
    position = jnp.asarray(position_m, jnp.float32)
    seen = {
        "time_s": jnp.float32(1.0),
        "quaternion": jnp.array([1.0, 0.0, 0.0, 0.0]),
        "angular_velocity_rad_s": jnp.zeros(3),
        "battery": jnp.float32(1.0),
        "height_m": jnp.maximum(position[2], 0.0),
        "hold": jnp.array(False),
        "push_m": jnp.zeros(3),
        "nearest_m": jnp.float32(np.inf),
        "reading": None,
        "heard": None,
        "belief": None,
    }
    changes = {name: jnp.asarray(value) for name, value in changes.items()}
    return View(position_m=position, velocity_m_s=jnp.asarray(velocity_m_s, jnp.float32), **seen | changes)


def task(path: Path | None = None, params: Any = None, known: Any = None) -> Task:
    """A task on flat ground; a rover's lookahead is a metre."""
    return Task(
        settings=SimpleNamespace(),
        site=SITE,
        home_m=jnp.zeros(2),
        yaw_rad=jnp.float32(0.3),
        params=SimpleNamespace(lookahead_m=jnp.float32(LOOKAHEAD_M)) if params is None else params,
        rank=jnp.int32(0),
        path=path,
        known=known,
    )
