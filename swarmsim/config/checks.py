"""What no single field can tell: parts of a scenario that must fit together."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from swarmsim.config import files
from swarmsim.config.documents import Document, Place
from swarmsim.config.errors import Problem, first_problems
from swarmsim.config.load import read_document
from swarmsim.config.mission import TEAM_MAX, Mission
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.phases import check_phases
from swarmsim.config.radiation import CRYSTAL_MAX_KEV
from swarmsim.config.references import Wanted, materials_of, missing, sensors_twice
from swarmsim.config.site import SiteSpec
from swarmsim.config.sources import POINTS_MAX, points_of
from swarmsim.config.team import RESERVED, team_size
from swarmsim.config.vehicles import Multirotor, SkidSteer

if TYPE_CHECKING:
    from swarmsim.config.scenario import Scenario

AIR = "air"
PAIRS_MAX = 50_000  # of vehicles that start too near to each other: sorting all pairs of a large team takes seconds


def check_team_size(mission: Mission, document: Document) -> list[Problem]:
    """A team that is too large once its formations are expanded."""
    size = team_size(mission)
    if size <= TEAM_MAX:
        return []
    allowed = f"at most {TEAM_MAX} vehicles, those of formations included"
    return [document.problem(("vehicles",), "has too many vehicles", given=str(size), allowed=allowed)]


def check_consistency(scenario: Scenario) -> list[Problem]:
    """Everything that the parts of a scenario get wrong together, in the order of the mission's file."""
    checks = (
        _check_definitions,
        _check_sensors,
        _check_timing,
        _check_materials,
        _check_lines,
        _check_names,
        _check_sources,
        _check_pads,
        _check_estimates,
        check_phases,
    )
    return first_problems(problem for check in checks for problem in check(scenario))


def footprint_radius_m(vehicle: Multirotor | SkidSteer) -> float:
    """Radius of the circle that a vehicle covers on the ground."""
    if isinstance(vehicle, Multirotor):
        return vehicle.collision_radius_m
    length, width = vehicle.chassis_size_m[:2]
    wheels = vehicle.wheels
    return (
        math.hypot(max(length, wheels.wheel_base_m + 2 * wheels.radius_m), max(width, wheels.track_m + wheels.width_m))
        / 2
    )


def _check_definitions(scenario: Scenario) -> Iterator[Problem]:
    for kind in ("vehicles", "detectors", "sensors", "nuclides", "materials"):
        for key, model in getattr(scenario.mission.definitions, kind).items():
            if model.name != key:
                place: Place = ("definitions", kind, key, "name")
                yield scenario.problem(
                    place, "the name inside differs from the key above it", given=model.name, allowed=key
                )


def _check_sensors(scenario: Scenario) -> Iterator[Problem]:
    types = {vehicle.name: (entry, vehicle) for entry, vehicle in zip(scenario.entries, scenario.vehicles, strict=True)}
    for entry, vehicle in types.values():
        for told in sensors_twice(vehicle, scenario.sensors):
            suggestion = "leave one of them out: a vehicle has at most one of each kind"
            yield scenario.problem(("vehicles", entry, "type"), told, suggestion=suggestion)


def _check_timing(scenario: Scenario) -> Iterator[Problem]:
    timing = scenario.mission.timing
    whole = f"is not a whole number of control periods of {timing.control_period_s:g} s"
    for field in ("judge_period_s", "log_period_s", "decision_period_s"):
        period = getattr(timing, field)
        if nearest := _nearest_multiples(period, timing.control_period_s):
            yield scenario.problem(("timing", field), whole, given=f"{period:g}", allowed=nearest)
    for name, detector in scenario.detectors.items():
        if nearest := _nearest_multiples(detector.sample_period_s, timing.control_period_s):
            own = name in scenario.mission.definitions.detectors
            place: Place = ("definitions", "detectors", name) if own else ("timing",)
            yield scenario.problem(
                (*place, "sample_period_s" if own else "control_period_s"),
                f"the sample_period_s of the detector '{name}' {whole}",
                given=f"{detector.sample_period_s:g}",
                allowed=nearest,
                suggestion=f"change timing.control_period_s, or set definitions.detectors.{name}.sample_period_s",
            )
        elif detector.sample_period_s < timing.judge_period_s - 0.5 * timing.control_period_s:
            yield scenario.problem(
                ("timing", "judge_period_s"),
                f"the sample_period_s of {detector.sample_period_s:g} s of the detector '{name}' is shorter than "
                "timing.judge_period_s",
                given=f"{timing.judge_period_s:g}",
                allowed=f"at most {detector.sample_period_s:g}",
            )


