"""Bilinear sampling of rasters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from yards import make_site

from swarmsim.site import sample, sample_with_gradient
from swarmsim.site.model import sample_on_host

RASTER = np.random.default_rng(1).normal(size=(7, 9)).astype(np.float32)
SITE = make_site(terrain=RASTER, cell=0.5, origin=(2.0, -1.0))


def test_centres_give_the_cells_themselves():
    x, y = np.meshgrid(2.0 + 0.5 * np.arange(9), -1.0 + 0.5 * np.arange(7))
    np.testing.assert_allclose(sample(SITE.terrain_m, SITE, jnp.asarray(np.stack([x, y], -1))), RASTER, atol=1e-5)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(x=st.floats(2.0, 6.0, width=32), y=st.floats(-1.0, 2.0, width=32))
def test_bilinear_formula(x, y):
    u, v = (x - 2.0) / 0.5, (y + 1.0) / 0.5
    i, j = min(int(u), 7), min(int(v), 5)
    u, v = u - i, v - j
    a, b, c, d = RASTER[j, i], RASTER[j, i + 1], RASTER[j + 1, i], RASTER[j + 1, i + 1]
    expected = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    value, _ = sample_with_gradient(SITE.terrain_m, SITE, jnp.array([x, y]))
    assert float(value) == pytest.approx(float(expected), abs=1e-4)


@pytest.mark.parametrize("finer", [1, 3])
def test_the_host_reads_the_same(finer):
    raster = np.kron(RASTER, np.ones((finer, finer), np.float32)) + np.linspace(0.0, 1.0, 9 * finer, dtype=np.float32)
    xy = np.random.default_rng(3).uniform([0.0, -3.0], [9.0, 4.0], (200, 2))  # some beyond the border
    expected = jax.jit(lambda p: sample(jnp.asarray(raster), SITE, p))(jnp.asarray(xy, jnp.float32))
    found = sample_on_host(raster, SITE, xy)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("xy", [(3.1, 0.3), (2.2, -0.9), (5.9, 1.9), (1.0, 0.3), (9.0, 5.0)])
def test_gradient_is_that_of_the_value(xy):
    xy = jnp.array(xy)
    _, gradient = sample_with_gradient(SITE.terrain_m, SITE, xy)
    np.testing.assert_allclose(gradient, jax.grad(lambda p: sample(SITE.terrain_m, SITE, p))(xy), atol=1e-5)


def test_gradient_of_a_plane_is_its_slope():
    x, y = np.meshgrid(2.0 + 0.5 * np.arange(9), -1.0 + 0.5 * np.arange(7))
    site = make_site(terrain=0.3 * x - 0.2 * y, cell=0.5, origin=(2.0, -1.0))
    _, gradient = jax.vmap(lambda p: sample_with_gradient(site.terrain_m, site, p))(jnp.array([[3.1, 0.2], [5.2, 1.1]]))
    np.testing.assert_allclose(gradient, [[0.3, -0.2]] * 2, atol=1e-5)


def test_clamped_outside_and_nan_stays_nan():
    value, gradient = sample_with_gradient(SITE.terrain_m, SITE, jnp.array([-50.0, -50.0]))
    assert float(value) == pytest.approx(float(RASTER[0, 0]))
    np.testing.assert_array_equal(gradient, 0.0)
    assert np.isnan(sample(SITE.terrain_m, SITE, jnp.array([np.nan, 0.0])))
