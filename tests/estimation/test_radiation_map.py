from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.config.errors import InputError
from swarmsim.estimation import extract_hotspots, interpolate
from swarmsim.estimation.radiation_map import _significance, matern, posterior
from tests.estimation.survey import draw, mapping, survey, windows

pytestmark = pytest.mark.optimised

SMALL = mapping(half=12.0, variance_kept=0.9995)
COARSE = mapping(half=35.0, variance_kept=0.9, cell_m=2.5)
COARSE_SURVEY = survey(half=35.0, lines=8, count=240)
_interpolate = jax.jit(interpolate)
_posterior = jax.jit(posterior)


def dense(points, cells, rate, noise, mean, variance, length_scale):
    """Gaussian-process regression by its textbook formula in float64 (Rasmussen & Williams 2006, algorithm 2.1)."""

    def kernel(a, b):
        d = np.sqrt(5.0) * np.abs(a[:, None] - b[None]) / length_scale
        return variance * np.prod((1.0 + d + d * d / 3.0) * np.exp(-d), axis=-1)

    cross = kernel(cells, points)
    weights = np.linalg.solve(kernel(points, points) + np.diag(noise), cross.T).T
    return (
        mean + weights @ (rate - mean),
        variance - np.sum(weights * cross, axis=1),
        weights.sum(axis=1),
        weights**2 @ noise,
    )


@settings(max_examples=15)
@given(seed=st.integers(0, 2**31), level=st.floats(3.0, 300.0), amplitude=st.floats(0.1, 10.0))
def test_map_equals_the_dense_gaussian_process(seed, level, amplitude):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-12.0, 12.0, (40, 2))
    rate, noise = rng.poisson(level, 40) * 1.0, rng.uniform(0.5, 2.0, 40) * level
    variance = amplitude**2 * level
    samples = windows(np.c_[points, np.full(40, 20.0)])
    f32 = lambda v: jnp.asarray(v, jnp.float32)  # noqa: E731
    mean, var, gain, from_noise = _posterior(SMALL, samples, f32(rate), f32(noise), f32(level), f32(variance))
    ny, nx = mean.shape
    x = SMALL.origin_m[0] + SMALL.cell_m * np.arange(nx)
    y = SMALL.origin_m[1] + SMALL.cell_m * np.arange(ny)
    cells = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)
    truth = dense(points, cells, rate, noise, level, variance, 6.0)
    spread = np.sqrt(variance)
    np.testing.assert_allclose(np.ravel(mean), truth[0], atol=0.05 * spread)
    np.testing.assert_allclose(np.sqrt(np.ravel(var)), np.sqrt(truth[1]), atol=0.03 * spread)
    np.testing.assert_allclose(np.ravel(gain), truth[2], atol=0.05)
    np.testing.assert_allclose(np.sqrt(np.ravel(from_noise)), np.sqrt(truth[3]), atol=0.03 * spread)


def test_the_kernel_is_the_published_one():
    assert float(matern(jnp.array(0.0), jnp.array(6.0))) == 1.0
    expected = (1.0 + np.sqrt(5.0) + 5.0 / 3.0) * np.exp(-np.sqrt(5.0))
    np.testing.assert_allclose(matern(jnp.array(-6.0), jnp.array(6.0)), expected, rtol=1e-6)


def test_no_rate_of_the_map_is_negative():
    near = jnp.sum(jnp.square(COARSE_SURVEY.position_m[:, :2]), axis=1) < 8.0**2
    strong = draw(COARSE_SURVEY, jnp.where(near, 30_000.0, 94.0), 1)
    result = _interpolate(COARSE, strong)
    rate, level = strong.counts / strong.exposure_s, result.background_cps
    swings = _posterior(COARSE, strong, rate, jnp.full(240, 94.0), level, jnp.square(jnp.std(rate)))[0]
    assert float(jnp.min(swings)) < 0.0
    assert float(jnp.min(result.mean_cps)) == 0.0
    assert float(jnp.max(result.mean_cps)) > 10_000.0


