"""Fits of sums of template spectra to a spectrum, at any gain and resolution (device side).

A hypothesis is a set of nuclides. Its spectrum is a non-negative sum of the background's templates (amplitude and tilt
free) and of those of its nuclides behind walls and air (`swarmsim.radiation.templates`), at a gain and a relative width
of peaks of its own. Expectation maximisation finds the Poisson likelihood's maximum in the weights; Fisher scoring,
between its iterations, that in gain and width. Templates at any gain and width are interpolated in tables:
quadratically between three gains, and between three widths, in which they are quadratic (`templates.widened`).
"""

import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from swarmsim.radiation.detector import Detector
from swarmsim.radiation.goodness import deviance
from swarmsim.radiation.templates import NATURAL, Templates, rebinned, widened

_GAIN_SPACING = 0.005
GAINS = tuple(0.97 + _GAIN_SPACING * step for step in range(13))
"""Gains of the tables; fitted gains lie between the first and the last."""
WIDTHS = (0.85, 1.0, 1.15)
"""Relative widths of peaks of the tables; fitted widths lie between the first and the last."""
_ITERATIONS = 40  # of the fits that find the best hypotheses
_ROUNDS, _ROUND_ITERATIONS = 5, 25  # of the final fits: steps of gain and width, iterations of the weights before each
_LAST_ITERATIONS = 60  # of the weights after them
_GAIN_STEP, _WIDTH_STEP = 0.006, 0.08  # largest steps
_RELAXATION = 1.6  # exponent of the multiplicative step; below 2 it still converges and needs fewer steps
_TEMPLATE_ERROR = 0.04  # relative error of the templates in a bin: an estimate
_STRENGTH_SCALE = 0.3  # scale of the half-Cauchy prior of a source's strength, in units of the background
_COUNTS_FLOOR = 0.05  # per bin: keeps the information finite where almost no counts are expected


class Binned(NamedTuple):
    """Templates in the bins of identification."""

    background: jax.Array  # [gains, widths, 2, bins]
    nuclides: jax.Array  # [gains, widths, N, S, bins]
    lines: jax.Array  # [gains, grid, bins] free lines of the detector's own width


class Data(NamedTuple):
    """What is fitted."""

    counts: jax.Array  # [bins]
    certainty: jax.Array  # [bins] weight of each bin for the error of the templates
    natural: jax.Array  # [] expected counts of the background
    scale: jax.Array  # [] counts, scale of the prior of a source's strength


class Fits(NamedTuple):
    """Fits of H hypotheses, in which every nuclide has templates, of weight 0 where it is not a member."""

    score: jax.Array  # [H] logarithm of likelihood and Occam factors
    background: jax.Array  # [H, 2] counts
    weights: jax.Array  # [H, N, S] counts
    members: jax.Array  # [H, N] 1 for the nuclides of the hypothesis, else 0
    gain: jax.Array  # [H]
    width: jax.Array  # [H]

    def at(self, rows: jax.Array) -> "Fits":
        """Some of the hypotheses."""
        return jax.tree.map(lambda leaf: leaf[rows], self)


def binned_data(detector: Detector, counts: jax.Array, live_s: jax.Array) -> Data:
    """The data of a spectrum ``counts`` [channels] of ``live_s`` [] seconds."""
    binned = jnp.diff(jnp.pad(jnp.cumsum(counts), (1, 0))[np.asarray(detector.identification_bins)])
    return Data(
        counts=binned,
        certainty=1.0 / (1.0 + _TEMPLATE_ERROR**2 * binned),
        natural=detector.background_cps * live_s,
        scale=_STRENGTH_SCALE * jnp.maximum(detector.background_cps, 1.0) * jnp.maximum(live_s, 1e-3),
    )


def binned_templates(detector: Detector, fine: Templates) -> Binned:
    """Templates in the bins, at every gain and width of the tables."""
    edges, gains = np.asarray(detector.identification_bins), jnp.asarray(GAINS)

    def at(spectra: jax.Array, width: float) -> jax.Array:
        wide = spectra if width == 1.0 else widened(detector, spectra, jnp.float32(width))
        return jax.vmap(lambda gain: rebinned(detector, wide, gain, edges))(gains)

    background = jnp.stack([at(fine.background, width) for width in WIDTHS], axis=1)
    nuclides = jnp.stack([at(fine.nuclides, width) for width in WIDTHS], axis=1)
    return Binned(background, nuclides, at(fine.lines, 1.0))


