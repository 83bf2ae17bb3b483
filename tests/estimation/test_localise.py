"""Sources found in the counts by region of interest of a survey of open ground, and behind walls; their bound."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.mission import Knowledge
from swarmsim.estimation.detection_limit import noticed_from
from swarmsim.estimation.importance_sampling import Posterior
from swarmsim.estimation.localise import problem_of, sampled
from swarmsim.estimation.sources import find_sources, needed
from swarmsim.estimation.state import no_sources, settled, signals
from tests.estimation.conftest import AERIAL, BOTH, DETECTORS, SPANS
from tests.estimation.survey import ACTIVITY, NUCLIDES, SOURCE, counted, drawn, mean_rois, place, presumed

SITE = place()
DRAWS = 32
CERTAIN = Knowledge(site="exact", background_std=0.01, model_std=0.001)
CO_60 = [(SOURCE, ACTIVITY, "Co-60")]


def names(estimated):
    return [NUCLIDES[int(k)] for k in estimated.fits.nuclide]


def sigma(fits, k=0):
    return np.sqrt(np.diag(fits.covariance_m2[k]))


def deviations(fits, position, activity, k=0):
    """Errors of x, y and the activity over the stated standard deviations."""
    place_error = np.asarray(fits.position_m[k] - jnp.asarray(position))[:2] / sigma(fits, k)[:2]
    return np.append(place_error, float(fits.activity_bq[k] - activity) / float(fits.activity_std_bq[k]))


def test_one_source_in_the_open_is_found_and_its_errors_are_as_stated(localiser):
    rng = np.random.default_rng(4)
    found = []
    for seed in range(8):
        name = NUCLIDES[seed % 3]
        activity = {"Co-60": 170e6, "Cs-137": 400e6, "I-131": 450e6}[name] * rng.uniform(0.8, 1.5)
        position = np.append(rng.uniform(-50.0, 50.0, 2), rng.uniform(0.6, 1.4))
        estimated = localiser(drawn(AERIAL, mean_rois(SITE, DETECTORS, AERIAL, [(position, activity, name)]), seed))
        assert estimated.fits.present.tolist() == [True, False]
        assert names(estimated)[0] == name
        assert float(estimated.fits.nuclide_confidence[0]) > 0.9
        assert np.all(sigma(estimated.fits)[:2] < 5.0)
        found.append(deviations(estimated.fits, position, activity))
        assert np.all(np.abs(found[-1]) < 3.0)
        assert abs(float(estimated.misfit)) < 4.0
    assert 0.4 < np.sqrt(np.mean(np.square(found))) < 1.6


def test_expected_counts_give_the_truth_back(localiser):
    site = place(slope=(0.05, -0.1))
    flight = replace(
        AERIAL, position_m=AERIAL.position_m.at[:, 2].add(AERIAL.position_m[:, :2] @ jnp.array([0.05, -0.1]))
    )
    truth = jnp.array([12.0, 4.0, 12.0 * 0.05 - 4.0 * 0.1 + 1.0])
    m = counted(flight, mean_rois(site, DETECTORS, flight, [(truth, ACTIVITY, "Co-60")]))
    # counts without any deviation in them would make those that are presumed look as if they were less elsewhere
    estimated = localiser(m, presumed(site, DETECTORS, knowledge=CERTAIN))
    fits = estimated.fits
    assert np.all(np.abs(np.asarray(fits.position_m[0] - truth)) < 0.25 * sigma(fits))
    np.testing.assert_allclose(fits.activity_bq[0], ACTIVITY, rtol=0.01)
    np.testing.assert_allclose(estimated.background_scale, 1.0, rtol=0.003)
    assert bool(fits.converged[0])
    # expected counts lie closer to the model than drawn ones ever do
    assert float(estimated.misfit) < -10.0
    assert int(estimated.windows) == 300


def test_a_known_height_stays_fixed(localiser):
    none = jnp.float32(0.0)  # poses have no error, which would move the source with them
    fixed = replace(
        localiser.presumed, height_m=jnp.float32(0.5), height_std_m=none, pose_std_m=none, geometry_std_m=none
    )
    fits = localiser(counted(AERIAL, mean_rois(SITE, DETECTORS, AERIAL, CO_60)), fixed).fits
    np.testing.assert_allclose(fits.position_m[0, 2], 0.5, atol=0.01)
    assert float(fits.covariance_m2[0, 2, 2]) < 1e-5


@pytest.mark.slow
def test_a_source_is_found_from_a_place_in_a_building_alone(localiser):
    """All points of the grid are far off, as the best ones may be where walls hide a source to one side."""
    half = jnp.array([[7.0, 5.0, 2.5], [0.01, 0.01, 0.01]])
    centre = jnp.array([[12.0, 4.0, 2.5], [-85.0, -85.0, 0.0]])
    hollow = replace(SITE.obstacles, centre_m=centre, half_extent_m=half, wall_m=jnp.array([0.2, 0.0]))
    site = replace(SITE, obstacles=hollow)
    at = (14.5, 2.0, 1.0)
    m = drawn(AERIAL, mean_rois(site, DETECTORS, AERIAL, [(at, 500e6, "Co-60")]), 0)
    known = presumed(site, DETECTORS)
    assert known.places.there.any()
    elsewhere = np.array([-30.0, -30.0, 0.0]) + np.array([0.1, 0.1, 1.0]) * known.places.points_m

    @jax.jit
    def sought(places):  # sampling finds a source that the search left metres beside its place
        problem = problem_of(known, m, SPANS)
        nothing = no_sources(problem, localiser.params.search.sources_max, len(NUCLIDES))
        return find_sources(problem, places, jnp.asarray(known.nuclides), localiser.params.search, nothing).sources

    for rooms, found in ((known.places.there, True), (np.zeros_like(known.places.there), False)):
        sources = sought(replace(known.places, points_m=np.float32(elsewhere), there=rooms))
        off_m = np.linalg.norm(np.asarray(sources.place)[:, :2] - at[:2], axis=1)
        assert np.any(sources.present & (off_m < 3.0)) == found


@pytest.mark.parametrize("seed", range(8))
def test_no_source_is_found_in_a_background_with_a_step(localiser, seed):
    turn = 2.0 * np.pi * seed / 8.0
    across = AERIAL.position_m[:, :2] @ jnp.array([np.cos(turn), np.sin(turn)])
    background = jnp.where(across > 0.0, 1.2, 1.0)
    estimated = localiser(drawn(AERIAL, mean_rois(SITE, DETECTORS, AERIAL, background=background), seed))
    assert not np.any(estimated.fits.present)
    assert np.all(np.asarray(estimated.fits.detection) == 0.0)
    assert 0.95 < float(estimated.background_scale) < 1.25


@pytest.mark.parametrize(
    "activity", [1e11, pytest.param(1e12, marks=pytest.mark.slow), pytest.param(1e13, marks=pytest.mark.slow)]
)
def test_a_source_that_overloads_the_counter_is_one_source(localiser, activity):
    """The strongest paralyses it near the source: it counts less there than far off."""
    rng = np.random.default_rng(int(np.log10(activity)))
    for seed in range(3):
        position = np.append(rng.uniform(-45.0, 45.0, 2), 1.0)
        mean = mean_rois(SITE, DETECTORS, AERIAL, [(position, activity, "Co-60")])
        estimated = localiser(drawn(AERIAL, mean, seed))
        fits = estimated.fits
        assert fits.present.tolist() == [True, False]
        assert names(estimated)[0] == "Co-60"
        assert np.linalg.norm(np.asarray(fits.position_m[0])[:2] - position[:2]) < 0.5
        assert float(fits.activity_bq[0]) == pytest.approx(activity, rel=0.05)
        true = np.asarray(estimated.highest_cps)[0]
        assert true * float(DETECTORS[0].paralyzable_s) == pytest.approx(1.4 * activity / 1e12, rel=0.3)


@pytest.mark.parametrize("seed", range(3))
def test_two_sources_of_different_nuclides_are_both_found(localiser, seed):
    turn = 1.0 + 2.0 * seed
    along = 20.0 * np.array([np.cos(turn), np.sin(turn), 0.0])
    middle = np.array([5.0, -8.0, 1.0])
    truth = {"Co-60": (middle + along, 200e6), "Cs-137": (middle - along, 450e6)}
    mean = mean_rois(SITE, DETECTORS, AERIAL, [(p, a, name) for name, (p, a) in truth.items()])
    estimated = localiser(drawn(AERIAL, mean, seed))
    assert estimated.fits.present.tolist() == [True, True]
    assert sorted(names(estimated)) == sorted(truth)
    for k, name in enumerate(names(estimated)):
        assert np.all(np.abs(deviations(estimated.fits, *truth[name], k)) < 4.0)
        assert float(estimated.fits.detection[k]) > float(localiser.params.search.threshold)
    assert float(estimated.fits.detection[0]) >= float(estimated.fits.detection[1])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("apart", [4.0, 7.0])
def test_two_of_a_nuclide_beside_one_another_are_two(localiser, apart, seed):
    """A detector goes around both of them, 7 m from their middle."""
    turn = 0.4 + seed
    way, middle = 0.5 * apart * np.array([np.cos(turn), np.sin(turn), 0.0]), np.asarray(SOURCE)
    truth = [middle + way, middle - way]
    mean = mean_rois(SITE, DETECTORS, BOTH, [(one, 200e6, "Co-60") for one in truth])
    estimated = localiser(drawn(BOTH, mean, seed))
    fits = estimated.fits
    assert fits.present.tolist() == [True, True]
    assert fits.joined_m.tolist() == [0.0, 0.0]
    found = np.asarray(fits.position_m)[:, :2]
    assert all(min(np.linalg.norm(found - one[:2], axis=1)) < 0.5 for one in truth)
    np.testing.assert_allclose(np.sum(np.asarray(fits.activity_bq)), 400e6, rtol=0.1)
    assert float(estimated.misfit) < 4.0


def test_no_more_sources_are_found_than_there_is_room_for(localiser):
    truth = [
        ((-35.0, -30.0, 1.0), 300e6, "Co-60"),
        ((35.0, 0.0, 1.0), 700e6, "Cs-137"),
        ((-30.0, 40.0, 1.0), 700e6, "I-131"),
    ]
    estimated = localiser(drawn(AERIAL, mean_rois(SITE, DETECTORS, AERIAL, truth), 1))
    assert estimated.fits.present.tolist() == [True, True]
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(estimated.fits))
    # one cannot be told: the misfit says that something is missing
    assert float(estimated.misfit) > 5.0


@pytest.mark.slow
def test_an_earlier_state_leads_to_the_same_source_when_there_are_more_windows(localiser):
    m = drawn(AERIAL, mean_rois(SITE, DETECTORS, AERIAL, CO_60), 2)
    earlier = localiser(replace(m, valid=m.valid & (jnp.arange(360) < 220)))
    assert earlier.fits.present.tolist() == [True, False]
    on, anew = localiser(m, known=earlier.state), localiser(m)
    assert on.fits.present.tolist() == [True, False]
    assert names(on)[0] == "Co-60"
    assert np.all(np.abs(deviations(on.fits, SOURCE, ACTIVITY)) < 3.0)
    apart = np.asarray(on.fits.position_m[0] - anew.fits.position_m[0])
    assert np.all(np.abs(apart) < 0.5 * sigma(anew.fits))
    np.testing.assert_allclose(on.fits.activity_bq[0], anew.fits.activity_bq[0], rtol=0.05)
    assert float(on.fits.detection[0]) > float(earlier.fits.detection[0])


def test_a_source_behind_a_wall_is_found_where_it_is(localiser):
    wall = [((9.0, 4.0, 2.0), (0.3, 6.0, 2.0), "concrete"), ((12.0, 8.5, 1.5), (3.0, 0.3, 1.5), "concrete")]
    site = place(wall)
    mean = mean_rois(site, DETECTORS, BOTH, CO_60)
    draws, known = [drawn(BOTH, mean, seed) for seed in range(4)], presumed(site, DETECTORS)
    for m in draws:
        estimated = localiser(m, known)
        assert estimated.fits.present.tolist() == [True, False]
        assert np.linalg.norm((estimated.fits.position_m[0] - SOURCE)[:2]) < 0.5
        assert 0.7 < float(estimated.chi_squared) < 1.3
    # a model blind to the walls does not describe the counts: the walls are what is tested
    assert float(localiser(draws[3]).misfit) > 5.0


def test_ground_data_sharpen_the_aerial_estimate(localiser):
    m = counted(BOTH, mean_rois(SITE, DETECTORS, BOTH, CO_60))
    both, aerial = localiser(m).fits, localiser(replace(m, valid=AERIAL.valid)).fits
    assert float(both.covariance_m2[0, 0, 0]) < 0.05 * float(aerial.covariance_m2[0, 0, 0])
    np.testing.assert_allclose(both.position_m[0, :2], SOURCE[:2], atol=0.02)
    # little but the ground, which no source lies below, tells its height: the mean lies 0.2 m above the truth, and 128
    # places tell it within another 0.2 m
    np.testing.assert_allclose(both.position_m[0, 2], SOURCE[2], atol=0.5)
    np.testing.assert_allclose(both.activity_bq[0], ACTIVITY, rtol=0.01)


def test_padding_and_repetition_change_nothing(localiser):
    m = drawn(AERIAL, mean_rois(SITE, DETECTORS, AERIAL, CO_60), 5)
    m = replace(m, valid=m.valid & (jnp.arange(360) < 250))
    spoilt = replace(
        m,
        counts=m.counts.at[250:].set(jnp.nan),
        rois=m.rois.at[250:].set(jnp.nan),
        position_m=m.position_m.at[250:].set(jnp.nan),
        exposure_s=m.exposure_s.at[250:].set(1e9),
        detector=m.detector.at[250:].set(9),
    )
    one, again, other = (localiser(v) for v in (m, m, spoilt))
    for a, b, c in zip(*(jax.tree.leaves(v) for v in (one, again, other)), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


@pytest.mark.parametrize("case", ["no samples", "no counts", "outside"])
def test_useless_data_give_a_finite_answer_that_is_no_detection(localiser, case):
    far = replace(AERIAL, position_m=AERIAL.position_m + jnp.array([900.0, 0.0, 0.0]))
    background = mean_rois(SITE, DETECTORS, AERIAL)
    m = {
        "no samples": replace(counted(AERIAL, background), valid=jnp.zeros(360, bool)),
        "no counts": counted(AERIAL, jnp.zeros_like(background)),
        "outside": drawn(far, background, 1),
    }[case]
    fits = localiser(m).fits
    # beside none that was found no other one is thought of
    assert np.all(np.isposinf(fits.beside_bq))
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(replace(fits, beside_bq=fits.joined_m)))
    assert not np.any(fits.present)
    assert np.all(np.abs(np.asarray(fits.position_m)[:, :2]) <= 90.0)


@pytest.mark.slow
def test_a_source_that_the_others_explain_as_well_is_taken_away(localiser):
    """One of a thousandth that the search left 9 m beside the true one; of two true ones none."""
    beside, away = SOURCE + jnp.array([7.0, -6.0, 0.0]), SOURCE + jnp.array([-30.0, 5.0, 0.0])

    @jax.jit
    def asked(m, places, activity_bq):
        problem = problem_of(localiser.presumed, m, SPANS)
        state = no_sources(problem, 2, len(NUCLIDES))
        sources = replace(state.sources, place=places, activity_bq=activity_bq, present=jnp.ones(2, bool))
        state = replace(state, sources=sources, added=signals(problem, sources, state.unknowns.lengths))
        return needed(problem, localiser.params.search, settled(problem, state))

    for second, activity, stays in ((beside, 1e-3 * ACTIVITY, False), (away, ACTIVITY, True)):
        truth = [*CO_60, (second, activity, "Co-60")] if stays else CO_60
        m = drawn(AERIAL, mean_rois(SITE, DETECTORS, AERIAL, truth), 3)
        state, ratio = asked(m, jnp.stack([SOURCE, second]), jnp.array([ACTIVITY, activity], jnp.float32))
        assert state.sources.present.tolist() == [True, stays]
        assert float(ratio[0]) > 100.0
        assert (float(ratio[1]) > 100.0) == stays
        np.testing.assert_allclose(state.sources.activity_bq[0], ACTIVITY, rtol=0.1)


def test_a_posterior_that_is_no_number_is_the_place_found_with_the_reach_of_the_search(localiser):
    state = localiser.nothing
    sources = replace(
        state.sources, place=jnp.array([[3.0, -4.0, 1.0], [7.0, 8.0, 0.5]]), activity_bq=jnp.array([2e8, 1e8])
    )
    bad = jnp.full((4, 4), jnp.nan)
    posterior = Posterior(
        mean=jnp.array([[3.1, -4.1, 1.1, 19.0], [jnp.nan] * 4]),
        covariance=jnp.stack([0.01 * jnp.eye(4), bad]),
        effective=jnp.array([50.0, jnp.nan]),
        halves=jnp.array([0.1, jnp.nan]),
        likeliest=jnp.zeros((2, 3)),
    )
    converged, mean, covariance = sampled(localiser.presumed, localiser.params, sources, posterior)
    reach = float(localiser.params.search.reach_m)
    assert converged.tolist() == [True, False]
    np.testing.assert_allclose(mean[0], posterior.mean[0])
    np.testing.assert_allclose(covariance[0], 0.01 * np.eye(4))
    np.testing.assert_allclose(mean[1], [7.0, 8.0, 0.5, np.log(1e8)], rtol=1e-6)
    assert np.all(np.sqrt(np.diag(covariance[1])[:2]) >= reach)


def test_places_worth_too_few_have_no_small_error(localiser):
    few = Posterior(
        mean=jnp.zeros((2, 4)),
        covariance=jnp.broadcast_to(1e-4 * jnp.eye(4), (2, 4, 4)),
        effective=jnp.array([50.0, 3.0]),
        halves=jnp.array([2.0, 0.1]),
        likeliest=jnp.zeros((2, 3)),
    )
    converged, _, covariance = sampled(localiser.presumed, localiser.params, localiser.nothing.sources, few)
    assert converged.tolist() == [False, False]
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.all(std[:, :2] > 1.0)
    assert np.all(std[:, 3] > 0.3)  # what is elsewhere is of another activity


def means(theta):
    """Expected counts [n, R] of (x, y, height, ln activity, ln background)."""
    at, activity, background = theta[:3], np.exp(theta[3]), np.exp(theta[4])
    return np.asarray(mean_rois(SITE, DETECTORS, AERIAL, [(at, activity, "Co-60")], background), float)[:300]


def bound(height_std):
    """Least standard deviations [5], by central differences."""
    theta = np.append(np.asarray(SOURCE, float), [np.log(ACTIVITY), 0.0])
    steps = np.diag([0.5, 0.5, 0.5, 0.05, 0.05])
    slopes = np.stack([(means(theta + s) - means(theta - s)) / (2.0 * s.sum()) for s in steps])
    information = np.einsum("anr,bnr,nr->ab", slopes, slopes, 1.0 / np.maximum(means(theta), 1e-9))
    information[2, 2] += 1.0 / height_std**2
    return np.sqrt(np.diag(np.linalg.inv(information)))


@pytest.mark.slow
def test_estimates_reach_the_cramer_rao_bound_and_know_their_errors(localiser):
    """Where nothing but the source and the level of the background is unknown."""
    certain = replace(localiser.presumed, background_std=jnp.float32(0.01), model_std=jnp.float32(0.001))
    mean = mean_rois(SITE, DETECTORS, AERIAL, [(SOURCE, ACTIVITY, "Co-60")])
    fits = [localiser(drawn(AERIAL, mean, seed), certain).fits for seed in range(DRAWS)]
    assert all(f.present.tolist() == [True, False] for f in fits)
    error = np.stack([f.position_m[0] - SOURCE for f in fits])[:, :2]
    rmse, least = np.sqrt(np.mean(error**2, axis=0)), bound(0.5)
    assert np.all(rmse <= 1.3 * least[:2])
    assert np.all(rmse >= 0.8 * least[:2])  # nobody beats the bound: the errors would be wrong
    assert np.all(np.abs(error.mean(axis=0)) < 4.0 * least[:2] / np.sqrt(DRAWS))
    covariance = np.stack([f.covariance_m2[0, :2, :2] for f in fits])
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert 1.2 < normalised.mean() < 3.0  # two degrees of freedom
    logs = np.log([float(f.activity_bq[0]) / ACTIVITY for f in fits])
    assert np.std(logs) < 1.3 * least[3]
    assert np.mean([bool(f.converged[0]) for f in fits]) > 0.98


def test_another_source_that_no_source_is_as_strong_as_is_never_noticed():
    """A saturated detector tells next to nothing of more; what is told is 5 + 1.645 standard deviations (ISO 11929)."""
    told = jnp.array([1e-14, 1e-30, 0.0])
    np.testing.assert_allclose(noticed_from(told, jnp.float32(25.0)), [66.45e6, np.inf, np.inf], rtol=1e-4)
