"""What can end a vehicle's part in a mission: the kinds of events, and the time of the first of each kind."""

import jax
import jax.numpy as jnp
import numpy as np

LOSSES = ("crash", "obstacle", "vehicle", "battery_empty", "non_finite")
"""crash: hit the ground too hard or tipped over · obstacle, vehicle: collided with one · battery_empty · non_finite:
its state or its command stopped being a number, and it is held at the last good state. The motors are off from then on.
"""
FAILSAFES = ("fence", "wind", "battery_low", "link_lost")
"""The autopilot has taken over (`swarmsim.world.failsafes`): it flies on, its part in the mission has ended."""
KINDS = LOSSES + FAILSAFES

CRASH, OBSTACLE, VEHICLE, BATTERY_EMPTY, NON_FINITE, FENCE, WIND, BATTERY_LOW, LINK_LOST = range(len(KINDS))
DESCRIPTIONS = {
    "crash": "hit the ground too fast, or tipped over",
    "obstacle": "collided with an obstacle",
    "vehicle": "collided with another vehicle",
    "battery_empty": "used up its battery",
    "non_finite": "had a non-finite state or command, and was stopped where it was last finite",
    "fence": "failsafe: was about to leave the fence",
    "wind": "failsafe: the air carried it off although it did nearly all that it can",
    "battery_low": "failsafe: its battery was low",
    "link_lost": "failsafe: it lost the link to the ground station",
}


def none_yet() -> jax.Array:
    """Event times [kinds] of a vehicle to which nothing has happened: infinity."""
    return jnp.full(len(KINDS), jnp.inf, jnp.float32)


def record(times_s: jax.Array, happened: jax.Array, now_s: jax.Array) -> jax.Array:
    """Record first event times [kinds] of what ``happened`` [kinds]; a vehicle that is lost has no more events."""
    return jnp.where(happened & intact(times_s), jnp.minimum(times_s, now_s), times_s)


def able(times_s: jax.Array | np.ndarray) -> jax.Array:
    """Whether nothing has ended the vehicle's part [...] in the mission, from event times [..., kinds]."""
    return jnp.all(jnp.isinf(times_s), axis=-1)


def intact(times_s: jax.Array | np.ndarray) -> jax.Array:
    """Whether the vehicle [...] is not lost: it may have a part in the mission, or be under a failsafe."""
    return jnp.all(jnp.isinf(times_s[..., : len(LOSSES)]), axis=-1)


def rescued(times_s: jax.Array | np.ndarray) -> jax.Array:
    """Whether the vehicle [...] is intact and its autopilot has taken over."""
    return intact(times_s) & ~able(times_s)
