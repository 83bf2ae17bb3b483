"""Paths of multirotors: from where one is, over corners on the map at a safe height, and home to land."""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.config.vehicles import Multirotor
from swarmsim.policies.path import (
    Path,
    acceleration_along,
    limit_in_bends,
    limit_speed,
    resample,
    rounded,
    rounded_above,
)
from swarmsim.pytree import on_host, pytree
from swarmsim.site import Site, sample

PATH_SPACING_M = 0.5  # between points of a path, at most
CLIMB_GRADIENT = 0.7  # a path climbs at most 7 m in 10 m, about 35 degrees
BELOW_GROUND_M = 0.4  # the landing path ends here, so that the vehicle comes down until it touches
TOUCHDOWN_HEIGHT_M = 2.5  # below this height the descent is slow
CORNER_M = 0.5  # how far a corner may be cut
VERTICAL_POINTS = 32


@pytree
class FlightProfile:
    """How high and how fast a path is flown."""

    altitude_m: jax.Array  # [] above ground
    obstacle_clearance_m: jax.Array  # [] kept above the highest surface nearby
    speed_m_s: jax.Array  # []
    climb_speed_m_s: jax.Array  # []
    descent_speed_m_s: jax.Array  # []
    touchdown_speed_m_s: jax.Array  # []
    acceleration_m_s2: jax.Array  # []


def flight_profile(settings: Any, specs: Sequence[Any]) -> FlightProfile:
    """Profile of the settings of a policy; half the acceleration of the weakest vehicle is left to its control."""
    limits = [spec.control.acceleration_max_m_s2 for spec in specs if isinstance(spec, Multirotor)]
    numbers = {
        name: getattr(settings, name)
        for name in (
            "altitude_m", "obstacle_clearance_m", "speed_m_s", "climb_speed_m_s", "descent_speed_m_s",
            "touchdown_speed_m_s",
        )
    }  # fmt: skip
    numbers["acceleration_m_s2"] = 0.5 * min(limits)
    return FlightProfile(**{name: on_host(number) for name, number in numbers.items()})


def points_for(length_m: float, altitude_m: float) -> int:
    """Points of a path of at most ``length_m`` on the map and the climb to ``altitude_m`` and back (host)."""
    return 256 * math.ceil((length_m + 4.0 * altitude_m) / PATH_SPACING_M / 256)


def air_path(
    profile: FlightProfile, site: Site, start_m: jax.Array, home_m: jax.Array, corners_m: jax.Array, points: int
) -> Path:
    """Path from ``start_m`` [3] up, over ``corners_m`` [W, 2] at a safe height, and down at ``home_m`` [2] to land."""
    flat, flat_length = resample(jnp.concatenate([start_m[None, :2], corners_m, home_m[None]]), points)
    spacing = flat_length / (points - 1)
    flat = rounded(flat, spacing, CORNER_M)
    height = safe_height(profile, site, flat, spacing)
    # so far that, at the speed of the flight, a climb begins and ends with the acceleration that there is
    ease = CLIMB_GRADIENT * jnp.square(profile.speed_m_s) / (2.0 * profile.acceleration_m_s2)
    height = rounded_above(height, ease / jnp.maximum(spacing, 1e-6))
    survey = jnp.concatenate([flat, height[:, None]], axis=-1)
    ground = sample(site.terrain_m, site, home_m)
    rise = jnp.linspace(0.0, 1.0, VERTICAL_POINTS)[:, None]
    below = jnp.append(home_m, ground - BELOW_GROUND_M)
    whole = jnp.concatenate([start_m + rise * (survey[0] - start_m), survey, survey[-1] + rise * (below - survey[-1])])
    places, length = resample(whole, points)
    vertical = jnp.asarray(jnp.gradient(places[:, 2])) / jnp.maximum(length / (points - 1), 1e-6)
    low = places[:, 2] < ground + TOUCHDOWN_HEIGHT_M
    down = jnp.where(low, profile.touchdown_speed_m_s, profile.descent_speed_m_s)
    cruise = jnp.where(vertical > 0.9, profile.climb_speed_m_s, jnp.where(vertical < -0.9, down, profile.speed_m_s))
    cruise = limit_in_bends(places, cruise, profile.acceleration_m_s2)
    speed = limit_speed(places, cruise, profile.acceleration_m_s2, CORNER_M)
    # the landing must not stop above ground: the last points keep the touchdown speed
    landing = low & (jnp.arange(points) > points // 2)
    speed = jnp.where(landing, profile.touchdown_speed_m_s, speed)
    return Path(
        points_m=places,
        speed_m_s=speed,
        spacing_m=length / (points - 1),
        length_m=length,
        acceleration_m_s2=acceleration_along(places, speed, profile.acceleration_m_s2),
    )


def safe_height(profile: FlightProfile, site: Site, xy: jax.Array, spacing: jax.Array) -> jax.Array:
    """Height [P] that keeps the altitude above ground and the clearance above the surface around each point.

    Higher ground ahead is met by climbing before it, at `CLIMB_GRADIENT`.
    """
    ring = jnp.linspace(0.0, 2.0 * jnp.pi, 8, endpoint=False)
    offsets = jnp.stack([jnp.cos(ring), jnp.sin(ring)], axis=-1)
    around = xy[:, None, None] + jnp.array([0.0, 0.5, 1.0])[:, None, None] * profile.obstacle_clearance_m * offsets
    surface = jnp.max(sample(site.surface_m, site, around), axis=(1, 2))
    wanted = jnp.maximum(sample(site.terrain_m, site, xy) + profile.altitude_m, surface + profile.obstacle_clearance_m)
    slope = CLIMB_GRADIENT * spacing * jnp.arange(len(wanted))
    ahead = jax.lax.cummax(wanted - slope, reverse=True) + slope
    behind = jax.lax.cummax(wanted + slope) - slope
    return jnp.maximum(ahead, behind)
