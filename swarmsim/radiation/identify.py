"""Bayesian identification of the nuclides in a spectrum (device side).

The hypotheses: background only; one nuclide; two or three nuclides; something that the library does not hold, which is
any non-negative sum of lines of the detector's own shape. Under each, the spectrum is a non-negative sum of templates:
the background (amplitude and tilt free), and for each nuclide its spectrum bare and behind concrete, steel and lead.
Gain and resolution are profiled over a grid. The fits maximise the Poisson likelihood by expectation maximisation.
All nuclides are fitted alone, the best of them at all resolutions; each other is added to the best two, and a third to
the best pair.
Posterior = likelihood x Occam factor of each source's strength x prior, where each bin's deviance is reduced to account
for the error of the templates. Free lines fit better than the truth does, by about a chi-squared number whose degrees
of freedom grow with the lines that the resolution separates; they are charged for it.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from swarmsim.config.errors import InputError
from swarmsim.pytree import pytree
from swarmsim.radiation.detector import Detector
from swarmsim.radiation.goodness import deviance, p_value
from swarmsim.radiation.templates import Templates, rebinned, templates, widened

NONE, UNKNOWN = -1, -2
"""What `Identification.nuclide` is where no nuclide is named: background only, or a source not in the library."""
GAINS = tuple(0.97 + 0.005 * step for step in range(13))
WIDTHS = (0.87, 1.0, 1.13)
_COARSE = 2  # every so many gains all nuclides are fitted, the best ones then at the gains between
_FREE_GAINS = (2, 6, 10)  # of GAINS, at which free lines are fitted: their energies are free anyway
CANDIDATES = 5  # best single nuclides, which are fitted at other gains and resolutions
REFINED = 4  # best mixtures, which are fitted to the end
FIRSTS = 2  # best single nuclides to which each other is added
_ITERATIONS = (40, 120)  # of the fits that find the best hypotheses, of the final fits
_RELAXATION = 1.6  # exponent of the multiplicative step; below 2 it still converges and needs fewer steps
# Prior: a hotspot may be natural background, may be no nuclide of the library, and is rarely a mixture.
_PRIOR_NONE, _PRIOR_UNKNOWN, _PRIOR_ONE, _PRIOR_TWO, _PRIOR_THREE = 0.4, 0.1, 0.4, 0.08, 0.02
_TEMPLATE_ERROR = 0.04  # relative error of the templates in a bin: an estimate
_SHAPE_ERROR = 0.06  # relative error of a nuclide's whole shape, which free lines do not have: an estimate
_STRENGTH_SCALE = 0.3  # scale of the half-Cauchy prior of a source's strength, in units of the background
_COUNTS_FLOOR = 0.05  # per bin: keeps the information finite where almost no counts are expected
_FREE = ((10, 29.0), (120, 55.0))
"""Iterations of a fit of free lines, and by how much its deviance is smaller than that of the true nuclide: mean over
random spectra of the library on a grid of `_FREE_GRID` lines. Few iterations fit the noise less, and more are needed
where there are many counts."""
_FREE_GRID = 110
_FREE_SIGMAS = 1.5  # by so many standard deviations (chi-squared) must it be smaller than that
_NATURAL = 2  # templates of the background, which come first


@pytree
class Identification:
    """Result of `identify`; N nuclides in the order of the detector's ``nuclide_names``."""

    nuclide: jax.Array  # [] int32 nuclide that explains most counts; `NONE` or `UNKNOWN` when none is identified
    confidence: jax.Array  # [] probability of that answer
    posterior: jax.Array  # [N] probability that each nuclide is present
    none: jax.Array  # [] probability of background only
    unknown: jax.Array  # [] probability of a source that no nuclides of the library explain
    strength_cps: jax.Array  # [N] counts per second of each nuclide under the best hypothesis of the library
    gain: jax.Array  # [] fitted energy gain relative to the detector's
    width: jax.Array  # [] fitted width of peaks relative to the detector's
    goodness: jax.Array  # [] p-value of the deviance of the best hypothesis of the library
    fit: jax.Array  # [channels] expected counts of that hypothesis


class _Binned(NamedTuple):
    """Templates in the bins of identification."""

    background: jax.Array  # [gains, widths, 2, bins]
    nuclides: jax.Array  # [gains, widths, N, S, bins]
    lines: jax.Array  # [free gains, grid, bins]


class _Data(NamedTuple):
    """What is fitted."""

    counts: jax.Array  # [bins]
    certainty: jax.Array  # [bins] weight of each bin for the error of the templates
    natural: jax.Array  # [] expected counts of the background
    scale: jax.Array  # [] counts, scale of the prior of a source's strength


