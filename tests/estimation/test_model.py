"""The model of counts by region of interest and its fit at one place, against closed forms and the simulated truth."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from swarmsim.config.mission import Knowledge
from swarmsim.estimation.fit import settle, without_more
from swarmsim.estimation.forward import dead_time, lengthened, rates, ways_from, with_one_ray
from swarmsim.estimation.localise import problem_of
from swarmsim.estimation.nodes import inverse_square_gain, nodes_of, spans_of
from swarmsim.estimation.scan import open_counts, open_totals, scan
from swarmsim.estimation.state import no_sources
from swarmsim.radiation import observed_rate
from tests.estimation.survey import (
    NUCLIDES,
    counted,
    library,
    mean_rois,
    place,
    presumed,
    spectrometer,
    survey,
    windows,
)

WALL = [((4.0, 0.0, 2.0), (0.15, 8.0, 2.0), "concrete")]
DETECTORS = (spectrometer(),)
FLIGHT = survey(altitude=12.0, count=120, half=40.0, lines=8)
SPANS = ((0, 120, 0, 1),)
BACKGROUND = 1.1


def told(site, sources, knowledge=None, background=BACKGROUND, flight=FLIGHT):
    """What is presumed, and the noiseless counts of a survey."""
    m = counted(flight, mean_rois(site, DETECTORS, flight, sources, background))
    return presumed(site, DETECTORS, half=40.0, knowledge=knowledge), m


@pytest.mark.slow
def test_a_source_decays_while_it_is_sought():
    """F-18 of a survey of half an hour was told 13 % too weak, and metres off."""
    half_life_s = 40.0
    site, at = place(half=40.0), jnp.array([3.0, -5.0, 1.0])
    known = presumed(site, DETECTORS, half=40.0)
    decaying = tuple(replace(d, decay_1_s=jnp.full(len(NUCLIDES), np.log(2.0) / half_life_s)) for d in known.detectors)
    m = counted(FLIGHT, mean_rois(site, DETECTORS, FLIGHT))

    def added(detectors):
        problem = problem_of(replace(known, detectors=detectors), m, SPANS)
        n = len(NUCLIDES)
        points = jnp.broadcast_to(at, (n, 3))
        return (
            rates(problem, ways_from(problem, at), jnp.int32(1), jnp.zeros_like(problem.material_std)).counts,
            open_counts(problem, at, jnp.int32(1)),
            open_totals(problem, points, jnp.arange(n))[1],
        )

    left = 0.5 ** ((np.asarray(FLIGHT.time_s) - 0.5) / half_life_s)
    lasting = tuple(replace(d, decay_1_s=jnp.zeros(len(NUCLIDES))) for d in known.detectors)
    for now, before in zip(added(decaying), added(lasting), strict=True):
        share = left if now.ndim == 1 else left[:, None]
        np.testing.assert_allclose(now, share * before, rtol=1e-4, atol=1e-12)
    nuclides = library().nuclides
    assert library().decay_1_s == pytest.approx([np.log(2.0) / nuclide.half_life_s for nuclide in nuclides])


@pytest.mark.parametrize("site", ["terrain", "none"])
def test_walls_that_are_not_known_are_an_error_of_all_windows(site):
    """Of eight sources told with errors of each window by itself four were outside of their 95 % regions."""
    known = told(place(WALL, half=40.0), [], Knowledge(site="geometry"))[0]
    blind = told(place(WALL, half=40.0), [], Knowledge(site=site))[0]
    assert float(blind.common_std) > 0.5 > 2.0 * float(known.common_std)
    assert float(blind.learning_rate) < 0.5 * float(known.learning_rate)


@jax.jit
def _settled(known, m, at, nuclide):
    problem = problem_of(known, m, SPANS)
    nothing = no_sources(problem, 1, len(NUCLIDES))
    others, unknowns = nothing.added, nothing.unknowns
    alone = without_more(problem, others, unknowns, 4)[1]
    return settle(problem, ways_from(problem, at), nuclide, others, unknowns, 4, 3, fresh=True), alone


@pytest.mark.parametrize("boxes", [[], WALL], ids=["open", "wall"])
@pytest.mark.parametrize("name", ["Co-60", "Cs-137", "Ba-133"])
def test_expected_counts_at_the_true_place_give_the_truth(boxes, name):
    rng = np.random.default_rng(len(boxes) + NUCLIDES.index(name))
    site = place(boxes, half=40.0)
    for _ in range(3):
        at, activity = np.append(rng.uniform(-25.0, 25.0, 2), 1.0), 10.0 ** rng.uniform(8.5, 9.2)
        known, m = told(site, [(at, activity, name)], Knowledge(site="geometry"))
        fit = _settled(known, m, jnp.asarray(at, jnp.float32), jnp.int32(NUCLIDES.index(name)))[0]
        u = fit.unknowns
        np.testing.assert_allclose(u.activity_bq, activity, rtol=0.01)
        np.testing.assert_allclose(u.lengths, 0.0, atol=0.02)
        np.testing.assert_allclose(jnp.exp(u.level), BACKGROUND, rtol=0.003)
        np.testing.assert_allclose(u.background, 0.0, atol=0.02)
        np.testing.assert_allclose(u.gain, 0.0, atol=0.02)
        assert abs(float(fit.likelihood)) < 0.5


def test_the_prior_of_the_activity_is_in_the_value_and_not_in_the_likelihood():
    at, activity = jnp.array([5.0, 3.0, 1.0]), 500e6
    fits = []
    for presumed_mbq in (100.0, 1e5):
        knowledge = Knowledge(site="exact", activity_mbq=presumed_mbq, activity_factor=3.0)
        known, m = told(place(half=40.0), [(at, activity, "Cs-137")], knowledge)
        fits.append(_settled(known, m, at, jnp.int32(NUCLIDES.index("Cs-137")))[0])
    assert abs(float(fits[0].likelihood - fits[1].likelihood)) < 1e-3
    excess = np.log(activity / np.array([100e6, 1e11])) / np.log(3.0)
    np.testing.assert_allclose(fits[0].value - fits[1].value, 0.5 * (excess[1] ** 2 - excess[0] ** 2), rtol=0.01)


def test_a_window_that_lacks_half_its_counts_costs_a_few_nats_and_moves_nothing():
    """Student's tails: a post that no ray met takes counts from one window."""
    at, k = jnp.array([5.0, 3.0, 1.0]), jnp.int32(NUCLIDES.index("Cs-137"))
    known, m = told(place(half=40.0), [(at, 2e9, "Cs-137")], Knowledge(site="exact"))
    nearest = int(jnp.argmin(jnp.linalg.norm(m.position_m - at, axis=1)))
    fits = [_settled(known, x, at, k)[0] for x in (m, replace(m, rois=m.rois.at[nearest].multiply(0.6)))]
    assert 4.0 < float(fits[0].likelihood - fits[1].likelihood) < 15.0
    np.testing.assert_allclose(fits[1].unknowns.activity_bq, fits[0].unknowns.activity_bq, rtol=0.005)
    assert float(fits[1].unknowns.gain[nearest]) == pytest.approx(np.log(0.6), abs=0.1)


