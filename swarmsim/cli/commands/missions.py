"""Commands that fly missions and show them."""

from datetime import datetime
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from swarmsim.cli.app import SEED_END, command, whole


@command
def run(
    scenario: str,
    *,
    out: Path | None = None,
    seed: Annotated[int | None, Parameter(validator=Number(gte=0, lt=SEED_END), converter=whole)] = None,
    missions: Annotated[int, Parameter(validator=Number(gte=1, lte=1_000_000), converter=whole)] = 1,
    overrides: Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False)] = (),
    force: bool = False,
    strict: bool = False,
) -> int:
    """Fly a mission, or many at once, and write the results.

    For example:
        swarmsim run recon
        swarmsim run configs/missions/recon.yaml --seed 7 --out runs/seven
        swarmsim run recon --missions 256
        swarmsim run recon --set phases.survey.settings.altitude_m=30 --set wind.speed_m_s=5
        swarmsim run random_recon --missions 256
        swarmsim run random_recon --seed 17 --set vary.wind.speed_m_s=null --set wind.speed_m_s=3
        swarmsim run runs/recon/scenario.yaml --out runs/again
        swarmsim run recon --strict

    Parameters
    ----------
    scenario
        Name of a mission (see 'swarmsim list missions') or path of a mission file.
    out
        Folder of the results; runs/NAME by default. It must not exist, unless --force is given.
    seed
        Seed of the (first) mission, instead of the one in the file.
    missions
        How many missions to fly in one batch, with seeds N, N+1, …; 1 by default.
    overrides
        Change a value of the mission, as path=value; may be given again and again. Items of a list are named by
        index or by their name, e.g. vehicles.uav1.heading_deg=90. What is drawn for every mission is set under
        vary, e.g. 'vary.wind.speed_m_s={uniform: [0, 5]}', or null to draw it no more.
    force
        Replace the results of an earlier run.
    strict
        End with 3 where a mission's status is neither located nor none, and it seeks sources. (2 is wrong input.)
    """
    from swarmsim.cli.run import run_scenario

    certain = run_scenario(scenario, out, seed, missions, overrides, force)
    return 3 if strict and not certain else 0


@command
def bench(
    scenario: str = "recon",
    *,
    missions: Annotated[int, Parameter(validator=Number(gte=2, lte=1_000_000), converter=whole)] = 64,
    fleet: Annotated[int, Parameter(validator=Number(gte=0, lte=100_000_000), converter=whole)] = 0,
    repeats: Annotated[int, Parameter(validator=Number(gte=1, lte=100), converter=whole)] = 2,
    overrides: Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False)] = (),
) -> None:
    """Measure how fast a scenario flies here: one mission, and a batch against it. Writes nothing.

    For example:
        swarmsim bench
        swarmsim bench recon --missions 256
        swarmsim bench recon --set engine=analytic
        swarmsim bench recon --fleet 1000000

    Parameters
    ----------
    scenario
        Name of a mission, or a mission file.
    missions
        How many missions the batch has; 64 by default.
    fleet
        Instead of missions, that many UAVs of the mission's first type, each under position control, with drag, feet
        and wind, and nothing else: physics steps per second.
    repeats
        Rollouts of which the fastest counts; 2 by default.
    overrides
        Change a value of the mission, as path=value.
    """
    from swarmsim.cli.run import bench_fleet, bench_scenario

    if fleet:
        bench_fleet(scenario, fleet, repeats, overrides)
    else:
        bench_scenario(scenario, missions, repeats, overrides)


@command
def view(run: Path, *, web: bool = False) -> None:
    """Open the recording of a run in the Rerun viewer.

    For example:
        swarmsim view runs/recon
        swarmsim view runs/recon --web

    Parameters
    ----------
    run
        Folder of a run, or an .rrd file.
    web
        Use the viewer in the browser instead of the desktop's.
    """
    from swarmsim.playback.viewer import open_recording

    open_recording(run, web)


@command
def draw(
    scenario: str,
    *,
    seed: Annotated[int | None, Parameter(validator=Number(gte=0, lt=SEED_END), converter=whole)] = None,
    missions: Annotated[int, Parameter(validator=Number(gte=1, lte=1000), converter=whole)] = 4,
    overrides: Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False)] = (),
) -> None:
    """Show what missions of a family draw (`vary` of a mission file), without flying them.

    For example:
        swarmsim draw random_recon
        swarmsim draw random_recon --seed 17 --missions 1
        swarmsim draw recon --set 'vary.wind.speed_m_s={uniform: [0, 5]}'

    Parameters
    ----------
    scenario
        Name of a mission, or a mission file.
    seed
        Seed of the first mission, instead of the one in the file.
    missions
        How many missions, with seeds N, N+1, …; 4 by default.
    overrides
        Change a value of the mission, as path=value.
    """
    from swarmsim.cli.files import print_draws

    print_draws(scenario, seed, missions, overrides)


@command(name="export-n42")
def export_n42(
    run: Path,
    *,
    out: Path | None = None,
    vehicles: Annotated[tuple[str, ...], Parameter(name="--vehicle", consume_multiple=False)] = (),
    start: datetime | None = None,
    force: bool = False,
) -> None:
    """Write what a run's detectors measured as ANSI N42.42-2012 documents, with a spectrum for every sample.

    For example:
        swarmsim export-n42 runs/recon
        swarmsim export-n42 runs/recon --vehicle orpheus --out orpheus_n42
        swarmsim export-n42 runs/recon --start 2026-05-04T09:30:00

    Parameters
    ----------
    run
        Folder of a run; of a batch its first mission is written.
    out
        Folder of the documents, one for each vehicle and one for the spectrum near the source; RUN/n42 by default. It
        must not exist, unless --force is given.
    vehicles
        Write the samples of this vehicle only; may be given again and again.
    start
        Date and time in UTC at which the mission began; 2000-01-01T00:00:00 by default.
    force
        Replace an earlier export.
    """
    from swarmsim.cli.export import export_run

    export_run(run, out, vehicles, start, force)
