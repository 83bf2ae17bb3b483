"""swarmsim: a swarm simulator for research, in Python on JAX.

Load a scenario, build it, roll it out:

    import swarmsim
    simulation = swarmsim.build(swarmsim.load("recon"))
    batch = simulation.rollout(range(16))
    print(swarmsim.mission_record(simulation, batch, 0).finding)

or step its team by hand with :class:`swarmsim.Stepper`. The names below are loaded when they are first used, so that
importing swarmsim is quick.
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

# XLA logs an error for every program that it loads from the compilation cache, though nothing is wrong: it compares
# tuning preferences (prefer-no-gather) with the processor's features. Whoever wants its log sets the variable.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

if TYPE_CHECKING:
    from swarmsim.config.errors import InputError
    from swarmsim.config.scenario import load_scenario as load
    from swarmsim.missions.extract import mission_record
    from swarmsim.missions.record import MissionRecord
    from swarmsim.missions.rollout import MissionBatch, Simulation
    from swarmsim.missions.run import build, run
    from swarmsim.missions.stepping import Command, Observation, Stepper, TeamState
    from swarmsim.policies import register as register_policy

_HOMES = {
    "Command": ("swarmsim.missions.stepping", "Command"),
    "InputError": ("swarmsim.config.errors", "InputError"),
    "MissionBatch": ("swarmsim.missions.rollout", "MissionBatch"),
    "MissionRecord": ("swarmsim.missions.record", "MissionRecord"),
    "Observation": ("swarmsim.missions.stepping", "Observation"),
    "Simulation": ("swarmsim.missions.rollout", "Simulation"),
    "Stepper": ("swarmsim.missions.stepping", "Stepper"),
    "TeamState": ("swarmsim.missions.stepping", "TeamState"),
    "build": ("swarmsim.missions.run", "build"),
    "load": ("swarmsim.config.scenario", "load_scenario"),
    "mission_record": ("swarmsim.missions.extract", "mission_record"),
    "register_policy": ("swarmsim.policies", "register"),
    "run": ("swarmsim.missions.run", "run"),
}

__all__ = [
    "Command",
    "InputError",
    "MissionBatch",
    "MissionRecord",
    "Observation",
    "Simulation",
    "Stepper",
    "TeamState",
    "build",
    "load",
    "mission_record",
    "register_policy",
    "run",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its home when it is first asked for."""
    if name not in _HOMES:
        raise AttributeError(f"module 'swarmsim' has no attribute {name!r}")
    module, attribute = _HOMES[name]
    return getattr(importlib.import_module(module), attribute)
