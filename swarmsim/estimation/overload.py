"""Counters driven into their dead time: which of several activities is right, and what is to be believed beside it.

A counter that is paralysed registers few counts, as one far from any source does. So the likelihood has several maxima
by the activity, and no step from a weak source leads to a strong one.
"""

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.estimation.forward import Problem
from swarmsim.estimation.normal_equations import MEAN_FLOOR, Others
from swarmsim.radiation.rate import share_registered

OVERLOADED = 0.1  # of the time a counter is dead in some window, from which on it may have been paralysed in others
LEAST_SHARE = 0.3  # of the rate of the other sources in some window, that a further one adds
FACTORS = 1.6 ** np.arange(24, dtype=np.float32)  # of an activity, that are tried


def overloaded(problem: Problem) -> jax.Array:
    """Whether [] some counter registered so much that it was dead for a good part of the time."""
    m = problem.measurements
    dead = m.counts / jnp.maximum(m.exposure_s, 1e-9) * jnp.sum(problem.dead_s, axis=1)
    return jnp.any(m.valid & (dead > OVERLOADED))


def prominent(problem: Problem, own: jax.Array, others: Others) -> jax.Array:
    """Whether [] a further source adds [n, R] counts that may be believed beside ``others``.

    Where counters were overloaded it has to add `LEAST_SHARE` of all others in some window: by less the dead time, and
    the rate within a window, may be other than modelled.
    """
    return least_prominent(problem, jnp.sum(own, axis=1), others) < 1.0


def least_prominent(problem: Problem, own: jax.Array, others: Others) -> jax.Array:
    """Activity [...] in Bq from which on a source that adds [..., n] per Bq is `prominent`, before dead time."""
    valid, rest = problem.measurements.valid, jnp.sum(others.counts, axis=(0, 2))
    share = jnp.max(jnp.where(valid, own / jnp.maximum(rest, MEAN_FLOOR), 0.0), axis=-1)
    return jnp.where(overloaded(problem), LEAST_SHARE / jnp.maximum(share, 1e-30), 0.0)


def likeliest(
    problem: Problem, added: jax.Array, beside: jax.Array, variance: jax.Array
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """Which of `FACTORS` [...] of what a source adds explains the counts best, and twice the gain in log likelihood.

    Errors of the model have Student's t-distribution, so that few windows decide nothing. Works on the last axis.

    Args:
        problem: the data.
        added: [..., n] counts that the source adds, before dead time.
        beside: [n] those of all else.
        variance: [n] of the logarithm of what it adds.
    """
    m = problem.measurements
    seen = jnp.maximum(m.counts, 0.5)
    spread = problem.tail * (variance + jnp.square(problem.background_std) + 1.0 / seen)

    def value(true: jax.Array) -> jax.Array:
        share = share_registered(true / jnp.maximum(m.exposure_s, 1e-9), *problem.dead_s.T)
        expected = jnp.maximum(share * true, MEAN_FLOOR)
        misfit = jnp.log1p(jnp.square(jnp.log(seen / expected)) / spread)
        return -(problem.tail + 1.0) * jnp.sum(jnp.where(m.valid, misfit, 0.0), axis=-1)

    def better(best: tuple[jax.Array, jax.Array], factor: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
        now = value(factor * added + beside)
        return (jnp.where(now > best[1], factor, best[0]), jnp.maximum(now, best[1])), None

    first = jnp.ones(added.shape[:-1])
    (factor, most), _ = jax.lax.scan(better, (first, -jnp.inf * first), jnp.asarray(FACTORS))
    return factor, most - value(beside)


def likeliest_source(problem: Problem, added: jax.Array, beside: jax.Array) -> jax.Array:
    """Twice the gain in log likelihood [C] of sources of any activity that add [C, n] per Bq, before dead time.

    From an activity on by which the counter that has most of it is dead for `OVERLOADED` of the time.
    """
    live, dead_s = jnp.maximum(problem.measurements.exposure_s, 1e-9), jnp.sum(problem.dead_s, axis=1)
    most = jnp.max(jnp.where(problem.measurements.valid, added / live * dead_s, 0.0), axis=-1, keepdims=True)
    return likeliest(problem, OVERLOADED * added / jnp.maximum(most, 1e-30), beside, jnp.square(problem.model_std))[1]
