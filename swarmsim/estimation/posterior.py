"""Mean and covariance of the posterior of each source, and what another one beside it would have to be to be noticed.

`swarmsim.estimation.importance_sampling` samples them.

The likelihood is raised to a power below one, the learning rate (Holmes and Walker, Biometrika 104, 2017, 497): errors
of the model are alike in neighbouring windows, and a posterior that takes each for one of its own is too narrow.

The posterior of a source holds the places of the others. Where sampling finds a place of one that explains the counts
better than the search had, the source is moved, and all are sampled again if it was far or others are near (iterated
conditional modes: Besag, "On the statistical analysis of dirty pictures", JRSS B 48, 1986, 259).
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.device import IN_STEP, for_those, repeat_while, some_at_a_time
from swarmsim.estimation.fit import alone, log_prior_of_activity, settle
from swarmsim.estimation.focus import focused
from swarmsim.estimation.forward import Problem, ways_from
from swarmsim.estimation.importance_sampling import Posterior, sample_posterior
from swarmsim.estimation.likelihood import height_precision, position_of, scaled_inverse
from swarmsim.estimation.mixture import Weighed
from swarmsim.estimation.modes import modes_around
from swarmsim.estimation.normal_equations import (
    MEAN_FLOOR,
    joint_equations,
    log_prior_of_lengths,
    normal_equations,
)
from swarmsim.estimation.search import attempt, bounds, heard_most_at
from swarmsim.estimation.seek import with_source
from swarmsim.estimation.state import ALONE_STEPS, State, without
from swarmsim.pytree import pytree

MODES = 96  # likely places by the screen, about which some are drawn
NO_TAIL = 1e5  # degrees of freedom of a distribution that is as good as normal
WEIGH_STEPS = 2  # Gauss-Newton steps at a place
SWEEPS = 5  # over all sources, at most
BETTER = 4.0  # in the logarithm of the likelihood, a place at which a source is taken to be from then on
FAR_M = 0.5  # from where a source was to such a place: its posterior is sampled again
TOGETHER_M = 25.0  # sources nearer to one another are not known independently of one another


@pytree
class Goodness:
    """Pearson's chi-squared of the fit of all sources."""

    chi_squared: jax.Array  # []
    freedom: jax.Array  # [] degrees of freedom
    spread: jax.Array  # [] standard deviation of chi-squared


@pytree
class Sampled:
    """What is known of K sources; it means nothing where there is none."""

    posterior: Posterior  # [K] of each, the places of the others held
    beside: jax.Array  # [K] information (1/Bq^2) about another one beside each (`modes_around`)
    state: State  # of the likeliest places
    moved: jax.Array  # [] bool: whether a likelier place was found still, from which not all were sampled again


def posteriors(problem: Problem, state: State, rounds: int, per_round: int) -> Sampled:
    """Posteriors of all sources, one after another.

    Sampling looks at more places than the search, and at all of what the counts leave open. Where one is found that
    explains them better the source is there from then on, and all may be sampled again beside it (`_moved`).
    """
    zero, count = jnp.zeros(()), state.sources.present.shape[0]
    nowhere = Posterior(
        mean=jnp.zeros(4), covariance=jnp.eye(4), effective=zero, halves=zero, likeliest=jnp.zeros(3)
    )  # fmt: skip

    def one(known: tuple[State, jax.Array], k: jax.Array) -> tuple[tuple[State, jax.Array], Any]:
        state, moved = known

        def sample() -> tuple[tuple[State, jax.Array], Any]:
            own = _as_fitted(problem, state, k)
            posterior, beside = _posterior(problem, own, k, rounds, per_round)
            after, far = _moved(problem, own, k, posterior.likeliest)
            return (after, moved | far), (posterior, beside)

        return for_those(state.sources.present[k], sample, lambda: (known, (nowhere, zero)), IN_STEP)

    def sweep(at: tuple[Sampled, jax.Array]) -> tuple[Sampled, jax.Array]:
        known = at[0].state, jnp.array(False)
        (state, moved), (posterior, beside) = jax.lax.scan(one, known, jnp.arange(count))
        return Sampled(posterior=posterior, beside=beside, state=state, moved=moved), at[1] + 1

    every = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), nowhere)
    start = Sampled(posterior=every, beside=jnp.zeros(count), state=state, moved=jnp.array(True))
    return repeat_while(lambda at: at[0].moved & (at[1] < SWEEPS), sweep, (start, jnp.int32(0)), IN_STEP)[0]


