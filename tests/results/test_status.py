"""What an answer is worth: each status from the diagnostics that lead to it."""

import re
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from swarmsim.results.record import Estimate, GammaConstant, RadiationMap, Samples
from swarmsim.results.saturation import saturated
from swarmsim.results.status import CERTAIN, MORE, Fit, assess, coverage, source_of_spectrum, survey_doubts

GOOD = Fit(misfit=0.3, chi_squared=1.01)
SIDE_M, HEIGHT_M = 60.0, 20.0


def chart(hotspots=((0.0, 0.0),), rate=400.0) -> RadiationMap:
    cells = np.full((31, 31), 94.0)
    for x, y in hotspots:
        cells[round((y + 30.0) / 2.0), round((x + 30.0) / 2.0)] = rate
    return RadiationMap(np.array([-30.0, -30.0]), 2.0, cells, cells + 1.0, np.array(hotspots, float).reshape(-1, 2))


def survey(rate: float = 120.0, share: float = 1.0) -> Samples:
    """Samples on lines 10 m apart over the first ``share`` of the area."""
    y = np.arange(-30.0, 31.0, 10.0)
    x = np.linspace(-30.0, -30.0 + share * SIDE_M, 60)
    place = np.array([(a, b, HEIGHT_M) for b in y for a in x])
    n = len(place)
    return Samples(
        vehicle=np.zeros(n, np.int32), phase=np.full(n, "survey"), time_s=np.arange(n) * 1.0, position_m=place,
        counts=np.full(n, rate), exposure_s=np.ones(n), count_rate_cps=np.full(n, rate),
    )  # fmt: skip


def estimate(x: float = 0.0, std: float = 0.5, activity: float = 170.0, nuclide: str = "Co-60") -> Estimate:
    covariance = np.diag([std**2, std**2, 0.25])
    return Estimate(np.array([x, 0.0, 1.0]), covariance, activity, 0.05 * activity, 1.0, nuclide)


def verdict(
    samples=None, hotspots=((0.0, 0.0),), found=True, fit=GOOD, aerial=None, final=None, highest=184e3, rate=400.0,
    at_1_m=MappingProxyType({}), presumed=(100.0, 10.0), identified=MappingProxyType({}),
    suggested="", spectrum_of=0, noticed=MappingProxyType({}), heights=(),
):  # fmt: skip
    samples = survey() if samples is None else samples
    n = len(samples.counts)
    beyond = saturated(samples.vehicle, samples.counts, samples.exposure_s, np.full(n, highest), np.full(n, 94.0))
    return assess(
        replace(samples, saturated=beyond), chart(hotspots, rate), np.zeros(n), fit,
        (aerial or (estimate(1.0),)) if found else (), (final or (estimate(),)) if found else (), 0.3,
        (presumed[0], float(np.log(presumed[1]))), at_1_m, identified, suggested,
        spectrum_of, noticed, heights=heights,
    )  # fmt: skip


def test_the_survey_is_compared_with_all_sources_beside_one_another() -> None:
    """What it took for one source of 340 MBq are two of 170; one of 170 alone contradicts it."""
    survey_of_both = (estimate(2.0, std=1.0, activity=340.0),)
    assert verdict(aerial=survey_of_both, final=(estimate(), estimate(4.0))).status == "located"
    alone = verdict(aerial=survey_of_both, final=(estimate(),))
    assert alone.status == "inconsistent"
    assert "by the survey and by all counts differs 2 times" in " ".join(alone.reasons)
    # and so are those of the survey that it told apart
    final = (estimate(), estimate(11.0, activity=60.0))
    assert (
        verdict(aerial=(estimate(0.5, activity=165.0), estimate(10.5, activity=62.0)), final=final).status == "located"
    )
    # either may have two apart that the other takes for beside one another
    wide, near = (estimate(), estimate(12.4)), (estimate(), estimate(11.0))
    assert verdict(aerial=near, final=wide).status == verdict(aerial=wide, final=near).status == "located"
    # a contradiction of the two is told once
    moved = verdict(aerial=(estimate(9.0, std=1.0), estimate(19.0, std=1.0)), final=(estimate(), estimate(10.0)))
    apart = (
        "the survey alone had the Co-60 source 9 m from where all counts have it (it may have taken several for one)"
    )
    assert moved.reasons == (apart,)
    # one farther off is another source
    assert verdict(aerial=survey_of_both, final=(estimate(), estimate(30.0))).status == "inconsistent"