def fit(binned: Binned, data: Data, nuclide: jax.Array, gain: jax.Array, width: jax.Array) -> Fits:
    """Fits of H hypotheses of the nuclides [H, M] at a gain [H] and a width [H]."""
    shape = jax.vmap(lambda *at: _shapes(binned, *at))(nuclide, gain, width)
    return _scored(binned, data, shape, maximise(shape, data, _ITERATIONS), nuclide, gain, width)


def refine(binned: Binned, data: Data, nuclide: jax.Array, gain: jax.Array, width: jax.Array) -> Fits:
    """Fits of H hypotheses of the nuclides [H, M] at the best gain and width near ``gain`` [H] and ``width`` [H]."""
    weights, gain, width = jax.vmap(lambda *start: _refined(binned, data, *start))(nuclide, gain, width)
    shape = jax.vmap(lambda *at: _shapes(binned, *at))(nuclide, gain, width)
    return _scored(binned, data, shape, weights, nuclide, gain, width)


def _refined(
    binned: Binned, data: Data, nuclide: jax.Array, gain: jax.Array, width: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Weights [2 + M S], gain [] and width [] of the best fit of the nuclides [M]."""
    low, high = jnp.array([GAINS[0], WIDTHS[0]]), jnp.array([GAINS[-1], WIDTHS[-1]])
    largest = jnp.array([_GAIN_STEP, _WIDTH_STEP])

    def step(carry: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], None]:
        scale, weights = carry
        shape = _shapes(binned, nuclide, *scale)
        weights = maximise(shape, data, _ROUND_ITERATIONS, weights)
        expected = jnp.maximum(weights @ shape, 1e-9)
        slope = jax.jacfwd(lambda at: weights @ _shapes(binned, nuclide, *at))(scale)  # [bins, 2]
        information = slope.T @ (slope * (data.certainty / (expected + _COUNTS_FLOOR))[:, None])
        information += jnp.diag(1.0 / largest**2)  # keeps a step small where the data tell nothing
        gradient = slope.T @ (data.certainty * (data.counts / expected - 1.0))
        (a, b), (_, c) = information
        solved = jnp.stack([c * gradient[0] - b * gradient[1], a * gradient[1] - b * gradient[0]]) / (a * c - b * b)
        change = jnp.clip(solved, -largest, largest)
        return (jnp.clip(scale + change, low, high), weights), None

    scale = jnp.stack([gain, width])
    start = _start(_shapes(binned, nuclide, gain, width), data)
    scale, weights = jax.lax.scan(step, (scale, start), None, length=_ROUNDS)[0]
    shape = _shapes(binned, nuclide, *scale)
    return maximise(shape, data, _LAST_ITERATIONS, weights), scale[0], scale[1]


def expected_counts(binned: Binned, best: Fits) -> jax.Array:
    """Expected counts [bins] of one hypothesis."""
    every = jnp.arange(binned.nuclides.shape[2])
    shape = _shapes(binned, every, best.gain, best.width)
    return jnp.maximum(jnp.concatenate([best.background, best.weights.ravel()]) @ shape, 1e-9)


def _shapes(binned: Binned, nuclide: jax.Array, gain: jax.Array, width: jax.Array) -> jax.Array:
    """Templates [2 + M S, bins] of the background and the nuclides [M] at a gain [] and a width []."""
    place = (gain - GAINS[0]) / _GAIN_SPACING
    middle = jnp.clip(jnp.round(place).astype(jnp.int32), 1, len(GAINS) - 2)
    by_gain = _lagrange(place - middle, [-1.0, 0.0, 1.0])
    by_width = _lagrange(0.5 * (width**2 - 1.0), [0.5 * (w * w - 1.0) for w in WIDTHS])
    # rows of a matrix, added up one by one: on a CPU tens of times as fast as gathered and contracted
    gains, widths, n, each, bins = binned.nuclides.shape
    rows = binned.nuclides.reshape(gains * widths * n, each * bins)
    natural, sources = jnp.zeros((NATURAL, bins)), jnp.zeros((nuclide.shape[0], each * bins))
    for i, j in itertools.product(range(3), range(widths)):
        at, share = (middle + i - 1) * widths + j, by_gain[i] * by_width[j]
        natural += share * binned.background.reshape(gains * widths, NATURAL, bins)[at]
        sources += share * rows[at * n + nuclide]
    return jnp.maximum(jnp.concatenate([natural, sources.reshape(nuclide.shape[0] * each, bins)]), 0.0)


def _lagrange(place: jax.Array, nodes: list[float]) -> jax.Array:
    """Weights [nodes] of the interpolating polynomial at a place []."""
    return jnp.stack(
        [math.prod((place - other) / (node - other) for other in nodes if other != node) for node in nodes]
    )


def _scored(
    binned: Binned,
    data: Data,
    shape: jax.Array,
    weights: jax.Array,
    nuclide: jax.Array,
    gain: jax.Array,
    width: jax.Array,
) -> Fits:
    """Scores of fitted hypotheses of the nuclides [H, M] with ``weights`` [H, 2 + M S] of templates ``shape``."""
    n, each = binned.nuclides.shape[2:4]
    rows, count = nuclide.shape
    expected = jnp.einsum("ht,htb->hb", weights, shape)
    score = -0.5 * loss(shape, weights, data)
    by_nuclide = weights[:, NATURAL:].reshape(rows, count, each)
    shapes = shape[:, NATURAL:].reshape(rows, count, each, shape.shape[-1])
    score += jnp.sum(log_occam(shapes, by_nuclide, data, expected[:, None]), axis=1)
    index = jnp.arange(rows)[:, None]
    return Fits(
        score=score,
        background=weights[:, :NATURAL],
        weights=jnp.zeros((rows, n, each)).at[index, nuclide].add(by_nuclide),
        members=jnp.zeros((rows, n)).at[index, nuclide].set(1.0),
        gain=gain,
        width=width,
    )


def maximise(shape: jax.Array, data: Data, iterations: int, start: jax.Array | None = None) -> jax.Array:
    """Counts [..., T] of templates [..., T, bins], of which the first are the background, by relaxed EM."""
    seen = jnp.maximum(jnp.sum(shape, axis=-1), 1e-9)

    def step(weights: jax.Array, _: None) -> tuple[jax.Array, None]:
        expected = jnp.einsum("...t,...tb->...b", weights, shape)
        ratio = data.counts / jnp.maximum(expected, 1e-9)
        return weights * (jnp.einsum("...b,...tb->...t", ratio, shape) / seen) ** _RELAXATION, None

    return jax.lax.scan(step, _start(shape, data) if start is None else start, None, length=iterations)[0]


def _start(shape: jax.Array, data: Data) -> jax.Array:
    """Counts [..., T] with which a fit of templates [..., T, bins] starts."""
    total = jnp.maximum(jnp.sum(data.counts), 1e-6)
    natural = jnp.clip(data.natural, 0.05 * total, total)
    sources = max(shape.shape[-2] - NATURAL, 1)
    start = jnp.full(shape.shape[:-1], jnp.maximum(total - natural, 0.05 * total) / sources)
    return start.at[..., :NATURAL].set(natural / NATURAL)


def loss(shape: jax.Array, weights: jax.Array, data: Data) -> jax.Array:
    """Deviance [...] of fits, reduced for the error of the templates."""
    expected = jnp.maximum(jnp.einsum("...t,...tb->...b", weights, shape), 1e-9)
    return jnp.sum(data.certainty * deviance(data.counts, expected), axis=-1)


def log_occam(shape: jax.Array, weights: jax.Array, data: Data, expected: jax.Array) -> jax.Array:
    """Logarithm [...] of the Occam factor of a strength (counts) with a half-Cauchy prior.

    Laplace approximation about the fitted strength, truncated at zero, of sources of fitted ``weights`` [..., S] of
    templates [..., S, bins] where ``expected`` [..., bins] counts are expected in all.
    """
    strength, scale = jnp.sum(weights, axis=-1), data.scale
    mixed = jnp.einsum("...s,...sb->...b", weights + 1e-6, shape) / (strength + 1e-6 * shape.shape[-2])[..., None]
    information = jnp.sum(data.certainty * mixed**2 / (expected + _COUNTS_FLOOR), axis=-1)
    density = 2.0 / (jnp.pi * scale * (1.0 + (strength / scale) ** 2))
    width = jnp.sqrt(2.0 * jnp.pi / (information + (0.5 / scale) ** 2))
    return jnp.log(jnp.clip(density * width * ndtr(strength * jnp.sqrt(information)), 1e-30, 1.0))
