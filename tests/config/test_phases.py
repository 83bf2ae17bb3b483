"""Phases of a mission: malformed ones and the message of each, and teams that were refused before there were phases."""

from pathlib import Path

import pytest

from swarmsim.config.documents import dump_yaml, read_file
from swarmsim.config.errors import InputError
from swarmsim.config.load import load_model
from swarmsim.config.mission import Mission
from swarmsim.config.policies import SETTINGS, ApproachAndOrbit, Orbit, ParallelLines, line_spacing
from swarmsim.config.scenario import load_scenario
from tests.config.project import line_of, spoil

SEARCH = "{speed_m_s: 0.9, standoff_m: 4.0, viewpoints: 8}"

# One edit of recon.yaml each: what is replaced, by what, and fragments of the message; "@text" as in test_malformed.py.
EDITS = {
    "no phases": ("phases:", "phases: []\nfases:", ["phases: has too few values", "did you mean 'phases'"]),
    "phases missing": ("phases:", "fases:", ["phases: this field is missing", "did you mean 'phases'"]),
    "unknown field": ("who: orpheus", "whom: orpheus", ["phases.1.whom", "mean 'who'", "phases.1.who: this field"]),
    "same name": ("name: search", "name: survey", ["phases.1.name", "phases.0 has the same name"]),
    "no policy": ("    policy: parallel_lines\n", "", ["phases.0.policy: this field is missing", "a text"]),
    "empty policy": ("policy: parallel_lines", 'policy: ""', ["phases.0.policy: is empty"]),
    "policy not a text": ("policy: parallel_lines", "policy: [a]", ["phases.0.policy: is not a text"]),
    "unknown policy": (
        "policy: parallel_lines",
        "policy: paralel_lines",
        ["@policy: paralel", "no policy 'paralel_lines'", "did you mean 'parallel_lines'", "orbit", ".py:"],
    ),
    "no time limit": (
        "    start: {after: survey}\n    time_limit_s: 600.0\n",
        "    start: {after: survey}\n",
        ["phases.1.time_limit_s: this field is missing", "from 0.001 to 86400"],
    ),
    "no time": ("time_limit_s: 600.0", "time_limit_s: 0", ["phases.0.time_limit_s: is too small"]),
    "settings in a list": (SEARCH, "[1]", ["phases.1.settings: is not a mapping", "given:   [1]"]),
    "unknown setting": (
        "standoff_m: 4.0",
        "stand_off_m: 4.0",
        ["@stand_off_m", "phases.1.settings.stand_off_m: there is no field", "did you mean 'standoff_m'", "viewpoints"],
    ),
    "setting missing": (
        "    settings: {speed_m_s: 0.9, standoff_m: 4.0, viewpoints: 8}\n",
        "",
        ["@- name: search", "phases.1.settings.speed_m_s: this field is missing", "to 5"],
    ),
    "setting too large": ("viewpoints: 8", "viewpoints: 800", ["settings.viewpoints: is too large", "1 to 64"]),
    "setting of another policy": (
        "viewpoints: 8",
        "viewpoints: 8, altitude_m: 9",
        ["phases.1.settings.altitude_m: there is no field 'altitude_m' here"],
    ),
    "target misspelt": (
        "viewpoints: 8",
        "target: hotspott",
        ["phases.1.settings.target: is not one of", "one of source, hotspot or a list of 2", "did you mean 'hotspot'"],
    ),
    "target of one number": ("viewpoints: 8", "target: [1]", ["phases.1.settings.target", "given:   [1]"]),
    "no such vehicle": (
        "who: orpheus",
        "who: orfeus",
        ["@who: orfeus", "no vehicle of the team is meant by 'orfeus'", "did you mean 'orpheus'", "all, multirotor"],
    ),
    "nobody": ("who: orpheus", "who: []", ["phases.1.who: has too few values"]),
    "number for a vehicle": ("who: orpheus", "who: 3", ["phases.1.who", "given:   3"]),
    "kind that the team lacks": ("- {name: orpheus, type: orpheus, position_m: [-62.0, -10.0], heading_deg: 0.0}\n",
        "- {name: r, type: tarot_t650, position_m: [-62.0, -20.0], heading_deg: 0.0}\n",
        ["no vehicle of the team is meant by 'orpheus'", "uav1, uav2, uav3, r"]),
    "rover in the air": (
        "[uav1, uav2, uav3]",
        "[uav1, orpheus]",
        ["phases.0.who", "'parallel_lines' cannot command 'orpheus', a skid_steer", "of the kind multirotor"],
    ),
    "UAV on the ground": ("who: orpheus", "who: all", ["'approach_and_orbit' cannot command 'uav1', a multirotor"]),
    "after nothing": (
        "{after: survey}",
        "{after: survy}",
        ["@{after", "phases.1.start.after: there is no phase 'survy'", "did you mean 'survey'"],
    ),
    "after itself": ("{after: survey}", "{after: search}", ["phases.1.start.after", "'search' waits for its own end"]),
    "after each other": (
        "policy: parallel_lines",
        "start: {after: search}\n    policy: parallel_lines",
        ["phases.0.start.after: phases wait for each other: survey -> search -> survey"],
    ),
    "ends after what waits for it": (
        "policy: parallel_lines",
        "end: {after: search}\n    policy: parallel_lines",
        ["phases.0.end.after: phases wait for each other: survey -> search -> survey"],
    ),
    "two starts": ("{after: survey}", "{after: survey, at_s: 3}", ["phases.1.start: give exactly one of at_s"]),
    "delay alone": ("{after: survey}", "{delay_s: 3}", ["phases.1.start: give exactly one of at_s"]),
    "start in the past": ("{after: survey}", "{at_s: -3}", ["phases.1.start.at_s: is too small", "from 0 to"]),
    "start as a word": ("{after: survey}", "survey", ["phases.1.start: is not a mapping", "at_s, after, when"]),
    "unknown finding": ("{after: survey}", "{when: hotspt}", ["phases.1.start.when", "hotspot"]),
    "end before the start": (
        "{after: survey}",
        "{at_s: 30, delay_s: 5}\n    end: {at_s: 20}",
        ["phases.1.end: ends before it starts", "given:   20 s", "later than 35 s"],
    ),
    "everybody waits": (
        "policy: parallel_lines",
        "start: {when: hotspot}\n    policy: parallel_lines",
        ["phases: every phase waits", "start: {at_s: 0}"],
    ),
    "estimate at time zero": (
        "    start: {after: survey}\n",
        "",
        ["phases.1.start", "needs the source, and nothing has been measured when the mission begins", "{after: …}"],
    ),
    "climb too fast": ("      speed_m_s: 2.5", "      speed_m_s: 2.5\n      climb_speed_m_s: 3.5", ["can climb"]),
    "fast landing": ("touchdown_speed_m_s: 0.5", "touchdown_speed_m_s: 2.5", ["touchdown_speed_m_s: is too large"]),
    "period between": (
        "physics_steps: 2",
        "physics_steps: 2, judge_period_s: 0.035",
        ["@timing:", "timing.judge_period_s: is not a whole number of control periods of 0.01 s", "0.03 or 0.04"],
    ),
    "period below the control period": (
        "control_period_s: 0.01",
        "control_period_s: 0.05, log_period_s: 0.02",
        ["timing.log_period_s", "given:   0.02", "allowed: 0.05"],
    ),
    "sample period between": (
        "control_period_s: 0.01",
        "control_period_s: 0.04, judge_period_s: 0.08, log_period_s: 0.4",
        ["timing.control_period_s: the sample_period_s of the detector 'nai_1p5x1p5'", "0.08 or 0.12"],
    ),
    "too many steps": ("physics_steps: 2", "physics_steps: 21", ["timing.physics_steps: is too large", "1 to 20"]),
    "lossy radio": ("mapping:", "radio: {loss: 1.5}\nmapping:", ["radio.loss: is too large", "from 0 to 1"]),
    "late radio": ("mapping:", "radio: {delay_s: 11}\nmapping:", ["radio.delay_s: is too large", "from 0 to 10"]),
    "no traffic": ("mapping:", "traffic: {separation_m: 0}\nmapping:", ["traffic.separation_m: is too small"]),
    "hotspot without a map": (
        "mapping: {cell_m: 2.0, length_scale_m: 6.0, hotspots_max: 4, hotspot_separation_m: 15.0, "
        "significance_sigma: 5.0}\n",
        "",
        [
            "localisation: the estimate starts from the hotspots of the map",
            "'approach_and_orbit' needs the source, and the mission has no mapping to find it",
        ],
    ),
    "reserved name": ("name: uav1", "name: multirotor", ["vehicles.0.name: is a word of its own under 'who'"]),
}  # fmt: skip


