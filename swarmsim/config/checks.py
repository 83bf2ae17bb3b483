"""What no single field can tell: names that must exist, and parts of a scenario that must fit together."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from swarmsim.config import files
from swarmsim.config.allowed import item
from swarmsim.config.documents import Document, Place
from swarmsim.config.errors import Problem
from swarmsim.config.mission import Mission
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.radiation import Detector, Material
from swarmsim.config.site import SiteSpec
from swarmsim.config.vehicles import Multirotor, SkidSteer

Vehicles = Sequence[Multirotor | SkidSteer]


def check_references(document: Document, near: Path | None) -> list[Problem]:
    """Names in a mission's document that name nothing: site, vehicle types, nuclides, policies.

    Works on the plain data, so that wrong names are told together with wrong values; values of a wrong type are left to
    the validation.
    """
    data = document.data
    problems: list[Problem] = []

    def check(what: str, place: Place, known: Iterable[str]) -> None:
        value: Any = data
        for step in place:
            value = item(value, step)
        if isinstance(value, str) and value not in (known := list(known)):
            allowed, hint = one_of(known), did_you_mean(value, known)
            problems.append(document.problem(place, f"there is no {what} '{value}'", allowed=allowed, suggestion=hint))

    check("site", ("site",), files.available("sites", near))
    types, nuclides = known_names(data, "vehicles", near), known_names(data, "nuclides", near)
    for i in _indices(item(data, "vehicles")):
        check("vehicle type", ("vehicles", i, "type"), types)
    for i in _indices(item(data, "sources")):
        check("nuclide", ("sources", i, "nuclide"), nuclides)
    check("nuclide", ("localisation", "presumed_nuclide"), nuclides)
    for kind in ("aerial", "ground"):
        if isinstance(item(item(data, kind), "policy"), str):
            check(f"{kind} policy", (kind, "policy"), policy_names(kind))
    return problems


def known_names(data: Any, kind: str, near: Path | None) -> list[str]:
    """Names of a kind that a mission may use: its own definitions, and what the configuration folders hold."""
    definitions = item(data, "definitions")
    own = item(definitions, kind)
    names = set(own) if isinstance(own, dict) else set()
    if item(definitions, "complete") is not True:
        names |= set(files.available(kind, near))
    return sorted(names)


def policy_names(kind: str) -> list[str]:
    """Names of the registered policies of a kind, ``aerial`` or ``ground``."""
    from swarmsim import policies  # costs the import of jax

    return policies.names(kind)


def check_detectors(mission: Mission, vehicles: Vehicles, document: Document, near: Path | None) -> list[Problem]:
    """Vehicles without a detector, or with one that does not exist."""
    known = known_names(document.data, "detectors", near)
    problems = []
    for i, (member, vehicle) in enumerate(zip(mission.vehicles, vehicles, strict=True)):
        place: Place = ("vehicles", i, "type")
        if vehicle.detector is None:
            message = f"the vehicle type '{member.type}' carries no detector, and every vehicle must measure"
            hint = "give its file a 'detector', or choose another type"
            problems.append(document.problem(place, message, given=member.type, suggestion=hint))
        elif (name := vehicle.detector.model) not in known:
            message = f"the vehicle type '{member.type}' carries a detector '{name}' that does not exist"
            problems.append(
                document.problem(place, message, allowed=one_of(known), suggestion=did_you_mean(name, known))
            )
    return problems


def check_consistency(
    mission: Mission,
    vehicles: Vehicles,
    detectors: Mapping[str, Detector],
    materials: Mapping[str, Material],
    site: SiteSpec,
    document: Document,
) -> list[Problem]:
    """Everything that the parts of a scenario get wrong together, in the order of the mission's file."""
    return [
        *_check_definitions(mission, document),
        *_check_materials(detectors, materials, site, document),
        *_check_team(mission, vehicles, document),
        *_check_starts(mission, vehicles, document),
        *_check_speeds(mission, vehicles, document),
    ]


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


def _indices(value: Any) -> range:
    return range(len(value)) if isinstance(value, list) else range(0)


def _check_definitions(mission: Mission, document: Document) -> Iterator[Problem]:
    for kind in ("vehicles", "detectors", "nuclides", "materials"):
        for key, model in getattr(mission.definitions, kind).items():
            if model.name != key:
                place: Place = ("definitions", kind, key, "name")
                yield document.problem(
                    place, "the name inside differs from the key above it", given=model.name, allowed=key
                )