def _as_fitted(problem: Problem, state: State, k: jax.Array) -> State:
    """The state with the unknowns of a fit of source ``k`` where it is, unless that fit explains the counts much worse.

    Those of the fit that came last, if it was of another one, know nothing of the walls about this one: what is far
    from its place would be summed up about thicknesses with which its activity explains no count. With the lengths the
    activities, the windows' unknowns and the likelihood are those of that fit too.
    """
    if not problem.uncertain:
        return state
    s = state.sources
    tried = attempt(problem, s.nuclide[k], without(state, k).added, state.unknowns, s.place[k])
    # the lengths and the height of each fit are its own source's: what is likely of them is not compared
    above = height_precision(problem.height_std_m) * jnp.square(s.place[k, 2] - problem.height_m)
    after = tried.fit.likelihood + 0.5 * above - log_prior_of_lengths(problem, tried.fit.unknowns.lengths)
    before = state.likelihood - log_prior_of_lengths(problem, state.unknowns.lengths)
    sound = jnp.isfinite(tried.fit.value) & (after > before - BETTER)
    return jax.tree.map(partial(jnp.where, sound), with_source(problem, state, k, tried), state)


def _moved(problem: Problem, state: State, k: jax.Array, place: jax.Array) -> tuple[State, jax.Array]:
    """The state with source ``k`` at ``place`` [3], if that explains the counts better; and whether [] to sample again.

    The places that were drawn lie about the better one as well unless it is far from the one before, and others hardly
    notice the change unless they are near.
    """
    s = state.sources
    tried = attempt(problem, s.nuclide[k], without(state, k).added, state.unknowns, place)
    better = jnp.isfinite(tried.fit.value) & (tried.fit.likelihood > state.likelihood + BETTER)
    apart = jnp.linalg.norm(s.place - s.place[k], axis=-1)
    beside = jnp.any(s.present & (apart < TOGETHER_M) & (jnp.arange(len(apart)) != k))
    far = jnp.linalg.norm(place - s.place[k]) > FAR_M
    return jax.tree.map(partial(jnp.where, better), with_source(problem, state, k, tried), state), better & (
        far | beside
    )


def of_others(problem: Problem, state: State) -> jax.Array:
    """What it adds to each covariance [K, 4, 4] that the places of the others are not known either.

    The posterior of each holds them. Of companions, that hides most of what is not known of either: of two of 170 MBq
    6 m apart, flown over at 15 m, the activities are six times as uncertain. By the Gauss-Newton information about all.
    """
    s, count = state.sources, state.sources.present.shape[0]
    apart = jnp.linalg.norm(s.place[:, None, :2] - s.place[:, :2], axis=-1)
    near = (apart < TOGETHER_M) & s.present[:, None] & s.present & ~jnp.eye(count, dtype=bool)

    def wider() -> jax.Array:
        u, model = alone(problem, state.added, state.unknowns, ALONE_STEPS)
        places = jax.vmap(lambda place: position_of(problem.site, place))(s.place)
        low, high = bounds(problem)
        prior = jnp.append(12.0 / jnp.square(high - low), 1.0 / jnp.square(problem.log_activity_std))
        prior = jnp.tile(prior.at[2].set(height_precision(problem.height_std_m)), count)
        information = problem.learning_rate * joint_equations(problem, model, u, places)[0] + jnp.diag(prior)
        is_place, owner = jnp.arange(4 * count) % 4 < 3, jnp.arange(4 * count) // 4
        every = scaled_inverse(information)

        def one(k: jax.Array) -> jax.Array:
            held = is_place & (owner != k)
            alone_ = scaled_inverse(jnp.where(held[:, None] | held, 0.0, information) + jnp.diag(held * 1.0))
            return jax.lax.dynamic_slice(every - alone_, (4 * k, 4 * k), (4, 4))

        added = jax.lax.map(one, jnp.arange(count))
        # it is positive but for rounding
        size, axes = jnp.linalg.eigh(0.5 * (added + jnp.swapaxes(added, 1, 2)))
        return (axes * jnp.maximum(size, 0.0)[:, None]) @ jnp.swapaxes(axes, 1, 2)

    wide = for_those(jnp.any(near), wider, lambda: jnp.zeros((count, 4, 4)))
    return jnp.where(jnp.any(near, axis=1)[:, None, None], wide, 0.0)


