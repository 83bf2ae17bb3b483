"""Sensor files, and vehicles that name sensors: what is wrong with them is said in sentences."""

from pathlib import Path

import pytest

from swarmsim.cli import main
from swarmsim.config.errors import InputError
from swarmsim.config.files import available, packaged_dir
from swarmsim.config.load import load_all, load_model, load_named
from swarmsim.config.scenario import load_scenario
from swarmsim.config.sensors import SENSOR_KINDS, Sensor
from swarmsim.sensors.suite import suite_of

FOLDER = packaged_dir() / "sensors"
CHANGES = {
    "a rate of nothing": ("rm3100", "rate_hz: 75.0", "rate_hz: 0", "rate_hz: is too small"),
    "a negative noise": ("rm3100", "noise_ut: 0.015", "noise_ut: -1", "noise_ut: is too small"),
    "not a number": ("ms5611", "noise_pa: 1.2", "noise_pa: .nan", "not a finite number"),
    "a text": ("ms5611", "noise_pa: 1.2", "noise_pa: loud", "allowed: a number from 0"),
    "a misspelt field": ("bmi088", "noise_ug_sqrt_hz: 121", "noise_ug_hz: 121", "did you mean 'noise_ug_sqrt_hz'"),
    "an unknown kind": ("bmi088", "kind: imu", "kind: imus", "did you mean 'imu'"),
    "no kind": ("bmi088", "kind: imu\n", "", "field is missing"),
    "an unknown fix": ("zed_f9p", "fix: 3d", "fix: dgps", "one of 3d, rtk_float, rtk_fixed"),
    "a range the wrong way": ("tfmini", "[0.3, 12.0]", "[12.0, 0.3]", "the first must be smaller"),
    "a pressure the wrong way": ("ms5611", "[1000.0, 120000.0]", "[1e5, 1e3]", "the first must be smaller"),
    "a drift without its time": (
        "rm3100",
        "soft_iron_std: 0.01\nsources:",
        "soft_iron_std: 0.01\ndrift_std_ut: 1\nsources:\n  drift_std_ut: x",
        "drift_std_ut and drift_time_s belong together",
    ),
    "a number without a source": ("tfmini", "  dropout: estimate\n", "", "no source is given for: dropout"),
    "a source of nothing": (
        "tfmini",
        "dropout: estimate",
        "drop: estimate",
        "no number stands at the path of the source",
    ),
    "an empty source": ("tfmini", "dropout: estimate", 'dropout: " "', "the source is empty for: dropout"),
    "another name": ("tfmini", "name: tfmini", "name: lidar", "differs from the file's"),
    "outages that are a number": ("zed_f9p_rtk", "mean_duration_s: 10.0", "mean_duration_s: 0", "is too small"),
    "a latency of a minute": ("zed_f9p", "latency_s: 0.12", "latency_s: 60", "is too large"),
}


@pytest.mark.parametrize(("name", "old", "new", "told"), CHANGES.values(), ids=CHANGES)
def test_what_is_wrong_with_a_sensor_is_told(
    name: str, old: str, new: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
    assert old in text
    file = tmp_path / "configs" / "sensors" / f"{name}.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    assert main(["check", str(file)]) == 2
    assert told in " ".join(capsys.readouterr().err.split())


def test_the_catalogue_has_every_kind_and_each_runs_at_the_rates_of_autopilots() -> None:
    sensors = load_all("sensors")
    assert {sensor.kind for sensor in sensors.values()} == set(SENSOR_KINDS)
    for sensor in sensors.values():
        for period_s in (1 / 400, 1 / 250, 0.02):
            assert getattr(suite_of([sensor], period_s), sensor.kind).ticks >= 1


def test_a_file_elsewhere_is_a_sensor(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_bytes((FOLDER / "tfmini.yaml").read_bytes())
    assert load_model(file, Sensor).name == "tfmini"


def test_a_sensor_extends_another_one(tmp_path: Path) -> None:
    folder = tmp_path / "configs" / "sensors"
    folder.mkdir(parents=True)
    (folder / "quiet.yaml").write_text("extends: bmi088\nname: quiet\ngyroscope: {noise_deg_s_sqrt_hz: 0.001}\n")
    quiet = load_named("sensors", folder / "quiet.yaml")
    assert quiet.gyroscope.noise_deg_s_sqrt_hz == 0.001
    assert quiet.accelerometer == load_named("sensors", "bmi088").accelerometer


VEHICLE = "definitions.vehicles.tarot_t650.sensors"


def test_a_mission_whose_vehicle_names_a_sensor_that_is_none_is_told() -> None:
    with pytest.raises(InputError, match=r"carries a sensor 'bmi808' that does not exist(.|\n)*did you mean 'bmi088'"):
        load_scenario("recon", [f"{VEHICLE}=[bmi808]"])


def test_a_vehicle_with_two_sensors_of_a_kind_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="'tarot_t650' carries two sensors of the kind imu: 'bmi088' and 'icm_20948'"):
        load_scenario("recon", [f"{VEHICLE}=[bmi088, icm_20948]"])
    file = tmp_path / "configs" / "vehicles" / "mine.yaml"
    file.parent.mkdir(parents=True)
    for names, told in (("[bmi088, icm_20948]", "two sensors of the kind imu"), ("[bmi808]", "did you mean 'bmi088'")):
        file.write_text(f"extends: x500\nname: mine\nsensors: {names}\n")
        assert main(["check", str(file)]) == 2
        assert told in " ".join(capsys.readouterr().err.split())


def test_a_scenario_brings_its_sensors_along() -> None:
    change = "definitions.sensors.bmi088.gyroscope.noise_deg_s_sqrt_hz=0.5"
    scenario = load_scenario("recon", [change])
    assert scenario.sensors["bmi088"].gyroscope.noise_deg_s_sqrt_hz == 0.5
    assert set(scenario.sensors) == {name for vehicle in scenario.vehicles for name in vehicle.sensors}
    assert "noise_deg_s_sqrt_hz: 0.5" in scenario.to_yaml()


def test_every_sensor_that_a_shipped_vehicle_names_is_there() -> None:
    vehicles = load_all("vehicles").values()
    named = {name for vehicle in vehicles for name in vehicle.sensors}
    assert named <= set(available("sensors"))
    for vehicle in vehicles:
        suite_of(vehicle, 0.004)
