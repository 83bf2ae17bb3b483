"""Samples added up over windows while vehicles measure, against the sums of all samples at once."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.estimation import aggregate
from swarmsim.estimation.measurements import Measurements
from swarmsim.estimation.windows import gather, measured, merged, windows_start

FRAMES, VEHICLES, PER_WINDOW = 60, 3, 7
add = jax.jit(gather, static_argnames="per_window")
ROIS = 3  # regions of interest


def samples(seed=0, frames=FRAMES):
    """Samples [F, U] of vehicles far from the origin, and which of them are new."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(frames, VEHICLES, 3)) * 0.2 + [0.0, 1.0, 0.0]
    time = np.broadcast_to(0.09 * np.arange(1, frames + 1)[:, None], (frames, VEHICLES))
    shape = (frames, VEHICLES)
    rois = rng.poisson(3.0, (*shape, ROIS))
    taken = Measurements(
        time_s=jnp.asarray(time, jnp.float32),
        position_m=jnp.asarray(rng.uniform(-300.0, 300.0, (*shape, 3)), jnp.float32),
        travel_m=jnp.asarray(rng.normal(size=(*shape, 3)), jnp.float32),
        axis=jnp.asarray(axis / np.linalg.norm(axis, axis=-1, keepdims=True), jnp.float32),
        counts=jnp.asarray(rois.sum(axis=-1), jnp.float32),
        rois=jnp.asarray(rois, jnp.float32),
        exposure_s=jnp.asarray(rng.uniform(0.05, 0.15, shape), jnp.float32),
        valid=jnp.ones(shape, bool),
        detector=jnp.full(shape, 2, jnp.int32),
    )
    return taken, jnp.asarray(rng.random(shape) < 0.8)


def of_vehicle(taken, new, vehicle):
    """The new samples of one vehicle, without the others between them."""
    rows = np.flatnonzero(np.asarray(new)[:, vehicle])
    return jax.tree.map(lambda x: x[rows, vehicle], taken)