def _check_materials(
    detectors: Mapping[str, Detector], materials: Mapping[str, Material], site: SiteSpec, document: Document
) -> Iterator[Problem]:
    wanted = [("site", f"the site '{site.name}' is made of", name) for name in _site_materials(site)]
    for detector in detectors.values():
        for name in (detector.crystal, detector.housing.material):
            wanted.append(("vehicles", f"the detector '{detector.name}' is made of", name))
    for where, who, name in wanted:
        if name not in materials:
            message, hint = f"{who} a material '{name}' that does not exist", did_you_mean(name, materials)
            yield document.problem((where,), message, allowed=one_of(materials), suggestion=hint)


def _site_materials(site: SiteSpec) -> list[str]:
    return sorted({site.ground_material, site.default_material, *(obstacle.material for obstacle in site.obstacles)})


def _check_team(mission: Mission, vehicles: Vehicles, document: Document) -> Iterator[Problem]:
    first: dict[str, int] = {}
    for i, member in enumerate(mission.vehicles):
        if member.name in first:
            message = f"vehicles.{first[member.name]} has the same name: names must differ"
            yield document.problem(("vehicles", i, "name"), message, given=member.name)
        first.setdefault(member.name, i)
    if not any(isinstance(vehicle, Multirotor) for vehicle in vehicles):
        types = ", ".join(member.type for member in mission.vehicles)
        message = "the team has no multirotor, and the survey needs at least one"
        yield document.problem(("vehicles",), message, given=types, suggestion="add a vehicle of a multirotor type")
    rovers = [i for i, vehicle in enumerate(vehicles) if isinstance(vehicle, SkidSteer)]
    for i in rovers[1:]:
        message = f"the team has more than one rover: '{mission.vehicles[rovers[0]].name}' is one already"
        yield document.problem(("vehicles", i), message, given=mission.vehicles[i].name, allowed="at most one rover")


def _check_starts(mission: Mission, vehicles: Vehicles, document: Document) -> Iterator[Problem]:
    for i, j in combinations(range(len(vehicles)), 2):
        one, other = mission.vehicles[i], mission.vehicles[j]
        apart = math.dist(one.position_m, other.position_m)
        needed = footprint_radius_m(vehicles[i]) + footprint_radius_m(vehicles[j])
        if apart < needed:
            yield document.problem(
                ("vehicles", j, "position_m"),
                f"'{other.name}' starts on top of '{one.name}': their centres are {apart:.2f} m apart",
                given=str(list(other.position_m)),
                allowed=f"at least {needed:.2f} m from {list(one.position_m)}",
            )


def _check_speeds(mission: Mission, vehicles: Vehicles, document: Document) -> Iterator[Problem]:
    aerial, ground = mission.aerial, mission.ground
    told = set()
    for member, vehicle in zip(mission.vehicles, vehicles, strict=True):
        limits: list[tuple[Place, float, float, str]]
        if isinstance(vehicle, Multirotor):
            climb = vehicle.control.climb_rate_max_m_s
            limits = [
                (("aerial", "speed_m_s"), aerial.speed_m_s, vehicle.control.speed_max_m_s, "can fly"),
                (("aerial", "climb_speed_m_s"), aerial.climb_speed_m_s, climb, "can climb"),
                (("aerial", "descent_speed_m_s"), aerial.descent_speed_m_s, climb, "can descend"),
                (("aerial", "touchdown_speed_m_s"), aerial.touchdown_speed_m_s, vehicle.impact_speed_max_m_s, "lands"),
            ]
        else:
            fastest = min(vehicle.control.speed_max_m_s, vehicle.motor.speed_max_rad_s * vehicle.wheels.radius_m)
            limits = [(("ground", "speed_m_s"), ground.speed_m_s, fastest, "can drive")]
        for place, value, limit, verb in limits:
            if value > limit and (place, member.type) not in told:
                told.add((place, member.type))
                message = f"is faster than the vehicle type '{member.type}' {verb}"
                if verb == "lands":
                    message = f"is a crash for the vehicle type '{member.type}'"
                yield document.problem(place, message, given=f"{value:g}", allowed=f"at most {limit:g}")
