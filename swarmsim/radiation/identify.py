"""Bayesian identification of the nuclides in a spectrum (device side).

The hypotheses: background only; one nuclide, behind one shield or two; two or three nuclides; a stranger, which is a
nuclide that is known of but not looked for (`swarmsim.radiation.strangers`), or else a few lines of any energies. A
nuclide is bare, above the ground, or behind one of many shields (water, concrete, steel, lead of some depth, air), with
more or fewer scattered photons than that would make, and some of air or of the ground besides; lines are behind shields
too.
The evidence of each hypothesis is the mean of the likelihood over shields, strengths, gain, resolution and background
(`swarmsim.radiation.laplace`), so that what explains more spectra is not preferred for fitting one of them.
Posterior = evidence x prior, where each bin's deviance is reduced to account for the error of the templates.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from swarmsim.config.errors import InputError
from swarmsim.pytree import pytree
from swarmsim.radiation.detector import Detector
from swarmsim.radiation.goodness import p_value
from swarmsim.radiation.laplace import COLUMNS, GAIN_STD, NATURAL, PARTS, SOURCES, Data, Fit, binned_data, laplace
from swarmsim.radiation.lines import GAINS
from swarmsim.radiation.pursuit import (
    Found,
    Sources,
    bin_weights,
    known_strangers,
    lines_of_strangers,
    natural_slopes,
    of_library,
    screen,
    strengths,
    with_new,
)
from swarmsim.radiation.templates import Tables, shield_shares, stranger_shares, tables

NONE, UNKNOWN = -1, -2
"""What `Identification.nuclide` is where no nuclide is named: background only, or a source not in the library."""
CANDIDATES = 10  # sources that are fitted in full at each stage
_SHIELDS_EACH = 3  # of one nuclide among them
# Prior: a hotspot may be natural background, may be no nuclide of the library, and is rarely a mixture.
_PRIOR_NONE, _PRIOR_ONE, _PRIOR_TWO, _PRIOR_THREE = 0.4, 0.36, 0.08, 0.02
_PRIOR_AGAIN = 0.04  # of one nuclide that the way sees behind two shields, or behind a mixed one
_PRIOR_KNOWN, _PRIOR_LINES = 0.07, 0.03  # of a stranger that is known of, and of one that is not
_BASE_SIZE = (0, 1, 1, 2)  # nuclides of the base of each stage
_MODEL_ERROR = 0.015
"""Relative error of an expected spectrum in a bin, for the goodness of fit: an estimate."""

COUNTS_MOST = 1e6  # of a spectrum that are used


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
    stranger: jax.Array  # [] int32 index into the detector's ``known_names``: the likeliest one that is not looked for
    alike: jax.Array  # [] probability that it is that one, if it is unknown


class _Base(NamedTuple):
    """A fitted hypothesis of the library."""

    sources: Sources
    fit: Fit
    log_prior: jax.Array  # [] of the shields of its sources, and of the number of others that fit about as well


class _Stage(NamedTuple):
    """Hypotheses of a base and one nuclide more."""

    score: jax.Array  # [N] logarithm of the evidence of each
    base: jax.Array  # [N] 1 for the nuclides of the base
    best: _Base  # the best of them all
    share: jax.Array  # [2, N] counts of each nuclide of the base, and of any nuclide that is added, over all of both
    base_fit: Fit


class _Strangers(NamedTuple):
    """What a source that is not looked for explains."""

    known: jax.Array  # [] logarithm of the evidence of those that are known of
    lines: jax.Array  # [] of lines of any energies
    nuclide: jax.Array  # [] int32, the likeliest of the former
    share: jax.Array  # [] of the evidence of the former that is its own


def identify(detector: Detector, counts: jax.Array, live_s: jax.Array, view: jax.Array | None = None) -> Identification:
    """Identify the nuclides in ``counts`` [channels] accumulated over ``live_s`` [] seconds.

    ``view`` is how the crystal saw the source (`swarmsim.radiation.rate.mean_view`), by default from far away, end on:
    from the side or close by, soft photons count more than hard ones.

    Of more than `COUNTS_MOST` counts a part is used. Without live time and counts the posterior is the prior. Of what
    is no spectrum (numbers below zero or none, counts without live time) the answer is `UNKNOWN`, with a confidence and
    a goodness of 0. Only nuclides for which the detector has tables are named, and at most three at once. Raises
    `InputError` for a detector without energy resolution, and for another number of channels than the detector's.
    """
    if not detector.identification_bins:
        raise InputError.of("a counter without energy resolution tells no nuclides apart: use a scintillator")
    channels = detector.energy_kev.shape
    if jnp.shape(counts) != channels:
        raise InputError.of(f"the spectrum has the shape {jnp.shape(counts)}, and the detector's {channels} (channels)")
    n = len(detector.nuclide_names)
    sound = jnp.all(jnp.isfinite(counts) & (counts >= 0)) & jnp.isfinite(live_s)
    sound &= (live_s > 0.0) | (jnp.sum(counts) == 0)
    counts, live_s = jnp.where(sound, counts, 0.0), jnp.where(sound, live_s, 0.0)
    # more counts tell nothing beside the model's error, and sums of them lose what tells hypotheses apart in float32
    part = COUNTS_MOST / jnp.maximum(jnp.sum(counts), COUNTS_MOST)
    counts, live_s = part * counts, part * live_s
    table, data = tables(detector, view), binned_data(detector, counts, live_s)
    strangers = _strangers(detector, table, data)
    stages = _stages(table, data, jnp.asarray(np.log(shield_shares(detector)), jnp.float32), n)
    prior = (
        _PRIOR_ONE / n,
        *(p / max(math.comb(n, k), 1) for p, k in ((0.5 * _PRIOR_TWO, 2),) * 2 + ((_PRIOR_THREE, 3),)),
    )
    log_prior = np.log([p if n > k else 1e-30 for p, k in zip(prior, _BASE_SIZE, strict=True)])
    score = stages.score + log_prior[:, None]  # [stages, N]
    none = stages.base_fit.score[0] + math.log(_PRIOR_NONE)
    known, lines = strangers.known + math.log(_PRIOR_KNOWN), strangers.lines + math.log(_PRIOR_LINES)
    unknown = jnp.logaddexp(known, lines)
    chance = jax.nn.softmax(jnp.concatenate([score.ravel(), jnp.stack([none, unknown])]))
    added, none_chance, unknown_chance = chance[:-2].reshape(score.shape), chance[-2], chance[-1]
    of_base = jnp.sum(added, axis=1)
    present = _present(added, stages.base)
    main = jnp.argmax(of_base @ stages.share[:, 0] + jnp.sum(added * stages.share[:, 1], axis=0))
    nothing = jnp.where(unknown_chance > none_chance, UNKNOWN, NONE)
    other = jnp.maximum(none_chance, unknown_chance)
    named = present[main] > other
    value = jnp.append(stages.best.fit.score + stages.best.log_prior + log_prior, none)
    last = jnp.argmax(value)
    fits = jax.tree.map(lambda a, b: jnp.concatenate([a, b[:1]]), stages.best.fit, stages.base_fit)
    nobody = jax.tree.map(lambda a: jnp.concatenate([a, jnp.zeros_like(a[:1])]), stages.best.sources)
    best, sources = jax.tree.map(lambda leaf: leaf[last], (fits, nobody))
    each = jnp.sum(strengths(best), axis=1) * sources.present
    # background, tilt, gain and width; strength, shield and scattered photons of each, here and beside
    fitted = 4.0 + 4.0 * jnp.sum(sources.present)
    shields = table.sources.shape[0] // n
    return Identification(
        nuclide=jnp.where(sound, jnp.where(named, main, nothing), UNKNOWN).astype(jnp.int32),
        confidence=jnp.where(sound, jnp.where(named, present[main], other), 0.0),
        posterior=present,
        none=none_chance,
        unknown=unknown_chance,
        strength_cps=jnp.zeros(n).at[sources.row // shields].add(each) / jnp.maximum(live_s, 1e-3),
        gain=best.gain,
        width=jnp.sqrt(1.0 + 2.0 * best.time),
        goodness=jnp.where(sound, p_value(data.counts, best.expected, data.certainty, fitted, _MODEL_ERROR), 0.0),
        fit=_in_channels(detector, best.expected) / part,
        stranger=strangers.nuclide,
        alike=strangers.share * jnp.exp(known - unknown),
    )


def _present(added: jax.Array, base: jax.Array) -> jax.Array:
    """Probability [N] that each nuclide is present, of the chances [stages, N] of each that is added to a base.

    ``base`` [stages, N] is 1 for the nuclides of each base, to which one of them may be added again. Chances that sum
    to 1 exceed it by single precision's rounding when they are summed anew: that is cut off, as a probability of
    1.0000001 is none.
    """
    return jnp.minimum(jnp.sum(added, axis=1) @ base + jnp.sum(added * (1.0 - base), axis=0), 1.0)


def _log_again(n: int) -> float:
    """Logarithm of the prior of a nuclide behind two shields over that of two of ``n`` nuclides."""
    return math.log(_PRIOR_AGAIN / n) - math.log(_PRIOR_TWO / max(math.comb(n, 2), 1))


def _strangers(detector: Detector, table: Tables, data: Data) -> _Strangers:
    """Evidence of a source that is not looked for, alone on the background."""
    weight = bin_weights(table, data)
    expected, slope = _about(table, data, _nobody(), jnp.zeros(COLUMNS).at[0].set(data.natural))
    found = screen(detector.known_spectrum, data, weight, expected, slope, _gain_prior())
    chosen, shield_log_share = detector.stranger, np.log(stranger_shares(detector))
    nuclide_log_share = jnp.log(jnp.maximum(chosen / jnp.maximum(jnp.sum(chosen), 1.0), 1e-30))
    prior = (nuclide_log_share[:, None] + shield_log_share).ravel()
    shields = len(shield_log_share)
    ground = np.arange(prior.shape[0]) // shields * shields + min(1, shields - 1)  # the second of each
    spectra, scattered = detector.known_spectrum, detector.known_scattered
    known = known_strangers(table, data, found, spectra, scattered, jnp.asarray(ground), prior)
    lines = lines_of_strangers(table, data, weight, natural_slopes(table, data), found.base_gain)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), known, lines)
    fits = jax.vmap(jax.vmap(lambda hypothesis: laplace(hypothesis, data)))(both.hypotheses)
    fitted = fits.score + both.places
    # what is not fitted is off by as much as what is
    evidence = both.total + logsumexp(fitted, axis=1) - logsumexp(both.score, axis=1)
    nuclide = known.row[jnp.argmax(fitted[0])] // shields
    own = logsumexp((found.score + prior).reshape(-1, shields)[nuclide]) - known.total
    return _Strangers(evidence[0], evidence[1], nuclide.astype(jnp.int32), jnp.exp(own))


def _nobody() -> Sources:
    return Sources(jnp.zeros(SOURCES, jnp.int32), jnp.zeros(SOURCES), jnp.zeros(SOURCES))


def _gain_prior() -> jax.Array:
    return -0.5 * ((jnp.asarray(GAINS) - 1.0) / GAIN_STD) ** 2


def _about(table: Tables, data: Data, own: Sources, counts: jax.Array) -> tuple[jax.Array, jax.Array]:
    """What sources and background of ``counts`` [COLUMNS] expect [gains, bins]; its slopes [gains, COLUMNS, bins]."""
    about = jax.vmap(lambda gain: of_library(table, data, own, gain))(jnp.arange(len(GAINS)))
    shape = about.column[:, :, 0]  # [gains, COLUMNS, bins]
    return jnp.einsum("c,gcb->gb", counts, shape), about.scale[..., None] * shape


def _stages(table: Tables, data: Data, shield_prior: jax.Array, n: int) -> _Stage:
    """All stages: one nuclide; another with the best; another with that one alone; a third with the best two."""
    shields = table.sources.shape[0] // n
    weight = bin_weights(table, data)
    row_prior = jnp.tile(shield_prior, n)

    def added_to(own: Sources, counts: jax.Array) -> Found:
        """Candidates at all gains, whose amplitudes follow; ``counts`` [COLUMNS] are those of the base."""
        expected, slope = _about(table, data, own, counts)
        return screen(table.sources[:, :, 0], data, weight, expected, slope, _gain_prior())

    def stage(bases: _Base, k: jax.Array) -> tuple[_Base, _Stage]:
        base = jax.tree.map(lambda leaf: leaf[k], bases)
        size = jnp.asarray(_BASE_SIZE)[k]
        own = Sources(base.sources.row, base.sources.present, jnp.sum(strengths(base.fit), axis=1))
        found = added_to(own, base.fit.counts)
        in_base = jnp.zeros(n).at[base.sources.row // shields].max(base.sources.present)
        # the nuclides of the base may be behind another shield as well
        prior = row_prior + jnp.repeat(jnp.where(in_base > 0.0, _log_again(n), 0.0), shields)
        ranked = found.score + prior
        by_nuclide, which = jax.lax.top_k(ranked.reshape(n, shields), _SHIELDS_EACH)
        few = jax.lax.top_k(by_nuclide.ravel(), min(CANDIDATES, n * _SHIELDS_EACH))[1]
        row = few // _SHIELDS_EACH * shields + which.ravel()[few]
        # the first two at the neighbouring gains too: to second order the base may point to a wrong one
        at = jnp.concatenate([found.gain[row], (found.gain[row[:2]][:, None] + jnp.array([-1, 1])).ravel()])
        row = jnp.concatenate([row, jnp.repeat(row[:2], 2)])
        candidates = jax.vmap(lambda r: with_new(own, size, r, found.strength[r]))(row)
        hypotheses = [
            jax.vmap(lambda s, g: of_library(table, data, s, g))(candidates, jnp.clip(at, 0, len(GAINS) - 1)),
            jax.tree.map(lambda leaf: leaf[None], of_library(table, data, own, found.base_gain)),
        ]
        fits = jax.vmap(lambda h: laplace(h, data))(jax.tree.map(lambda *a: jnp.concatenate(a), *hypotheses))
        many, first_many = row.shape[0], few.shape[0]
        fitted = fits.score[:many] + prior[row]
        # what is not fitted is off by as much as what is
        shift = logsumexp(fitted[:first_many]) - logsumexp(ranked[row[:first_many]])
        scores = (ranked + shift).at[row].set(-jnp.inf)
        scores = scores.at[row].max(fitted)
        evidence = logsumexp(scores.reshape(n, shields), axis=1)
        best = jnp.argmax(fitted)

        sources, fit = jax.tree.map(lambda leaf: leaf[best], (candidates, jax.tree.map(lambda leaf: leaf[:many], fits)))
        winner = _Base(sources, fit, base.log_prior + evidence[row[best] // shields] - fit.score)
        counts = jnp.sum(strengths(winner.fit), axis=1) * winner.sources.present
        counts /= jnp.maximum(jnp.sum(counts), 1e-9)
        new = counts[size]
        old = jnp.zeros(n).at[base.sources.row // shields].add(counts * base.sources.present)
        out = _Stage(
            score=evidence + base.log_prior,
            base=in_base,
            best=winner,
            share=jnp.stack([old, jnp.full(n, new)]),
            base_fit=jax.tree.map(lambda leaf: leaf[many], fits),
        )
        better = (k == 1) | (winner.fit.score + winner.log_prior > bases.fit.score[3] + bases.log_prior[3])
        # the nuclide that was added to the first one, alone: so that the first one's shield is found again beside it
        parts = strengths(winner.fit)[size]
        lone = _Base(
            Sources(*(jnp.zeros_like(leaf).at[0].set(leaf[size]) for leaf in winner.sources)),
            winner.fit._replace(counts=jnp.zeros(COLUMNS).at[:NATURAL].set(winner.fit.counts[:NATURAL])),
            winner.log_prior - base.log_prior,
        )
        lone = lone._replace(fit=lone.fit._replace(counts=lone.fit.counts.at[NATURAL : NATURAL + PARTS].set(parts)))
        for place, new_base in (
            (jnp.where(k == 0, 1, jnp.where((k < 3) & better, 3, 4)), winner),
            (jnp.where(k == 1, 2, 4), lone),
        ):
            bases = jax.tree.map(lambda all_of, one, p=place: all_of.at[p].set(one), bases, new_base)
        return bases, out

    bins = data.counts.shape[0]
    zero, alone = jnp.zeros(()), jnp.zeros(COLUMNS).at[0].set(data.natural)
    empty = _Base(_nobody(), Fit(zero, alone, zero + 1.0, zero, jnp.zeros(bins)), zero)
    start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (5, *leaf.shape)), empty)
    return jax.lax.scan(stage, start, jnp.arange(len(_BASE_SIZE)))[1]


def _in_channels(detector: Detector, expected: jax.Array) -> jax.Array:
    """Expected counts [channels] where those of the bins are ``expected`` [bins], which they add up to.

    A parabola in each bin, through densities at its edges that four bins give (Colella and Woodward, Journal of
    Computational Physics 54, 1984, 174, eq. 1.9, for bins that change slowly in width): lines between the bins' middles
    would flatten peaks.
    """
    edges = np.asarray(detector.identification_bins)
    channel = np.arange(detector.energy_kev.shape[0])
    mean = expected / np.diff(edges)
    around = jnp.concatenate([mean[:1], mean[:1], mean, mean[-1:], mean[-1:]])
    at_edge = (7.0 * (around[1:-2] + around[2:-1]) - around[:-3] - around[3:]) / 12.0
    at_edge = jnp.maximum(at_edge, 0.0)
    within = np.clip(np.searchsorted(edges, channel, side="right") - 1, 0, len(edges) - 2)
    part = np.clip((channel + 0.5 - edges[within]) / np.diff(edges)[within], 0.0, 1.0)
    low, high, middle = at_edge[within], at_edge[within + 1], mean[within]
    per_channel = low + part * (6.0 * middle - 4.0 * low - 2.0 * high) + part**2 * 3.0 * (low + high - 2.0 * middle)
    per_channel = jnp.maximum(per_channel, 0.0)
    # the channel that the threshold lies in counts, but is in no bin: its share is that of the background there
    natural = detector.background_spectrum
    share = natural / jnp.maximum(natural[edges[0]], 1e-30)
    return jnp.where(channel < edges[0], share * per_channel[edges[0]], per_channel)
