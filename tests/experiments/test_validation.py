"""Validation of missions: which estimate stands for which source, and what is counted of them."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

import swarmsim
from experiments.validation import detection, pairs
from experiments.validation.missions import by_survey, matches, rows_of, summarised, without_sources

ASKED = (30.0, 60.0)


def source(x, y=0.0, nuclide="Co-60", activity=100.0):
    return SimpleNamespace(position_m=np.array([x, y, 0.5]), nuclide=nuclide, activity_mbq=activity)


def estimate(x, y=0.0, nuclide="Co-60", activity=100.0, std=0.5):
    return SimpleNamespace(
        position_m=np.array([x, y, 0.5]), covariance_m2=np.diag([std**2, std**2, 0.04]), activity_mbq=activity,
        activity_std_mbq=0.1 * activity, nuclide=nuclide, detection=90.0, effective_samples=80.0, converged=True,
    )  # fmt: skip


def record(sources, estimates, status="located", seed=0):
    drawn = {f"sources.{i}.region": "open" for i in range(len(sources))}
    return SimpleNamespace(
        seed=seed,
        status=status,
        sources=tuple(sources),
        estimates=tuple(estimates),
        drawn=drawn,
        site="yard",
        finding="told",
    )


def test_nearest_pairs_come_first_and_none_is_used_twice():
    sources, estimates = [source(0.0), source(30.0)], [estimate(24.0), estimate(1.0), estimate(90.0)]
    found = matches(sources, estimates)
    assert {i: k for i, (k, _) in found.items()} == {0: 1, 1: 0}
    assert matches([source(0.0)], [estimate(25.1)]) == {}
    assert {i: k for i, (k, _) in matches([source(0.0), source(4.0)], [estimate(3.0)]).items()} == {1: 0}


def test_a_ratio_of_nothing_is_that_of_its_own_source():
    rows = rows_of(record([source(0.0), source(40.0)], []), np.array([0.0, 90.0]), ASKED)
    assert [row["true_ratio"] for row in rows] == [0.0, 90.0]
    assert [row["detectable"] for row in rows] == [False, True]


def test_pairs_are_counted_by_what_was_told_of_them():
    drawn = {"nuclides": ["Co-60"] * 2, "places": np.array([[0.0, 0.0], [4.0, 0.0]]), "mbq": np.array([100.0, 50.0])}
    plain = [with_joined(estimate(0.5), 0.0), with_joined(estimate(4.0), 0.0)]
    several = [with_joined(estimate(1.0, std=2.0), 4.0)]
    rows = [pairs.row_of(drawn, record([], estimates)) for estimates in (plain, several, plain[:1], [])]
    assert [row["told"] for row in rows] == ["two", "may be several", "one", "none"]
    assert rows[0]["sigmas"] == [1.0, 0.0]
    assert rows[2]["sigmas"] == [1.0, 7.0]
    found = pairs.summarised(rows)["3 to 6 m"]
    assert found["missions"] == found["located"] == 4
    assert found["told"] == {"two": 1, "may be several": 1, "one": 1}
    assert found["both_inside_95"] == 2
    assert pairs.summarised(rows)["6 to 14 m"]["missions"] == 0
    # 50 of 80 MBq: noticed in two of the answers; that without a source is no answer about one beside it
    assert rows[0]["beside_mbq"] == 80.0
    assert rows[3]["beside_mbq"] is None
    assert pairs.summarised(rows)["by_limit"]["0.5 to 1"] == {"sources": 3, "told": 2, "doubted": 0}
    never = [pairs.row_of(drawn, record([], [with_joined(estimate(0.0), 0.0, np.inf)], "ambiguous"))]
    assert pairs.summarised(never)["by_limit"]["0 to 0.25"] == {"sources": 1, "told": 0, "doubted": 1}


def test_of_two_nuclides_each_is_looked_for_where_its_own_is_told():
    drawn = {"nuclides": ["Co-60", "Cs-137"], "places": np.zeros((2, 2)), "mbq": np.array([100.0, 50.0])}
    right = [with_joined(estimate(0.5), 0.0), with_joined(estimate(0.0, nuclide="Cs-137"), 0.0)]
    wrong = [right[0], with_joined(estimate(0.0, nuclide="Ba-133"), 0.0)]
    rows = [pairs.row_of(drawn, record([], estimates)) for estimates in (right, wrong)]
    assert [row["sigmas"] for row in rows] == [[1.0, 0.0], [1.0, np.inf]]
    found = pairs.summarised(rows)
    assert found["0 to 1 m"]["both_inside_95"] == 1
    assert "by_limit" not in found


def test_pairs_of_two_nuclides_are_drawn_with_two():
    rng = np.random.default_rng(1)
    some = [pairs._drawn(rng, True) for _ in range(60)]
    assert all(len(set(one["nuclides"])) == 2 for one in some)
    in_one = sum(np.array_equal(*one["places"]) for one in some)
    assert 8 <= in_one <= 32
    assert all(len(set(pairs._drawn(rng, False)["nuclides"])) == 1 for _ in range(20))


def test_no_pairs_at_all_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        pairs.main(["--missions", "0", "--out", str(tmp_path / "out")])
    assert stopped.value.code == 2
    assert "--missions: 0 is too few" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def with_joined(one, joined_m, beside_mbq=80.0):
    return SimpleNamespace(**vars(one), joined_m=joined_m, beside_mbq=beside_mbq)


def test_errors_are_in_standard_deviations_of_what_was_stated():
    row = rows_of(record([source(0.0)], [estimate(1.0, activity=110.0)]), np.array([80.0]), ASKED)[0]
    assert (row["error_m"], row["sigmas"]) == (pytest.approx(1.0), pytest.approx(2.0))
    assert row["activity_sigmas"] == pytest.approx(np.log(1.1) / 0.1)
    assert (row["apart_m"], row["detectable"], row["found"]) == (np.inf, True, "Co-60")


def test_a_source_beside_others_must_be_seen_better():
    ratios = np.array([40.0, 40.0])
    both = rows_of(record([source(0.0), source(40.0)], []), ratios, ASKED)
    assert [row["detectable"] for row in both] == [False, False]
    assert [row["detectable"] for row in rows_of(record([source(0.0)], []), ratios[:1], ASKED)] == [True]
    assert both[0]["apart_m"] == pytest.approx(40.0)
    assert both[0]["found"] is None


def test_false_sources_have_a_row_of_their_own():
    rows = rows_of(record([source(0.0)], [estimate(0.2), estimate(60.0, nuclide="Cs-137")]), np.array([80.0]), ASKED)
    assert [row["true"] for row in rows] == ["Co-60", None]
    assert (rows[1]["found"], rows[1]["sigmas"]) == ("Cs-137", None)


@dataclass(frozen=True)
class Found:
    """What of a record says what was found."""

    status: str
    estimate: object
    further: tuple
    survey_estimate: object
    survey_further: tuple


def test_what_the_survey_found_can_be_judged_by_itself():
    by_all, before, beside = estimate(0.1), estimate(3.0), estimate(60.0)
    judged = by_survey(Found("located", by_all, (), before, (beside,)))
    assert (judged.status, judged.estimate, judged.further) == ("located", before, (beside,))


def test_shares_are_of_those_that_they_speak_of():
    missions = [
        record([source(0.0)], [estimate(0.5)], seed=0),
        record([source(0.0)], [estimate(4.0)], seed=1),
        record([source(0.0)], [estimate(1.5, nuclide="Cs-137"), estimate(50.0)], "ambiguous", seed=2),
        record([source(0.0), source(12.0)], [estimate(0.0)], "located", seed=3),
        record([source(0.0)], [], "none", seed=4),
        record([], [estimate(9.0)], "located", seed=5),
    ]
    seen = [[80.0], [80.0], [80.0], [80.0, 80.0], [12.0], []]
    rows = [row for r, ratio in zip(missions, seen, strict=True) for row in rows_of(r, np.array(ratio), ASKED)]
    told = summarised(missions, rows)
    assert told["statuses"] == {"located": 4, "ambiguous": 1, "none": 1}
    assert (told["true"], told["found"], told["false"], told["false_located"]) == (6, 4, 2, 1)
    assert told["located_sources"] == 3
    assert told["false_alarms"] == 1.0  # of the one mission without a source
    assert told["located_inside_95"] == pytest.approx(2 / 3)
    assert told["located_beyond_5_sigma"] == pytest.approx(1 / 3)
    assert told["all_inside_95"] == pytest.approx(2 / 4)  # errors of 1, 8, 3 and 0 standard deviations
    assert told["nuclide_right"] == pytest.approx(3 / 4)
    # seeds 0 to 2: the two of seed 3 are too near each other, the one of seed 4 is too faint
    assert told["detectable_and_resolved"] == 3
    assert told["of_those_number_right"] == pytest.approx(2 / 3)
    assert told["of_those_located"] == pytest.approx(2 / 3)


def test_what_was_noticed_is_counted_by_times_the_limit():
    near, far = record([source(0.0)], [estimate(3.0)]), record([source(0.0)], [estimate(40.0)])
    rows = [detection.row_of(one, times, 30.0) for times in (0.5, 1.0) for one in (near, far)]
    rows.append(detection.row_of(record([source(0.0)], [], "none"), 0.5, 30.0))
    assert [row["noticed"] for row in rows] == [True, False, True, False, False]
    assert rows[-1]["error_m"] is None
    told = detection.summarised(rows, np.array([30.0, 50.0]))
    assert told["limit_mbq"] == {"median": 40.0, "max": 50.0}
    assert told["by_times_the_limit"]["0.5"] == {"missions": 3, "noticed": 1, "share": pytest.approx(0.333)}
    assert told["by_times_the_limit"]["1.0"]["share"] == 0.5


def test_a_familywithout_sources_draws_everything_else_as_before():
    built = swarmsim.build(swarmsim.load("random_recon", without_sources("random_recon", [])))
    whole = swarmsim.build(swarmsim.load("random_recon"))
    drawn, before = (b.draw(range(3)).values for b in (built, whole))
    assert not any(path.startswith("sources") for path in drawn)
    assert all(list(drawn[path]) == list(before[path]) for path in drawn)
    assert built.world_of(0).sources.activity_bq.sum() == 0.0
