"""The phases of a mission: settings of their policies, and what no phase alone can tell."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarmsim.config.allowed import item
from swarmsim.config.documents import Document, Place, dotted
from swarmsim.config.errors import InputError, Problem, raise_if_any
from swarmsim.config.mission import PHASES_MAX, Trigger
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.policies import LandOn, Orbit, ParallelLines, PolicySettings, Waypoints
from swarmsim.config.validation import validate
from swarmsim.config.vehicles import VEHICLE_KINDS, Multirotor, SkidSteer

if TYPE_CHECKING:
    from swarmsim.config.scenario import Scenario
    from swarmsim.policies.answers import Answers

ESTIMATES = {"source": ("mapping", "localisation"), "hotspot": ("mapping",)}
"""Sections of a mission that an estimate comes from."""
NAMES_SHOWN = 30
CEILING_HINT = "fly lower, raise failsafes.fence.ceiling_m, or set failsafes.fence.action to none"


def read_settings(document: Document, near: Path | None) -> tuple[list[PolicySettings | None], list[Problem]]:
    """Validated settings of each phase (None where they are wrong), and the problems of policies and settings.

    Works on the plain data, so that these problems are told together with all others.
    """
    phases = item(document.data, "phases")
    settings: list[PolicySettings | None] = []
    problems: list[Problem] = []
    models = cache(partial(_model_of, near=near))  # looking for a policy that does not exist takes time
    for i, phase in enumerate(phases[:PHASES_MAX] if isinstance(phases, list) else ()):
        try:
            settings.append(_settings_of(document, i, phase, models))
        except InputError as error:
            settings.append(None)
            problems += error.problems
    return settings, problems


def _model_of(policy: str, near: Path | None) -> type[PolicySettings] | InputError:
    """The model of a policy's settings, or what is wrong with the policy."""
    from swarmsim.policies import registry

    try:
        return registry.settings_model(policy, near)
    except InputError as error:
        return error


def _settings_of(
    document: Document, index: int, phase: Any, models: Callable[[str], type[PolicySettings] | InputError]
) -> PolicySettings | None:
    policy, given = item(phase, "policy"), item(phase, "settings")
    if not isinstance(policy, str) or not policy:
        return None  # the validation of the mission tells it
    place: Place = ("phases", index, "policy")
    model = models(policy)
    if isinstance(model, InputError):
        raise InputError(
            document.problem(place, p.message, given=p.given, allowed=p.allowed, suggestion=p.suggestion)
            for p in model.problems
        ) from model
    if given is not None and not isinstance(given, dict):
        return None
    place = ("phases", index, "settings")
    marks = {p[len(place) :]: mark for p, mark in document.marks.items() if p[: len(place)] == place}
    around = document.mark(place)
    part = Document(dict(given or {}), marks if around is None else {(): around} | marks)
    from swarmsim.policies.answers import ask

    prefix = dotted(place)
    told: list[Problem] = []
    try:
        found = ask(policy, "a validator of the settings", partial(_validated, part, model, told))
    except InputError as error:
        raise InputError(document.problem(place, p.message, suggestion=p.suggestion) for p in error.problems) from None
    raise_if_any([dataclasses.replace(p, path=f"{prefix}.{p.path}" if p.path else prefix) for p in told])
    return found


def _validated(part: Document, model: type[PolicySettings], told: list[Problem]) -> PolicySettings | None:
    """The settings; None where they are wrong, with what is ``told`` of them."""
    try:
        found = validate(part, model)
    except InputError as error:
        told += error.problems
        return None
    if not isinstance(found, model):
        raise TypeError(f"a validator of {model.__name__} must return the settings, not {found!r}"[:200])
    return found


def check_phases(scenario: Scenario) -> Iterator[Problem]:
    """Names, order, team, estimates and speeds of the phases."""
    yield from _check_names(scenario)
    yield from _check_order(scenario)
    for i in range(len(scenario.mission.phases)):
        yield from _check_who(scenario, i)
        try:
            asked = _asked(scenario, i)
        except InputError as error:
            for told in error.problems:
                details = {"given": told.given, "allowed": told.allowed, "suggestion": told.suggestion}
                yield scenario.problem(("phases", i, "policy"), told.message, **details)
            continue
        yield from _check_kinds(scenario, i, asked)
        yield from _check_senses(scenario, i, asked)
        yield from _check_partners(scenario, i, asked)
        yield from _check_landing(scenario, i)
        yield from _check_needs(scenario, i, asked)
        yield from _check_speeds(scenario, i)
        yield from _check_height(scenario, i)


