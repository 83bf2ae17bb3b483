"""Formations, and what a phase's ``who`` may name."""

from pathlib import Path

import pytest

from swarmsim.config.errors import InputError
from swarmsim.config.mission import Formation, TeamMember
from swarmsim.config.scenario import Scenario, load_scenario
from swarmsim.config.team import expand

PHASES = "phases=[{name: p, who: %s, policy: hold, time_limit_s: 5}]"
REST = ["sources=[]", "mapping=", "localisation=", "identification="]


def load(mission: Path, team: str, who: str = "all", *more: str) -> Scenario:
    return load_scenario(mission, [f"vehicles=[{team}]", PHASES % who, *REST, *more])


def formation(count: int, columns: int, spacing: float, name: str = "f", at: str = "[0, 0]") -> str:
    grid = f"{{count: {count}, columns: {columns}, spacing_m: {spacing}}}"
    return f"{{name: {name}, type: x500, position_m: {at}, heading_deg: 30, formation: {grid}}}"


def test_a_formation_is_a_grid_of_rows_from_west_to_east_and_south_to_north() -> None:
    entry = TeamMember(
        name="f", type="x500", position_m=(10.0, -5.0), formation=Formation(count=5, columns=2, spacing_m=3)
    )
    members = expand(entry)
    assert [member.name for member in members] == ["f1", "f2", "f3", "f4", "f5"]
    assert [member.position_m for member in members] == [(10, -5), (13, -5), (10, -2), (13, -2), (10, 1)]
    assert all(member.formation is None for member in members)
    alone = TeamMember(name="a", type="x500", position_m=(0, 0))
    assert expand(alone) == (alone,)


def test_the_team_of_a_scenario_is_expanded_and_its_mission_is_not(mission: Path) -> None:
    scenario = load(mission, "{name: r, type: orpheus, position_m: [-9, 0]}, " + formation(200, 20, 4.0))
    assert len(scenario.mission.vehicles) == 2
    assert len(scenario.members) == len(scenario.vehicles) == 201
    assert scenario.entries == (0,) + (1,) * 200
    assert scenario.members[200].position_m == (76, 36)
    assert scenario.members[200].heading_deg == 30
    assert "f200" not in scenario.to_yaml()


@pytest.mark.parametrize(
    ("who", "members"),
    [
        ("all", (0, 1, 2, 3, 4)),
        ("multirotor", (1, 2, 3, 4)),
        ("skid_steer", (0,)),
        ("f", (1, 2, 3)),
        ("f2", (2,)),
        ("x500", (1, 2, 3)),
        ("tarot_t650", (4,)),
        ("[f3, skid_steer, f3]", (0, 3)),
    ],
)
def test_who_names_members_formations_types_and_kinds(mission: Path, who: str, members: tuple[int, ...]) -> None:
    team = [
        "{name: r, type: orpheus, position_m: [-9, 0]}",
        formation(3, 3, 4.0),
        "{name: t, type: tarot_t650, position_m: [0, 20]}",
    ]
    assert load(mission, ", ".join(team), who).phase_members == (members,)


@pytest.mark.parametrize(
    ("team", "fragments"),
    [
        (formation(1, 1, 4), ["vehicles.0.formation.count: is too small", "from 2 to 2000"]),
        (formation(2, 0, 4), ["vehicles.0.formation.columns: is too small"]),
        (formation(4, 2, 0), ["vehicles.0.formation.spacing_m: is too small"]),
        (formation(2000, 50, 4) + ", " + formation(2, 2, 4, "g"), ["vehicles: has too many vehicles", "2002"]),
        (formation(9, 3, 1.0), ["'f2' starts too near to 'f1'", "1.00 m apart", "at least 1.27 m", "pad_gap_m"]),
        (
            formation(4, 2, 4) + ", {name: f2, type: x500, position_m: [-9, 0]}",
            ["vehicles.1.name: vehicles.0 has the same name", "given:   f2"],
        ),
        (
            formation(4, 2, 4) + ", {name: f, type: x500, position_m: [-9, 0]}",
            ["vehicles.1.name: vehicles.0 has the same name", "given:   f"],
        ),
        (formation(4, 2, 4) + ", " + formation(4, 2, 4, "g", "[3, 0.5]"), ["'g1' starts too near to 'f2'"]),
    ],
)  # fmt: skip
def test_a_formation_that_does_not_fit(mission: Path, team: str, fragments: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        load(mission, team)
    assert len(caught.value.problems) == 1
    for fragment in fragments:
        assert fragment in str(caught.value)


@pytest.mark.parametrize(("gap", "fits"), [(0.5, True), (0.9, False)])
def test_pads_keep_the_radii_and_the_gap(mission: Path, gap: float, fits: bool) -> None:
    team = "{name: a, type: x500, position_m: [0, 0]}, {name: b, type: x500, position_m: [1.4, 0]}"
    team += ", {name: r, type: orpheus, position_m: [0, 1.9]}"
    if fits:
        load(mission, team, "all", f"traffic.pad_gap_m={gap}")
    else:
        with pytest.raises(InputError, match="'b' starts too near to 'a'"):
            load(mission, team, "all", f"traffic.pad_gap_m={gap}")


def test_two_thousand_vehicles_on_one_pad_are_told_once(mission: Path) -> None:
    with pytest.raises(InputError) as caught:
        load(mission, formation(2000, 40, 0.01))
    assert len(caught.value.problems) == 1
