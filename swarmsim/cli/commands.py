"""The commands: thin, and quick to start. What they need is imported when they run."""

from collections.abc import Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter, Token
from cyclopts.validators import Number

SEED_END = 2**31

Kind = Literal["vehicles", "sites", "missions", "detectors", "nuclides", "materials", "policies"]
ModelKind = Literal["mission", "vehicle", "site", "detector", "nuclide", "material"]


def _whole(_: object, tokens: Sequence[Token]) -> int:
    """A whole number; cyclopts alone would round another one."""
    text = tokens[0].value
    if not text.lstrip("+-").isdecimal():
        raise ValueError(f"a whole number is needed, not '{text[:100]}'")
    return int(text[:100])


def _version() -> str:
    from swarmsim.versions import NOT_INSTALLED, package_versions

    version = package_versions(())["swarmsim"]
    return (
        "swarmsim, run from its source folder without being installed"
        if version == NOT_INSTALLED
        else f"swarmsim {version}"
    )


app = App(
    name="swarmsim",
    help="Simulate teams of aerial and ground robots, and their search for radioactive sources.",
    help_epilogue=(
        "Examples:\n"
        "    swarmsim run recon           fly the shipped mission, results in runs/recon\n"
        "    swarmsim view runs/recon     watch it in the Rerun viewer\n"
        "    swarmsim init my_project     copy the configurations out, to edit them\n"
        "    swarmsim list vehicles       what there is to build a team of\n\n"
        "'swarmsim COMMAND --help' says more of a command, with examples.\n"
        "Exit codes: 0 done, 2 wrong input (told on standard error), 3 a doubtful answer of 'run --strict',\n"
        "4 a flight that did not end as planned, 130 stopped with Ctrl-C, 143 by SIGTERM."
    ),
    version=_version,
    help_format="plaintext",
    suppress_keyboard_interrupt=False,
    default_parameter=Parameter(show_default=False, negative=""),
)


command = partial(app.command, help_epilogue="")  # the epilogue above belongs to the whole program