@dataclasses.dataclass(frozen=True)
class _Asked:
    """What the policy of a phase says of itself, and its settings of the phase."""

    kinds: tuple[str, ...]  # of vehicle that it can command
    senses: tuple[str, ...]  # kinds of sensor that it reads
    answers: Answers


def _asked(scenario: Scenario, i: int) -> _Asked:
    """Raises `InputError` where the policy's code fails, or answers with what is none."""
    from swarmsim.policies import registry
    from swarmsim.policies.answers import answers_of

    policy, near = scenario.mission.phases[i].policy, scenario.mission_file
    kinds = frozenset(scenario.vehicles[k].kind for k in scenario.phase_members[i])
    return _Asked(
        kinds=registry.vehicle_kinds(policy, near),
        senses=registry.senses(policy, near),
        answers=answers_of(scenario.settings[i], policy, kinds, VEHICLE_KINDS),
    )


def _check_names(scenario: Scenario) -> Iterator[Problem]:
    first: dict[str, int] = {}
    for i, phase in enumerate(scenario.mission.phases):
        if phase.name in first:
            message = f"phases.{first[phase.name]} has the same name: names must differ"
            yield scenario.problem(("phases", i, "name"), message, given=phase.name)
        first.setdefault(phase.name, i)


def _triggers(scenario: Scenario) -> Iterator[tuple[Place, int, Trigger]]:
    for i, phase in enumerate(scenario.mission.phases):
        yield ("phases", i, "start"), i, phase.start
        if phase.end is not None:
            yield ("phases", i, "end"), i, phase.end


def _check_order(scenario: Scenario) -> Iterator[Problem]:
    phases = scenario.mission.phases
    names = [phase.name for phase in phases]
    waits: dict[str, set[str]] = {name: set() for name in names}
    for place, i, trigger in _triggers(scenario):
        other = trigger.after
        if other is not None and other not in names:
            message, hint = f"there is no phase '{other}'", did_you_mean(other, names)
            yield scenario.problem((*place, "after"), message, allowed=one_of(names), suggestion=hint)
        elif other == names[i]:
            yield scenario.problem((*place, "after"), f"the phase '{other}' waits for its own end", given=other)
        elif other is not None:
            waits[names[i]].add(other)
    loop = _cycle(waits)
    if loop:
        i = names.index(loop[0])
        what = "start" if phases[i].start.after in loop else "end"
        yield scenario.problem(("phases", i, what, "after"), f"phases wait for each other: {' -> '.join(loop)}")
    elif all(phase.start.at_s is None for phase in phases):
        message = "every phase waits for another phase or a finding, so none can start"
        yield scenario.problem(("phases",), message, suggestion="let one start at a time: start: {at_s: 0}")
    for i, phase in enumerate(phases):
        if phase.end is None or phase.end.at_s is None or phase.start.at_s is None:
            continue
        start, end = phase.start.at_s + phase.start.delay_s, phase.end.at_s + phase.end.delay_s
        if end <= start:
            yield scenario.problem(
                ("phases", i, "end"), "ends before it starts", given=f"{end:g} s", allowed=f"later than {start:g} s"
            )


def _cycle(waits: dict[str, set[str]]) -> list[str]:
    """Names along a cycle, the first repeated at the end; empty when there is none."""
    done: set[str] = set()

    def visit(name: str, path: list[str]) -> list[str]:
        if name in path:
            return [*path[path.index(name) :], name]
        if name in done:
            return []
        for other in sorted(waits[name]):
            if loop := visit(other, [*path, name]):
                return loop
        done.add(name)
        return []

    for name in waits:
        if loop := visit(name, []):
            return loop
    return []


