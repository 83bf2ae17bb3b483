"""Adaptive importance sampling against closed forms: normal distributions, needles, rings and several modes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal, norm

from swarmsim.estimation.importance_sampling import sample_posterior
from swarmsim.estimation.mixture import Normals, Rounds, Weighed, log_weights_of, with_round, worth_of


def weighed(place, log_posterior, log_activity=0.0, variance=0.0):
    """A place [3] of a posterior as wide as a metre."""
    return Weighed(
        place=place, log_activity=jnp.asarray(log_activity), variance=jnp.asarray(variance),
        log_posterior=log_posterior, information=jnp.eye(3),
    )  # fmt: skip


@jax.jit
def _of_two_normals(mean, covariance, site, start, guess, off_std):
    """Moments where places that are off are normal, and so are what walls tell of where they are on the site."""
    inverse, wall = jnp.linalg.inv(covariance), jnp.linalg.inv(site)

    def weigh(x, off):
        from_mean, from_walls = x - mean, x - off - mean
        told = from_mean @ inverse @ from_mean + from_walls @ wall @ from_walls
        return replace(weighed(x, -0.5 * told), information=inverse + wall)

    return sample_posterior(weigh, start, guess, 24, 24, off_std_m=off_std)


@pytest.mark.parametrize("walls_m", [1e4, 0.1, 0.02])
def test_what_all_places_are_off_by_is_told_by_walls_alone(walls_m):
    """A place known to 3 cm by distances, on a site registered to 5 cm: the sum of both where walls tell nothing."""
    mean, off_std = np.array([20.0, -30.0, 1.0]), 0.05
    covariance, site = np.diag(np.square([0.03, 0.02, 0.05])), walls_m**2 * np.eye(3)
    f32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    start = mean + np.array([0.03, 0.0, 0.05])
    found = _of_two_normals(*map(f32, (mean, covariance, site, start, covariance, off_std)))
    # place p = x - off with x ~ N(0, C) and off ~ N(0, s^2) before walls tell p ~ N(0, W)
    expected = np.linalg.inv(np.linalg.inv(covariance + off_std**2 * np.eye(3)) + np.linalg.inv(site))
    std = np.sqrt(np.diag(expected))
    assert np.all(np.abs(np.asarray(found.mean)[:3] - mean) < 0.35 * std)
    # of 40 independent places a standard deviation is known to 11 %
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)[:3]), std, rtol=0.3)
    assert float(found.effective) >= 40.0


@jax.jit
def _of_a_normal(mean, covariance, slope, variance, start, guess):
    """Moments where the posterior of the place is normal, and the activity's logarithm linear in the place."""
    inverse = jnp.linalg.inv(covariance)

    def weigh(x, _):
        offset = x - mean
        return Weighed(
            place=x, log_activity=slope @ offset, variance=variance, log_posterior=-0.5 * offset @ inverse @ offset,
            information=inverse,
        )  # fmt: skip

    return sample_posterior(weigh, start, guess, 6, 64)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**31), wrong=st.floats(0.5, 2.0))
def test_a_normal_posterior_has_its_mean_and_covariance(seed, wrong):
    rng = np.random.default_rng(seed)
    root = np.diag(10.0 ** rng.uniform(-1.0, 1.0, 3)) @ (np.eye(3) + 0.4 * np.tril(rng.normal(size=(3, 3)), -1))
    covariance, mean, slope = root @ root.T, rng.uniform(-50.0, 50.0, 3), rng.normal(size=3)
    start = mean + root @ rng.uniform(-0.7, 0.7, 3)
    f32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    found = _of_a_normal(f32(mean), f32(covariance), f32(slope), f32(0.09), f32(start), f32(wrong**2 * covariance))
    std = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(np.asarray(found.mean)[:3] - mean) < 0.15 * std)
    relative = np.asarray(found.covariance)[:3, :3] / np.outer(std, std)
    np.testing.assert_allclose(relative, covariance / np.outer(std, std), atol=0.25)
    spread = float(slope @ covariance @ slope) + 0.09
    np.testing.assert_allclose(found.covariance[3, 3], spread, rtol=0.3)
    assert abs(float(found.mean[3])) < 0.15 * np.sqrt(spread)
    assert float(found.effective) > 64.0
    assert float(found.halves) < 0.4


