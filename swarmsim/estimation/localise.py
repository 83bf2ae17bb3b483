"""Maximum-likelihood localisation of one point source with the full forward model of the measurement.

Two stages, because rays through walls and terrain cost a hundred times what the rest of the likelihood does:

1. Adam (optax) with a cosine-decayed step from several starts. The exact net rates r0, and the activity and the
   background that fit them best, are computed at the start of each segment of `SPREAD_M`; within one,
   r = r0 d0² / d² with d the distance to the crystal, the only part that changes quickly. What is held (attenuation,
   build-up, direction) changes r by a few per cent over the few metres of a segment, and is exact again at the next.
   The source is spread out at first, so that a start is not caught between windows close to the ground.
2. From the best end point, by exact likelihood: damped Fisher scoring (Levenberg–Marquardt on the Poisson likelihood,
   Osborne 1992) in which every evaluation uses exact path lengths. It removes what the first stage left, and its
   fixed point is that of the exact likelihood.
"""

import jax
import jax.numpy as jnp
import optax

from swarmsim.config.mission import Localisation
from swarmsim.estimation.likelihood import (
    FIXED_STD_M,
    Evaluation,
    FitProblem,
    evaluate,
    expected_counts,
    height_precision,
    net_rates,
    observed_rates,
    poisson_log_likelihood,
    position_covariance,
    position_of,
    scaled_inverse,
)
from swarmsim.estimation.measurements import Measurements, cleared
from swarmsim.pytree import pytree, static
from swarmsim.radiation import Detector
from swarmsim.site import Site, sample_with_gradient

# The first stage computes exact rates once per entry. Each entry is the length in m over which the source is taken to
# be spread: it turns 1/d² to 1/(d² + s²), without which a start outside the ring that a rover drove could not cross it.
SPREAD_M = (10.0, 5.0, 2.0, 0.0, 0.0, 0.0)
PROFILE_STEPS = 10  # Fisher steps for activity and background with the position held
LOG_ACTIVITY = (0.0, 34.5)  # 1 Bq to 1e15 Bq
LOG_SCALE = (-4.6, 4.6)  # 1 % to 100 times the nominal background
LOG_STEP = 1.0  # longest Fisher step of a logarithm
POSITION_STEP_M = 10.0  # longest Fisher step of a coordinate
SETTLED_NATS = 0.02  # gain of the last Fisher steps below which the fit has converged: 0.2 standard deviations
HEIGHT_REACH = 4.0  # the height is sought within this many of its standard deviations
# Adam moves every coordinate by about its rate per iteration: logarithms by these per metre of learning rate.
LOG_RATES = (0.3, 0.1)


@pytree
class LocalisationParams:
    """Settings of `localise`."""

    presumed_height_m: jax.Array  # [] prior mean of the source's height above ground
    height_std_m: jax.Array  # [] its standard deviation; 0 = known
    learning_rate_m: jax.Array  # [] first step of Adam
    iterations: int = static()  # of Adam
    fisher_steps: int = static()  # of the polish


@pytree
class SourceFit:
    """The estimate of one source, with uncertainties from the Fisher information at the optimum (prior included)."""

    position_m: jax.Array  # [3] m, world ENU
    activity_bq: jax.Array  # []
    background_scale: jax.Array  # [] background over the detectors' nominal one
    covariance_m2: jax.Array  # [3, 3] of the position; bounded by the site's size where the data say nothing
    activity_std_bq: jax.Array  # []
    log_likelihood: jax.Array  # [] nats, relative to the saturated model
    log_likelihood_background_only: jax.Array  # [] the same without a source, background scale fitted
    detection: jax.Array  # [] twice their difference: generalised likelihood ratio, see `detected`
    reduced_deviance: jax.Array  # [] about 1 for a model that describes the counts; tens: a local optimum, more sources
    converged: jax.Array  # [] bool: the last steps gained nothing, and the place is within the site


def localisation_params(spec: Localisation) -> LocalisationParams:
    """Settings from the configuration (host)."""
    return LocalisationParams(
        presumed_height_m=jnp.float32(spec.presumed_height_m),
        height_std_m=jnp.float32(spec.height_std_m),
        learning_rate_m=jnp.float32(spec.learning_rate_m),
        iterations=spec.iterations,
        fisher_steps=spec.fisher_steps,
    )


