"""Building a scenario, and the settings of the process."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import swarmsim

DEVICES = "import swarmsim; swarmsim.use_all_cores(); import jax; print(len(jax.devices()))"


def test_build_changes_no_setting_of_the_process() -> None:
    settings, environment = dict(jax.config.values), dict(os.environ)
    swarmsim.build(swarmsim.load("recon", ["engine=analytic"]))
    assert {name: jax.config.values[name] for name in settings} == settings
    assert dict(os.environ) == environment


def test_build_refuses_what_does_not_fit_the_site() -> None:
    with pytest.raises(swarmsim.InputError, match="sources"):
        swarmsim.build(swarmsim.load("recon", ["sources.0.position_m=[900, 0]"]))


def test_what_cannot_be_built_or_run(tmp_path: Path) -> None:
    for given in (None, "recon"):
        with pytest.raises(swarmsim.InputError, match="is no scenario"):
            swarmsim.build(given)  # type: ignore[arg-type]
    scenario = swarmsim.load("recon", ["engine=analytic"])
    for missions in (0, -1, 1.5, True):
        with pytest.raises(swarmsim.InputError, match="a run has one mission or more"):
            swarmsim.run(scenario, tmp_path / "run", missions)  # type: ignore[arg-type]
    for out in (None, b"run", 3):
        with pytest.raises(swarmsim.InputError, match="named by a text or a path"):
            swarmsim.run(scenario, out)  # type: ignore[arg-type]
    with pytest.raises(swarmsim.InputError, match="a null character"):
        swarmsim.run(scenario, f"{tmp_path}/a\0b")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("chosen", [None, 3])
def test_all_cores_are_devices_unless_a_number_is_set(chosen: int | None) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "JAX_NUM_CPU_DEVICES"}
    environment |= {"JAX_PLATFORMS": "cpu"} | ({} if chosen is None else {"JAX_NUM_CPU_DEVICES": str(chosen)})
    result = subprocess.run(
        [sys.executable, "-c", DEVICES], capture_output=True, text=True, check=True, env=environment
    )
    assert int(result.stdout) == (chosen or os.cpu_count())


def test_asking_for_all_cores_too_late_is_harmless() -> None:
    devices = jax.devices()
    swarmsim.use_all_cores()
    assert jax.devices() == devices