def test_rounds_close_in_on_what_is_much_narrower_than_promised():
    """As behind walls, where the curvature promises a posterior that is five times as wide: in seven rounds of 24."""
    mean, std = np.array([1.0, 2.0, 0.5]), np.array([0.25, 0.35, 0.2])
    zero = jnp.zeros(())

    def weigh(place, _):
        off = (place - mean) / std
        value = -0.5 * jnp.sum(jnp.square(off))
        return Weighed(place=place, log_activity=zero, variance=zero, log_posterior=value, information=promised)

    start, guess = jnp.array([1.3, 1.7, 0.6]), jnp.diag(jnp.square(jnp.array([2.0, 1.6, 0.8])))
    promised = jnp.linalg.inv(guess)
    found = jax.jit(lambda: sample_posterior(weigh, start, guess, 7, 24))()
    assert float(found.effective) >= 40.0
    np.testing.assert_allclose(found.mean[:3], mean, atol=0.2 * std.max())
    np.testing.assert_allclose(np.sqrt(np.diagonal(found.covariance)[:3]), std, rtol=0.15)


@jax.jit
@jax.vmap
def _of_a_ring(start, pivot, radius, width):
    """Moments where all places at a distance from the pivot are likely, of a source about 1 m high."""
    height = 1.0 / 0.4**2

    def weigh(x, _):
        offset = x - pivot
        far = jnp.linalg.norm(offset)
        value = -0.5 * jnp.square((far - radius) / width) - 0.5 * height * jnp.square(x[2] - 1.0)
        along = offset / far
        information = jnp.outer(along, along) / jnp.square(width) + jnp.diag(jnp.array([1e-4, 1e-4, height]))
        return replace(weighed(x, value), information=information)

    promised = jnp.linalg.inv(weigh(start, None).information)
    return sample_posterior(weigh, start, promised, 16, 24, None, pivot)


def test_a_ring_is_sampled_all_around():
    """As of a source that is some metres from where a vehicle climbed: known to centimetres, and in no direction."""
    rng = np.random.default_rng(0)
    pivot = np.append(rng.uniform(-50.0, 50.0, (24, 2)).T, [np.full(24, 0.7)], axis=0).T
    radius, turn = np.exp(rng.uniform(0.0, np.log(5.0), 24)), rng.uniform(0.0, 2.0 * np.pi, 24)
    start = pivot + np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(24, 0.1)], axis=1)
    width = radius * rng.uniform(0.03, 0.1, 24)
    found = _of_a_ring(*(jnp.asarray(x, jnp.float32) for x in (start, pivot, radius, width)))
    off = np.linalg.norm(np.asarray(found.mean)[:, :2] - pivot[:, :2], axis=1) / radius
    std = np.sqrt(np.trace(np.asarray(found.covariance)[:, :2, :2], axis1=1, axis2=2)) / radius
    assert np.all(off < 0.5), off
    assert np.median(off) < 0.2
    assert np.all(np.abs(std - 1.0) < 0.2), std


def test_two_halves_that_disagree_are_told():
    """All of the posterior in a hair's breadth far from the start: the few places that come near it settle nothing."""

    def weigh(x, _):
        far = -0.5 * jnp.sum(jnp.square((x - 2.5) / 0.02))
        return weighed(x, far, x[0], jnp.float32(0.01))

    found = jax.jit(lambda: sample_posterior(weigh, jnp.zeros(3), jnp.eye(3), 1, 64))()
    assert float(found.effective) < 16.0


def two_modes(turn):
    """A posterior [] of places with one mode at the origin, and less of another one six metres from it."""
    other = 6.0 * jnp.stack([jnp.cos(turn), jnp.sin(turn), 0.0 * turn])

    def weigh(x, _):
        modes = jnp.stack([-0.5 * jnp.sum(x * x) + jnp.log(0.7), -0.5 * jnp.sum(jnp.square(x - other)) + jnp.log(0.3)])
        return weighed(x, jax.scipy.special.logsumexp(modes))

    return weigh


@pytest.mark.slow
def test_what_places_are_worth_does_not_depend_on_how_many_there_might_be():
    """Sampling ends when there are enough, in five rounds or so."""
    found = [
        jax.jit(lambda rounds=rounds: sample_posterior(two_modes(0.3), jnp.zeros(3), jnp.eye(3), rounds, 24))()
        for rounds in (12, 60)
    ]
    for one, other in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4)


def test_a_few_places_that_outweigh_all_others_are_not_worth_many():
    """Two of 120 that have been drawn, of 960 that there is room for."""
    weight = np.full(120, 0.1 / 118)
    weight[:2] = 0.45
    value = np.full((40, 24), -np.inf)
    value[:5] = np.log(weight).reshape(5, 24)
    zero = jnp.zeros((40, 24))
    eye = jnp.broadcast_to(jnp.eye(3), (40, 24, 3, 3))
    known = replace(weighed(jnp.zeros((40, 24, 3)), jnp.float32(value), zero, zero), information=eye)
    off = jnp.zeros((40, 24, 3))
    drawn_from = Normals(centres=known.place, inverse=eye, off=off, off_std=off + 1.0, slope=0.0 * eye)
    done = Rounds(known=known, off=off, drawn_from=drawn_from, mixture=zero, count=jnp.int32(5))
    assert float(worth_of(done)) < 5.0


