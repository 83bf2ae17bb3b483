"""Likelihood of detector counts for one point source: forward model, score and Fisher information.

The parameters are theta = (x, y, height above the ground, log activity in Bq, log background scale). Counts are
Poisson with mean exposure * observed_rate(activity * r + extra + (scale * n - 1) * background), r being the detector's
net rate per becquerel through the known site and n the natural background at the window's height over the nominal one;
the background scale multiplies every detector's nominal background.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.estimation.measurements import Measurements, cleared
from swarmsim.pytree import pytree, static
from swarmsim.radiation import Detector, Source, net_rate, observed_rate
from swarmsim.radiation.background import fall_with_height
from swarmsim.site import Site, sample, sample_with_gradient
from swarmsim.site.rays import crossed_from

BLOCK = 1024  # rays of a block of measurements; one without a valid measurement costs nothing
STEP_SHARE = 0.05  # step of the central differences over the distance of the nearest window: a relative error of 0.25 %
STEP_M = (0.02, 1.0)  # shortest and longest step
MEAN_FLOOR = 1e-6  # counts; keeps a zero-rate model finite when it meets a count
FIXED_STD_M = 1e-3  # a height known better than this counts as known this well


@pytree
class FitProblem:
    """Everything a likelihood is conditioned on."""

    site: Site
    detectors: tuple[Detector, ...]
    measurements: Measurements
    nuclide: jax.Array  # [] int32 index in the library's order
    natural: jax.Array  # [n] background over the detector's nominal one, where the ground is even
    extra_cps: jax.Array  # [n] net rate of other, known sources
    height_m: jax.Array  # [] prior mean of the height above ground
    height_std_m: jax.Array  # [] prior standard deviation
    rays: int = static()  # to a window, along its way


@pytree
class Evaluation:
    """Likelihood at one parameter vector."""

    log_likelihood: jax.Array  # [] nats, relative to the saturated model (half the negative deviance)
    log_posterior: jax.Array  # [] plus the log prior of the height
    score: jax.Array  # [5] gradient of the log posterior
    information: jax.Array  # [5, 5] Fisher information, prior included


def position_of(site: Site, theta: jax.Array) -> jax.Array:
    """World position [3] of the source of parameters ``theta`` [>=3] (x, y, height above the ground)."""
    return jnp.stack([theta[0], theta[1], sample(site.terrain_m, site, theta[:2]) + theta[2]])


@partial(jax.jit, static_argnames="rays")  # traced once for the several places of a program that ask for it
def net_rates(
    site: Site,
    detectors: tuple[Detector, ...],
    m: Measurements,
    position_m: jax.Array,
    nuclide: jax.Array,
    rays: int = 1,
) -> jax.Array:
    """Net rate [n] in counts/s per becquerel of a source at ``position_m`` [3] in each measurement's detector.

    The mean over the way of the crystal during the measurement, by a ray to the middle of each of ``rays`` equal parts
    of it: within each, 1/r² is integrated in closed form and the rest taken as constant. Rows that are not valid have
    some rate or zero. Order rows by detector, the invalid ones last: only the rays of valid rows cost time, and each
    only for its own detector (except under `vmap`, where a `cond` evaluates both branches).
    """
    source = Source(position_m=position_m, activity_bq=jnp.ones(()), nuclide=nuclide)
    middle = (jnp.arange(rays) + 0.5) / rays - 0.5

    def of_block(block: Measurements) -> jax.Array:
        crystal = (block.position_m[:, None] + middle[:, None] * block.travel_m[:, None]).reshape(-1, 3)
        axis, travel = (jnp.repeat(x, rays, axis=0) for x in (block.axis, block.travel_m / rays))
        way = crossed_from(site, position_m, crystal)
        gain = travel_gain(crystal - position_m, travel)

        def rate(detector: Detector) -> jax.Array:
            each = jax.vmap(lambda through, place, axis: net_rate(detector, source, through, place, axis))
            return jnp.mean((each(way, crystal, axis) * gain).reshape(-1, rays), axis=1)

        def of_own(number: int, detector: Detector) -> jax.Array:
            used = jnp.any(block.valid & (block.detector == number))
            return jax.lax.cond(used, lambda: rate(detector), lambda: jnp.zeros_like(block.counts))

        return _of_detector([of_own(k, d) for k, d in enumerate(detectors)], block.detector)

    def of_valid(block: Measurements) -> jax.Array:
        return jax.lax.cond(jnp.any(block.valid), of_block, lambda block: jnp.zeros_like(block.counts), block)

    n = m.counts.shape[0]
    size = min(n, max(1, BLOCK // rays))
    padded = jax.tree.map(lambda x: jnp.pad(x, [(0, -n % size)] + [(0, 0)] * (x.ndim - 1)), m)
    blocks = jax.tree.map(lambda x: x.reshape(-1, size, *x.shape[1:]), padded)
    return jax.lax.map(of_valid, blocks).reshape(-1)[:n]


def exact_rates(problem: FitProblem, position_m: jax.Array) -> jax.Array:
    """Net rate [n] per becquerel of the source sought at ``position_m`` [3]."""
    return net_rates(problem.site, problem.detectors, problem.measurements, position_m, problem.nuclide, problem.rays)


def travel_gain(offset_m: jax.Array, travel_m: jax.Array) -> jax.Array:
    """Mean of 1/r² [n] on the way ``travel_m`` [n, 3] over its value in the middle, ``offset_m`` [n, 3] from a source.

    The mean over a straight way of length L whose middle is p away is atan2(z, a) / z with a = |p|² - L² / 4 and
    z = |p x L|: the angle that the way is seen under, over z. A rover that drives 1 m at 4 m from a source counts up
    to 2 % more or less than it would standing in the middle; attenuation and direction are taken from the middle.
    """
    squared = jnp.sum(offset_m * offset_m, axis=-1)
    a = squared - 0.25 * jnp.sum(travel_m * travel_m, axis=-1)
    across = jnp.cross(offset_m, travel_m)
    z_squared = jnp.sum(across * across, axis=-1)
    small = z_squared < 1e-6 * a * a
    safe = jnp.where(small, jnp.maximum(jnp.abs(a), 1e-6), a)
    z = jnp.sqrt(jnp.where(small, 1.0, z_squared))
    mean = jnp.where(small, (1.0 - z_squared / (3.0 * safe * safe)) / safe, jnp.arctan2(z, safe) / z)
    return jnp.where(squared > 1e-6, squared * mean, 1.0)


def observed_rates(
    detectors: tuple[Detector, ...], m: Measurements, net_cps: jax.Array, background_scale: jax.Array
) -> jax.Array:
    """Observed rate [n] in counts/s (background and dead time included) of net rates [n]."""
    rates = [
        jax.vmap(observed_rate, (None, 0))(d, net_cps + (background_scale - 1.0) * d.background_cps) for d in detectors
    ]
    return _of_detector(rates, m.detector)


def _of_detector(values: list[Any], which: jax.Array) -> jax.Array:
    chosen = values[0]
    for k, value in enumerate(values[1:], start=1):
        chosen = jnp.where(which == k, value, chosen)
    return chosen


def poisson_log_likelihood(counts: jax.Array, mean: jax.Array, valid: jax.Array) -> jax.Array:
    """Log likelihood [] of Poisson counts [n], relative to the saturated model: half the negative deviance.

    Each term k log(mean/k) - (mean - k) is of the order of one, where k log(mean) - mean is hundreds: summed over
    1000 windows in float32 the latter would lose the tenths that decide between positions.
    """
    mean = jnp.maximum(mean, MEAN_FLOOR)
    safe = jnp.where(counts > 0.0, counts, 1.0)
    ratio = jnp.maximum((mean - safe) / safe, -0.999999)
    seen = safe * (jnp.log1p(ratio) - ratio)
    return jnp.sum(jnp.where(valid, jnp.where(counts > 0.0, seen, -mean), 0.0))


def natural_background(
    site: Site, detectors: tuple[Detector, ...], m: Measurements, ground_share: jax.Array | float
) -> jax.Array:
    """Background [n] over each detector's nominal one by its height above an even ground."""
    height = m.position_m[:, 2] - sample(site.terrain_m, site, m.position_m[:, :2])
    reference = jnp.stack([d.background_height_m for d in detectors])[m.detector]
    return jnp.where(m.valid, fall_with_height(jnp.asarray(ground_share), height, reference), 1.0)