def test_a_wrong_nuclide_at_the_true_place_explains_the_counts_less():
    known, m = told(place(half=40.0), [((5.0, 3.0, 1.0), 500e6, "Cs-137")])
    values = [
        float(_settled(known, m, jnp.array([5.0, 3.0, 1.0]), jnp.int32(k))[0].value) for k in range(len(NUCLIDES))
    ]
    assert np.argmax(values) == NUCLIDES.index("Cs-137")
    assert np.sort(values)[-1] - np.sort(values)[-2] > 10.0


@jax.jit
def _scanned(known, m, point):
    problem = problem_of(known, m, SPANS)
    nothing = no_sources(problem, 1, len(NUCLIDES))
    u, _ = without_more(problem, nothing.added, nothing.unknowns, 4)
    return [scan(problem, point[None], jnp.arange(len(NUCLIDES)) == k, nothing.added, u) for k in range(len(NUCLIDES))]


def cone(at):
    """Windows at several heights above a place, all seen at the angle for which the scan has its rates."""
    turn, up = np.linspace(0.0, 6.0 * np.pi, 120), np.tile(np.geomspace(3.0, 50.0, 12), 10)
    return windows(np.asarray(at) + np.stack([up * np.cos(turn), up * np.sin(turn), up], axis=-1))


