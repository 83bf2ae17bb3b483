"""Evidence of hypotheses about a spectrum, by Laplace's method (device side).

Under a hypothesis the expected spectrum is a sum of columns (the background's amplitude and tilt; of each source its
spectrum behind a wall, more or fewer scattered photons, and those of air or of the ground beside), at a gain and a
relative width of peaks of its own. Columns are polynomials in both (`swarmsim.radiation.lines.orders`). Fisher scoring
finds the maximum of Poisson likelihood times prior; the evidence is that maximum times the volume of the posterior over
that of the prior (Kass and Raftery, J. Am. Stat. Assoc. 90, 1995, 773, eq. 4), so that no parameter is merely fitted.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from swarmsim.radiation.detector import Detector
from swarmsim.radiation.goodness import deviance

NATURAL = 2  # columns of the background: amplitude and tilt
SOURCES = 3  # sources of a hypothesis at most
PARTS = 3  # columns of a source: behind its wall, more or fewer scattered photons there, and of other matter
COLUMNS = NATURAL + SOURCES * PARTS
GAIN_STD, WIDTH_STD = 0.02, 0.1  # of the prior of gain and width
GAIN_RANGE, WIDTH_RANGE = (0.965, 1.035), (-0.14, 0.16)
NATURAL_STD, TILT_STD = 0.4, 0.1  # of the prior of the background's amplitude and tilt, relative
PART_STD = 0.5  # of the prior of scattered photons, relative to the source
_GAIN_REACH = 0.009  # from the gain of the tables about which columns are expanded
_LEAST_PART = -0.9  # fewest scattered photons, relative to those of the templates: less than all of them
_ITERATIONS = 6
_LOOSE = 0.01  # precision that stands for the prior of a strength while it is fitted
_TEMPLATE_ERROR = 0.04  # relative error of the templates in a bin: an estimate
_STRENGTH_SCALE = 0.3  # scale of the half-Cauchy prior of a source's strength, in units of the background
FAILED = -1e6  # score of a fit that came to nothing
_COUNTS_FLOOR = 0.02  # per bin: keeps the information finite where almost no counts are expected


class Data(NamedTuple):
    """What is fitted."""

    counts: jax.Array  # [bins]
    certainty: jax.Array  # [bins] weight of each bin for the error of the templates
    natural: jax.Array  # [] expected counts of the background
    scale: jax.Array  # [] counts, scale of the prior of a source's strength


class Hypothesis(NamedTuple):
    """One hypothesis; a column without a scale is absent."""

    column: jax.Array  # [COLUMNS, ORDERS, bins] by gain about `gain`, and by width
    scale: jax.Array  # [COLUMNS] counts, standard deviation of the prior of each part, about that of each strength
    strength: jax.Array  # [COLUMNS] 1 for strengths, which are positive and have a prior of their own
    start: jax.Array  # [COLUMNS] counts
    gain: jax.Array  # []


class Fit(NamedTuple):
    """A fitted hypothesis."""

    score: jax.Array  # [] logarithm of the evidence
    counts: jax.Array  # [COLUMNS]
    gain: jax.Array  # []
    time: jax.Array  # [] (width^2 - 1) / 2
    expected: jax.Array  # [bins]


def binned_data(detector: Detector, counts: jax.Array, live_s: jax.Array) -> Data:
    """The data of a spectrum ``counts`` [channels] of ``live_s`` [] seconds."""
    # bin by bin: differences of a running sum lose the counts of small bins beside those of ten million in others
    edges = np.asarray(detector.identification_bins)
    bin_of = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
    inside = counts[edges[0] : edges[-1]]
    binned = jax.ops.segment_sum(inside, bin_of, len(edges) - 1, indices_are_sorted=True)
    natural = jnp.maximum(detector.background_cps, 1.0) * jnp.maximum(live_s, 1e-3)
    return Data(
        counts=binned,
        certainty=1.0 / (1.0 + _TEMPLATE_ERROR**2 * binned),
        natural=natural,
        scale=_STRENGTH_SCALE * natural,
    )


def evaluated(
    column: jax.Array, counts: jax.Array, offset: jax.Array, time: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Columns [COLUMNS, bins] at a gain ``offset`` [] and a width ``time`` [], and the slopes [bins] of their sum."""
    # products and sums one by one: on a CPU several times as fast as contractions of so small a size
    shape = column[:, 0] + offset * column[:, 1] + offset**2 * column[:, 2]
    shape += time * column[:, 3] + time**2 * column[:, 4]
    weighted = counts[:, None, None] * column[:, 1:]
    by_order = jnp.sum(weighted, axis=0)
    by_gain = by_order[0] + 2.0 * offset * by_order[1]
    return shape, by_gain, by_order[2] + 2.0 * time * by_order[3]


