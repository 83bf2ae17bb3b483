"""What was drawn for a mission within the bounds of its knowledge: the truth that its estimate does not know."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim import randomness
from swarmsim.missions.knowledge import pose_errors
from swarmsim.results.record import Departures
from swarmsim.runtime.simulation import Simulation
from swarmsim.sensors import radiation
from swarmsim.world.build import detector_models
from swarmsim.world.model import World


def departures_of(
    simulation: Simulation, world: World, pose_std_m: tuple[Any, Any] | None, seed: int
) -> Departures | None:
    """The departures of the mission of a ``seed`` with its own ``world``; None where no vehicle has a detector.

    They are drawn again, by the functions and from the key that the mission drew them with. ``pose_std_m``
    (`errors_of_places`) is None where no source is estimated, which alone asks for measured places.
    """
    counting = [np.asarray(group.member) for group in world.groups if group.counter is not None]
    if not counting:
        return None
    members, models = simulation.scenario.members, detector_models(simulation.scenario)
    measured = [] if pose_std_m is None else counting
    numbers = np.sort(np.concatenate([np.zeros(0, np.int32), *measured])).astype(np.int32)
    key = randomness.mission_keys(np.array([seed]))[0]
    lengths, sensitivities = jax.device_get(_drawn(world.departures, key, len(models)))
    std_m = (0.0, 0.0) if pose_std_m is None else pose_std_m
    errors = np.asarray(_pose_errors(std_m, key, jnp.asarray(numbers)))
    site = world.site
    solid = np.all(np.asarray(site.obstacles.half_extent_m) > 0.0, axis=1)
    materials = sorted(set(np.asarray(site.obstacles.material)[solid].tolist()))
    varied = np.asarray(world.departures.thickness_share) > 0.0
    return Departures(
        thickness_factor={site.material_names[m]: float(lengths[m]) for m in materials if varied[m]},
        sensitivity_factor=dict(zip(models, map(float, sensitivities), strict=True)),
        pose_error_m={members[number].name: error for number, error in zip(numbers, errors, strict=True)},
    )


_pose_errors = jax.jit(pose_errors)


@partial(jax.jit, static_argnums=2)
def _drawn(within: radiation.Departures, key: jax.Array, models: int) -> tuple[jax.Array, jax.Array]:
    """Length factors [M] and sensitivity factors [D] of one mission."""
    sensitivities = jnp.stack([radiation.sensitivity_factor(within, key, model) for model in range(models)])
    return radiation.length_factors(within, key), sensitivities
