"""What sources add to the counts by region of interest: rays, transport, and the way of the crystal in a window."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.estimation.likelihood import position_of, travel_gain
from swarmsim.estimation.measurements import Measurements
from swarmsim.pytree import pytree, static
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.rate import registered_share, roi_rates_and_slopes
from swarmsim.site import Site, sample
from swarmsim.site.rays import Crossed, crossed_from, stretched

LEAST_ABOVE_M = 0.2  # height of a crystal above the ground
EDGE_SHARE = 0.11  # of the variance between a window's rays: an edge lies anywhere between two of them


Span = tuple[int, int, int, int]
"""Rows from, to, their detector model, and the rays to each window along its way."""


@pytree
class Nodes:
    """Where the crystal is looked at from a source: ``rays`` places of each of m windows.

    Each stands for the part of the way that is nearest to it: two straight pieces, one before it and one after.
    """

    position_m: jax.Array  # [rays m, 3]
    axis: jax.Array  # [rays m, 3]
    pieces_m: jax.Array  # [rays m, 2, 3] from the place to the beginning of its part, and to the end


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
    log_activity: jax.Array  # [] prior of ln(activity in Bq), its mean
    log_activity_std: jax.Array  # []
    learning_rate: jax.Array  # [] 0..1: how often the log likelihood counts in the posterior of a place
    trust: jax.Array  # [n, R] 0..1: the counts of a region in a window are worth so many times as many (`trust_of`)
    height_m: jax.Array  # [] prior of a source's height above ground
    height_std_m: jax.Array  # []
    nodes: tuple[Nodes, ...]  # of each span
    spans: tuple[Span, ...] = static()
    uncertain: tuple[int, ...] = static()  # numbers of the U materials whose thickness is not known exactly


@pytree
class Rates:
    """What a source of 1 Bq adds, before dead time."""

    counts: jax.Array  # [n, R]
    slopes: jax.Array  # [n, U, R] their derivatives by ln(length in each uncertain material)
    edge: jax.Array  # [n] variance of their logarithm from shadows' edges that the window crosses


@pytree
class Ways:
    """What lies between a place and the windows."""

    crossed: tuple[Crossed, ...]  # for each span [rays m, M]
    position_m: jax.Array  # [3] of the place


def nodes_of(site: Site, m: Measurements, span: Span) -> Nodes:
    """The nodes of a span's windows.

    With one ray a window has its middle; with more the first and the last end of the way are among them, so that a
    shadow's edge that a window crosses is seen in the spread between its rays. A way is two straight legs of equal
    time, which the ends and the mean place tell: the corner between them lies as far beyond the mean as this lies off
    the straight line between the ends. No place is taken to lie below the ground.
    """
    first, last, _, rays = span
    mean, travel, axis = (x[first:last] for x in (m.position_m, m.travel_m, m.axis))
    chord = jnp.zeros_like(travel) if m.chord_m is None else m.chord_m[first:last]
    corner = -2.0 * chord
    # a vehicle that stands for long and drives off at last, or drives in circles, has no two legs of equal time
    length, off = (jnp.linalg.norm(x, axis=-1, keepdims=True) for x in (travel, corner))
    corner = corner * jnp.minimum(1.0, 0.5 * length / jnp.maximum(off, 1e-6))

    def at(share: jax.Array) -> jax.Array:
        """Places [m, ..., 3] at so much of the way."""
        along, beside = share[..., None] - 0.5, 1.0 - jnp.abs(2.0 * share[..., None] - 1.0)
        return (mean + chord)[:, None] + along * travel[:, None] + beside * corner[:, None]

    share, low, high = _parts(rays)
    position = at(share)
    pieces = jnp.stack([at(low) - position, at(high) - position], axis=2)
    ground = jax.vmap(lambda xy: sample(site.terrain_m, site, xy))(position[..., :2].reshape(-1, 2))
    position = position.reshape(-1, 3)
    return Nodes(
        position_m=position.at[:, 2].max(ground + LEAST_ABOVE_M),
        axis=jnp.repeat(axis, rays, axis=0),
        pieces_m=pieces.reshape(-1, 2, 3),
    )


def _parts(rays: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where on a way its nodes [rays] are, and where the parts that they stand for begin and end."""
    share = jnp.linspace(0.0, 1.0, rays) if rays > 1 else jnp.array([0.5])
    half = 0.5 / max(rays - 1, 1)
    return share, jnp.maximum(share - half, 0.0), jnp.minimum(share + half, 1.0)


def shares_of(rays: int) -> jax.Array:
    """Shares [rays] of a way that its nodes stand for."""
    _, low, high = _parts(rays)
    return high - low


