"""Fly a scenario and leave a run behind: what ``swarmsim run`` does, and what scripts call."""

import os
from pathlib import Path

import jax
import platformdirs

from swarmsim.config.errors import raise_if_any
from swarmsim.config.geometry import check_geometry
from swarmsim.config.scenario import Scenario
from swarmsim.missions.batching import use_all_cores
from swarmsim.missions.extract import mission_record
from swarmsim.missions.files import write_run
from swarmsim.missions.out_folder import check_out
from swarmsim.missions.progress import Progress, SilentProgress
from swarmsim.missions.record import MissionRecord
from swarmsim.missions.rollout import MissionBatch, Simulation
from swarmsim.missions.summary import Timings
from swarmsim.site import load_site


def keep_compiled() -> None:
    """Keep compiled programs in the user's cache folder, unless ``JAX_COMPILATION_CACHE_DIR`` says where else."""
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        folder = Path(platformdirs.user_cache_dir("swarmsim")) / "compiled"
        jax.config.update("jax_compilation_cache_dir", str(folder))
        # Small programs too: the hundred that build the world take two seconds to compile.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def build(scenario: Scenario) -> Simulation:
    """Load the scenario's site, check the scenario against it, and build what flies it.

    Raises `InputError` with everything that is wrong.
    """
    keep_compiled()
    use_all_cores()
    site_model = load_site(scenario.site_file, tuple(scenario.materials))
    raise_if_any(check_geometry(scenario, site_model))
    return Simulation(scenario, site_model)


def run(
    scenario: Scenario, out: Path, missions: int = 1, progress: Progress | None = None, *, force: bool = False
) -> tuple[MissionRecord, ...]:
    """Fly ``missions`` missions (seeds N, N + 1, …) in one batch and write the run to ``out``, whole or not at all.

    Raises `InputError` for a scenario that cannot be flown, and where ``out`` exists and ``force`` is not given.
    """
    tell = progress or SilentProgress()
    check_out(out, force)
    tell.phase("load the site", 0.0)
    simulation = build(scenario)
    batch = simulation.rollout(range(scenario.mission.seed, scenario.mission.seed + missions), tell)
    records = tuple(mission_record(simulation, batch, index) for index in range(missions))
    tell.phase("write", 0.0)
    write_run(records, scenario.to_yaml(), simulation.site_model, out, timings_of(batch), force=force)
    return records


def timings_of(batch: MissionBatch) -> Timings:
    """Wall times of a rollout."""
    return Timings(compile_s=batch.clock.compile_s, run_s=batch.clock.run_s)
