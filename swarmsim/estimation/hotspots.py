"""Hotspots of a radiation map."""

import jax
import jax.numpy as jnp

from swarmsim.estimation.radiation_map import MappingParams, RadiationMap
from swarmsim.pytree import pytree


@pytree
class Hotspots:
    """Places of significant excess, strongest first. Those not ``valid`` stand at the map's largest significance."""

    position_m: jax.Array  # [h, 2] m, cell centre, world ENU
    significance: jax.Array  # [h] standard deviations above background
    valid: jax.Array  # [h] bool


def extract_hotspots(params: MappingParams, radiation_map: RadiationMap) -> Hotspots:
    """The cells that are the most significant of their neighbourhood and above ``params.significance_sigma``.

    The neighbourhood is a square that reaches one hotspot separation to each side, so two hotspots are further apart
    than that, and the flank of a strong one is none itself. Significances are standard normal under bare background,
    so the chance of any false hotspot is at most (cells) x Q(sigma) by the union bound: 1.1e-3 for 4000 cells at 5
    sigma.
    """
    significance = radiation_map.significance
    ny, nx = significance.shape
    width = 2 * params.separation_cells + 1
    highest = significance
    for window in ((width, 1), (1, width)):
        highest = jax.lax.reduce_window(highest, -jnp.inf, jax.lax.max, window, (1, 1), "SAME")
    peak = (significance >= highest) & (significance >= params.significance_sigma)
    row, column = jnp.arange(ny)[:, None], jnp.arange(nx)

    def strongest(candidates: jax.Array, _: None) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        index = jnp.argmax(candidates)
        # Equal neighbours are all peaks: the first of them stands for the others.
        reach = jnp.maximum(jnp.abs(row - index // nx), jnp.abs(column - index % nx))
        return jnp.where(reach > params.separation_cells, candidates, -jnp.inf), (index, jnp.max(candidates))

    candidates = jnp.where(peak, significance, -jnp.inf)
    _, (index, value) = jax.lax.scan(strongest, candidates, None, length=params.hotspots_max)
    valid = jnp.isfinite(value)
    index = jnp.where(valid, index, jnp.argmax(significance))
    return Hotspots(
        position_m=params.origin_m + params.cell_m * jnp.stack([index % nx, index // nx], axis=-1),
        significance=significance.reshape(-1)[index],
        valid=valid,
    )