def localise(
    site: Site,
    detectors: tuple[Detector, ...],
    measurements: Measurements,
    initial_xy: jax.Array,
    nuclide: jax.Array,
    params: LocalisationParams,
    extra_rate_cps: jax.Array | float = 0.0,
) -> SourceFit:
    """Estimate position, activity and background of a source of known nuclide.

    Args:
        site: the known site (attenuation).
        detectors: what ``measurements.detector`` indexes; all share one likelihood.
        measurements: windows, about a second each.
        initial_xy: [S, 2] starting points, m, world ENU (`initial_points`).
        nuclide: [] int32 index in the library's order.
        params: settings. extra_rate_cps: [] or [n] net rate of sources already known, to find several one after the
        other (`net_rates`).

    Returns:
        The fit. It always exists: ask `detected` whether there is a source at all.
    """
    m = cleared(measurements)
    extra = jnp.broadcast_to(jnp.asarray(extra_rate_cps, jnp.float32), m.counts.shape)
    problem = FitProblem(
        site=site,
        detectors=detectors,
        measurements=m,
        nuclide=nuclide,
        extra_cps=jnp.where(m.valid, extra, 0.0),
        height_m=params.presumed_height_m,
        height_std_m=params.height_std_m,
    )
    bounds = _bounds(problem)
    log_scale, background_only = _background_only(problem)
    candidates = _search(problem, bounds, initial_xy, log_scale, params)
    theta, found, settled = _polish(problem, bounds, _best(problem, candidates), params.fisher_steps)
    return _report(problem, bounds, theta, found, settled, background_only)


def detected(fit: SourceFit, significance_sigma: jax.Array | float) -> jax.Array:
    """Whether there is a source: the likelihood ratio exceeds ``significance_sigma`` squared.

    At one given place twice the log likelihood ratio of an activity >= 0 is, without a source, half a chi-square of
    one degree of freedom (Chernoff 1954), so its root exceeds s with chance Q(s); the search over places multiplies
    this by about the number of detector footprints in the site (some tens), which 5 sigma (Q = 2.9e-7) leaves far
    below one per cent.
    """
    return fit.detection > jnp.square(significance_sigma)


def _bounds(problem: FitProblem) -> tuple[jax.Array, jax.Array]:
    """Lower and upper bounds [5] of theta."""
    site = problem.site
    ny, nx = site.terrain_m.shape
    extent = site.cell_m * jnp.array([nx - 1, ny - 1], jnp.float32)
    reach = HEIGHT_REACH * jnp.maximum(problem.height_std_m, FIXED_STD_M)

    def limits(corner: jax.Array, height: jax.Array, end: int) -> jax.Array:
        return jnp.concatenate([corner, height[None], jnp.array([LOG_ACTIVITY[end], LOG_SCALE[end]])])

    return limits(site.origin_m, problem.height_m - reach, 0), limits(
        site.origin_m + extent, problem.height_m + reach, 1
    )


def _background_only(problem: FitProblem) -> tuple[jax.Array, jax.Array]:
    """Best log background scale [] without a source, and its log likelihood []."""
    m = problem.measurements
    none = jnp.zeros_like(m.counts)

    def step(_: int, log_scale: jax.Array) -> jax.Array:
        mean, slope = jax.jvp(lambda s: expected_counts(problem, none, s), (log_scale,), (jnp.ones_like(log_scale),))
        mean = jnp.maximum(mean, 1e-6)
        score = jnp.sum(jnp.where(m.valid, slope * (m.counts - mean) / mean, 0.0))
        information = jnp.sum(jnp.where(m.valid, slope * slope / mean, 0.0))
        return jnp.clip(log_scale + jnp.clip(score / jnp.maximum(information, 1e-12), -LOG_STEP, LOG_STEP), *LOG_SCALE)

    log_scale = jax.lax.fori_loop(0, 2 * PROFILE_STEPS, step, jnp.zeros(()))
    return log_scale, poisson_log_likelihood(m.counts, expected_counts(problem, none, log_scale), m.valid)