def _check_who(scenario: Scenario, i: int) -> Iterator[Problem]:
    known = scenario.groups
    for name in scenario.mission.phases[i].who:
        if name not in known:
            shown = list(known)[:NAMES_SHOWN]
            allowed = one_of(shown) + (" …" if len(known) > len(shown) else "")
            message = f"no vehicle of the team is meant by '{name}'"
            yield scenario.problem(("phases", i, "who"), message, allowed=allowed, suggestion=did_you_mean(name, known))


def _check_kinds(scenario: Scenario, i: int, asked: _Asked) -> Iterator[Problem]:
    phase, told = scenario.mission.phases[i], set()
    suited = asked.kinds
    for k in scenario.phase_members[i]:
        vehicle, member = scenario.vehicles[k], scenario.members[k]
        if vehicle.kind not in suited and member.type not in told:
            told.add(member.type)
            yield scenario.problem(
                ("phases", i, "who"),
                f"the policy '{phase.policy}' cannot command '{member.name}', a {vehicle.kind}",
                given=", ".join(phase.who[:NAMES_SHOWN]),
                allowed=f"vehicles of the kind {' or '.join(suited)}",
            )
    for field, message in asked.answers.faults:
        yield scenario.problem(("phases", i, "settings", field), message)


def _check_senses(scenario: Scenario, i: int, asked: _Asked) -> Iterator[Problem]:
    """Sensors that a policy reads and a vehicle of the phase lacks."""
    phase, told = scenario.mission.phases[i], set()
    for k in scenario.phase_members[i]:
        vehicle, type_name = scenario.vehicles[k], scenario.members[k].type
        carried = {scenario.sensors[name].kind for name in vehicle.sensors}
        lacking = [kind for kind in asked.senses if kind not in carried]
        if lacking and type_name not in told:
            told.add(type_name)
            reads = f"the policy '{phase.policy}' reads {', '.join(lacking)}"
            yield scenario.problem(
                ("phases", i, "policy"),
                f"{reads}, and the vehicle type '{type_name}' carries none",
                suggestion=f"name a sensor of that kind: definitions.vehicles.{type_name}.sensors",
            )


def _check_partners(scenario: Scenario, i: int, asked: _Asked) -> Iterator[Problem]:
    """Members of the team that settings name."""
    settings = scenario.settings[i]
    kinds = {member.name: vehicle.kind for member, vehicle in zip(scenario.members, scenario.vehicles, strict=True)}
    for field, kind in asked.answers.partners.items():
        name = getattr(settings, field)
        if kinds.get(name) == kind:
            continue
        suited = [other for other in kinds if kinds[other] == kind][:NAMES_SHOWN]
        message = f"'{name}' is a {kinds[name]}" if name in kinds else f"there is no vehicle '{name}' in the team"
        allowed = one_of(suited) if suited else f"a {kind}, and the team has none"
        place: Place = ("phases", i, "settings", field)
        yield scenario.problem(place, message, given=name, allowed=allowed, suggestion=did_you_mean(name, suited))


def _check_landing(scenario: Scenario, i: int) -> Iterator[Problem]:
    """Whether one vehicle lands on a rover, and has room for its feet there."""
    settings, members = scenario.settings[i], scenario.phase_members[i]
    if not isinstance(settings, LandOn):
        return
    if len(members) > 1:
        message = f"one vehicle lands on '{settings.rover}', and {len(members)} are to follow the policy 'land_on'"
        yield scenario.problem(("phases", i, "who"), message, suggestion="give each a phase and a rover of its own")
    names = [member.name for member in scenario.members]
    rover = scenario.vehicles[names.index(settings.rover)] if settings.rover in names else None
    for vehicle in {scenario.members[k].type: scenario.vehicles[k] for k in members}.values():
        if not isinstance(rover, SkidSteer) or not isinstance(vehicle, Multirotor):
            continue
        spans = [2.0 * max(abs(foot[axis]) for foot in vehicle.feet.positions_m) for axis in (0, 1)]
        if any(span >= room for span, room in zip(spans, rover.chassis_size_m, strict=False)):
            yield scenario.problem(
                ("phases", i, "settings", "rover"),
                f"the feet of the vehicle type '{vehicle.name}' do not fit on the deck of '{settings.rover}'",
                given=f"feet over {spans[0]:.3g} m by {spans[1]:.3g} m",
                allowed=f"less than {rover.chassis_size_m[0]:.3g} m by {rover.chassis_size_m[1]:.3g} m",
            )


