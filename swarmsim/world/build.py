"""A scenario as arrays: the true world that the step reads, built once on the host."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from swarmsim.config.checks import footprint_radius_m
from swarmsim.config.errors import InputError
from swarmsim.config.flight import Failsafe, FlightEffects
from swarmsim.config.scenario import Scenario
from swarmsim.config.vehicles import Multirotor, SkidSteer
from swarmsim.kept import kept, stored
from swarmsim.physics.multirotor import check_time_step
from swarmsim.pytree import on_host
from swarmsim.radiation.background import SMOOTH_M, BackgroundField
from swarmsim.radiation.detector import AIR, Detector, build_detector
from swarmsim.radiation.library import Library
from swarmsim.sensors.radiation import Counter, Departures
from swarmsim.site import Site, SiteModel
from swarmsim.site.landing_places import landing_places
from swarmsim.site.model import bounds_m
from swarmsim.site.walls import walls_of
from swarmsim.vehicles.multirotor import multirotor_params
from swarmsim.vehicles.skid_steer import skid_steer_params
from swarmsim.world.failsafes import ACTIONS, HOLD, LEASH_M, FailsafeRules
from swarmsim.world.model import Air, Group, Limits, Radio, Timing, TrafficRules, World
from swarmsim.world.sources import build_sources

NOWHERE_M = 1e6
"""Distance [m] of a fence that is never met."""
EVALUATION_PERIOD_S = 0.12  # the rate of a detector is evaluated about this often during an exposure

Spec = Multirotor | SkidSteer


def build_timing(scenario: Scenario) -> Timing:
    """Periods of a checked scenario as whole numbers."""
    timing = scenario.mission.timing

    def whole(period_s: float) -> int:
        return max(1, round(period_s / timing.control_period_s))

    judge = whole(timing.judge_period_s)
    log = judge * max(1, round(whole(timing.log_period_s) / judge))
    decision = log * max(1, round(whole(timing.decision_period_s) / log))
    return Timing(
        time_step_s=timing.time_step_s,
        substeps=timing.physics_steps,
        judge_ticks=judge,
        log_ticks=log,
        decision_ticks=decision,
    )


def library_of(scenario: Scenario) -> Library:
    """Nuclides and materials of the scenario, in the order of every table and index."""
    return Library(nuclides=tuple(scenario.nuclides.values()), materials=tuple(scenario.materials.values()))


def build_world(scenario: Scenario, site_model: SiteModel, mates: int = 0) -> World:
    """The true world of a checked scenario at its site.

    Args:
        scenario, site_model: what to build.
        mates: team mates that policies listen to; 0 leaves the radio off.

    Raises:
        InputError: the time step does not suit a vehicle, or its body's file is wrong.
    """
    mission, site = scenario.mission, site_model.site
    timing, library = build_timing(scenario), library_of(scenario)
    radio, groups = mission.radio, grouped(scenario)
    sources, emission = build_sources(scenario, site, library, groups)
    return World(
        site=site,
        walls=walls_of(site),
        sources=sources,
        emission=emission,
        air=Air(
            speed_m_s=_f32(mission.wind.speed_m_s),
            from_rad=_f32(math.radians(mission.wind.from_deg)),
            gusts=_f32(mission.wind.gusts),
        ),
        background=_background(scenario, site),
        departures=_departures(scenario, site),
        traffic=TrafficRules(
            separation_m=_f32(mission.traffic.separation_m),
            ground_separation_m=_f32(mission.traffic.ground_separation_m),
        ),
        failsafes=_failsafes(scenario, site),
        radio=Radio(
            range_m=_f32(radio.range_m if radio.range_m is not None else np.inf),
            loss=_f32(radio.loss),
            delay=round(radio.delay_s / timing.judge_period_s),
            mates=mates,
        ),
        groups=tuple(_group(scenario, members, timing, library) for members in groups),
        timing=timing,
        engine=mission.engine,
    )


def _departures(scenario: Scenario, site: Site) -> Departures:
    knowledge = scenario.mission.knowledge
    share = np.full(len(site.material_names), knowledge.thickness_share if knowledge.site == "geometry" else 0.0)
    share[[site.material_names.index(AIR), int(site.ground_material)]] = 0.0
    return Departures(thickness_share=_f32(share), sensitivity_std=_f32(knowledge.sensitivity_std))


def _background(scenario: Scenario, site: Site) -> BackgroundField:
    spec = scenario.mission.background
    surface = around = np.ones((2, 2))
    if spec.surfaces:
        surface = surface_factors(site, dict(spec.surfaces))
        around = gaussian_filter(surface, SMOOTH_M / float(site.cell_m), mode="nearest")
    bearing = math.radians(spec.step.toward_deg)
    normal = np.array([math.sin(bearing), math.cos(bearing)])
    return BackgroundField(
        scale=_f32(spec.scale),
        ground_share=_f32(spec.ground_share),
        patch_std=_f32(spec.patches.std),
        patch_length_m=_f32(spec.patches.length_m),
        step_share=_f32(spec.step.share),
        step_normal=_f32(normal),
        step_offset_m=_f32(float(normal @ np.array(spec.step.through_m))),
        step_width_m=_f32(spec.step.width_m),
        surface=_f32(surface),
        around=_f32(around),
    )


def surface_factors(site: Site, factors: dict[str, float]) -> np.ndarray:
    """Factor [ny, nx] of the uppermost surface in each cell: that of the ground, or of the highest box there."""
    ny, nx = np.shape(site.terrain_m)
    names, boxes = site.material_names, site.obstacles
    x = float(site.origin_m[0]) + float(site.cell_m) * np.arange(nx)
    y = float(site.origin_m[1]) + float(site.cell_m) * np.arange(ny)
    found = np.full((ny, nx), factors.get(names[int(site.ground_material)], 1.0))
    top = np.full((ny, nx), -np.inf)
    columns = (np.asarray(a, float) for a in (boxes.centre_m, boxes.half_extent_m, boxes.axis))
    for centre, half, (c, s), material in zip(*columns, np.asarray(boxes.material), strict=True):
        offset_x, offset_y = x[None, :] - centre[0], y[:, None] - centre[1]
        inside = (np.abs(c * offset_x + s * offset_y) <= half[0]) & (np.abs(c * offset_y - s * offset_x) <= half[1])
        higher = inside & (centre[2] + half[2] > top)
        found[higher] = factors.get(names[int(material)], 1.0)
        top[higher] = centre[2] + half[2]
    return found


def _failsafes(scenario: Scenario, site: Site) -> FailsafeRules:
    rules = scenario.mission.failsafes
    origin, end = (np.asarray(corner, np.float64) for corner in bounds_m(site))
    kinds: list[Failsafe] = [rules.fence, rules.wind, rules.battery, rules.link]
    fence, wind, battery, link = (kind.action != "none" for kind in kinds)
    margin = rules.fence.margin_m if fence else -NOWHERE_M
    flying = [m.position_m for m, v in zip(scenario.members, scenario.vehicles, strict=True) if v.kind == "multirotor"]
    starts = np.array(flying).reshape(-1, 2)
    if np.any((starts < origin + margin) | (starts > end - margin)):
        raise InputError.of(
            "a vehicle starts outside the fence, which is the site's outline less failsafes.fence.margin_m",
            given=f"a margin of {margin:g} m",
            suggestion="make the margin smaller, or set failsafes.fence.action to none",
        )
    widest = max((v.collision_radius_m for v in scenario.vehicles if v.kind == "multirotor"), default=0.0)
    (east, north), over = landing_places(site, widest + rules.landing_clearance_m, max(margin, 0.0) + LEASH_M)
    return FailsafeRules(
        fence_low_m=_f32(origin + margin),
        fence_high_m=_f32(end - margin),
        ceiling_m=_f32(rules.fence.ceiling_m if fence else NOWHERE_M),
        wind_share=_f32(rules.wind.share if wind else np.inf),
        wind_drift_m_s=_f32(rules.wind.drift_m_s),
        wind_s=_f32(rules.wind.after_s),
        battery_low=_f32(rules.battery.charge if battery else -1.0),
        link_range_m=_f32(rules.link.range_m if link else np.inf),
        link_s=_f32(rules.link.after_s),
        return_height_m=_f32(float(np.max(np.asarray(site.surface_m))) + rules.return_clearance_m),
        clear_east_m=_f32(east),
        clear_north_m=_f32(north),
        over_m=_f32(over),
        action=on_host([ACTIONS.get(kind.action, HOLD) for kind in kinds], np.int32),
    )


def grouped(scenario: Scenario) -> tuple[tuple[int, ...], ...]:
    """Members (their numbers) of one kind, number of rotors and feet, and detector model, in the order of the team."""
    groups: dict[tuple[Any, ...], list[int]] = {}
    for number, spec in enumerate(scenario.vehicles):
        groups.setdefault(_suite(spec), []).append(number)
    return tuple(tuple(members) for members in groups.values())


def _suite(spec: Spec) -> tuple[Any, ...]:
    detector = None if spec.detector is None else spec.detector.model
    if isinstance(spec, Multirotor):
        return spec.kind, len(spec.rotors), len(spec.feet.positions_m), detector
    return spec.kind, detector


def detector_models(scenario: Scenario) -> tuple[str, ...]:
    """Models of the team's detectors, in the order of the team: what `Counter.index` and measurements index."""
    return tuple(dict.fromkeys(s.detector.model for s in scenario.vehicles if s.detector is not None))


