"""Localisation of one point source by the likelihood of the counts, with the full forward model of the measurement.

A search from several starts (`swarmsim.estimation.search`) ends near the largest likelihood; damped Fisher scoring
(Levenberg–Marquardt on the Poisson likelihood, Osborne 1992) goes the rest of the way. Places drawn round that maximum
give the estimate, the mean of the posterior, and its covariance (`swarmsim.estimation.posterior`); in the open they are
the maximum and the inverse of the information there.
"""

import jax
import jax.numpy as jnp

from swarmsim.config.mission import Localisation
from swarmsim.estimation.likelihood import (
    Evaluation,
    FitProblem,
    evaluate,
    in_blocks,
    natural_background,
    position_covariance,
    position_of,
    scaled_inverse,
)
from swarmsim.estimation.measurements import Measurements, cleared
from swarmsim.estimation.posterior import Posterior, sample_posterior
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
ENOUGH_EFFECTIVE = 4.0  # weighted places must be worth this many: the mean is then within half a standard deviation


@pytree
class LocalisationParams:
    """Settings of `localise`."""

    presumed_height_m: jax.Array  # [] prior mean of the source's height above ground
    height_std_m: jax.Array  # [] its standard deviation; 0 = known
    learning_rate_m: jax.Array  # [] first step of Adam
    ground_share: jax.Array  # [] share of the nominal background that falls with height
    search_radius_m: jax.Array  # [] reach of the first round of the pattern search
    iterations: int = static()  # of Adam
    search_rounds: int = static()  # of the pattern search
    fisher_steps: int = static()  # of the polish
    sample_rounds: int = static()  # of the posterior's places
    samples: int = static()  # places in a round
    rays: int = static()  # to a window, along its way


@pytree
class SourceFit:
    """The estimate of one source: mean and covariance of the posterior."""

    position_m: jax.Array  # [3] m, world ENU
    activity_bq: jax.Array  # []
    background_scale: jax.Array  # [] background over the detectors' nominal one
    covariance_m2: jax.Array  # [3, 3] of the position; bounded by the site's size where the data say nothing
    activity_std_bq: jax.Array  # []
    log_likelihood: jax.Array  # [] nats, relative to the saturated model, at its maximum
    log_likelihood_background_only: jax.Array  # [] the same without a source, background scale fitted
    detection: jax.Array  # [] twice their difference: generalised likelihood ratio, see `detected`
    reduced_deviance: jax.Array  # [] about 1 for a model that describes the counts; tens: a local optimum, more sources
    effective_samples: jax.Array  # [] number of independent places that the posterior's weighted ones are worth
    windows: jax.Array  # [] number of valid ones
    converged: jax.Array  # [] bool: those are enough for a mean, and the place is within the site


