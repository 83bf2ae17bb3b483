"""Where a further source would explain the counts, and of which nuclide: a score statistic over a grid, without rays.

At a grid point the statistic is s^2 / I with s the derivative of the log likelihood by the activity at zero, and I the
information about it, the background's level in every window and the activities of the sources known so far eliminated:
chi-square of one degree of freedom without a source. In the open the rate of a nuclide depends on the distance alone,
up to the direction to the crystal, so that both are matrix products: (points x windows) (windows x nuclides).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.device import each
from swarmsim.estimation.forward import Problem, left, padded, silent, with_one_ray
from swarmsim.estimation.nodes import inverse_square_gain
from swarmsim.estimation.normal_equations import MEAN_FLOOR, Others, Unknowns, linearised, normal_equations, of_window
from swarmsim.pytree import on_device, pytree
from swarmsim.radiation.detector import AIR, Detector, Source
from swarmsim.radiation.ground import basis
from swarmsim.radiation.roi_lines import roi_rates_and_slopes
from swarmsim.site.rays import Crossed, above_ground, mirrored, wide

NODES_M = (3.0, 10.0, 30.0, 100.0)
"""Distances at which the rates are computed; rates times squared distance are linear between them."""
HEIGHT_M = 1.0  # of a source above the ground, for what the ground scatters
SINE = 0.7071  # of the angle between the crystal's axis and the direction to the source
LEAST_M = 3.0  # closer windows count as if they were this far: where a source is near, the grid is too coarse for them


@pytree
class Scanned:
    """The statistic of every grid point."""

    statistic: jax.Array  # [C] largest over the nuclides
    nuclide: jax.Array  # [C] int32 which one that is
    activity_bq: jax.Array  # [C] that it has by the score
    information: jax.Array  # [C, N] (1/Bq^2) about the activity of each nuclide there


def open_rates(detector: Detector, nuclides: int, air: int) -> jax.Array:
    """Counts/s per Bq times squared distance [N, nodes, R] over ground; ``air`` is its number among materials."""
    distance = jnp.array(NODES_M)
    zero = jnp.zeros_like(distance)
    place = jnp.stack([distance * SINE, zero, distance * (1.0 - SINE**2) ** 0.5], axis=-1)
    up = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), place.shape)
    length = jnp.zeros((len(NODES_M), len(detector.material_names))).at[:, air].set(distance)
    far = np.array(NODES_M)
    ground = on_device(basis(HEIGHT_M, HEIGHT_M + far * (1.0 - SINE**2) ** 0.5, far * SINE))
    way = Crossed(length_m=length, place=jnp.full_like(length, 0.5), shape=wide(length, ground))

    def of(nuclide: jax.Array) -> jax.Array:
        source = Source(position_m=jnp.zeros(3), activity_bq=jnp.ones(()), nuclide=nuclide)
        return roi_rates_and_slopes(detector, source, way, place, up).rates * jnp.square(distance)[:, None]

    return each(of, jnp.arange(nuclides), nuclides)


def scan(problem: Problem, points_m: jax.Array, allowed: jax.Array, others: Others, u: Unknowns) -> Scanned:
    """The statistic at ``points_m`` [C, 3] (world) for the nuclides that are ``allowed`` [N].

    ``others`` are the sources known so far, and ``u`` is the fit with them alone (its own activity
    is zero).
    """
    m, regions = problem.measurements, problem.background.shape[1]
    assert m.rois is not None
    model = linearised(problem, silent(problem), others, jnp.zeros(3), u)
    at = normal_equations(problem, model, u)
    # windows first
    mean, columns, of_own = model.mean.T, model.columns.T, of_window(model.columns, u.others.shape[0]).T
    own_inverse, own_push = at.own.T, at.own_push.T
    weight = jnp.where(m.valid[:, None], problem.trust / jnp.maximum(mean, MEAN_FLOOR), 0.0)
    models = problem.detector
    kernels = [padded(open_rates(d, allowed.shape[0], _air_of(d)), regions) for d in problem.detectors]
    kernel = jnp.stack(kernels)  # [D, N, J, R]
    true = jnp.sum(true_counts(problem, others, u), axis=1)
    scale = m.exposure_s * jnp.sum(mean, axis=1) / jnp.maximum(true, 1e-9)  # [n]
    there = left(problem, jnp.arange(allowed.shape[0])).T  # [n, N]
    shape = (scale[:, None] * there)[:, :, None, None] * jnp.einsum("nd,dcjr->ncjr", models, kernel)  # [n, N, J, R]

    # what is common to all windows: the others' factors and the levels
    k, d = u.others.shape[0], u.level.shape[0]
    common = jnp.concatenate([columns[..., 1 : 1 + k], columns[..., 1 + k, None] * models[:, None]], axis=-1)

    def eliminated(x: jax.Array) -> jax.Array:
        """V^-1 x [n, R, ...]: the windows' own background and gain eliminated."""
        weighted = weight.reshape(*weight.shape, *[1] * (x.ndim - 2)) * x
        inside = jnp.einsum("nab,nrb,nr...->na...", own_inverse, of_own, weighted)
        return weighted - weight.reshape(*weight.shape, *[1] * (x.ndim - 2)) * jnp.einsum(
            "nra,na...->nr...", of_own, inside
        )

    # the fit's own deviations have taken up their part already: only what still pushes them is eliminated
    still = jnp.einsum("nab,nb->na", own_inverse, own_push)
    rest = weight * (m.rois - mean - jnp.einsum("nra,na->nr", of_own, still))  # [n, R]
    across = eliminated(common)  # [n, R, Q]
    pushes = jnp.einsum("ncjr,nr->ncj", shape, rest)
    crossings = jnp.einsum("ncjr,nrq->ncjq", shape, across)
    inner = jnp.einsum("nra,nr,ncjr->ncja", of_own, weight, shape)
    own = jnp.einsum("ncjr,nr,ncir->ncji", shape, weight, shape)
    own = own - jnp.einsum("ncja,nab,ncib->ncji", inner, own_inverse, inner)

    phi = _weights(points_m, m.position_m, m.valid)  # [J, C, n]
    nodes = len(NODES_M)
    score = jnp.einsum("jcn,nkj->ck", phi, pushes)
    information = sum(
        (phi[i] * phi[j]) @ own[:, :, i, j] * (1.0 if i == j else 2.0) for i in range(nodes) for j in range(i, nodes)
    )
    flat = crossings.transpose(2, 0, 1, 3)  # [J, n, N, Q]
    cross = jnp.einsum("jcn,jnq->cq", phi, flat.reshape(nodes, flat.shape[1], -1)).reshape(
        points_m.shape[0], allowed.shape[0], k + d
    )
    of_common = jnp.einsum("nrp,nrq->pq", common, across) + 1e-4 * jnp.eye(k + d)
    half = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(of_common), jnp.eye(k + d))
    information = information - jnp.einsum("ncp,pq,ncq->nc", cross, half, cross)
    information = jnp.maximum(information, 1e-30)
    score = score - jnp.einsum("ncp,pq,q->nc", cross, half, jnp.einsum("nrp,nr->p", common, rest))
    statistic = jnp.where(allowed, jnp.square(jnp.maximum(score, 0.0)) / information, -1.0)
    best = jnp.argmax(statistic, axis=1)
    chosen = best[:, None]
    return Scanned(
        statistic=jnp.take_along_axis(statistic, chosen, axis=1)[:, 0],
        nuclide=best.astype(jnp.int32),
        activity_bq=jnp.take_along_axis(score / information, chosen, axis=1)[:, 0],
        information=information,
    )