def test_far_from_samples_the_map_is_background_with_the_prior_spread():
    left = replace(COARSE_SURVEY, valid=COARSE_SURVEY.position_m[:, 0] < -10.0)
    result = _interpolate(COARSE, draw(left, jnp.full(240, 94.0), 1))
    far, near = result.std_cps[:, -1], result.std_cps[2:-2, 2]
    assert float(jnp.min(far)) > 1.5 * float(jnp.max(near))
    np.testing.assert_allclose(result.mean_cps[:, -1], result.background_cps, atol=0.1 * float(jnp.min(far)))
    np.testing.assert_array_equal(result.significance[:, -1], 0.0)


@pytest.mark.parametrize(
    ("counts", "valid"),
    [(0.0, True), (3.0, True), (1e8, True), (94.0, False)],
    ids=["none", "few", "huge", "no samples"],
)
def test_nothing_is_ever_not_a_number(counts, valid):
    samples = replace(COARSE_SURVEY, counts=jnp.full(240, counts), valid=jnp.full(240, valid))
    one_hot = replace(samples, counts=samples.counts.at[17].set(1e7))
    for case in (samples, one_hot):
        result = _interpolate(COARSE, case)
        for leaf in jax.tree.leaves(result):
            assert bool(jnp.all(jnp.isfinite(leaf)))
        assert bool(jnp.all(result.std_cps >= 0.0))
    assert not bool(jnp.any(extract_hotspots(COARSE, _interpolate(COARSE, samples)).valid))


def test_padding_changes_nothing():
    samples = draw(COARSE_SURVEY, jnp.full(240, 94.0), 4)
    padded = jax.tree.map(lambda a: jnp.concatenate([a, a[:50]]), samples)
    padded = replace(
        padded,
        valid=padded.valid.at[240:].set(False),
        counts=padded.counts.at[240:].set(jnp.nan),
        position_m=padded.position_m.at[240:].set(jnp.nan),
    )
    a, b = _interpolate(COARSE, samples), _interpolate(COARSE, padded)
    np.testing.assert_allclose(a.mean_cps, b.mean_cps, rtol=1e-4)
    np.testing.assert_allclose(a.significance, b.significance, atol=1e-2)


def test_an_even_rate_is_mapped_without_bias():
    keys = jax.random.split(jax.random.key(5), 64)
    results = jax.jit(jax.vmap(lambda k: interpolate(COARSE, draw(COARSE_SURVEY, jnp.full(240, 50.0), k))))(keys)
    # 64 missions of 240 s at 50 cps: standard error of the mean 0.06; the median of a smoothed field adds as much.
    assert abs(float(jnp.mean(results.mean_cps)) - 50.0) < 0.25
    assert abs(float(jnp.mean(results.background_cps)) - 50.0) < 0.25


@given(expected=st.floats(20.0, 1e6), sigma=st.floats(-4.0, 8.0))
def test_significance_is_the_signed_root_of_the_poisson_deviance(expected, sigma):
    background, noise_var, gain = 10.0, 100.0 / expected, 1.0
    excess = sigma * np.sqrt(noise_var)
    n = expected * (1.0 + excess / background)
    if n <= 1.0:
        return
    truth = np.sign(sigma) * np.sqrt(max(2.0 * (n * np.log(n / expected) - (n - expected)), 0.0))
    value = _significance(*(jnp.float32(v) for v in (excess, gain, noise_var, background)))
    np.testing.assert_allclose(value, truth, atol=2e-3 + 2e-3 * abs(sigma))


def test_a_map_too_large_is_refused_with_the_way_out():
    with pytest.raises(InputError, match="larger cell_m"):
        mapping(half=500.0, cell_m=0.5)
    with pytest.raises(InputError, match="longer length_scale_m"):
        mapping(half=50.0, length_scale_m=1.0)
