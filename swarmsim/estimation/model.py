"""Counts by region of interest of several sources, and their posterior with everything else marginalised.

For a place of one source the following are unknown besides, and fitted together by Gauss-Newton steps:

- the activity of that source, and those of the others;
- the level of each detector model's background, and its deviation in every window (a normal prior of its logarithm);
- a factor of the path length in each material (a normal prior of its logarithm);
- a common factor of what the sources add in every window: what the model does not know of scattering, poses and walls.

What belongs to one window is eliminated there (Schur complement), so that the cost grows with the windows and not with
their square. The value at a place is the logarithm of the posterior after all of them are integrated out (Laplace's
approximation): the shape of the spectrum then tells a source from a background that varies from place to place.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.estimation.likelihood import height_precision, scaled_inverse, travel_gain
from swarmsim.estimation.measurements import Measurements
from swarmsim.pytree import pytree, static
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.rate import roi_rates_and_slopes
from swarmsim.site import Site, sample
from swarmsim.site.rays import Crossed, crossed_from

MEAN_FLOOR = 1e-3  # counts of a region in a window; keeps an impossible count finite
LONGEST_STEP = 1.0  # of a logarithm in one Gauss-Newton step
LOWEST_SHARE = 0.1  # of the activity that is left after one step
EDGE_SHARE = 0.11  # of the variance between a window's rays: an edge lies anywhere between two of them
LOOSE = 1e-4  # precision of what has no prior


Span = tuple[int, int, int, int]
"""Rows from, to, their detector model, and the rays to each window along its way."""


@pytree
class Problem:
    """Everything that the estimate of sources is conditioned on."""

    site: Site
    detectors: tuple[Detector, ...]
    measurements: Measurements  # n windows, detector by detector; ``rois`` [n, R]
    background: jax.Array  # [n, R] counts expected at the nominal level, over an even ground
    material_std: jax.Array  # [M] prior of ln(true over presumed length); 0: exact
    background_std: jax.Array  # [] of a window's ln(background over the detector's level)
    model_std: jax.Array  # [] of a window's ln(true over modelled rate of the sources)
    pose_std_m: jax.Array  # [n] of a window's place
    height_m: jax.Array  # [] prior of a source's height above ground
    height_std_m: jax.Array  # []
    spans: tuple[Span, ...] = static()


@pytree
class Unknowns:
    """What is fitted at a place; K sources, D detector models, M materials, n windows."""

    activity_bq: jax.Array  # [] of the source whose place is given
    others: jax.Array  # [K] factors of the other sources' rates
    level: jax.Array  # [D] ln(background over nominal)
    lengths: jax.Array  # [M] ln(true over presumed length)
    background: jax.Array  # [n] deviation of ln(background)
    gain: jax.Array  # [n] deviation of ln(rate of the sources)


@pytree
class Rates:
    """What a source of 1 Bq adds, before dead time."""

    counts: jax.Array  # [n, R]
    slopes: jax.Array  # [n, M, R] their derivatives by ln(length in each material)
    edge: jax.Array  # [n] variance of their logarithm from shadows' edges that the window crosses


@pytree
class Settled:
    """The fit at one place."""

    value: jax.Array  # [] logarithm of the posterior, integrated over the unknowns
    likelihood: jax.Array  # [] that of the likelihood and the priors at the unknowns' best values
    unknowns: Unknowns
    covariance: jax.Array  # [P, P] of ln(activity), the others' factors, levels and lengths, the place held
    towards: jax.Array  # [3, 3] information about the place, the unknowns marginalised; as if nothing were in the way
    rates: Rates  # of the source, with the lengths of the fit


@pytree
class Others:
    """What sources other than the one sought add; K of them."""

    counts: jax.Array  # [K, n, R] before dead time; zero for one that is not there
    variance: jax.Array  # [K, n] of ln(true over modelled rate)


@pytree
class Ways:
    """What lies between a place and the windows."""

    crossed: tuple[Crossed, ...]  # for each span [rays m, M]
    position_m: jax.Array  # [3] of the place


def position_of(site: Site, place: jax.Array) -> jax.Array:
    """World position [3] of ``place`` [3] (x, y, height above the ground)."""
    return jnp.stack([place[0], place[1], sample(site.terrain_m, site, place[:2]) + place[2]])


def crystals(problem: Problem, span: Span) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Places [rays m, 3] along the ways of a span's m windows, the crystal's axes there, and the shares of each [rays].

    With one ray a window has its middle; with more the first and the last end of the way are among them, so that a
    shadow's edge that a window crosses is seen in the spread between its rays.
    """
    first, last, _, rays = span
    m = problem.measurements
    position, travel, axis = (x[first:last] for x in (m.position_m, m.travel_m, m.axis))
    if rays == 1:
        return position, axis, jnp.ones(1)
    node = jnp.linspace(-0.5, 0.5, rays)
    share = jnp.ones(rays).at[jnp.array([0, rays - 1])].set(0.5) / (rays - 1)
    along = position[:, None] + node[:, None] * travel[:, None]
    return along.reshape(-1, 3), jnp.repeat(axis, rays, axis=0), share


