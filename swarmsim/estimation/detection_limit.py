"""How strong a source would have had to be for the search to notice it: the detection limit of what was measured.

The limit (ISO 11929) is the activity whose statistic exceeds what is asked with a probability of 95 %. That statistic
is a likelihood ratio, whose root has a standard deviation of 1 about the ratio of the counts as they are expected
(G. Cowan, K. Cranmer, E. Gross, O. Vitells, Eur. Phys. J. C 71 (2011) 1554). Without the source the search's own fit
takes up what it can of them: with the level of each detector model, the activities of the sources that are known, and
the background and the gain of each window.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.config.sources import ACTIVITY_MAX_MBQ
from swarmsim.device import each, for_those
from swarmsim.estimation.fit import alone
from swarmsim.estimation.forward import Problem, dead_time, variance_of
from swarmsim.estimation.normal_equations import Others, log_likelihood, log_prior, normal_equations
from swarmsim.estimation.overload import least_prominent, overloaded
from swarmsim.estimation.scan import open_counts, open_totals, scan, true_counts
from swarmsim.estimation.seek import SearchParams, least_of
from swarmsim.estimation.starts import Places
from swarmsim.estimation.state import ALONE_STEPS, State
from swarmsim.pytree import pytree

NOTICED = 1.645  # standard deviations above what is asked of a source: it has that with 95 % (ISO 11929)
MOST = 0.95  # of the places in the open, at which a source as strong as the limit would be noticed
FASTEST = 10.0  # what a step may multiply the activity by
STEPS = 6  # of the activity towards the limit, at most; it is within 1 % then
NEAR = 0.01  # step of its logarithm after which a further one would change next to nothing
POWERS = (0.3, 1.2)  # of the activity, with which the root of the ratio may grow
TOGETHER = 8  # nuclides that an accelerator looks at side by side


@pytree
class _Tried:
    """An activity, and the one before."""

    activity_bq: jax.Array  # []
    last_bq: jax.Array  # []
    last_root: jax.Array  # [] of the likelihood ratio that it has; 0: none was tried
    steps: jax.Array  # [] int32, how many were tried


def noticed(
    problem: Problem, places: Places, allowed: jax.Array, params: SearchParams, state: State
) -> tuple[jax.Array, jax.Array]:
    """Activities [N] in Bq from which on a source beside those of ``state`` is noticed, at `MOST` of the open places.

    Of those in the area. Infinite for nuclides that are not ``allowed`` [N], where it would have to be stronger than
    any, and where as many sources are known as are sought. And the largest statistic [] of one that is not sought, over
    what is asked of a further one (``params.further``): of any other nuclide, and of one that is allowed where as many
    are known as are sought.
    """
    allowed, points = jnp.asarray(allowed), jnp.asarray(places.points_m)
    full = jnp.all(state.sources.present)
    scanned = scan(problem, points, jnp.where(full, allowed, ~allowed), state.added, state.unknowns)
    unsought = jnp.maximum(jnp.max(scanned.statistic), 0.0) / params.further

    def look() -> jax.Array:
        information, surveyed = scanned.information, jnp.asarray(places.surveyed)
        # in ascending order, those outside of the area last
        order = jnp.argsort(jnp.where(surveyed[:, None], information, jnp.inf), axis=0)
        weak = order[((1.0 - MOST) * jnp.sum(surveyed)).astype(jnp.int32)]
        faint = jnp.take_along_axis(information, weak[None], axis=0)[0]
        activity = limits(problem, state, points[weak], least_of(params, state), faint)
        activity = jnp.maximum(activity, _prominent(problem, points, surveyed, state))
        return jnp.where(allowed, possible(activity), jnp.inf)

    return for_those(~full, look, lambda: jnp.full(allowed.shape, jnp.inf)), unsought


def _prominent(problem: Problem, points_m: jax.Array, surveyed: jax.Array, state: State) -> jax.Array:
    """Activities [N] in Bq from which on the search believes in a source at `MOST` of the ``surveyed`` [C] points."""
    count = points_m.shape[0]
    hidden = ((1.0 - MOST) * jnp.sum(surveyed)).astype(jnp.int32)

    def of(nuclide: jax.Array) -> jax.Array:
        least = least_prominent(problem, open_totals(problem, points_m, jnp.full(count, nuclide)), state.added)
        return -jnp.sort(jnp.where(surveyed, -least, jnp.inf))[hidden]

    nuclides = jnp.arange(problem.detectors[0].decay_1_s.shape[0])
    return for_those(overloaded(problem), lambda: jax.lax.map(of, nuclides), lambda: jnp.zeros(nuclides.shape))


def noticed_from(information: jax.Array, further: jax.Array) -> jax.Array:
    """Activities [K] in Bq from which on another source is noticed, by the information [K] about its activity.

    ``further`` [] is what it must reach. Infinite where it would have to be stronger than any.
    """
    activity = (jnp.sqrt(further) + NOTICED) / jnp.sqrt(jnp.maximum(information, 1e-37))
    return possible(activity)


def possible(activity_bq: jax.Array) -> jax.Array:
    """Activities [...], those that no source has as infinite."""
    return jnp.where(activity_bq < 1e6 * ACTIVITY_MAX_MBQ, activity_bq, jnp.inf)


def limits(problem: Problem, state: State, points_m: jax.Array, asked: jax.Array, information: jax.Array) -> jax.Array:
    """Activities [N] in Bq at the detection limit, each nuclide at its own of ``points_m`` [N, 3], in the open.

    ``information`` [N] (1/Bq^2) is that about the activity of a faint source there, where the search for them begins.
    """
    reach, start = jnp.sqrt(asked) + NOTICED, jnp.sqrt(jnp.maximum(information, 1e-37))

    def of(one: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        point, nuclide, root = one
        added, variance = open_counts(problem, point, nuclide), variance_of(problem, point)

        def on(tried: _Tried) -> jax.Array:
            far = jnp.abs(jnp.log(tried.activity_bq / tried.last_bq)) > NEAR
            return (tried.steps < STEPS) & (far | (tried.steps == 0))

        def step(tried: _Tried) -> _Tried:
            now = jnp.sqrt(ratio(problem, state, tried.activity_bq * added, variance))
            grown = jnp.log(jnp.maximum(now, 1e-9) / jnp.maximum(tried.last_root, 1e-9))
            power = jnp.clip(grown / jnp.log(tried.activity_bq / tried.last_bq), *POWERS)
            power = jnp.where((tried.last_root > 0.0) & jnp.isfinite(power), power, 1.0)
            # a faint signal may be lost in rounding
            further = jnp.clip((reach / jnp.maximum(now, 1e-9)) ** (1.0 / power), 1.0 / FASTEST, FASTEST)
            return _Tried(
                activity_bq=tried.activity_bq * further, last_bq=tried.activity_bq, last_root=now, steps=tried.steps + 1
            )

        zero = jnp.zeros(())
        begin = _Tried(activity_bq=reach / root, last_bq=jnp.ones(()), last_root=zero, steps=jnp.int32(0))
        return jax.lax.while_loop(on, step, begin).activity_bq

    return each(of, (points_m, jnp.arange(points_m.shape[0]), start), TOGETHER)


def ratio(problem: Problem, state: State, signal: jax.Array, variance: jax.Array) -> jax.Array:
    """Twice the logarithm of the likelihood ratio [] of a source that adds ``signal`` [n, R], before dead time.

    The mean one, with the levels, the sources and what belongs to each window as in ``state``: that of the counts that
    are expected, less what the windows' own unknowns take up of chance without the source more than with it (as many
    as the data determine; twice a log likelihood is short of its mean by so much). With a background raised to what the
    source adds that is much: of a Geiger counter a third of the ratio. ``variance`` [n] is that of the logarithm of
    what it adds.
    """
    u, added = state.unknowns, state.added
    true = true_counts(problem, added, u) + signal
    share, _ = dead_time(problem, jnp.sum(true, axis=1))
    measured = replace(problem.measurements, rois=share[:, None] * true)
    expected = replace(problem, measurements=measured)
    # the place of one that is not there is free
    free = jnp.argmin(state.sources.present)
    more = Others(counts=added.counts.at[free].set(signal), variance=added.variance.at[free].set(variance))

    def mean_of(added: Others) -> jax.Array:
        own, model = alone(expected, added, u, ALONE_STEPS)
        value = log_likelihood(expected, model) + log_prior(expected, model, own)
        return 2.0 * value + normal_equations(expected, model, own).fitted

    without, with_ = jax.lax.map(mean_of, jax.tree.map(lambda *x: jnp.stack(x), added, more))
    return jnp.maximum(with_ - without, 0.0)
