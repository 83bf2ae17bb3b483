"""Commands that speak to autopilots."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from swarmsim.cli.app import SEED_END, command, whole


@command
def fly(
    scenario: str,
    *,
    vehicle: str,
    link: str = "udpin:127.0.0.1:14540",
    profile: Literal["px4", "ardupilot", "ardrone2", "pelican", "auto"] = "auto",
    system: Annotated[int | None, Parameter(validator=Number(gte=1, lte=255), converter=whole)] = None,
    seed: Annotated[int | None, Parameter(validator=Number(gte=0, lt=SEED_END), converter=whole)] = None,
    out: Path | None = None,
    overrides: Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False)] = (),
    signing_key: Path | None = None,
    recover: Literal["land", "return"] | None = None,
    dry_run: bool = False,
    live: bool = False,
    live_url: str | None = None,
    force: bool = False,
    manual: Literal["keyboard", "gamepad"] | None = None,
) -> int:
    """Fly one vehicle of a mission on a real autopilot; the others are simulated around it.

    For example:
        swarmsim fly recon --vehicle uav1 --dry-run
        swarmsim fly recon --vehicle uav1 --link udpin:127.0.0.1:14540
        swarmsim fly recon --vehicle uav1 --link serial:/dev/ttyUSB0:57600 --profile ardupilot
        swarmsim fly recon --vehicle uav1 --link ardrone:192.168.1.1
        swarmsim fly recon --vehicle uav1 --link pelican:/dev/ttyUSB0
        swarmsim fly recon --vehicle uav1 --recover land
        swarmsim fly recon --vehicle uav1 --live
        swarmsim fly recon --vehicle uav1 --link sim: --manual keyboard

    How it flies (limits, watchdogs, what it does at the end) stands under 'autopilot' in the mission. Ctrl-C ends the
    flight as autopilot.at_end says. An operator who changes the mode takes over for good.

    With --manual the mission begins as without it. The space bar (A on a gamepad) takes the vehicle over at once, also
    before it has taken off, and hands it back: the mission goes on from where it is, and the other vehicles meanwhile.
    Arrows move it, w and s climb and sink, a and d turn, h holds, l lands, r returns; + and - change the speed. A key
    counts while it repeats: without keys the vehicle stops and holds. Speeds and keys: autopilot.manual in the mission.

    Parameters
    ----------
    scenario
        Name of a mission, or a mission file.
    vehicle
        Name of the vehicle in the mission.
    link
        Where the autopilot is: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or
        serial:DEVICE:BAUD for PX4 and ArduPilot, ardrone:HOST for an AR.Drone 2.0, pelican:DEVICE for an AscTec
        Pelican. sim: is a vehicle simulated in this process, in real time.
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
    live
        Show the flight in the Rerun viewer of this desktop, which is opened if need be.
    live_url
        Show it in a Rerun viewer that runs elsewhere: rerun+http://HOST:PORT/proxy.
    force
        Replace earlier results.
    manual
        What a pilot may take the vehicle over with.
    """
    from swarmsim.cli.fly import fly_mission

    return fly_mission(
        scenario, vehicle, link, profile, system, seed, overrides, out, force, signing_key, recover, dry_run, live,
        live_url, manual,
    )  # fmt: skip


@command(name="autopilot-sim")
def autopilot_sim(
    scenario: str | None = None,
    *,
    vehicle: str | None = None,
    autopilot: Literal["px4", "ardupilot", "ardrone2", "pelican"] = "px4",
    link: str | None = None,
    system: Annotated[int, Parameter(name="--sysid", validator=Number(gte=1, lte=255), converter=whole)] = 1,
    speed: Annotated[float, Parameter(validator=Number(gte=0.1, lte=100))] = 1.0,
    seed: Annotated[int, Parameter(validator=Number(gte=0, lt=SEED_END), converter=whole)] = 0,
) -> int:
    """Stand in for a real autopilot: a vehicle that behaves as one with it does, over swarmsim's physics.

    For example:
        swarmsim autopilot-sim
        swarmsim autopilot-sim recon --vehicle uav1 --autopilot px4 --link udpout:127.0.0.1:14540
        swarmsim autopilot-sim recon --vehicle orpheus --autopilot ardupilot --link tcpin:127.0.0.1:5760
        swarmsim autopilot-sim --autopilot ardrone2 --link ardrone:127.0.0.1
        swarmsim autopilot-sim --autopilot pelican

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
        autopilot's own simulation. An ardrone2 listens at ardrone:HOST[:COMMANDS:NAVDATA], a pelican at a
        pseudo-terminal that it names.
    system
        Its MAVLink system id; 1 by default.
    speed
        Simulated seconds in a second; 1 by default.
    seed
        Of its wind and noise.
    """
    from swarmsim.cli.autopilot_sim import run_stand_in

    return run_stand_in(scenario, vehicle, autopilot, link, system, speed, seed)


@command
def sitl(
    scenario: str,
    *,
    autopilot: Literal["px4", "ardupilot"],
    vehicles: Annotated[int | None, Parameter(validator=Number(gte=1, lte=100), converter=whole)] = None,
    names: Annotated[tuple[str, ...], Parameter(name="--vehicle", consume_multiple=False)] = (),
    speed: Annotated[float, Parameter(validator=Number(gte=0, lte=100))] = 1.0,
    duration: Annotated[float, Parameter(validator=Number(gt=0))] = float("inf"),
    start: str | None = None,
    seed: Annotated[int | None, Parameter(validator=Number(gte=0, lt=SEED_END), converter=whole)] = None,
    out: Path | None = None,
    overrides: Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False)] = (),
    force: bool = False,
) -> int:
    """Be the physics of real autopilot firmware: vehicles of a mission in lockstep with PX4 or ArduPilot in software.

    For example:
        swarmsim sitl recon --autopilot px4
        swarmsim sitl recon --autopilot px4 --vehicles 3 --speed 2
        swarmsim sitl recon --autopilot ardupilot --vehicle uav1 --vehicle orpheus
        swarmsim sitl recon --autopilot px4 --start 'PX4_SIM_MODEL=none_iris ./px4 -d -i {instance} -w {folder} ./etc'

    The physics of vehicle k is at port 4560 + k (PX4, TCP) or 9002 + 10 k (ArduPilot, UDP, --model JSON). It runs until
    Ctrl-C. Fly the vehicles with 'swarmsim fly', or from any ground station.

    Parameters
    ----------
    scenario
        Name of a mission, or a mission file, with the site, the vehicles and the wind.
    autopilot
        Whose firmware it is.
    vehicles
        How many vehicles, from the first of the team; 1 by default.
    names
        This vehicle; may be given again and again, instead of --vehicles.
    speed
        Simulated seconds in a second, 0 for as fast as it goes; 1 by default.
    duration
        Simulated seconds after which it ends; by default it goes on until Ctrl-C.
    start
        Command that starts the firmware of one vehicle, with {instance}, {sysid}, {kind}, {folder}, {home} and {params}
        for what differs; by default that of SWARMSIM_PX4_SITL or SWARMSIM_ARDUPILOT_SITL, and without one the firmware
        is waited for.
    seed
        Seed of the mission, in the stead of its own.
    out
        Folder of the results; runs/NAME_sitl by default.
    overrides
        Change a value of the mission, as path=value; may be given again and again.
    force
        Replace an earlier session's results.
    """
    from swarmsim.cli.sitl import run_sitl

    return run_sitl(scenario, autopilot, names, vehicles, speed, duration, start, seed, overrides, out, force)


@command(name="replay-log")
def replay_log(
    file: Path,
    *,
    run: Path | None = None,
    mission: str | None = None,
    vehicle: str | None = None,
    seed: Annotated[int | None, Parameter(validator=Number(gte=0, lt=SEED_END), converter=whole)] = None,
    overrides: Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False)] = (),
    system: Annotated[int | None, Parameter(validator=Number(gte=1, lte=255), converter=whole)] = None,
    origin: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    out: Path | None = None,
    force: bool = False,
) -> None:
    """Read the log of a flight (.tlog, dataflash .bin, PX4 .ulg), and lay it over a mission's plan and simulation.

    For example:
        swarmsim replay-log flight.tlog
        swarmsim replay-log 00000001.BIN --mission recon --vehicle uav1
        swarmsim replay-log 10_31_07.ulg --run runs/recon_uav1
        swarmsim replay-log flight.tlog --system 2 --origin 49.2275,16.5747,280

    Prints and writes the errors; 'swarmsim view FOLDER' shows the tracks.

    Parameters
    ----------
    file
        The log.
    run
        Folder of a run of 'swarmsim fly' or 'swarmsim run', whose mission the flight is compared with.
    mission
        Name of a mission, or a mission file, that the flight is compared with.
    vehicle
        Vehicle of the mission that the log is of; by default the one that was flown in the run.
    seed
        Seed of the mission, in the stead of its own.
    overrides
        Change a value of the mission, as path=value; may be given again and again.
    system
        System id of the vehicle, where the log holds several.
    origin
        Place on the Earth of the mission's origin, LAT,LON,ALT in degrees and metres; by default the flight is laid
        over the mission where it began.
    out
        Folder of the results; runs/log_NAME by default.
    force
        Replace earlier results.
    """
    from swarmsim.cli.replay_log import replay_log as replay

    replay(file, run, mission, vehicle, seed, overrides, system, origin, out, force)
