"""The benchmark, with a stand-in for the simulation."""

import types
from collections.abc import Sequence
from pathlib import Path

import pytest

from swarmsim import cli
from swarmsim.runtime.benchmark import measure
from swarmsim.runtime.clock import Clock
from swarmsim.runtime.progress import SilentProgress


class Simulation:
    """Compiles in the first rollout; each rollout is faster than the one before."""

    scenario = types.SimpleNamespace(mission=types.SimpleNamespace(seed=3))

    def __init__(self) -> None:
        self.asked: list[list[int]] = []

    def rollout(self, seeds: Sequence[int], *, progress: object) -> types.SimpleNamespace:
        self.asked.append(list(seeds))
        clock = Clock()
        clock.add("ran", "run", 4.0 / len(self.asked))
        if len(self.asked) == 1:
            clock.add("compiled", "run", 30.0)
        return types.SimpleNamespace(clock=clock, simulated_s=500.0 * len(seeds))


def test_the_fastest_rollout_counts_and_the_first_compilation() -> None:
    simulation = Simulation()
    speed = measure(simulation, 2, 3, SilentProgress())  # type: ignore[arg-type]
    assert simulation.asked == [[3, 4]] * 3
    assert (speed.run_s, speed.compile_s) == pytest.approx((4.0 / 3.0, 30.0))
    assert speed.programs_s == pytest.approx({"run": 4.0 / 3.0})
    assert speed.real_time_factor == pytest.approx(1000.0 / (4.0 / 3.0))


def test_the_command_compares_one_mission_with_a_batch(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("swarmsim.runtime.run.build", lambda scenario: Simulation())
    assert cli.main(["bench", "recon", "--missions", "8", "--repeats", "1"]) == 0
    printed = capsys.readouterr().out
    for fragment in ("8 missions", "run [s]", "real-time factor", "throughput against one at a time"):
        assert fragment in printed


@pytest.mark.slow
def test_the_command_measures_a_fleet_in_both_layouts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("swarmsim.runtime.fleet.TICKS", 3)
    assert cli.main(["bench", "recon", "--fleet", "5", "--repeats", "1", "--set", "engine=analytic"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "scalars" in line or "vmap" in line]
    assert [("each its own" in line, "scalars" in line) for line in lines] == [
        (True, True), (True, False), (False, True), (False, False)
    ]  # fmt: skip
    assert all(float(line.rsplit("│", 2)[1]) < 1e-5 for line in lines)  # as far as `jax.vmap` is from the layout


def test_a_team_of_rovers_has_no_fleet_to_measure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rover.yaml"
    path.write_text(ROVER)
    assert cli.main(["bench", str(path), "--fleet", "5"]) == 2
    assert "has no UAV" in " ".join(capsys.readouterr().err.split())


ROVER = """
name: rover
site: meadows
sources: []
vehicles: [{name: a, type: orpheus, position_m: [-190, 40]}]
phases: [{name: wait, who: a, policy: hold, time_limit_s: 5}]
"""
