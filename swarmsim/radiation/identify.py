"""Bayesian identification of the nuclides in a spectrum (device side).

The hypotheses: background only; background and an unknown source of which only scattered photons are detected;
background and one nuclide; background and two. Under each, the spectrum is a non-negative sum of templates: the
background, two smooth continua of scattered photons, and for each nuclide its spectrum as emitted and behind thick
shielding, which allows for spectral hardening. The fit maximises the Poisson likelihood by expectation maximisation; a
template that starts at zero stays at zero, so that one matrix fits all hypotheses.
Posterior = likelihood x Occam factor of the source's strength x prior, where each bin's deviance is reduced to account
for the error of the templates.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from swarmsim.pytree import pytree
from swarmsim.radiation.cylinder import direction_basis
from swarmsim.radiation.detector import Detector
from swarmsim.radiation.rate import scattered_shares, transmission
from swarmsim.site.rays import Crossed

ITERATIONS = 150
_RELAXATION = 1.6  # exponent of the multiplicative step; below 2 it still converges and needs fewer steps
# Prior: a hotspot may be natural background, may be heavily shielded, and is rarely a mixture.
_PRIOR_NONE, _PRIOR_UNKNOWN, _PRIOR_ONE, _PRIOR_TWO = 0.4, 0.1, 0.4, 0.1
_TEMPLATE_ERROR = 0.04  # relative error of the templates in a bin: an estimate
_STRENGTH_SCALE = 0.3  # scale of the half-Cauchy prior of a source's strength, in units of the background
_COUNTS_FLOOR = 0.05  # per bin: keeps the information finite where almost no counts are expected
_SHIELD_M = 0.11  # of concrete: two mean free paths at 662 keV
_SMOOTH = 3  # templates shared by the hypotheses: background and the two continua


@pytree
class Identification:
    """Result of `identify`; N nuclides in the order of the detector's ``nuclide_names``."""

    nuclide: jax.Array  # [] int32 nuclide that explains most counts; -1 when none is identified
    confidence: jax.Array  # [] probability that it is present, or of background only when none is identified
    posterior: jax.Array  # [N] probability that each nuclide is present
    none: jax.Array  # [] probability of background only
    unknown: jax.Array  # [] probability of a source of which only scattered photons are detected
    strength_cps: jax.Array  # [N] counts per second of each nuclide under the best hypothesis
    fit: jax.Array  # [channels] expected counts of the best hypothesis


