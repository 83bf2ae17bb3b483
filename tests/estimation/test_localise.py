from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.estimation import (
    concatenate,
    detected,
    localise,
    net_rates,
)
from tests.estimation.survey import (
    ACTIVITY,
    NUCLIDE,
    QUICK,
    SOURCE,
    detector,
    draw,
    mean_rates,
    orbit,
    place,
    survey,
)

STARTS = jnp.array([[5.0, 8.0], [20.0, -2.0]])
_compiled = jax.jit(localise)


def _localise(site, detectors, m, starts, nuclide, params, extra=None):
    """`localise`, always with an extra rate, so that tests share compiled programs."""
    return _compiled(site, detectors, m, starts, nuclide, params, jnp.zeros_like(m.counts) if extra is None else extra)


def noiseless(site, detectors, measurements, sources):
    return replace(measurements, counts=mean_rates(site, detectors, measurements, sources) * measurements.exposure_s)


def test_expected_counts_give_the_truth_back():
    site, d = place(slope=(0.05, -0.1)), (detector(),)
    truth = jnp.array([12.0, 4.0, 12.0 * 0.05 - 4.0 * 0.1 + 1.0])
    m = noiseless(site, d, survey(count=300, slope=(0.05, -0.1)), [(truth, ACTIVITY)])
    fit = _localise(site, d, m, STARTS, NUCLIDE, QUICK)
    sigma = np.sqrt(np.diag(fit.covariance_m2))
    assert np.all(np.abs(np.asarray(fit.position_m - truth)) < 0.25 * sigma)  # sampling, and the skew of the posterior
    assert np.all(sigma < [2.5, 2.5, 0.6])
    np.testing.assert_allclose(fit.activity_bq, ACTIVITY, rtol=0.01)
    np.testing.assert_allclose(fit.background_scale, 1.0, rtol=0.003)
    assert bool(fit.converged)
    assert abs(float(fit.log_likelihood)) < 0.05


def test_a_known_height_stays_fixed():
    fixed = replace(QUICK, presumed_height_m=jnp.float32(0.5), height_std_m=jnp.float32(0.0))
    m = noiseless(place(), (detector(),), survey(count=300), [(SOURCE, ACTIVITY)])
    fit = _localise(place(), (detector(),), m, STARTS, NUCLIDE, fixed)
    np.testing.assert_allclose(fit.position_m[2], 0.5, atol=0.01)
    assert float(fit.covariance_m2[2, 2]) < 1e-5


def test_a_source_behind_a_wall_is_found_where_it_is():
    wall = [((9.0, 4.0, 2.0), (0.3, 6.0, 2.0), "concrete"), ((12.0, 8.5, 1.5), (3.0, 0.3, 1.5), "concrete")]
    site, d = place(wall), (detector(), detector(model="nai_2x2"))
    drive = orbit((12.0, 4.0), 7.0, 60)
    m = concatenate(survey(count=300), drive)
    rates = mean_rates(site, d, m, [(SOURCE, ACTIVITY)])
    fits = [_localise(site, d, draw(m, rates, seed), STARTS, NUCLIDE, QUICK) for seed in range(4)]
    for fit in fits:
        assert np.linalg.norm((fit.position_m - SOURCE)[:2]) < 0.5
        assert 0.7 < float(fit.reduced_deviance) < 1.3
    # A model blind to the walls puts it elsewhere: the walls are what is tested.
    blind = _localise(place(), d, draw(m, rates, 3), STARTS, NUCLIDE, QUICK)
    assert float(blind.reduced_deviance) > 3.0


def test_ground_data_sharpen_the_aerial_estimate():
    site, d = place(), (detector(), detector(model="nai_2x2"))
    m = concatenate(survey(count=300), orbit((12.0, 4.0), 5.0, 60))
    m = noiseless(site, d, m, [(SOURCE, ACTIVITY)])
    both = _localise(site, d, m, STARTS, NUCLIDE, QUICK)
    aerial = _localise(site, d, replace(m, valid=m.detector == 0), STARTS, NUCLIDE, QUICK)
    assert float(both.covariance_m2[0, 0]) < 0.05 * float(aerial.covariance_m2[0, 0])
    np.testing.assert_allclose(both.position_m[:2], SOURCE[:2], atol=0.02)
    np.testing.assert_allclose(both.position_m[2], SOURCE[2], atol=0.5 * float(jnp.sqrt(both.covariance_m2[2, 2])))
    np.testing.assert_allclose(both.activity_bq, ACTIVITY, rtol=0.01)


