from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.estimation import extract_hotspots, interpolate
from swarmsim.estimation.recursive_map import default_bin_cells, measurements, read, start, update
from tests.estimation.survey import draw, mapping, survey, windows

pytestmark = pytest.mark.optimised

HALF = 24.0
MAP = mapping(half=HALF, cell_m=1.5)  # bins of one cell, a quarter of the length scale of 6 m
SURVEY = survey(half=HALF, lines=7, count=200)
_interpolate = jax.jit(partial(interpolate, MAP))
_update = jax.jit(partial(update, MAP))
_read = jax.jit(partial(read, MAP))


def added(state, m, sensitivity=1.0):
    ratio = jnp.broadcast_to(jnp.float32(sensitivity), m.counts.shape)
    return _update(state, m.position_m, m.counts, m.exposure_s, m.valid, ratio)


def bump(m, height, centre=(0.0, 0.0), width=7.0):
    square = jnp.sum((m.position_m[:, :2] - jnp.asarray(centre)) ** 2, axis=-1)
    return height * jnp.exp(-0.5 * square / width**2)


def near(a, b, **tolerances):
    for name in ("exposure_s", "counts", "samples", "offset_m_s", "ignored"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), err_msg=name, **tolerances)


def test_bins_are_about_a_quarter_of_the_length_scale():
    assert default_bin_cells(MAP) == 1
    assert default_bin_cells(mapping(half=20.0, cell_m=1.0, length_scale_m=12.0)) == 3
    assert default_bin_cells(mapping(half=20.0, cell_m=4.0, length_scale_m=6.0)) == 1
    assert start(MAP).samples.shape == (32, 32)
    assert start(MAP, 3).samples.shape == (11, 11)
    with pytest.raises(ValueError, match="at least one cell"):
        start(MAP, 0)


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**31),
    level=st.floats(5.0, 300.0),
    contrast=st.floats(0.0, 4.0),
    kind=st.sampled_from(["lines", "scattered", "hover"]),
)
def test_the_map_is_that_of_all_samples_at_once(seed, level, contrast, kind):
    rng = np.random.default_rng(seed)
    place = rng.uniform(-HALF, HALF, (200, 2))
    if kind == "hover":
        place[:100] = rng.uniform(-HALF, HALF, 2) + rng.normal(0.0, 1.0, (100, 2))
    m = SURVEY if kind == "lines" else windows(np.c_[place, np.full(200, 20.0)].clip(-HALF, HALF))
    m = draw(m, level * (1.0 + bump(m, contrast, rng.uniform(-15.0, 15.0, 2))), seed)
    batch, recursive = _interpolate(m), _read(added(start(MAP), m))
    error = (recursive.mean_cps - batch.mean_cps) / batch.std_cps
    assert float(jnp.sqrt(jnp.mean(error**2))) < 0.15
    assert float(jnp.max(jnp.abs(error))) < 1.0
    np.testing.assert_allclose(recursive.std_cps, batch.std_cps, rtol=0.2)
    np.testing.assert_allclose(recursive.background_cps, batch.background_cps, rtol=0.03)


def test_one_sample_in_each_bin_is_the_batch_itself():
    m = survey(half=HALF, lines=7, count=168)  # 2 m apart: no two in one bin
    m = draw(m, 60.0 * (1.0 + bump(m, 2.0)), 1)
    state = added(start(MAP), m)
    assert float(jnp.max(state.samples)) == 1.0
    batch, recursive = _interpolate(m), _read(state)
    np.testing.assert_allclose(recursive.mean_cps, batch.mean_cps, rtol=1e-3)
    np.testing.assert_allclose(recursive.std_cps, batch.std_cps, rtol=1e-3)
    np.testing.assert_allclose(recursive.significance, batch.significance, atol=0.02)


def test_repeated_samples_weigh_as_often_as_they_were_taken():
    """The levels are the batch's; repeated samples share what the basis misses, so the bins claim less there."""
    m = draw(survey(half=HALF, lines=7, count=168), jnp.full(168, 60.0), 2)
    again = jnp.concatenate([jnp.arange(168), jnp.full(80, 20), jnp.full(41, 90)])
    many = jax.tree.map(lambda x: x[again], m)
    batch, recursive = _interpolate(many), _read(added(start(MAP), many))
    np.testing.assert_allclose(recursive.background_cps, batch.background_cps, rtol=1e-4)
    ratio = recursive.std_cps / batch.std_cps
    np.testing.assert_allclose(jnp.median(ratio), 1.0, rtol=1e-3)
    assert float(jnp.min(ratio)) > 0.999
    assert float(jnp.max(ratio)) < 1.3


