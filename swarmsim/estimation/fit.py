"""Fits of all unknowns at a place, or with known sources alone, by steps of `swarmsim.estimation.normal_equations`.

The value at a place is the logarithm of the posterior after all of them are integrated out (Laplace's approximation):
the shape of the spectrum then tells a source from a background that varies from place to place.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.config.sources import ACTIVITY_MAX_MBQ
from swarmsim.device import for_those
from swarmsim.estimation.forward import Problem, Rates, Ways, lengthened, rates, silent, variance_of
from swarmsim.estimation.likelihood import height_precision, scaled_inverse
from swarmsim.estimation.normal_equations import (
    MEAN_FLOOR,
    Linearised,
    Others,
    Unknowns,
    linearised,
    log_likelihood,
    log_prior,
    normal_equations,
    stepped,
)
from swarmsim.estimation.overload import likeliest, overloaded
from swarmsim.pytree import pytree
from swarmsim.site import sample

LEVEL_STEPS = 8  # of the activity that the windows' own ones are put together to
FAR_OFF = 4.0  # standard deviations of its counts, from which on the gain of a window does not start at zero
FARTHEST_GAIN = 5.0  # logarithm of a window's rate over the model's, where a fit starts
FLAT = 1e-6  # 1/m^2, precision of a place that no count tells of


@pytree
class Settled:
    """The fit at one place."""

    value: jax.Array  # [] logarithm of the posterior, integrated over the unknowns
    likelihood: jax.Array  # [] that of the likelihood and the priors at the unknowns' best values
    unknowns: Unknowns
    covariance: jax.Array  # [P, P] of ln(activity), the others' factors, levels and lengths, the place held
    towards: jax.Array  # [3, 3] information about the place, the unknowns marginalised; as if nothing were in the way
    move: jax.Array  # [3] Gauss-Newton step of the place; as if nothing were in the way
    rates: Rates  # of the source, with the lengths of the fit


def settle(
    problem: Problem,
    ways: Ways,
    nuclide: jax.Array,
    others: Others,
    start: Unknowns,
    steps: int,
    passes: int = 1,
    *,
    fresh: bool = False,
    fitted: jax.Array | bool = True,
) -> Settled:
    """Fit all unknowns for a source of ``nuclide`` at the place that ``ways`` lead from.

    Args:
        problem: the data.
        ways: from the place.
        nuclide: [] int32.
        others: other sources.
        start: where to begin.
        steps: of Gauss-Newton in each pass (static).
        passes: how often the rates are computed, each time with the lengths that the steps before came to; after each
            step, the last one too, they are extrapolated (`lengthened`; static).
        fresh: whether the place is a new one: then the activity and the windows' own unknowns are not taken from
            ``start`` (static).
        fitted: [] bool; where it is False the rates are computed and no step is done.
    """
    # where no length is uncertain the rates are the same in all passes
    passes, steps = (passes, steps) if problem.uncertain else (1, passes * steps)
    # loops of known length, unless something else is asked
    count, moves = (passes, steps) if fitted is True else (jnp.where(fitted, passes, 1), jnp.where(fitted, steps, 0))

    def linear(u: Unknowns, source: Rates) -> Linearised:
        return linearised(problem, source, others, ways.position_m, u)

    def step(_: int, carry: tuple[Unknowns, Rates]) -> tuple[Unknowns, Rates]:
        u, source = carry
        moved = stepped(problem, u, normal_equations(problem, linear(u, source), u))
        return moved, lengthened(source, moved.lengths - u.lengths)

    def pass_(number: jax.Array | int, carry: tuple[Unknowns, Rates]) -> tuple[Unknowns, Rates]:
        u, _ = carry
        source = rates(problem, ways, nuclide, u.lengths)
        if fresh:
            u = jax.lax.cond(number == 0, lambda: _begun(problem, source, others, ways.position_m, u), lambda: u)
        return jax.lax.fori_loop(0, moves, step, (u, source))

    # a loop, so that what a pass does is compiled once
    u, source = jax.lax.fori_loop(0, count, pass_, (start, silent(problem)))
    return _settled(problem, linear(u, source), u, ways, source)


@jax.jit  # traced once for all places of a program that call it
def _settled(problem: Problem, model: Linearised, u: Unknowns, ways: Ways, source: Rates) -> Settled:
    at = normal_equations(problem, model, u)
    height = ways.position_m[2] - sample(problem.site.terrain_m, problem.site, ways.position_m[:2])
    precise, above = height_precision(problem.height_std_m), height - problem.height_m
    likelihood = log_likelihood(problem, model) + log_prior(problem, model, u) - 0.5 * precise * jnp.square(above)
    towards, pull = at.towards.at[2, 2].add(precise), at.pull.at[2].add(-precise * above)
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(at.information), 1e-20))
    unit = at.information / (scale[:, None] * scale) + 1e-6 * jnp.eye(scale.shape[0])
    root = jax.scipy.linalg.cholesky(unit, lower=True)
    log_volume = -jnp.sum(jnp.log(jnp.diagonal(root))) - jnp.sum(jnp.log(scale))
    value = likelihood + log_volume + at.log_volume + log_prior_of_activity(problem, u.activity_bq)
    possible = u.activity_bq <= 1e6 * ACTIVITY_MAX_MBQ
    return Settled(
        value=jnp.where(possible & jnp.isfinite(value), value, -jnp.inf),
        likelihood=jnp.where(possible & jnp.isfinite(likelihood), likelihood, -jnp.inf),
        unknowns=u,
        covariance=scaled_inverse(at.information),
        towards=at.towards,
        move=scaled_inverse(towards + jnp.eye(3) * FLAT) @ pull,
        rates=source,
    )


def log_prior_of_activity(problem: Problem, activity_bq: jax.Array) -> jax.Array:
    """Log prior [] of an activity, up to a constant."""
    # where nothing is left of an activity its logarithm says nothing
    excess = (jnp.log(jnp.maximum(activity_bq, 1.0)) - problem.log_activity) / problem.log_activity_std
    return -0.5 * jnp.square(excess)


def _begun(problem: Problem, source: Rates, others: Others, where: jax.Array, u: Unknowns) -> Unknowns:
    """Where a fit at a new place starts: the activity, and each window's background and gain, all else as in ``u``."""
    begun, amount, beside, variance = _put_together(problem, source, others, where, u)

    def strong() -> Unknowns:
        factor, _ = likeliest(problem, amount, beside, variance)
        own, same = jnp.zeros_like(begun.gain), factor == 1.0
        return replace(
            begun,
            activity_bq=factor * begun.activity_bq,
            gain=jnp.where(same, begun.gain, own),
            background=jnp.where(same, begun.background, own),
        )

    # not in the function that is traced once: JAX 0.11 gives a program twice its arguments where an accelerator's
    # groups are chosen inside of one
    return for_those(overloaded(problem), strong, lambda: begun)


