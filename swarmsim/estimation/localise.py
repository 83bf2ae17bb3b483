"""Localisation: the number of sources, their places, activities and nuclides, from the counts by region of interest.

`problem_of` puts together what is known, `localise` finds the sources (`swarmsim.estimation.sources`) and samples the
posterior of each (`swarmsim.estimation.posterior`).
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.mission import Localisation
from swarmsim.device import IN_STEP, for_those, repeat_while
from swarmsim.estimation.detection_limit import noticed, noticed_from
from swarmsim.estimation.forward import Problem, models_of, padded, trust_of
from swarmsim.estimation.importance_sampling import Posterior
from swarmsim.estimation.likelihood import natural_background, position_covariance
from swarmsim.estimation.measurements import Measurements, cleared
from swarmsim.estimation.nodes import Span, nodes_of
from swarmsim.estimation.pairs import strain
from swarmsim.estimation.posterior import Sampled, goodness, of_others, posteriors
from swarmsim.estimation.presumed import Presumed
from swarmsim.estimation.scan import true_counts
from swarmsim.estimation.seek import HOPELESS, SearchParams
from swarmsim.estimation.sources import find_sources, needed
from swarmsim.estimation.state import Sources, State, no_sources
from swarmsim.pytree import on_host, pytree, static
from swarmsim.site import sample

TAIL = 4.0  # degrees of freedom of the error of a window's rate: a post between two rays takes a third of the counts
WAY_SHARE = 0.05  # of a window's way, by which it departs from a straight one at constant speed
CONVERGED_EFFECTIVE = 10.0  # weighted places must be worth this many
HALVES_AGREE = 1.5  # standard deviations between the means of two halves of the places
TURNS = 2  # that sources are sought and sampled, at most
UNSURE = 0.25  # standard deviation of a place whose posterior could not be sampled, over the reach of the search
UNSURE_ACTIVITY = 0.5  # the same of the logarithm of its activity


@pytree
class LocalisationParams:
    """Settings of `localise`."""

    search: SearchParams
    sample_rounds: int = static()  # of the posterior's places
    samples: int = static()  # places in a round
    rays: int = static()  # to a window of a vehicle on the ground, along its way


@pytree
class SourceFits:
    """Estimates of K sources, the surest first: mean and covariance of the posterior of each."""

    present: jax.Array  # [K] bool
    position_m: jax.Array  # [K, 3] m, world ENU
    covariance_m2: jax.Array  # [K, 3, 3]
    activity_bq: jax.Array  # [K]
    activity_std_bq: jax.Array  # [K]
    nuclide: jax.Array  # [K] int32
    nuclide_confidence: jax.Array  # [K] posterior of that nuclide among those in question, from the survey's counts
    detection: jax.Array  # [K] twice the logarithm of the likelihood ratio against the same without it
    effective_samples: jax.Array  # [K] number of independent places that the posterior's weighted ones are worth
    converged: jax.Array  # [K] bool: those are enough, and two halves of them agree
    joined_m: jax.Array  # [K] so far off another one of its nuclide would explain the counts better; 0: none
    beside_bq: jax.Array  # [K] from which on another one of its nuclide beside it would have been noticed; inf: never


@pytree
class Estimated:
    """What the counts tell of sources."""

    fits: SourceFits
    background_scale: jax.Array  # [] of the first detector model's nominal one
    misfit: jax.Array  # [] standard deviations by which Pearson's chi-squared exceeds its degrees of freedom
    chi_squared: jax.Array  # [] over its degrees of freedom, about 1 for a model that describes the counts
    strain: jax.Array  # [] what windows' rates depart from the model by, beyond what is usual (`pairs.strain`)
    highest_cps: jax.Array  # [D] true rate of the window with the most, by the model, of each detector model
    windows: jax.Array  # [] number of valid ones
    noticed_bq: jax.Array  # [N] from which on a further source in free view would have been noticed; inf: never
    suspected: jax.Array  # [] ratio of a further one that is not taken for one, over what is asked of a first one
    suspect_m: jax.Array  # [2] where it may be
    suspect_nuclide: jax.Array  # [] int32
    unsought: jax.Array  # [] statistic of a further one that is not sought, over what is asked of one (`noticed`)
    state: State  # to go on from when there are more counts


def localisation_params(spec: Localisation) -> LocalisationParams:
    """Settings from the configuration (host)."""
    return LocalisationParams(
        search=SearchParams(
            threshold=on_host(spec.detection_sigma**2),
            further=on_host(spec.further_sigma**2),
            reach_m=on_host(spec.search_radius_m),
            grid_m=on_host(spec.grid_m),
            rounds=spec.search_rounds,
            sources_max=spec.sources_max,
        ),
        sample_rounds=spec.sample_rounds,
        samples=spec.samples,
        rays=spec.rays_per_window,
    )


def problem_of(presumed: Presumed, measurements: Measurements, spans: tuple[Span, ...]) -> Problem:
    """The data of an estimate; ``spans`` say which rows which detector model measured (`spans_of`)."""
    m = cleared(measurements)
    assert m.rois is not None
    natural = natural_background(presumed.site, presumed.detectors, m, presumed.ground_share)
    regions = m.rois.shape[1]
    nominal = jnp.concatenate(
        [
            jnp.broadcast_to(padded(presumed.detectors[k].background_rois, regions), (last - first, regions))
            for first, last, k, _ in spans
        ]
    )
    travel = jnp.sum(jnp.square(m.travel_m), axis=-1)
    detector, dead_s = models_of(presumed.detectors, spans)
    background = nominal * (natural * m.exposure_s)[:, None]
    return Problem(
        site=presumed.site,
        detectors=presumed.detectors,
        measurements=m,
        background=background,
        trust=trust_of(m.rois, background, jnp.asarray(presumed.spectrum_std)),
        material_std=jnp.asarray(presumed.material_std),
        background_std=jnp.asarray(presumed.background_std),
        model_std=jnp.asarray(presumed.model_std),
        tail=jnp.asarray(TAIL),
        learning_rate=jnp.asarray(presumed.learning_rate),
        log_activity=jnp.asarray(presumed.log_activity),
        log_activity_std=jnp.asarray(presumed.log_activity_std),
        pose_std_m=jnp.sqrt(jnp.square(presumed.pose_std_m) + WAY_SHARE**2 * travel),
        geometry_std_m=jnp.asarray(presumed.geometry_std_m),
        height_m=jnp.asarray(presumed.height_m),
        height_std_m=jnp.asarray(presumed.height_std_m),
        detector=detector,
        dead_s=dead_s,
        nodes=nodes_of(presumed.site, m, spans),
        spans=spans,
        uncertain=presumed.uncertain,
    )


def localise(
    presumed: Presumed,
    measurements: Measurements,
    spans: tuple[Span, ...],
    params: LocalisationParams,
    known: State | None = None,
    limits: jax.Array | bool = True,
) -> Estimated:
    """Find all sources that the counts tell of.

    Args:
        presumed: what is known of the world.
        measurements: windows with their counts by region of interest, detector model by detector model.
        spans: rows from, to, and the detector model of each part (`spans_of`; static).
        params: settings.
        known: an earlier estimate's state, to go on from; zeros say nothing.
        limits: [] whether detection limits are asked for; without, they are infinite.
    """
    problem = problem_of(presumed, measurements, spans)
    nuclides = jnp.asarray(presumed.nuclides)
    state = no_sources(problem, params.search.sources_max, nuclides.shape[0])
    if known is not None:
        # the windows are others now
        there = known.sources.present[:, None]
        state = replace(
            state,
            sources=replace(known.sources, place=jnp.where(there, known.sources.place, state.sources.place)),
            unknowns=replace(state.unknowns, level=known.unknowns.level, lengths=known.unknowns.lengths),
        )
    return _report(presumed, problem, params, _found(presumed, problem, params, state), limits)


def _found(presumed: Presumed, problem: Problem, params: LocalisationParams, state: State) -> Sampled:
    """Sources sought from ``state`` on, and their posteriors.

    Where sampling, which looks at more places, has moved one of several much, the others may have taken up what that
    one did not explain: all are sought again from there.
    """
    nuclides, search = jnp.asarray(presumed.nuclides), params.search

    def turn(at: tuple[Sampled, jax.Array, jax.Array]) -> tuple[Sampled, jax.Array, jax.Array]:
        found = find_sources(problem, presumed.places, nuclides, search, at[0].state)
        sampled = posteriors(problem, found, params.sample_rounds, params.samples)
        gain = 2.0 * (sampled.state.likelihood - found.likelihood)
        again = (jnp.sum(found.sources.present) > 1) & (gain > HOPELESS * search.further)
        return sampled, again, at[2] + 1

    shapes = jax.eval_shape(lambda: posteriors(problem, state, params.sample_rounds, params.samples))
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    start = replace(nothing, state=state), jnp.array(True), jnp.int32(0)
    # a loop, so that both are compiled once
    return repeat_while(lambda at: at[1] & (at[2] < TURNS), turn, start, IN_STEP)[0]


def nothing_found(
    presumed: Presumed, measurements: Measurements, spans: tuple[Span, ...], params: LocalisationParams
) -> Estimated:
    """What `localise` returns, all of it zero: to trace that for its shapes alone takes ten seconds."""
    count = params.search.sources_max
    zero, each_ = jnp.zeros(()), jnp.zeros(count)
    fits = SourceFits(
        present=jnp.zeros(count, bool),
        position_m=jnp.zeros((count, 3)),
        covariance_m2=jnp.zeros((count, 3, 3)),
        activity_bq=each_,
        activity_std_bq=each_,
        nuclide=jnp.zeros(count, jnp.int32),
        nuclide_confidence=each_,
        detection=each_,
        effective_samples=each_,
        converged=jnp.zeros(count, bool),
        joined_m=each_,
        beside_bq=each_,
    )
    state = jax.eval_shape(
        lambda: no_sources(problem_of(presumed, measurements, spans), count, np.shape(presumed.nuclides)[0])
    )
    return Estimated(
        fits=fits,
        background_scale=zero,
        misfit=zero,
        chi_squared=zero,
        strain=zero,
        highest_cps=jnp.zeros(len(presumed.detectors)),
        windows=jnp.int32(0),
        noticed_bq=jnp.zeros(np.shape(presumed.nuclides)),
        suspected=zero,
        suspect_m=jnp.zeros(2),
        suspect_nuclide=jnp.int32(0),
        unsought=zero,
        state=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), state),
    )


def sampled(
    presumed: Presumed, params: LocalisationParams, s: Sources, posterior: Posterior
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Whether each posterior [K] was sampled well enough; their means [K, 4] and covariances [K, 4, 4].

    One that could not be computed says nothing: then they are the best place, and the reach of the search as its error.
    """
    known = jnp.concatenate([s.place, jnp.log(jnp.maximum(s.activity_bq, 1.0))[:, None]], axis=1)
    reach, height = params.search.reach_m, jnp.maximum(presumed.height_std_m, 1e-3)
    wide = jnp.diag(jnp.square(jnp.stack([reach, reach, height, jnp.ones(())])))
    sound = jnp.isfinite(posterior.mean).all(axis=1) & jnp.isfinite(posterior.covariance).all(axis=(1, 2))
    mean = jnp.where(sound[:, None], posterior.mean, known)
    covariance = jnp.where(sound[:, None, None], posterior.covariance, wide)
    converged = sound & (posterior.effective >= CONVERGED_EFFECTIVE) & (posterior.halves <= HALVES_AGREE)
    # too few places to tell their spread: it must not look small
    unsure = jnp.square(jnp.stack([UNSURE * reach, UNSURE * reach, jnp.zeros(()), jnp.asarray(UNSURE_ACTIVITY)]))
    return converged, mean, covariance + jnp.where(converged[:, None, None], 0.0, jnp.diag(unsure))


