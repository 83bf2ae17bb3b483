"""Photons scattered by walls that are not infinitely wide, or that the line crosses at an angle (device side).

The tables of `swarmsim.radiation.scattering` hold for a slab of infinite width that the line crosses squarely. Of a
wall that the line crosses at an angle with cosine c, with the depth t the short way through (c t' on the line),

    S(t) (R (1 - a k) c^(q + p t) + k (a + b e^(-f t)))

photons arrive, S those of the slab. R is the share of the wide wall's scattered photons that come from a wall of this
size: with h = d d' / (d + d') from the distances of source and detector to the wall's plane, a strip that reaches x to
one side of the line gives x / sqrt(x^2 + h^2) of that side's (scattering once and isotropically into a small detector:
1 / (d^2 + x^2) for each place, and for both distances nearly the same with h), and a rectangle the product of two
strips. k is 1 where the line leads out of a hollow box: its other walls scatter too, photons that go round (a) and
photons that go back and through this wall (b; softer, so that a thick wall keeps more of them). The exponent is that
scattered photons take the short way. The five constants (``configs/elements/walls.csv``) are fitted to the Monte Carlo
of buildings (``experiments/transport/walls.py``).
"""

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp

from swarmsim.config.files import packaged_dir
from swarmsim.radiation.scattering import DEPTH_MAX, DEPTH_SCALES, POSITIONS
from swarmsim.site.rays import Crossed


class Constants(NamedTuple):
    """See the module."""

    slant: float  # q
    slant_per_depth: float  # p
    around: float  # a
    back: float  # b
    back_per_depth: float  # f


class Scattered(NamedTuple):
    """Scattered counts of each line (L) over those of the bare source, and their derivatives."""

    layers: jax.Array  # [..., L, M] optical depths of the materials the short way
    depth: jax.Array  # [..., L] their sum
    slant_layers: jax.Array  # [..., L, M] optical depths on the line
    slant: jax.Array  # [..., L] their sum
    counts: jax.Array  # [..., L]
    by_depth: jax.Array  # [..., L] derivative of the counts by the depth
    by_slant: jax.Array  # [..., L]
    by_walls: jax.Array  # [..., L] by the part of the depth that is walls, over the depth


@lru_cache(maxsize=1)
def constants() -> Constants:
    """The constants of the project's table."""
    text = (packaged_dir() / "elements" / "walls.csv").read_text(encoding="utf-8")
    rows = [line.split(",") for line in text.splitlines() if not line.startswith("#")][1:]
    return Constants(**{name: float(value) for name, value in rows})


def scattered_counts(
    attenuation_1_m: jax.Array, scatter_1_m: jax.Array, air: int | None, way: Crossed, k: Constants | None = None
) -> Scattered:
    """What arrives of the photons that matter on the way [..., M] scatters.

    Behind several layers with depths t_k it is that of the depth sum(t_k), with coefficients averaged over the layers
    with weights t_k; each layer's lie between those of a wall near the source and of one half way. Derivatives leave
    out that these weights change, and take what changes for a wall: for
    air, ``by_walls`` is to be taken off ``by_depth``.

    Args:
        attenuation_1_m: [L, M].
        scatter_1_m: [positions, COEFFICIENTS, L, M], see `Detector`.
        air: number of the material that is no wall.
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
    growth = c[0] + c[1] * t + c[2] * jnp.log1p(t / DEPTH_SCALES[0]) + c[3] * jnp.log1p(t / DEPTH_SCALES[1])
    steep = c[1] + c[2] / (DEPTH_SCALES[0] + t) + c[3] / (DEPTH_SCALES[1] + t)
    falling = jnp.exp(growth - depth)
    rising = 1.0 + depth * (jnp.where(depth < DEPTH_MAX, steep, 0.0) - 1.0)  # of depth x falling, over falling
    if way.shape is None:
        zero = jnp.zeros_like(depth)
        return Scattered(layers, depth, slant_layers, slant, depth * falling, falling * rising, zero, zero)
    k, small = k or constants(), 1e-9
    of_walls = 1.0 if air is None else 1.0 - layers[..., air] / (depth + small)
    missing, other = (1.0 - way.shape.spread)[..., None], way.shape.closed[..., None]
    narrow, closed = of_walls * missing, of_walls * other
    cosine = (depth + small) / (slant + small)
    log_cosine, power = jnp.log(cosine), k.slant + k.slant_per_depth * depth
    slanted, softened = jnp.exp(power * log_cosine), k.back * jnp.exp(-k.back_per_depth * depth)
    straight, back = (1.0 - narrow) * (1.0 - k.around * closed) * slanted, closed * softened
    share = straight + k.around * closed + back
    of_share = straight * (power + k.slant_per_depth * depth * log_cosine) - k.back_per_depth * depth * back
    # a thicker wall makes up more of the depth
    by_walls = other * (k.around + softened)
    by_walls -= slanted * (missing * (1.0 - k.around * closed) + k.around * other * (1.0 - narrow))
    of_share += (1.0 - of_walls) * by_walls
    return Scattered(
        layers, depth, slant_layers, slant, depth * falling * share,
        falling * (rising * share + of_share), -falling * straight * power * cosine, falling * by_walls,
    )  # fmt: skip
