"""The air that multirotors push down onto those below them."""

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.pytree import pytree
from swarmsim.vehicles.rotors import AIR_DENSITY_KG_M3
from swarmsim.world.neighbours import Candidates, dot

SPREAD = 0.096
"""Half width of a round turbulent jet over the distance from its virtual origin (Pope, Turbulent Flows, 2000, section
5.1: 0.094 to 0.102)."""
_SHAPE = 2.0**0.5 - 1.0  # of the profile (1 + a xi^2)^-2, which is one half at the half width
DECAY = float(np.sqrt(0.75 * _SHAPE) / SPREAD)
"""Speed on the axis times the distance from the virtual origin, over sqrt(4 T / pi rho): 5.8, which is what keeps the
momentum flux equal to the thrust T, and is measured (Pope: 5.8 to 6.06)."""
ORIGIN = 5.8
"""Virtual origin above the rotors in distances of opposite motors: the jet then has about the rotors' own induced
velocity where it leaves them."""
DEPTH_MAX, REACH_MAX = 40.0, 10.0
"""How far down and aside a jet is felt, in distances of opposite motors; it fades over the last quarter, and
sets in over the first quarter of one such distance below the rotors."""


@pytree
class Rotorcraft:
    """Vehicles as sources of downwash; axis V."""

    position_m: jax.Array  # [V, 3] world
    velocity_m_s: jax.Array  # [V, 3] world
    wind_m_s: jax.Array  # [V, 3] velocity of the air where it is, world, without the others
    thrust_n: jax.Array  # [V] 0 of what has no rotors
    span_m: jax.Array  # [V] distance of opposite motors


def reach_m(span_m: jax.Array) -> jax.Array:
    """Horizontal distance [] m within which vehicles of motor distances ``span_m`` [V] feel each other."""
    return REACH_MAX * jnp.max(span_m, initial=0.0)


def downwash(craft: Rotorcraft, near: Candidates) -> jax.Array:
    """Speed [V] m/s of the air downwards that each vehicle is in, averaged over its rotors.

    Far enough below, all rotors of a vehicle make one turbulent jet, whose speed needs only thrust and size (Bauersfeld
    et al., "Robotics meets fluid dynamics: a characterization of the induced airflow below a quadrotor as a turbulent
    jet", IEEE Robotics and Automation Letters, 2025, arXiv 2403.13321). Nearer than 2.5 motor distances, where the
    rotors have jets of their own, it is a mean. What the paper has not: the air of a jet drifts with the wind while it
    sinks, and a vehicle that moves leaves it behind. Of several jets the momentum fluxes add.
    """
    of = near.of
    below = of(craft.position_m) - craft.position_m[:, None]
    strength = jnp.sqrt((4.0 / (np.pi * AIR_DENSITY_KG_M3)) * jnp.maximum(craft.thrust_n, 0.0))
    drift = craft.wind_m_s[:, :2] - craft.velocity_m_s[:, :2]
    span, flow = of(craft.span_m), DECAY * of(strength)
    blows = near.pair & (below[..., 2] > 0.0) & (flow > 0.0)
    depth, origin = jnp.where(blows, below[..., 2], 0.0), ORIGIN * jnp.where(blows, span, 1.0)
    length = depth + origin
    age = 0.5 * (length * length - origin * origin) / jnp.where(blows, flow, 1.0)
    aside = jnp.where(blows[..., None], below[..., :2] + age[..., None] * of(drift), 0.0)
    own = 0.25 * craft.span_m * craft.span_m  # its rotors are this far from its middle, squared
    square = (dot(aside, aside) + own[:, None]) / (SPREAD * SPREAD * length * length)
    speed = jnp.where(blows, flow, 0.0) / (length * (1.0 + _SHAPE * square) ** 2)
    away = dot(below[..., :2], below[..., :2]) / (REACH_MAX * REACH_MAX)
    near_enough = _faded(depth / DEPTH_MAX, span) * _faded(jnp.sqrt(away + 1e-12), span)
    near_enough *= jnp.clip(4.0 * depth / jnp.maximum(span, 1e-3), 0.0, 1.0)  # nothing at the same height
    total = jnp.sum((near_enough * speed) ** 2, axis=1)
    return jnp.where(total > 0.0, jnp.sqrt(jnp.where(total > 0.0, total, 1.0)), 0.0)


def _faded(distance_m: jax.Array, span_m: jax.Array) -> jax.Array:
    """Share [...] from 1 at three quarters of ``span_m`` to 0 at ``span_m``."""
    return jnp.clip(4.0 * (1.0 - distance_m / jnp.maximum(span_m, 1e-3)), 0.0, 1.0)
