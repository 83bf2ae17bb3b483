"""Counts by region of interest of several sources, and their posterior with everything else marginalised.

For a place of one source the following are unknown besides, and fitted together by Gauss-Newton steps:

- the activity of that source, and those of the others;
- the level of each detector model's background, and its deviation in every window (a normal prior of its logarithm);
- a factor of the path length in each uncertain material (a normal prior of its logarithm);
- in every window a factor of what all sources add (Student's t of its logarithm): what the model does not know of
  scattering, poses and walls.

What belongs to one window is eliminated there (Schur complement), so that the cost grows with the windows and not with
their square.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.device import on_processor
from swarmsim.estimation.forward import MOST_BY_LENGTHS, Problem, Rates, Rest, dead_time, variance_of
from swarmsim.estimation.likelihood import poisson_log_likelihood, scaled_inverse
from swarmsim.pytree import pytree

MEAN_FLOOR = 1e-3  # counts of a region in a window; keeps an impossible count finite
LONGEST_STEP = 1.0  # of a logarithm in one Gauss-Newton step; of the activity's, what does not make up for lengths
LOWEST_SHARE = 0.1  # of the activity that is left after one step, but for what makes up for lengths
LOOSE = 1e-4  # precision of what has no prior
LEAST_STD = 1e-3  # of a logarithm of lengths


@pytree
class Unknowns:
    """What is fitted at a place; K sources, D detector models, U materials, n windows."""

    activity_bq: jax.Array  # [] of the source whose place is given
    others: jax.Array  # [K] factors of the other sources' rates
    level: jax.Array  # [D] ln(background over nominal)
    lengths: jax.Array  # [U] ln(true over presumed length) in each uncertain material
    background: jax.Array  # [n] deviation of ln(background)
    gain: jax.Array  # [n] deviation of ln(rate of the sources)


@pytree
class Others:
    """What sources other than the one sought add; K of them."""

    counts: jax.Array  # [K, n, R] before dead time; zero for one that is not there
    variance: jax.Array  # [K, n] of ln(true over modelled rate)


def nothing_known(problem: Problem, sources: int) -> Unknowns:
    """Where fits start: nominal background, presumed materials."""
    n = problem.background.shape[0]
    return Unknowns(
        activity_bq=jnp.zeros(()),
        others=jnp.ones(sources),
        level=jnp.zeros(len(problem.detectors)),
        lengths=jnp.zeros(problem.material_std.shape[0]),
        background=jnp.zeros(n),
        gain=jnp.zeros(n),
    )


@pytree
class Linearised:
    """Means, and how they change with the unknowns. Windows come last, so that several are computed at a time.

    The B = 1 + K + 1 + U columns are those of ln(activity), of the logarithms of the others' factors, of the logarithm
    of all background, and of lengths: the unknowns that windows share, and a window's own, act through these.
    """

    mean: jax.Array  # [R, n]
    columns: jax.Array  # [B, R, n]
    nearer: jax.Array  # [3, n] change of ln(rate of the source) with its place
    where: jax.Array  # [3] that place, in the world
    variance: jax.Array  # [2, n] of the priors of a window's own unknowns, background and gain
    registered: jax.Array  # [n] derivative of the registered counts of a window by the true ones


@jax.jit  # traced once for all places of a program that call it
def linearised(problem: Problem, source: Rates, others: Others, where: jax.Array, u: Unknowns) -> Linearised:
    """The model at ``u``, with the rates of the source at ``where`` [3]."""
    gain = jnp.exp(u.gain)
    own = u.activity_bq * source.counts.T * gain
    rest = jnp.swapaxes(others.counts, 1, 2) * u.others[:, None, None] * gain  # [K, R, n]
    background = problem.background.T * jnp.exp(u.level @ problem.detector.T + u.background)
    by_lengths = u.activity_bq * jnp.moveaxis(source.slopes, 0, 2) * gain
    added = jnp.concatenate([own[None], rest, background[None], by_lengths])
    true = own + jnp.sum(rest, axis=0) + background
    total = jnp.sum(true, axis=0)
    share, fall = dead_time(problem, total)
    offset = where - problem.measurements.position_m
    squared = jnp.maximum(jnp.sum(offset * offset, axis=-1, keepdims=True), 0.01)
    return Linearised(
        mean=share * true,
        # what is registered of a change of the true counts
        columns=share * added + true * (fall * jnp.sum(added, axis=1))[:, None],
        nearer=(-2.0 * offset / squared).T,
        where=where,
        registered=share + fall * total,
        variance=_variance(problem, jnp.sum(own, axis=0), jnp.sum(rest, axis=1), others, where, source.edge),
    )


def of_window(columns: jax.Array, sources: int) -> jax.Array:
    """Columns [2, ...] of a window's background and gain, from all [B, ...] with so many other ``sources``."""
    return jnp.stack([columns[1 + sources], jnp.sum(columns[: 1 + sources], axis=0)])