def embodied(spec: Multirotor) -> Multirotor:
    """The specification with the mass and inertia of its body file, where it names one."""
    if spec.body is None:
        return spec
    from swarmsim.vehicles.bodies import with_file_body  # its readers take half a second to import

    return with_file_body(spec)


def _f32(value: ArrayLike) -> Any:
    return np.asarray(value, np.float32)


def _stack(items: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *items)


def _group(scenario: Scenario, members: tuple[int, ...], timing: Timing, library: Library) -> Group:
    specs = [scenario.vehicles[i] for i in members]
    team = [scenario.members[i] for i in members]
    params: dict[int, Any] = {}
    for spec in specs:
        if id(spec) not in params:  # many members share one specification
            params[id(spec)] = vehicle_params(spec, scenario.mission.effects, timing.time_step_s)
    params = dict(zip(params, _alike(list(params.values())), strict=True))
    return Group(
        params=_stack([params[id(spec)] for spec in specs]),
        limits=_limits(specs, [params[id(spec)] for spec in specs], _f32([m.position_m for m in team])),
        counter=_counter(scenario, specs, timing, library),
        start_m=_f32([m.position_m for m in team]),
        yaw_rad=_f32(np.radians([m.heading_deg for m in team])),
        member=on_host(members, np.int32),
        kind=specs[0].kind,
    )


