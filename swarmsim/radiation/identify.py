"""Bayesian identification of the nuclides in a spectrum (device side).

The hypotheses: background only; one nuclide; two or three nuclides; something that the library does not hold, which is
any non-negative sum of lines of the detector's own shape. Under each, the spectrum is a non-negative sum of templates:
the background (amplitude and tilt free), and for each nuclide its spectrum bare, above the ground, in air, and behind
concrete, steel and lead (`swarmsim.radiation.templates`). All nuclides are fitted alone; each other is added to the
best two, and a third to the best pair. The best of each number are fitted at a gain and a resolution of their own
(`swarmsim.radiation.fits`): those of one nuclide that is fitted to a mixture are not those of the mixture.
Posterior = likelihood x Occam factor of each source's strength x prior, where each bin's deviance is reduced to account
for the error of the templates. Free lines fit better than the truth does, by about a chi-squared number whose degrees
of freedom grow with the lines that the resolution separates; they are charged for it.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.pytree import pytree
from swarmsim.radiation.detector import Detector
from swarmsim.radiation.fits import (
    GAINS,
    WIDTHS,
    Binned,
    Data,
    Fits,
    binned_data,
    binned_templates,
    expected_counts,
    fit,
    log_occam,
    loss,
    maximise,
    refine,
)
from swarmsim.radiation.goodness import p_value
from swarmsim.radiation.templates import NATURAL, Templates, rebinned, templates, widened

NONE, UNKNOWN = -1, -2
"""What `Identification.nuclide` is where no nuclide is named: background only, or a source not in the library."""
_COARSE = 2  # every so many gains of the tables all nuclides are fitted
_FREE_GAINS = (2, 6, 10)  # of GAINS, at which free lines are fitted: their energies are free anyway
CANDIDATES = 5  # best single nuclides, which are fitted to the end
REFINED = 4  # best mixtures, which are fitted to the end
FIRSTS = 2  # best single nuclides to which each other is added
# Prior: a hotspot may be natural background, may be no nuclide of the library, and is rarely a mixture.
_PRIOR_NONE, _PRIOR_UNKNOWN, _PRIOR_ONE, _PRIOR_TWO, _PRIOR_THREE = 0.4, 0.1, 0.4, 0.08, 0.02
_SHAPE_ERROR = 0.04  # relative error of a nuclide's whole shape, which free lines do not have: an estimate
_FREE_ITERATIONS = 120
_FREE_MEAN, _FREE_GRID = 48.0, 110
"""By how much the deviance of free lines is smaller than that of the true nuclide, on a grid of so many lines: mean
over random spectra of 300 and 1000 counts of the library behind walls. Its spread there is that of chi-squared."""
_FREE_SIGMAS = 1.75  # by so many standard deviations must it be smaller than that: one in 25 is, by chance
_MODEL_ERROR = 0.015
"""Relative error of an expected spectrum in a bin, for the goodness of fit. Sums of the templates differ from spectra
behind random walls by 4 to 5 % of the source's counts (root mean square over nuclides), a third of which it is of all
counts where the background is twice the source."""


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


def identify(detector: Detector, counts: jax.Array, live_s: jax.Array) -> Identification:
    """Identify the nuclides in ``counts`` [channels] accumulated over ``live_s`` [] seconds.

    With no counts or no live time the posterior is the prior. Only nuclides for which the detector has tables are
    named, and at most three at once. Raises `InputError` for a detector without energy resolution.
    """
    if not detector.identification_bins:
        raise InputError.of("a counter without energy resolution tells no nuclides apart: use a scintillator")
    n = len(detector.nuclide_names)
    fine = templates(detector)
    binned = binned_templates(detector, fine)
    data = binned_data(detector, counts, live_s)
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
    expected = expected_counts(binned, best)
    fitted = 4.0 + 2.0 * jnp.sum(best.members)  # background, tilt, gain and width; strength and shield of each
    return Identification(
        nuclide=jnp.where(named, main, nothing).astype(jnp.int32),
        confidence=jnp.where(named, present[main], jnp.maximum(none, unknown)),
        posterior=present,
        none=none,
        unknown=unknown,
        strength_cps=jnp.sum(best.weights, axis=1) / jnp.maximum(live_s, 1e-3),
        gain=best.gain,
        width=best.width,
        goodness=p_value(data.counts, expected, data.certainty, fitted, _MODEL_ERROR),
        fit=_in_channels(detector, fine, best),
    )


def _background_only(binned: Binned, data: Data) -> Fits:
    """Fit of the background at its best gain and width: one hypothesis."""
    gains = jnp.asarray(GAINS[::_COARSE])
    nothing = jnp.zeros((len(gains), 0), jnp.int32)
    coarse = fit(binned, data, nothing, gains, jnp.ones(len(gains)))
    best = jnp.argmax(coarse.score)[None]
    return refine(binned, data, nothing[:1], coarse.gain[best], coarse.width[best])


def _singles(binned: Binned, data: Data) -> Fits:
    """Fits of each nuclide alone: all at every `_COARSE`-th gain, the best at the best gain and width."""
    n, gains = binned.nuclides.shape[2], jnp.asarray(GAINS[::_COARSE])
    number = jnp.tile(jnp.arange(n), len(gains))[:, None]
    coarse = fit(binned, data, number, jnp.repeat(gains, n), jnp.ones(len(number)))
    best = jnp.argmax(coarse.score.reshape(len(gains), n), axis=0)
    coarse = coarse.at(best * n + jnp.arange(n))
    top = jax.lax.top_k(coarse.score, min(CANDIDATES, n))[1]
    finer = refine(binned, data, top[:, None], coarse.gain[top], coarse.width[top])
    return jax.tree.map(lambda all_of, some: all_of.at[top].set(some), coarse, finer)


def _with_another(binned: Binned, data: Data, firsts: Fits, count: int) -> Fits:
    """Fits of each of ``firsts`` together with each other nuclide, ``count`` in all, the best at their gain and width.

    A set that comes twice, or a nuclide added to itself, has a score of -inf.
    """
    n, rows = firsts.members.shape[1], firsts.members.shape[0]
    first = jax.lax.top_k(firsts.members, count - 1)[1]  # [rows, count - 1]
    chosen = jnp.concatenate([jnp.repeat(first, n, axis=0), jnp.tile(jnp.arange(n), rows)[:, None]], axis=1)
    fits = fit(binned, data, chosen, jnp.repeat(firsts.gain, n), jnp.repeat(firsts.width, n))
    same = jnp.all(fits.members[:, None] == fits.members, axis=-1)
    again = jnp.any(same & (jnp.arange(rows * n)[:, None] > jnp.arange(rows * n)), axis=1)
    few = jnp.sum(fits.members, axis=1) < count
    fits = fits._replace(score=jnp.where(again | few, -jnp.inf, fits.score))
    score, top = jax.lax.top_k(fits.score, min(REFINED, rows * n))
    finer = refine(binned, data, chosen[top], fits.gain[top], fits.width[top])
    finer = finer._replace(score=jnp.where(jnp.isfinite(score), finer.score, -jnp.inf))
    return jax.tree.map(lambda all_of, some: all_of.at[top].set(some), fits, finer)


def _free_lines(binned: Binned, data: Data) -> jax.Array:
    """Score [] of a source of any energies: free lines of the detector's own shape."""
    some = np.array(_FREE_GAINS)
    natural = binned.background[some, WIDTHS.index(1.0)]
    shape = jnp.concatenate([natural, binned.lines[some]], axis=1)
    weights = maximise(shape, data, _FREE_ITERATIONS)
    losses = loss(shape, weights, data)
    best = jnp.argmin(losses)
    sources = weights[best, None, NATURAL:]
    occam = log_occam(shape[best, None, NATURAL:], sources, data, weights[best] @ shape[best])[0]
    freedom = _FREE_MEAN * binned.lines.shape[1] / _FREE_GRID
    charge = freedom + _FREE_SIGMAS * math.sqrt(2.0 * freedom) + _SHAPE_ERROR**2 * jnp.sum(sources)
    return occam - 0.5 * (losses[best] + charge)


def _in_channels(detector: Detector, fine: Templates, best: Fits) -> jax.Array:
    """Expected counts [channels] of one hypothesis."""
    drawn = best.background @ fine.background + jnp.einsum("ns,nsc->c", best.weights, fine.nuclides)
    moved = rebinned(detector, widened(detector, drawn, best.width), best.gain, np.arange(drawn.shape[0] + 1))
    return jnp.where(np.arange(drawn.shape[0]) < detector.identification_bins[0], 0.0, moved)