def ways_from(problem: Problem, place: jax.Array) -> Ways:
    """What lies between ``place`` [3] (x, y, height above the ground) and the windows."""
    position, materials = position_of(problem.site, place), len(problem.site.material_names)
    found = []
    for span in problem.spans:
        ends = crystals(problem, span)[0]
        zero = jnp.zeros((ends.shape[0], materials))
        used = jnp.any(problem.measurements.valid[span[0] : span[1]])
        found.append(
            jax.lax.cond(
                used,
                lambda ends=ends: crossed_from(problem.site, position, ends),
                lambda zero=zero: Crossed(length_m=zero, place=zero),
            )
        )
    return Ways(crossed=tuple(found), position_m=position)


def rates(problem: Problem, ways: Ways, nuclide: jax.Array, lengths: jax.Array) -> Rates:
    """Counts per Bq of a source of ``nuclide``; ``lengths`` [M] are logarithms of the factors of the path lengths."""
    source = Source(position_m=ways.position_m, activity_bq=jnp.ones(()), nuclide=nuclide)
    parts = []
    for span, crossed in zip(problem.spans, ways.crossed, strict=True):
        way = Crossed(length_m=crossed.length_m * jnp.exp(lengths), place=crossed.place)

        def seen(span: Span = span, way: Crossed = way) -> Rates:
            return _rates_of_span(problem, span, source, way)

        def nothing(seen: Any = seen) -> Any:
            return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(seen))

        used = jnp.any(problem.measurements.valid[span[0] : span[1]])
        parts.append(jax.lax.cond(used, seen, nothing))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def _rates_of_span(problem: Problem, span: Span, source: Source, way: Crossed) -> Rates:
    first, last, number, rays = span
    position, axis, share = crystals(problem, span)
    offset = position - source.position_m
    rate, slope = roi_rates_and_slopes(problem.detectors[number], source, way, position, axis)
    m = problem.measurements
    gain = travel_gain(offset, m.travel_m[first:last]) if rays == 1 else jnp.ones(offset.shape[0])
    exposure = m.exposure_s[first:last]

    def over_windows(x: jax.Array) -> jax.Array:
        ones = [1] * (x.ndim - 1)
        each = (x * gain.reshape(-1, *ones)).reshape(-1, rays, *x.shape[1:])
        mean = jnp.sum(each * share.reshape(-1, *ones), axis=1)
        return padded(mean, problem.background.shape[1]) * exposure.reshape(-1, *ones)

    strength = (jnp.sum(rate, axis=1) * jnp.sum(offset * offset, axis=1)).reshape(-1, rays)
    mean = jnp.sum(share * strength, axis=1)
    spread = jnp.sum(share * jnp.square(strength - mean[:, None]), axis=1) / jnp.maximum(jnp.square(mean), 1e-30)
    edge = EDGE_SHARE * jnp.where(mean > 0.0, spread, 0.0)
    return Rates(counts=over_windows(rate), slopes=over_windows(slope), edge=edge)


def padded(values: jax.Array, regions: int) -> jax.Array:
    """The same with zeros up to so many regions on the last axis."""
    return jnp.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, regions - values.shape[-1])])