def _posterior(
    problem: Problem, state: State, k: jax.Array, rounds: int, per_round: int
) -> tuple[Posterior, jax.Array]:  # fmt: skip
    problem, state = focused(problem, state, k)
    limits, s = bounds(problem), state.sources
    others = without(state, k).added
    u, nuclide = replace(state.unknowns, activity_bq=s.activity_bq[k]), s.nuclide[k]
    rate = problem.learning_rate

    known = 12.0 / jnp.square(limits[1] - limits[0])  # uniform over the site
    known = known.at[2].set(height_precision(problem.height_std_m))

    def weigh(place: jax.Array, off_m: jax.Array) -> Weighed:
        fit = settle(problem, ways_from(problem, place, off_m), nuclide, others, u, WEIGH_STEPS)
        # it is the likelihood that counts less often; the priors, which the value holds as well, count in full
        priors = -0.5 * height_precision(problem.height_std_m) * jnp.square(place[2] - problem.height_m)
        priors += log_prior_of_activity(problem, fit.unknowns.activity_bq)
        sound = jnp.all((place >= limits[0]) & (place <= limits[1])) & jnp.isfinite(fit.value) & jnp.isfinite(priors)
        return Weighed(
            place=place,
            log_activity=jnp.log(jnp.maximum(fit.unknowns.activity_bq, 1e-3)),
            variance=fit.covariance[0, 0] / rate,
            log_posterior=jnp.where(sound, rate * fit.value + (1.0 - rate) * priors, -jnp.inf),
            information=rate * fit.towards + jnp.diag(known),
        )

    covariance = scaled_inverse(rate * s.towards[k] + jnp.diag(known))
    modes, beside = some_at_a_time(lambda: modes_around(problem, state, k, others, u, MODES))
    pivot = heard_most_at(problem, s.place[k], jnp.sum(state.added.counts[k], axis=1))
    off = problem.geometry_std_m
    return sample_posterior(weigh, s.place[k], covariance, rounds, per_round, modes, pivot, off), beside


def goodness(problem: Problem, state: State) -> Goodness:
    """How well the sources of ``state`` describe the counts."""
    # outliers that the fit may take for errors of the model are to be seen here
    problem = replace(problem, tail=jnp.asarray(NO_TAIL))
    m = problem.measurements
    assert m.rois is not None
    u, model = alone(problem, state.added, state.unknowns, ALONE_STEPS)
    at = normal_equations(problem, model, u)
    found = model.mean.T
    mean = jnp.maximum(found, MEAN_FLOOR)
    cells = m.valid[:, None] & (problem.background > 0.0)
    return Goodness(
        chi_squared=jnp.sum(jnp.where(cells, problem.trust * jnp.square(m.rois - found) / mean, 0.0)),
        freedom=jnp.maximum(jnp.sum(cells) - at.fitted - 4.0 * jnp.sum(state.sources.present), 1.0),
        spread=jnp.sqrt(jnp.sum(jnp.where(cells, 2.0 + 1.0 / mean, 0.0))),
    )