def _nearest_multiples(period: float, unit: float) -> str | None:
    """The whole multiples of ``unit`` next to ``period`` in words, or None when it is one."""
    ratio = period / unit
    if round(ratio) >= 1 and abs(ratio - round(ratio)) <= 1e-6 * ratio:
        return None
    low = math.floor(ratio)
    near = [f"{count * unit:.6g}" for count in (low, low + 1) if count >= 1]
    return " or ".join(near)


def _check_materials(scenario: Scenario) -> Iterator[Problem]:
    site = scenario.site
    wanted: list[Wanted] = [(("definitions",), "what lies between obstacles is of a material", AIR)]
    made = f"the site '{site.name}' is made of a material"
    wanted += [(("site",), made, name) for name in _site_materials(site)]
    for detector in scenario.detectors.values():
        wanted += [(("vehicles",), who, name) for _, who, name in materials_of(detector)]
    for name in scenario.mission.background.surfaces:
        wanted.append((("background", "surfaces", name), "a surface is of a material", name))
    yield from missing(scenario.problem, wanted, scenario.materials)


def _check_lines(scenario: Scenario) -> Iterator[Problem]:
    """Lines that no crystal's response reaches: tables of a scintillator are made for every nuclide that there is."""
    if all(detector.crystal is None for detector in scenario.detectors.values()):
        return
    own = scenario.mission.definitions.nuclides
    known = files.available("nuclides", scenario.mission_file)
    for name, nuclide in scenario.nuclides.items():
        for k, line in enumerate(nuclide.lines):
            if line.energy_kev <= CRYSTAL_MAX_KEV:
                continue
            place: Place = ("lines", k, "energy_kev")
            message = "lies beyond the response of the team's scintillators"
            details = {"given": f"{line.energy_kev:g}", "allowed": f"at most {CRYSTAL_MAX_KEV:g}"}
            if name in own:
                yield scenario.problem(("definitions", "nuclides", name, *place), message, **details)
            else:
                yield read_document(known[name], "nuclides").problem(place, message, **details)


def _site_materials(site: SiteSpec) -> list[str]:
    return sorted({site.ground_material, site.default_material, *(obstacle.material for obstacle in site.obstacles)})


def _check_names(scenario: Scenario) -> Iterator[Problem]:
    first: dict[str, int] = {}
    for i, entry in enumerate(scenario.mission.vehicles):
        if entry.name in RESERVED:
            message = "is a word of its own under 'who' of a phase: choose another name"
            yield scenario.problem(("vehicles", i, "name"), message, given=entry.name)
    named = [(entry.name, i) for i, entry in enumerate(scenario.mission.vehicles) if entry.formation is not None]
    named += [(member.name, i) for member, i in zip(scenario.members, scenario.entries, strict=True)]
    told = set()
    for name, i in sorted(named, key=lambda pair: pair[1]):
        if name in first and (first[name], i) not in told:
            told.add((first[name], i))
            message = f"vehicles.{first[name]} has the same name: names must differ"
            yield scenario.problem(("vehicles", i, "name"), message, given=name)
        first.setdefault(name, i)


