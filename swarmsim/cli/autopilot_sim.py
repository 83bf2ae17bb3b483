"""What ``swarmsim autopilot-sim`` does."""

import sys
from contextlib import closing
from typing import TYPE_CHECKING

from swarmsim.config.errors import InputError

if TYPE_CHECKING:
    from swarmsim.autopilot.standin.tilting import StickStandin
    from swarmsim.autopilot.standin.vehicle import Standin

LINKS = {"px4": "udpout:127.0.0.1:14540", "ardupilot": "tcpin:127.0.0.1:5760"}
"""Where each autopilot's own simulation offers its link to a companion computer."""
STICKS = ("ardrone2", "pelican")
"""Those that are flown by sticks."""
TOLD_EVERY_S, LATE_S = 0.2, 0.5


def run_stand_in(
    mission: str | None, vehicle: str | None, autopilot: str, link: str | None, system: int, speed: float, seed: int
) -> int:
    """Run the stand-in until Ctrl-C, which is its usual end, or until it dies; the exit code."""
    if autopilot in STICKS:
        return _run_sticks(mission, vehicle, autopilot, link, speed, seed)
    from swarmsim.autopilot.standin.body import SimulatedBody, scenario_alone
    from swarmsim.autopilot.standin.settings import load_settings
    from swarmsim.autopilot.standin.sockets import open_link
    from swarmsim.autopilot.standin.vehicle import Standin

    settings = load_settings(autopilot)
    default = settings.default.model_dump()
    scenario = scenario_alone(mission, vehicle, settings.step_s, default)
    wire = open_link(LINKS[autopilot] if link is None else link)
    try:
        sys.stderr.write("compiling …\n")
        body = SimulatedBody(scenario, seed)
        standin = Standin(body, settings, wire, system=system, speed=speed, seed=seed)
        name, kind = body.name, "copter" if body.flies else "rover"
        print(f"{name}: stand-in {autopilot} {kind}, system {system}, at {wire.address}; ends with Ctrl-C", flush=True)
        return _watched(standin)
    finally:
        wire.close()


def _run_sticks(
    mission: str | None, vehicle: str | None, autopilot: str, link: str | None, speed: float, seed: int
) -> int:
    """`run_stand_in` for the vehicles that are flown by sticks."""
    from swarmsim.autopilot.opening import ALLOWED, ArdroneAddress, parse
    from swarmsim.autopilot.settings import load_settings
    from swarmsim.autopilot.standin.ardrone import ArdroneStandin, ArdroneStandinSettings
    from swarmsim.autopilot.standin.body import SimulatedBody, scenario_alone
    from swarmsim.autopilot.standin.pelican import PelicanStandin, PelicanStandinSettings

    where = ArdroneAddress("127.0.0.1")
    if link is not None:
        given = parse(link)
        if autopilot == "pelican" or not isinstance(given, ArdroneAddress):
            message = "a pelican names its pseudo-terminal itself: leave --link out" if autopilot == "pelican" else None
            raise InputError.of(
                message or "an ardrone2 listens at UDP ports", path="--link", given=link, allowed=ALLOWED
            )
        where = given

    def body_of(step_s: float, default: dict[str, object]) -> SimulatedBody:
        scenario = scenario_alone(mission, vehicle, step_s, default)
        sys.stderr.write("compiling …\n")
        body = SimulatedBody(scenario, seed)
        if not body.flies:
            raise InputError.of(f"a {autopilot} flies", given=f"{body.name} drives")
        return body

    standin: ArdroneStandin | PelicanStandin
    if autopilot == "ardrone2":
        drone = load_settings("standin_ardrone2", ArdroneStandinSettings)
        ports = (where.commands or 5556, where.navdata or 5554)
        body = body_of(drone.step_s, drone.default.model_dump())
        standin = ArdroneStandin(body, drone, where.host, ports, speed)
    else:
        pelican = load_settings("standin_pelican", PelicanStandinSettings)
        body = body_of(pelican.step_s, pelican.default.model_dump())
        standin = PelicanStandin(body, pelican, speed=speed)
    with closing(standin):
        print(f"{body.name}: stand-in {autopilot}, at {standin.address}; ends with Ctrl-C", flush=True)
        return _watched(standin)


def _watched(standin: "Standin | StickStandin") -> int:
    """Run, and print what changes."""
    told, logged, warned = "", 0, False
    with standin:
        while not standin.wait(TOLD_EVERY_S):
            now = f"{standin.mode}, {'armed' if standin.armed else 'disarmed'}"
            if now != told:
                print(f"{standin.time_s:8.1f} s  {now}", flush=True)
                told = now
            if standin.lateness_s > LATE_S and not warned:
                print("this machine is too slow for --speed: simulated time lags behind", flush=True)
                warned = True
            news = standin.log[logged:]
            logged += len(news)
            for sentence in news:
                print(f"{standin.time_s:8.1f} s  {sentence}", flush=True)
    for sentence in standin.log[logged:]:
        print(f"{standin.time_s:8.1f} s  {sentence}", flush=True)
    return standin.exit_code or 0
