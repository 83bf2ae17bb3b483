"""swarmsim: a swarm simulator for research, in Python on JAX.

Load a scenario, build it, roll it out:

    import swarmsim
    simulation = swarmsim.build(swarmsim.load("recon"))
    batch = simulation.rollout(range(16))
    print(swarmsim.mission_record(simulation, batch, 0).finding)

or step its world by hand:

    world, state = simulation.world, simulation.reset(seed=0)
    state, readings = swarmsim.step(world, state, swarmsim.hold(world, state))

`step` is pure: `jax.jit`, `jax.vmap`, `jax.lax.scan` and `jax.grad` work on it. The names below are loaded when they
are first used, so that importing swarmsim is quick.
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

# XLA logs an error for every program that it loads from the compilation cache, though nothing is wrong: it compares
# tuning preferences (prefer-no-gather) with the processor's features. Whoever wants its log sets the variable.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# XLA's CPU runtime launches every fused loop by itself, and a control period of a few vehicles is hundreds of loops
# over three or four numbers. This lets it compile whole loops of the program into one function each, as it does by
# itself for those that touch less than 1 KiB: a mission then flies in half of the time. (Without any limit, a fleet of
# thousands takes a minute to compile.) XLA reads its flags when it is first used, so that swarmsim has to be imported
# before that; whoever sets these options keeps theirs.
_FLAGS = os.environ.get("XLA_FLAGS", "")
if "xla_backend_extra_options" not in _FLAGS:
    _WHOLE_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=100000000"
    os.environ["XLA_FLAGS"] = f"{_FLAGS} {_WHOLE_LOOPS}".strip()

if TYPE_CHECKING:
    from swarmsim.config.errors import InputError
    from swarmsim.config.policies import PolicySettings
    from swarmsim.config.scenario import load_scenario as load
    from swarmsim.config.sensors import Place
    from swarmsim.control.commands import (
        AttitudeCommand,
        BodyRateCommand,
        DriveCommand,
        DriveToCommand,
        PositionCommand,
        RotorSpeedCommand,
        WheelSpeedCommand,
        fly_velocity,
        go_to,
    )
    from swarmsim.policies.registry import register as register_policy
    from swarmsim.policies.view import Task, View
    from swarmsim.results.counted import read_counts
    from swarmsim.results.extract import mission_record
    from swarmsim.results.hand_stepped import Frame, observe, record_steps
    from swarmsim.results.n42 import write_n42
    from swarmsim.results.record import MissionRecord
    from swarmsim.results.run_directory import write_run
    from swarmsim.results.spectra import sample_spectra
    from swarmsim.runtime.devices import use_all_cores
    from swarmsim.runtime.run import build, run
    from swarmsim.runtime.simulation import MissionBatch, Simulation
    from swarmsim.world.model import World
    from swarmsim.world.sensing import fit_sensors, sense, switch_on
    from swarmsim.world.state import WorldState, mission_axes
    from swarmsim.world.step import hold, reset, step

_HOMES = {
    "config.errors": ("InputError",),
    "config.policies": ("PolicySettings",),
    "config.scenario": ("load_scenario",),
    "config.sensors": ("Place",),
    "control.commands": (
        "AttitudeCommand",
        "BodyRateCommand",
        "DriveCommand",
        "DriveToCommand",
        "PositionCommand",
        "RotorSpeedCommand",
        "WheelSpeedCommand",
        "fly_velocity",
        "go_to",
    ),
    "policies.registry": ("register",),
    "policies.view": ("Task", "View"),
    "results.counted": ("read_counts",),
    "results.extract": ("mission_record",),
    "results.hand_stepped": ("Frame", "observe", "record_steps"),
    "results.n42": ("write_n42",),
    "results.record": ("MissionRecord",),
    "results.run_directory": ("write_run",),
    "results.spectra": ("sample_spectra",),
    "runtime.devices": ("use_all_cores",),
    "runtime.run": ("build", "run"),
    "runtime.simulation": ("MissionBatch", "Simulation"),
    "world.model": ("World",),
    "world.sensing": ("fit_sensors", "sense", "switch_on"),
    "world.state": ("WorldState", "mission_axes"),
    "world.step": ("hold", "reset", "step"),
}
_SHORTER = {"load_scenario": "load", "register": "register_policy"}
_PLACES = {_SHORTER.get(name, name): (f"swarmsim.{home}", name) for home, names in _HOMES.items() for name in names}

__all__ = [
    "AttitudeCommand",
    "BodyRateCommand",
    "DriveCommand",
    "DriveToCommand",
    "Frame",
    "InputError",
    "MissionBatch",
    "MissionRecord",
    "Place",
    "PolicySettings",
    "PositionCommand",
    "RotorSpeedCommand",
    "Simulation",
    "Task",
    "View",
    "WheelSpeedCommand",
    "World",
    "WorldState",
    "build",
    "fit_sensors",
    "fly_velocity",
    "go_to",
    "hold",
    "load",
    "mission_axes",
    "mission_record",
    "observe",
    "read_counts",
    "record_steps",
    "register_policy",
    "reset",
    "run",
    "sample_spectra",
    "sense",
    "step",
    "switch_on",
    "use_all_cores",
    "write_n42",
    "write_run",
]


def __dir__() -> list[str]:
    return sorted({*globals(), *_PLACES})


def __getattr__(name: str) -> Any:
    """Load a public name from its home when it is first asked for."""
    if name not in _PLACES:
        raise AttributeError(f"module 'swarmsim' has no attribute {name!r}")
    module, attribute = _PLACES[name]
    return getattr(importlib.import_module(module), attribute)