class _Fits(NamedTuple):
    """Fits of H hypotheses, in which every nuclide has templates, of weight 0 where it is not a member."""

    score: jax.Array  # [H] logarithm of likelihood and Occam factors
    background: jax.Array  # [H, 2] counts
    weights: jax.Array  # [H, N, S] counts
    members: jax.Array  # [H, N] 1 for the nuclides of the hypothesis, else 0
    gain: jax.Array  # [H] indices into GAINS
    width: jax.Array  # [H] indices into WIDTHS

    def at(self, rows: jax.Array) -> "_Fits":
        """Some of the hypotheses."""
        return jax.tree.map(lambda leaf: leaf[rows], self)


def identify(detector: Detector, counts: jax.Array, live_s: jax.Array) -> Identification:
    """Identify the nuclides in ``counts`` [channels] accumulated over ``live_s`` [] seconds.

    With no counts or no live time the posterior is the prior. Only nuclides for which the detector has tables are
    named, and at most three at once. Raises `InputError` for a detector without energy resolution.
    """
    if not detector.identification_bins:
        raise InputError.of("a counter without energy resolution tells no nuclides apart: use a scintillator")
    n = len(detector.nuclide_names)
    fine = templates(detector)
    binned = _bin(detector, fine)
    data = _data(detector, counts, live_s)
    groups = [(_background_only(binned, data), _PRIOR_NONE, 1), (_singles(binned, data), _PRIOR_ONE, n)]
    for prior, count, firsts in ((_PRIOR_TWO, 2, FIRSTS), (_PRIOR_THREE, 3, 1)):
        if n >= count:
            before = groups[-1][0]
            best = before.at(jax.lax.top_k(before.score, min(firsts, n))[1])
            groups.append((_with_another(binned, data, best, count), prior, math.comb(n, count)))
    library = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *(fits for fits, _, _ in groups))
    priors = np.concatenate([np.full(len(fits.score), math.log(p / number)) for fits, p, number in groups])
    free = _free_lines(binned, data) + math.log(_PRIOR_UNKNOWN)
    chance = jax.nn.softmax(jnp.append(library.score + priors, free))
    present, none, unknown = chance[:-1] @ library.members, chance[0], chance[-1]
    best = library.at(jnp.argmax(library.score + priors))
    strength = jnp.sum(library.weights, axis=2)
    share = strength / jnp.maximum(jnp.sum(strength, axis=1, keepdims=True), 1e-9)
    main = jnp.argmax(chance[:-1] @ (share * library.members))
    nothing = jnp.where(unknown > none, UNKNOWN, NONE)
    named = present[main] > jnp.maximum(none, unknown)
    expected = _expected(binned, best)
    fitted = 2.0 + 2.0 * jnp.sum(best.members)  # background and tilt, strength and shield of each
    return Identification(
        nuclide=jnp.where(named, main, nothing).astype(jnp.int32),
        confidence=jnp.where(named, present[main], jnp.maximum(none, unknown)),
        posterior=present,
        none=none,
        unknown=unknown,
        strength_cps=jnp.sum(best.weights, axis=1) / jnp.maximum(live_s, 1e-3),
        gain=jnp.asarray(GAINS)[best.gain],
        width=jnp.asarray(WIDTHS)[best.width],
        goodness=p_value(data.counts, expected, data.certainty, fitted),
        fit=_in_channels(detector, fine, best),
    )


def _data(detector: Detector, counts: jax.Array, live_s: jax.Array) -> _Data:
    binned = jnp.diff(jnp.pad(jnp.cumsum(counts), (1, 0))[np.asarray(detector.identification_bins)])
    return _Data(
        counts=binned,
        certainty=1.0 / (1.0 + _TEMPLATE_ERROR**2 * binned),
        natural=detector.background_cps * live_s,
        scale=_STRENGTH_SCALE * jnp.maximum(detector.background_cps, 1.0) * jnp.maximum(live_s, 1e-3),
    )


def _bin(detector: Detector, fine: Templates) -> _Binned:
    """Templates in the bins, at every gain and width."""
    edges, gains = np.asarray(detector.identification_bins), jnp.asarray(GAINS)

    def at(spectra: jax.Array, width: float, gains: jax.Array) -> jax.Array:
        wide = spectra if width == 1.0 else widened(detector, spectra, jnp.float32(width))
        return jax.vmap(lambda gain: rebinned(detector, wide, gain, edges))(gains)

    background = jnp.stack([at(fine.background, width, gains) for width in WIDTHS], axis=1)
    nuclides = jnp.stack([at(fine.nuclides, width, gains) for width in WIDTHS], axis=1)
    return _Binned(background, nuclides, at(fine.lines, 1.0, gains[np.array(_FREE_GAINS)]))


