"""The benchmark, with a stand-in for the simulation."""

import types
from collections.abc import Sequence

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
