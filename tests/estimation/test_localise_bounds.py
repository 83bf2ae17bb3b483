"""Many estimates against the Cramér–Rao bound of counts by region of interest."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from tests.estimation.conftest import AERIAL, DETECTORS, NOWHERE
from tests.estimation.survey import ACTIVITY, SOURCE, drawn, mean_rois, place

pytestmark = pytest.mark.optimised

SITE = place(NOWHERE)
DRAWS = 32


def means(theta):
    """Expected counts [n, R] of (x, y, height, ln activity, ln background)."""
    at, activity, background = theta[:3], np.exp(theta[3]), np.exp(theta[4])
    return np.asarray(mean_rois(SITE, DETECTORS, AERIAL, [(at, activity, "Co-60")], background), float)[:300]


def bound(height_std):
    """Least standard deviations [5], by central differences."""
    theta = np.append(np.asarray(SOURCE, float), [np.log(ACTIVITY), 0.0])
    steps = np.diag([0.5, 0.5, 0.5, 0.05, 0.05])
    slopes = np.stack([(means(theta + s) - means(theta - s)) / (2.0 * s.sum()) for s in steps])
    information = np.einsum("anr,bnr,nr->ab", slopes, slopes, 1.0 / np.maximum(means(theta), 1e-9))
    information[2, 2] += 1.0 / height_std**2
    return np.sqrt(np.diag(np.linalg.inv(information)))


def test_estimates_reach_the_cramer_rao_bound_and_know_their_errors(localiser):
    """Where nothing but the source and the level of the background is unknown."""
    certain = replace(localiser.presumed, background_std=jnp.float32(0.01), model_std=jnp.float32(0.001))
    mean = mean_rois(SITE, DETECTORS, AERIAL, [(SOURCE, ACTIVITY, "Co-60")])
    fits = [localiser(drawn(AERIAL, mean, seed), certain).fits for seed in range(DRAWS)]
    assert all(f.present.tolist() == [True, False] for f in fits)
    error = np.stack([f.position_m[0] - SOURCE for f in fits])[:, :2]
    rmse, least = np.sqrt(np.mean(error**2, axis=0)), bound(0.5)
    assert np.all(rmse <= 1.3 * least[:2])
    assert np.all(rmse >= 0.8 * least[:2])  # nobody beats the bound: the errors would be wrong
    assert np.all(np.abs(error.mean(axis=0)) < 4.0 * least[:2] / np.sqrt(DRAWS))
    covariance = np.stack([f.covariance_m2[0, :2, :2] for f in fits])
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert 1.2 < normalised.mean() < 3.0  # two degrees of freedom
    logs = np.log([float(f.activity_bq[0]) / ACTIVITY for f in fits])
    assert np.std(logs) < 1.3 * least[3]
    assert np.mean([bool(f.converged[0]) for f in fits]) > 0.98
