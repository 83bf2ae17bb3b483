"""Natural background as a field."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.radiation.background import BackgroundField, background_factor, fall_with_height
from tests.site.yards import make_site

EVEN = BackgroundField(
    scale=jnp.float32(1.0),
    ground_share=jnp.float32(0.85),
    patch_std=jnp.float32(0.0),
    patch_length_m=jnp.float32(20.0),
    step_share=jnp.float32(0.0),
    step_normal=jnp.array([1.0, 0.0]),
    step_offset_m=jnp.float32(10.0),
    step_width_m=jnp.float32(2.0),
    surface=jnp.ones((2, 2)),
    around=jnp.ones((2, 2)),
)
SITE = make_site([], terrain=np.zeros((61, 61), np.float32), cell=2.0, origin=(-60.0, -60.0))
_factors = jax.jit(
    jax.vmap(lambda field, key, place, at: background_factor(field, SITE, key, place, at), (None, None, 0, None))
)


def factors(field: BackgroundField, places, seed: int = 0, reference: float = 20.0) -> np.ndarray:
    return np.asarray(_factors(field, jax.random.key(seed), jnp.asarray(places, jnp.float32), jnp.float32(reference)))


def test_nominal_at_the_reference_height_and_falls_with_height() -> None:
    heights = np.array([0.0, 20.0, 50.0, 100.0])
    found = factors(EVEN, [(3.0, 4.0, h) for h in heights])
    np.testing.assert_allclose(found, 0.15 + 0.85 * np.exp(-0.0070 * (heights - 20.0)), rtol=1e-5)
    np.testing.assert_allclose(
        found, fall_with_height(jnp.float32(0.85), jnp.asarray(heights), jnp.float32(20.0)), rtol=1e-5
    )
    assert found[1] == pytest.approx(1.0)


def test_a_step_rises_across_its_edge() -> None:
    stepped = replace(EVEN, step_share=jnp.float32(0.2))
    low, middle, high = factors(stepped, [(x, 0.0, 20.0) for x in (0.0, 10.0, 20.0)])
    assert low == pytest.approx(1.0, abs=1e-4)
    assert middle == pytest.approx(1.0 + 0.85 * 0.1, abs=1e-4)
    assert high == pytest.approx(1.0 + 0.85 * 0.2, abs=1e-4)


def test_patches_have_the_stated_spread_and_length_and_belong_to_the_mission() -> None:
    patchy = replace(EVEN, patch_std=jnp.float32(0.2), ground_share=jnp.float32(1.0))
    x = np.linspace(-50.0, 50.0, 41)
    places = np.stack([*np.meshgrid(x, x), np.full((41, 41), 20.0)], axis=-1).reshape(-1, 3)
    fields = np.stack([np.log(factors(patchy, places, seed)).reshape(41, 41) for seed in range(60)])
    assert fields.std() == pytest.approx(0.2, rel=0.12)
    assert np.exp(fields).mean() == pytest.approx(1.0, abs=0.03)
    apart = 20.0 / (x[1] - x[0])
    correlation = np.mean(fields[:, :, : -int(apart)] * fields[:, :, int(apart) :]) / np.mean(fields**2)
    assert correlation == pytest.approx(np.exp(-0.5), abs=0.12)
    np.testing.assert_array_equal(fields[3], np.log(factors(patchy, places, 3)).reshape(41, 41))


def test_the_surface_below_counts_near_it_and_the_mean_of_all_from_above() -> None:
    surface = jnp.ones((61, 61)).at[:, 31:].set(2.0)
    field = replace(EVEN, surface=surface, around=jnp.full((61, 61), 1.5), ground_share=jnp.float32(1.0))
    west, east, above = factors(field, [(-30.0, 0.0, 0.0), (30.0, 0.0, 0.0), (30.0, 0.0, 20.0)], reference=0.0)
    assert west == pytest.approx(1.0)
    assert east == pytest.approx(2.0)
    assert above == pytest.approx(1.5 * np.exp(-0.0070 * 20.0), rel=1e-5)
