"""What an autopilot does by itself when a mission goes wrong: hold, return or land, as PX4 and ArduPilot do.

A failsafe is latched: it stays until the vehicle has landed. Of several the one that lands comes before the one that
returns, and that before the one that holds. Where it lands is known beforehand, as are ArduPilot's rally points and
PX4's safe points: the nearest place of the site that is clear.
"""

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree
from swarmsim.site import Site, nearest, sample
from swarmsim.world import events

HOLD, RETURN, LAND = range(3)
ACTIONS = {"hold": HOLD, "return": RETURN, "land": LAND}

REACTION_S = 0.4
"""Time until a vehicle brakes: it has to be judged, and to tilt."""
ARRIVED_M = 1.5
"""Horizontal distance from home within which a returning vehicle descends."""
LEASH_M = 3.0
"""Largest distance from which a vehicle that holds or lands flies back to its place; least one that this is inside the
fence."""
CLIMBED_M = 1.0
"""Height below that of the return from which a vehicle sets out for home."""
SLOW_BELOW_M = 5.0
"""Height above ground below which a vehicle descends slowly."""
DESCENT_M_S, SLOW_DESCENT_M_S = 1.5, 0.6
"""Rates of descent: PX4's defaults MPC_Z_V_AUTO_DN and, near the ground, MPC_LAND_SPEED."""
WIND_DESCENT_M_S = 3.0
"""Rate of descent, as far as the vehicle may, out of a wind that carries it off: it is weaker near the ground."""
CLEAR_ABOVE_M = 2.0
"""Height above what stands around it at which a vehicle flies to where it can land."""
CLIMB_OVER_M_S = 1.0
"""Rate at which it climbs for that."""
ADRIFT_S = 20.0
"""For how long the wind may carry it off before it goes down wherever it is."""
SEARCH_S = 90.0
"""For how long after the last failsafe it makes for such a place, before it goes down wherever it is."""
CARRIED_S = 2.0
"""For how long the wind must have carried a vehicle off before it lands early, because the fence is near."""


@pytree
class FailsafeRules:
    """When failsafes set in and what they do; a threshold that cannot be reached switches one off."""

    fence_low_m: jax.Array  # [2] south-west corner of the fence, world
    fence_high_m: jax.Array  # [2] north-east corner
    ceiling_m: jax.Array  # [] above the terrain
    wind_share: jax.Array  # [] of the largest tilt (as tangents) or rotor speed from which it does nearly all it can
    wind_drift_m_s: jax.Array  # [] and the air carries it off faster than this
    wind_s: jax.Array  # [] for how long
    battery_low: jax.Array  # [] charge left
    link_range_m: jax.Array  # [] from home, where the ground station is
    link_s: jax.Array  # [] for how long out of range
    return_height_m: jax.Array  # [] world: above everything that stands on the site
    clear_east_m: jax.Array  # [ny, nx] where, nearest to this cell of the site, one can land clear of what stands there
    clear_north_m: jax.Array  # [ny, nx]
    over_m: jax.Array  # [ny, nx] world: highest surface around this cell
    action: jax.Array  # [failsafes] int32: HOLD, RETURN or LAND


@pytree
class Rescue:
    """What a vehicle's autopilot flies by itself."""

    takes_over: jax.Array  # [] bool
    position_m: jax.Array  # [3] world
    velocity_m_s: jax.Array  # [3] world
    carried_s: jax.Array  # [] for how long the wind has carried it off
    unheard_s: jax.Array  # [] for how long the link has been lost


def no_rescue() -> Rescue:
    """Of a vehicle that does what it is told."""
    zero = jnp.zeros(())
    return Rescue(
        takes_over=jnp.array(False),
        position_m=jnp.zeros(3),
        velocity_m_s=jnp.zeros(3),
        carried_s=zero,
        unheard_s=zero,
    )


def stopping_m(velocity_m_s: jax.Array, brake_m_s2: jax.Array | float) -> jax.Array:
    """How far a vehicle at ``velocity_m_s`` goes, m with its sign, that reacts and brakes by ``brake_m_s2``."""
    return REACTION_S * velocity_m_s + 0.5 * velocity_m_s * jnp.abs(velocity_m_s) / brake_m_s2


def failing(
    rules: FailsafeRules, rescue: Rescue, *, position_m: jax.Array, velocity_m_s: jax.Array, brake_m_s2: jax.Array,
    above_m: jax.Array, carried_m_s: jax.Array, charge: jax.Array, home_m: jax.Array, dt: float,
) -> tuple[jax.Array, Rescue]:  # fmt: skip
    """Which failsafes [failsafes] set in for one vehicle in flight, and its timers.

    One in a failsafe that the wind has carried for `ADRIFT_S` counts as carried from then on, also in calmer air.
    The fence is felt ahead: at the distance that braking by ``brake_m_s2`` [] takes. ``above_m`` [] is the height above
    the terrain, ``carried_m_s`` [] the speed at which the wind carries it off, ``charge`` [] what is left of the
    battery, ``home_m`` [2] where it started.
    """
    level = position_m[:2]
    stop = stopping_m(velocity_m_s, brake_m_s2)
    ahead, up = level + stop[:2], above_m + stop[2]
    outside = jnp.any((ahead < rules.fence_low_m) | (ahead > rules.fence_high_m)) | (up > rules.ceiling_m)
    drifts = (carried_m_s > rules.wind_drift_m_s) | (rescue.takes_over & (rescue.carried_s > ADRIFT_S))
    carried = jnp.where(drifts, rescue.carried_s + dt, 0.0)
    away = level - home_m
    far = jnp.sum(away * away) > rules.link_range_m * rules.link_range_m
    unheard = jnp.where(far, rescue.unheard_s + dt, 0.0)
    # There is no time to wait where the fence is nearer than the calmer air at the ground.
    below = level + velocity_m_s[:2] * (above_m / WIND_DESCENT_M_S)
    soon = jnp.any((below < rules.fence_low_m) | (below > rules.fence_high_m)) & (carried > CARRIED_S)
    blown = (carried > rules.wind_s) | soon | (outside & (carried > 0.0))
    found = jnp.stack([outside, blown, charge < rules.battery_low, far & (unheard > rules.link_s)])
    return found, Rescue(
        takes_over=rescue.takes_over,
        position_m=rescue.position_m,
        velocity_m_s=rescue.velocity_m_s,
        carried_s=carried,
        unheard_s=unheard,
    )


