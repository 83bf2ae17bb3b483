"""Photons scattered by walls that are not infinitely wide, or that the line crosses at an angle (device side).

The tables of `swarmsim.radiation.scattering` hold for a slab of infinite width that the line crosses squarely. Of walls
with the depth t the short way through,

    S(t) P(t / n) exp(k (a g + x (b g + v l) + x^2 (c + w l))),  x = t / (1 + t)

photons arrive, S(t) = t exp(g(t) - t) those of the slab. P is the share of the slab's photons that walls of this size,
shape and place send to the detector, for n walls in turn (`swarmsim.site.surfaces`), linear in ln(t) between
`swarmsim.site.surfaces.DEPTHS` and constant beyond. k is 1 where the line leads out of a hollow box: photons go to and
fro inside it before they leave, the more of them the less the material absorbs (g) and the lower their energy is
(l, its logarithm over 662 keV). A wide wall that is crossed squarely is the slab: P = 1, k = 0.

The constants (``configs/elements/walls.csv``) are fitted to the Monte Carlo of buildings
(``experiments/transport/walls.py``).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.radiation.scattering import DEPTH_MAX, DEPTH_SCALES, POSITIONS
from swarmsim.site.rays import Crossed
from swarmsim.site.surfaces import DEPTHS, Constants, constants

REFERENCE_KEV = 662.0
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
    k: Constants | None = None,
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
        k: those of the project's table by default.
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
    k = k or constants()
    closed, x = way.shape.closed[..., None], depth / (1.0 + depth)
    level = jnp.log(jnp.maximum(energy_kev, 1.0) / REFERENCE_KEV)
    linear, curved = k.growth_depth * growth + k.energy * level, k.depth + k.energy_depth * level
    more = closed * (k.growth * growth + x * (linear + x * curved))
    rise_of_more = (k.growth + k.growth_depth * x) * rise + x * (1.0 - x) * (linear + 2.0 * x * curved)
    share, rise_of_share = _shares(way, depth * of_walls)
    falling = jnp.exp(growth - depth + of_walls * more)
    seen = 1.0 + of_walls * (share - 1.0)
    # a thicker wall makes up more of the depth
    mixed *= 1.0 + of_walls * closed * (k.growth + k.growth_depth * x)
    by_walls = share - 1.0 + rise_of_share + seen * (more + mixed)
    of_share = of_walls * rise_of_share + (1.0 - of_walls) * by_walls
    return Scattered(
        layers, depth, slant_layers, slant, depth * falling * seen,
        falling * (seen * (rising + of_walls * closed * rise_of_more) + of_share), falling * by_walls,
    )  # fmt: skip


def _shares(way: Crossed, depth: jax.Array) -> tuple[jax.Array, jax.Array]:
    """P of walls with depths [..., L], and its derivative by ln(depth)."""
    assert way.shape is not None
    step = float(np.log(DEPTHS[1] / DEPTHS[0]))
    at = jnp.log(jnp.maximum(depth / way.shape.walls[..., None], 1e-6) / DEPTHS[0]) / step
    share = way.shape.share[..., None, :]
    found, rise = share[..., 0], jnp.zeros_like(at)
    for number in range(len(DEPTHS) - 1):
        part, change = jnp.clip(at - number, 0.0, 1.0), share[..., number + 1] - share[..., number]
        found, rise = found + change * part, rise + jnp.where((part > 0.0) & (part < 1.0), change / step, 0.0)
    return found, rise
