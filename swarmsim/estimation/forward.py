"""What sources add to the counts by region of interest: rays, transport, and the way of the crystal in a window."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.estimation.likelihood import position_of
from swarmsim.estimation.measurements import Measurements
from swarmsim.estimation.nodes import Nodes, Span, inverse_square_gain, nodes_of
from swarmsim.pytree import pytree, static
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.rate import share_registered
from swarmsim.radiation.roi_lines import roi_rates_and_slopes
from swarmsim.site import Site
from swarmsim.site.rays import Crossed, crossed_from, stretched

EDGE_SHARE = 0.11  # of the variance between a window's rays: an edge lies anywhere between two of them
MOST_BY_LENGTHS = 20.0  # that the logarithm of a rate changes by with the lengths, in one step


@pytree
class Rest:
    """What windows that are left out tell, to second order about one fit (`swarmsim.estimation.focus`).

    Of the P unknowns that windows share, in the order of `swarmsim.estimation.normal_equations.prior_precision`, with
    logarithms of activities and factors, and the place.
    """

    information: jax.Array  # [P + 3, P + 3] the windows' own unknowns eliminated
    push: jax.Array  # [P + 3] derivative of the log likelihood there
    unknowns: jax.Array  # [P + 3] of that fit, the place in the world


@pytree
class Problem:
    """Everything that the estimate of sources is conditioned on."""

    site: Site
    detectors: tuple[Detector, ...]
    measurements: Measurements  # n windows, detector by detector; ``rois`` [n, R]
    background: jax.Array  # [n, R] counts expected at the nominal level, over an even ground
    material_std: jax.Array  # [U] prior of ln(true over presumed length) in each uncertain material
    background_std: jax.Array  # [] of a window's ln(background over the detector's level)
    model_std: jax.Array  # [] of a window's ln(true over modelled rate of the sources)
    tail: jax.Array  # [] degrees of freedom of the distribution (Student's t) of a window's rate
    pose_std_m: jax.Array  # [n] of a window's place
    geometry_std_m: jax.Array  # [] by which all places are off from the site's geometry alike
    log_activity: jax.Array  # [] prior of ln(activity in Bq), its mean
    log_activity_std: jax.Array  # []
    learning_rate: jax.Array  # [] 0..1: how often the log likelihood counts in the posterior of a place
    trust: jax.Array  # [n, R] 0..1: the counts of a region in a window are worth so many times as many (`trust_of`)
    height_m: jax.Array  # [] prior of a source's height above ground
    height_std_m: jax.Array  # []
    detector: jax.Array  # [n, D] one-hot: the detector model of each row
    dead_s: jax.Array  # [n, 2] its dead times, the paralyzable and the non-paralyzable one
    nodes: Nodes  # of all windows
    rest: Rest | None = None  # of windows that are left out
    spans: tuple[Span, ...] = static()
    uncertain: tuple[int, ...] = static()  # numbers of the U materials whose thickness is not known exactly


@pytree
class Rates:
    """What a source of 1 Bq at the start adds, before dead time."""

    counts: jax.Array  # [n, R]
    slopes: jax.Array  # [n, U, R] their derivatives by ln(length in each uncertain material)
    edge: jax.Array  # [n] variance of their logarithm from shadows' edges that the window crosses


@pytree
class Ways:
    """What lies between a place and the windows."""

    crossed: Crossed  # [nodes, M]
    position_m: jax.Array  # [3] of the place


@jax.jit  # traced once for all places of a program that call it
def ways_from(problem: Problem, place: jax.Array, off_m: jax.Array | None = None) -> Ways:
    """What lies between ``place`` [3] (x, y, height above the ground) and the windows.

    Both the place and those of the windows may be off from the site's geometry by ``off_m`` [3].
    """
    position, valid = position_of(problem.site, place), problem.measurements.valid
    wanted = jnp.concatenate([jnp.repeat(valid[first:last], rays) for first, last, _, rays in problem.spans])
    ends = position, problem.nodes.position_m
    one, other = ends if off_m is None else (x - off_m for x in ends)
    crossed = crossed_from(problem.site, one, other, wanted)
    return Ways(crossed=crossed, position_m=position)


@partial(jax.jit, static_argnames="slopes")  # traced once for all places of a program that call it
def rates(problem: Problem, ways: Ways, nuclide: jax.Array, lengths: jax.Array, slopes: bool = True) -> Rates:
    """Counts per Bq at the start of a source of ``nuclide``.

    ``lengths`` [U] are logarithms of the factors of the path lengths in the uncertain materials. Without ``slopes``
    (static) there are none: [n, 0, R].
    """
    materials = len(problem.site.material_names)
    factors = jnp.ones(materials).at[jnp.array(problem.uncertain, jnp.int32)].set(jnp.exp(lengths))
    source = Source(position_m=ways.position_m, activity_bq=jnp.ones(()), nuclide=nuclide)
    by, exposure_s = problem.uncertain if slopes else (), problem.measurements.exposure_s * left(problem, nuclide)
    parts = [
        _of_windows(problem, span, nodes, crossed, source, factors, by, exposure_s)
        for span, (nodes, crossed) in zip(problem.spans, _by_span(problem, (problem.nodes, ways.crossed)), strict=True)
    ]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def left(problem: Problem, nuclide: jax.Array) -> jax.Array:
    """Share [..., n] of the activity at the start that is left in the middle of each window, of ``nuclide`` [...]."""
    m = problem.measurements
    middle_s = jnp.maximum(m.time_s - 0.5 * m.exposure_s, 0.0)
    return jnp.exp(-problem.detectors[0].decay_1_s[nuclide][..., None] * middle_s)


def _by_span(problem: Problem, x: Any) -> list[Any]:
    """The rows of each span, of arrays of all nodes."""
    ends = itertools.accumulate((last - first) * rays for first, last, _, rays in problem.spans)
    return [jax.tree.map(lambda x, part=slice(*part): x[part], x) for part in itertools.pairwise([0, *ends])]


def _of_windows(
    problem: Problem,
    span: Span,
    nodes: Nodes,
    crossed: Crossed,
    source: Source,
    factors: jax.Array,
    by: tuple[int, ...],
    exposure_s: jax.Array,
) -> Rates:
    """The rates of a span's windows; those of spans without a valid one mean nothing."""
    (first, last, number, rays), m = span, problem.measurements
    offset = nodes.position_m - source.position_m
    found = roi_rates_and_slopes(
        problem.detectors[number],
        source,
        stretched(crossed, factors),
        nodes.position_m,
        nodes.axis,
        by,
        weight=inverse_square_gain(offset, nodes),
        places=rays,
        asked=jnp.any(m.valid[first:last]),
    )
    strength, share = found.net * jnp.sum(offset * offset, axis=1), jnp.sum(nodes.pieces, axis=1)
    strength, share = strength.reshape(-1, rays), share.reshape(-1, rays)
    mean = jnp.sum(share * strength, axis=1)
    spread = jnp.sum(share * jnp.square(strength - mean[:, None]), axis=1) / jnp.maximum(jnp.square(mean), 1e-30)
    exposure, regions = exposure_s[first:last], problem.background.shape[1]
    return Rates(
        counts=padded(found.rates, regions) * exposure[:, None],
        slopes=padded(found.slopes, regions) * exposure[:, None, None],
        edge=EDGE_SHARE * jnp.where(mean > 0.0, spread, 0.0),
    )


