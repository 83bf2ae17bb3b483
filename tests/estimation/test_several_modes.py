"""Importance sampling of posteriors with modes metres apart, against closed forms."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.estimation.importance_sampling import _of_off, sample_posterior
from swarmsim.estimation.mixture import Weighed, nowhere

CASES = 48
FLAT = np.array([1.0, 1.0, 0.5])


def _weighed(place, log_posterior, information):
    zero = jnp.zeros(())
    return Weighed(place=place, log_activity=zero, variance=zero, log_posterior=log_posterior, information=information)


@jax.jit
@jax.vmap
def _of_two_modes(centres, std, share, modes):
    """Moments where a source is in one of two normal modes [2, 3] of ``std`` [2], in each with its ``share`` [2]."""

    def weigh(x, _):
        inverse = 1.0 / jnp.square(std[:, None] * jnp.asarray(FLAT))
        each = jnp.log(share) - 3.0 * jnp.log(std) - 0.5 * jnp.sum(inverse * jnp.square(x - centres), axis=1)
        return _weighed(x, jax.scipy.special.logsumexp(each), jnp.diag(inverse[jnp.argmax(each)]))

    guess = jnp.diag(jnp.square(std[0] * jnp.asarray(FLAT)))
    return sample_posterior(weigh, centres[0], guess, 40, 24, modes)


def test_a_place_that_is_given_many_times_stands_for_a_region():
    """Four places of the far mode, each twelve times: what is drawn about them is as wide as they are apart."""
    rng = np.random.default_rng(4)
    share, std = rng.uniform(0.2, 0.8, CASES), np.exp(rng.uniform(np.log(0.15), np.log(0.6), (CASES, 2)))
    angle, far = rng.uniform(0.0, 2.0 * np.pi, CASES), rng.uniform(3.0, 8.0, CASES)
    away = np.stack([far * np.cos(angle), far * np.sin(angle), np.zeros(CASES)], axis=1)
    few = away[:, None] + std[:, 1, None, None] * FLAT * rng.normal(size=(CASES, 4, 3))
    near = std[:, :1, None] * FLAT * rng.normal(size=(CASES, 48, 3))
    modes = np.concatenate([np.repeat(few, 12, axis=1), near], axis=1)[:, rng.permutation(96)]
    centres = np.stack([np.zeros_like(away), away], axis=1)
    found = _of_two_modes(*map(jnp.float32, (centres, std, np.stack([1.0 - share, share], axis=1), modes)))
    told = np.sum(np.asarray(found.mean)[:, :2] * away[:, :2], axis=1) / far**2
    assert np.all(np.asarray(found.effective) >= 40.0)
    assert np.sqrt(np.mean(np.square(told - share))) < 0.1
    assert np.mean(np.abs(told - share) > 0.25) < 0.05


def test_each_mode_has_an_error_of_all_places_of_its_own():
    """What is likely of it follows from the place, in another way about each of two modes ten metres apart."""
    rng = np.random.default_rng(8)
    centre, mean = np.array([[0.0, 0.0, 1.0], [8.0, -6.0, 1.0]]), np.array([[1.0, 0.0, -0.5], [-0.8, 0.6, 0.0]])
    slope = rng.normal(0.0, 1.5, (2, 3, 3))
    mode = rng.integers(0, 2, (20, 24))
    aside = rng.normal(0.0, 0.2, (20, 24, 3))
    off = mean[mode] + np.einsum("qpij,qpj->qpi", slope[mode], aside) + rng.normal(0.0, 0.3, aside.shape)
    done = nowhere(20, 24)
    known = replace(done.known, place=jnp.float32(centre[mode] + aside), log_posterior=jnp.zeros((20, 24)))
    # the prior of the error is in the weights, and is taken out of them here
    even = -0.5 * jnp.sum(jnp.square(jnp.float32(off)), axis=-1)
    done = replace(done, known=known, off=jnp.float32(off), mixture=even, count=jnp.int32(20))
    all_ = jnp.ones(2, bool)
    found, std, along = _of_off(done, jnp.float32(centre), ~all_, all_)
    np.testing.assert_allclose(found, mean, atol=0.15)
    np.testing.assert_allclose(along, slope, atol=0.2 * np.abs(slope).max())
    assert np.all(np.asarray(std) < 0.6)
