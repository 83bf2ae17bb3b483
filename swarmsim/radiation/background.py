"""Natural background as a field: by place, height and surface, with a random part of every mission (device side).

The part of a detector's nominal background that comes from the ground falls with height as exp(-mu h), from the height
for which the nominal rate holds (IAEA-TECDOC-1363, 2003, section 4.5.3); the rest (cosmic radiation, vehicle, radon)
stays. The ground's part is multiplied by the surface below, by smooth random patches, and by a step.
"""

import jax
import jax.numpy as jnp

from swarmsim import randomness
from swarmsim.pytree import pytree
from swarmsim.site import Site, sample

WAVES = 24  # plane waves that the random patches are made of
AIR_1_M = 0.0070
"""Attenuation of natural gamma radiation with height, total count (IAEA-TECDOC-1363, table 4.4)."""
SMOOTH_M = 15.0
"""Height from which on a detector sees the mean of the surfaces around rather than the one below it."""


@pytree
class BackgroundField:
    """Background of one mission's world, relative to the detectors' nominal one."""

    scale: jax.Array  # [] of everything
    ground_share: jax.Array  # [] of the nominal background that comes from the ground
    patch_std: jax.Array  # [] relative standard deviation of the random patches
    patch_length_m: jax.Array  # [] their correlation length: exp(-d^2 / 2 l^2)
    step_share: jax.Array  # [] relative rise of the ground's part beyond an edge
    step_normal: jax.Array  # [2] unit vector across the edge, to the higher side
    step_offset_m: jax.Array  # [] distance of the edge from the origin along the normal
    step_width_m: jax.Array  # [] in which it rises
    surface: jax.Array  # [ny, nx] factor of the surface in each cell of the site's raster
    around: jax.Array  # [ny, nx] its mean over the surroundings


def background_factor(
    field: BackgroundField, site: Site, key: jax.Array, place_m: jax.Array, reference_m: jax.Array
) -> jax.Array:
    """Background [] at ``place_m`` [3] over the nominal one of a detector, which holds ``reference_m`` [] above ground.

    ``key`` is the mission's; the random part depends on it alone.
    """
    height = place_m[2] - sample(site.terrain_m, site, place_m[:2])
    fall = jnp.exp(-AIR_1_M * (jnp.maximum(height, 0.0) - reference_m))
    near = jnp.clip(1.0 - height / SMOOTH_M, 0.0, 1.0)
    below = sample(jnp.asarray(field.surface), site, place_m[:2])
    surface = near * below + (1.0 - near) * sample(jnp.asarray(field.around), site, place_m[:2])
    across = (place_m[:2] @ field.step_normal - field.step_offset_m) / jnp.maximum(field.step_width_m, 1e-3)
    step = 1.0 + field.step_share * jax.nn.sigmoid(4.0 * across)
    ground = surface * step * _patches(field, key, place_m[:2]) * fall
    return field.scale * (1.0 - field.ground_share + field.ground_share * ground)


def fall_with_height(ground_share: jax.Array, height_m: jax.Array, reference_m: jax.Array) -> jax.Array:
    """Background [...] at a height above ground over that at the reference height, over an even ground."""
    fall = jnp.exp(-AIR_1_M * (jnp.maximum(height_m, 0.0) - reference_m))
    return 1.0 - ground_share + ground_share * fall


def _patches(field: BackgroundField, key: jax.Array, xy: jax.Array) -> jax.Array:
    """Log-normal factor [] of mean 1 at ``xy`` [2], by random Fourier features (Rahimi and Recht, NIPS 2007)."""
    direction, phase = jax.random.split(randomness.consumer(key, "background patches"))
    waves = jax.random.normal(direction, (WAVES, 2)) / field.patch_length_m
    phases = jax.random.uniform(phase, (WAVES,), maxval=2.0 * jnp.pi)
    smooth = jnp.sqrt(2.0 / WAVES) * jnp.sum(jnp.cos(waves @ xy + phases))
    return jnp.exp(field.patch_std * smooth - 0.5 * field.patch_std**2)
