"""What of a mission an autopilot flies: some of its vehicles on its site, without phases, detectors and failsafes."""

from collections.abc import Sequence

from swarmsim.config.flight import BatteryFailsafe, Failsafes, Fence, WindFailsafe
from swarmsim.config.mission import Definitions, Mission, Phase, Timing
from swarmsim.config.scenario import Scenario, scenario_of

_KEPT = ("site", "engine", "wind", "effects", "seed")


def bare_scenario(whole: Scenario, numbers: Sequence[int], name: str, timing: Timing) -> Scenario:
    """The vehicles ``numbers`` of a scenario under the same names, with the fields of the mission that move them.

    Its detectors, sources and failsafes are left out: those are the autopilot's, or the mission's that flies it.
    """
    members = tuple(whole.members[k].model_copy(update={"formation": None}) for k in numbers)
    types = {}
    for k in numbers:
        spec = whole.vehicles[k]
        cited = {place: text for place, text in spec.sources.items() if place.split(".")[0] != "detector"}
        types[whole.members[k].type] = spec.model_copy(update={"detector": None, "sources": cited})
    mission = Mission(
        name=name,
        sources=(),
        vehicles=members,
        timing=timing,
        phases=(Phase(name=name, who=tuple(m.name for m in members), policy="hold", time_limit_s=60.0),),
        failsafes=Failsafes(
            fence=Fence(action="none"), wind=WindFailsafe(action="none"), battery=BatteryFailsafe(action="none")
        ),
        definitions=Definitions(vehicles=types, sensors=dict(whole.sensors), materials=dict(whole.materials)),
        **{field: getattr(whole.mission, field) for field in _KEPT},
    )
    return scenario_of(mission, whole.mission_file)