def test_different_nuclides_are_compared_by_what_they_add() -> None:
    """250 GBq of a nuclide of few photons are fainter than 100 MBq of one of many."""
    at_1_m = {"Co-60": GammaConstant(0.35, 0.30), "Pu-239": GammaConstant(1e-6, 1e-6)}
    pair = (estimate(activity=222.0), estimate(7.8, activity=1.5e5, nuclide="Pu-239"))
    said = " ".join(verdict(final=pair, at_1_m=at_1_m, presumed=(222.0, 10.0)).reasons)
    assert "the Pu-239 source of 150 GBq 7.8 m beside one of a higher dose rate" in said
    assert "the Co-60 source" not in said
    # of two that add as much neither is faint
    even = {"Co-60": GammaConstant(0.35, 0.30), "Am-241": GammaConstant(0.003, 0.0025)}
    pair = (estimate(activity=5.0), estimate(20.0, activity=600.0, nuclide="Am-241"))
    assert verdict(final=pair, at_1_m=even, aerial=(estimate(1.0, activity=5.0),)).status == "located"


def test_a_spectrum_of_another_nuclide_contradicts_the_surest_source() -> None:
    assert verdict(suggested="Co-60").status == "located"
    other = verdict(suggested="Cs-137")
    assert (other.status, other.reasons) == ("ambiguous", ("the spectrum taken near the Co-60 source is of Cs-137",))
    stranger = verdict(suggested="unknown")
    assert stranger.reasons == ("the spectrum taken near the Co-60 source is of none in the library",)
    both = (estimate(), estimate(40.0, nuclide="Cs-137"))
    assert verdict(final=both, suggested="Cs-137").status == "ambiguous"
    # by all counts the source that was the surest to the survey need not be that any more
    at_the_second = verdict(final=both, suggested="Cs-137", spectrum_of=1)
    assert not any("the spectrum" in reason for reason in at_the_second.reasons)
    wrong = verdict(final=both, suggested="Co-60", spectrum_of=1)
    assert "the spectrum taken near the Cs-137 source is of Co-60" in wrong.reasons
    assert verdict(found=False, hotspots=(), suggested="Cs-137").status == "none"


def test_a_spectrum_is_of_the_source_that_it_was_taken_near() -> None:
    sources = (estimate(0.0), estimate(40.0), estimate(45.0))
    assert source_of_spectrum(estimate(1.0), sources, 12.0) == 0
    assert source_of_spectrum(estimate(41.0), sources, 12.0) == 1
    assert source_of_spectrum(estimate(20.0), sources, 12.0) is None
    assert source_of_spectrum(estimate(1.0), (), 12.0) is None
    assert source_of_spectrum(None, sources, 12.0) is None


def test_two_nuclides_in_one_place_are_believed_where_the_spectrum_shows_both() -> None:
    pair = (estimate(), estimate(0.4, activity=200.0, nuclide="Cs-137"))
    doubtful = verdict(final=pair)
    assert doubtful.status == "ambiguous"
    assert doubtful.reasons == ("the Co-60 and Cs-137 sources 0.4 m apart may be one of another nuclide",)
    assert verdict(final=pair, identified={"Co-60": 0.99, "Cs-137": 0.95}).status == "located"
    assert verdict(final=pair, identified={"Co-60": 0.99, "Cs-137": 0.05}).status == "ambiguous"
    # the spectrum is of the surest source
    third = replace(estimate(), position_m=np.array([0.0, 40.0, 1.0]))
    assert verdict(final=(third, *pair), identified={"Co-60": 0.99, "Cs-137": 0.95}).status == "ambiguous"
    assert verdict(final=(estimate(), estimate(4.0, activity=200.0, nuclide="Cs-137"))).status == "located"


