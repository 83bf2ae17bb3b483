"""Maximum-likelihood localisation of one point source with the full forward model of the measurement.

A search from several starts (`swarmsim.estimation.search`) ends near the largest likelihood; damped Fisher scoring
(Levenberg–Marquardt on the Poisson likelihood, Osborne 1992) goes the rest of the way. Every evaluation of the latter
uses exact path lengths, so its fixed point and its covariance are those of the exact likelihood.
"""

import jax
import jax.numpy as jnp

from swarmsim.config.mission import Localisation
from swarmsim.estimation.likelihood import (
    Evaluation,
    FitProblem,
    evaluate,
    position_covariance,
    position_of,
    scaled_inverse,
)
from swarmsim.estimation.measurements import Measurements, cleared
from swarmsim.estimation.search import (
    LOG_STEP,
    Bounds,
    background_only,
    bounds,
    gradient_search,
    pattern_search,
)
from swarmsim.pytree import pytree, static
from swarmsim.radiation import Detector
from swarmsim.site import Site

POSITION_STEP_M = 10.0  # longest Fisher step of a coordinate
SETTLED_NATS = 0.02  # gain of the last Fisher steps below which the fit has converged: 0.2 standard deviations


@pytree
class LocalisationParams:
    """Settings of `localise`."""

    presumed_height_m: jax.Array  # [] prior mean of the source's height above ground
    height_std_m: jax.Array  # [] its standard deviation; 0 = known
    learning_rate_m: jax.Array  # [] first step of Adam
    search_radius_m: jax.Array  # [] reach of the first round of the pattern search
    iterations: int = static()  # of Adam
    search_rounds: int = static()  # of the pattern search
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
        search_radius_m=jnp.float32(spec.search_radius_m),
        iterations=spec.iterations,
        search_rounds=spec.search_rounds,
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
        params: settings.
        extra_rate_cps: [] or [n] net rate of sources known already (`net_rates`), to find several in turn.

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
    limits = bounds(problem)
    log_scale, without_source = background_only(problem)
    candidates = gradient_search(problem, limits, initial_xy, log_scale, params.learning_rate_m, params.iterations)
    best = pattern_search(problem, limits, candidates, log_scale, params.search_radius_m, params.search_rounds)
    theta, found, settled = _polish(problem, limits, best, params.fisher_steps)
    return _report(problem, limits, theta, found, settled, without_source)


def detected(fit: SourceFit, significance_sigma: jax.Array | float) -> jax.Array:
    """Whether there is a source: the likelihood ratio exceeds ``significance_sigma`` squared.

    At one given place twice the log likelihood ratio of an activity >= 0 is, without a source, half a chi-square of
    one degree of freedom (Chernoff 1954), so its root exceeds s with chance Q(s); the search over places multiplies
    this by about the number of detector footprints in the site (some tens), which 5 sigma (Q = 2.9e-7) leaves far
    below one per cent.
    """
    return fit.detection > jnp.square(significance_sigma)


def _polish(
    problem: FitProblem, limits: Bounds, theta: jax.Array, steps: int
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
        return (theta, here, damping, jnp.clip(theta + move, *limits)), here.log_posterior

    unknown = -jnp.asarray(jnp.inf)
    nowhere = Evaluation(
        log_likelihood=unknown, log_posterior=unknown, score=jnp.zeros(5), information=jnp.eye(5)
    )  # worse than any place: the first trial, the start itself, is taken
    (theta, here, _, _), course = jax.lax.scan(step, (theta, nowhere, jnp.asarray(1e-2), theta), None, length=steps + 1)
    return theta, here, course[-1] - course[-1 - max(1, steps // 3)] < SETTLED_NATS


def _report(
    problem: FitProblem,
    limits: Bounds,
    theta: jax.Array,
    here: Evaluation,
    settled: jax.Array,
    without_source: jax.Array,
) -> SourceFit:
    """The fit at the end point ``theta`` [5]."""
    low, high = limits
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
        log_likelihood_background_only=without_source,
        detection=jnp.maximum(2.0 * (here.log_likelihood - without_source), 0.0),
        reduced_deviance=-2.0 * here.log_likelihood / jnp.maximum(jnp.sum(problem.measurements.valid) - 5, 1),
        converged=settled & inside,
    )