def _check_sources(scenario: Scenario) -> Iterator[Problem]:
    """Vehicles that are to carry a source and do not exist, and lines and areas that need too many points."""
    names, total = [member.name for member in scenario.members], 0
    for i, source in enumerate(scenario.mission.sources):
        if source.on is not None:
            if source.on not in names:
                message, hint = f"there is no vehicle '{source.on}'", did_you_mean(source.on, names)
                yield scenario.problem(("sources", i, "on"), message, allowed=one_of(names), suggestion=hint)
            continue
        try:
            count = len(points_of(source).share)
        except ValueError as error:
            count, told = POINTS_MAX + 1, str(error)
        else:
            told = str(count)
        total += count
        if total > POINTS_MAX:
            yield scenario.problem(
                ("sources", i, source.place_field),
                f"the {source.form} is too large to be computed as points {source.spacing:g} m apart",
                given=f"{told} points",
                allowed=f"at most {POINTS_MAX} of all sources of a mission",
                suggestion="set a larger spacing_m: half the distance at which detectors pass is near enough",
            )
            return


def _check_pads(scenario: Scenario) -> Iterator[Problem]:
    """Vehicles that start too near to each other; a pair of entries of ``vehicles`` is told once."""
    if len(scenario.members) < 2:
        return
    from scipy.spatial import KDTree

    gap = scenario.mission.traffic.pad_gap_m
    xy = np.array([member.position_m for member in scenario.members])
    radius = np.array([footprint_radius_m(vehicle) for vehicle in scenario.vehicles])
    pairs = KDTree(xy).query_pairs(2 * radius.max() + gap, output_type="ndarray")
    apart = np.linalg.norm(xy[pairs[:, 0]] - xy[pairs[:, 1]], axis=1)
    needed = radius[pairs].sum(axis=1) + gap
    near = np.flatnonzero(apart < needed - 1e-9)[:PAIRS_MAX]
    near = near[np.lexsort((pairs[near, 0], pairs[near, 1]))]
    entries = np.array(scenario.entries)[pairs[near]]
    _, first = np.unique(entries, axis=0, return_index=True)
    for k in near[np.sort(first)]:
        one, other = (scenario.members[int(index)] for index in pairs[k])
        yield scenario.problem(
            ("vehicles", scenario.entries[int(pairs[k, 1])], "position_m"),
            f"'{other.name}' starts too near to '{one.name}': their centres are {apart[k]:.2f} m apart",
            given=str(list(other.position_m)),
            allowed=f"at least {needed[k]:.2f} m from {list(one.position_m)} (both radii and traffic.pad_gap_m)",
        )


def _check_estimates(scenario: Scenario) -> Iterator[Problem]:
    """Sections that stand on one another: the map, the estimate from its hotspots, the nuclide at the estimate."""
    mission = scenario.mission
    if mission.mapping is not None and all(vehicle.detector is None for vehicle in scenario.vehicles):
        message = "there is nothing to map: no vehicle of the team carries a detector"
        yield scenario.problem(("mapping",), message, suggestion="leave it out, or give a vehicle type a detector")
    named = mission.knowledge.nuclides
    for k, name in enumerate(named if isinstance(named, tuple) else ()):
        if name in named[:k]:
            yield scenario.problem(("knowledge", "nuclides", k), "is named twice", given=name)
    if mission.localisation is not None and mission.mapping is None:
        message = "the estimate starts from the hotspots of the map, and the mission has no mapping"
        yield scenario.problem(("localisation",), message, suggestion="add mapping, or leave localisation out")
    at_work = {number for team in scenario.phase_members for number in team}
    carried = [scenario.vehicles[number].detector is not None for number in at_work]
    if mission.localisation is not None and mission.mapping is not None and at_work and not any(carried):
        message = "there is nothing to estimate sources from: no vehicle with a detector has a part in a phase"
        hint = "name one in a phase's who, or leave localisation out"
        yield scenario.problem(("localisation",), message, suggestion=hint)
    if mission.identification is not None and mission.localisation is None:
        message = "spectra are taken round the estimated source, and the mission has no localisation"
        yield scenario.problem(("identification",), message, suggestion="add localisation, or leave identification out")
    resolve = [detector.spectrometer is not None for detector in scenario.detectors.values()]
    if mission.identification is not None and resolve and not any(resolve):
        message = "nuclides cannot be told apart: no detector of the team resolves energies"
        suggestion = "give a vehicle type a scintillator, or leave identification out"
        yield scenario.problem(("identification",), message, given=", ".join(scenario.detectors), suggestion=suggestion)