def test_a_good_answer_has_no_reasons() -> None:
    assert verdict().status == "located"
    assert verdict().reasons == ()
    assert verdict(found=False).status == "none"
    assert {"located", "none"} <= set(CERTAIN)


@pytest.mark.parametrize(
    ("given", "status", "said"),
    [
        ({"samples": survey(share=0.3), "found": False}, "incomplete_survey", r"only \d\d% of the survey area"),
        ({"samples": survey(rate=150e3)}, "saturated", "dead time"),
        ({"samples": survey(rate=2.0)}, "saturated", "dead time"),
        ({"fit": Fit(misfit=20.0, chi_squared=1.6)}, "inconsistent", "chi-squared 1.60"),
        ({"fit": Fit(misfit=np.nan, chi_squared=np.nan)}, "inconsistent", "contradict the sources"),
        ({"fit": replace(GOOD, strain=600.0)}, "inconsistent", "the rates depart from those of the sources"),
        ({"fit": replace(GOOD, strain=np.nan)}, "inconsistent", "the rates depart from those of the sources"),
        ({"aerial": (estimate(12.0, std=1.0),)}, "inconsistent", "12 m from where all counts"),
        ({"final": (estimate(activity=19e6),)}, "inconsistent", "times"),
        ({"final": (replace(estimate(), converged=False),)}, "ambiguous", "could not be searched"),
        ({"final": (estimate(), replace(estimate(25.0), converged=False))}, "ambiguous", "could not be searched"),
        ({"final": (estimate(std=14.0),)}, "detected", "known to 14 m"),
        ({"final": (estimate(), estimate(20.0, std=14.0, nuclide="Cs-137"))}, "detected", "Cs-137 source is known to"),
        ({"hotspots": ((0.0, 0.0), (-28.0, 0.0))}, "ambiguous", "further sources"),
        (
            {"final": (estimate(), estimate(6.0, activity=20.0))},
            "ambiguous",
            "20 MBq 6 m beside one of a higher dose rate",
        ),
        (
            {"final": (estimate(), estimate(0.3, activity=95.0))},
            "ambiguous",
            "95 MBq 0.3 m beside one of a higher dose rate",
        ),
        (
            {"final": (estimate(), replace(estimate(15.0, activity=95.0), detection=80.0))},
            "ambiguous",
            "95 MBq 15 m beside one of a higher dose rate",
        ),
        (
            {"final": (replace(estimate(), joined_m=2.4), estimate(8.0, activity=90.0))},
            "ambiguous",
            "8 m beside one of a higher",
        ),
        (
            {"final": (estimate(), replace(estimate(8.0, activity=90.0, nuclide="I-131"), joined_m=2.4))},
            "ambiguous",
            "8 m beside one of a higher",
        ),
        ({"final": (estimate(activity=85.0), estimate(0.3, activity=85.0))}, "ambiguous", "0.3 m beside another one"),
        (
            {"final": (estimate(), estimate(9.0, activity=0.02, nuclide="I-131"))},
            "ambiguous",
            "of 0.02 MBq is 5,000 times weaker",
        ),
        (
            {"final": (estimate(), estimate(20.0, activity=0.9, nuclide="I-131"))},
            "ambiguous",
            "0.9 MBq 20 m beside one of a higher dose rate may be an error of the model",
        ),
        (
            {"final": (estimate(), estimate(9.0, activity=2e6, nuclide="I-131"))},
            "ambiguous",
            r"stronger than presumed \(knowledge.activity_mbq\)",
        ),
    ],
)
def test_each_doubt_has_its_status_and_sentence(given, status: str, said: str) -> None:
    found = verdict(**given)
    assert found.status == status
    assert found.status not in CERTAIN
    assert any(re.search(said, reason) for reason in found.reasons)