def assert_equal(found, expected):
    """All but places, whose mean over a window is taken of large numbers here and of differences there."""
    for name in ("time_s", "travel_m", "axis", "counts", "rois", "exposure_s", "valid", "detector"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=2e-5, atol=1e-5, err_msg=name)
    for name in ("position_m", "chord_m"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=3e-4, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("portions", [[FRAMES], [1] * FRAMES, [0, 13, 40, 7]])
def test_windows_equal_the_sums_of_all_samples_in_any_portions(portions):
    taken, new = samples()
    windows = windows_start(VEHICLES, 12, ROIS)
    begin = 0
    for count in portions:
        part = slice(begin, begin + count)
        windows = add(windows, jax.tree.map(lambda x, p=part: x[p], taken), new[part], per_window=PER_WINDOW)
        begin += count
    np.testing.assert_array_equal(windows.samples, np.asarray(new).sum(axis=0))
    found = jax.tree.map(lambda x: x.reshape(VEHICLES, 12, *x.shape[1:]), measured(windows, 2))
    for vehicle in range(VEHICLES):
        own = of_vehicle(taken, new, vehicle)
        expected = aggregate(own, PER_WINDOW)
        used = expected.counts.shape[0]
        mine = jax.tree.map(lambda x, v=vehicle: x[v], found)
        assert_equal(jax.tree.map(lambda x, n=used: x[:n], mine), expected)
        assert not np.any(mine.valid[used:])
        assert int(mine.counts.sum()) == int(own.counts.sum())


def test_samples_beyond_the_last_window_are_dropped():
    taken, _ = samples(1)
    every = jnp.ones((FRAMES, VEHICLES), bool)
    windows = add(windows_start(VEHICLES, 3, ROIS), taken, every, per_window=PER_WINDOW)
    first = jax.tree.map(lambda x: x[: 3 * PER_WINDOW], taken)
    np.testing.assert_allclose(windows.counts.sum(axis=1), first.counts.sum(axis=0))
    np.testing.assert_allclose(windows.exposure_s.sum(axis=1), first.exposure_s.sum(axis=0), rtol=1e-5)
    np.testing.assert_array_equal(windows.samples, FRAMES)


def test_contents_of_samples_that_are_not_new_never_matter():
    taken, new = samples(2)
    spoilt = jax.tree.map(
        lambda x: (
            jnp.where(new.reshape(*new.shape, *[1] * (x.ndim - 2)), x, jnp.asarray(jnp.nan, x.dtype))
            if jnp.issubdtype(x.dtype, jnp.floating)
            else x
        ),
        taken,
    )
    start = windows_start(VEHICLES, 12, ROIS)
    jax.tree.map(
        np.testing.assert_array_equal,
        add(start, spoilt, new, per_window=PER_WINDOW),
        add(start, taken, new, per_window=PER_WINDOW),
    )


def test_nothing_measured_has_no_valid_window():
    none = measured(windows_start(2, 4, ROIS), 1)
    assert none.counts.shape == (8,)
    assert not np.any(none.valid)
    assert np.isfinite(none.position_m).all()
    np.testing.assert_allclose(np.linalg.norm(none.axis, axis=1), 1.0, rtol=1e-6)
    np.testing.assert_array_equal(none.detector, 1)


def test_missions_of_a_batch_have_their_own_windows():
    batch = [samples(seed) for seed in range(3)]
    taken, new = jax.tree.map(lambda *x: jnp.stack(x), *batch)
    start = windows_start(VEHICLES, 12, ROIS)
    together = jax.vmap(partial(gather, per_window=PER_WINDOW), in_axes=(None, 0, 0))(start, taken, new)
    for number, (one, fresh) in enumerate(batch):
        alone = add(start, one, fresh, per_window=PER_WINDOW)
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[number], b, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("most", [1, 2, 4, 8])
def test_windows_are_put_together_until_they_fit(most):
    taken, new = samples(3)
    windows = add(windows_start(VEHICLES, 12, ROIS), taken, new.at[20:, 1].set(False), per_window=PER_WINDOW)
    used = np.asarray(windows.exposure_s > 0.0).sum(axis=1)
    few = merged(windows, most)
    assert few.counts.shape == (VEHICLES, most)
    for name in ("counts", "exposure_s", "rois", "travel_m", "position_m", "axis"):
        whole, parts = (np.asarray(getattr(w, name)).sum(axis=1) for w in (windows, few))
        np.testing.assert_allclose(parts, whole, rtol=1e-5, atol=1e-2, err_msg=name)
    np.testing.assert_array_equal(few.samples, windows.samples)
    for vehicle in range(VEHICLES):
        time, exposure, begin = (np.asarray(x)[vehicle] for x in (windows.time_s, windows.exposure_s, windows.begin_m))
        filled = np.flatnonzero(np.asarray(few.exposure_s)[vehicle] > 0.0)
        # neighbours in their order: each ends with one of the windows, and begins after the one before it
        ends = np.searchsorted(time[: used[vehicle]], np.asarray(few.time_s)[vehicle, filled])
        assert np.all(np.diff(ends) > 0)
        assert ends[-1] == used[vehicle] - 1
        starts = np.concatenate([[0], ends[:-1] + 1])
        np.testing.assert_allclose(np.asarray(few.begin_m)[vehicle, filled], begin[starts])
        np.testing.assert_allclose(
            np.asarray(few.exposure_s)[vehicle, filled], np.add.reduceat(exposure[: used[vehicle]], starts), rtol=1e-5
        )


def test_windows_are_short_where_counts_are_many():
    """A vehicle passes a source at constant speed: windows near it are put together least."""
    along = np.arange(-100.0, 100.0)
    rate = 20.0 + 1e5 / (along**2 + 16.0)
    count, zero = len(along), jnp.zeros((1, len(along)))
    at = jnp.asarray(np.stack([along, 0.0 * along, 0.0 * along], axis=-1)[None], jnp.float32)
    windows = replace(
        windows_start(1, count, ROIS), time_s=zero + jnp.arange(1.0, count + 1.0), position_m=at,
        begin_m=at - jnp.array([0.5, 0.0, 0.0]), travel_m=jnp.zeros((1, count, 3)).at[..., 0].set(1.0),
        counts=jnp.asarray(rate[None], jnp.float32), exposure_s=zero + 1.0,
    )  # fmt: skip
    few = merged(windows, 60)
    length = np.asarray(few.travel_m)[0, :, 0]
    where = np.asarray(few.position_m)[0, :, 0] / np.maximum(np.asarray(few.exposure_s)[0], 1e-9)
    assert length[np.abs(where) < 5.0].max() == 1.0
    far = length[(np.abs(where) > 50.0) & (length > 0.0)]
    assert 4.0 <= far.mean() <= 10.0
    assert far.max() < 2.0 * far.min() + 1.0


@pytest.mark.parametrize("most", [9, 12, 20])
def test_windows_that_fit_stay_as_they_are(most):
    taken, new = samples(4)
    windows = add(windows_start(VEHICLES, 12, ROIS), taken, new, per_window=PER_WINDOW)
    assert int((windows.exposure_s > 0.0).sum(axis=1).max()) <= 9
    few = merged(windows, most)
    kept = min(most, 12)
    for name in ("time_s", "position_m", "travel_m", "begin_m", "axis", "counts", "exposure_s", "rois"):
        np.testing.assert_array_equal(getattr(few, name)[:, :kept], getattr(windows, name)[:, :kept], err_msg=name)
        assert not np.any(getattr(few, name)[:, kept:])