def _background_only(binned: _Binned, data: _Data) -> _Fits:
    """Fit of the background at its best gain and width: one hypothesis."""
    gains, widths, n, templates_each, bins = binned.nuclides.shape
    shape = binned.background.reshape(gains * widths, _NATURAL, bins)
    weights = _maximise(shape, data, _ITERATIONS[0])
    loss = _loss(shape, weights, data)
    best = jnp.argmin(loss)
    return _Fits(
        score=-0.5 * loss[best][None],
        background=weights[best][None],
        weights=jnp.zeros((1, n, templates_each)),
        members=jnp.zeros((1, n)),
        gain=(best // widths)[None],
        width=(best % widths)[None],
    )


def _singles(binned: _Binned, data: _Data) -> _Fits:
    """Fits of each nuclide alone: all at every `_COARSE`-th gain, the best at those between and at every width."""
    gains, _, n, _, bins = binned.nuclides.shape
    nominal, coarse_gains = WIDTHS.index(1.0), np.arange(0, gains, _COARSE)
    natural = binned.background[coarse_gains, nominal, None]
    natural = jnp.broadcast_to(natural, (len(coarse_gains), n, _NATURAL, bins))
    shape = jnp.concatenate([natural, binned.nuclides[coarse_gains, nominal]], axis=2)
    weights = _maximise(shape, data, _ITERATIONS[0])
    row, number = jnp.argmin(_loss(shape, weights, data), axis=0), jnp.arange(n)
    gain = _COARSE * row
    coarse = _fits(binned, data, weights[row, number], number[:, None], gain, jnp.full(n, nominal))
    top = jax.lax.top_k(coarse.score, min(CANDIDATES, n))[1]
    moves, widths = (
        jnp.ravel(axis) for axis in jnp.meshgrid(jnp.arange(1 - _COARSE, _COARSE), jnp.arange(len(WIDTHS)))
    )
    tried = jnp.repeat(top, len(moves))
    gain, width = jnp.clip(gain[tried] + jnp.tile(moves, len(top)), 0, gains - 1), jnp.tile(widths, len(top))
    weights = _maximise(_shapes(binned, tried[:, None], gain, width), data, _ITERATIONS[1])
    finer = _fits(binned, data, weights, tried[:, None], gain, width)
    best = jnp.argmax(finer.score.reshape(len(top), len(moves)), axis=1) + jnp.arange(len(top)) * len(moves)
    return jax.tree.map(lambda all_of, some: all_of.at[top].set(some), coarse, finer.at(best))


def _with_another(binned: _Binned, data: _Data, firsts: _Fits, count: int) -> _Fits:
    """Fits of each of ``firsts`` together with each other nuclide, ``count`` in all, at their gain and width.

    A set that comes twice, or a nuclide added to itself, has a score of -inf.
    """
    n, rows = firsts.members.shape[1], firsts.members.shape[0]
    first = jax.lax.top_k(firsts.members, count - 1)[1]  # [rows, count - 1]
    added = jnp.tile(jnp.arange(n), rows)
    chosen = jnp.concatenate([jnp.repeat(first, n, axis=0), added[:, None]], axis=1)
    gain, width = jnp.repeat(firsts.gain, n), jnp.repeat(firsts.width, n)
    weights = _maximise(_shapes(binned, chosen, gain, width), data, _ITERATIONS[0])
    fits = _fits(binned, data, weights, chosen, gain, width)
    same = jnp.all(fits.members[:, None] == fits.members, axis=-1)
    again = jnp.any(same & (jnp.arange(rows * n)[:, None] > jnp.arange(rows * n)), axis=1)
    few = jnp.sum(fits.members, axis=1) < count
    fits = fits._replace(score=jnp.where(again | few, -jnp.inf, fits.score))
    score, top = jax.lax.top_k(fits.score, min(REFINED, rows * n))
    weights = _maximise(_shapes(binned, chosen[top], gain[top], width[top]), data, _ITERATIONS[1])
    finer = _fits(binned, data, weights, chosen[top], gain[top], width[top])
    finer = finer._replace(score=jnp.where(jnp.isfinite(score), finer.score, -jnp.inf))
    return jax.tree.map(lambda all_of, some: all_of.at[top].set(some), fits, finer)


def _free_lines(binned: _Binned, data: _Data) -> jax.Array:
    """Score [] of a source of any energies: free lines of the detector's own shape."""
    natural = binned.background[np.array(_FREE_GAINS), WIDTHS.index(1.0)]
    shape = jnp.concatenate([natural, binned.lines], axis=1)
    scores = []
    for iterations, mean in _FREE:
        weights = _maximise(shape, data, iterations)
        loss = _loss(shape, weights, data)
        best = jnp.argmin(loss)
        sources = weights[best, None, _NATURAL:]
        occam = _log_occam(shape[best, None, _NATURAL:], sources, data, weights[best] @ shape[best])[0]
        freedom = mean * binned.lines.shape[1] / _FREE_GRID
        charge = freedom + _FREE_SIGMAS * math.sqrt(2.0 * freedom) + _SHAPE_ERROR**2 * jnp.sum(sources)
        scores.append(occam - 0.5 * (loss[best] + charge))
    return jnp.max(jnp.stack(scores))


def _shapes(binned: _Binned, nuclide: jax.Array, gain: jax.Array, width: jax.Array) -> jax.Array:
    """Templates [H, 2 + M S, bins] of hypotheses of the nuclides [H, M]."""
    natural = binned.background[gain, width]
    sources = binned.nuclides[gain[:, None], width[:, None], nuclide]
    return jnp.concatenate([natural, sources.reshape(len(gain), -1, natural.shape[-1])], axis=1)


def _fits(
    binned: _Binned, data: _Data, weights: jax.Array, nuclide: jax.Array, gain: jax.Array, width: jax.Array
) -> _Fits:
    """Scores of fitted hypotheses of the nuclides [H, M] with ``weights`` [H, 2 + M S]."""
    n, each = binned.nuclides.shape[2:4]
    shape = _shapes(binned, nuclide, gain, width)
    rows, count = nuclide.shape
    expected = jnp.einsum("ht,htb->hb", weights, shape)
    score = -0.5 * _loss(shape, weights, data)
    by_nuclide = weights[:, _NATURAL:].reshape(rows, count, each)
    shapes = shape[:, _NATURAL:].reshape(rows, count, each, -1)
    score += jnp.sum(_log_occam(shapes, by_nuclide, data, expected[:, None]), axis=1)
    index = jnp.arange(rows)[:, None]
    return _Fits(
        score=score,
        background=weights[:, :_NATURAL],
        weights=jnp.zeros((rows, n, each)).at[index, nuclide].add(by_nuclide),
        members=jnp.zeros((rows, n)).at[index, nuclide].set(1.0),
        gain=gain,
        width=width,
    )


def _maximise(shape: jax.Array, data: _Data, iterations: int) -> jax.Array:
    """Counts [..., T] of templates [..., T, bins], of which the first are the background, by relaxed EM."""
    total = jnp.maximum(jnp.sum(data.counts), 1e-6)
    natural = jnp.clip(data.natural, 0.05 * total, total)
    sources = max(shape.shape[-2] - _NATURAL, 1)
    start = jnp.full(shape.shape[:-1], jnp.maximum(total - natural, 0.05 * total) / sources)
    start = start.at[..., :_NATURAL].set(natural / _NATURAL)
    seen = jnp.maximum(jnp.sum(shape, axis=-1), 1e-9)

    def step(weights: jax.Array, _: None) -> tuple[jax.Array, None]:
        expected = jnp.einsum("...t,...tb->...b", weights, shape)
        ratio = data.counts / jnp.maximum(expected, 1e-9)
        return weights * (jnp.einsum("...b,...tb->...t", ratio, shape) / seen) ** _RELAXATION, None

    return jax.lax.scan(step, start, None, length=iterations)[0]


def _loss(shape: jax.Array, weights: jax.Array, data: _Data) -> jax.Array:
    """Deviance [...] of fits, reduced for the error of the templates."""
    expected = jnp.maximum(jnp.einsum("...t,...tb->...b", weights, shape), 1e-9)
    return jnp.sum(data.certainty * deviance(data.counts, expected), axis=-1)


def _log_occam(shape: jax.Array, weights: jax.Array, data: _Data, expected: jax.Array) -> jax.Array:
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


def _expected(binned: _Binned, fit: _Fits) -> jax.Array:
    """Expected counts [bins] of one hypothesis."""
    sources = jnp.einsum("ns,nsb->b", fit.weights, binned.nuclides[fit.gain, fit.width])
    return jnp.maximum(fit.background @ binned.background[fit.gain, fit.width] + sources, 1e-9)


def _in_channels(detector: Detector, fine: Templates, fit: _Fits) -> jax.Array:
    """Expected counts [channels] of one hypothesis."""
    drawn = fit.background @ fine.background + jnp.einsum("ns,nsc->c", fit.weights, fine.nuclides)
    wide = widened(detector, drawn, jnp.asarray(WIDTHS)[fit.width])
    moved = rebinned(detector, wide, jnp.asarray(GAINS)[fit.gain], np.arange(wide.shape[0] + 1))
    return jnp.where(np.arange(wide.shape[0]) < detector.identification_bins[0], 0.0, moved)