def open_totals(problem: Problem, points_m: jax.Array, nuclide: jax.Array) -> jax.Array:
    """Counts [C, n] before dead time that sources of 1 Bq of ``nuclide`` [C] at ``points_m`` [C, 3] add in the open.

    By the distance alone, as the `scan` has them.
    """
    m, count = problem.measurements, points_m.shape[0]
    air = [_air_of(d) for d in problem.detectors]
    sums = [
        jnp.sum(open_rates(d, len(d.nuclide_names), k), axis=2) for d, k in zip(problem.detectors, air, strict=True)
    ]
    of_detector = jnp.stack(sums)[:, nuclide]  # [D, C, J]
    phi = _weights(points_m, m.position_m, m.valid)
    parts = (of_detector[d].T[:, :, None] * problem.detector[:, d] for d in range(len(sums)))  # each [J, C, n]
    rates = sum((jnp.sum(phi * part, axis=0) for part in parts), jnp.zeros((count, m.valid.shape[0])))
    return m.exposure_s * left(problem, nuclide) * rates


def _air_of(detector: Detector) -> int:
    """Number of air among the materials of a detector."""
    return detector.material_names.index(AIR) if AIR in detector.material_names else 0


def open_counts(problem: Problem, point_m: jax.Array, nuclide: jax.Array) -> jax.Array:
    """Counts [n, R] before dead time that a source of 1 Bq at ``point_m`` [3] adds where no wall is in the way."""
    source = Source(position_m=point_m, activity_bq=jnp.ones(()), nuclide=nuclide)
    nodes, parts = with_one_ray(problem).nodes, []
    offset = nodes.position_m - point_m
    heights = jax.vmap(partial(above_ground, problem.site, point_m))(nodes.position_m)
    ground = jax.vmap(partial(mirrored, point_m))(nodes.position_m, *heights)
    distance, gain = jnp.linalg.norm(offset, axis=1), inverse_square_gain(offset, nodes)
    for first, last, number, _ in problem.spans:
        own, detector = slice(first, last), problem.detectors[number]
        length = jnp.zeros((last - first, len(detector.material_names)))
        length = length.at[:, _air_of(detector)].set(distance[own])
        way = Crossed(length_m=length, place=jnp.full_like(length, 0.5), shape=wide(length, ground[own]))
        rates = roi_rates_and_slopes(
            detector, source, way, nodes.position_m[own], nodes.axis[own], weight=gain[own]
        ).rates  # fmt: skip
        parts.append(padded(rates, problem.background.shape[1]))
    return jnp.concatenate(parts) * (problem.measurements.exposure_s * left(problem, nuclide))[:, None]