def _check_needs(scenario: Scenario, i: int, asked: _Asked) -> Iterator[Problem]:
    mission, phase = scenario.mission, scenario.mission.phases[i]
    senses = any(vehicle.detector is not None for vehicle in scenario.vehicles)
    needs: list[tuple[Place, str, str]] = [
        (("phases", i, "policy"), f"the policy '{phase.policy}' needs the {need}", need) for need in asked.answers.needs
    ]
    for what, trigger in (("start", phase.start), ("end", phase.end)):
        if trigger is not None and trigger.when is not None:
            needs.append((("phases", i, what, "when"), f"the phase waits for a {trigger.when}", trigger.when))
    for place, message, need in needs:
        missing = [section for section in ESTIMATES[need] if getattr(mission, section) is None]
        if missing:
            text = f"{message}, and the mission has no {' and no '.join(missing)} to find it"
            yield scenario.problem(place, text, suggestion=f"add {' and '.join(missing)} to the mission")
        elif not senses:
            yield scenario.problem(place, f"{message}, and no vehicle of the team carries a detector to find it")
    if asked.answers.needs and phase.start.at_s == 0 and phase.start.delay_s == 0:
        yield scenario.problem(
            ("phases", i, "start"),
            f"the policy '{phase.policy}' needs the {' and the '.join(asked.answers.needs)}, "
            "and nothing has been measured when the mission begins",
            suggestion="start it later: start: {after: …}, start: {when: hotspot} or start: {at_s: …}",
        )


def _check_speeds(scenario: Scenario, i: int) -> Iterator[Problem]:
    settings, told = scenario.settings[i], set()
    for k in scenario.phase_members[i]:
        name = scenario.members[k].type
        if name in told:
            continue
        told.add(name)
        for field, limit, message in _speed_limits(scenario.vehicles[k], name):
            value = getattr(settings, field, None)
            if isinstance(value, int | float) and value > limit:
                place: Place = ("phases", i, "settings", field)
                yield scenario.problem(place, message, given=f"{value:g}", allowed=f"at most {limit:g}")


def _speed_limits(vehicle: Multirotor | SkidSteer, name: str) -> list[tuple[str, float, str]]:
    """Settings that are speeds, the vehicle's limit for each, and what is wrong beyond it."""
    faster = f"is faster than the vehicle type '{name}' can"
    if isinstance(vehicle, Multirotor):
        climb = vehicle.control.climb_rate_max_m_s
        return [
            ("speed_m_s", vehicle.control.speed_max_m_s, f"{faster} fly"),
            ("climb_speed_m_s", climb, f"{faster} climb"),
            ("descent_speed_m_s", climb, f"{faster} descend"),
            ("touchdown_speed_m_s", vehicle.impact_speed_max_m_s, f"is a crash for the vehicle type '{name}'"),
        ]
    fastest = min(vehicle.control.speed_max_m_s, vehicle.motor.speed_max_rad_s * vehicle.wheels.radius_m)
    return [("speed_m_s", fastest, f"{faster} drive")]


def _check_height(scenario: Scenario, i: int) -> Iterator[Problem]:
    """A phase that flies above the ceiling of the fence, whose failsafe would end it on the way up."""
    settings, fence = scenario.settings[i], scenario.mission.failsafes.fence
    if fence.action == "none" or not isinstance(settings, ParallelLines | Orbit | Waypoints | LandOn):
        return
    altitude = settings.altitude_m
    if altitude is not None and altitude >= fence.ceiling_m:
        yield scenario.problem(
            ("phases", i, "settings", "altitude_m"),
            f"is not below the fence's ceiling: on the way up the failsafe would take over (action {fence.action})",
            given=f"{altitude:g}",
            allowed=f"less than {fence.ceiling_m:g} (failsafes.fence.ceiling_m)",
            suggestion=CEILING_HINT,
        )
