"""The sentence of a mission's finding."""

from dataclasses import replace

import numpy as np
import pytest

from swarmsim.results.doubts import in_mbq
from swarmsim.results.finding import NO_WAY, NOTHING_FOUND, NOTHING_SOUGHT, finding
from swarmsim.results.record import Spectrum
from swarmsim.results.status import Verdict
from tests.results.test_status import estimate

SURE = Verdict(status="located", reasons=(), covered=1.0)
ONE = (estimate(),)


def spectrum(nuclide: str, goodness: float = 0.4) -> Spectrum:
    none = np.zeros(1)
    return Spectrum(
        energy_kev=none, counts=none, fit=none, background=none, live_time_s=1.0, nuclide=nuclide, confidence=0.97,
        scores={}, goodness=goodness,
    )  # fmt: skip


def test_nothing_sought_and_nothing_found():
    assert finding(None, (), None, hindrance=None, presumed=False) == NOTHING_SOUGHT
    assert finding(replace(SURE, status="none"), (), None, hindrance=None, presumed=False) == NOTHING_FOUND


def test_a_saturated_counter_s_answer_has_no_standard_deviations():
    verdict = replace(SURE, status="saturated", reasons=("a counter was driven into its dead time",))
    told = finding(verdict, (replace(ONE[0], errors_known=False),), None, None, True)
    assert told.startswith("saturated: a source of about ")
    assert "±" not in told
    assert "noticed" not in told
    assert "±" in finding(SURE, ONE, None, None, True)


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"Co-60": 12.3}, "over 95% of the survey area, one would have been noticed from 12 MBq Co-60 on)"),
        ({"Co-60": 12.3, "Am-241": 345.6, "Na-22": 9.87}, "noticed from 9.9 MBq Na-22 to 346 MBq Am-241 on)"),
        ({"Co-60": 12.3, "Pu-239": np.inf}, "noticed from 12 MBq Co-60 on, but none of Pu-239)"),
        ({"Co-60": np.inf}, "nor would one of any activity in free view have been noticed"),
    ],
)
def test_none_comes_with_what_would_have_been_noticed(limits, said):
    none = replace(SURE, status="none")
    told = finding(none, (), None, hindrance=None, presumed=True, noticed_mbq=limits)
    assert told.startswith(NOTHING_FOUND + " (")
    assert said in told
    doubtful = finding(replace(none, reasons=("only 40% was measured",)), (), None, None, True, 0, limits)
    assert said in doubtful
    assert doubtful.endswith("; but only 40% was measured")
    assert "would have been" not in finding(SURE, ONE, None, hindrance=None, presumed=True, noticed_mbq=limits)


def test_an_activity_that_is_less_than_its_error_is_not_told_as_nothing():
    faint = replace(ONE[0], activity_mbq=0.21, activity_std_mbq=32.0)
    assert "a source of 0.21 ± 32 MBq Co-60" in finding(SURE, (faint,), None, None, True)


@pytest.mark.parametrize(("presumed", "said"), [(True, "nuclide presumed"), (False, "nuclide by the counts")])
def test_it_says_where_the_nuclide_is_from(presumed, said):
    assert f"; {said}, no spectrum" in finding(SURE, ONE, None, hindrance=None, presumed=presumed)
    lost = "no spectrum was taken near it (orpheus: collided with another vehicle)"
    assert f"; {said}, {lost}" in finding(SURE, ONE, None, hindrance=lost, presumed=presumed)
    assert "orpheus" not in finding(SURE, ONE, spectrum("Co-60"), hindrance=lost, presumed=presumed)
    assert f"; {said}, no drivable way" in finding(SURE, ONE, None, hindrance=NO_WAY, presumed=presumed)
    assert f"; {said}, the spectrum suggests Zn-65 with 97%" in finding(SURE, ONE, spectrum("Zn-65"), None, presumed)
    assert f"; {said}, the spectrum shows none" in finding(SURE, ONE, spectrum("none"), None, presumed)
    assert f"; {said}, the spectrum is of none in the library" in finding(
        SURE, ONE, spectrum("unknown"), None, presumed
    )


def test_a_spectrum_that_names_it_says_how_well():
    named = ONE[0].nuclide
    assert finding(SURE, ONE, spectrum(named), None, False).endswith("; identified with 97.0%")
    assert "fits the spectrum badly (p = 1e-05)" in finding(SURE, ONE, spectrum(named, 1e-5), None, False)


