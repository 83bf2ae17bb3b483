"""How strong a source would have had to be for the search to notice it: the detection limit of what was measured.

The limit (ISO 11929) is the activity whose statistic exceeds what is asked with a probability of 95 %. That statistic
is a likelihood ratio, whose root has a standard deviation of 1 about the ratio of the counts as they are expected
(G. Cowan, K. Cranmer, E. Gross, O. Vitells, Eur. Phys. J. C 71 (2011) 1554). Without the source the background of each
window, and the rate of the sources that are known, take up what they can of its counts.
"""

import jax
import jax.numpy as jnp

from swarmsim.config.sources import ACTIVITY_MAX_MBQ
from swarmsim.device import each
from swarmsim.estimation.forward import Problem, silent
from swarmsim.estimation.normal_equations import LONGEST_STEP, LOOSE, MEAN_FLOOR, linearised
from swarmsim.estimation.scan import open_counts, scan, true_counts
from swarmsim.estimation.starts import Places
from swarmsim.estimation.state import State
from swarmsim.pytree import pytree

NOTICED = 1.645  # standard deviations above what is asked of a source: it has that with 95 % (ISO 11929)
MOST = 0.95  # of the places in the open, at which a source as strong as the limit would be noticed
FASTEST = 10.0  # what a step may multiply the activity by
STEPS = 8  # of the activity towards the limit, which is within 1 % then
FIT_STEPS = 4  # of Newton's, of what belongs to a window
FAINT = 0.003  # of the counts: of what is left below it the square counts, to that accuracy
TOGETHER = 8  # nuclides that an accelerator looks at side by side


@pytree
class Null:
    """The null hypothesis: what is counted without the source in question; n windows, R regions."""

    background: jax.Array  # [n, R] counts of it that are registered
    rest: jax.Array  # [n, R] those of the sources that are known
    trust: jax.Array  # [n, R] as in `Problem`; 0 where nothing was measured
    detector: jax.Array  # [n, D] one-hot
    deviation: jax.Array  # [n] of ln(background) from the level, which the counts had already
    gain: jax.Array  # [n] of ln(rate of the known sources) from the model
    precision: jax.Array  # [2, n] of the priors of those


def noticed(problem: Problem, places: Places, allowed: jax.Array, asked: jax.Array, state: State) -> jax.Array:
    """Activities [N] in Bq from which on a source beside those of ``state`` is noticed, at `MOST` of the open places.

    Infinite for nuclides that are not ``allowed`` [N], and where it would have to be stronger than any. Twice the
    logarithm of its likelihood ratio must reach ``asked`` [].
    """
    allowed, points = jnp.asarray(allowed), jnp.asarray(places.points_m)
    information = scan(problem, points, allowed, state.added, state.unknowns).information
    weak = jnp.argsort(information, axis=0)[int((1.0 - MOST) * points.shape[0])]
    activity = limits(problem, state, points[weak], asked)
    return jnp.where(allowed & (activity < 1e6 * ACTIVITY_MAX_MBQ), activity, jnp.inf)


def limits(problem: Problem, state: State, points_m: jax.Array, asked: jax.Array) -> jax.Array:
    """Activities [N] in Bq at the detection limit, each nuclide at its own of ``points_m`` [N, 3], in the open."""
    u, others = state.unknowns, state.added
    model = linearised(problem, silent(problem), others, jnp.zeros(3), u)
    mean, true = model.mean.T, true_counts(problem, others, u)
    share = mean / jnp.maximum(true, MEAN_FLOOR)
    background = problem.background * jnp.exp(problem.detector @ u.level + u.background)[:, None]
    background_variance, of_gain = model.variance
    # Student's t of a window's gain, about its middle: see `normal_equations`
    of_gain = of_gain * problem.tail / (problem.tail + 1.0)
    null = Null(
        background=share * background,
        rest=share * (true - background),
        trust=jnp.where(problem.measurements.valid[:, None], problem.trust, 0.0),
        detector=problem.detector,
        deviation=u.background,
        gain=u.gain,
        precision=1.0 / jnp.stack([background_variance, of_gain]),
    )
    share_of_sum = (jnp.sum(mean, axis=1) / jnp.maximum(jnp.sum(true, axis=1), MEAN_FLOOR))[:, None]
    reach = jnp.sqrt(asked) + NOTICED

    def of(one: tuple[jax.Array, jax.Array]) -> jax.Array:
        added = share_of_sum * open_counts(problem, *one)
        faint, levelled = information_of(null, added)

        def step(_: int, activity: jax.Array) -> jax.Array:
            root = jnp.sqrt(jnp.maximum(levelled * ratio(null, activity * added), 0.0))
            # a faint signal may be lost in what windows deviate by already
            return activity * jnp.minimum(reach / jnp.maximum(root, 1e-9), FASTEST)

        return jax.lax.fori_loop(0, STEPS, step, reach / jnp.sqrt(jnp.maximum(levelled * faint, 1e-37)))

    return each(of, (points_m, jnp.arange(points_m.shape[0])), TOGETHER)


