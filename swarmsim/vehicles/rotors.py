"""Rotors in moving air: thrust, in-plane drag, rolling moment and power of fixed-pitch propellers.

All of one vehicle's rotors at once, leading axis R; body frame FLU, rotor axes along body z, SI units.
"""

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree

AIR_DENSITY_KG_M3 = 1.225
"""Density of the air at sea level (ISO 2533, standard atmosphere)."""
GROUND_EFFECT_HEIGHT_MIN = 0.5
"""Lowest rotor height in propeller radii at which the ground effect is evaluated: the theory holds above it."""
ADVANCE_MAX = 0.5
"""Forward speed over tip speed up to which blades are taken to meet faster air; beyond it too much of a disc stalls."""
_STILL_M2_S2 = 1e-6  # keeps derivatives finite where nothing moves


@pytree
class RotorAir:
    """What moving air does to a rotor; a coefficient of zero leaves that effect out."""

    radius_m: jax.Array  # []
    induced_m: jax.Array  # [] m: induced velocity in hover over the rotor speed
    inflow_kg_m: jax.Array  # [] thrust lost per tip speed and inflow
    translational_lift_kg_m: jax.Array  # [] the same, for the inflow that is spared in forward flight
    pitch_rad: jax.Array  # [] of the blades, mean as blade element theory weighs it
    drag_kg: jax.Array  # [] N/((rad/s) (m/s)), in the plane of the rotor
    rolling_moment_kg_m: jax.Array  # [] N m/((rad/s) (m/s)), about the direction of motion
    ground_effect: jax.Array  # [] 1, or 0 to leave it out


def ground_gain(
    height_m: jax.Array,
    radius_m: jax.Array,
    induced_m2_s2: jax.Array | float = 1.0,
    level_m2_s2: jax.Array | float = 0.0,
) -> jax.Array:
    """What rotors [...] at ``height_m`` above the ground gain of thrust at equal power, over that far from it.

    Cheeseman and Bennett, "The effect of the ground on a helicopter rotor in forward flight" (ARC R&M 3021, 1955): a
    thrust 1 / (1 - (R / 4 z)^2 / (1 + V^2 / v^2)) times that far away. The squares of the induced velocity v and of the
    forward speed V are ``induced_m2_s2`` and ``level_m2_s2``. The height is held above half a radius, where the theory
    ends: the gain is at most 1/3.
    """
    height = jnp.maximum(height_m, GROUND_EFFECT_HEIGHT_MIN * radius_m)
    near = radius_m * radius_m * induced_m2_s2
    return near / (16.0 * height * height * (induced_m2_s2 + level_m2_s2) - near)


def thrusts(
    air: RotorAir, thrust_coefficient_n_s2: jax.Array, speed_rad_s: jax.Array, hub_m_s: jax.Array, height_m: jax.Array
) -> jax.Array:
    """Thrust [R] N of rotors at ``speed_rad_s`` [R] whose hubs move by ``hub_m_s`` [R, 3] through the air (body).

    k w^2 in still air. Blade element theory makes the thrust fall with the inflow, by rho A a sigma / 4 per tip speed
    and inflow, and momentum theory gives the inflow (Leishman, Principles of Helicopter Aerodynamics, 2nd ed., sections
    2.14 and 3.2). Along the axis it is half of a climb in hover, because the induced velocity gives way by the other
    half, and all of it in fast forward flight. In forward flight the induced velocity is Glauert's, v^2 = sqrt(V^4 / 4
    + v_h^4) - V^2 / 2 with v_h in hover, and the blades meet faster air. Heights [R] m above the ground raise the
    thrust. Vortex ring and windmill states are not modelled: a rotor that sinks faster than its wake keeps the thrust
    of one that sinks as fast as it.
    """
    hover = air.induced_m * speed_rad_s
    level = hub_m_s[:, 0] * hub_m_s[:, 0] + hub_m_s[:, 1] * hub_m_s[:, 1]
    half = 0.5 * level
    induced = jnp.sqrt(jnp.sqrt(half * half + hover**4 + _STILL_M2_S2**2) - half + _STILL_M2_S2)
    tip = air.radius_m * speed_rad_s
    faster = air.pitch_rad * jnp.minimum(level, (ADVANCE_MAX * tip) ** 2)
    spared = tip * jnp.maximum(hover - induced, 0.0) + faster
    square = induced * induced
    share = (level + square) / (level + 2.0 * square + _STILL_M2_S2)  # of a climb in the inflow: the wake gives way
    climb = jnp.maximum(hub_m_s[:, 2], -2.0 * hover)
    moving = air.translational_lift_kg_m * spared - air.inflow_kg_m * share * tip * climb
    free = jnp.maximum(thrust_coefficient_n_s2 * speed_rad_s * speed_rad_s + moving, 0.0)
    slow = jnp.maximum(hover * hover, 0.01)
    return free * (1.0 + air.ground_effect * ground_gain(height_m, air.radius_m, slow, level))
