"""Many fits against the Cramér–Rao bound, and against nothing there."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, kstest

from swarmsim.estimation import (
    cramer_rao_covariance,
    detected,
    extract_hotspots,
    fisher_information,
    initial_points,
    interpolate,
    localise,
)
from tests.estimation.survey import (
    ACTIVITY,
    NUCLIDE,
    QUICK,
    SOURCE,
    detector,
    draw,
    mapping,
    mean_rates,
    place,
    survey,
)

pytestmark = pytest.mark.optimised

MAP = mapping(variance_kept=0.9, cell_m=5.0, length_scale_m=14.0)


@partial(jax.jit, static_argnames="missions")
def fly(site, detectors, flight, rates, seed, missions=64):
    """Fits of missions of the given expected rates [n], through map, hotspots and likelihood."""

    def mission(key):
        m = draw(flight, rates, key)
        spots = extract_hotspots(MAP, interpolate(MAP, m))
        return localise(site, detectors, m, initial_points(MAP, spots, 2), NUCLIDE, QUICK)

    return jax.lax.map(mission, jax.random.split(jax.random.key(seed), missions))


def cramer_rao_std(site, detectors, flight):
    information = jax.jit(fisher_information)(site, detectors, flight, SOURCE, ACTIVITY, NUCLIDE)
    return np.sqrt(np.diag(cramer_rao_covariance(information, QUICK.height_std_m)))


def test_aerial_estimate_reaches_the_cramer_rao_bound_and_knows_its_error():
    """128 seeds of the physical detector over open ground, 924 one-second counts each."""
    site, d, flight = place(), (detector(),), survey()
    rates = mean_rates(site, d, flight, [(SOURCE, ACTIVITY)])
    bound = cramer_rao_std(site, d, flight)
    parts = [fly(site, d, flight, rates, seed) for seed in range(2)]
    fits = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    error = (fits.position_m - np.asarray(SOURCE))[:, :2]
    rmse = np.sqrt(np.mean(error**2, axis=0))
    assert np.all(rmse <= 1.3 * bound[:2])
    assert np.all(rmse >= 0.8 * bound[:2])  # nobody beats the bound: the errors would be wrong
    assert np.all(np.abs(error.mean(axis=0)) < 4.0 * bound[:2] / np.sqrt(128))
    assert np.mean(fits.converged) > 0.98
    covariance = fits.covariance_m2[:, :2, :2]
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert kstest(normalised, chi2(2).cdf).pvalue > 1e-3
    assert np.std(np.log(fits.activity_bq / ACTIVITY)) < 1.3 * bound[3]
    assert np.all(detected(fits, 5.0))


def test_ideal_detector_reaches_its_bound_too():
    site, d, flight = place(), (detector("paper_ideal"),), survey()
    fits = fly(site, d, flight, mean_rates(site, d, flight, [(SOURCE, ACTIVITY)]), 12)
    rmse = np.sqrt(np.mean(np.asarray(fits.position_m - SOURCE) ** 2, axis=0))
    assert np.all(rmse[:2] < 1.3 * cramer_rao_std(site, d, flight)[:2])


def test_without_a_source_nothing_is_detected():
    site, d, flight = place(), (detector(),), survey()
    fits = fly(site, d, flight, mean_rates(site, d, flight), 13)
    assert not bool(jnp.any(detected(fits, 5.0)))
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(fits))
    # What little activity is fitted is within its own uncertainty, and the place is as unknown as it gets.
    assert float(jnp.median(fits.detection)) < 9.0
    assert float(jnp.median(jnp.sqrt(fits.covariance_m2[:, 0, 0]))) > 4.0