def _profile(problem: FitProblem, rates: jax.Array, log_scale: jax.Array) -> jax.Array:
    """Best log activity and log scale [2] at a held position with net rates ``rates`` [n] per becquerel."""
    m = problem.measurements
    # Start where the source gives as much as the background to the windows that see it best.
    brightest = jnp.max(jnp.where(m.valid, rates, 0.0))
    level = observed_rates(problem.detectors, m, jnp.zeros_like(rates), jnp.ones(()))
    start = jnp.log(jnp.maximum(jnp.max(jnp.where(m.valid, level, 0.0)), 1.0) / jnp.maximum(brightest, 1e-20))

    def step(_: int, v: jax.Array) -> jax.Array:
        mean, jacobian = jax.jvp(lambda a: expected_counts(problem, jnp.exp(a) * rates, v[1]), (v[0],), (jnp.ones(()),))
        _, by_scale = jax.jvp(lambda s: expected_counts(problem, jnp.exp(v[0]) * rates, s), (v[1],), (jnp.ones(()),))
        mean = jnp.maximum(mean, 1e-6)
        j = jnp.where(m.valid, jnp.stack([jacobian, by_scale]), 0.0)
        f = (j / mean) @ j.T
        delta = scaled_inverse(f) @ (j @ ((m.counts - mean) / mean))
        return jnp.clip(v + jnp.clip(delta, -LOG_STEP, LOG_STEP), *jnp.array([LOG_ACTIVITY, LOG_SCALE]).T)

    return jax.lax.fori_loop(0, PROFILE_STEPS, step, jnp.stack([jnp.clip(start, *LOG_ACTIVITY), log_scale]))


