"""Names that must name something: what a mission, a vehicle and a detector refer to."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarmsim.config import files
from swarmsim.config.allowed import item
from swarmsim.config.documents import Document, Place
from swarmsim.config.errors import PROBLEMS_MAX, InputError, Problem, raise_if_any
from swarmsim.config.load import load_named, read_document
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.radiation import Detector
from swarmsim.config.sensors import AnySensor
from swarmsim.config.vehicles import Multirotor, SkidSteer

if TYPE_CHECKING:
    from swarmsim.config.mission import Mission

Wanted = tuple[Place, str, str]
"""Where a reference stands, what refers to what, as the beginning of a sentence, and the name."""


def check_references(document: Document, near: Path | None) -> list[Problem]:
    """Names in a mission's document that name nothing: site, vehicle types, nuclides.

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
            if len(problems) > PROBLEMS_MAX:
                return
            allowed, hint = one_of(known), did_you_mean(value, known)
            problems.append(document.problem(place, f"there is no {what} '{value}'", allowed=allowed, suggestion=hint))

    check("site", ("site",), files.available("sites", near))
    types, nuclides = known_names(data, "vehicles", near), known_names(data, "nuclides", near)
    for i in _indices(item(data, "vehicles")):
        check("vehicle type", ("vehicles", i, "type"), types)
    for i in _indices(item(data, "sources")):
        check("nuclide", ("sources", i, "nuclide"), nuclides)
    named = item(item(data, "knowledge"), "nuclides")
    for i in _indices(named if isinstance(named, list | tuple) else None):
        check("nuclide", ("knowledge", "nuclides", i), nuclides)
    return problems


def known_names(data: Any, kind: str, near: Path | None) -> list[str]:
    """Names of a kind that a mission may use: its own definitions, and what the configuration folders hold."""
    definitions = item(data, "definitions")
    own = item(definitions, kind)
    names = set(own) if isinstance(own, dict) else set()
    if item(definitions, "complete") is not True:
        names |= set(files.available(kind, near))
    return sorted(names)


def missing(problem: Callable[..., Problem], wanted: Iterable[Wanted], known: Collection[str]) -> Iterator[Problem]:
    """A ``problem(place, message, ...)`` for each of the ``wanted`` names that is not ``known``."""
    for place, refers, name in wanted:
        if name not in known:
            message, hint = f"{refers} '{name}' that does not exist", did_you_mean(name, known)
            yield problem(place, message, allowed=one_of(known), suggestion=hint)


def parts_of(vehicle: Multirotor | SkidSteer, name: str) -> dict[str, list[Wanted]]:
    """What a vehicle type refers to, by its kind; places are those in the vehicle's file."""
    carries, mount = f"the vehicle type '{name}' carries a", vehicle.detector
    return {
        "detectors": [] if mount is None else [(("detector", "model"), f"{carries} detector", mount.model)],
        "sensors": [(("sensors", k), f"{carries} sensor", sensor) for k, sensor in enumerate(vehicle.sensors)],
    }


def materials_of(detector: Detector) -> list[Wanted]:
    """The materials that a detector is made of; places are those in the detector's file."""
    made = f"the detector '{detector.name}' is made of a material"
    crystal: list[Wanted] = [] if detector.crystal is None else [(("crystal",), made, detector.crystal)]
    return [*crystal, (("housing", "material"), made, detector.housing.material)]


def check_carried(
    mission: Mission, vehicles: Sequence[Multirotor | SkidSteer], document: Document, near: Path | None
) -> list[Problem]:
    """Vehicle types (``vehicles``: of each entry of ``mission.vehicles``) with a detector or sensor that there is not.

    Each type is told once, at the first vehicle of it.
    """
    first: dict[str, tuple[int, Multirotor | SkidSteer]] = {}
    for i, (member, vehicle) in enumerate(zip(mission.vehicles, vehicles, strict=True)):
        first.setdefault(member.type, (i, vehicle))
    problems: list[Problem] = []
    for kind in ("detectors", "sensors"):
        known = known_names(document.data, kind, near)
        for name, (i, vehicle) in first.items():
            wanted = [(("vehicles", i, "type"), who, part) for _, who, part in parts_of(vehicle, name)[kind]]
            problems += missing(document.problem, wanted, known)
    return problems


def sensors_twice(vehicle: Multirotor | SkidSteer, sensors: Mapping[str, AnySensor]) -> list[str]:
    """A sentence for each sensor of a vehicle that is the second of its kind."""
    first: dict[str, str] = {}
    told = []
    for name in vehicle.sensors:
        kind = sensors[name].kind
        if kind in first:
            told.append(f"'{vehicle.name}' carries two sensors of the kind {kind}: '{first[kind]}' and '{name}'")
        first.setdefault(kind, name)
    return told


def _of_body(document: Document, problem: Problem) -> Problem:
    """What is wrong with a body's file, told where the vehicle's file names it."""
    hint = problem.suggestion or "mend the body's file, or name another one"
    place = ("body", "file")
    return document.problem(place, problem.message, given=problem.file, allowed=problem.allowed, suggestion=hint)


def load_vehicle(path: Path) -> Multirotor | SkidSteer:
    """The vehicle of a file; raises `InputError` with what is wrong with it and with the parts that it carries."""
    vehicle: Multirotor | SkidSteer = load_named("vehicles", path)
    document = read_document(path, "vehicles")
    parts = parts_of(vehicle, vehicle.name)
    known = {kind: files.available(kind, path) for kind in parts}
    raise_if_any([fault for kind, wanted in parts.items() for fault in missing(document.problem, wanted, known[kind])])
    for _, _, name in parts["detectors"]:
        load_detector(known["detectors"][name])
    told = sensors_twice(vehicle, {name: load_named("sensors", name, path) for _, _, name in parts["sensors"]})
    raise_if_any([document.problem(("sensors",), sentence) for sentence in told])
    if vehicle.body is not None:
        from swarmsim.vehicles.bodies import read_rover_body, with_file_body

        try:
            if isinstance(vehicle, SkidSteer):
                read_rover_body(vehicle.body)
            else:
                with_file_body(vehicle)
        except InputError as error:
            problems = [_of_body(document, problem) for problem in error.problems]
            raise InputError(problems) from error
    return vehicle


def load_detector(path: Path) -> Detector:
    """The detector of a file; raises `InputError` with what is wrong with it and with its materials."""
    detector: Detector = load_named("detectors", path)
    known, wanted = files.available("materials", path), materials_of(detector)
    raise_if_any([*missing(read_document(path, "detectors").problem, wanted, known)])
    for _, _, name in wanted:
        load_named("materials", known[name], path)
    return detector


def _indices(value: Any) -> range:
    return range(len(value)) if isinstance(value, list) else range(0)
