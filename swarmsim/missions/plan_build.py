"""From a scenario to the mission's plan (host)."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from swarmsim.config.mission import Mapping
from swarmsim.config.mission import Phase as PhaseSpec
from swarmsim.config.mission import Trigger as TriggerSpec
from swarmsim.config.policies import ParallelLines
from swarmsim.config.scenario import Scenario
from swarmsim.estimation import localisation_params, mapping_params, presume
from swarmsim.estimation.nodes import Span, spans_of
from swarmsim.estimation.radiation_map import MappingParams
from swarmsim.estimation.recursive_map import default_bin_cells
from swarmsim.kept import kept
from swarmsim.missions.plan import Phase, Place, Plan, PolicyReference, Trigger, Values
from swarmsim.policies import registry
from swarmsim.policies.protocol import Assignment
from swarmsim.pytree import on_host
from swarmsim.site import SiteModel
from swarmsim.world.build import detector_models, grouped
from swarmsim.world.kinds import KINDS
from swarmsim.world.model import Group, World
from swarmsim.world.sensing import fit_sensors


def listens(scenario: Scenario) -> bool:
    """Whether a policy of the mission reads what the radio brings."""
    return any(getattr(_policy(scenario, phase).object, "listens", False) for phase in scenario.mission.phases)


def senses(scenario: Scenario) -> bool:
    """Whether a policy of the mission reads navigation sensors."""
    return any(registry.senses(phase.policy, scenario.mission_file) for phase in scenario.mission.phases)


def _policy(scenario: Scenario, phase: PhaseSpec) -> PolicyReference:
    near = scenario.mission_file
    file = registry.policy_file(phase.policy, near)
    reference = phase.policy if file is None else f"{file}:{phase.policy.rpartition(':')[2]}"
    return PolicyReference(reference=reference, digest=registry.digest(phase.policy, near))


def build_plan(scenario: Scenario, site_model: SiteModel, world: World) -> Plan:
    """The plan of a checked scenario."""
    mission = scenario.mission
    counters = {g.counter.index: g.counter for g in reversed(world.groups) if g.counter is not None}
    detectors = tuple(counters[i].detector for i in range(len(detector_models(scenario))))
    localisation, identification = mission.localisation, mission.identification
    per_window, windows = _windows(scenario, world)
    kept_windows = tuple(_kept_windows(group) for group in world.groups)
    params = localisation_params(localisation) if localisation is not None and detectors else None
    mapping = presumed = None
    areas = mapped_areas(scenario, site_model.site.survey_area_m)
    if localisation is not None and detectors:
        ground_share = mission.background.ground_share
        presumed = presume(site_model.site, detectors, localisation, mission.knowledge, ground_share, areas)
    if mission.mapping is not None and detectors:
        mapping = kept_mapping(mission.mapping, areas)
    return Plan(
        site=site_model.site,
        detectors=detectors,
        mapping=mapping,
        localisation=params,
        presumed=presumed,
        spectrum_radius_m=on_host(0.0 if identification is None else identification.spectrum_radius_m),
        confidence_min=on_host(1.0 if identification is None else identification.confidence_min),
        phases=tuple(_phase(scenario, site_model, i) for i in range(len(mission.phases))),
        sensors=fit_sensors(scenario, world, periods=world.timing.judge_ticks) if senses(scenario) else None,
        per_window=per_window,
        windows=windows,
        kept=kept_windows,
        spans=() if params is None else _spans(world, windows, kept_windows, params.rays),
        bin_cells=1 if mapping is None else default_bin_cells(mapping),
        spectrometer=-1 if identification is None else _spectrometer(world),
        trail=0 if identification is None else _trail(scenario, world),
    )


def _trail(scenario: Scenario, world: World) -> int:
    """Decision periods that a phase can be under way in, and the start; 0 where no source is carried."""
    if world.emission.carrier is None:
        return 0
    phases = scenario.mission.phases  # each may end a period after its time is up
    return 2 + sum(math.ceil(phase.time_limit_s / world.timing.decision_period_s) + 1 for phase in phases)


def kept_mapping(mapping: Mapping, areas: list[np.ndarray]) -> MappingParams:
    """The map's grid and basis functions over ``areas`` [V, 2]; raises `InputError` as `mapping_params` does."""
    return _kept_mapping(mapping, tuple(map(tuple, np.concatenate(areas).tolist())))


@kept(4)
def _kept_mapping(mapping: Mapping, corners: tuple[tuple[float, ...], ...]) -> MappingParams:
    """Missions of a family share the map's basis functions, which take 0.2 s for a large map."""
    return mapping_params(mapping, np.array(corners))


