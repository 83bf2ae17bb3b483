import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.estimation import RadiationMap, extract_hotspots, interpolate
from tests.estimation.survey import detector, draw, mapping, mean_rates, place, survey

pytestmark = pytest.mark.optimised

PARAMS = mapping(half=35.0, variance_kept=0.85, cell_m=2.5)
ALARM = mapping(half=25.0, variance_kept=0.85, cell_m=2.5)
SURVEY = survey(half=25.0, lines=6, count=120)


def synthetic_map(significance):
    significance = jnp.asarray(significance, jnp.float32)
    return RadiationMap(
        mean_cps=significance,
        std_cps=jnp.ones_like(significance),
        significance=significance,
        background_cps=jnp.zeros(()),
    )


def bumps(*peaks, width=4.0):
    ny, nx = PARAMS.rows.shape[0], PARAMS.columns.shape[0]
    x = np.asarray(PARAMS.origin_m[0] + PARAMS.cell_m * np.arange(nx))
    y = np.asarray(PARAMS.origin_m[1] + PARAMS.cell_m * np.arange(ny))
    xs, ys = np.meshgrid(x, y)
    return sum(h * np.exp(-0.5 * ((xs - px) ** 2 + (ys - py) ** 2) / width**2) for px, py, h in peaks)


def test_bare_background_gives_no_hotspot_and_standard_normal_significance():
    def mission(key):
        result = interpolate(ALARM, draw(SURVEY, jnp.full(120, 94.0), key))
        return jnp.any(extract_hotspots(ALARM, result).valid), result.significance

    keys = jax.random.split(jax.random.key(0), 1024)
    alarms, significance = jax.jit(lambda k: jax.lax.map(mission, k, batch_size=64))(keys)
    assert float(jnp.mean(alarms)) < 0.01
    inner = np.asarray(significance)[:, 2:-2, 2:-2].ravel()
    # The background is estimated from the same map, which takes up part of the spread; it must never add to it.
    assert abs(inner.mean()) < 0.1
    assert 0.85 < inner.std() < 1.03
    assert np.mean(inner > 3.0) < 2.0 * 1.35e-3


def test_sparse_counts_raise_no_false_alarms_either():
    def mission(key):
        return jnp.any(extract_hotspots(ALARM, interpolate(ALARM, draw(SURVEY, jnp.full(120, 2.0), key))).valid)

    keys = jax.random.split(jax.random.key(1), 1024)
    assert float(jnp.mean(jax.jit(lambda k: jax.lax.map(mission, k, batch_size=64))(keys))) < 0.01


@pytest.mark.slow
def test_two_sources_are_two_hotspots_strongest_first():
    site, detectors, flight = place(), (detector(),), survey(altitude=10.0)
    truth = [((-35.0, 20.0, 0.5), 60e6), ((30.0, -25.0, 0.5), 120e6)]
    params = mapping(variance_kept=0.85, cell_m=2.5)
    rates = mean_rates(site, detectors, flight, truth)
    for seed in range(3):
        found = jax.jit(lambda m: extract_hotspots(params, interpolate(params, m)))(draw(flight, rates, seed))
        assert found.valid.tolist() == [True, True, False, False]
        np.testing.assert_allclose(found.position_m[0], (30.0, -25.0), atol=9.0)
        np.testing.assert_allclose(found.position_m[1], (-35.0, 20.0), atol=9.0)


def test_hotspots_are_apart_and_flanks_are_none():
    found = extract_hotspots(PARAMS, synthetic_map(bumps((0.0, 0.0, 20.0), (10.0, 0.0, 15.0), (-25.0, 25.0, 12.0))))
    assert found.valid.tolist() == [True, True, False, False]
    np.testing.assert_allclose(found.position_m[0], (0.0, 0.0), atol=1.3)
    np.testing.assert_allclose(found.position_m[1], (-25.0, 25.0), atol=1.3)
    assert bool(jnp.all(jnp.diff(found.significance[:2]) < 0.0))


def test_below_the_threshold_nothing_is_found_but_the_best_place_is_known():
    found = extract_hotspots(PARAMS, synthetic_map(bumps((10.0, -20.0, 4.9))))
    assert not bool(jnp.any(found.valid))
    np.testing.assert_allclose(found.position_m, np.tile([10.0, -20.0], (4, 1)), atol=1.3)


def test_a_flat_map_above_the_threshold_still_has_a_fixed_size():
    found = extract_hotspots(PARAMS, synthetic_map(jnp.full((28, 28), 6.0)))
    assert found.position_m.shape == (4, 2)
    assert len({tuple(p) for p in found.position_m.tolist()}) == 4