@pytest.mark.parametrize("name", ["Co-60", "Cs-137", "I-131"])
@pytest.mark.parametrize(("flight", "tolerance"), [(cone, 0.02), (lambda at: FLIGHT, 0.06)], ids=["angle", "survey"])
def test_the_score_of_a_weak_source_is_the_likelihood_ratio_and_a_squared_information(name, flight, tolerance):
    """s^2 / I = A^2 I where s = A I; noiseless counts of a source far below the background.

    The scan knows the rates at one angle to the crystal's axis, which is what the larger tolerance of a survey is for,
    and what the ground scatters at four distances, linear between them.
    """
    k = NUCLIDES.index(name)
    rng = np.random.default_rng(k)
    site = place(half=40.0)
    for _ in range(3):
        at = np.append(rng.uniform(-20.0, 20.0, 2), 1.0)
        m = flight(at)
        share = mean_rois(site, DETECTORS, m, [(at, 1e6, name)]) / mean_rois(site, DETECTORS, m)
        activity = 0.03 * 1e6 / float(jnp.max(share) - 1.0)
        known, m = told(site, [(at, activity, name)], flight=m)
        found = _scanned(known, m, jnp.asarray(at, jnp.float32))[k]
        fit, alone = _settled(known, m, jnp.asarray(at, jnp.float32), jnp.int32(k))
        ratio = 2.0 * float(fit.likelihood - alone)
        information = float(found.statistic[0]) / float(found.activity_bq[0]) ** 2
        assert int(found.nuclide[0]) == k
        np.testing.assert_allclose(found.activity_bq[0], activity, rtol=tolerance)
        np.testing.assert_allclose(activity**2 * information, ratio, rtol=2.0 * tolerance)
        np.testing.assert_allclose(found.statistic[0], ratio, rtol=0.015)


def test_without_a_source_the_score_is_nothing_anywhere():
    known, m = told(place(half=40.0), [])
    for k, found in enumerate(_scanned(known, m, jnp.array([3.0, -8.0, 1.0]))):
        assert int(found.nuclide[0]) == k
        assert abs(float(found.statistic[0])) < 0.01


@jax.jit
def _rates(known, m, at, nuclide, lengths):
    problem = problem_of(known, m, SPANS)
    return rates(problem, ways_from(problem, at), nuclide, lengths)


@pytest.mark.parametrize("name", ["Co-60", "Ba-133"])
def test_rates_at_other_lengths_are_extrapolated_within_their_error(name):
    """A wall of 30 cm presumed, 10 % thinner and thicker; and slopes are the derivatives by ln(length)."""
    known, m = told(place(WALL, half=40.0), [], Knowledge(site="geometry"))
    at, k, zero = jnp.array([12.0, 1.0, 1.0]), jnp.int32(NUCLIDES.index(name)), jnp.zeros(len(known.uncertain))
    assert [known.site.material_names[i] for i in known.uncertain] == ["concrete"]
    presumed_ = _rates(known, m, at, k, zero)
    for change in (-0.1, 0.1):
        exact = _rates(known, m, at, k, zero + change)
        near = lengthened(presumed_, zero + change)
        shadowed = np.asarray(jnp.sum(exact.counts, axis=1) < 0.97 * jnp.sum(presumed_.counts, axis=1)).any()
        assert shadowed == (change > 0.0)
        off = np.abs(np.log(np.sum(near.counts, axis=1) / np.sum(exact.counts, axis=1)))
        assert np.quantile(off, 0.95) < 0.03
        assert off.max() < 0.1
        back = lengthened(near, -zero - change).counts
        np.testing.assert_allclose(back, presumed_.counts, rtol=0.05, atol=0.01 * float(presumed_.counts.max()))
    step = 0.01
    by = (_rates(known, m, at, k, zero + step).counts - _rates(known, m, at, k, zero - step).counts) / (2.0 * step)
    total, exact_slope = np.asarray(presumed_.slopes[:, 0].sum(axis=1)), np.asarray(by.sum(axis=1))
    # slopes leave out how the mixture of wall and air changes what is scattered, which a few grazing rays notice
    assert np.quantile(np.abs(total - exact_slope), 0.95) < 0.05 * np.abs(exact_slope).max()


def test_nodes_lie_along_the_way_and_never_below_the_ground():
    site = place(half=40.0)
    flight = windows([[0.0, 0.0, 12.0], [5.0, 0.0, 1.0]])
    flight = replace(flight, travel_m=jnp.array([[4.0, 2.0, 0.0], [0.0, 0.0, 10.0]]))
    nodes = nodes_of(site, flight, [(0, 2, 0, 3)])
    np.testing.assert_allclose(nodes.position_m[:3], [[-2.0, -1.0, 12.0], [0.0, 0.0, 12.0], [2.0, 1.0, 12.0]])
    np.testing.assert_allclose(nodes.position_m[3:, 2], [0.2, 1.0, 6.0], atol=1e-6)