def mapped_areas(scenario: Scenario, survey_area_m: ArrayLike) -> list[np.ndarray]:
    """What the map covers, corners [V, 2] of each: the areas that phases survey, or the site's survey area [U, 2]."""
    surveys = [s for s in scenario.settings if isinstance(s, ParallelLines)]
    areas = [np.array(s.area_m) for s in surveys if s.area_m is not None]
    whole = any(s.area_m is None for s in surveys)
    return areas if areas and not whole else [np.asarray(survey_area_m), *areas]


def _windows(scenario: Scenario, world: World) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Samples in a window of the estimate, and windows that a vehicle can fill, for each group.

    A vehicle that flies is far from a source, so its samples are put together; one on the ground keeps its own.
    """
    localisation = scenario.mission.localisation
    per_window, windows = [], []
    for members, group in zip(grouped(scenario), world.groups, strict=True):
        if group.counter is None or localisation is None:
            per_window.append(1)
            windows.append(0)
            continue
        sample_s = group.counter.ticks * group.counter.evaluations * world.timing.control_period_s
        together = max(1, round(localisation.window_s / sample_s)) if KINDS[group.kind].FLIES else 1
        limit_s = sum(
            phase.time_limit_s
            for phase, team in zip(scenario.mission.phases, scenario.phase_members, strict=True)
            if set(team) & set(members)
        )
        per_window.append(together)
        windows.append(math.ceil(limit_s / (sample_s * together)) + 1 if limit_s else 0)
    return tuple(per_window), tuple(windows)


ROWS = {True: 264, False: 160}
"""Windows of the estimate of all vehicles of a group that flies, or drives; their neighbours are put together."""
ROWS_LEAST = 16  # of one vehicle


def _kept_windows(group: Group) -> int:
    return max(ROWS_LEAST, ROWS[KINDS[group.kind].FLIES] // group.size)


def _spans(world: World, windows: Sequence[int], kept_windows: Sequence[int], rays: int) -> tuple[Span, ...]:
    """Spans of the windows that `swarmsim.missions.knowledge.gathered` puts after one another."""
    return spans_of(
        [
            (group.size * each, group.counter.index, rays)
            for group, size, each in zip(world.groups, windows, kept_windows, strict=True)
            if size and group.counter is not None
        ]
    )


def _spectrometer(world: World) -> int:
    """Detector model whose spectra are identified: of those with energy resolution a rover's, else the first."""
    models = [
        (KINDS[g.kind].FLIES, g.counter.index)
        for g in world.groups
        if g.counter is not None and g.counter.detector.identification_bins
    ]
    return min(models)[1] if models else -1


def _phase(scenario: Scenario, site_model: SiteModel, number: int) -> Phase:
    spec, settings = scenario.mission.phases[number], scenario.settings[number]
    members = scenario.phase_members[number]
    policy = _policy(scenario, spec)
    task: Any = None
    if hasattr(policy.object, "task"):
        assignment = Assignment(scenario=scenario, settings=settings, members=members, site_model=site_model)
        task = policy.object.task(assignment)
    target = getattr(settings, "target", None)
    kind = "none" if target is None else target if isinstance(target, str) else "point"
    team = [scenario.members[i] for i in members]
    names = [phase.name for phase in scenario.mission.phases]
    return Phase(
        task=task,
        settings=Values.of(settings),
        target_m=on_host(target if kind == "point" else (0.0, 0.0)),
        start_s=on_host(_seconds(spec.start)),
        end_s=on_host(0.0 if spec.end is None else _seconds(spec.end)),
        time_limit_s=on_host(spec.time_limit_s),
        home_m=on_host([m.position_m for m in team]),
        yaw_rad=on_host(np.radians([m.heading_deg for m in team])),
        name=spec.name,
        policy=policy,
        places=_places(scenario, members),
        start=_trigger(spec.start, names),
        end=None if spec.end is None else _trigger(spec.end, names),
        target=kind,
    )


def _places(scenario: Scenario, members: tuple[int, ...]) -> tuple[Place, ...]:
    places = []
    for number, group in enumerate(grouped(scenario)):
        inside = [i for i in members if i in set(group)]
        if inside:
            local, rank = tuple(group.index(i) for i in inside), tuple(members.index(i) for i in inside)
            places.append(Place(group=number, local=local, rank=rank))
    return tuple(places)


def _trigger(spec: TriggerSpec, names: list[str]) -> Trigger:
    if spec.after is not None:
        return Trigger(kind="after", phase=names.index(spec.after))
    return Trigger(kind="at" if spec.when is None else "when")


def _seconds(spec: TriggerSpec) -> float:
    return (spec.at_s or 0.0) + spec.delay_s