def test_order_and_portions_do_not_matter():
    m = draw(SURVEY, jnp.full(200, 40.0), 3)
    once = added(start(MAP), m)
    turned = added(start(MAP), jax.tree.map(lambda x: x[::-1], m))
    near(once, turned, rtol=1e-5, atol=1e-4)
    portions = start(MAP)
    for part in range(0, 200, 20):
        portions = added(portions, jax.tree.map(lambda x, part=part: x[part : part + 20], m))
    near(once, portions, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(_read(once).mean_cps, _read(portions).mean_cps, rtol=1e-3)


def test_samples_that_are_not_fresh_or_not_sound_change_nothing():
    m = draw(SURVEY, jnp.full(200, 40.0), 4)
    state = added(start(MAP), m)
    old = replace(m, valid=jnp.zeros(200, bool), counts=m.counts.at[3].set(jnp.nan), position_m=m.position_m * jnp.nan)
    near(added(state, old), state, rtol=0.0)
    bad = replace(
        m,
        counts=m.counts.at[0].set(jnp.nan).at[1].set(-1.0),
        exposure_s=m.exposure_s.at[2].set(0.0).at[3].set(jnp.inf),
        position_m=m.position_m.at[4, 0].set(jnp.nan).at[5, 1].set(jnp.inf),
        valid=jnp.arange(200) < 6,
    )
    refused = added(state, bad)
    assert int(refused.ignored) == 6
    near(replace(refused, ignored=state.ignored), state, rtol=0.0)
    still = replace(m, valid=jnp.arange(200) < 1)
    for ratio in (0.0, jnp.nan, -1.0):
        assert int(added(state, still, ratio).ignored) == 1
    # The height is of no concern.
    near(added(start(MAP), replace(m, position_m=m.position_m.at[:, 2].set(jnp.nan))), state, rtol=0.0)


def test_samples_just_outside_belong_to_the_edge_and_others_to_nothing():
    reach = 0.5 * 6.0
    inside, outside = HALF + 0.9 * reach, HALF + 1.1 * reach
    place = [[inside, 0.0, 9.0], [-inside, -inside, 9.0], [0.0, outside, 9.0], [-outside, 0.0, 9.0], [1e6, 0.0, 9.0]]
    m = replace(windows(np.array(place)), counts=jnp.full(5, 7.0))
    state = added(start(MAP), m)
    assert int(state.ignored) == 3
    assert float(state.samples[16, -1]) == float(state.samples[0, 0]) == 1.0
    rows = measurements(MAP, state)
    np.testing.assert_allclose(rows.position_m[np.asarray(rows.valid), :2], [[-inside, -inside], [inside, 0.0]])


def test_a_bin_stands_where_its_samples_were():
    rng = np.random.default_rng(6)
    place = np.c_[rng.uniform(0.05, 1.45, (50, 2)), np.zeros(50)]
    exposure = rng.uniform(0.1, 3.0, 50).astype(np.float32)
    m = replace(windows(place), exposure_s=jnp.asarray(exposure), counts=jnp.full(50, 5.0))
    rows = measurements(MAP, added(start(MAP), m))
    assert int(jnp.sum(rows.valid)) == 1
    at = int(jnp.argmax(rows.valid))
    np.testing.assert_allclose(rows.position_m[at, :2], np.average(place[:, :2], weights=exposure, axis=0), atol=1e-5)
    np.testing.assert_allclose(rows.exposure_s[at], exposure.sum(), rtol=1e-6)
    assert float(rows.counts[at]) == 250.0


def test_different_detectors_give_one_map():
    """One flies the west half, one of three times the area the east half, over pure background."""
    m = SURVEY
    ratio = jnp.where(m.position_m[:, 0] > 0.0, 3.0, 1.0)

    def west_and_east(key, used):
        counted = draw(m, 40.0 * ratio, key)
        state = update(MAP, start(MAP), m.position_m, counted.counts, m.exposure_s, m.valid, used)
        chart = read(MAP, state)
        return chart, extract_hotspots(MAP, chart).valid[0]

    keys = jax.random.split(jax.random.key(7), 16)
    chart, found = jax.jit(jax.vmap(lambda k: west_and_east(k, ratio)))(keys)
    assert not np.any(found)
    west, east = jnp.mean(chart.mean_cps[:, :, 2:14]), jnp.mean(chart.mean_cps[:, :, 18:30])
    np.testing.assert_allclose([west, east], 40.0, rtol=0.02)
    assert float(jnp.mean(chart.std_cps[:, :, 24:])) < float(jnp.mean(chart.std_cps[:, :, :8]))
    _, alarm = jax.jit(lambda k: west_and_east(k, jnp.ones_like(ratio)))(keys[0])
    assert bool(alarm)  # as if both were alike


def test_a_strong_source_is_a_hotspot_as_soon_as_it_has_been_passed():
    centre = jnp.array([9.0, 3.0])
    m = draw(SURVEY, 40.0 + bump(SURVEY, 120.0, centre, 5.0), 8)
    before = replace(m, valid=m.position_m[:, 1] < -13.0)
    after = replace(m, valid=~before.valid)
    state = added(start(MAP), before)
    assert not bool(extract_hotspots(MAP, _read(state)).valid[0])
    hotspots = extract_hotspots(MAP, _read(added(state, after)))
    assert bool(hotspots.valid[0])
    assert float(jnp.linalg.norm(hotspots.position_m[0] - centre)) < 3.0


def test_many_small_samples_add_up_exactly():
    number, vehicles = 25_000, 4
    place = jnp.array([[0.3, 0.4, 9.0], [0.3, 0.5, 9.0], [0.4, 0.4, 9.0], [9.0, 9.0, 9.0]])
    exposure, counts, ratio = jnp.float32(0.0973), jnp.float32(1001.0), jnp.float32(1.3)

    def one(_, state):
        full = lambda v: jnp.full(vehicles, v)  # noqa: E731
        return update(MAP, state, place, full(counts), full(exposure), jnp.ones(vehicles, bool), full(ratio))

    state = jax.jit(lambda s: jax.lax.fori_loop(0, number, one, s))(start(MAP))
    rows = measurements(MAP, state)
    seen = np.flatnonzero(rows.valid)
    single = float(exposure * ratio)
    np.testing.assert_allclose(rows.exposure_s[seen], [3 * number * single, number * single], rtol=2e-6)
    np.testing.assert_allclose(rows.counts[seen], [3 * number * 1001.0, number * 1001.0], rtol=2e-7)
    np.testing.assert_allclose(rows.position_m[seen[0], :2], [1.0 / 3.0, 1.3 / 3.0], atol=2e-3)
    np.testing.assert_allclose(state.samples.sum(), vehicles * number)


def test_nothing_measured_is_a_map_that_knows_nothing():
    chart = _read(start(MAP))
    np.testing.assert_array_equal(chart.mean_cps, 0.0)
    np.testing.assert_allclose(chart.std_cps, 1.0, atol=0.1)
    np.testing.assert_array_equal(chart.significance, 0.0)


def test_missions_in_a_batch_have_their_own_maps():
    m = [draw(SURVEY, jnp.full(200, level), 9) for level in (20.0, 80.0)]
    counts = jnp.stack([x.counts for x in m])
    one = lambda c: read(MAP, added(start(MAP), replace(SURVEY, counts=c)))  # noqa: E731
    batch = jax.jit(jax.vmap(one))(counts)
    for i in range(2):
        np.testing.assert_allclose(batch.mean_cps[i], one(counts[i]).mean_cps, rtol=1e-4)


def test_gradients_are_finite_and_equal_differences():
    m = draw(SURVEY, 40.0 + bump(SURVEY, 60.0), 10)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(32, 32)), jnp.float32)

    def score(counts, exposure, position):
        state = update(MAP, start(MAP), position, counts, exposure, m.valid, jnp.ones(200))
        chart = read(MAP, state)
        return jnp.sum(weight * (chart.mean_cps + chart.std_cps + chart.significance)) / 100.0

    given_ = (m.counts, m.exposure_s, m.position_m)
    gradients = jax.jit(jax.grad(score, (0, 1, 2)))(*given_)
    assert all(np.all(np.isfinite(g)) for g in gradients)
    step = 2.0
    value = jax.jit(score)
    up, down = (value(m.counts.at[57].add(s), *given_[1:]) for s in (step, -step))
    np.testing.assert_allclose(gradients[0][57], (up - down) / (2.0 * step), rtol=0.1, atol=2e-3)