def inverse_of_two(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Inverse [2, 2, n] and determinant [n] of matrices [2, 2, n]."""
    determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    turned = jnp.stack([jnp.stack([matrix[1, 1], -matrix[0, 1]]), jnp.stack([-matrix[1, 0], matrix[0, 0]])])
    return turned / determinant, determinant


def _variance(
    problem: Problem, own: jax.Array, rest: jax.Array, others: Others, where: jax.Array, edge: jax.Array
) -> jax.Array:
    """Variances [2, n] of a window's own unknowns; a gain stands for all sources, weighted with what they add."""
    total = own + jnp.sum(rest, axis=0)
    varied = own * (variance_of(problem, where) + edge) + jnp.sum(rest * others.variance, axis=0)
    model = jnp.square(problem.model_std)
    variance = jnp.where(total > 0.0, varied / jnp.maximum(total, 1e-20), model)
    background = jnp.broadcast_to(jnp.square(problem.background_std), variance.shape)
    return jnp.clip(jnp.stack([background, variance]), 1e-6, 1.0)


def _own_precision(problem: Problem, variance: jax.Array, u: Unknowns) -> jax.Array:
    """Precisions [2, n] of the priors of a window's own unknowns at ``u``, from their variances.

    The gain has Student's t-distribution: its precision is that of the normal distribution with the same slope at ``u``
    (iteratively reweighted least squares: Lange, Little and Taylor, JASA 84, 1989, 881).
    """
    tail = problem.tail
    heavy = (tail + 1.0) / (tail * variance[1] + jnp.square(u.gain))
    return jnp.stack([1.0 / variance[0], heavy])


def prior_precision(problem: Problem, sources: int) -> jax.Array:
    """Precisions [P] of the unknowns that windows share."""
    loose = jnp.full(1 + sources + len(problem.detectors), LOOSE)
    lengths = 1.0 / jnp.square(jnp.maximum(problem.material_std, LEAST_STD))
    return jnp.concatenate([loose, lengths])


def log_prior_of_lengths(problem: Problem, lengths: jax.Array) -> jax.Array:
    """Log prior [] of ``lengths`` [U], up to a constant; a part of `log_prior`."""
    return -0.5 * jnp.sum(jnp.square(lengths / jnp.maximum(problem.material_std, LEAST_STD)))


def _common(u: Unknowns) -> jax.Array:
    """The unknowns that have a prior about zero, in the order of `prior_precision`; zero for those without."""
    free = jnp.zeros(1 + u.others.shape[0] + u.level.shape[0])
    return jnp.concatenate([free, u.lengths])


@pytree
class NormalEquations:
    """Normal equations at some unknowns; windows come last."""

    information: jax.Array  # [P, P] the windows' own unknowns eliminated, priors included
    push: jax.Array  # [P]
    own: jax.Array  # [2, 2, n] inverse of the information about a window's own unknowns
    crossing: jax.Array  # [2, B, n] of those with the columns of `Linearised`
    own_push: jax.Array  # [2, n]
    towards: jax.Array  # [3, 3]
    pull: jax.Array  # [3] derivative by the place, the unknowns marginalised
    log_volume: jax.Array  # [] of the windows' own unknowns, over that of their priors
    precision: jax.Array  # [2, n] of the priors of a window's own unknowns, there
    fitted: jax.Array  # [] how many of them the data determine


@pytree
class Eliminated:
    """Normal equations of the columns of `Linearised` in each window, its own unknowns eliminated."""

    products: jax.Array  # [B, B, n]
    pushes: jax.Array  # [B, n]
    own: jax.Array  # [2, 2, n] as in `NormalEquations`, and so on
    crossing: jax.Array  # [2, B, n]
    own_push: jax.Array  # [2, n]
    precision: jax.Array  # [2, n]
    determinant: jax.Array  # [n] of the information about a window's own unknowns


def eliminated(problem: Problem, model: Linearised, u: Unknowns) -> Eliminated:
    """The windows' own unknowns eliminated at ``u``, where ``model`` is linearised."""
    m, k = problem.measurements, u.others.shape[0]
    assert m.rois is not None
    columns = model.columns
    weight = jnp.where(m.valid, problem.trust.T / jnp.maximum(model.mean, MEAN_FLOOR), 0.0)
    left = weight * (m.rois.T - model.mean)
    products, pushes = _products(columns * weight, columns), jnp.sum(columns * left, axis=1)
    crossing = of_window(products, k)
    precision = _own_precision(problem, model.variance, u)
    h = of_window(jnp.swapaxes(crossing, 0, 1), k) + precision[:, None] * jnp.eye(2)[..., None]
    own, determinant = inverse_of_two(h)
    own_push = of_window(pushes, k) - precision * window_unknowns(u)
    turned = own[:, 0, None] * crossing[0] + own[:, 1, None] * crossing[1]  # [2, B, n]
    return Eliminated(
        products=products - (turned[0][:, None] * crossing[0] + turned[1][:, None] * crossing[1]),
        pushes=pushes - (turned[0] * own_push[0] + turned[1] * own_push[1]),
        own=own,
        crossing=crossing,
        own_push=own_push,
        precision=precision,
        determinant=determinant,
    )


@jax.jit  # traced once for all places of a program that call it
def normal_equations(problem: Problem, model: Linearised, u: Unknowns) -> NormalEquations:
    """The normal equations at ``u``, where ``model`` is linearised."""
    m, k = problem.measurements, u.others.shape[0]
    e = eliminated(problem, model, u)
    whole, push = sums_of(problem, model, k, e)
    if problem.rest is not None:
        more, towards = _of_rest(problem.rest, model, u)
        whole, push = whole + more, push + towards
    common_precision = prior_precision(problem, k)
    p = common_precision.shape[0]
    information = whole[:p, :p] + jnp.diag(common_precision)
    across = whole[:p, p:]
    common_push = push[:p] - common_precision * _common(u)
    inverse = scaled_inverse(information)
    told = e.own[0, 0] * e.precision[0] + e.own[1, 1] * e.precision[1]
    return NormalEquations(
        information=information,
        push=common_push,
        own=e.own,
        crossing=e.crossing,
        own_push=e.own_push,
        towards=whole[p:, p:] - across.T @ inverse @ across,
        pull=push[p:] - across.T @ inverse @ common_push,
        log_volume=-0.5 * jnp.sum(jnp.where(m.valid, jnp.log(e.determinant * jnp.prod(model.variance, axis=0)), 0.0)),
        precision=e.precision,
        fitted=jnp.sum(jnp.where(m.valid, 2.0 - told, 0.0)),
    )


def sums_of(
    problem: Problem, model: Linearised, sources: int, e: Eliminated, share: jax.Array | float = 1.0
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """Normal equations [P + 3, P + 3], [P + 3] of the unknowns that windows share and the place, without priors.

    With a ``share`` [n] of each window, and so many ``sources`` besides the one sought.
    """
    column, factor = _unknowns(problem, model, sources)
    whole = jnp.sum(e.products[column][:, column] * factor[:, None] * (factor * share), axis=-1)
    return whole, jnp.sum(e.pushes[column] * (factor * share), axis=-1)


def unknowns_of(model: Linearised, u: Unknowns) -> jax.Array:
    """The unknowns [P + 3] that windows share and the place in the world, in the order of `Rest`."""
    of_sources = jnp.log(jnp.maximum(jnp.append(u.activity_bq, u.others), 1e-3))
    return jnp.concatenate([of_sources, u.level, u.lengths, model.where])


def _of_rest(rest: Rest, model: Linearised, u: Unknowns) -> tuple[jax.Array, jax.Array]:
    """The normal equations of the windows that are left out, at ``u``."""
    off = unknowns_of(model, u) - rest.unknowns
    return rest.information, rest.push - rest.information @ off


def _log_likelihood_of(rest: Rest, model: Linearised, u: Unknowns) -> jax.Array:
    """Log likelihood [] of the windows that are left out, up to a constant."""
    off = unknowns_of(model, u) - rest.unknowns
    return off @ rest.push - 0.5 * off @ rest.information @ off


@jax.jit
def joint_equations(
    problem: Problem, model: Linearised, u: Unknowns, places_m: jax.Array
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """Normal equations [4 K, 4 K], [4 K] of (x, y, height, log activity) of each of the sources at ``places_m`` [K, 3].

    Places are in the world. The levels are eliminated; as if nothing were in the way. ``model`` has no source but the K
    others.
    """
    count, levels = u.others.shape[0], len(problem.detectors)
    e = eliminated(problem, model, u)
    offset = places_m[:, None] - problem.measurements.position_m
    squared = jnp.maximum(jnp.sum(offset * offset, axis=-1, keepdims=True), 0.01)
    nearer = jnp.concatenate([-2.0 * offset / squared, jnp.ones_like(squared)], axis=-1)  # [K, n, 4]
    factor = jnp.concatenate([jnp.swapaxes(nearer, 1, 2).reshape(4 * count, -1), problem.detector.T])
    column = np.array([*np.repeat(1 + np.arange(count), 4), *[1 + count] * levels])
    whole = jnp.sum(e.products[column][:, column] * factor[:, None] * factor, axis=-1)
    push = jnp.sum(e.pushes[column] * factor, axis=-1)
    own, across = whole[: 4 * count, : 4 * count], whole[: 4 * count, 4 * count :]
    of_levels = across @ scaled_inverse(whole[4 * count :, 4 * count :] + LOOSE * jnp.eye(levels))
    return own - of_levels @ across.T, push[: 4 * count] - of_levels @ push[4 * count :]


def _products(one: jax.Array, other: jax.Array) -> jax.Array:
    """Sums over the regions [A, B, n] of products of [A, R, n] and [B, R, n].

    The regions are few, and a sum that is written out is computed for several windows at a time.
    """
    if on_processor():
        return functools.reduce(jnp.add, (one[:, None, r] * other[:, r] for r in range(one.shape[1])))
    return jnp.sum(one[:, None] * other, axis=2)


def _unknowns(problem: Problem, model: Linearised, sources: int) -> tuple[np.ndarray, jax.Array]:
    """The column of each of the P unknowns that windows share and of the 3 of the place; its factor [P + 3, n]."""
    levels, last = len(problem.detectors), model.columns.shape[0]
    background = 1 + sources
    column = [*range(background), *[background] * levels, *range(background + 1, last), 0, 0, 0]
    ones = jnp.ones((1, model.nearer.shape[1]))
    parts = [ones.repeat(background, 0), problem.detector.T, ones.repeat(last - background - 1, 0), model.nearer]
    return np.array(column), jnp.concatenate(parts)


def stepped(problem: Problem, u: Unknowns, at: NormalEquations) -> Unknowns:
    """The unknowns after a Gauss-Newton step.

    What a source adds is proportional to its activity and falls exponentially with the lengths. Behind walls that are
    not as presumed both are far off together: the activity makes up for what the change of the lengths does to the
    counts, and is changed by the rest of its own step besides.
    """
    step = scaled_inverse(at.information) @ at.push
    k, d = u.others.shape[0], u.level.shape[0]
    (source, *_), others, levels, lengths = jnp.split(step, [1, 1 + k, 1 + k + d])
    # the logarithm of what the source adds changes with those of the lengths by so much, on the whole
    slope = at.information[0, 1 + k + d :] / at.information[0, 0]
    unclipped = source + slope @ lengths, others, levels, lengths
    added, others, levels, lengths = (jnp.clip(x, -LONGEST_STEP, LONGEST_STEP) for x in unclipped)
    sources, background = jnp.append(added - slope @ lengths, others), levels @ problem.detector.T
    taken = (
        jnp.einsum("abn,b->an", at.crossing[:, : 1 + k], sources)
        + at.crossing[:, 1 + k] * background
        + jnp.einsum("abn,b->an", at.crossing[:, 2 + k :], lengths)
    )
    rest = at.own_push - taken
    own = jnp.clip(at.own[:, 0] * rest[0] + at.own[:, 1] * rest[1], -LONGEST_STEP, LONGEST_STEP)
    # for what they change, as `lengthened` has it
    made_up = jnp.exp(-jnp.clip(slope @ jnp.expm1(lengths), -MOST_BY_LENGTHS, MOST_BY_LENGTHS))
    return Unknowns(
        activity_bq=u.activity_bq * jnp.maximum(1.0 + added, LOWEST_SHARE) * made_up,
        others=jnp.clip(u.others * jnp.maximum(1.0 + others, LOWEST_SHARE), 1e-3, 1e3),
        level=u.level + levels,
        lengths=u.lengths + lengths,
        background=u.background + own[0],
        gain=u.gain + own[1],
    )


def log_likelihood(problem: Problem, model: Linearised) -> jax.Array:
    """Log likelihood [] of the counts, relative to the saturated model."""
    m = problem.measurements
    assert m.rois is not None
    # it grows with the counts: a tenth of all of them are worth a tenth of it
    trust = problem.trust.T
    return poisson_log_likelihood(trust * m.rois.T, trust * jnp.maximum(model.mean, MEAN_FLOOR), m.valid)


def window_unknowns(u: Unknowns) -> jax.Array:
    """The unknowns [2, n] that each window has to itself: background and gain."""
    return jnp.stack([u.background, u.gain])


def log_prior(problem: Problem, model: Linearised, u: Unknowns) -> jax.Array:
    """Log prior [] of the unknowns but the place, up to a constant; with what windows that are left out tell."""
    shared = prior_precision(problem, u.others.shape[0]) * jnp.square(_common(u))
    relative = jnp.square(window_unknowns(u)) / model.variance
    own = relative[0] + (problem.tail + 1.0) * jnp.log1p(relative[1] / problem.tail)
    prior = -0.5 * (jnp.sum(shared) + jnp.sum(jnp.where(problem.measurements.valid, own, 0.0)))
    return prior if problem.rest is None else prior + _log_likelihood_of(problem.rest, model, u)
