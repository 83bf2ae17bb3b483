"""What missions make of boxes: counts of a detector by the model, on a site with the same walls as the Monte Carlo."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.transport.walk import Floats
from swarmsim.pytree import on_device
from swarmsim.radiation import Detector
from swarmsim.radiation.rate import from_ground, transmission
from swarmsim.site import Obstacles, Site, crossed
from swarmsim.site.rays import Crossed, stretched

FAR_BELOW_M = -1e4  # ground that nothing is seen of


class Block(NamedTuple):
    """A box of a site along the axes; hollow if its wall has a thickness."""

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    wall_m: float
    material: str


def site_of(blocks: Sequence[Block], names: tuple[str, ...], ground: bool) -> Site:
    """A site with ``blocks``, on level ground at z = 0 with ``ground``."""
    low, high = (np.array([block[k] for block in blocks], float).reshape(-1, 3) for k in (0, 1))
    wall, material = [block.wall_m for block in blocks], [names.index(block.material) for block in blocks]
    if not blocks:
        low, high, wall, material = np.zeros((1, 3)), np.zeros((1, 3)), [0.0], [0]
    level = jnp.full((2, 2), 0.0 if ground else FAR_BELOW_M)
    obstacles = Obstacles(
        centre_m=on_device(0.5 * (low + high)),
        half_extent_m=on_device(0.5 * (high - low)),
        axis=jnp.tile(jnp.array([1.0, 0.0]), (len(low), 1)),
        wall_m=on_device(np.array(wall)),
        material=jnp.array(material, jnp.int32),
    )
    return Site(
        origin_m=jnp.array([-500.0, -500.0]), cell_m=jnp.float32(1000.0), terrain_m=level, surface_m=level,
        clearance_m=level, cost=level, obstacles=obstacles, survey_area_m=jnp.zeros((3, 2)),
        ground_material=jnp.int32(names.index("soil")), material_names=names,
    )  # fmt: skip


@jax.jit
def ways(site: Site, source_m: Floats, detectors_m: Floats) -> Crossed:
    """What lies between a source [3] and ``detectors_m`` [d, 3]; between the boxes is nothing."""
    matter = jnp.array([float(name != "air") for name in site.material_names])
    return jax.vmap(lambda target: stretched(crossed(site, jnp.asarray(source_m), target), matter))(
        jnp.asarray(detectors_m)
    )


@jax.jit
def modelled(detector: Detector, number: int, way: Crossed) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Counts [d] of the line ``number``, unscattered, from walls and from the ground, over those of the bare source."""

    def one(way: Crossed) -> tuple[jax.Array, jax.Array, jax.Array]:
        direct, scattered = transmission(detector, jnp.int32(number), way)
        return direct[0], scattered[0], ((direct + scattered) * from_ground(detector, jnp.int32(number), way))[0]

    return jax.vmap(one)(way)
