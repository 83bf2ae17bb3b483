"""Circle a target: out to it at a safe height, round it, and home."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.policies import Orbit
from swarmsim.policies.air_path import FlightProfile, air_path, flight_profile, points_for
from swarmsim.policies.path import Path
from swarmsim.policies.protocol import Assignment, Situation
from swarmsim.policies.registry import register
from swarmsim.pytree import on_host, pytree, static
from swarmsim.site import Site

CORNERS_PER_TURN = 36


@pytree
class OrbitTask:
    """Circle a target with M multirotors, evenly spaced round the circle."""

    profile: FlightProfile
    home_m: jax.Array  # [M, 2] where each lands, world
    radius_m: jax.Array  # []
    corners: int = static()
    turns: float = static()
    points: int = static()


@register("orbit")
class OrbitPlanner:
    """Fly to a target, circle it, return and land."""

    Settings = Orbit
    vehicles = ("multirotor",)

    def task(self, assignment: Assignment) -> OrbitTask:
        """Circle and sizes of the phase (host)."""
        settings, scenario = assignment.settings, assignment.scenario
        assert isinstance(settings, Orbit)
        homes = np.array([scenario.members[i].position_m for i in assignment.members], np.float32)
        site = assignment.site_model.site
        across = float(site.cell_m) * math.hypot(*site.terrain_m.shape)
        length = 2.0 * across + 2.0 * math.pi * settings.radius_m * settings.turns
        return OrbitTask(
            profile=flight_profile(settings, [scenario.vehicles[i] for i in assignment.members]),
            home_m=on_host(homes),
            radius_m=on_host(settings.radius_m),
            corners=math.ceil(CORNERS_PER_TURN * settings.turns) + 1,
            turns=settings.turns,
            points=points_for(length, settings.altitude_m),
        )

    def plan(self, task: OrbitTask, site: Site, situation: Situation) -> Path:
        """One path for each UAV; without a target it goes up, comes home and lands."""
        count = task.home_m.shape[0]
        phase = 2.0 * jnp.pi * jnp.arange(count) / count

        def one(position: jax.Array, home: jax.Array, phase: jax.Array) -> Path:
            angle = phase + 2.0 * jnp.pi * task.turns * jnp.linspace(0.0, 1.0, task.corners)
            circle = situation.target_m + task.radius_m * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
            corners = jnp.where(situation.found, circle, home)
            return air_path(task.profile, site, position, home, corners, task.points)

        return jax.vmap(one)(situation.position_m, task.home_m, phase)
