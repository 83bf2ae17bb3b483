"""The facts of autopilots in configs/autopilots, and which of them a vehicle has."""

import pytest

from swarmsim.autopilot.link import LinkError, Mode
from swarmsim.autopilot.mavlink.profile import (
    AUTOPILOTS,
    VEHICLES,
    Profile,
    Rule,
    detect_profile,
    load_autopilot,
    load_profile,
)
from swarmsim.config.errors import InputError

PAIRS = [(a, v) for a in AUTOPILOTS for v in VEHICLES]


@pytest.mark.parametrize(("autopilot", "vehicle"), PAIRS)
def test_every_mode_that_is_commanded_is_told_back(autopilot, vehicle):
    profile = load_profile(autopilot, vehicle)
    for mode in (Mode.FOLLOW, Mode.HOLD, Mode.LAND, Mode.RETURN):
        name, custom, numbers = profile.command_of(mode)
        told, told_name = profile.mode_of(custom)
        assert told_name == name
        # a rover has landed when it holds
        assert told is (Mode.HOLD if vehicle == "rover" and mode is Mode.LAND else mode)
        assert all(0 <= number <= 255 for number in numbers)


@pytest.mark.parametrize(("autopilot", "vehicle"), PAIRS)
def test_the_detected_profile_is_the_loaded_one(autopilot, vehicle):
    known = load_profile(autopilot, vehicle)
    for kind in known.kind.types:
        found = detect_profile(known.autopilot.autopilot, kind)
        assert (found.autopilot.name, found.vehicle) == (autopilot, vehicle)


def test_the_modes_that_were_flown():
    assert load_profile("ardupilot", "copter").command_of(Mode.FOLLOW) == ("GUIDED", 4, (4, 0))
    assert load_profile("ardupilot", "rover").command_of(Mode.FOLLOW) == ("GUIDED", 15, (15, 0))
    assert load_profile("px4", "copter").command_of(Mode.FOLLOW) == ("OFFBOARD", 6 << 16, (6, 0))
    assert load_profile("px4", "copter").command_of(Mode.HOLD)[1:] == (4 << 16 | 3 << 24, (4, 3))
    assert load_profile("px4", "copter").mode_of(3 << 16) == (Mode.OTHER, "POSCTL")
    assert load_profile("px4", "copter").mode_of(99 << 16) == (Mode.OTHER, f"mode {99 << 16}")


def test_unknown_vehicles():
    with pytest.raises(LinkError, match="MAV_AUTOPILOT 8"):
        detect_profile(8, 2)
    with pytest.raises(LinkError, match="MAV_TYPE 1"):
        detect_profile(12, 1)
    with pytest.raises(LinkError, match="not rover"):
        detect_profile(12, 2, vehicle="rover")
    with pytest.raises(InputError, match=r"no autopilot 'px5'(.|\n)*px4"):
        load_profile("px5", "copter")
    with pytest.raises(InputError, match="no vehicle 'plane'"):
        load_profile("px4", "plane")


def test_ones_own_file_comes_first_and_its_mistakes_are_told(tmp_path, monkeypatch):
    folder = tmp_path / "configs" / "autopilots"
    folder.mkdir(parents=True)
    (folder / "px4.yaml").write_text("name: px4\nautopilot: 300\nnonsense: 1\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        load_autopilot("px4")
    for word in ("px4.yaml:2", "px4.yaml:3", "nonsense", "copter"):
        assert word in str(caught.value)


def test_a_role_must_name_a_mode():
    autopilot = load_autopilot("px4")
    copter = autopilot.copter.model_copy(update={"hold": ("HOVER",)})
    with pytest.raises(InputError, match="no mode HOVER"):
        Profile(autopilot.model_copy(update={"copter": copter}), "copter")


def test_rules():
    bounded = Rule(parameter="X", severity="warn", say="x", min=1.0, max=2.0)
    assert [bounded.broken_by(value) for value in (0.5, 1.0, 2.0, 2.5, float("nan"))] == [
        True,
        False,
        False,
        True,
        True,
    ]
    assert Rule(parameter="X", severity="warn", say="x", unequal=0.0).broken_by(0.0)
    assert not Rule(parameter="X", severity="warn", say="x", unequal=0.0).broken_by(1.0)
    assert Rule(parameter="X", severity="tell", say="x").broken_by(7.0)
