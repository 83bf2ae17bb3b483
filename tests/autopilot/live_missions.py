"""The missions that flights in real time are part of: recon with vehicles of one kind, which compile in half the time.

Both kinds together are flown by `test_fly` and by the tests of `LiveMission`. The files share these programs.
"""

import swarmsim
from swarmsim.runtime.live import LiveMission

PLAIN = ("engine=analytic", "mapping=null", "localisation=null", "identification=null")
UAVS = (
    "vehicles=[{name: uav1, type: tarot_t650, position_m: [-74, -42]}, "
    "{name: uav2, type: tarot_t650, position_m: [-74, 0]}]"
)
ROVER = "vehicles=[{name: orpheus, type: orpheus, position_m: [-74, -56]}]"


def prepared(vehicle: str, team: str, phases: str) -> LiveMission:
    """A mission without estimates whose programs are compiled, with one vehicle outside."""
    mission = LiveMission(swarmsim.build(swarmsim.load("recon", [*PLAIN, team, f"phases=[{phases}]"])), 0, vehicle)
    mission.prepare()
    return mission