def test_two_sources_one_after_the_other():
    site, d, flight = place(), (detector(),), survey(altitude=12.0, count=300)
    truth = [(jnp.array([30.0, -25.0, 1.0]), 300e6), (jnp.array([-30.0, 20.0, 1.0]), 150e6)]
    m = draw(flight, mean_rates(site, d, flight, truth), 7)
    first = jnp.array([[28.0, -22.0], [34.0, -20.0]])
    second = jnp.array([[-27.0, 22.0], [-33.0, 25.0]])
    extra = jnp.zeros(300)
    rates = jax.jit(partial(net_rates, site, d))
    for _ in range(3):  # each in turn with the other's rate known: coordinate ascent of the joint likelihood
        strong = _localise(site, d, m, first, NUCLIDE, QUICK, extra)
        weak = _localise(site, d, m, second, NUCLIDE, QUICK, strong.activity_bq * rates(m, strong.position_m, NUCLIDE))
        extra = weak.activity_bq * rates(m, weak.position_m, NUCLIDE)
    for fit, (position, activity) in zip((strong, weak), truth, strict=True):
        sigma = np.sqrt(np.diag(fit.covariance_m2))[:2]
        assert np.all(np.abs(np.asarray(fit.position_m - position)[:2]) < 4.0 * sigma)
        assert abs(float(fit.activity_bq) - activity) < 4.0 * float(fit.activity_std_bq)
        assert bool(detected(fit, 5.0))


def test_padding_and_repetition_change_nothing():
    site, d, flight = place(), (detector(),), survey(count=300)
    m = draw(flight, mean_rates(site, d, flight, [(SOURCE, ACTIVITY)]), 5)
    m = replace(m, valid=m.valid.at[250:].set(False))
    spoilt = replace(
        m,
        counts=m.counts.at[250:].set(jnp.nan),
        position_m=m.position_m.at[250:].set(jnp.nan),
        exposure_s=m.exposure_s.at[250:].set(1e9),
        detector=m.detector.at[250:].set(9),
    )
    one, again, other = (_localise(site, d, v, STARTS, NUCLIDE, QUICK) for v in (m, m, spoilt))
    for a, b, c in zip(*(jax.tree.leaves(v) for v in (one, again, other)), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)
    shorter = _localise(site, d, jax.tree.map(lambda a: a[:250], m), STARTS, NUCLIDE, QUICK)
    np.testing.assert_allclose(one.position_m, shorter.position_m, atol=0.02)
    np.testing.assert_allclose(one.detection, shorter.detection, rtol=1e-3)


def test_a_mission_of_a_batch_equals_itself_alone():
    site, d, flight = place(), (detector(),), survey(count=300)
    rates = mean_rates(site, d, flight, [(SOURCE, ACTIVITY)])
    batch = jax.vmap(lambda k: draw(flight, rates, k))(jax.random.split(jax.random.key(6), 3))
    together = jax.jit(jax.vmap(lambda m: localise(site, d, m, STARTS, NUCLIDE, QUICK)))(batch)
    alone = _localise(site, d, jax.tree.map(lambda a: a[1], batch), STARTS, NUCLIDE, QUICK)
    np.testing.assert_allclose(together.position_m[1], alone.position_m, atol=0.02)
    np.testing.assert_allclose(together.activity_bq[1], alone.activity_bq, rtol=2e-3)


@pytest.mark.parametrize("case", ["no samples", "no counts", "outside"])
def test_useless_data_give_a_finite_answer_that_is_no_detection(case):
    site, d, m = place(), (detector(),), survey(count=300)
    m = {
        "no samples": replace(m, valid=jnp.zeros(300, bool)),
        "no counts": m,
        "outside": draw(replace(m, position_m=m.position_m + jnp.array([900.0, 0.0, 0.0])), jnp.full(300, 94.0), 1),
    }[case]
    fit = _localise(site, d, m, STARTS, NUCLIDE, QUICK)
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(fit))
    assert not bool(detected(fit, 5.0))
    assert np.all(np.abs(np.asarray(fit.position_m)[:2]) <= 90.0)