def hypotheses(nuclides: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nuclides [H, N] of each hypothesis, whether it has continua [H], and the logarithm of its prior [H].

    The first is background only, the second the unknown source, then each nuclide and each pair.
    """
    single, pairs = [(n,) for n in range(nuclides)], list(itertools.combinations(range(nuclides), 2))
    sets: list[tuple[int, ...]] = [(), (), *single, *pairs]
    members = np.zeros((len(sets), nuclides), np.float32)
    for row, chosen in enumerate(sets):
        members[row, list(chosen)] = 1.0
    one, two = _PRIOR_ONE / nuclides, _PRIOR_TWO / max(len(pairs), 1)
    prior = [_PRIOR_NONE, _PRIOR_UNKNOWN, *[one] * nuclides, *[two] * len(pairs)]
    continua = np.ones(len(sets), np.float32)
    continua[0] = 0.0
    return members, continua, np.log(np.array(prior) / sum(prior))


def templates(detector: Detector) -> jax.Array:
    """Template spectra [3 + 2 N, channels], each summing to 1: background, two continua, bare and shielded nuclides."""
    above = jnp.arange(detector.energy_kev.shape[0]) >= detector.identification_bins[0]
    low = jnp.exp(-0.5 * (jnp.log(detector.energy_kev / 105.0) / 0.6) ** 2) / detector.energy_kev * above
    broad = jnp.exp(-detector.energy_kev / 350.0) * above
    end_on = direction_basis(jnp.float32(1.0), jnp.float32(0.0))
    lines = detector.yields * (detector.effective_area_m2 @ end_on)  # [N, L]
    way = _shielding(detector)

    def behind(number: jax.Array, lines: jax.Array) -> jax.Array:
        direct, scattered = transmission(detector, number, way)
        bins = (lines * scattered) @ scattered_shares(detector, number, way)
        return (lines * direct) @ detector.peak_spectrum[number] + bins @ detector.bin_spectrum

    bare = jnp.einsum("nl,nlc->nc", lines, detector.peak_spectrum)
    shielded = jax.lax.map(lambda pair: behind(*pair), (jnp.arange(lines.shape[0]), lines))
    stacked = jnp.concatenate([jnp.stack([detector.background_spectrum, low, broad]), bare, shielded])
    return stacked / jnp.maximum(jnp.sum(stacked, axis=1, keepdims=True), 1e-30)


def _shielding(detector: Detector) -> Crossed:
    """`_SHIELD_M` of concrete half way between source and detector."""
    names = detector.material_names
    wall = names.index("concrete") if "concrete" in names else 0
    length = jnp.zeros(len(names)).at[wall].set(_SHIELD_M)
    return Crossed(length_m=length, place=jnp.full(len(names), 0.5))


def identify(detector: Detector, counts: jax.Array, live_s: jax.Array) -> Identification:
    """Identify the nuclides in ``counts`` [channels] accumulated over ``live_s`` [] seconds.

    With no counts or no live time the posterior is the prior. Only nuclides for which the detector has tables are
    considered, and at most two of them at once.
    """
    nuclides = len(detector.nuclide_names)
    members, continua, log_prior = hypotheses(nuclides)
    fine = templates(detector)
    starts = np.asarray(detector.identification_bins)
    of_channel = np.searchsorted(starts, np.arange(counts.shape[-1]), side="right") - 1
    fold = np.eye(len(starts) - 1, dtype=np.float32)[of_channel] * (of_channel >= 0)[:, None]  # [channels, bins]
    shape, data = fine @ fold, counts @ fold
    smooth = np.stack([np.ones_like(continua), continua, continua], axis=1)
    allowed = np.concatenate([smooth, members, members], axis=1)
    weights = _fit(shape, data, allowed, detector.background_cps * live_s)  # [H, 3 + 2 N]
    expected = jnp.maximum(weights @ shape, 1e-12)
    deviance = 2.0 * (expected - data + jax.scipy.special.xlogy(data, data / expected))  # [H, bins]
    certainty = 1.0 / (1.0 + _TEMPLATE_ERROR**2 * data)
    precision = certainty / (expected + _COUNTS_FLOOR)
    source = slice(_SMOOTH, _SMOOTH + nuclides)
    strength = weights[:, source] + weights[:, _SMOOTH + nuclides :]  # [H, N] counts
    scale = _STRENGTH_SCALE * jnp.maximum(detector.background_cps, 1.0) * jnp.maximum(live_s, 1e-3)
    occam = jnp.sum(members * _log_occam(strength, precision @ (shape[source] ** 2).T, scale), axis=1)
    hidden = jnp.sum(precision[1] * shape[1] ** 2)
    occam = occam.at[1].set(_log_occam(weights[1, 1] + weights[1, 2], hidden, scale))
    posterior = jax.nn.softmax(log_prior + occam - 0.5 * deviance @ certainty)
    present, none, unknown = posterior @ members, posterior[0], posterior[1]
    share = strength / jnp.maximum(jnp.sum(strength, axis=1, keepdims=True), 1e-9)
    main = jnp.argmax(posterior @ (share * members))
    best = jnp.argmax(posterior)
    named = present[main] > jnp.maximum(none, unknown)
    return Identification(
        nuclide=jnp.where(named, main, -1).astype(jnp.int32),
        confidence=jnp.where(named, present[main], none),
        posterior=present,
        none=none,
        unknown=unknown,
        strength_cps=strength[best] / jnp.maximum(live_s, 1e-3),
        fit=weights[best] @ fine,
    )


def _fit(shape: jax.Array, data: jax.Array, allowed: np.ndarray, background: jax.Array) -> jax.Array:
    """Counts [H, 3 + 2 N] of each allowed template under each hypothesis, by relaxed expectation maximisation."""
    total = jnp.maximum(jnp.sum(data), 1e-6)
    natural = jnp.clip(background, 0.05 * total, total)
    excess = jnp.maximum(total - natural, 0.05 * total)
    weights = allowed * excess / np.maximum(allowed.sum(axis=1, keepdims=True) - 1.0, 1.0)
    weights = weights.at[:, 0].set(natural)
    seen = jnp.maximum(jnp.sum(shape, axis=1), 1e-9)

    def step(weights: jax.Array, _: None) -> tuple[jax.Array, None]:
        expected = jnp.maximum(weights @ shape, 1e-9)
        return weights * (((data / expected) @ shape.T) / seen) ** _RELAXATION, None

    return jax.lax.scan(step, weights, None, length=ITERATIONS)[0]


def _log_occam(strength: jax.Array, information: jax.Array, scale: jax.Array) -> jax.Array:
    """Logarithm of the Occam factor of a strength (counts) with a half-Cauchy prior of ``scale``.

    Laplace approximation about the fitted strength, truncated at zero.
    """
    density = 2.0 / (jnp.pi * scale * (1.0 + (strength / scale) ** 2))
    width = jnp.sqrt(2.0 * jnp.pi / (information + (0.5 / scale) ** 2))
    return jnp.log(jnp.clip(density * width * ndtr(strength * jnp.sqrt(information)), 1e-30, 1.0))
