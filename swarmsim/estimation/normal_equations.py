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

import jax
import jax.numpy as jnp

from swarmsim.estimation.forward import Problem, Rates, dead_time, detector_of, variance_of
from swarmsim.estimation.likelihood import poisson_log_likelihood, scaled_inverse
from swarmsim.pytree import pytree

MEAN_FLOOR = 1e-3  # counts of a region in a window; keeps an impossible count finite
LONGEST_STEP = 1.0  # of a logarithm in one Gauss-Newton step
LOWEST_SHARE = 0.1  # of the activity that is left after one step
LOOSE = 1e-4  # precision of what has no prior


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
    """Means, and how they change with the unknowns."""

    mean: jax.Array  # [n, R]
    common: jax.Array  # [n, R, P] by ln(activity), the others' factors (logarithms), levels, lengths
    own: jax.Array  # [n, R, 2] by the window's background and gain
    moved: jax.Array  # [n, R, 3] by the place
    variance: jax.Array  # [n, 2] of the priors of the window's own unknowns, background and gain
    registered: jax.Array  # [n] derivative of the registered counts of a window by the true ones


@jax.jit  # traced once for all places of a program that call it
def linearised(problem: Problem, source: Rates, others: Others, where: jax.Array, u: Unknowns) -> Linearised:
    """The model at ``u``, with the rates of the source at ``where`` [3]."""
    gain = jnp.exp(u.gain)[:, None]
    own = u.activity_bq * source.counts * gain
    rest = others.counts * u.others[:, None, None] * gain  # [K, n, R]
    signal = own + jnp.sum(rest, axis=0)
    models = detector_of(problem)
    background = problem.background * jnp.exp(models @ u.level + u.background)[:, None]
    true = signal + background
    total = jnp.sum(true, axis=1)
    share, fall = dead_time(problem, total)

    def seen(change: jax.Array) -> jax.Array:
        """Change [n, R, p] of what is registered from that of the true counts."""
        sums = jnp.sum(change, axis=1, keepdims=True)
        return share[:, None, None] * change + true[..., None] * (fall[:, None] * sums[:, 0])[:, None]

    by_lengths = jnp.moveaxis(u.activity_bq * source.slopes, 1, 2) * gain[..., None]
    by_level = background[..., None] * models[:, None]
    common = jnp.concatenate([own[..., None], jnp.moveaxis(rest, 0, 2), by_level, by_lengths], axis=-1)
    offset = where - problem.measurements.position_m
    squared = jnp.maximum(jnp.sum(offset * offset, axis=-1, keepdims=True), 0.01)
    moved = own[..., None] * (-2.0 * offset / squared)[:, None]
    return Linearised(
        mean=share[:, None] * true,
        common=seen(common),
        own=seen(jnp.stack([background, signal], axis=-1)),
        moved=seen(moved),
        registered=share + fall * total,
        variance=_variance(problem, jnp.sum(own, axis=1), jnp.sum(rest, axis=2), others, where, source.edge),
    )


def _variance(
    problem: Problem, own: jax.Array, rest: jax.Array, others: Others, where: jax.Array, edge: jax.Array
) -> jax.Array:
    """Variances [n, 2] of a window's own unknowns; a gain stands for all sources, weighted with what they add."""
    total = own + jnp.sum(rest, axis=0)
    varied = own * (variance_of(problem, where) + edge) + jnp.sum(rest * others.variance, axis=0)
    model = jnp.square(problem.model_std)
    variance = jnp.where(total > 0.0, varied / jnp.maximum(total, 1e-20), model)
    background = jnp.broadcast_to(jnp.square(problem.background_std), variance.shape)
    return jnp.clip(jnp.stack([background, variance], axis=-1), 1e-6, 1.0)


def _own_precision(problem: Problem, variance: jax.Array, u: Unknowns) -> jax.Array:
    """Precisions [n, 2] of the priors of a window's own unknowns at ``u``, from their variances.

    The gain has Student's t-distribution: its precision is that of the normal distribution with the same slope at ``u``
    (iteratively reweighted least squares: Lange, Little and Taylor, JASA 84, 1989, 881).
    """
    tail = problem.tail
    heavy = (tail + 1.0) / (tail * variance[:, 1] + jnp.square(u.gain))
    return jnp.stack([1.0 / variance[:, 0], heavy], axis=-1)


def prior_precision(problem: Problem, sources: int) -> jax.Array:
    """Precisions [P] of the unknowns that windows share."""
    loose = jnp.full(1 + sources + len(problem.detectors), LOOSE)
    lengths = 1.0 / jnp.square(jnp.maximum(problem.material_std, 1e-3))
    return jnp.concatenate([loose, lengths])


def _common(u: Unknowns) -> jax.Array:
    """The unknowns that have a prior about zero, in the order of `prior_precision`; zero for those without."""
    free = jnp.zeros(1 + u.others.shape[0] + u.level.shape[0])
    return jnp.concatenate([free, u.lengths])


@pytree
class NormalEquations:
    """Normal equations at some unknowns."""

    information: jax.Array  # [P, P] the windows' own unknowns eliminated, priors included
    push: jax.Array  # [P]
    own: jax.Array  # [n, 2, 2] inverse of the information about a window's own unknowns
    crossing: jax.Array  # [n, 2, P]
    own_push: jax.Array  # [n, 2]
    towards: jax.Array  # [3, 3]
    pull: jax.Array  # [3] derivative by the place, the unknowns marginalised
    log_volume: jax.Array  # [] of the windows' own unknowns, over that of their priors
    fitted: jax.Array  # [] how many of them the data determine


