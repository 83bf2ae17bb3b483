"""The sampled posterior of a source against its integral on a grid, in the open and beside a wall."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.mission import Knowledge
from swarmsim.estimation import posterior as posterior_module
from swarmsim.estimation.fit import settle
from swarmsim.estimation.forward import rates, ways_from
from swarmsim.estimation.importance_sampling import Posterior
from swarmsim.estimation.localise import problem_of
from swarmsim.estimation.posterior import BETTER, WEIGH_STEPS, _as_fitted, posteriors
from swarmsim.estimation.search import attempt, mirrored_place
from swarmsim.estimation.seek import with_source
from swarmsim.estimation.state import Sources, no_sources, ratios, without
from tests.estimation.survey import detector, drawn, drawn_of_one, mean_rois, place, presumed, survey, windows

AT, ACTIVITY = jnp.array([12.0, 4.0, 1.0]), 170e6
WALLS = [((9.5, 4.0, 1.5), (0.05, 4.0, 1.5), "concrete"), ((12.0, 6.2, 1.5), (2.5, 0.05, 1.5), "concrete")]
SPANS = ((0, 231, 0, 1),)
CO_60 = jnp.int32(0)


def told(boxes, seed):
    """What a survey of 231 windows at 12 m tells of a source whose height is known, and a state with that source."""
    site, flight = place(boxes), survey(altitude=12.0, count=231)
    certain = Knowledge(site="exact", background_std=0.05, model_std=0.01)
    known = presumed(site, (detector(),), knowledge=certain, height_std_m=1e-3)
    problem = problem_of(known, drawn_of_one(site, detector(), flight, AT, ACTIVITY, seed), SPANS)
    return problem, _state(problem, AT)


@jax.jit
def _state(problem, at):
    nothing = no_sources(problem, 1, 1)
    u = replace(nothing.unknowns, activity_bq=jnp.float32(ACTIVITY))
    fit = attempt(problem, CO_60, nothing.added, u, at).fit
    sources = Sources(
        place=at[None],
        nuclide=CO_60[None],
        activity_bq=fit.unknowns.activity_bq[None],
        present=jnp.ones(1, bool),
        nuclide_value=jnp.zeros((1, 1)),
        towards=fit.towards[None],
        joined_m=jnp.zeros(1),
        beside_m=jnp.zeros(1),
        beside_bq=jnp.zeros(1),
    )
    counts = fit.unknowns.activity_bq * fit.rates.counts
    unknowns = replace(fit.unknowns, activity_bq=jnp.zeros(()))
    added = replace(nothing.added, counts=counts[None])
    return replace(nothing, sources=sources, added=added, unknowns=unknowns, likelihood=fit.likelihood)


@jax.jit
def _sampled(problem, state):
    return posteriors(problem, state, 6, 64)


@jax.jit
def _sampled_as_in_a_mission(problem, state):
    return posteriors(problem, state, 40, 24)


def _sample(problem, state):
    return jax.tree.map(lambda x: x[0], _sampled(problem, state).posterior)


@jax.jit
def _grid(problem, state, places):
    nothing = no_sources(problem, 1, 1).added
    u = replace(state.unknowns, activity_bq=state.sources.activity_bq[0])

    def one(at):
        fit = settle(problem, ways_from(problem, at), CO_60, nothing, u, WEIGH_STEPS)
        return jnp.append(at, jnp.log(fit.unknowns.activity_bq)), fit.value, fit.covariance[0, 0]

    return jax.lax.map(one, places)


def weighed(problem, state, centre, reach, count):
    """Places and log activities [n, 4] on a grid of so many metres to each side; weights; variances of the latter."""
    x, y = np.meshgrid(*(at + np.linspace(-reach, reach, count) for at in centre))
    places = jnp.asarray(np.stack([x.ravel(), y.ravel(), np.ones(x.size)], -1), jnp.float32)
    theta, value, own = (np.asarray(v, np.float64) for v in _grid(problem, state, places))
    rate = float(problem.learning_rate)
    # the value has the prior of the activity, which counts in full at any rate
    excess = (theta[:, 3] - float(problem.log_activity)) / float(problem.log_activity_std)
    log_weight = rate * value - (1.0 - rate) * 0.5 * excess**2
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    square = weight.reshape(count, count)
    assert square[[0, -1]].sum() + square[:, [0, -1]].sum() < 0.02
    return theta, weight, own / rate


def integral(problem, state, reach):
    """Mean [4] and standard deviations [4] of the posterior on a grid of so many metres to each side."""
    theta, weight, own = weighed(problem, state, (12.0, 4.0), reach, 35)
    mean = weight @ theta
    variance = weight @ (theta - mean) ** 2
    variance[3] += weight @ own
    return mean, np.sqrt(variance)


@pytest.mark.parametrize("boxes", [[], WALLS])
def test_sampling_moves_a_source_that_the_search_left_beside_its_place(boxes):
    problem, at_its_place = told(boxes, 0)
    beside = _state(problem, AT + jnp.array([1.5, -1.0, 0.0]))
    assert float(beside.likelihood) < float(at_its_place.likelihood) - 2.0 * BETTER
    found = _sampled(problem, beside)
    assert not bool(found.moved)
    assert float(found.state.likelihood) > float(at_its_place.likelihood) - BETTER
    again = _sample(problem, at_its_place)
    std = np.sqrt(np.diag(again.covariance)[:2])
    assert np.all(np.abs(found.posterior.mean[0, :2] - again.mean[:2]) < std)
    np.testing.assert_allclose(found.state.sources.activity_bq[0], ACTIVITY, rtol=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("boxes", "rate", "reach", "near", "usually"),
    [([], 1.0, 4.5, 0.2, 0.1), ([], 0.4, 7.2, 0.2, 0.1), (WALLS, 1.0, 1.7, 0.35, 0.2)],
)
def test_moments_are_those_of_the_integral(boxes, rate, reach, near, usually):
    off = []
    for seed in range(5):
        problem, state = told(boxes, seed)
        problem = replace(problem, learning_rate=jnp.float32(rate))
        mean, std = integral(problem, state, reach)
        found = _sample(problem, state)
        sampled = np.sqrt(np.diag(found.covariance))
        off.append((np.asarray(found.mean) - mean)[[0, 1, 3]] / [*std[:2], sampled[3]])
        # beside walls the weights are flattened until they are worth enough places: wider, never narrower
        assert np.all(sampled[:2] > 0.75 * std[:2])
        assert np.all(sampled[:2] < (1.4 if boxes else 1.2) * std[:2])
        np.testing.assert_allclose(sampled[3], std[3], rtol=0.15)
        assert float(found.effective) > 16.0
    assert np.max(np.abs(off)) < near
    assert np.max(np.sqrt(np.mean(np.square(off), axis=0))) < usually


def test_the_prior_of_the_activity_counts_in_full_at_any_learning_rate():
    """A source presumed to be a tenth stronger, to 3 %, lies farther from the way than its counts alone say."""
    problem, state = told([], 0)
    rate = jnp.float32(0.4)
    presumed_ = {"log_activity": jnp.float32(np.log(1.1 * ACTIVITY)), "log_activity_std": jnp.float32(0.03)}
    problem = replace(problem, learning_rate=rate, **presumed_)
    mean, std = integral(problem, state, 7.2)
    found = _sample(problem, state)
    assert abs(float(found.mean[3]) - mean[3]) < 0.15 * std[3]
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)[:2]), std[:2], rtol=0.2)


@pytest.mark.slow
def test_the_mean_does_not_depend_on_where_sampling_starts():
    problem, state = told(WALLS, 1)
    std = integral(problem, state, 1.7)[1][:2]
    means = [
        _sample(problem, _state(problem, AT + jnp.array([dx, dy, 0.0]))).mean[:2]
        for dx, dy in ((0, 0), (0.5, -0.4), (-0.6, 0.2))
    ]
    assert np.all(np.ptp(np.asarray(means), axis=0) < 0.4 * std)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_source_beside_a_straight_way_may_lie_on_either_side_of_it(seed):
    way = np.column_stack([np.linspace(-30.0, 30.0, 231), np.full(231, 4.0), np.full(231, 0.6)])
    known = presumed(place(), (detector(),), knowledge=Knowledge(site="exact"), height_std_m=1e-3)
    at = jnp.array([2.0, 6.0, 1.0])
    counts = drawn_of_one(place(), detector(), windows(way), at, ACTIVITY, seed)
    problem = problem_of(known, counts, SPANS)
    found = _sample(problem, _state(problem, at))
    across = float(jnp.sqrt(found.covariance[1, 1]))
    assert across > 1.0  # of two metres to each side
    assert abs(float(found.mean[1]) - 4.0) < 2.0
    assert float(jnp.sqrt(found.covariance[0, 0])) < 0.2


@pytest.mark.slow
def test_a_weak_source_beside_a_climb_may_lie_on_a_ring_around_it():
    """A UAV climbs 10 m from it, and flies by above: the ring is around the climb, not around all that was flown."""
    site, (x, y) = place([]), (2.0, -3.0)
    climb = np.column_stack([np.full(16, x), np.full(16, y), np.linspace(0.6, 20.0, 16)])
    along = np.linspace(-35.0, 35.0, 30)
    lines = [np.column_stack([along, np.full(30, y + off), np.full(30, 20.0)]) for off in (-27, -15, -3, 9, 21)]
    flight = windows(np.concatenate([climb, *lines, climb[::-1]]), exposure=4.0)
    given = Knowledge(site="exact", background_std=0.05, model_std=0.1, learning_rate=0.8)
    known, source = presumed(site, (detector(),), knowledge=given, height_std_m=1e-3), jnp.array([6.0, -12.2, 1.0])
    shares, off = [], []
    for seed in range(6):
        counts = drawn_of_one(site, detector(), flight, source, 6e6, seed)
        problem = problem_of(known, counts, ((0, flight.counts.shape[0], 0, 1),))
        theta, weight, _ = weighed(problem, _state(problem, source), (x, y), 22.0, 61)
        places = theta[:, :2]
        mean, covariance = weight @ places, np.cov(places.T, aweights=weight)
        likeliest = _state(problem, jnp.asarray([*places[np.argmax(weight)], 1.0], jnp.float32))
        found = jax.tree.map(lambda v: v[0], _sampled_as_in_a_mission(problem, likeliest).posterior)
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        shares.append(np.sqrt(np.linalg.eigvalsh(root @ np.asarray(found.covariance)[:2, :2] @ root.T)))
        off.append(root @ (np.asarray(found.mean)[:2] - mean))
    # standard deviations over those of the integral, in the direction in which it is narrowest: 0.58 about the mean of
    # all that was flown
    assert np.mean(shares, axis=0)[0] > 0.7
    assert np.mean(shares, axis=0)[1] < 1.3
    assert np.sqrt(np.mean(np.square(off))) < 0.6


def test_without_any_measurement_the_moments_are_finite():
    problem, state = told([], 0)
    m = problem.measurements
    nothing = replace(problem, measurements=replace(m, valid=jnp.zeros_like(m.valid)))
    found = _sample(nothing, state)
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(found))


@pytest.mark.slow
def test_a_straight_way_does_not_tell_its_sides_apart():
    """A rover drives past a source on level ground: both sides of its way are as likely."""
    site = place([])
    along = np.arange(-20.0, 20.0)
    drive = windows(np.stack([along, 0.2 * along, np.full(40, 0.6)], axis=-1))
    source = np.array([1.0, 4.0, 1.0])
    certain = Knowledge(site="exact", background_std=0.05, model_std=0.01, learning_rate=1.0)
    known = presumed(site, (detector(),), knowledge=certain, height_std_m=1e-3)
    problem = problem_of(known, drawn_of_one(site, detector(), drive, source, ACTIVITY, 0), ((0, 40, 0, 1),))
    state = _state(problem, jnp.asarray(source, jnp.float32))
    normal = np.array([-0.2, 1.0]) / np.hypot(0.2, 1.0)
    side = float(source[:2] @ normal)
    other = mirrored_place(problem, jnp.asarray(source, jnp.float32), jnp.sum(state.added.counts[0], axis=1))
    np.testing.assert_allclose(other, [*(source[:2] - 2.0 * side * normal), 1.0], atol=0.05)
    found = _sample(problem, state)
    assert abs(float(np.asarray(found.mean)[:2] @ normal)) < 0.5 * side  # a quarter and three quarters at most
    across = float(normal @ np.asarray(found.covariance)[:2, :2] @ normal)
    assert np.sqrt(across) == pytest.approx(side, rel=0.15)
    assert float(found.effective) > 16.0


def test_a_source_is_sampled_with_the_walls_as_its_own_fit_has_them(monkeypatch):
    """The fit of another one in the open, which came last, knows nothing of the walls about it.

    Nor has its likelihood the prior of walls that are not what they were taken for: a tenth of what was presumed costs
    ten nats, which are no reason against a fit that explains the counts.
    """

    def lengths_of(_, state, k, *__):
        told = Posterior(
            mean=jnp.zeros(4).at[0].set(state.unknowns.lengths[0]), covariance=jnp.eye(4), effective=jnp.ones(()),
            halves=jnp.zeros(()), likeliest=state.sources.place[k],
        )  # fmt: skip
        return told, jnp.zeros(())

    monkeypatch.setattr(posterior_module, "_posterior", lengths_of)
    monkeypatch.setattr(posterior_module, "_moved", lambda _, state, *__: (state, jnp.array(False)))
    behind, flight = jnp.array([-8.0, -6.0, 1.0]), survey(altitude=12.0, count=231)

    def block(half):
        return place([((-8.0, -6.0, 1.0), (half, half, half), "concrete")])

    both = [(np.array(behind), 2e9, "Co-60"), (np.array(AT), ACTIVITY, "Co-60")]

    @jax.jit
    def one_after_another(known, m):
        problem = problem_of(known, m, SPANS)
        state = no_sources(problem, 2, 1)

        def fitted(state, k):
            at = jnp.stack([behind, AT])[k]
            tried = attempt(problem, CO_60, without(state, k).added, state.unknowns, at)
            return with_source(problem, state, k, tried), None

        # one of them, the other, and both again
        last = jax.lax.scan(fitted, state, jnp.array([0, 1, 0, 1]))[0]
        own = _as_fitted(problem, last, jnp.int32(0))
        ways = ways_from(problem, behind)

        def more(state):
            """How many times as much its activity adds through the walls as it is taken to add."""
            through = rates(problem, ways, CO_60, state.unknowns.lengths, slopes=False).counts
            return jnp.sum(state.sources.activity_bq[0] * through) / jnp.sum(state.added.counts[0])

        asked = posteriors(problem, last, 1, 1).posterior.mean[:, 0]
        return last, own, jnp.stack([more(last), more(own)]), asked

    for share, of_presumed in ((0.5, 0.5), (0.9, 0.1)):
        m = drawn(flight, mean_rois(block(0.5 * of_presumed), (detector(),), flight, both), 1)
        knowledge = Knowledge(site="geometry", thickness_share=share)
        known = presumed(block(0.5), (detector(),), knowledge=knowledge)
        last, own, more, asked = one_after_another(known, m)
        assert float(asked[0]) == pytest.approx(float(own.unknowns.lengths[0]), abs=1e-3)
        assert abs(float(asked[1] - asked[0])) > 0.3
        assert more[0] < 0.5
        assert float(more[1]) == pytest.approx(1.0, abs=0.03)
        unlikely = np.sum(np.square(own.unknowns.lengths / problem_of(known, m, SPANS).material_std)) / 2.0
        assert float(own.likelihood) + unlikely > float(last.likelihood) - BETTER
        np.testing.assert_array_equal(own.sources.place, last.sources.place)
    assert float(own.likelihood) < float(last.likelihood) - BETTER


def test_how_much_a_source_is_missed_does_not_depend_on_which_one_was_fitted_last():
    """The likelihood of a state holds the priors of that one's walls and height."""
    problem, state = told([], 3)
    missed = jax.jit(ratios)
    last, other = (float(missed(problem, replace(state, likelihood=state.likelihood - x))[0]) for x in (0.0, 50.0))
    assert last == other
    assert last > 1000.0
