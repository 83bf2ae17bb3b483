"""Fly a scenario and leave a run behind: what ``swarmsim run`` does, and what scripts call."""

import os
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from numbers import Integral
from pathlib import Path

from swarmsim.atomic_folder import claimed
from swarmsim.config.errors import InputError, raise_if_any
from swarmsim.config.files import SHOWN
from swarmsim.config.scenario import Scenario
from swarmsim.config.site_checks import check_site
from swarmsim.results.extract import mission_record
from swarmsim.results.out_folder import check_out, check_space, told_of
from swarmsim.results.record import MissionRecord
from swarmsim.results.summary import Timings
from swarmsim.runtime.progress import Progress, SilentProgress
from swarmsim.runtime.simulation import MissionBatch, Simulation
from swarmsim.site import load_site


def build(scenario: Scenario) -> Simulation:
    """Load the scenario's site, check the scenario against it, and build what flies it.

    No setting of the process is changed (see `swarmsim.use_all_cores`). Raises `InputError` with everything that is
    wrong.
    """
    _check_scenario(scenario, "swarmsim.build(swarmsim.load('recon'))")
    site_model = load_site(
        scenario.site_file, tuple(scenario.materials), [m.density_kg_m3 for m in scenario.materials.values()]
    )
    raise_if_any(check_site(scenario, site_model))
    simulation = Simulation(scenario, site_model)
    simulation.check_family()
    return simulation


def run(
    scenario: Scenario, out: Path | str, missions: int = 1, progress: Progress | None = None, *, force: bool = False
) -> tuple[MissionRecord, ...]:
    """Fly ``missions`` missions (seeds N, N + 1, …) in one batch and write the run to ``out``, complete or not at all.

    Raises `InputError` for a scenario that cannot be flown, where ``out`` exists and ``force`` is not given, where
    another run is being written there, and where there is too little room on the disk. When writing fails after the
    flight, the results are kept in a temporary place, which the error tells.
    """
    _check_scenario(scenario, "swarmsim.run(swarmsim.load('recon'), 'out')")
    if not isinstance(out, str | os.PathLike):
        raise InputError.of("the folder of a run is named by a text or a path", path="out", given=repr(out)[:SHOWN])
    if not isinstance(missions, Integral) or isinstance(missions, bool) or missions < 1:
        raise InputError.of("a run has one mission or more", path="missions", given=repr(missions)[:SHOWN])
    out = Path(out)
    check_out(out, force)
    check_space(out)
    with told_of(out), claimed(out):
        return _flown(scenario, out, missions, progress or SilentProgress(), force)


def _check_scenario(scenario: object, call: str) -> None:
    if not isinstance(scenario, Scenario):
        raise InputError.of("is no scenario", given=repr(scenario)[:SHOWN], suggestion=f"load it first: {call}")


def _flown(scenario: Scenario, out: Path, missions: int, tell: Progress, force: bool) -> tuple[MissionRecord, ...]:
    # Arrow, Matplotlib and Rerun, which write the run, take two seconds to import: meanwhile the mission flies.
    with ThreadPoolExecutor(1) as thread:
        writer = thread.submit(import_module, "swarmsim.results.run_directory")
        tell.phase("load the site", 0.0)
        simulation = build(scenario)
        first = scenario.mission.seed
        batch = simulation.rollout(range(first, first + missions), progress=tell)
        records = tuple(mission_record(simulation, batch, index) for index in range(missions))
        tell.phase("write", 0.0)
        writer.result().write_run(simulation, records, out, timings_of(batch), force=force, keep=True)
    return records


def timings_of(batch: MissionBatch) -> Timings:
    """Wall times of a rollout."""
    return Timings(compile_s=batch.clock.compile_s, run_s=batch.clock.run_s)
