"""What can happen to a vehicle: the kinds of events, and the time of the first of each kind."""

import jax
import jax.numpy as jnp
import numpy as np

KINDS = ("finished", "crash", "obstacle", "vehicle", "battery_empty", "non_finite")
"""finished: landed or arrived · crash: hit the ground too hard or tipped over · obstacle, vehicle: collided with one
· battery_empty · non_finite: its state stopped being a number and was held at the last good one."""

FINISHED, CRASH, OBSTACLE, VEHICLE, BATTERY_EMPTY, NON_FINITE = range(len(KINDS))
DESCRIPTIONS = {
    "finished": "ended its path at rest",
    "crash": "hit the ground too fast, or tipped over",
    "obstacle": "collided with an obstacle",
    "vehicle": "collided with another vehicle",
    "battery_empty": "used up its battery",
    "non_finite": "had a non-finite state, and was stopped at its last finite one",
}


def none_yet() -> jax.Array:
    """Event times [kinds] of a vehicle to which nothing has happened: infinity."""
    return jnp.full(len(KINDS), jnp.inf, jnp.float32)  # without the type the first tick would compile twice


def record(times_s: jax.Array, happened: jax.Array, now_s: jax.Array) -> jax.Array:
    """Event times [kinds] after the present ``happened`` [kinds]; only a vehicle still under way can have events."""
    return jnp.where(happened & under_way(times_s), jnp.minimum(times_s, now_s), times_s)


def under_way(times_s: jax.Array | np.ndarray) -> jax.Array:
    """Whether nothing has ended the vehicle's part yet [...], from event times [..., kinds]."""
    return jnp.all(jnp.isinf(times_s), axis=-1)


def crashed(times_s: jax.Array | np.ndarray) -> jax.Array:
    """Whether the vehicle's part ended otherwise than by finishing [...]."""
    return ~under_way(times_s) & jnp.isinf(times_s[..., FINISHED])