def test_a_weak_source_far_from_others_of_its_nuclide_is_believed() -> None:
    weak = replace(estimate(15.0, activity=95.0), detection=80.0)
    assert verdict(final=(estimate(), replace(weak, nuclide="Cs-137"))).status == "located"
    assert verdict(final=(estimate(), replace(weak, detection=300.0))).status == "located"
    assert verdict(final=(estimate(), replace(weak, position_m=np.array([27.0, 0.0, 1.0])))).status == "located"
    assert verdict(fit=replace(GOOD, strain=300.0)).status == "located"


def test_where_not_even_what_is_presumed_would_have_been_noticed_none_is_not_certain() -> None:
    limits = {"Co-60": 140.0, "Pu-239": 3e4}
    assert verdict(found=False, hotspots=(), noticed=limits, presumed=(150.0, 10.0)).status == "none"
    blind = verdict(found=False, hotspots=(), noticed=limits, presumed=(100.0, 10.0))
    assert blind.status == "incomplete_survey"
    assert blind.reasons == ("one as presumed, of 100 MBq (knowledge.activity_mbq), would have gone unnoticed",)
    assert verdict(found=False, hotspots=(), noticed={"Co-60": np.inf}).status == "incomplete_survey"
    assert verdict(noticed=limits).status == "located"


def test_a_nuclide_that_neither_counts_nor_a_spectrum_are_sure_of_is_doubtful() -> None:
    """Behind half a metre of soil that nobody presumed, Co-60 was told as Zn-65 with 31 %."""
    unsure = replace(estimate(), nuclide_confidence=0.31)
    told = verdict(final=(unsure,))
    assert told.status == "ambiguous"
    assert told.reasons == ("the Co-60 source may be of another nuclide (31.0% by the counts)",)
    assert verdict(final=(unsure,), suggested="Co-60").status == "located"
    # the spectrum is that of the first
    assert verdict(final=(estimate(), replace(unsure, position_m=np.array([40.0, 0, 1])))).status == "ambiguous"
    assert verdict(final=(replace(unsure, nuclide_confidence=0.95),)).status == "located"


def test_a_source_far_from_the_height_presumed_is_doubtful() -> None:
    """One buried 0.6 m was told 6 m off, at a height 3.8 standard deviations from what was presumed."""
    told = verdict(heights=(-3.8,))
    assert told.status == "ambiguous"
    assert told.reasons[0].startswith("the height of the Co-60 source is 3.8 standard deviations from what is presumed")
    assert verdict(heights=(2.4,)).status == "located"


def test_counts_of_a_nuclide_that_is_not_in_question_are_told() -> None:
    none = {"found": False, "hotspots": ()}
    assert verdict(**none, fit=replace(GOOD, unsought=0.9)).status == "none"
    told = verdict(**none, fit=replace(GOOD, unsought=1.1))
    assert told.status == "inconsistent"
    assert told.reasons == ("the counts show a source of a nuclide that is not in question (knowledge.nuclides)",)
    # what the model does not know of a strong source looks like others beside it
    assert verdict(fit=replace(GOOD, unsought=9.0)).status == "located"


def test_a_further_source_that_explains_more_than_chance_allows_is_suspected() -> None:
    """Of 26 such missions of a random family 21 had one that was not found; places of the others were right."""
    told = verdict(fit=replace(GOOD, suspected=1.1, suspect="K-40 near (10, -3)"))
    assert told.status == "ambiguous"
    assert "a further source is suspected, perhaps of K-40 near (10, -3)" in told.reasons[0]
    assert verdict(fit=replace(GOOD, suspected=0.9)).status == "located"
    # a first one that explains too little is below what is asked of it
    none = {"found": False, "hotspots": ()}
    assert verdict(**none, fit=replace(GOOD, suspected=0.9)).status == "none"