def rescue_of(
    rules: FailsafeRules, rescue: Rescue, times_s: jax.Array, now_s: jax.Array, position_m: jax.Array,
    height_m: jax.Array, push_m: jax.Array, site: Site, home_m: jax.Array,
) -> Rescue:  # fmt: skip
    """What one vehicle's autopilot flies now, from its event times [kinds].

    ``height_m`` [] is that of its feet, ``push_m`` [3] the displacement that keeps it apart from others in flight.
    """
    since = times_s[len(events.LOSSES) :]
    set_in = jnp.isfinite(since)
    in_vain = now_s - jnp.max(jnp.where(set_in, since, -jnp.inf)) > SEARCH_S
    in_vain |= rescue.carried_s > ADRIFT_S
    action = jnp.max(jnp.where(set_in, rules.action, -1))
    away = position_m[:2] - home_m
    there = jnp.sum(away * away) < ARRIVED_M * ARRIVED_M
    high = position_m[2] > rules.return_height_m - CLIMBED_M
    lands = (action == LAND) | ((action == RETURN) & there)
    cruises = (action == RETURN) & ~there
    blown = set_in[events.WIND - len(events.LOSSES)]
    outside = jnp.any((position_m[:2] < rules.fence_low_m) | (position_m[:2] > rules.fence_high_m))
    # Low above the ground it can fly back before it lands.
    near = jnp.where(outside & blown & ~in_vain, 0.0, SLOW_DESCENT_M_S)
    sink = jnp.where(height_m > SLOW_BELOW_M, jnp.where(blown, WIND_DESCENT_M_S, DESCENT_M_S), near)
    # The place is kept while the vehicle holds or lands; one that the wind carries off does not race back to it.
    back = jnp.where(rescue.takes_over, rescue.position_m[:2] - position_m[:2], 0.0)
    kept = position_m[:2] + back * jnp.minimum(1.0, LEASH_M * jax.lax.rsqrt(jnp.sum(back * back) + 1e-12))
    inside = jnp.clip(kept, rules.fence_low_m + LEASH_M, rules.fence_high_m - LEASH_M)
    clear, climb = _to_clear_place(rules, site, position_m, inside, push_m[:2], rescue.carried_s <= 0.0)
    level = jnp.where((action == RETURN) & (there | high), home_m, jnp.where(action == LAND, clear, inside))
    sink = jnp.where((action == LAND) & ~in_vain, jnp.minimum(sink, -climb), sink)
    aim = jnp.where(cruises, jnp.maximum(rules.return_height_m, jnp.where(high, position_m[2], 0.0)), position_m[2])
    ground = sample(site.terrain_m, site, position_m[:2])
    aim = jnp.minimum(aim, ground + rules.ceiling_m)
    return Rescue(
        takes_over=jnp.any(set_in),
        position_m=jnp.append(level, aim),
        velocity_m_s=jnp.stack([jnp.zeros(()), jnp.zeros(()), jnp.where(lands, -sink, 0.0)]),
        carried_s=rescue.carried_s,
        unheard_s=rescue.unheard_s,
    )


def _to_clear_place(
    rules: FailsafeRules, site: Site, position_m: jax.Array, place_m: jax.Array, aside_m: jax.Array, holds: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Where [2] to fly on the way to the clear place nearest to ``place_m`` [2], and the least climb rate [] for that.

    Above what stands around it, and no faster than it can climb over that. A vehicle that ``holds`` [] against the wind
    climbs first. ``aside_m`` [2] keeps those apart that have the same place.
    """
    aside = place_m + aside_m
    clear = jnp.stack([nearest(raster, site, aside) for raster in (rules.clear_east_m, rules.clear_north_m)])
    to_go, ahead = clear - position_m[:2], clear - place_m
    arrived = jnp.sum(to_go * to_go) < ARRIVED_M * ARRIVED_M
    above = position_m[2] - nearest(rules.over_m, site, position_m[:2]) - CLEAR_ABOVE_M
    reach = jnp.where(~arrived & holds & (above < -CLIMBED_M), 0.0, LEASH_M)
    level = place_m + ahead * jnp.minimum(1.0, reach * jax.lax.rsqrt(jnp.sum(ahead * ahead) + 1e-12))
    return level, jnp.where(arrived, -jnp.inf, jnp.minimum(-above, CLIMB_OVER_M_S))
