"""How fast a scenario flies on this machine: one mission against a batch, within one run."""

from dataclasses import dataclass

from swarmsim.runtime.progress import Progress
from swarmsim.runtime.simulation import Simulation


@dataclass(frozen=True)
class Speed:
    """A rollout's speed; compilation is not in it."""

    missions: int
    simulated_s: float  # of all missions
    run_s: float
    compile_s: float
    programs_s: dict[str, float]  # running time of each program

    @property
    def real_time_factor(self) -> float:
        """Simulated over wall seconds."""
        return self.simulated_s / self.run_s


def measure(simulation: Simulation, missions: int, repeats: int, progress: Progress) -> Speed:
    """The fastest of ``repeats`` rollouts of a batch; the compilation is that of the first."""
    first = simulation.scenario.mission.seed
    speeds = []
    for _ in range(repeats):
        batch = simulation.rollout(range(first, first + missions), progress=progress)
        clock = batch.clock
        speeds.append(Speed(missions, batch.simulated_s, clock.run_s, clock.compile_s, dict(clock.ran)))
    best = min(speeds, key=lambda speed: speed.run_s)
    return Speed(best.missions, best.simulated_s, best.run_s, speeds[0].compile_s, best.programs_s)