def test_a_search_that_is_full_may_have_missed_others() -> None:
    """Of 20 missions with five or six sources nine were located with four, three of those at wrong places."""
    four = tuple(estimate(30.0 * k) for k in range(4))
    assert verdict(final=four).status == "located"
    told = verdict(final=four, fit=replace(GOOD, full=True))
    assert (told.status, told.reasons) == ("ambiguous", (MORE,))
    # one alone that is sought is presumed to be the only one, unless the counts say otherwise
    assert verdict(fit=replace(GOOD, full=True, unsought=0.8)).status == "located"
    assert verdict(fit=replace(GOOD, full=True, unsought=1.2)).status == "ambiguous"


def test_several_nuclides_that_the_spectrum_shows_do_not_contradict_it() -> None:
    pair = (estimate(), estimate(8.0, nuclide="Cs-137"))
    both = {"Co-60": 1.0, "Cs-137": 1.0}
    assert verdict(final=pair, suggested="Cs-137").status == "ambiguous"
    assert verdict(final=pair, suggested="Cs-137", identified=both).status == "located"
    # another nuclide than that of any source found, or of one too far off for the spectrum, still does
    assert verdict(suggested="Cs-137", identified=both).status == "ambiguous"
    far = (estimate(), estimate(40.0, nuclide="Cs-137"))
    assert verdict(final=far, suggested="Cs-137", identified=both).status == "ambiguous"
    # nor is one of them an error of the model
    several = (replace(estimate(), joined_m=2.0), estimate(8.0, nuclide="Cs-137", activity=90.0))
    assert verdict(final=several).status == "ambiguous"
    assert verdict(final=several, identified=both).status == "located"


def test_sources_whose_nuclide_is_not_known_are_compared_whatever_they_are_called() -> None:
    """A Geiger tube's survey had for Ba-133 what all counts had for Co-60; another Ba-133 was 123 m off."""
    before = (replace(estimate(1.0, nuclide="Ba-133"), nuclide_confidence=0.1),)
    final = tuple(replace(one, nuclide_confidence=0.1) for one in (estimate(), estimate(100.0, nuclide="Ba-133")))
    assert not any("from where all counts" in reason for reason in verdict(aerial=before, final=final).reasons)
    sure = tuple(replace(one, nuclide_confidence=1.0) for one in final)
    told = verdict(aerial=(replace(before[0], nuclide_confidence=1.0),), final=sure)
    assert "99 m from where all counts" in " ".join(told.reasons)


@pytest.mark.parametrize("height_m", [8.0, 10.0, 11.9, 12.0, 15.9, 20.0])
def test_lines_twice_their_height_apart_cover_the_ground(height_m: float) -> None:
    y = np.arange(-30.0, 31.0, 2.0 * height_m)
    place = np.array([(x, at, height_m) for at in y for x in np.arange(-30.0, 30.5, 0.5)])
    samples = Samples(*(np.zeros(len(place)),) * 3, place, *(np.ones(len(place)),) * 3)
    area = np.array([(-30.0, -30.0), (30.0, -30.0), (30.0, y[-1]), (-30.0, y[-1])])
    assert coverage(samples, chart(), np.zeros(len(place)), [area]) == 1.0
    assert coverage(samples, chart(), np.full(len(place), 0.2 * height_m), [area]) < (1.0 if height_m > 10.0 else 1.1)


def test_where_a_counter_was_saturated_no_error_of_a_place_is_told() -> None:
    far = (estimate(std=35.0),)
    assert verdict(final=far).status == "detected"
    told = verdict(final=far, fit=replace(GOOD, load=2.0))
    assert told.status == "saturated"
    assert not any("known to" in reason for reason in told.reasons)


def test_a_counter_is_saturated_short_of_its_highest_rate() -> None:
    assert verdict(samples=survey(rate=0.7 * 184e3)).status == "located"
    assert verdict(samples=survey(rate=0.8 * 184e3)).status == "saturated"


def test_a_counter_that_was_paralysed_by_what_was_found_is_saturated() -> None:
    """It may have shown ordinary rates all the time: the case is of 10^5 MBq, which none of its rates told."""
    assert verdict(fit=replace(GOOD, load=0.9)).status == "located"
    assert verdict(fit=replace(GOOD, load=1.1)).status == "saturated"
    assert verdict(fit=replace(GOOD, load=1.1, misfit=300.0, chi_squared=7.0)).status == "saturated"