def test_it_says_what_the_spectrum_shows_besides():
    also = replace(spectrum("Co-60"), scores={"Co-60": 0.97, "I-131": 0.95, "Cs-137": 0.5, "Na-22": 0.99})
    pair = (*ONE, estimate(30.0, nuclide="Na-22"))
    said = ", but the spectrum fits better with I-131 as well: a weak source, or walls other than presumed"
    assert said in finding(SURE, pair, also, None, False)
    assert "I-131 and Na-22 as well" in finding(SURE, ONE, also, None, False)
    told = replace(also, scores={"Co-60": 0.97, "Cs-137": 0.89})
    assert "as well" not in finding(SURE, ONE, told, None, False)
    assert "as well" not in finding(SURE, ONE, None, None, False)


def test_a_source_that_may_be_several_is_told_so():
    joined = (replace(estimate(), joined_m=2.4),)
    assert "m (or several within 3 m, or behind other walls than presumed); " in finding(
        SURE, joined, None, None, False
    )
    assert "several" not in finding(SURE, ONE, None, None, False)


def test_it_says_from_which_activity_on_another_source_beside_it_would_be_noticed():
    said = finding(SURE, (replace(estimate(), beside_mbq=43.21),), None, None, False)
    assert "(another Co-60 source 3 to 12 m off would be noticed from 43 MBq on); " in said
    said = finding(SURE, ONE, None, None, False)
    assert "(another Co-60 source 3 to 12 m off may go unnoticed whatever its activity); " in said
    # where it may be several already, nothing more is said
    assert "another" not in finding(SURE, (replace(estimate(), joined_m=2.4),), None, None, False)


def test_certainty_is_never_stated():
    sure = replace(spectrum(ONE[0].nuclide), confidence=0.99999)
    assert finding(SURE, ONE, sure, None, False).endswith("; identified with more than 99.9%")


def test_an_unknown_source_is_said_to_be_like_a_stranger():
    unknown = replace(spectrum("unknown"), alike="Sb-124")
    assert finding(SURE, ONE, unknown, None, False).endswith("of none in the library with 97%, most like Sb-124")


def test_several_sources_and_doubts_are_told():
    two = (estimate(), estimate(20.0, nuclide="Cs-137"))
    doubt = Verdict(status="ambiguous", reasons=("a", "b"), covered=1.0)
    said = finding(doubt, two, None, hindrance=None, presumed=False)
    assert said.startswith("ambiguous: 2 sources: of ")
    assert "Cs-137 at (20.0" in said
    assert said.endswith("; but a; b")


@pytest.mark.parametrize(
    ("activity", "std", "said"),
    [
        (170.4, 3.14, "170.4 ± 3.1"),
        (170.4, 12.7, "170 ± 13"),
        (0.0107, 0.00213, "0.0107 ± 0.0021"),
        (21500.0, 1830.0, "21500 ± 1830"),
    ],
)
def test_the_activity_is_told_with_its_standard_deviation(activity, std, said):
    one = (replace(estimate(activity=activity), activity_std_mbq=std),)
    assert f"a source of {said} MBq Co-60 at (" in finding(SURE, one, None, hindrance=None, presumed=False)


def test_the_activity_of_a_faint_source_is_not_zero():
    for activity, said in ((0.0107, "0.011 MBq"), (9.96, "10 MBq"), (170.4, "170 MBq")):
        faint = (replace(estimate(activity=activity), activity_std_mbq=0.0),)
        assert f"a source of {said} Co-60" in finding(SURE, faint, None, hindrance=None, presumed=False)


@pytest.mark.parametrize(
    ("std", "said"), [(0.0583, "(3.13, -0.50) ± 0.058 m"), (2.34, "(3.1, -0.5) ± 2.3 m"), (41.0, "(3.1, -0.5) ± 41 m")]
)
def test_how_well_the_place_is_known_is_said_by_its_largest_deviation(std, said):
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    covariance = turn @ np.diag([std**2, (0.3 * std) ** 2, 900.0]) @ turn.T
    one = replace(estimate(), position_m=np.array([3.126, -0.497, 0.0]), covariance_m2=covariance)
    assert f" at {said} (" in finding(SURE, (one,), None, hindrance=None, presumed=False)


def test_the_source_that_a_spectrum_was_taken_near_is_the_one_that_it_names():
    pair = (*ONE, estimate(30.0, nuclide="Cs-137"))
    said = finding(SURE, pair, spectrum("Cs-137"), None, False, spectrum_of=1)
    first, second = said.split("; of ")
    assert "identified" not in first
    assert second.endswith("; identified with 97.0%")


@pytest.mark.parametrize(
    ("mbq", "told"),
    [(0.0123, "0.012 MBq"), (9.94, "9.9 MBq"), (170.4, "170 MBq"), (9_999.0, "9999 MBq"), (150_000.0, "150 GBq"),
     (12_341_720.0, "12 TBq"), (3e10, "30 PBq")],
)  # fmt: skip
def test_activities_are_told_in_units_of_their_size(mbq: float, told: str) -> None:
    assert in_mbq(mbq) == told