def dead_time(problem: Problem, counts: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Share [n] of the true counts [n] of each window that is registered, and its derivative by them."""
    exposure = jnp.maximum(problem.measurements.exposure_s, 1e-9)
    shares, slopes = [], []
    for first, last, number, _ in problem.spans:
        d, live = problem.detectors[number], exposure[first:last]
        rate = counts[first:last] / live
        share = jnp.exp(-rate * d.paralyzable_s) / (1.0 + rate * d.non_paralyzable_s)
        fall = d.paralyzable_s + d.non_paralyzable_s / (1.0 + rate * d.non_paralyzable_s)
        shares.append(share)
        slopes.append(-share * fall / live)
    return jnp.concatenate(shares), jnp.concatenate(slopes)


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
class _Linear:
    """Means, and how they change with the unknowns."""

    mean: jax.Array  # [n, R]
    common: jax.Array  # [n, R, P] by ln(activity), the others' factors (logarithms), levels, lengths
    own: jax.Array  # [n, R, 2] by the window's background and gain
    moved: jax.Array  # [n, R, 3] by the place
    precision: jax.Array  # [n, 2] of the priors of the window's own unknowns


def detector_of(problem: Problem) -> jax.Array:
    """One-hot [n, D]: the detector model of each row."""
    rows = [jnp.full(last - first, number) for first, last, number, _ in problem.spans]
    return jax.nn.one_hot(jnp.concatenate(rows), len(problem.detectors))


def _linear(problem: Problem, source: Rates, others: Others, where: jax.Array, u: Unknowns) -> _Linear:
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
    return _Linear(
        mean=share[:, None] * true,
        common=seen(common),
        own=seen(jnp.stack([background, signal], axis=-1)),
        moved=seen(moved),
        precision=_precision(problem, jnp.sum(own, axis=1), jnp.sum(rest, axis=2), others, where, source.edge),
    )


def variance_of(problem: Problem, where: jax.Array) -> jax.Array:
    """Variance [n] of ln(true over modelled rate) of a source at ``where`` [3], from the model and the poses."""
    offset = where - problem.measurements.position_m
    squared = jnp.maximum(jnp.sum(offset * offset, axis=-1), 0.01)
    return jnp.square(problem.model_std) + 4.0 * jnp.square(problem.pose_std_m) / squared


def _precision(
    problem: Problem, own: jax.Array, rest: jax.Array, others: Others, where: jax.Array, edge: jax.Array
) -> jax.Array:
    """Precisions [n, 2] of a window's own unknowns; a gain stands for all sources, weighted with what they add."""
    total = own + jnp.sum(rest, axis=0)
    varied = own * (variance_of(problem, where) + edge) + jnp.sum(rest * others.variance, axis=0)
    model = jnp.square(problem.model_std)
    variance = jnp.where(total > 0.0, varied / jnp.maximum(total, 1e-20), model)
    background = jnp.broadcast_to(jnp.square(problem.background_std), variance.shape)
    return 1.0 / jnp.clip(jnp.stack([background, variance], axis=-1), 1e-6, 1.0)


def _prior(problem: Problem, sources: int) -> jax.Array:
    """Precisions [P] of the unknowns that windows share."""
    loose = jnp.full(1 + sources + len(problem.detectors), LOOSE)
    lengths = 1.0 / jnp.square(jnp.maximum(problem.material_std, 1e-3))
    return jnp.concatenate([loose, lengths])


def _common(u: Unknowns) -> jax.Array:
    """The unknowns that have a prior about zero, in the order of `_prior`; zero for those without."""
    free = jnp.zeros(1 + u.others.shape[0] + u.level.shape[0])
    return jnp.concatenate([free, u.lengths])


@pytree
class _Normal:
    """Normal equations at some unknowns."""

    information: jax.Array  # [P, P] the windows' own unknowns eliminated, priors included
    push: jax.Array  # [P]
    own: jax.Array  # [n, 2, 2] inverse of the information about a window's own unknowns
    crossing: jax.Array  # [n, 2, P]
    own_push: jax.Array  # [n, 2]
    towards: jax.Array  # [3, 3]
    log_volume: jax.Array  # [] of the windows' own unknowns, over that of their priors
    fitted: jax.Array  # [] how many of them the data determine


def _normal(problem: Problem, model: _Linear, u: Unknowns) -> _Normal:
    m = problem.measurements
    assert m.rois is not None
    weight = jnp.where(m.valid[:, None], 1.0 / jnp.maximum(model.mean, MEAN_FLOOR), 0.0)
    left = weight * (m.rois - model.mean)
    common_precision, own_precision = _prior(problem, u.others.shape[0]), model.precision
    nuisance = jnp.stack([u.background, u.gain], axis=-1)
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
    inverse = scaled_inverse(information)
    return _Normal(
        information=information,
        push=push[:p] - common_precision * _common(u),
        own=own,
        crossing=crossing[:, :, :p],
        own_push=own_push,
        towards=whole[p:, p:] - across.T @ inverse @ across,
        log_volume=-0.5 * jnp.sum(jnp.where(m.valid, jnp.log(determinant / jnp.prod(own_precision, axis=1)), 0.0)),
        fitted=jnp.sum(jnp.where(m.valid, 2.0 - jnp.einsum("naa,na->n", own, own_precision), 0.0)),
    )


def _moved(problem: Problem, u: Unknowns, at: _Normal) -> Unknowns:
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


def _log_likelihood(counts: jax.Array, mean: jax.Array, valid: jax.Array) -> jax.Array:
    """Of Poisson counts [n, R], relative to the saturated model: small terms, which float32 can add up."""
    mean = jnp.maximum(mean, MEAN_FLOOR)
    safe = jnp.where(counts > 0.0, counts, 1.0)
    ratio = jnp.maximum((mean - safe) / safe, -0.999999)
    seen = safe * (jnp.log1p(ratio) - ratio)
    return jnp.sum(jnp.where(valid[:, None], jnp.where(counts > 0.0, seen, -mean), 0.0))


def settle(
    problem: Problem,
    ways: Ways,
    nuclide: jax.Array,
    others: Others,
    start: Unknowns,
    steps: int,
    fresh: jax.Array | bool = False,
) -> Settled:
    """Fit all unknowns for a source of ``nuclide`` at the place that ``ways`` lead from.

    Args:
        problem: the data.
        ways: from the place.
        nuclide: [] int32.
        others: other sources.
        start: where to begin.
        steps: of Gauss-Newton (static).
        fresh: [] bool, whether the activity is not known from ``start``: the first one is that which fits best if
            all else is held.
    """
    m = problem.measurements
    assert m.rois is not None
    source = rates(problem, ways, nuclide, start.lengths)
    first = _first_activity(problem, source, others, start)
    start = replace(start, activity_bq=jnp.where(fresh, first, start.activity_bq))

    def linear(u: Unknowns, source: Rates) -> _Linear:
        return _linear(problem, source, others, ways.position_m, u)

    def step(carry: tuple[Unknowns, Rates], _: None) -> tuple[Any, None]:
        u, source = carry
        u = _moved(problem, u, _normal(problem, linear(u, source), u))
        return (u, rates(problem, ways, nuclide, u.lengths)), None

    (u, source), _ = jax.lax.scan(step, (start, source), None, length=steps)
    return _settled(problem, linear(u, source), u, ways, source)


def _settled(problem: Problem, model: _Linear, u: Unknowns, ways: Ways, source: Rates) -> Settled:
    m = problem.measurements
    assert m.rois is not None
    at = _normal(problem, model, u)
    common_precision = _prior(problem, u.others.shape[0])
    own = jnp.stack([u.background, u.gain], axis=-1)
    penalty = jnp.sum(common_precision * jnp.square(_common(u)))
    penalty = penalty + jnp.sum(jnp.where(m.valid[:, None], model.precision * jnp.square(own), 0.0))
    height = ways.position_m[2] - sample(problem.site.terrain_m, problem.site, ways.position_m[:2])
    penalty = penalty + height_precision(problem.height_std_m) * jnp.square(height - problem.height_m)
    likelihood = _log_likelihood(m.rois, model.mean, m.valid) - 0.5 * penalty
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(at.information), 1e-20))
    unit = at.information / (scale[:, None] * scale) + 1e-6 * jnp.eye(scale.shape[0])
    root = jax.scipy.linalg.cholesky(unit, lower=True)
    log_volume = -jnp.sum(jnp.log(jnp.diagonal(root))) - jnp.sum(jnp.log(scale))
    value = likelihood + log_volume + at.log_volume
    return Settled(
        value=jnp.where(jnp.isfinite(value), value, -jnp.inf),
        likelihood=jnp.where(jnp.isfinite(likelihood), likelihood, -jnp.inf),
        unknowns=u,
        covariance=scaled_inverse(at.information),
        towards=at.towards,
        rates=source,
    )