def ratio(null: Null, signal: jax.Array) -> jax.Array:
    """Twice the logarithm of the likelihood ratio [] of counts that have a ``signal`` [n, R], as they are expected."""
    counts = jnp.maximum(null.background + null.rest + signal, MEAN_FLOOR)
    without, with_ = (unexplained(null, rest, counts) for rest in (null.rest, null.rest + signal))
    return jnp.sum(without - with_)


def unexplained(null: Null, rest: jax.Array, counts: jax.Array) -> jax.Array:
    """Twice the logarithm of the posterior [n] that is missing to one which has exactly the ``counts`` [n, R].

    The background of each window and the gain of the ``rest`` [n, R] are fitted.
    """
    before, (p, q) = jnp.stack([null.deviation, null.gain]), null.precision

    def parts(own: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        changed = jnp.exp(own - before)[..., None]
        background, others = null.background * changed[0], rest * changed[1]
        return background, others, jnp.maximum(background + others, MEAN_FLOOR)

    def step(_: int, own: jax.Array) -> jax.Array:
        background, others, mean = parts(own)
        left, weight = null.trust * (counts / mean - 1.0), null.trust / mean
        a = jnp.sum(weight * background * background, axis=1) + p
        b = jnp.sum(weight * background * others, axis=1)
        d = jnp.sum(weight * others * others, axis=1) + q
        one = jnp.sum(left * background, axis=1) - p * own[0]
        other = jnp.sum(left * others, axis=1) - q * own[1]
        change = jnp.stack([d * one - b * other, a * other - b * one]) / (a * d - b * b)
        return own + jnp.clip(change, -LONGEST_STEP, LONGEST_STEP)

    own = jax.lax.fori_loop(0, FIT_STEPS, step, before)
    mean = parts(own)[2]
    gap = counts - mean
    # the two terms nearly cancel where little is left
    little = jnp.abs(gap) < FAINT * mean
    more = jnp.where(little, 0.0, gap)
    missed = jnp.where(little, gap * gap / mean, 2.0 * (counts * jnp.log1p(more / mean) - more))
    held = p * (jnp.square(own[0]) - jnp.square(before[0])) + q * (jnp.square(own[1]) - jnp.square(before[1]))
    return jnp.sum(null.trust * missed, axis=1) + held


def information_of(null: Null, added: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Information [] (1/Bq^2) about the activity of a faint source that adds ``added`` [n, R] per Bq.

    The windows' backgrounds and gains are not known. And the share [] of it that is left where the levels of the
    detector models are not known either.
    """
    weight = null.trust / jnp.maximum(null.background + null.rest, MEAN_FLOOR)

    def product(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.sum(weight * a * b, axis=1)

    background, rest = null.background, null.rest
    levels, crossing = product(background, background), product(background, rest)
    by_background, by_rest = product(background, added), product(rest, added)
    a, d = levels + null.precision[0], product(rest, rest) + null.precision[1]
    determinant = a * d - crossing * crossing

    def eliminated(x: tuple[jax.Array, jax.Array], y: tuple[jax.Array, jax.Array]) -> jax.Array:
        """What the window's own unknowns take of a product."""
        return (d * x[0] * y[0] - crossing * (x[0] * y[1] + x[1] * y[0]) + a * x[1] * y[1]) / determinant

    source, level = (by_background, by_rest), (levels, crossing)
    own = jnp.sum(product(added, added) - eliminated(source, source))
    both = null.detector.T @ (by_background - eliminated(source, level))
    alone = null.detector.T @ (levels - eliminated(level, level)) + LOOSE
    left = own - jnp.sum(jnp.square(both) / alone)
    return own, jnp.clip(left / jnp.maximum(own, 1e-37), 0.0, 1.0)
