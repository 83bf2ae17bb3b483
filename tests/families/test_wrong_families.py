"""Families that cannot be drawn from: each is told in a sentence before anything flies."""

import pytest

import swarmsim


@pytest.mark.parametrize(
    ("path", "distribution", "message"),
    [
        ("wind.sped_m_s", "{uniform: [0, 3]}", "did you mean 'speed_m_s'"),
        ("wnd.speed_m_s", "{uniform: [0, 3]}", "did you mean 'wind'"),
        ("phases.survy.settings.speed_m_s", "{uniform: [1, 2]}", "did you mean 'survey'"),
        ("phases.survey.settings.sped_m_s", "{uniform: [1, 2]}", "did you mean 'speed_m_s'"),
        ("sources.7.activity_mbq", "{uniform: [1, 2]}", "no item '7'"),
        ("wind.*", "{uniform: [1, 2]}", "stands for the items of a list"),
        ("wind.speed_m_s", "{uniform: [3, 1]}", "the first is greater"),
        ("wind.speed_m_s", "{uniform: [.nan, 1]}", "not a finite number"),
        ("wind.speed_m_s", "{uniform: [0, .inf]}", "not a finite number"),
        ("wind.speed_m_s", "{uniform: [0]}", "uniform"),
        ("wind.speed_m_s", "{uniform: [0, 31]}", "can draw a value that is too large"),
        ("wind.speed_m_s", "{normal: {mean: 5, std: 2}}", "can draw a value that is too small"),
        ("wind.speed_m_s", "{normal: {mean: 5, std: 0}}", "too small"),
        ("wind.speed_m_s", "{normal: {mean: 5, std: 1, min: 9, max: 2}}", "min must be smaller"),
        ("sources.0.activity_mbq", "{log_uniform: [0, 5]}", "greater than zero"),
        ("wind.speed_m_s", "{choice: []}", "too few values"),
        ("wind.speed_m_s", "{choice: [1, .nan]}", "not finite"),
        ("wind.speed_m_s", "{choice: [1, 99]}", "holds a value that is too large"),
        ("wind.speed_m_s", "{choice: [1, fast]}", "is not a number"),
        ("wind.speed_m_s", f"{{choice: [{', '.join(map(str, range(3000)))}]}}", "too many values"),
        ("wind.speed_m_s", "{choice: [1, 2], weights: [1]}", "a weight for each choice"),
        ("wind.speed_m_s", "{choice: [1, 2], weights: [0, 0]}", "greater than zero"),
        ("wind.speed_m_s", "{uniform: [1, 2], choice: [1]}", "exactly one of"),
        ("wind.speed_m_s", "{}", "exactly one of"),
        ("wind.speed_m_s", "{unifrom: [1, 2]}", "did you mean 'uniform'"),
        ("wind.speed_m_s", "5", "is not a mapping"),
        ("wind.speed_m_s", "{count: [1, 2]}", "is the number of sources"),
        ("wind.gusts", "{uniform: [0, 1]}", "is true or false"),
        ("sources", "{count: [3, 1]}", "the first is greater"),
        ("sources", "{count: [1, 99]}", "too large"),
        ("sources", "{uniform: [1, 2]}", "cannot be varied"),
        ("sources.0.nuclide", "{choice: [Co-60, Co-61]}", "there is no nuclide 'Co-61'"),
        ("sources.0.nuclide", "{any_nuclide: {yield_min_percent: 101}}", "too large"),
        ("sources.0.height_m", "{place: {region: open}}", "is for sources.*.position_m"),
        ("sources.0.position_m", "{place: {region: opn}}", "not one of the choices"),
        ("sources.0.position_m", "{place: {region: indoors, margin_m: 900}}", "no place in the region 'indoors'"),
        ("sources.0.on", "{choice: [uav1, uav2]}", "position_m and on are given"),
        ("sources.0.offset_m.2", "{uniform: [0, 1]}", "sources.0.offset_m"),
        ("vehicles.uav1.name", "{choice: [a, b]}", "sources.*.nuclide, position_m"),
        ("vehicles.uav1.type", "{choice: [x500, tarot_t650]}", "cannot be varied"),
        ("engine", "{choice: [mjx, analytic]}", "cannot be varied"),
        ("phases.survey.policy", "{choice: [orbit]}", "cannot be varied"),
        ("autopilot.limits", "{choice: [1, 2]}", "vary.autopilot.limits: cannot be varied"),
        ("autopilot.limits.speed_m_s", "{uniform: [1, 2]}", "cannot be varied"),
        ("definitions.materials.brick.density_kg_m3", "{uniform: [1500, 2000]}", "cannot be varied"),
        ("definitions.materials.brik.density_kg_m3", "{uniform: [1500, 2000]}", "vary.definitions.materials.brik"),
        ("failsafes.fence.action", "{choice: [retrn]}", "vary.failsafes.fence.action.choice: draws a value"),
        ("wind", "{choice: [{speed: 3}]}", "vary.wind.choice: draws a value with which the mission is wrong: there is"),
        ("mapping.length_scale_m", "{choice: [0.1]}", "vary.mapping.length_scale_m.choice: draws a value"),
        ("localisation.samples", "{uniform: [16, 80]}", "changes more than a value"),
        ("localisation.samples", "{uniform: [16.5, 80]}", "draws fractions"),
        ("phases.survey.settings.speed_m_s", "{choice: [2, 20]}", "faster than the vehicle type"),
    ],
)  # fmt: skip
def test_wrong_families_are_told_in_a_sentence(path, distribution, message):
    with pytest.raises(swarmsim.InputError) as caught:
        swarmsim.build(swarmsim.load("recon", [f"vary.{path}={distribution}", "engine=analytic"]))
    assert message in str(caught.value)


@pytest.mark.slow
def test_no_room_for_sources_and_parts_varied_twice_are_told():
    base = ["vary.sources={count: [12, 12]}", "engine=analytic"]
    crowded = "vary.sources.*.position_m={place: {region: indoors, apart_m: 60}}"
    with pytest.raises(swarmsim.InputError, match="find no places so far apart"):
        swarmsim.build(swarmsim.load("recon", [*base, crowded]))
    twice = ["vary.sources.0.position_m={choice: [[0, 0]]}", "vary.sources.0.position_m.0={uniform: [0, 1]}"]
    with pytest.raises(swarmsim.InputError, match="varied as a part"):
        swarmsim.load("recon", twice)
    with pytest.raises(swarmsim.InputError, match="setting it changes nothing"):
        swarmsim.load("random_recon", ["sources.1.activity_mbq=5"])


def test_a_wrong_word_in_a_list_is_told_once_where_it_stands() -> None:
    """One region or a list of them may stand there: pydantic finds the list to be no word as well."""
    with pytest.raises(swarmsim.InputError) as caught:
        swarmsim.load("random_recon", ["vary.sources.*.position_m={place: {region: [open, indors]}}"])
    (problem,) = caught.value.problems
    assert (problem.path or "").endswith("position_m.place.region.1")
    assert problem.given == "indors"
    assert problem.suggestion == "did you mean 'indoors'?"


def test_what_is_wrong_is_told_where_it_is_drawn_and_not_at_the_number_of_sources() -> None:
    wrong = ["vary.sources={count: [1, 2]}", "vary.sources.*.nuclide={choice: [Cs-137, Co-61]}", "engine=analytic"]
    with pytest.raises(swarmsim.InputError, match=r"vary\.sources\.\*\.nuclide\.choice: draws a value with which"):
        swarmsim.build(swarmsim.load("random_recon", wrong))