def silent(problem: Problem) -> Rates:
    """Rates of no source."""
    n, regions = problem.background.shape
    materials = problem.material_std.shape[0]
    return Rates(counts=jnp.zeros((n, regions)), slopes=jnp.zeros((n, materials, regions)), edge=jnp.zeros(n))


def _first_activity(problem: Problem, source: Rates, others: Others, u: Unknowns) -> jax.Array:
    """Activity [] of least squares with everything else held, at least what gives ten counts in all."""
    m, net = problem.measurements, source.counts
    assert m.rois is not None
    model = _linear(problem, silent(problem), others, jnp.zeros(3), replace(u, activity_bq=jnp.zeros(())))
    # a background that varies is part of the variance, as if it did so in each region by itself
    variance = model.mean + jnp.square(problem.background_std * model.mean)
    weight = jnp.where(m.valid[:, None], 1.0 / jnp.maximum(variance, MEAN_FLOOR), 0.0)
    score, information = jnp.sum(weight * net * (m.rois - model.mean)), jnp.sum(weight * net * net)
    least = 10.0 / jnp.maximum(jnp.sum(jnp.where(m.valid[:, None], net, 0.0)), 1e-30)
    return jnp.maximum(score / jnp.maximum(information, 1e-30), least)


def spans_of(groups: Sequence[tuple[int, int, int]]) -> tuple[Span, ...]:
    """Spans from (rows, detector, rays) of groups that follow one another; neighbours that are alike are one span."""
    spans: list[Span] = []
    at = 0
    for size, detector, rays in groups:
        if spans and spans[-1][2:] == (detector, rays):
            spans[-1] = (spans[-1][0], at + size, detector, rays)
        elif size:
            spans.append((at, at + size, detector, rays))
        at += size
    return tuple(spans)
