"""Evidence of a hypothesis about a spectrum."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import xlogy

from swarmsim.radiation.laplace import COLUMNS, NATURAL, NATURAL_STD, Data, Hypothesis, laplace, swept
from swarmsim.radiation.lines import ORDERS


def test_evidence_of_a_flat_background_is_the_integral() -> None:
    """Laplace's method against the sum over a grid of the one parameter that the data tell, and of a strength."""
    bins, rng = 40, np.random.default_rng(3)
    natural = np.full(bins, 10.0)
    peak = np.exp(-0.5 * ((np.arange(bins) - 20.0) / 2.0) ** 2)
    peak /= peak.sum()
    counts = rng.poisson(natural + 60.0 * peak).astype(np.float64)
    column = np.zeros((COLUMNS, ORDERS, bins), np.float32)
    column[0, 0], column[NATURAL, 0] = natural / natural.sum(), peak
    scale = np.zeros(COLUMNS, np.float32)
    scale[[0, NATURAL]] = NATURAL_STD * natural.sum(), 50.0
    strength = np.zeros(COLUMNS, np.float32)
    strength[NATURAL] = 1.0
    start = np.zeros(COLUMNS, np.float32)
    start[[0, NATURAL]] = natural.sum(), 30.0
    hypothesis = Hypothesis(*map(jnp.asarray, (column, scale, strength, start, np.float32(1.0))))
    data = Data(*map(jnp.asarray, (counts, np.ones(bins), natural.sum(), 120.0)))
    found = laplace(hypothesis, data)
    level = natural.sum() * (1.0 + NATURAL_STD * np.linspace(-2.0, 2.0, 401))
    s = np.linspace(0.0, 300.0, 601)
    mean = level[:, None, None] * column[0, 0] + s[:, None] * column[NATURAL, 0]
    log_likelihood = np.sum(xlogy(counts, mean) - mean - (xlogy(counts, counts) - counts), axis=-1)
    x = (level / natural.sum() - 1.0) / NATURAL_STD
    prior = np.exp(-0.5 * x**2)[:, None] / np.sqrt(2 * np.pi) * 2.0 / (np.pi * 120.0 * (1.0 + (s / 120.0) ** 2))
    truth = np.log(np.sum(np.exp(log_likelihood) * prior) * (x[1] - x[0]) * (s[1] - s[0]))
    assert float(found.score) == pytest.approx(truth, abs=0.1)


def test_the_sweep_inverts_a_matrix() -> None:
    a = np.random.default_rng(5).normal(size=(10, 14))
    matrix = a @ a.T + np.eye(10)
    inverse, log_determinant = swept(jnp.asarray(matrix, jnp.float32))
    np.testing.assert_allclose(inverse, np.linalg.inv(matrix), atol=1e-5)
    assert float(log_determinant) == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-4)