def localisation_params(spec: Localisation, ground_share: float = 0.0) -> LocalisationParams:
    """Settings from the configuration (host); ``ground_share`` of the background falls with height."""
    return LocalisationParams(
        presumed_height_m=jnp.float32(spec.presumed_height_m),
        height_std_m=jnp.float32(spec.height_std_m),
        learning_rate_m=jnp.float32(spec.learning_rate_m),
        ground_share=jnp.float32(ground_share),
        search_radius_m=jnp.float32(spec.search_radius_m),
        iterations=spec.iterations,
        search_rounds=spec.search_rounds,
        fisher_steps=spec.fisher_steps,
        sample_rounds=spec.sample_rounds,
        samples=spec.samples,
        rays=spec.rays_per_window,
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
    order = in_blocks(m)
    m, extra = jax.tree.map(lambda leaf: leaf[order], (m, extra))
    problem = FitProblem(
        site=site,
        detectors=detectors,
        measurements=m,
        nuclide=nuclide,
        natural=natural_background(site, detectors, m, params.ground_share),
        extra_cps=jnp.where(m.valid, extra, 0.0),
        height_m=params.presumed_height_m,
        height_std_m=params.height_std_m,
        rays=params.rays,
    )
    limits = bounds(problem)
    log_scale, without_source = background_only(problem)
    candidates = gradient_search(problem, limits, initial_xy, log_scale, params.learning_rate_m, params.iterations)
    best = pattern_search(problem, limits, candidates, log_scale, params.search_radius_m, params.search_rounds)
    theta, found = _polish(problem, limits, best, params.fisher_steps)
    # Where the data say nothing, a coordinate is known to the range it was sought in: uniform, variance range² / 12.
    covariance = scaled_inverse(found.information + jnp.diag(12.0 / jnp.square(limits[1] - limits[0])))
    posterior = sample_posterior(problem, limits, theta, covariance, log_scale, params.sample_rounds, params.samples)
    return _report(problem, limits, posterior, found, without_source)


def detected(fit: SourceFit, significance_sigma: jax.Array | float) -> jax.Array:
    """Whether there is a source: the likelihood ratio exceeds ``significance_sigma`` squared.

    At one given place twice the log likelihood ratio of an activity >= 0 is, without a source, half a chi-square of
    one degree of freedom (Chernoff 1954), so its root exceeds s with chance Q(s); the search over places multiplies
    this by about the number of detector footprints in the site (some tens), which 5 sigma (Q = 2.9e-7) leaves far
    below one per cent.
    """
    return fit.detection > jnp.square(significance_sigma)


def _polish(problem: FitProblem, limits: Bounds, theta: jax.Array, steps: int) -> tuple[jax.Array, Evaluation]:
    """Damped Fisher scoring from ``theta`` [5]: the end point and the likelihood there."""
    reach = jnp.array([POSITION_STEP_M, POSITION_STEP_M, POSITION_STEP_M, LOG_STEP, LOG_STEP])
    Carry = tuple[jax.Array, Evaluation, jax.Array, jax.Array]

    def step(carry: Carry, _: None) -> tuple[Carry, None]:
        theta, here, damping, trial = carry
        there = evaluate(problem, trial)
        better = there.log_posterior >= here.log_posterior
        theta, here = jax.tree.map(lambda a, b: jnp.where(better, a, b), (trial, there), (theta, here))
        damping = jnp.clip(damping * jnp.where(better, 0.1, 10.0), 1e-6, 1e4)
        damped = here.information + damping * jnp.diag(jnp.diagonal(here.information))
        move = scaled_inverse(damped) @ here.score
        move = move * jnp.minimum(1.0, jnp.min(reach / jnp.maximum(jnp.abs(move), 1e-9)))
        return (theta, here, damping, jnp.clip(theta + move, *limits)), None

    unknown = -jnp.asarray(jnp.inf)
    nowhere = Evaluation(
        log_likelihood=unknown, log_posterior=unknown, score=jnp.zeros(5), information=jnp.eye(5)
    )  # worse than any place: the first trial, the start itself, is taken
    (theta, here, _, _), _ = jax.lax.scan(step, (theta, nowhere, jnp.asarray(1e-2), theta), None, length=steps + 1)
    return theta, here


def _report(
    problem: FitProblem, limits: Bounds, posterior: Posterior, best: Evaluation, without_source: jax.Array
) -> SourceFit:
    """The fit of a posterior and the largest likelihood found."""
    low, high = limits
    theta, covariance = posterior.mean, posterior.covariance
    inside = jnp.all((theta[:2] > low[:2]) & (theta[:2] < high[:2]))
    activity = jnp.exp(theta[3])
    return SourceFit(
        position_m=position_of(problem.site, theta),
        activity_bq=activity,
        background_scale=jnp.exp(theta[4]),
        covariance_m2=position_covariance(problem.site, theta, covariance),
        activity_std_bq=activity * jnp.sqrt(covariance[3, 3]),
        log_likelihood=best.log_likelihood,
        log_likelihood_background_only=without_source,
        detection=jnp.maximum(2.0 * (best.log_likelihood - without_source), 0.0),
        reduced_deviance=-2.0 * best.log_likelihood / jnp.maximum(jnp.sum(problem.measurements.valid) - 5, 1),
        effective_samples=posterior.effective,
        windows=jnp.sum(problem.measurements.valid),
        converged=(posterior.effective >= ENOUGH_EFFECTIVE) & inside,
    )