def laplace(hypothesis: Hypothesis, data: Data) -> Fit:
    """Fit and evidence of one hypothesis."""
    column, scale, strength, start, middle = hypothesis
    mean = jnp.zeros(COLUMNS).at[0].set(data.natural)
    precision = jnp.concatenate([jnp.where(strength > 0.0, _LOOSE, 1.0), jnp.ones(2)])
    present = (scale > 0.0).astype(jnp.float32)
    # strengths and the scattered photons among them are not negative
    low = jnp.where(strength > 0.0, 0.0, _LEAST_PART / PART_STD)
    low = low.at[:NATURAL].set(jnp.array([-0.9 / NATURAL_STD, -jnp.inf]))

    def values(x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Counts [COLUMNS], offset of the gain [] and width []."""
        return mean + scale * x[:COLUMNS], 1.0 + GAIN_STD * x[-2] - middle, WIDTH_STD * x[-1]

    def model(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Expected counts [bins] and their slopes [COLUMNS + 2, bins]."""
        counts, offset, time = values(x)
        shape, by_gain, by_width = evaluated(column, counts, offset, time)
        slope = jnp.concatenate([scale[:, None] * shape, GAIN_STD * by_gain[None], WIDTH_STD * by_width[None]])
        return jnp.maximum(counts @ shape, _COUNTS_FLOOR * 0.1), slope

    def information(expected: jax.Array, slope: jax.Array) -> jax.Array:
        weight = data.certainty / (expected + _COUNTS_FLOOR)
        return (slope * weight) @ slope.T + jnp.diag(precision)

    reach = jnp.array([middle - _GAIN_REACH, middle + _GAIN_REACH]).clip(*GAIN_RANGE)
    least = jnp.concatenate([low, (reach[:1] - 1.0) / GAIN_STD, jnp.array([WIDTH_RANGE[0] / WIDTH_STD])])
    most = jnp.concatenate(
        [jnp.full(COLUMNS, jnp.inf), (reach[1:] - 1.0) / GAIN_STD, jnp.array([WIDTH_RANGE[1] / WIDTH_STD])]
    )

    def step(x: jax.Array, _: None) -> tuple[jax.Array, None]:
        expected, slope = model(x)
        gradient = slope @ (data.certainty * (data.counts / expected - 1.0)) - precision * x
        # a parameter at its bound that would leave it stays there
        free = ~(((x <= least) & (gradient < 0.0)) | ((x >= most) & (gradient > 0.0)))
        inside = free.astype(jnp.float32)
        matrix = information(expected, slope) * inside[:, None] * inside + jnp.diag(1.0 - inside)
        change = swept(matrix)[0] @ (gradient * inside)
        return jnp.clip(x + jnp.clip(change, -3.0, 3.0), least, most), None

    counts_0 = jnp.where(scale > 0.0, (start - mean) / jnp.maximum(scale, 1e-9), 0.0)
    x_0 = jnp.concatenate([counts_0, jnp.stack([(middle - 1.0) / GAIN_STD, jnp.zeros(())])])
    x = jax.lax.scan(step, jnp.clip(x_0, least, most), None, length=_ITERATIONS)[0]
    expected, slope = model(x)
    inverse, log_volume = swept(information(expected, slope))
    deviation = jnp.sqrt(jnp.maximum(jnp.diagonal(inverse), 1e-12))[:COLUMNS]
    counts, offset, time = values(x)
    prior = jnp.where(strength > 0.0, _log_strength(counts, scale, deviation, data), -0.5 * x[:COLUMNS] ** 2)
    score = -0.5 * jnp.sum(data.certainty * deviance(data.counts, expected)) + jnp.sum(present * prior)
    score -= 0.5 * jnp.sum(x[-2:] ** 2) + 0.5 * log_volume
    # the matrix has the loose precision where a column is absent
    score += 0.5 * jnp.sum((1.0 - present) * jnp.log(precision[:COLUMNS]))
    # columns that are as good as alike can lead the steps away, to where nothing is expected
    sound = jnp.isfinite(score) & jnp.all(jnp.isfinite(counts)) & jnp.all(jnp.isfinite(expected))
    return Fit(
        score=jnp.where(sound, score, FAILED),
        counts=jnp.where(sound, counts, start),
        gain=jnp.where(sound, offset + middle, middle),
        time=jnp.where(sound, time, 0.0),
        expected=jnp.where(sound, expected, jnp.maximum(start @ column[:, 0], _COUNTS_FLOOR * 0.1)),
    )


def swept(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Inverse [k, k] and logarithm [] of the determinant of a positive definite matrix, by the sweep operator.

    Under vmap on a CPU many times as fast as factorisations, which are calls of LAPACK for each (Goodnight, The
    American Statistician 33, 1979, 149).
    """
    size = matrix.shape[0]
    places = jnp.arange(size)

    def step(carry: tuple[jax.Array, jax.Array], k: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
        matrix, log_determinant = carry
        here = (places == k).astype(jnp.float32)
        others = 1.0 - here
        pivot = jnp.maximum(matrix[k, k], 1e-6)
        column, row = here - matrix[:, k] * others, here + matrix[k] * others
        rest = matrix * others * others[:, None]
        return (rest + column[:, None] * row / pivot, log_determinant + jnp.log(pivot)), None

    (inverse, log_determinant), _ = jax.lax.scan(step, (matrix, jnp.zeros(())), places)
    return inverse, log_determinant


def _log_strength(counts: jax.Array, scale: jax.Array, deviation: jax.Array, data: Data) -> jax.Array:
    """Logarithm [COLUMNS] of the half-Cauchy prior of strengths times their posterior's part that is positive.

    In units of ``scale`` and of the volume sqrt(2 pi) of a normal prior; ``deviation`` is in units of ``scale`` too.
    """
    density = 2.0 / (jnp.pi * data.scale * (1.0 + (counts / data.scale) ** 2))
    inside = ndtr(counts / jnp.maximum(scale * deviation, 1e-9))
    return jnp.log(jnp.maximum(density * scale * np.sqrt(2.0 * np.pi) * inside, 1e-30))


def log_occam(strength: jax.Array, information: jax.Array, scale: jax.Array) -> jax.Array:
    """Logarithm [...] of the Occam factor of strengths [...] (counts) of an ``information`` [...], alone.

    The half-Cauchy prior of ``scale`` times the posterior's volume, but never more than the whole prior.
    """
    density = 2.0 / (jnp.pi * scale * (1.0 + (strength / scale) ** 2))
    width = jnp.sqrt(2.0 * jnp.pi / (information + (0.5 / scale) ** 2))
    return jnp.log(jnp.clip(density * width * ndtr(strength * jnp.sqrt(information)), 1e-30, 1.0))
