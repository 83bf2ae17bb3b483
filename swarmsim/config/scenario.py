"""A scenario: a mission with everything that it names looked up, checked and held together."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from swarmsim.config import files
from swarmsim.config.allowed import shape_of
from swarmsim.config.checks import check_consistency, check_team_size
from swarmsim.config.definitions import bring_in_definitions, unused_definitions
from swarmsim.config.documents import Document, Place, dotted, dump_yaml, other_key, shown_path
from swarmsim.config.errors import InputError, Problem, raise_if_any
from swarmsim.config.family import Varied, add_sources, read_family, set_and_varied, varied_paths
from swarmsim.config.load import load_named, read_document
from swarmsim.config.mission import Mission, TeamMember
from swarmsim.config.overrides import ORIGIN, apply_overrides
from swarmsim.config.phases import read_settings
from swarmsim.config.policies import PolicySettings
from swarmsim.config.radiation import Detector, Material, Nuclide
from swarmsim.config.references import check_carried, check_references, known_names
from swarmsim.config.sensors import AnySensor
from swarmsim.config.site import SiteSpec
from swarmsim.config.team import chosen, expand_team, groups
from swarmsim.config.validation import validate
from swarmsim.config.vehicles import Multirotor, SkidSteer
from swarmsim.versions import package_versions

_VERSIONED = ("jax", "mujoco", "mujoco-mjx", "numpy")

_FILES = {
    "site_sha256": "the site",
    "policy_sha256": "the file of the policy {}",
    "body_sha256": "the body file of {}",
}
"""Hashes among the versions, and what they are of."""


@dataclass(frozen=True)
class Scenario:
    """A mission ready to be built. Mappings are read-only and in the order of their names."""

    mission: Mission  # with the settings of every phase written out
    members: tuple[TeamMember, ...]  # the team, formations expanded
    entries: tuple[int, ...]  # index in mission.vehicles of each member
    vehicles: tuple[Multirotor | SkidSteer, ...]  # type of each member
    settings: tuple[PolicySettings, ...]  # of the policy of each phase
    detectors: Mapping[str, Detector]  # those that the team carries
    sensors: Mapping[str, AnySensor]  # those that the team carries
    nuclides: Mapping[str, Nuclide]  # the whole library
    materials: Mapping[str, Material]  # the whole library
    site: SiteSpec
    site_file: Path  # site.yaml; the site's mesh or elevation model is named relative to its folder
    mission_file: Path | None = field(compare=False)  # policies in files are named relative to its folder
    document: Document = field(repr=False, compare=False)  # where each value stands, for messages
    family: tuple[Varied, ...] = ()  # what is drawn for every mission: ``mission.vary`` with its paths written out

    @cached_property
    def groups(self) -> dict[str, tuple[int, ...]]:
        """What a phase's ``who`` may name, and the indices of the members that it means."""
        return groups(self.mission, self.members, self.entries, self.vehicles)

    @cached_property
    def phase_members(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the members of each phase, in the order of the team."""
        return tuple(chosen(phase.who, self.groups) for phase in self.mission.phases)

    def problem(self, place: Place, message: str, **details: str | None) -> Problem:
        """A `Problem` about the mission's value at ``place``, e.g. ``("sources", 0, "position_m")``."""
        return self.document.problem(place, message, **details)

    def to_yaml(self) -> str:
        """The scenario fully resolved: every default, setting and definition of what it names written out.

        `load_scenario` reads it back to the same mission, wherever it lies: the file of a user's policy is named by its
        absolute path where the working folder does not lead to it. The site stays a name; the hashes of its files, of
        users' policies and of vehicles' body files are among the ``versions`` (``site_sha256``,
        ``policy_sha256.<policy>``, ``body_sha256.<vehicle>``).
        """
        data = self.mission.model_dump(mode="json", exclude_none=True)
        for phase in data["phases"]:
            phase["policy"] = _found_from_anywhere(phase["policy"], self.mission_file)
        types = {member.type: vehicle for member, vehicle in zip(self.members, self.vehicles, strict=True)}
        libraries: dict[str, Mapping[str, Any]] = {
            "vehicles": types,
            "detectors": self.detectors,
            "sensors": self.sensors,
            "nuclides": self.nuclides,
            "materials": self.materials,
        }
        definitions: dict[str, Any] = {"complete": True}
        for kind, models in libraries.items():
            definitions[kind] = {
                name: model.model_dump(mode="json", exclude_none=True) for name, model in models.items()
            }
        data |= {"definitions": definitions, "versions": self.versions()}
        return dump_yaml(data)

    def versions(self) -> dict[str, str]:
        """What this scenario runs with: Python, packages that decide results, hashes of site, policy and body files."""
        from swarmsim.policies import registry

        digest = hashlib.sha256(self.site_file.read_bytes())
        geometry = self.site_file.parent / self.site.file
        if geometry.is_file():
            digest.update(geometry.read_bytes())
        found = package_versions(_VERSIONED) | {"site_sha256": digest.hexdigest()}
        for policy in dict.fromkeys(phase.policy for phase in self.mission.phases):
            if sha256 := registry.digest(policy, self.mission_file):
                found[f"policy_sha256.{_found_from_anywhere(policy, self.mission_file)}"] = sha256
        for vehicle in self.vehicles:
            # one that is missing is told where the body is read
            if vehicle.body is not None and files.is_file(Path(vehicle.body.file)):
                body = Path(vehicle.body.file).read_bytes()
                found[f"body_sha256.{vehicle.name}"] = hashlib.sha256(body).hexdigest()
        return found

    def changes(self) -> list[str]:
        """Sentences on files that are no longer those that a fully resolved scenario was written with."""
        wrote = {k: sha256 for k, sha256 in self.mission.versions.items() if k.partition(".")[0] in _FILES}
        have = self.versions() if wrote else {}
        # the file of a policy may be named by another way to it now
        names = [_last_name(key) for key in have]
        by_name = {name: sha256 for name, sha256 in zip(names, have.values(), strict=True) if names.count(name) == 1}
        return [
            f"{_FILES[key.partition('.')[0]].format(key.partition('.')[2])} is no longer what it was when the scenario "
            f"was written (versions.{key}): it flies otherwise"
            for key, sha256 in wrote.items()
            if have.get(key, by_name.get(_last_name(key), sha256)) != sha256
        ]


def _last_name(key: str) -> str:
    """A key of `Scenario.versions` without the folders of a policy's file."""
    kind, _, name = key.partition(".")
    return f"{kind}.{Path(name).name}"


def load_scenario(name_or_path: str | Path, overrides: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """The scenario of a shipped mission's name or of a mission file, with ``path=value`` overrides and a seed.

    Raises `InputError` with everything that is wrong with it, apart from what needs the site's ground
    (`swarmsim.config.site_checks.check_site`).
    """
    path = files.find("missions", name_or_path)
    document = read_document(path, "missions")
    folder = next((parent.name for parent in path.absolute().parents[:2] if parent.name in files.KINDS), "missions")
    if folder != "missions" and "phases" not in document.data:
        message, hint = f"is the file of a {folder.removesuffix('s')}, not of a mission", "swarmsim check reads it"
        raise InputError.of(message, file=shown_path(path), suggestion=hint)
    overrides = (*_texts(overrides), f"seed={seed}") if seed is not None else _texts(overrides)
    problems = bring_in_definitions(document, overrides, path, partial(Problem, file=ORIGIN))
    unknown = {problem.path for problem in problems}
    known = [text for text in overrides if text.partition("=")[0].strip() not in unknown]
    try:
        apply_overrides(document, known, shape_of(Mission))
    except InputError as error:
        problems += error.problems
    varied = varied_paths(document)
    problems += bring_in_definitions(
        document, varied, path, lambda message, path, **details: document.problem(("vary", path), message, **details)
    )
    problems += set_and_varied(document, overrides)
    scenario = resolve(document, path, problems)
    raise_if_any(unused_definitions(scenario, overrides))
    return scenario


def scenario_of(mission: Mission, near: Path | None = None) -> Scenario:
    """The scenario of a mission made in Python.

    ``near`` is a file beside whose ``configs`` names are looked up, and in whose folder files of policies are.
    """
    if not isinstance(mission, Mission):
        hint = "swarmsim.load takes a name or a file; of a mapping make swarmsim.config.mission.Mission(**mapping)"
        raise InputError.of("is no mission", given=repr(mission)[: files.SHOWN], suggestion=hint)
    # A model that was changed without being validated may hold anything: it is told below, and not warned of here.
    if other := other_key(mission.model_dump(warnings=False)):
        path, key = dotted(other[:-1]) or None, repr(other[-1])[: files.SHOWN]
        raise InputError.of("a field's name must be a text", path=path, given=key)
    return resolve(Document(mission.model_dump(mode="json", exclude_none=True, warnings=False)), near, [])


def _texts(overrides: Any) -> tuple[str, ...]:
    """The overrides, each a text; raises `InputError` for anything else."""
    given = (overrides,) if isinstance(overrides, str | bytes) or not isinstance(overrides, Iterable) else overrides
    texts = tuple(given)
    for text in texts:
        if given is not overrides or not isinstance(text, str):
            allowed = 'a list of texts path=value, such as ["wind.speed_m_s=3"]'
            raise InputError.of("are no overrides", given=repr(overrides)[: files.SHOWN], allowed=allowed)
    return texts


def resolve(document: Document, near: Path | None, problems: list[Problem], like: "Scenario | None" = None) -> Scenario:
    """The scenario of a mission's document; ``problems`` are those found already. Raises `InputError`.

    What is looked up by name (vehicles, detectors, sensors, nuclides, materials, the site) is taken from the scenario
    ``like`` where that names the same, instead of being read from its files again.
    """
    add_sources(document)
    mission: Mission | None = None
    try:
        mission = validate(document, Mission)
        problems += check_team_size(mission, document)
    except InputError as error:
        problems += error.problems
    settings, of_settings = read_settings(document, near)
    family, of_family = read_family(document, near) if mission is not None else ((), [])
    of_settings += of_family
    at_fault = {problem.path for problem in problems}
    others = (*check_references(document, near), *of_settings)
    problems += [problem for problem in others if problem.path not in at_fault]
    raise_if_any(sorted(problems, key=lambda p: (p.file is None, p.file != ORIGIN, p.file or "", p.line or 0)))
    assert mission is not None
    complete = tuple(each for each in settings if each is not None)
    mission = _with_settings(mission, complete)
    if like is not None and _names_the_same(mission, like.mission):
        members, entries = expand_team(mission)
        types = {member.type: vehicle for member, vehicle in zip(like.members, like.vehicles, strict=True)}
        scenario = replace(
            like,
            mission=mission,
            members=members,
            entries=entries,
            vehicles=tuple(types[member.type] for member in members),
            settings=complete,
            mission_file=near,
            document=document,
            family=family,
        )
    else:
        scenario = replace(_look_up(mission, complete, document, near), family=family)
    raise_if_any(check_consistency(scenario))
    return scenario


def _names_the_same(mission: Mission, other: Mission) -> bool:
    """Whether two missions look up the same vehicles, detectors, sensors, nuclides, materials and site."""
    types, others = ({member.type for member in each.vehicles} for each in (mission, other))
    return mission.site == other.site and mission.definitions == other.definitions and types == others


def _with_settings(mission: Mission, settings: tuple[PolicySettings, ...]) -> Mission:
    """The mission with every setting of its policies written out."""
    phases = tuple(
        phase.model_copy(update={"settings": each.model_dump(mode="json", exclude_none=True)})
        for phase, each in zip(mission.phases, settings, strict=True)
    )
    return mission.model_copy(update={"phases": phases})


def _look_up(mission: Mission, settings: tuple[PolicySettings, ...], document: Document, near: Path | None) -> Scenario:
    """Everything that the mission names, loaded; the names are known to exist, but the files may be wrong."""
    own = mission.definitions
    problems: list[Problem] = []

    def gather(kind: str, name: str) -> Any:
        defined = getattr(own, kind)
        if name in defined:
            return defined[name]
        try:
            return load_named(kind, name, near)
        except InputError as error:
            problems.extend(problem for problem in error.problems if problem not in problems)

    def library(kind: str) -> dict[str, Any]:
        names = known_names(document.data, kind, near)
        return {name: gather(kind, name) for name in names}

    types = {name: gather("vehicles", name) for name in dict.fromkeys(m.type for m in mission.vehicles)}
    nuclides, materials = library("nuclides"), library("materials")
    site_file = files.find("sites", mission.site, near)
    site: SiteSpec | None = None
    try:
        site = load_named("sites", mission.site, near)
    except InputError as error:
        problems += error.problems
    raise_if_any(problems)
    assert site is not None
    entered = [types[entry.type] for entry in mission.vehicles]
    raise_if_any(check_carried(mission, entered, document, near))
    carried = sorted({vehicle.detector.model for vehicle in types.values() if vehicle.detector is not None})
    detectors = {name: gather("detectors", name) for name in carried}
    sensors = {name: gather("sensors", name) for name in sorted({s for v in types.values() for s in v.sensors})}
    raise_if_any(problems)
    members, entries = expand_team(mission)
    return Scenario(
        mission=mission,
        members=members,
        entries=entries,
        vehicles=tuple(types[member.type] for member in members),
        settings=settings,
        detectors=MappingProxyType(detectors),
        sensors=MappingProxyType(sensors),
        nuclides=MappingProxyType(nuclides),
        materials=MappingProxyType(materials),
        site=site,
        site_file=site_file,
        mission_file=near,
        document=document,
    )


def _found_from_anywhere(policy: str, near: Path | None) -> str:
    """The reference of a policy, with the absolute path of its file where the working folder does not lead to it."""
    from swarmsim.policies import registry

    path = registry.policy_file(policy, near)
    if path is None:
        return policy
    file, _, name = policy.rpartition(":")
    return policy if (Path.cwd() / file).resolve() == path else f"{path}:{name}"