def true_counts(problem: Problem, others: Others, u: Unknowns) -> jax.Array:
    """Counts [n, R] before dead time of the background and the ``others``."""
    background = problem.background * jnp.exp(problem.detector @ u.level + u.background)[:, None]
    return background + jnp.sum(others.counts * u.others[:, None, None], axis=0) * jnp.exp(u.gain)[:, None]


def _weights(points_m: jax.Array, windows_m: jax.Array, valid: jax.Array) -> jax.Array:
    """Weights [J, C, n] of the nodes for every point and window, over the squared distance."""
    apart = points_m[:, None] - windows_m
    distance = jnp.maximum(jnp.sqrt(jnp.sum(apart * apart, axis=-1)), LEAST_M)
    place = jnp.interp(distance, jnp.array(NODES_M), jnp.arange(len(NODES_M), dtype=jnp.float32))
    shares = jnp.maximum(1.0 - jnp.abs(place - jnp.arange(len(NODES_M), dtype=jnp.float32)[:, None, None]), 0.0)
    return jnp.where(valid, shares / jnp.square(distance), 0.0)


def strongest(scanned: Scanned, points_m: jax.Array, count: int, apart_m: float) -> tuple[jax.Array, jax.Array]:
    """Numbers [count] of the grid points with the largest statistic, each ``apart_m`` from the others; and those."""

    def next_(statistic: jax.Array, _: None) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        k = jnp.argmax(statistic)
        away = jnp.linalg.norm(points_m[:, :2] - points_m[k, :2], axis=1)
        return jnp.where(away < apart_m, -jnp.inf, statistic), (k, statistic[k])

    return jax.lax.scan(next_, scanned.statistic, None, length=count)[1]