def expected_counts(problem: FitProblem, net_cps: jax.Array, log_scale: jax.Array) -> jax.Array:
    """Mean counts [n] for net rates [n] of the source sought; the known extra rate is added."""
    m = problem.measurements
    scale = jnp.exp(log_scale) * problem.natural
    return m.exposure_s * observed_rates(problem.detectors, m, net_cps + problem.extra_cps, scale)


def evaluate(problem: FitProblem, theta: jax.Array) -> Evaluation:
    """Likelihood, score and Fisher information at ``theta`` [5], with the exact path lengths at every place asked for.

    Derivatives along the position are central differences over ± 5 % of the distance of the nearest window, at most
    1 m; everything else is differentiated exactly. In the open that is the derivative. Behind walls the rate jumps
    where the edge of a shadow crosses a window, and the derivative proper is infinite there and zero elsewhere: it
    promises what no estimate reaches (the Cramér–Rao bound is not attained at change points, Ibragimov and
    Has'minskii 1981), whereas the difference counts a jump as what it tells about moves of that size.
    """
    m = problem.measurements
    apart = jnp.linalg.norm(m.position_m - position_of(problem.site, theta), axis=-1)
    half = jnp.clip(STEP_SHARE * jnp.min(jnp.where(m.valid, apart, jnp.inf)), *STEP_M)
    steps = half * jnp.concatenate([jnp.zeros((1, 3)), jnp.eye(3), -jnp.eye(3)])
    places = jax.vmap(lambda d: position_of(problem.site, theta[:3] + d))(steps)
    rates = jax.lax.map(lambda place: exact_rates(problem, place), places)
    activity = jnp.exp(theta[3])
    toward = activity * (rates[1:4] - rates[4:]) / (2.0 * half)

    net = activity * rates[0]
    mean, by_net = jax.jvp(lambda v: expected_counts(problem, v, theta[4]), (net,), (jnp.ones_like(net),))
    _, by_scale = jax.jvp(lambda s: expected_counts(problem, net, s), (theta[4],), (jnp.ones_like(theta[4]),))
    jacobian = jnp.concatenate([by_net * toward, (by_net * net)[None], by_scale[None]])  # [5, n]
    jacobian = jnp.where(m.valid, jacobian, 0.0)
    mean = jnp.where(m.valid, jnp.maximum(mean, MEAN_FLOOR), 1.0)
    residual = jnp.where(m.valid, m.counts - mean, 0.0)
    likelihood = poisson_log_likelihood(m.counts, mean, m.valid)

    precision = height_precision(problem.height_std_m)
    deviation = theta[2] - problem.height_m
    return Evaluation(
        log_likelihood=likelihood,
        log_posterior=likelihood - 0.5 * precision * deviation**2,
        score=(jacobian @ (residual / mean)).at[2].add(-precision * deviation),
        information=((jacobian / mean) @ jacobian.T).at[2, 2].add(precision),
    )