def _search(
    problem: FitProblem,
    bounds: tuple[jax.Array, jax.Array],
    initial_xy: jax.Array,
    log_scale: jax.Array,
    params: LocalisationParams,
) -> jax.Array:
    """First stage: theta [S, 5] at the end of Adam from each start."""
    per_segment = -(-params.iterations // len(SPREAD_M))
    optimiser = optax.adam(optax.cosine_decay_schedule(1.0, per_segment * len(SPREAD_M), alpha=1e-3))
    height_rate = jnp.where(params.height_std_m > FIXED_STD_M, jnp.minimum(params.height_std_m, 1.0), 0.0)
    rate = params.learning_rate_m * jnp.concatenate([jnp.ones(2), height_rate[None], jnp.array(LOG_RATES)])

    low, high = bounds
    zero = jnp.zeros(initial_xy.shape[0])
    columns = (initial_xy[:, 0], initial_xy[:, 1], zero + problem.height_m, zero, zero + log_scale)
    theta = jnp.clip(jnp.stack(columns, axis=-1), low, high)
    gradient = jax.vmap(jax.grad(_held_loss), (0, 0, 0, None, None))

    Carry = tuple[jax.Array, optax.OptState]

    def segment(carry: Carry, spread: jax.Array) -> tuple[Carry, None]:
        strength = jax.lax.map(lambda t: _strength(problem, t), carry[0])
        rates = jax.vmap(lambda t, s: s / (_squared_distance(problem, t, t) + spread**2))(carry[0], strength)
        anchor = carry[0].at[:, 3:].set(jax.vmap(lambda r: _profile(problem, r, log_scale))(rates))

        def iteration(carry: Carry, _: None) -> tuple[Carry, None]:
            theta, memory = carry
            update, memory = optimiser.update(gradient(theta, anchor, strength, spread, problem), memory)
            # A spread source's height would make up for the spread.
            step = jnp.where((jnp.arange(5) == 2) & (spread > 0.0), 0.0, rate * update)
            return (jnp.clip(theta + step, low, high), memory), None

        return jax.lax.scan(iteration, (anchor, carry[1]), None, length=per_segment)[0], None

    return jax.lax.scan(segment, (theta, optimiser.init(theta)), jnp.array(SPREAD_M))[0][0]


def _exact_rates(problem: FitProblem, theta: jax.Array) -> jax.Array:
    """Net rate [n] per becquerel at ``theta``."""
    place = position_of(problem.site, theta)
    return net_rates(problem.site, problem.detectors, problem.measurements, place, problem.nuclide)


def _strength(problem: FitProblem, theta: jax.Array) -> jax.Array:
    """Net rate per becquerel times squared distance [n]: what changes slowly with the position."""
    return _exact_rates(problem, theta) * _squared_distance(problem, theta, theta)


def _squared_distance(problem: FitProblem, theta: jax.Array, anchor: jax.Array) -> jax.Array:
    """Squared distance [n] in m² from ``theta`` to every crystal, on the tangent plane of the ground at ``anchor``."""
    ground, slope = sample_with_gradient(problem.site.terrain_m, problem.site, anchor[:2])
    place = jnp.append(theta[:2], ground + slope @ (theta[:2] - anchor[:2]) + theta[2])
    return jnp.maximum(jnp.sum((problem.measurements.position_m - place) ** 2, axis=-1), 1e-4)


def _held_loss(
    theta: jax.Array, anchor: jax.Array, strength: jax.Array, spread: jax.Array, problem: FitProblem
) -> jax.Array:
    """Negative log posterior [] at ``theta`` [5] with the strength [n] of ``anchor`` [5] and a source spread over m."""
    rates = strength / (_squared_distance(problem, theta, anchor) + spread**2)
    return -_log_posterior(problem, theta, jnp.exp(theta[3]) * rates)


def _log_posterior(problem: FitProblem, theta: jax.Array, net_cps: jax.Array) -> jax.Array:
    m = problem.measurements
    prior = 0.5 * height_precision(problem.height_std_m) * (theta[2] - problem.height_m) ** 2
    return poisson_log_likelihood(m.counts, expected_counts(problem, net_cps, theta[4]), m.valid) - prior


def _best(problem: FitProblem, candidates: jax.Array) -> jax.Array:
    """The candidate [5] of largest exact posterior among [S, 5]."""
    posterior = jax.lax.map(lambda t: _log_posterior(problem, t, jnp.exp(t[3]) * _exact_rates(problem, t)), candidates)
    return candidates[jnp.argmax(jnp.where(jnp.isnan(posterior), -jnp.inf, posterior))]


def _polish(
    problem: FitProblem, bounds: tuple[jax.Array, jax.Array], theta: jax.Array, steps: int
) -> tuple[jax.Array, Evaluation, jax.Array]:
    """Second stage: damped Fisher scoring from ``theta`` [5]; the end point, the likelihood there, whether it settled.

    Settled means that the last steps gained nothing, not that the score is zero: at the edge of a wall's shadow the
    best place is a kink of the likelihood.
    """
    reach = jnp.array([POSITION_STEP_M, POSITION_STEP_M, POSITION_STEP_M, LOG_STEP, LOG_STEP])
    Carry = tuple[jax.Array, Evaluation, jax.Array, jax.Array]

    def step(carry: Carry, _: None) -> tuple[Carry, jax.Array]:
        theta, here, damping, trial = carry
        there = evaluate(problem, trial)
        better = there.log_posterior >= here.log_posterior
        theta, here = jax.tree.map(lambda a, b: jnp.where(better, a, b), (trial, there), (theta, here))
        damping = jnp.clip(damping * jnp.where(better, 0.1, 10.0), 1e-6, 1e4)
        damped = here.information + damping * jnp.diag(jnp.diagonal(here.information))
        move = scaled_inverse(damped) @ here.score
        move = move * jnp.minimum(1.0, jnp.min(reach / jnp.maximum(jnp.abs(move), 1e-9)))
        return (theta, here, damping, jnp.clip(theta + move, *bounds)), here.log_posterior

    unknown = -jnp.asarray(jnp.inf)
    nowhere = Evaluation(
        log_likelihood=unknown, log_posterior=unknown, score=jnp.zeros(5), information=jnp.eye(5)
    )  # worse than any place: the first trial, the start itself, is taken
    (theta, here, _, _), course = jax.lax.scan(step, (theta, nowhere, jnp.asarray(1e-2), theta), None, length=steps + 1)
    return theta, here, course[-1] - course[-1 - max(1, steps // 3)] < SETTLED_NATS


def _report(
    problem: FitProblem,
    bounds: tuple[jax.Array, jax.Array],
    theta: jax.Array,
    here: Evaluation,
    settled: jax.Array,
    background_only: jax.Array,
) -> SourceFit:
    """The fit at the end point ``theta`` [5]."""
    low, high = bounds
    # Where the data say nothing, a coordinate is known to the range it was sought in: uniform, variance range² / 12.
    information = here.information + jnp.diag(12.0 / jnp.square(high - low))
    covariance = scaled_inverse(information)
    inside = jnp.all((theta[:2] > low[:2]) & (theta[:2] < high[:2]))
    activity = jnp.exp(theta[3])
    return SourceFit(
        position_m=position_of(problem.site, theta),
        activity_bq=activity,
        background_scale=jnp.exp(theta[4]),
        covariance_m2=position_covariance(problem.site, theta, covariance),
        activity_std_bq=activity * jnp.sqrt(covariance[3, 3]),
        log_likelihood=here.log_likelihood,
        log_likelihood_background_only=background_only,
        detection=jnp.maximum(2.0 * (here.log_likelihood - background_only), 0.0),
        reduced_deviance=-2.0 * here.log_likelihood / jnp.maximum(jnp.sum(problem.measurements.valid) - 5, 1),
        converged=settled & inside,
    )