@jax.jit  # traced once for all places of a program that call it
def normal_equations(problem: Problem, model: Linearised, u: Unknowns) -> NormalEquations:
    """The normal equations at ``u``, where ``model`` is linearised."""
    m = problem.measurements
    assert m.rois is not None
    weight = jnp.where(m.valid[:, None], problem.trust / jnp.maximum(model.mean, MEAN_FLOOR), 0.0)
    left = weight * (m.rois - model.mean)
    common_precision = prior_precision(problem, u.others.shape[0])
    own_precision = _own_precision(problem, model.variance, u)
    nuisance = window_unknowns(u)
    columns = jnp.concatenate([model.common, model.moved], axis=-1)
    # products of a few numbers for each window are written as sums: a batched matrix product would be slower
    weighted = model.own * weight[..., None]
    h = jnp.sum(weighted[..., :, None] * model.own[..., None, :], axis=1) + own_precision[:, :, None] * jnp.eye(2)
    determinant = h[:, 0, 0] * h[:, 1, 1] - h[:, 0, 1] * h[:, 1, 0]
    flipped = jnp.stack([jnp.stack([h[:, 1, 1], -h[:, 0, 1]], -1), jnp.stack([-h[:, 1, 0], h[:, 0, 0]], -1)], axis=-2)
    own = flipped / determinant[:, None, None]
    crossing = jnp.stack([jnp.sum(weighted[..., a, None] * columns, axis=1) for a in range(2)], axis=1)
    own_push = jnp.einsum("nrp,nr->np", model.own, left) - own_precision * nuisance
    p = columns.shape[-1]
    whole = (columns * weight[..., None]).reshape(-1, p).T @ columns.reshape(-1, p)
    turned = jnp.sum(own[..., None] * crossing[:, None], axis=2)  # [n, 2, P]
    whole = whole - turned.reshape(-1, p).T @ crossing.reshape(-1, p)
    push = jnp.einsum("nrp,nr->p", columns, left) - jnp.sum(turned * own_push[..., None], axis=(0, 1))
    p = common_precision.shape[0]
    information = whole[:p, :p] + jnp.diag(common_precision)
    across = whole[:p, p:]
    common_push = push[:p] - common_precision * _common(u)
    inverse = scaled_inverse(information)
    return NormalEquations(
        information=information,
        push=common_push,
        own=own,
        crossing=crossing[:, :, :p],
        own_push=own_push,
        towards=whole[p:, p:] - across.T @ inverse @ across,
        pull=push[p:] - across.T @ inverse @ common_push,
        log_volume=-0.5 * jnp.sum(jnp.where(m.valid, jnp.log(determinant * jnp.prod(model.variance, axis=1)), 0.0)),
        fitted=jnp.sum(jnp.where(m.valid, 2.0 - jnp.einsum("naa,na->n", own, own_precision), 0.0)),
    )


def stepped(problem: Problem, u: Unknowns, at: NormalEquations) -> Unknowns:
    """The unknowns after a Gauss-Newton step."""
    step = jnp.clip(scaled_inverse(at.information) @ at.push, -LONGEST_STEP, LONGEST_STEP)
    own = jnp.einsum("nab,nb->na", at.own, at.own_push - jnp.einsum("nap,p->na", at.crossing, step))
    own = jnp.clip(own, -LONGEST_STEP, LONGEST_STEP)
    k, d = u.others.shape[0], u.level.shape[0]
    return Unknowns(
        activity_bq=u.activity_bq * jnp.maximum(1.0 + step[0], LOWEST_SHARE),
        others=jnp.clip(u.others * jnp.maximum(1.0 + step[1 : 1 + k], LOWEST_SHARE), 1e-3, 1e3),
        level=u.level + step[1 + k : 1 + k + d],
        lengths=u.lengths + step[1 + k + d :],
        background=u.background + own[:, 0],
        gain=u.gain + own[:, 1],
    )


def log_likelihood(problem: Problem, model: Linearised) -> jax.Array:
    """Log likelihood [] of the counts, relative to the saturated model."""
    m = problem.measurements
    assert m.rois is not None
    # it grows with the counts: a tenth of all of them are worth a tenth of it
    trusted, mean = problem.trust * m.rois, problem.trust * jnp.maximum(model.mean, MEAN_FLOOR)
    return poisson_log_likelihood(trusted, mean, m.valid[:, None])


def window_unknowns(u: Unknowns) -> jax.Array:
    """The unknowns [n, 2] that each window has to itself: background and gain."""
    return jnp.stack([u.background, u.gain], axis=-1)


def log_prior(problem: Problem, model: Linearised, u: Unknowns) -> jax.Array:
    """Log prior [] of the unknowns but the place, up to a constant."""
    shared = prior_precision(problem, u.others.shape[0]) * jnp.square(_common(u))
    relative = jnp.square(window_unknowns(u)) / model.variance
    own = relative[:, 0] + (problem.tail + 1.0) * jnp.log1p(relative[:, 1] / problem.tail)
    return -0.5 * (jnp.sum(shared) + jnp.sum(jnp.where(problem.measurements.valid, own, 0.0)))