def test_a_survey_that_stated_a_place_too_well_is_told() -> None:
    final = (estimate(0.0, std=0.05), estimate(60.0, nuclide="Cs-137"))
    (told,) = survey_doubts((estimate(1.8, std=0.3), estimate(61.0, std=0.5, nuclide="Cs-137")), final)
    assert told == (
        "the survey by itself had the Co-60 source 1.8 m from where all counts have it, "
        "6 standard deviations as stated: its place was stated too well"
    )
    assert survey_doubts((estimate(1.4, std=0.3),), final) == ()
    assert survey_doubts((estimate(12.0, std=1.0),), final) == ()  # the answer is `inconsistent` by that
    assert survey_doubts((estimate(1.8, std=0.3, nuclide="F-18"),), final) == ()
    assert survey_doubts((estimate(1.8, std=0.3), estimate(5.0)), final) == ()  # beside one another
    assert survey_doubts((), final) == ()


def test_a_source_that_the_survey_did_not_show_is_compared_with_none() -> None:
    assert verdict(aerial=(estimate(30.0, std=0.5, nuclide="Cs-137"),)).status == "located"


@pytest.mark.parametrize(
    "other",
    [
        {"x": 4.0, "activity": 90.0},
        {"x": 3.2, "nuclide": "I-131"},
        {"x": 15.0, "activity": 20.0},
        {"x": 6.0, "activity": 90.0},
        {"x": 6.0, "activity": 20.0, "nuclide": "I-131"},
    ],
)
def test_companions_that_walls_do_not_explain_are_no_doubt(other) -> None:
    assert verdict(final=(estimate(), estimate(**other))).status == "located"


def test_a_hotspot_that_a_further_source_explains_is_no_doubt() -> None:
    two = (estimate(), estimate(-27.0, nuclide="Cs-137"))
    assert verdict(final=two, hotspots=((0.0, 0.0), (-28.0, 0.0))).status == "located"


def test_a_faint_hotspot_may_be_of_the_background() -> None:
    far = ((0.0, 0.0), (-28.0, 0.0))
    assert verdict(hotspots=far, rate=94.0 * 1.8).status == "located"
    assert verdict(hotspots=far, rate=94.0 * 2.0).status == "ambiguous"


def test_the_gravest_doubt_decides_and_all_are_told() -> None:
    both = verdict(fit=Fit(misfit=90.0, chi_squared=9.0), hotspots=((0.0, 0.0), (-28.0, 0.0)))
    assert both.status == "inconsistent"
    assert len(both.reasons) == 2


def test_coverage_is_the_share_of_the_area_near_a_measurement() -> None:
    assert coverage(survey(), chart(), np.zeros(7 * 60)) == 1.0
    half = coverage(survey(share=0.25), chart(), np.zeros(7 * 60))
    assert half == pytest.approx(0.25 + HEIGHT_M / SIDE_M, abs=0.06)
    on_ground = replace(survey(), position_m=survey().position_m * [1, 1, 0])
    assert coverage(on_ground, chart(), np.zeros(7 * 60)) > 0.95
    assert coverage(survey().rows(slice(0, 0)), chart(), np.zeros(0)) == 0.0


def test_coverage_is_that_of_the_area_alone() -> None:
    """A survey of a triangle was said to have measured two thirds of it: the rest of the map is not asked for."""
    half = 0.5 * SIDE_M
    west = np.array([[-half, -half], [0.0, -half], [-half, half]])
    east = np.array([[half, -half], [half, half], [half - 20.0, half]])
    quarter, ground = survey(share=0.25), np.zeros(7 * 60)
    assert coverage(quarter, chart(), ground, (west,)) == 1.0
    assert coverage(quarter, chart(), ground, (east,)) == 0.0
    assert 0.5 < coverage(quarter, chart(), ground, (west, east)) < 0.8
