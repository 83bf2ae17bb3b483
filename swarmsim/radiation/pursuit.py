"""Search for hypotheses: which nuclide behind which wall, which further one, and which lines of a stranger.

Candidates are ranked by the evidence to second order about a common expectation, in which nuisances are linear and can
be eliminated from all candidates by one matrix product; the best are fitted in full (`swarmsim.radiation.laplace`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from swarmsim.radiation.laplace import (
    COLUMNS,
    GAIN_STD,
    NATURAL,
    NATURAL_STD,
    PART_STD,
    PARTS,
    SOURCES,
    TILT_STD,
    WIDTH_STD,
    Data,
    Fit,
    Hypothesis,
    log_occam,
    swept,
)
from swarmsim.radiation.lines import GAINS, ORDERS
from swarmsim.radiation.templates import Tables

LINES = 6
"""Lines of a source that the library lacks, at most."""
STRANGERS = 2  # sources that the library lacks, which are fitted in full
_SMOOTH = np.exp(-0.5 * (np.arange(-5, 6) / 2.0) ** 2)  # weights of neighbouring bins, narrower than a peak
_DISTINCT = 0.01  # part of its information that a source keeps where it is not one of those before
_MORE = 0.8  # of the sources that the library lacks have one line more than those found: five on average
_LOOSE = 0.01  # precision of lines that are found, in units of the scale of strengths
_NATURAL_SHARE = 0.2  # of the nominal background in the expectation for which bins are weighed


class Sources(NamedTuple):
    """Sources of a hypothesis of the library."""

    row: jax.Array  # [SOURCES] int32, nuclide and shield
    present: jax.Array  # [SOURCES] 1 or 0
    strength: jax.Array  # [SOURCES] counts, about


class Found(NamedTuple):
    """Candidates to be added to a hypothesis, for every row of the tables, at the best of the gains."""

    score: jax.Array  # [rows] logarithm of the evidence, to second order
    strength: jax.Array  # [rows] counts
    gain: jax.Array  # [rows] int32, of GAINS
    base_gain: jax.Array  # [] int32, the best without them


class Strangers(NamedTuple):
    """Hypotheses of a source that is not looked for."""

    hypotheses: Hypothesis  # [STRANGERS]
    score: jax.Array  # [STRANGERS] logarithm of the evidence, to second order
    places: jax.Array  # [STRANGERS] logarithm of the prior and the number of energies that explain the lines as well
    total: jax.Array  # [] logarithm of the evidence of all strangers, to second order
    row: jax.Array  # [STRANGERS] int32, nuclide and shield where they are known of


def bin_weights(tables: Tables, data: Data) -> jax.Array:
    """Weight [bins] of each bin for fits to second order: over the counts there, smoothed."""
    kernel = jnp.asarray(_SMOOTH, jnp.float32)
    norm = jnp.convolve(jnp.ones_like(data.counts), kernel, mode="same")
    smooth = jnp.convolve(data.counts, kernel, mode="same") / norm
    natural = data.natural * tables.background[len(GAINS) // 2, 0, 0]
    return data.certainty / ((1.0 - _NATURAL_SHARE) * smooth + _NATURAL_SHARE * natural + 1e-3)


def natural_slopes(tables: Tables, data: Data) -> jax.Array:
    """Slopes [gains, 4, bins] of the background by amplitude, tilt, gain and width in units of their prior."""
    shape = tables.background
    amplitude, tilt = NATURAL_STD * shape[:, 0, 0], TILT_STD * shape[:, 1, 0]
    return data.natural * jnp.stack([amplitude, tilt, GAIN_STD * shape[:, 0, 1], WIDTH_STD * shape[:, 0, 3]], axis=1)


def screen(
    shapes: jax.Array, data: Data, weight: jax.Array, expected: jax.Array, slope: jax.Array, gains: jax.Array
) -> Found:
    """Rank spectra [rows, gains, bins] as a source added to what at each gain expects ``expected`` [gains, bins].

    ``slope`` [gains, V, bins] are its slopes by its parameters in units of their prior, ``gains`` [gains] the logarithm
    of the prior of each gain.
    """

    def at(
        shape: jax.Array, expected: jax.Array, slope: jax.Array, prior: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        value, strength, base = _added(shape, data, weight, expected, slope, jnp.ones(slope.shape[0]))
        return value + base + prior, strength, base + prior

    score, strength, base = jax.vmap(at, in_axes=(1, 0, 0, 0))(
        shapes,
        jnp.broadcast_to(expected, (len(GAINS), data.counts.shape[0])),
        jnp.broadcast_to(slope, (len(GAINS), *slope.shape[-2:])),
        gains,
    )
    best = jnp.argmax(score, axis=0)
    row = jnp.arange(score.shape[1])
    return Found(score[best, row], strength[best, row], best, jnp.argmax(base))


def _added(
    shape: jax.Array,
    data: Data,
    weight: jax.Array,
    expected: jax.Array,
    slope: jax.Array,
    precision: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """By how much each of ``shape`` [k, bins] raises the logarithm of the evidence [k], and its strength [k] in counts.

    To second order, with the logarithm of the evidence [] without them. The hypothesis to which they are added expects
    ``expected`` [bins], with slopes ``slope`` [V, bins] by parameters of ``precision`` [V] a priori.
    """
    left = weight * (data.counts - expected)
    weighted = slope * weight
    inverse, log_volume = swept(weighted @ slope.T + jnp.diag(precision))
    pull = slope @ left
    solved = inverse @ pull
    # each one's gradient after the parameters have followed the data, and its information where they follow it
    products = shape @ jnp.concatenate([weighted, (left - solved @ weighted)[None]]).T
    overlap, gradient = products[:, :-1], products[:, -1]
    alone = (shape * shape) @ weight
    information = alone - jnp.sum(overlap @ inverse * overlap, axis=1)
    distinct = information > _DISTINCT * alone
    information = jnp.maximum(information, jnp.maximum(_DISTINCT * alone, 1e-9))
    strength = jnp.maximum(gradient, 0.0) / information
    value = 0.5 * strength * gradient + log_occam(strength, information, data.scale)
    base = 0.5 * solved @ pull - 0.5 * jnp.sum(left * (data.counts - expected)) - 0.5 * log_volume
    return jnp.where(distinct, value, -1e3), strength, base


def of_library(tables: Tables, data: Data, sources: Sources, gain: jax.Array) -> Hypothesis:
    """The hypothesis of some sources about a gain [] int32 of the tables."""
    own, other = sources.row, tables.beside[sources.row]
    scattered = jnp.stack([tables.scattered[row, gain] for row in (own, other)], axis=1)  # [SOURCES, 2, ORDERS, bins]
    share = jnp.sum(scattered[:, :, 0], axis=-1) * jnp.stack([jnp.ones_like(own), own != other], axis=1)
    # all columns sum to 1, so that what stands before them is counts
    scattered /= jnp.maximum(share, 1e-9)[:, :, None, None]
    of_source = jnp.concatenate([tables.sources[own, gain][:, None], scattered], axis=1)
    about = jnp.maximum(sources.strength, 0.02 * data.natural) * sources.present
    scale = about[:, None] * jnp.concatenate([jnp.ones((SOURCES, 1)), PART_STD * share], axis=1)
    first = jnp.arange(PARTS) == 0
    start = (sources.strength * sources.present)[:, None] * first
    strengths = jnp.tile(first.astype(jnp.float32), SOURCES)
    column = of_source.reshape(SOURCES * PARTS, ORDERS, -1)
    return _hypothesis(tables, data, column, scale.ravel(), strengths, start.ravel(), gain)


def _hypothesis(
    tables: Tables,
    data: Data,
    column: jax.Array,
    scale: jax.Array,
    strength: jax.Array,
    start: jax.Array,
    gain: jax.Array,
) -> Hypothesis:
    """The hypothesis of columns of sources on the background."""
    natural = jnp.maximum(jnp.sum(data.counts) - jnp.sum(start), 0.3 * data.natural)
    return Hypothesis(
        column=jnp.concatenate([tables.background[gain], column]),
        scale=jnp.concatenate([data.natural * jnp.array([NATURAL_STD, TILT_STD]), scale]),
        strength=jnp.concatenate([jnp.zeros(NATURAL), strength]),
        start=jnp.concatenate([jnp.stack([natural, jnp.zeros(())]), start]),
        gain=jnp.asarray(GAINS)[gain],
    )


def lines_of_strangers(tables: Tables, data: Data, weight: jax.Array, slope: jax.Array, gain: jax.Array) -> Strangers:
    """The lines that explain the spectrum best, behind every shield; the background is linear about a gain [] int32.

    Lines are added one by one where they raise the evidence (orthogonal matching pursuit: Pati, Rezaiifar and
    Krishnaprasad, Asilomar 1993). Each line is followed by one more in `_MORE` of the cases a priori; its energy
    is anywhere on the grid, and its strength has the prior of a nuclide's.
    """
    shields, grid, bins = tables.lines.shape
    natural = slope[gain]
    expected = data.natural * tables.background[gain, 0, 0]
    parameters = natural.shape[0]
    precision = jnp.concatenate([jnp.ones(parameters), jnp.full(LINES, _LOOSE)])

    def pursue(lines: jax.Array) -> tuple[jax.Array, ...]:
        def add(
            carry: tuple[jax.Array, jax.Array], k: jax.Array
        ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, ...]]:
            found, active = carry
            value, strength, _ = _added(lines, data, weight, expected, jnp.concatenate([natural, found]), precision)
            gained = logsumexp(value) - np.log(grid) + jnp.where(k == 0, 0.0, np.log(_MORE))
            active = (k == 0) | (active & (gained > 0.0))
            best = jnp.argmax(value)
            found = found.at[k].set(jnp.where(active, data.scale * lines[best], 0.0))
            out = (best, jnp.where(active, strength[best], 0.0), active, jnp.where(active, gained, 0.0))
            return (found, active), (*out, jnp.where(active, gained - value[best], 0.0))

        start = (jnp.zeros((LINES, bins)), jnp.bool_(True))
        line, strength, active, gained, places = jax.lax.scan(add, start, jnp.arange(LINES))[1]
        return line, strength, active, jnp.sum(gained), jnp.sum(places)

    line, strength, active, gained, places = jax.vmap(pursue)(tables.lines)
    score = gained + _added(tables.lines[0], data, weight, expected, natural, jnp.ones(parameters))[2]
    score -= np.log(shields)
    shield = jax.lax.top_k(score, STRANGERS)[1]

    def hypothesis(shield: jax.Array) -> Hypothesis:
        of, extra = active[shield], COLUMNS - NATURAL - LINES
        column = jnp.zeros((COLUMNS - NATURAL, ORDERS, bins)).at[:LINES, 0].set(tables.lines[shield, line[shield]])
        scale = jnp.pad(jnp.maximum(strength[shield], 0.02 * data.natural) * of, (0, extra))
        is_line = jnp.pad(jnp.ones(LINES), (0, extra))
        return _hypothesis(tables, data, column, scale, is_line, jnp.pad(strength[shield] * of, (0, extra)), gain)

    return Strangers(
        hypotheses=jax.vmap(hypothesis)(shield),
        score=score[shield],
        places=places[shield] - np.log(shields),
        total=logsumexp(score),
        row=shield,
    )


def known_strangers(
    tables: Tables,
    data: Data,
    found: Found,
    known: jax.Array,
    scattered: jax.Array,
    ground: jax.Array,
    prior: jax.Array,
) -> Strangers:
    """The nuclides among those that are not looked for which explain the spectrum best, each behind some shield.

    ``found`` ranks their spectra ``known`` [rows, gains, bins], of which ``scattered`` [rows, bins] is the part of
    scattered photons; ``ground`` [rows] are the rows of the same nuclides above the ground, and ``prior`` [rows] is the
    logarithm of their prior.
    """
    ranked = found.score + prior
    score, row = jax.lax.top_k(ranked, STRANGERS)
    bins = data.counts.shape[0]

    def hypothesis(row: jax.Array) -> Hypothesis:
        gain, extra = found.gain[row], COLUMNS - NATURAL - PARTS
        beside = jnp.where(row == ground[row], 0.0, scattered[ground[row]])
        column = jnp.zeros((COLUMNS - NATURAL, ORDERS, bins))
        column = column.at[:PARTS, 0].set(jnp.stack([known[row, gain], scattered[row], beside]))
        about = jnp.maximum(found.strength[row], 0.02 * data.natural)
        scale = jnp.pad(about * jnp.array([1.0, PART_STD, PART_STD]), (0, extra))
        start = jnp.pad(found.strength[row][None], (0, extra + PARTS - 1))
        return _hypothesis(tables, data, column, scale, jnp.zeros(COLUMNS - NATURAL).at[0].set(1.0), start, gain)

    return Strangers(
        hypotheses=jax.vmap(hypothesis)(row), score=score, places=prior[row], total=logsumexp(ranked), row=row
    )


def with_new(base: Sources, stage: jax.Array, row: jax.Array, strength: jax.Array) -> Sources:
    """``base`` with the source ``row`` [] at a place ``stage`` []."""
    return Sources(base.row.at[stage].set(row), base.present.at[stage].set(1.0), base.strength.at[stage].set(strength))


def strengths(fit: Fit) -> jax.Array:
    """Counts [SOURCES, PARTS] of the columns of each source."""
    return fit.counts[NATURAL:].reshape(SOURCES, PARTS)