def test_nodes_follow_a_way_round_a_corner():
    site = place(half=40.0)
    # from (0, 0) to (6, 0) and on to (6, 8), for as long: the mean place is that of both legs' middles
    turn = replace(
        windows([[4.5, 2.0, 12.0]]), travel_m=jnp.array([[6.0, 8.0, 0.0]]), chord_m=jnp.array([[-1.5, 2.0, 0.0]])
    )
    nodes = nodes_of(site, turn, [(0, 1, 0, 3)])
    np.testing.assert_allclose(nodes.position_m, [[0.0, 0.0, 12.0], [6.0, 0.0, 12.0], [6.0, 8.0, 12.0]], atol=1e-5)
    np.testing.assert_allclose(nodes.pieces_m[1], [[-3.0, 0.0, 0.0], [0.0, 4.0, 0.0]], atol=1e-5)
    # a vehicle that stands at the end of its way: no place lies beyond it
    stood = replace(turn, travel_m=jnp.array([[8.0, 0.0, 0.0]]), chord_m=jnp.array([[-4.0, 0.0, 0.0]]))
    np.testing.assert_allclose(nodes_of(site, stood, [(0, 1, 0, 3)]).position_m[:, 0], [-3.5, 4.5, 4.5], atol=1e-5)


@pytest.mark.parametrize("rays", [1, 2, 3, 5])
@given(st.lists(st.floats(-6.0, 6.0), min_size=9, max_size=9), st.floats(0.5, 3.0))
def test_gain_of_the_nodes_is_the_mean_of_inverse_square_over_a_bent_way(rays, numbers, above):
    begin, corner, end = np.array(numbers).reshape(3, 3) * [1.0, 1.0, 0.0] + [0.0, 0.0, 10.0 + above]
    source = np.array([0.0, 0.0, 10.0])
    mean, chord = 0.25 * begin + 0.5 * corner + 0.25 * end, 0.5 * (begin + end)
    assume(np.linalg.norm(corner - chord) <= 0.5 * np.linalg.norm(end - begin))
    way = replace(
        windows([mean]), travel_m=jnp.array([end - begin], jnp.float32), chord_m=jnp.array([chord - mean], jnp.float32)
    )
    nodes = nodes_of(place(half=40.0), way, [(0, 1, 0, rays)])
    offset = nodes.position_m - jnp.asarray(source, jnp.float32)
    found = jnp.sum(inverse_square_gain(offset, nodes) / jnp.sum(offset**2, axis=1))
    share = ((np.arange(4000) + 0.5) / 4000)[:, None]
    fine = np.where(share < 0.5, begin + 2 * share * (corner - begin), corner + (2 * share - 1) * (end - corner))
    expected = np.mean(1.0 / np.sum((fine - source) ** 2, axis=1))
    assert float(found) == pytest.approx(expected, rel=3e-3)


def test_one_ray_is_led_to_the_middle_of_a_window():
    known, m = told(place(half=40.0), [])
    m = replace(m, travel_m=jnp.tile(jnp.array([3.0, 0.0, 0.0]), (120, 1)))
    problem = problem_of(known, m, ((0, 120, 0, 3),))
    one = with_one_ray(problem)
    np.testing.assert_array_equal(one.nodes.position_m, m.position_m)
    at, zero = jnp.array([3.0, -2.0, 1.0]), jnp.zeros(len(known.uncertain))
    several, single = (rates(p, ways_from(p, at), jnp.int32(0), zero).counts.sum(axis=1) for p in (problem, one))
    np.testing.assert_allclose(several, single, rtol=0.01)


@given(st.lists(st.floats(0.0, 3e5), min_size=4, max_size=4), st.floats(0.0, 1e-5), st.floats(0.0, 1e-5))
def test_dead_time_is_that_of_the_detector(rates, paralyzable, non_paralyzable):
    d = replace(DETECTORS[0], paralyzable_s=jnp.float32(paralyzable), non_paralyzable_s=jnp.float32(non_paralyzable))
    known, m = told(place(half=40.0), [])
    exposure = jnp.where(jnp.arange(120) % 2 == 0, 0.5, 3.0)
    problem = problem_of(replace(known, detectors=(d,)), replace(m, exposure_s=exposure), SPANS)
    rate = jnp.resize(jnp.asarray(rates, jnp.float32), 120)
    share, slope = dead_time(problem, rate * exposure)
    np.testing.assert_allclose(share * rate, observed_rate(d, rate - d.background_cps), rtol=1e-4, atol=1e-3)
    exact = jax.vmap(jax.grad(lambda n, t: share_of(d, n / t)))(rate * exposure, exposure)
    np.testing.assert_allclose(slope, exact, rtol=1e-3, atol=1e-12)


def share_of(d, rate):
    return jnp.exp(-rate * d.paralyzable_s) / (1.0 + rate * d.non_paralyzable_s)


def test_spans_join_neighbours_of_one_detector_and_as_many_rays():
    assert spans_of([(10, 0, 1), (5, 0, 1), (0, 1, 3), (7, 1, 3), (3, 0, 3), (2, 0, 1)]) == (
        (0, 15, 0, 1), (15, 22, 1, 3), (22, 25, 0, 3), (25, 27, 0, 1),
    )  # fmt: skip
    assert spans_of([]) == ()