def message_of(mission: Path, *overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        load_scenario(mission, overrides)
    return str(caught.value)


@pytest.mark.parametrize(("old", "new", "fragments"), EDITS.values(), ids=EDITS)
def test_an_edit_that_spoils_the_phases(mission: Path, old: str, new: str, fragments: list[str]) -> None:
    spoil(mission, old, new)
    message = message_of(mission)
    for fragment in fragments:
        if fragment.startswith("@"):
            fragment = f"configs/missions/recon.yaml:{line_of(mission, fragment[1:])}"
        assert fragment in message


@pytest.mark.parametrize(
    ("override", "fragment"),
    [
        ("phases.surwey.settings.altitude_m=3", "phases has no item 'surwey'"),
        ("phases.survey.settings.altitud_m=3", "--set phases.0.settings.altitud_m: there is no field 'altitud_m' here"),
        ("phases.survey.who=uav9", "--set phases.0.who: no vehicle of the team is meant by 'uav9'"),
        ("phases.search.start={when: source}", "--set phases.1.start.when"),
        ("phases.search.start={when: hotspot}", None),
        ("phases.search.settings.target=[1, 2]", None),
        ("phases.survey.end={when: hotspot, delay_s: 20}", None),
        ("phases.survey.who=multirotor", None),
        ("phases.survey.who=tarot_t650", None),
    ],
)
def test_an_override_of_a_phase(mission: Path, override: str, fragment: str | None) -> None:
    if fragment is None:
        load_scenario(mission, [override])
    else:
        assert fragment in message_of(mission, override)


def test_settings_of_all_phases_are_told_at_once(mission: Path) -> None:
    spoil(mission, "altitude_m: 20.0", "altitude_m: 0.5")
    spoil(mission, "viewpoints: 8", "viewpoints: 0")
    spoil(mission, "type: orpheus", "type: orfeus")
    with pytest.raises(InputError) as caught:
        load_scenario(mission)
    assert [(p.path, p.line) for p in caught.value.problems] == [
        ("vehicles.3.type", line_of(mission, "orfeus")),
        ("phases.0.settings.altitude_m", line_of(mission, "altitude_m")),
        ("phases.1.settings.viewpoints", line_of(mission, "viewpoints")),
    ]


def test_settings_are_validated_once_for_each_phase(mission: Path) -> None:
    scenario = load_scenario(mission)
    survey, search = scenario.settings
    assert isinstance(survey, ParallelLines)
    assert isinstance(search, ApproachAndOrbit)
    assert line_spacing(survey) == 10.0
    assert survey.climb_speed_m_s == 2.0
    assert search.needed() == ("source",)
    assert Orbit(radius_m=5, altitude_m=9, speed_m_s=1, target=(1.0, 2.0)).needed() == ()
    assert scenario.mission.phases[0].settings["climb_speed_m_s"] == 2.0
    assert scenario.phase_members == ((0, 1, 2), (3,))
    assert {name for name, model in SETTINGS.items() if "skid_steer" in model.vehicles} == {
        "approach_and_orbit", "waypoints", "hold",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("who", "settings", "fragment"),
    [
        ("uav1", "{points: [[0, 0]], speed_m_s: 1}", "settings.altitude_m: this field is missing: a multirotor"),
        ("orpheus", "{points: [[0, 0]], speed_m_s: 1, altitude_m: 9}", "settings.altitude_m: a rover has no altitude"),
        ("all", "{points: [[0, 0]], speed_m_s: 1, altitude_m: 9}", "give the rovers a phase of their own"),
        ("orpheus", "{points: [], speed_m_s: 1}", "settings.points: has too few values"),
        ("orpheus", "{points: [[0, 0], [1]], speed_m_s: 1}", "settings.points.1: has too few values"),
        ("orpheus", "{points: [[0, 0]], speed_m_s: 3}", "is faster than the vehicle type 'orpheus' can drive"),
        ("uav1", "{points: [[0, 0]], speed_m_s: 3, altitude_m: 9}", None),
        ("orpheus", "{points: [[0, 0]], speed_m_s: 1, laps: 3}", None),
    ],
)
def test_waypoints_suit_their_vehicles(mission: Path, who: str, settings: str, fragment: str | None) -> None:
    phase = f"phases.1={{name: b, who: {who}, policy: waypoints, settings: {settings}, time_limit_s: 60}}"
    if fragment is None:
        assert load_scenario(mission, [phase]).settings[1].points == ((0, 0),)
    else:
        assert fragment in message_of(mission, phase)


HOVER = "{name: p, who: all, policy: hold, time_limit_s: 5}"
ALONE = ["sources=[]", "mapping=", "localisation=", "identification=", f"phases=[{HOVER}]"]


def bare_type(mission: Path) -> None:
    """Add a type ``bare`` to the vehicles: an x500 without a detector."""
    vehicles = mission.parents[1] / "vehicles"
    data = read_file(vehicles / "x500.yaml").data | {"name": "bare", "detector": None}
    del data["sources"]["detector"]
    (vehicles / "bare.yaml").write_text(dump_yaml(data))


@pytest.mark.parametrize(
    "team",
    [
        "[{name: a, type: orpheus, position_m: [0, 0]}]",
        "[{name: a, type: orpheus, position_m: [0, 0]}, {name: b, type: orpheus, position_m: [4, 0]}]",
        "[{name: a, type: x500, position_m: [0, 0]}, {name: b, type: dji_f550, position_m: [4, 0]}]",
        "[{name: a, type: bare, position_m: [0, 0]}, {name: b, type: orpheus, position_m: [4, 0]}]",
        "[{name: a, type: x500, position_m: [0, 0], formation: {count: 2000, columns: 50, spacing_m: 2}}]",
    ],
)
def test_teams_of_any_kind(mission: Path, team: str) -> None:
    bare_type(mission)
    scenario = load_scenario(mission, [f"vehicles={team}", *ALONE])
    assert scenario.phase_members == (tuple(range(len(scenario.members))),)


def test_a_team_that_cannot_measure_finds_nothing(mission: Path) -> None:
    bare_type(mission)
    message = message_of(
        mission,
        "vehicles=[{name: uav1, type: bare, position_m: [0, 0]}]",
        "phases.survey.who=uav1",
        "phases.search.who=uav1",
        "phases.search.policy=orbit",
        "phases.search.settings={radius_m: 5, altitude_m: 9, speed_m_s: 1, target: hotspot}",
    )
    assert "mapping: there is nothing to map: no vehicle of the team carries a detector" in message
    assert "needs the hotspot, and no vehicle of the team carries a detector to find it" in message


def test_a_detector_that_has_no_part_in_a_phase_estimates_nothing(mission: Path) -> None:
    bare_type(mission)
    bare = (
        "vehicles=[{name: uav1, type: bare, position_m: [0, 0]}, {name: uav2, type: tarot_t650, position_m: [20, 0]}]"
    )
    only = "phases=[{name: survey, who: uav1, policy: hold, time_limit_s: 20}]"
    told = "localisation: there is nothing to estimate sources from: no vehicle with a detector has a part in a phase"
    assert told in message_of(mission, bare, only)
    assert load_scenario(mission, [bare, only.replace("uav1", "[uav1, uav2]")])


def test_a_team_that_resolves_no_energies_identifies_nothing(mission: Path) -> None:
    for file in (mission.parents[1] / "vehicles").glob("*.yaml"):
        data = read_file(file).data
        if data.get("detector"):
            data["detector"]["model"] = "geiger_sbm20"
            file.write_text(dump_yaml(data))
    message = message_of(mission, "description=counters")
    assert "identification: nuclides cannot be told apart: no detector of the team resolves energies" in message
    load_scenario(mission, ["identification="])


def test_a_trigger_is_validated_in_python_too(mission: Path) -> None:
    made = load_model(mission, Mission)
    assert made.phases[0].who == ("uav1", "uav2", "uav3")
    assert made.phases[1].who == ("orpheus",)
    with pytest.raises(ValueError, match="exactly one"):
        type(made.phases[0].start)(delay_s=3.0)


@pytest.mark.parametrize(
    ("phase", "place"),
    [
        ("phases.survey.settings.altitude_m=30", "phases.0.settings.altitude_m"),
        (
            "phases.1={name: b, who: uav1, policy: orbit, time_limit_s: 60, start: {after: survey}, "
            "settings: {radius_m: 5, altitude_m: 25.5, speed_m_s: 1}}",
            "phases.1.settings.altitude_m",
        ),
        (
            "phases.1={name: b, who: uav1, policy: waypoints, time_limit_s: 60, "
            "settings: {points: [[0, 0]], altitude_m: 25, speed_m_s: 1}}",
            "phases.1.settings.altitude_m",
        ),
    ],
)
def test_a_phase_above_the_ceiling_of_the_fence(mission: Path, phase: str, place: str) -> None:
    message = message_of(mission, phase, "failsafes.fence={ceiling_m: 25}")
    assert f"{place}: is not below the fence's ceiling" in message
    assert "less than 25 (failsafes.fence.ceiling_m)" in message
    load_scenario(mission, [phase, "failsafes.fence={ceiling_m: 25, action: none}"])
    load_scenario(mission, [phase, "failsafes.fence={ceiling_m: 31}"])