def inverse_square_gain(offset_m: jax.Array, pieces_m: jax.Array, rays: int) -> jax.Array:
    """Mean of 1/r² [rays m] over the parts of the ways over its value at their nodes.

    ``offset_m`` [rays m, 3] from the source to the nodes, ``pieces_m`` [rays m, 2, 3] as those of `Nodes`.
    """
    share, low, high = _parts(rays)
    weight = jnp.stack([share - low, high - share], axis=1) / (high - low)[:, None]  # [rays, 2]
    middle = offset_m[:, None] + 0.5 * pieces_m
    squared = jnp.maximum(jnp.sum(middle * middle, axis=-1), 1e-6)
    mean = travel_gain(middle, pieces_m) / squared
    mean = jnp.sum(weight * mean.reshape(-1, rays, 2), axis=-1).reshape(-1)
    return jnp.sum(offset_m * offset_m, axis=-1) * mean


@jax.jit  # traced once for all places of a program that call it
def ways_from(problem: Problem, place: jax.Array) -> Ways:
    """What lies between ``place`` [3] (x, y, height above the ground) and the windows."""
    position, valid = position_of(problem.site, place), problem.measurements.valid
    wanted = jnp.concatenate([jnp.repeat(valid[first:last], rays) for first, last, _, rays in problem.spans])
    ends = jnp.concatenate([nodes.position_m for nodes in problem.nodes])
    # of all spans at once: it is compiled at several places
    every = crossed_from(problem.site, position, ends, wanted)
    rows = np.cumsum([0, *(nodes.position_m.shape[0] for nodes in problem.nodes)])
    crossed = tuple(
        jax.tree.map(lambda x, part=slice(first, last): x[part], every)
        for first, last in itertools.pairwise(rows.tolist())
    )
    return Ways(crossed=crossed, position_m=position)


@jax.jit  # traced once for all places of a program that call it
def rates(problem: Problem, ways: Ways, nuclide: jax.Array, lengths: jax.Array) -> Rates:
    """Counts per Bq of a source of ``nuclide``.

    ``lengths`` [U] are logarithms of the factors of the path lengths in the uncertain materials.
    """
    materials = len(problem.site.material_names)
    factors = jnp.ones(materials).at[jnp.array(problem.uncertain, jnp.int32)].set(jnp.exp(lengths))
    source = Source(position_m=ways.position_m, activity_bq=jnp.ones(()), nuclide=nuclide)
    parts = [
        _rates_of_span(problem, span, nodes, source, stretched(crossed, factors))
        for span, nodes, crossed in zip(problem.spans, problem.nodes, ways.crossed, strict=True)
    ]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def _rates_of_span(problem: Problem, span: Span, nodes: Nodes, source: Source, way: Crossed) -> Rates:
    first, last, number, rays = span
    share, position = shares_of(rays), nodes.position_m
    offset = position - source.position_m
    detector, exposure = problem.detectors[number], problem.measurements.exposure_s[first:last]
    weight = jnp.tile(share, last - first) * inverse_square_gain(offset, nodes.pieces_m, rays)
    asked = jnp.any(problem.measurements.valid[first:last])
    found = roi_rates_and_slopes(detector, source, way, position, nodes.axis, problem.uncertain, weight, rays, asked)
    strength = (found.net * jnp.sum(offset * offset, axis=1)).reshape(-1, rays)
    mean = jnp.sum(share * strength, axis=1)
    spread = jnp.sum(share * jnp.square(strength - mean[:, None]), axis=1) / jnp.maximum(jnp.square(mean), 1e-30)
    regions = problem.background.shape[1]
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
    exposure = jnp.maximum(problem.measurements.exposure_s, 1e-9)
    shares, slopes = [], []
    for first, last, number, _ in problem.spans:
        live, law = exposure[first:last], partial(registered_share, problem.detectors[number])
        rate = counts[first:last] / live
        share, slope = jax.jvp(law, (rate,), (1.0 / live,))
        shares.append(share)
        slopes.append(slope)
    return jnp.concatenate(shares), jnp.concatenate(slopes)


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
    factor = jnp.exp(jnp.clip(further, -20.0, 20.0))
    slopes = source.slopes * (jnp.exp(change)[:, None] * factor[:, None])
    return replace(source, counts=source.counts * factor, slopes=slopes)


def with_one_ray(problem: Problem) -> Problem:
    """The same with one ray to each window."""
    spans = tuple((first, last, number, 1) for first, last, number, _ in problem.spans)
    nodes = tuple(nodes_of(problem.site, problem.measurements, span) for span in spans)
    return replace(problem, spans=spans, nodes=nodes)


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


def detector_of(problem: Problem) -> jax.Array:
    """One-hot [n, D]: the detector model of each row."""
    rows = [jnp.full(last - first, number) for first, last, number, _ in problem.spans]
    return jax.nn.one_hot(jnp.concatenate(rows), len(problem.detectors))


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
