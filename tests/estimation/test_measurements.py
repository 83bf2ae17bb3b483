from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.estimation import aggregate, concatenate
from swarmsim.estimation.measurements import cleared
from tests.estimation.survey import windows

_aggregate = jax.jit(aggregate, static_argnums=1)


def random_samples(n, seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(n, 3)) * 0.1 + [0.0, 0.0, 1.0]
    return replace(
        windows(rng.uniform(-500.0, 500.0, (n, 3))),
        axis=jnp.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True), jnp.float32),
        counts=jnp.asarray(rng.poisson(9.0, n), jnp.float32),
        exposure_s=jnp.asarray(rng.uniform(0.05, 0.15, n), jnp.float32),
        valid=jnp.asarray(rng.random(n) < 0.8),
    )


@given(n=st.sampled_from([1, 7, 40]), per_window=st.sampled_from([1, 3, 11]), seed=st.integers(0, 2**31))
def test_windows_keep_counts_exposure_and_centre(n, per_window, seed):
    samples = random_samples(n, seed)
    summed = _aggregate(samples, per_window)
    valid = np.asarray(samples.valid)
    exposure = np.where(valid, samples.exposure_s, 0.0).astype(np.float64)
    assert summed.counts.shape == (-(-n // per_window),)
    assert float(jnp.sum(summed.counts)) == np.sum(np.asarray(samples.counts)[valid])
    np.testing.assert_allclose(np.sum(summed.exposure_s), exposure.sum(), rtol=1e-5)
    for w in range(summed.counts.shape[0]):
        part = slice(w * per_window, (w + 1) * per_window)
        assert bool(summed.valid[w]) == valid[part].any()
        if valid[part].any():
            centre = exposure[part] @ np.asarray(samples.position_m, np.float64)[part] / exposure[part].sum()
            np.testing.assert_allclose(summed.position_m[w], centre, atol=2e-4)
            np.testing.assert_allclose(np.linalg.norm(summed.axis[w]), 1.0, rtol=1e-6)
            assert summed.time_s[w] == np.asarray(samples.time_s)[part][valid[part]].max()


def test_contents_of_padding_never_matter():
    samples = random_samples(40, 3)
    spoilt = replace(
        samples,
        position_m=jnp.where(samples.valid[:, None], samples.position_m, jnp.nan),
        counts=jnp.where(samples.valid, samples.counts, jnp.inf),
        detector=jnp.where(samples.valid, samples.detector, 7),
    )
    for a, b in zip(jax.tree.leaves(_aggregate(samples, 4)), jax.tree.leaves(_aggregate(spoilt, 4)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_row_without_exposure_or_with_a_broken_value_is_not_valid():
    samples = windows(np.zeros((4, 3)))
    broken = replace(samples, exposure_s=jnp.array([1.0, 0.0, 1.0, 1.0]), counts=jnp.array([5.0, 5.0, jnp.nan, 5.0]))
    assert cleared(broken).valid.tolist() == [True, False, False, True]


def test_vehicles_are_joined_after_one_another():
    fleet = jax.tree.map(lambda a, b: jnp.stack([a, b]), random_samples(6, 1), random_samples(6, 2))
    rover = replace(random_samples(4, 3), detector=jnp.ones(4, jnp.int32))
    joined = concatenate(jax.vmap(lambda m: aggregate(m, 3))(fleet), rover)
    assert joined.position_m.shape == (8, 3)
    assert joined.detector.tolist() == [0] * 4 + [1] * 4
    np.testing.assert_array_equal(joined.counts[4:], rover.counts)


def test_an_empty_window_is_refused():
    with pytest.raises(ValueError, match="per_window is 0"):
        aggregate(windows(np.zeros((4, 3))), 0)