@jax.jit
@jax.vmap
def _of_two_places(turn):
    """A posterior that only the two of the first places farthest to either side of a line reach."""
    across = jnp.stack([jnp.cos(turn), jnp.sin(turn), 0.0 * turn])

    def weigh(x, _):
        far = jnp.abs(x @ across) > 25.0
        return weighed(x, jnp.where(far, 0.0, -jnp.inf))

    return sample_posterior(weigh, jnp.zeros(3), jnp.diag(jnp.array([100.0, 100.0, 0.01])), 8, 8)


def test_a_needle_at_the_start_is_not_missed():
    """As of a source between walls: known to a centimetre, in a region that is promised to be metres wide."""

    def weigh(x, _):
        needle = 1e3 - 0.5 * jnp.sum(jnp.square(x / 0.01))
        return weighed(x, jnp.logaddexp(needle, -0.5 * jnp.sum(jnp.square((x - 2.0) / 0.3))))

    found = jax.jit(lambda: sample_posterior(weigh, jnp.zeros(3), 4.0 * jnp.eye(3), 24, 24))()
    assert float(jnp.max(jnp.abs(found.mean[:3]))) < 0.01
    np.testing.assert_allclose(jnp.sqrt(jnp.diagonal(found.covariance)[:3]), 0.01, rtol=0.25)
    assert float(found.effective) >= 40.0


def test_places_far_apart_that_span_no_volume_do_not_end_sampling():
    found = _of_two_places(jnp.linspace(0.0, np.pi, 64))
    assert bool(jnp.all(jnp.isfinite(found.mean)))
    assert bool(jnp.all(jnp.isfinite(found.covariance)))
    assert float(jnp.min(found.effective)) > 2.0


ROOM_M = jnp.array([3.0, 1.0, 0.5])


@jax.jit
@jax.vmap
def _of_a_place_and_a_room(share, centre, modes):
    """Moments of a place known to 0.3 m, at the origin, or anywhere in a room about ``centre`` by ``share``."""
    volume = jnp.log(8.0 * jnp.prod(ROOM_M))

    def weigh(x, _):
        there = jnp.where(jnp.all(jnp.abs(x - centre) < ROOM_M), jnp.log(share) - volume, -jnp.inf)
        here = jnp.log(1.0 - share) - 0.5 * jnp.sum(jnp.square(x / 0.3)) - 3.0 * jnp.log(0.3 * jnp.sqrt(2.0 * jnp.pi))
        return weighed(x, jnp.logaddexp(here, there))

    return sample_posterior(weigh, jnp.zeros(3), 0.09 * jnp.eye(3), 40, 24, modes)


@pytest.mark.slow
def test_of_modes_that_are_given_each_has_its_share_of_the_posterior():
    """A source is where the search found it or in a building ten metres off: no place drawn about the one is there."""
    rng = np.random.default_rng(3)
    share, far = rng.uniform(0.15, 0.85, 48), rng.uniform(6.0, 15.0, (48, 3)) * rng.choice([-1.0, 1.0], (48, 3))
    centre = np.array([1.0, 1.0, 0.0]) * far
    inside = rng.random((48, 96, 1)) < 0.5 * (0.5 + share[:, None, None])  # as by a screen that is off
    room = centre[:, None] + rng.uniform(-1.0, 1.0, (48, 96, 3)) * np.asarray(ROOM_M)
    modes = np.where(inside, room, rng.normal(0.0, 0.3, (48, 96, 3)))
    found = _of_a_place_and_a_room(*map(jnp.float32, (share, centre, modes)))
    told = np.sum(np.asarray(found.mean)[:, :2] * centre[:, :2], axis=1) / np.sum(centre[:, :2] ** 2, axis=1)
    assert np.std(told - share) < 0.08
    assert abs(np.mean(told - share)) < 0.05
    assert np.max(np.abs(told - share)) < 0.25


@pytest.mark.parametrize("none", [-np.inf, np.nan])
def test_a_posterior_of_which_no_place_was_found_is_worth_nothing(none):
    """It is sought about the start all the time, and no place counts as one of the posterior."""
    start = jnp.array([50.0, 60.0, 1.0])

    def weigh(x, _):
        return weighed(x, jnp.float32(none), x[0], jnp.float32(0.01))

    found = jax.jit(lambda: sample_posterior(weigh, start, jnp.eye(3), 6, 40))()
    assert float(found.effective) == 0.0
    np.testing.assert_allclose(found.mean[:3], start, atol=0.5)


