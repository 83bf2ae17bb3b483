"""What ``swarmsim autopilot-sim`` does."""

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from swarmsim.autopilot.standin.vehicle import Standin

LINKS = {"px4": "udpout:127.0.0.1:14540", "ardupilot": "tcpin:127.0.0.1:5760"}
"""Where each autopilot's own simulation offers its link to a companion computer."""
TOLD_EVERY_S, LATE_S = 0.2, 0.5


def run_stand_in(
    mission: str | None, vehicle: str | None, autopilot: str, link: str | None, system: int, speed: float, seed: int
) -> int:
    """Run the stand-in until Ctrl-C, which is its usual end, or until it dies; the exit code."""
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


def _watched(standin: "Standin") -> int:
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
            news = standin.pilot.log[logged:]
            logged += len(news)
            for sentence in news:
                print(f"{standin.time_s:8.1f} s  {sentence}", flush=True)
    for sentence in standin.pilot.log[logged:]:
        print(f"{standin.time_s:8.1f} s  {sentence}", flush=True)
    return standin.exit_code or 0
