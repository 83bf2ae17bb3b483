"""Photons scattered by walls that are not infinitely wide, or that the line crosses at an angle (device side).

The tables of `swarmsim.radiation.scattering` hold for a slab of infinite width that the line crosses squarely. Of walls
with the depth t the short way through, P S(t) photons arrive, S(t) = t exp(g(t) - t) those of the slab. ln P has, for
the size, the shape and the place of the walls, coefficients at depths of t / n for n walls in turn
(`swarmsim.site.wall_network`): of 1, of the energy's logarithm, and of the growth g, which tells how much the material
absorbs. It is linear in ln(t) between those depths and constant beyond, but such that walls deeper than the last depth
but one let no more pass with the same growth, and that no more than `MOST` times the counts of the bare source arrive.
A wide wall that is crossed squarely is the slab: ln P = 0.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.radiation.scattering import DEPTH_MAX, DEPTH_SCALES, POSITIONS
from swarmsim.site.rays import Crossed
from swarmsim.site.wall_network import COEFFICIENTS, DEPTHS, Array, Network, network

REFERENCE_KEV = 662.0
MOST = 2.0
"""Scattered counts over those of the bare source. No case that the network was fitted to has more; it holds for lines
like none of those."""
_LEAST_M = 1e-6


class Scattered(NamedTuple):
    """Scattered counts of each line (L) over those of the bare source, and their derivatives."""

    layers: jax.Array  # [..., L, M] optical depths of the materials the short way
    depth: jax.Array  # [..., L] their sum
    slant_layers: jax.Array  # [..., L, M] optical depths on the line
    slant: jax.Array  # [..., L] their sum
    counts: jax.Array  # [..., L]
    by_depth: jax.Array  # [..., L] derivative of the counts by the depth
    by_walls: jax.Array  # [..., L] by the part of the depth that is walls, over the depth


def scattered_counts(
    attenuation_1_m: jax.Array,
    scatter_1_m: jax.Array,
    energy_kev: jax.Array,
    surrounds: jax.Array,
    way: Crossed,
    net: Network | None = None,
) -> Scattered:
    """What arrives of the photons that matter on the way [..., M] scatters.

    Behind several layers with depths t_k it is that of the depth sum(t_k), with coefficients averaged over the layers
    with weights t_k; each layer's lie between those of a wall near the source and of one half way. Derivatives leave
    out that the weights of walls among each other change, and take what changes for a wall: for a material that
    surrounds, ``by_walls`` is to be taken off ``by_depth``.

    Args:
        attenuation_1_m: [L, M].
        scatter_1_m: [positions, COEFFICIENTS, L, M], see `Detector`.
        energy_kev: [L] of the lines.
        surrounds: [M] 1 for materials that are no walls (air, leaves), else 0.
        way: what the line crosses.
        net: of which the shape comes; the project's by default.
    """
    slant_layers = way.length_m[..., None, :] * attenuation_1_m
    thin_m = way.length_m if way.shape is None else way.shape.thin_m
    layers = slant_layers if way.shape is None else thin_m[..., None, :] * attenuation_1_m
    slant, depth = jnp.sum(slant_layers, axis=-1), jnp.sum(layers, axis=-1)
    first, last = POSITIONS
    near = jnp.clip((last - way.place) / (last - first), 0.0, 1.0)
    lengths = jnp.stack([near * thin_m, (1.0 - near) * thin_m], axis=-2)  # [..., positions, M]
    mean = jnp.einsum("pclm,...pm->...cl", scatter_1_m, lengths) / (depth + 1e-9)[..., None, :]
    c = [mean[..., k, :] for k in range(mean.shape[-2])]
    t = jnp.minimum(depth, DEPTH_MAX)
    logs = [jnp.log1p(t / scale) for scale in DEPTH_SCALES]
    growth = c[0] + c[1] * t + c[2] * logs[0] + c[3] * logs[1]
    steep = c[1] + c[2] / (DEPTH_SCALES[0] + t) + c[3] / (DEPTH_SCALES[1] + t)
    rise = jnp.where(depth < DEPTH_MAX, depth * steep, 0.0)  # of the growth, by ln(depth)
    rising = 1.0 + rise - depth  # of the logarithm of all, by ln(depth)
    of_walls = 1.0 - jnp.sum(layers * surrounds, axis=-1) / (depth + 1e-9)
    # the growth's derivative by the part that is walls; where nothing surrounds, as of a micrometre of what could
    around = jnp.stack([near, 1.0 - near], axis=-2) * (surrounds * (thin_m[..., None, :] + _LEAST_M))
    shares = jnp.einsum("pclm,...pm->...cl", scatter_1_m, around)
    # a nuclide with fewer lines than others has some without attenuation
    q = shares / jnp.maximum(jnp.einsum("lm,...pm->...l", attenuation_1_m, around), 1e-30)[..., None, :]
    apart = growth - (q[..., 0, :] + q[..., 1, :] * t + q[..., 2, :] * logs[0] + q[..., 3, :] * logs[1])
    mixed = jnp.where(of_walls > 1e-3, apart / jnp.maximum(of_walls, 1e-3), 0.0)
    if way.shape is None:
        falling = jnp.exp(growth - depth)
        by_depth = falling * (rising + (1.0 - of_walls) * mixed)
        return Scattered(layers, depth, slant_layers, slant, depth * falling, by_depth, falling * mixed)
    lines = (net or network()).lines
    walls = way.shape.walls[..., None]
    ln_share, by_ln_depth, by_growth = log_share(
        way.shape.scattered, depth * of_walls / walls, energy_kev, growth, walls, lines
    )  # fmt: skip
    highest = float(np.log(MOST)) + depth - jnp.log(depth + 1e-9) - growth
    free = ln_share < highest
    by_ln_depth, by_growth = jnp.where(free, by_ln_depth, depth - 1.0), jnp.where(free, by_growth, -1.0)
    share, falling = jnp.exp(jnp.minimum(ln_share, highest)), jnp.exp(growth - depth)
    seen, of_share = 1.0 + of_walls * (share - 1.0), of_walls * share
    # a thicker wall makes up more of the depth
    by_walls = share - 1.0 + share * by_ln_depth + (of_share * by_growth + seen) * mixed
    of_shape = of_share * (by_ln_depth + by_growth * rise) + (1.0 - of_walls) * by_walls
    return Scattered(
        layers, depth, slant_layers, slant, depth * falling * seen,
        falling * (seen * rising + of_shape), falling * by_walls,
    )  # fmt: skip


def log_share(
    scattered: jax.Array, depth: jax.Array, energy_kev: jax.Array, growth: jax.Array, walls: jax.Array, lines: Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """ln P [..., L] of a wall with ``depth`` [..., L], and its derivatives by ln(depth) and by the growth.

    ``scattered`` [..., OUTPUTS] are the coefficients, ``walls`` [..., 1] how many are crossed in turn, ``lines`` the
    range of `Network`. Beyond the last depth but one, which few cases are, deeper walls let no more pass.
    """
    lowest, highest, least, most = (jnp.asarray(x) for x in lines)
    level = jnp.clip(jnp.log(jnp.maximum(energy_kev, 1.0) / REFERENCE_KEV), lowest, highest)
    of_growth = jnp.clip(growth, least, most) - 1.0
    within = jnp.where((growth > least) & (growth < most), 1.0, 0.0)
    step = float(np.log(DEPTHS[1] / DEPTHS[0]))
    at = jnp.log(jnp.maximum(depth, 1e-6) / DEPTHS[0]) / step
    k = scattered[..., None, :]
    rows = [k[..., n : n + COEFFICIENTS] for n in range(0, k.shape[-1], COEFFICIENTS)]
    logs = [row[..., 0] + row[..., 1] * level + row[..., 2] * of_growth for row in rows]
    by = [row[..., 2] for row in rows]
    found, by_growth, by_depth = logs[0], by[0], jnp.zeros_like(at)
    for number in range(len(DEPTHS) - 1):
        part, change = jnp.clip(at - number, 0.0, 1.0), logs[number + 1] - logs[number]
        found = found + change * part
        by_growth = by_growth + (by[number + 1] - by[number]) * part
        by_depth += jnp.where((part > 0.0) & (part < 1.0), change / step, 0.0)
    deepest = DEPTHS[-2]
    highest = logs[-2] + walls * (depth - deepest) - jnp.log(jnp.maximum(depth, deepest) / deepest)
    free = (depth <= deepest) | (found < highest)
    return (
        jnp.where(free, found, highest),
        jnp.where(free, by_depth, walls * depth - 1.0),
        jnp.where(free, by_growth, by[-2]) * within,
    )