@jax.jit  # traced once for all places of a program that call it
def _put_together(
    problem: Problem, source: Rates, others: Others, where: jax.Array, u: Unknowns
) -> tuple[Unknowns, jax.Array, jax.Array, jax.Array]:
    """Where a fit starts by a score at each window, if no counter was overloaded.

    And counts [n] that the source adds then, those [n] of all else, and the variance [n] of the former's logarithm.

    Each window by itself tells an amplitude of the source; they are put together as the model of a window's error has
    it. At a wrong place many windows are off by factors, to which a few Gauss-Newton steps would not come.
    """
    m = problem.measurements
    assert m.rois is not None
    unit = jnp.maximum(jnp.max(jnp.where(m.valid, jnp.sum(source.counts, axis=1), 0.0)), 1e-30)
    net = source.counts / unit
    rest = jnp.sum(others.counts * u.others[:, None, None], axis=0)
    background = problem.background * jnp.exp(problem.detector @ u.level)[:, None]
    left = m.rois - rest - background
    weight = problem.trust / jnp.maximum(jnp.maximum(m.rois, rest + background), MEAN_FLOOR)
    weight = jnp.where(m.valid[:, None], weight, 0.0)

    def over(x: jax.Array) -> jax.Array:
        return jnp.sum(weight * x, axis=1)

    both = over(net * background)
    of_background = over(jnp.square(background)) + 1.0 / jnp.square(problem.background_std)
    information = jnp.maximum(over(net * net) - jnp.square(both) / of_background, 1e-20)
    score = over(net * left) - both * over(background * left) / of_background
    amplitude, noise = score / information, 1.0 / information
    variance = variance_of(problem, where) + source.edge
    least = 10.0 / jnp.maximum(jnp.sum(jnp.where(m.valid[:, None], net, 0.0)), 1e-20)
    tail = problem.tail

    def mean(_: int, level: jax.Array) -> jax.Array:
        beyond = jnp.maximum(jnp.square(amplitude - level) - noise, 0.0)
        trusted = noise + (tail * variance * jnp.square(level) + beyond) / (tail + 1.0)
        share = jnp.where(m.valid, 1.0 / trusted, 0.0)
        return jnp.maximum(jnp.sum(share * amplitude) / jnp.sum(share), least)

    level = jnp.maximum(jnp.sum(jnp.where(m.valid, score, 0.0)) / jnp.sum(information), least)
    level = jax.lax.fori_loop(0, LEVEL_STEPS, mean, level)
    known, total = jnp.sum(rest, axis=1), jnp.sum(net, axis=1)
    seen, expected = amplitude * total + known, level * total + known
    off = jnp.log(jnp.maximum(seen, 1e-3) / jnp.maximum(expected, 1e-3))
    spread = (tail * variance + jnp.square(off)) / (tail + 1.0)
    told = jnp.square(jnp.maximum(seen, expected) / jnp.maximum(total, 1e-20)) * information * spread
    # below that a heavy tail would hold the chance of few counts for an error of the model
    beyond_chance = jnp.square(amplitude - level) * information > FAR_OFF**2
    gain = jnp.where(beyond_chance, jnp.clip(off * told / (1.0 + told), -FARTHEST_GAIN, FARTHEST_GAIN), 0.0)
    signal = (level * net + rest) * jnp.exp(gain)[:, None]
    of_rest = over(background * (m.rois - background - signal)) / of_background
    begun = replace(u, activity_bq=level / unit, gain=gain, background=jnp.clip(of_rest, -1.0, 1.0))
    return begun, level * total, known + jnp.sum(background, axis=1), variance


def alone(problem: Problem, others: Others, u: Unknowns, steps: int) -> tuple[Unknowns, Linearised]:
    """Best unknowns with the sources ``others`` alone, and the model there."""

    def model(u: Unknowns) -> Linearised:
        return linearised(problem, silent(problem), others, jnp.zeros(3), u)

    def step(u: Unknowns, _: None) -> tuple[Unknowns, None]:
        return stepped(problem, u, normal_equations(problem, model(u), u)), None

    u = jax.lax.scan(step, replace(u, activity_bq=jnp.zeros(())), None, length=steps)[0]
    return u, model(u)


def without_more(problem: Problem, others: Others, u: Unknowns, steps: int) -> tuple[Unknowns, jax.Array]:
    """Best unknowns with the sources ``others`` alone, and the likelihood with the priors."""
    u, model = alone(problem, others, u, steps)
    return u, log_likelihood(problem, model) + log_prior(problem, model, u)