def _report(
    presumed: Presumed, problem: Problem, params: LocalisationParams, of_all: Sampled, limits: jax.Array | bool
) -> Estimated:  # fmt: skip
    site, m = presumed.site, problem.measurements
    posterior, state = of_all.posterior, of_all.state
    posterior = replace(posterior, effective=jnp.where(of_all.moved, 0.0, posterior.effective))
    state, detection = needed(problem, params.search, state)
    s, overall = state.sources, goodness(problem, state)
    converged, mean, covariance = sampled(presumed, params, s, posterior)
    more = of_others(problem, state)
    sound = jnp.isfinite(more).all(axis=(1, 2))
    converged = converged & sound
    nothing_told = jnp.square(UNSURE * params.search.reach_m) * jnp.diag(jnp.array([1.0, 1.0, 0.0, 0.0]))
    covariance = covariance + jnp.where(sound[:, None, None], more, nothing_told)
    # those that were taken away may be a part of it, or it a part of them
    shared_ = jnp.minimum(s.beside_bq / jnp.maximum(s.activity_bq, 1.0), 1.0)
    log_variance = covariance[:, 3, 3] + jnp.square(presumed.common_std) + jnp.square(shared_)
    height = jax.vmap(lambda xy: sample(site.terrain_m, site, xy))(mean[:, :2])
    activity = jnp.exp(mean[:, 3])

    in_space = jax.vmap(partial(position_covariance, site))(mean, covariance)
    # in which direction several would lie is hardly known
    beside = jnp.square(s.beside_m)[:, None, None] * jnp.diag(jnp.array([1.0, 1.0, 0.0]))
    share = jax.nn.softmax(s.nuclide_value, axis=1)
    fits = SourceFits(
        present=s.present,
        position_m=mean[:, :3].at[:, 2].add(height),
        covariance_m2=in_space + jnp.square(presumed.pose_std_m) * jnp.eye(3) + beside,
        activity_bq=activity,
        activity_std_bq=activity * jnp.sqrt(log_variance),
        nuclide=s.nuclide,
        nuclide_confidence=jnp.take_along_axis(share, s.nuclide[:, None], axis=1)[:, 0],
        detection=detection,
        effective_samples=jnp.nan_to_num(posterior.effective),
        converged=converged,
        joined_m=s.joined_m,
        beside_bq=noticed_from(of_all.beside, params.search.further),
    )
    strained, usual = strain(problem, state)
    rate = jnp.sum(true_counts(problem, state.added, state.unknowns), axis=1) / jnp.maximum(m.exposure_s, 1e-9)
    limits_bq, unsought = for_those(
        jnp.asarray(limits),
        lambda: noticed(problem, presumed.places, presumed.nuclides, params.search, state),
        lambda: (jnp.full(jnp.shape(presumed.nuclides), jnp.inf), jnp.zeros(())),
    )
    order = jnp.argsort(jnp.where(s.present, -detection, jnp.inf))

    def ordered(x: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[order], x)

    return Estimated(
        fits=ordered(fits),
        background_scale=jnp.exp(state.unknowns.level[0]),
        misfit=(overall.chi_squared - overall.freedom) / overall.spread,
        chi_squared=overall.chi_squared / overall.freedom,
        strain=strained - usual,
        highest_cps=jnp.max(jnp.where(m.valid, rate, 0.0)[:, None] * problem.detector, axis=0),
        windows=jnp.sum(m.valid),
        noticed_bq=limits_bq,
        suspected=state.suspect.ratio / params.search.threshold,
        suspect_m=state.suspect.place[:2],
        suspect_nuclide=state.suspect.nuclide,
        unsought=unsought,
        state=replace(state, sources=ordered(s), added=ordered(state.added)),
    )