def _alike(params: list[Any]) -> list[Any]:
    """The same of one structure: principal axes in all of them where those of one are not its body's."""
    if all(getattr(own, "principal_axes", None) is None for own in params):
        return params
    level = _f32([1.0, 0.0, 0.0, 0.0])

    def given(own: Any) -> Any:
        if own.principal_axes is not None:
            return own
        return replace(own, principal_axes=level, control=replace(own.control, principal_axes=level))

    return [given(own) for own in params]


def vehicle_params(spec: Spec, effects: FlightEffects, time_step_s: float) -> Any:
    """Parameters of a vehicle; raises `InputError` for a body's file that is wrong, or a time step that is too long."""
    if isinstance(spec, SkidSteer):
        return skid_steer_params(spec)
    check_time_step(spec, time_step_s)
    return multirotor_params(embodied(spec), effects)


def deck_of(spec: Spec, params: Any) -> tuple[float, float, float]:
    """Half length, half width and height over the origin of a rover's upper side, m; zeros for what flies."""
    if isinstance(spec, Multirotor):
        return 0.0, 0.0, 0.0
    length, width, tall = spec.chassis_size_m
    origin = float(params.wheel_radius_m) - float(np.mean(np.asarray(params.wheel_position_m)[:, 2]))
    return 0.5 * length, 0.5 * width, spec.chassis_height_m + 0.5 * tall - origin


def _limits(specs: Sequence[Spec], params: Sequence[Any], home_m: Any) -> Limits:
    def half_height(spec: Spec) -> float:
        return 0.5 * (spec.collision_height_m if isinstance(spec, Multirotor) else spec.chassis_size_m[2])

    return Limits(
        radius_m=_f32([footprint_radius_m(spec) for spec in specs]),
        half_height_m=_f32([half_height(spec) for spec in specs]),
        deck_m=_f32([deck_of(spec, own) for spec, own in zip(specs, params, strict=True)]),
        impact_speed_m_s=_f32([spec.impact_speed_max_m_s for spec in specs]),
        battery_j=_f32([3600.0 * spec.battery.capacity_wh for spec in specs]),
        home_m=home_m,
    )


def _counter(scenario: Scenario, specs: Sequence[Spec], timing: Timing, library: Library) -> Counter | None:
    mounts = [spec.detector for spec in specs if spec.detector is not None]
    if not mounts:
        return None
    model = mounts[0].model
    detector = _detector(scenario, model, library)
    whole = _exposure_ticks(scenario, model, timing)
    target = EVALUATION_PERIOD_S / timing.control_period_s
    divisors = [n for n in range(1, whole + 1) if whole % n == 0]
    ticks = min(divisors, key=lambda n: abs(math.log(n / target)))
    axes = np.array([mount.axis for mount in mounts], np.float64)
    return Counter(
        detector=detector,
        mount_position_m=_f32([mount.position_m for mount in mounts]),
        mount_axis=_f32(axes / np.linalg.norm(axes, axis=1, keepdims=True)),
        ticks=ticks,
        evaluations=whole // ticks,
        index=detector_models(scenario).index(model),
    )


def _detector(scenario: Scenario, model: str, library: Library) -> Detector:
    mount = next(s.detector for s in scenario.vehicles if s.detector is not None and s.detector.model == model)
    return _kept_detector(scenario.detectors[model], mount, library, scenario.mission.detection)


_kept_detector = kept(8)(stored(reads=("elements",))(build_detector))
"""Its tables take a second: missions of a family share them."""


def _exposure_ticks(scenario: Scenario, model: str, timing: Timing) -> int:
    """Control periods in an exposure of a detector model."""
    period = scenario.detectors[model].sample_period_s
    return round(period / timing.control_period_s)