def test_a_place_without_weight_may_have_any_values():
    def weigh(x, _):
        there = x[0] > 0.3
        return Weighed(
            place=x, log_activity=jnp.where(there, x[0], jnp.nan), variance=jnp.where(there, 0.01, jnp.inf),
            log_posterior=jnp.where(there, -0.5 * jnp.sum(x * x), -jnp.inf),
            information=jnp.where(there, 1.0, jnp.nan) * jnp.eye(3),
        )  # fmt: skip

    found = jax.jit(lambda: sample_posterior(weigh, jnp.zeros(3), jnp.eye(3), 6, 40))()
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(found))
    assert float(found.mean[0]) == pytest.approx(1.0, abs=0.15)  # of the half of a normal beyond 0.3: 0.998


def test_places_are_weighted_with_all_distributions_that_were_drawn_from():
    rng = np.random.default_rng(0)
    rounds, per_round, drawn = 6, 16, 4
    none = jnp.zeros((rounds, per_round))
    eye = jnp.broadcast_to(jnp.eye(3), (rounds, per_round, 3, 3))
    empty = replace(weighed(jnp.zeros((rounds, per_round, 3)), none - jnp.inf, none, none), information=eye)
    zero = empty.place
    nothing = Normals(centres=zero, inverse=eye, off=zero, off_std=zero + 1.0, slope=0.0 * eye)
    done = Rounds(known=empty, off=zero, drawn_from=nothing, mixture=none - jnp.inf, count=jnp.int32(0))
    places, centres, roots, offs, off_means, off_stds, slopes = [], [], [], [], [], [], []
    for _ in range(drawn):
        # far from the origin of the site, and from one round to the next
        centres.append((rng.normal(size=(per_round, 3)) * 2.0 + [3000.0, -2000.0, 1.0]).astype(np.float32))
        lower = np.tril(rng.normal(size=(per_round, 3, 3)) * 0.1) + np.diag([0.7, 1.0, 0.5])
        roots.append((rng.choice([0.6, 1.2, 2.5], (per_round, 1, 1)) * lower).astype(np.float32))
        places.append((centres[-1] + rng.normal(size=(per_round, 3))).astype(np.float32))
        new = replace(weighed(jnp.asarray(places[-1]), none[0] + 1.0, none[0], none[0]), information=eye[0])
        offs, off_means = ([*x, rng.normal(size=(per_round, 3)).astype(np.float32)] for x in (offs, off_means))
        off_stds.append(rng.uniform(0.2, 1.0, (per_round, 3)).astype(np.float32))
        slopes.append(rng.normal(size=(per_round, 3, 3)).astype(np.float32))
        inverse = np.linalg.inv(roots[-1])
        from_ = [jnp.asarray(x) for x in (centres[-1], inverse, off_means[-1], off_stds[-1], slopes[-1])]
        from_ = dict(zip(("centres", "inverse", "off", "off_std", "slope"), from_, strict=True))
        done = with_round(done, new, jnp.asarray(offs[-1]), Normals(**from_))
    at, off = np.concatenate(places).astype(np.float64), np.concatenate(offs)
    density = np.zeros(len(at))
    every = [np.concatenate(x).astype(np.float64) for x in (centres, roots, off_means, off_stds, slopes)]
    for c, root, mean, std, slope in zip(*every, strict=True):
        about = norm(mean + (at - c) @ slope.T, std)
        density += multivariate_normal(c, root @ root.T).pdf(at) * about.pdf(off).prod(axis=1)
    weights = np.asarray(log_weights_of(done))
    found, expected = weights[:drawn].reshape(-1), 1.0 + norm.logpdf(off).sum(axis=1) - np.log(density)
    np.testing.assert_allclose(found - found[0], expected - expected[0], atol=2e-3)
    assert np.all(weights[drawn:] == -np.inf)


def test_modes_are_taken_in_turn():
    """Of 96 modes ten metres apart each has had a place beside it once eleven rounds are done."""
    modes = 10.0 * np.stack(np.meshgrid(np.arange(12), np.arange(8), [1]), axis=-1).reshape(-1, 3)
    drawn = []

    def weigh(x, _):
        jax.debug.callback(lambda place: drawn.append(np.asarray(place)), x)
        return weighed(x, -0.5 * jnp.sum(jnp.square(x / 1e-4)))  # never enough: all rounds are done

    jax.block_until_ready(
        jax.jit(lambda: sample_posterior(weigh, jnp.zeros(3), jnp.eye(3), 11, 24, jnp.asarray(modes, jnp.float32)))()
    )
    jax.effects_barrier()
    assert len(drawn) == 11 * 24
    apart = np.linalg.norm(np.array(drawn) - modes[:, None], axis=-1)
    assert apart.min(axis=1).max() < 1.0