@command
def run(
    scenario: str,
    *,
    out: Path | None = None,
    seed: Annotated[int | None, Parameter(validator=Number(gte=0, lt=SEED_END), converter=_whole)] = None,
    missions: Annotated[int, Parameter(validator=Number(gte=1, lte=1_000_000), converter=_whole)] = 1,
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
        End with 3 where a mission's status is neither located nor none. (2 is wrong input.)
    """
    from swarmsim.cli.run import run_scenario

    certain = run_scenario(scenario, out, seed, missions, overrides, force)
    return 3 if strict and not certain else 0


@command
def bench(
    scenario: str = "recon",
    *,
    missions: Annotated[int, Parameter(validator=Number(gte=2, lte=1_000_000), converter=_whole)] = 64,
    fleet: Annotated[int, Parameter(validator=Number(gte=0, lte=100_000_000))] = 0,
    repeats: Annotated[int, Parameter(validator=Number(gte=1, lte=100), converter=_whole)] = 2,
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
def check(*paths: Path) -> None:
    """Validate configuration files of any kind, and tell everything that is wrong with them.

    For example:
        swarmsim check configs/missions/recon.yaml
        swarmsim check my_vehicle.yaml configs/nuclides/*.yaml
        swarmsim check configs

    Parameters
    ----------
    paths
        Files, or folders whose YAML files are all checked. What a file describes is told from its folder
        (missions, vehicles, sites …) or from its fields.
    """
    from swarmsim.cli.files import check_files

    check_files(paths)


@command
def draw(
    scenario: str,
    *,
    seed: Annotated[int | None, Parameter(validator=Number(gte=0, lt=SEED_END), converter=_whole)] = None,
    missions: Annotated[int, Parameter(validator=Number(gte=1, lte=1000), converter=_whole)] = 4,
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


@command
def schema(kind: ModelKind = "mission") -> None:
    """Print the JSON schema of a kind of configuration file, e.g. for an editor's completion.

    For example:
        swarmsim schema
        swarmsim schema vehicle > vehicle.schema.json

    Parameters
    ----------
    kind
        Which configuration file; mission by default.
    """
    from swarmsim.cli.files import print_schema

    print_schema(kind)


@command(name="list")
def list_(kind: Kind | None = None) -> None:
    """List what is available: vehicles, sites, missions, detectors, nuclides, materials and policies.

    For example:
        swarmsim list
        swarmsim list nuclides

    Parameters
    ----------
    kind
        List this kind only.
    """
    from swarmsim.cli.files import list_available

    list_available(kind)


@command
def init(folder: Path) -> None:
    """Copy the shipped configurations to FOLDER/configs, to be edited; names found there come before the shipped ones.

    For example:
        swarmsim init .
        swarmsim init my_project && cd my_project && swarmsim run recon

    Parameters
    ----------
    folder
        Where to put 'configs'; made if needed. An existing 'configs' is never overwritten.
    """
    from swarmsim.cli.files import copy_configurations

    copy_configurations(folder)


@command
def import_site(
    file: Path,
    *,
    out: Path,
    name: str | None = None,
    unit: Annotated[float | None, Parameter(validator=Number(gt=0))] = None,
    height_unit: Annotated[float | None, Parameter(validator=Number(gt=0))] = None,
    up: Literal["X", "Y", "Z"] | None = None,
    cell: Annotated[float | None, Parameter(validator=Number(gt=0))] = None,
    ground: Annotated[tuple[str, ...], Parameter(consume_multiple=False)] = (),
    plane: Annotated[float | None, Parameter(validator=Number(gt=0, lte=500))] = None,
    licence: str | None = None,
    overrides: Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False)] = (),
    guess: Annotated[bool, Parameter(negative="--no-guess")] = True,
    force: bool = False,
) -> None:
    """Turn a mesh (.dae, .obj, .glb, .stl) or an elevation model (GeoTIFF) into a site.

    For example:
        swarmsim import-site farm.dae --out configs/sites/farm
        swarmsim import-site yard.obj --out configs/sites/yard --unit 0.01 --up Y
        swarmsim import-site yard.glb --out configs/sites/yard --ground 'terrain*'
        swarmsim import-site alps.tif --out configs/sites/alps --cell 2
        swarmsim import-site house.dae --out configs/sites/house --plane 20
        swarmsim import-site scan.obj --out configs/sites/scan --set holes_max=0.3 --set default_material=brick

    Parameters
    ----------
    file
        The mesh or the elevation model.
    out
        Folder of the new site; its name is the site's name unless --name is given.
    name
        Name of the site.
    unit
        Metres of one unit of the file, where the file does not say or is wrong.
    height_unit
        Metres of one unit of the heights of an elevation model, where they differ from the file's or it does not say.
    up
        The axis of the file that points up, where the file does not say or is wrong.
    cell
        Size of the cells of the height maps, in metres.
    ground
        Pattern of the materials or geometries that are bare ground; may be given again and again.
    plane
        Lay level ground at height 0 under a model that has none, such as a building, and this far around it, in metres.
    licence
        Licence of the file, to be written into the site.
    overrides
        Any other field of site.yaml, as field=value (see 'swarmsim schema site'); may be given again and again.
    guess
        Guess materials from the names in the mesh (the default) and write them to site.yaml; --no-guess leaves it.
    force
        Replace an existing site.
    """
    from swarmsim.cli.sites import import_site_file

    given = {
        "unit_m": unit,
        "height_unit_m": height_unit,
        "up_axis": up,
        "ground": list(ground) or None,
        "plane": None if plane is None else {"margin_m": plane},
    }
    import_site_file(file, out, given, overrides, name, cell, licence, guess, force)


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


@command
def fly(
    scenario: str,
    *,
    vehicle: str,
    link: str = "udpin:127.0.0.1:14540",
    profile: Literal["px4", "ardupilot", "auto"] = "auto",
    system: Annotated[int | None, Parameter(validator=Number(gte=1, lte=255), converter=_whole)] = None,
    seed: Annotated[int | None, Parameter(validator=Number(gte=0, lt=SEED_END), converter=_whole)] = None,
    out: Path | None = None,
    overrides: Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False)] = (),
    signing_key: Path | None = None,
    recover: Literal["land", "return"] | None = None,
    dry_run: bool = False,
    force: bool = False,
) -> int:
    """Fly one vehicle of a mission on a real autopilot, PX4 or ArduPilot; the others are simulated around it.

    For example:
        swarmsim fly recon --vehicle uav1 --dry-run
        swarmsim fly recon --vehicle uav1 --link udpin:127.0.0.1:14540
        swarmsim fly recon --vehicle uav1 --link serial:/dev/ttyUSB0:57600 --profile ardupilot
        swarmsim fly recon --vehicle uav1 --recover land

    How it flies (limits, watchdogs, what it does at the end) stands under 'autopilot' in the mission. Ctrl-C ends the
    flight as autopilot.at_end says. An operator who changes the mode takes over for good.

    Parameters
    ----------
    scenario
        Name of a mission, or a mission file.
    vehicle
        Name of the vehicle in the mission.
    link
        Where the autopilot is: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or
        serial:DEVICE:BAUD.
    profile
        Which autopilot it is; auto (the default) takes what it says of itself.
    system
        System id of the vehicle, where several are on the link.
    seed
        Seed of the mission, in the stead of its own.
    out
        Folder of the results; runs/NAME_VEHICLE by default.
    overrides
        Change a value of the mission, as path=value; may be given again and again.
    signing_key
        File with the 32 bytes of a MAVLink 2 signing key.
    recover
        Fly no mission: have a vehicle that is under way land or return, and wait until it stands.
    dry_run
        Send nothing: print the setpoints that would be sent, as a table and on a map.
    force
        Replace earlier results.
    """
    from swarmsim.cli.fly import fly_mission

    return fly_mission(
        scenario, vehicle, link, profile, system, seed, overrides, out, force, signing_key, recover, dry_run
    )


@command(name="autopilot-sim")
def autopilot_sim(
    scenario: str | None = None,
    *,
    vehicle: str | None = None,
    autopilot: Literal["px4", "ardupilot"] = "px4",
    link: str | None = None,
    system: Annotated[int, Parameter(name="--sysid", validator=Number(gte=1, lte=255), converter=_whole)] = 1,
    speed: Annotated[float, Parameter(validator=Number(gte=0.1, lte=100))] = 1.0,
    seed: Annotated[int, Parameter(validator=Number(gte=0, lt=SEED_END), converter=_whole)] = 0,
) -> int:
    """Stand in for a real autopilot: a MAVLink vehicle that behaves as PX4 or ArduPilot do, over swarmsim's physics.

    For example:
        swarmsim autopilot-sim
        swarmsim autopilot-sim recon --vehicle uav1 --autopilot px4 --link udpout:127.0.0.1:14540
        swarmsim autopilot-sim recon --vehicle orpheus --autopilot ardupilot --link tcpin:127.0.0.1:5760

    It runs until Ctrl-C. Fly it with 'swarmsim fly', or from any ground station.

    Parameters
    ----------
    scenario
        Name of a mission, or a mission file, with the vehicle; without one a vehicle on level ground.
    vehicle
        Name of the vehicle in the mission; the first one by default.
    autopilot
        Whose behaviour it has; px4 by default.
    link
        Where it offers its link: udpout:HOST:PORT, udpin:HOST:PORT or tcpin:HOST:PORT; by default that of the
        autopilot's own simulation.
    system
        Its system id; 1 by default.
    speed
        Simulated seconds in a second; 1 by default.
    seed
        Of its wind and noise.
    """
    from swarmsim.cli.autopilot_sim import run_stand_in

    return run_stand_in(scenario, vehicle, autopilot, link, system, speed, seed)