def height_precision(height_std_m: jax.Array | float) -> jax.Array:
    """Precision [] in 1/m² of the prior of the height; a standard deviation of zero means fixed (1 mm)."""
    return 1.0 / jnp.maximum(jnp.asarray(height_std_m, jnp.float32), FIXED_STD_M) ** 2


def fisher_information(
    site: Site,
    detectors: tuple[Detector, ...],
    measurements: Measurements,
    position_m: jax.Array,
    activity_bq: jax.Array,
    nuclide: jax.Array,
    background_scale: jax.Array | float = 1.0,
    extra_rate_cps: jax.Array | float = 0.0,
    rays: int = 1,
    ground_share: jax.Array | float = 0.0,
) -> jax.Array:
    """Fisher information [5, 5] that samples hold about a source; only where and how long they were taken matters.

    Args:
        site: the known site.
        detectors: what ``measurements.detector`` indexes.
        measurements: where, how long and with which detector was measured.
        position_m: [3] true position, world ENU.
        activity_bq: [] true activity.
        nuclide: [] int32 index in the library's order.
        background_scale: [] true background over the nominal one.
        extra_rate_cps: [] or [n] net rate of other sources.
        rays: to each measurement, along its way (static).
        ground_share: [] share of the nominal background that falls with height.

    Returns:
        Information about (x m, y m, height above ground m, log activity, log background scale), without any prior.
        Its inverse is the Cramér–Rao bound: see `cramer_rao_covariance`.
    """
    height = position_m[2] - sample(site.terrain_m, site, position_m[:2])
    scale = jnp.asarray(background_scale, jnp.float32)
    theta = jnp.stack([position_m[0], position_m[1], height, jnp.log(activity_bq), jnp.log(scale)])
    problem = FitProblem(
        site=site,
        detectors=detectors,
        measurements=cleared(measurements),
        nuclide=nuclide,
        natural=natural_background(site, detectors, cleared(measurements), ground_share),
        extra_cps=jnp.broadcast_to(jnp.asarray(extra_rate_cps, jnp.float32), measurements.counts.shape),
        height_m=height,
        height_std_m=jnp.asarray(jnp.inf, jnp.float32),
        rays=rays,
    )
    return evaluate(problem, theta).information


def cramer_rao_covariance(information: jax.Array, height_std_m: jax.Array | float = jnp.inf) -> jax.Array:
    """Lower bound [5, 5] of the covariance of an unbiased estimate, from `fisher_information`.

    ``height_std_m`` is the standard deviation of the prior of the height (0 = known, inf = no prior).
    """
    return scaled_inverse(information.at[2, 2].add(height_precision(height_std_m)))


def scaled_inverse(matrix: jax.Array) -> jax.Array:
    """Inverse [k, k] of a positive semidefinite matrix, scaled to unit diagonal first (its entries span 12 decades)."""
    scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 1e-20))
    unit = matrix * scale[:, None] * scale + 1e-6 * jnp.eye(matrix.shape[0])
    root = jax.scipy.linalg.solve_triangular(
        jax.scipy.linalg.cholesky(unit, lower=True), jnp.eye(matrix.shape[0]), lower=True
    )
    return (root.T @ root) * scale[:, None] * scale


def position_covariance(site: Site, theta: jax.Array, covariance: jax.Array) -> jax.Array:
    """Covariance [3, 3] of the world position from that [5, 5] of theta: z follows the ground below (x, y)."""
    _, slope = sample_with_gradient(site.terrain_m, site, theta[:2])
    turn = jnp.eye(3).at[2, :2].set(slope)
    return turn @ covariance[:3, :3] @ turn.T