def padded(values: jax.Array, regions: int) -> jax.Array:
    """The same with zeros up to so many regions on the last axis."""
    return jnp.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, regions - values.shape[-1])])


def dead_time(problem: Problem, counts: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Share [n] of the true counts [n] of each window that is registered, and its derivative by them."""
    live, (paralyzable, non_paralyzable) = jnp.maximum(problem.measurements.exposure_s, 1e-9), problem.dead_s.T
    return jax.jvp(lambda rate: share_registered(rate, paralyzable, non_paralyzable), (counts / live,), (1.0 / live,))


def trust_of(counts: jax.Array, background: jax.Array, std: jax.Array) -> jax.Array:
    """Share [n, R] of the information in ``counts`` [n, R] that is left where the model's spectrum is off by ``std``.

    The variance mean + (std signal)^2 of an error of each region's signal over the mean, with the signal as it is
    counted above the ``background`` [n, R] expected: the same at every place, so that likelihoods can be compared.
    """
    signal = jnp.maximum(counts - background, 0.0)
    return 1.0 / (1.0 + jnp.square(std * signal) / jnp.maximum(counts, 1.0))


def lengthened(source: Rates, change: jax.Array) -> Rates:
    """The rates after the logarithms of the lengths have changed by ``change`` [U].

    Exact for photons of one energy that do not scatter: their logarithm is linear in the lengths.
    """
    further = jnp.sum(source.slopes * jnp.expm1(change)[:, None], axis=1) / jnp.maximum(source.counts, 1e-30)
    factor = jnp.exp(jnp.clip(further, -MOST_BY_LENGTHS, MOST_BY_LENGTHS))
    slopes = source.slopes * (jnp.exp(change)[:, None] * factor[:, None])
    return replace(source, counts=source.counts * factor, slopes=slopes)


def with_one_ray(problem: Problem) -> Problem:
    """The same with one ray to each window."""
    spans = tuple((first, last, number, 1) for first, last, number, _ in problem.spans)
    return replace(problem, spans=spans, nodes=nodes_of(problem.site, problem.measurements, spans))


def few_rows(problem: Problem, most: int) -> bool:
    """Whether no span has more rows than ``most``."""
    return all(last - first <= most for first, last, _, _ in problem.spans)


def most_of(problem: Problem, values: jax.Array, most: int) -> jax.Array:
    """The rows [m] with the largest ``values`` [n] in each span, ``most`` at most, in ascending order."""
    values = jnp.where(problem.measurements.valid, values, -1.0)
    rows = [
        first + jnp.sort(jax.lax.top_k(values[first:last], min(most, last - first))[1])
        for first, last, _, _ in problem.spans
    ]
    return jnp.concatenate(rows)


def of_rows(problem: Problem, rows: jax.Array, most: int) -> Problem:
    """The problem with these rows [m] alone, ``most`` of each span or all (`most_of`)."""
    spans: list[Span] = []
    nodes, begin, at = [], 0, 0
    for first, last, number, rays in problem.spans:
        kept = min(most, last - first)
        own = rows[at : at + kept] - first
        nodes.append(begin + (own[:, None] * rays + np.arange(rays)).reshape(-1))
        spans.append((at, at + kept, number, rays))
        begin, at = begin + (last - first) * rays, at + kept
    chosen = jnp.concatenate(nodes)
    return replace(
        problem,
        measurements=jax.tree.map(lambda x: x[rows], problem.measurements),
        background=problem.background[rows],
        pose_std_m=problem.pose_std_m[rows],
        trust=problem.trust[rows],
        detector=problem.detector[rows],
        dead_s=problem.dead_s[rows],
        nodes=jax.tree.map(lambda x: x[chosen], problem.nodes),
        spans=tuple(spans),
    )


def silent(problem: Problem) -> Rates:
    """Rates of no source."""
    n, regions = problem.background.shape
    materials = problem.material_std.shape[0]
    return Rates(counts=jnp.zeros((n, regions)), slopes=jnp.zeros((n, materials, regions)), edge=jnp.zeros(n))


def variance_of(problem: Problem, where: jax.Array) -> jax.Array:
    """Variance [n] of ln(true over modelled rate) of a source at ``where`` [3], from the model and the poses."""
    offset = where - problem.measurements.position_m
    squared = jnp.maximum(jnp.sum(offset * offset, axis=-1), 0.01)
    return jnp.square(problem.model_std) + 4.0 * jnp.square(problem.pose_std_m) / squared


def models_of(detectors: Sequence[Detector], spans: Sequence[Span]) -> tuple[jax.Array, jax.Array]:
    """Detector model of each row, one-hot [n, D], and its dead times [n, 2]: see `Problem`."""
    rows = np.concatenate([np.full(last - first, number) for first, last, number, _ in spans])
    dead = jnp.stack([jnp.stack([jnp.asarray(d.paralyzable_s), jnp.asarray(d.non_paralyzable_s)]) for d in detectors])
    return jax.nn.one_hot(rows, len(detectors)), dead[rows]
