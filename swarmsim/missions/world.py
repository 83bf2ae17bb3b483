"""A scenario as arrays: everything that the compiled mission reads, built once on the host."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from swarmsim.config.errors import InputError
from swarmsim.config.radiation import DetectorMount
from swarmsim.config.scenario import Scenario
from swarmsim.config.vehicles import Multirotor, SkidSteer
from swarmsim.estimation import LocalisationParams, MappingParams, localisation_params, mapping_params
from swarmsim.missions.flight import Air
from swarmsim.policies.coverage import lines_needed, points_needed
from swarmsim.policies.tasks import AerialTask, GroundTask
from swarmsim.pytree import pytree
from swarmsim.radiation.detector import Detector, Source, build_detector
from swarmsim.radiation.library import Library
from swarmsim.site import Site, SiteModel, sample
from swarmsim.vehicles.multirotor import MultirotorParams, multirotor_params
from swarmsim.vehicles.skid_steer import SkidSteerParams, skid_steer_params

PATH_SPACING_M = 0.5  # between points of a survey path, at most
ROUTE_CELL_M = 1.0  # routes are planned on cells of about this size
ROUTE_WINDOW_M = 25.0  # a route round the target stays this close to it
ROUTE_POINTS = 1536
ROVER_MARGIN_M = 0.3  # kept beside the rover's half width
TICK_TARGET_S = 0.12  # poses are logged about this often


@pytree
class Team:
    """The U survey UAVs."""

    params: MultirotorParams  # leading axis U
    limits: jax.Array  # [U, 3] collision radius (m), half height (m), largest impact speed (m/s)
    detector: Detector  # leading axis U
    home_m: jax.Array  # [U, 2] ENU
    yaw_rad: jax.Array  # [U] heading kept in flight, counter-clockwise from east
    separation_m: jax.Array  # []


@pytree
class Rover:
    """The rover."""

    params: SkidSteerParams
    detector: Detector
    start_m: jax.Array  # [2] ENU
    yaw_rad: jax.Array  # []
    spectrum_radius_m: jax.Array  # [] spectra are taken within this distance of the estimate


@pytree
class World:
    """All of a scenario that is traced; what decides the compilation stands in `Timing` and in static fields."""

    site: Site
    sources: Source  # leading axis S >= 1; a source of no activity stands in for none
    air: Air
    team: Team
    rover: Rover | None
    survey: AerialTask
    search: GroundTask | None  # its target is filled in when the source has been estimated
    mapping: MappingParams
    localisation: LocalisationParams
    presumed_nuclide: jax.Array  # [] int32, hypothesis of the aerial estimate
    confidence_min: jax.Array  # [] of the identification, to replace the presumed nuclide


@dataclass(frozen=True)
class Timing:
    """Periods as whole numbers of physics steps; they decide what compiles."""

    dt_s: float  # physics step
    substeps: int  # physics steps in a control period
    uav_periods: int  # control periods in a tick of the UAVs, which is one of their samples
    rover_periods: int  # control periods in a tick of the rover
    rover_ticks: int  # ticks in a sample of the rover

    @property
    def uav_tick_s(self) -> float:
        """Tick of the UAVs [s]."""
        return self.dt_s * self.substeps * self.uav_periods

    @property
    def rover_tick_s(self) -> float:
        """Tick of the rover [s]."""
        return self.dt_s * self.substeps * self.rover_periods


@dataclass(frozen=True)
class Roles:
    """Which members of the team (their indices) survey, and which one searches."""

    uavs: tuple[int, ...]
    rover: int | None


def roles_of(scenario: Scenario) -> Roles:
    """Sort the team by what its vehicles are."""
    uavs = tuple(i for i, spec in enumerate(scenario.vehicles) if isinstance(spec, Multirotor))
    rovers = [i for i, spec in enumerate(scenario.vehicles) if isinstance(spec, SkidSteer)]
    return Roles(uavs=uavs, rover=rovers[0] if rovers else None)


def embodied(spec: Multirotor) -> Multirotor:
    """The specification with the mass and inertia of its body file, where it names one."""
    if spec.body is None:
        return spec
    from swarmsim.vehicles.bodies import with_file_body  # its readers take half a second to import

    return with_file_body(spec)


def build_timing(scenario: Scenario, roles: Roles) -> Timing:
    """Periods of the scenario.

    Raises `InputError` where a detector's sample period is not a whole number of control periods, or the UAVs' differ.
    """
    dt = scenario.mission.time_step_s
    substeps = max(1, round(0.01 / dt))
    uav_periods = {_periods(scenario, i, dt * substeps) for i in roles.uavs}
    if len(uav_periods) != 1:
        raise InputError.of(
            "the UAVs' detectors have different sample periods: give them detectors with the same sample_period_s"
        )
    rover_sample = _periods(scenario, roles.rover, dt * substeps) if roles.rover is not None else 1
    divisors = [n for n in range(1, rover_sample + 1) if rover_sample % n == 0]
    rover_periods = min(divisors, key=lambda n: abs(math.log(n * dt * substeps / TICK_TARGET_S)))
    return Timing(
        dt_s=dt,
        substeps=substeps,
        uav_periods=uav_periods.pop(),
        rover_periods=rover_periods,
        rover_ticks=rover_sample // rover_periods,
    )


def _periods(scenario: Scenario, vehicle: int, period_s: float) -> int:
    sample = scenario.detectors[_mount(scenario, vehicle).model].sample_period_s
    count = round(sample / period_s)
    if count < 1 or abs(count * period_s - sample) > 1e-6:
        raise InputError.of(
            f"sample_period_s of {sample:g} s of detector {_mount(scenario, vehicle).model} is not a whole number of "
            f"control periods of {period_s:g} s: choose a multiple"
        )
    return count


def _mount(scenario: Scenario, vehicle: int) -> DetectorMount:
    mount = scenario.vehicles[vehicle].detector
    if mount is None:
        member = scenario.mission.vehicles[vehicle]
        raise InputError.of(
            f"vehicle {member.name} ({member.type}) carries no detector: give its type a detector, or leave it out"
        )
    return mount


def build_world(scenario: Scenario, site_model: SiteModel, roles: Roles) -> World:
    """Arrays of a checked scenario at its site.

    Raises `InputError` where the team cannot fly together (different numbers of rotors) or carries no detector.
    """
    mission, site = scenario.mission, site_model.site
    library = Library(nuclides=tuple(scenario.nuclides.values()), materials=tuple(scenario.materials.values()))
    area = np.asarray(mission.aerial.area_m if mission.aerial.area_m else site.survey_area_m)
    return World(
        site=site,
        sources=_sources(scenario, site, library),
        air=Air(
            speed_m_s=_f32(mission.wind.speed_m_s),
            from_rad=_f32(math.radians(mission.wind.from_deg)),
            gusts=_f32(mission.wind.gusts),
        ),
        team=_team(scenario, library, roles),
        rover=_rover(scenario, library, roles),
        survey=_survey(scenario, area, roles),
        search=_search(scenario, site, roles),
        mapping=mapping_params(mission.mapping, area),
        localisation=localisation_params(mission.localisation),
        presumed_nuclide=jnp.int32(library.nuclide_index(mission.localisation.presumed_nuclide)),
        confidence_min=_f32(mission.ground.confidence_min),
    )


def _f32(value: ArrayLike) -> jax.Array:
    return jnp.asarray(value, jnp.float32)


def _stack(items: Sequence, what: str):  # type: ignore[no-untyped-def, type-arg]
    shapes = {tuple(leaf.shape for leaf in jax.tree.leaves(item)) for item in items}
    if len(shapes) != 1:
        raise InputError.of(f"the UAVs of one team must have {what}: choose vehicles that are alike in this")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *items)


def _sources(scenario: Scenario, site: Site, library: Library) -> Source:
    truths = scenario.mission.sources
    xy = _f32([s.position_m for s in truths] or [(0.0, 0.0)])
    height = _f32([s.height_m for s in truths] or [0.0]) + sample(site.terrain_m, site, xy)
    return Source(
        position_m=jnp.concatenate([xy, height[:, None]], axis=1),
        activity_bq=_f32([1e6 * s.activity_mbq for s in truths] or [0.0]),
        nuclide=jnp.array([library.nuclide_index(s.nuclide) for s in truths] or [0], jnp.int32),
    )


def _team(scenario: Scenario, library: Library, roles: Roles) -> Team:
    members = [scenario.mission.vehicles[i] for i in roles.uavs]
    specs = [spec for i in roles.uavs if isinstance(spec := scenario.vehicles[i], Multirotor)]
    detectors = [_detector(scenario, i, library) for i in roles.uavs]
    limits = [[s.collision_radius_m, 0.5 * s.collision_height_m, s.impact_speed_max_m_s] for s in specs]
    return Team(
        params=_stack([multirotor_params(embodied(s)) for s in specs], "the same numbers of rotors and feet"),
        limits=_f32(limits),
        detector=_stack(detectors, "detectors of the same kind"),
        home_m=_f32([m.position_m for m in members]),
        yaw_rad=_f32([math.radians(m.heading_deg) for m in members]),
        separation_m=_f32(scenario.mission.aerial.separation_m),
    )


def _detector(scenario: Scenario, vehicle: int, library: Library) -> Detector:
    mount = _mount(scenario, vehicle)
    return build_detector(scenario.detectors[mount.model], mount, library, scenario.mission.detection)


def _rover(scenario: Scenario, library: Library, roles: Roles) -> Rover | None:
    if roles.rover is None:
        return None
    spec, member = scenario.vehicles[roles.rover], scenario.mission.vehicles[roles.rover]
    assert isinstance(spec, SkidSteer)
    return Rover(
        params=skid_steer_params(spec),
        detector=_detector(scenario, roles.rover, library),
        start_m=_f32(member.position_m),
        yaw_rad=_f32(math.radians(member.heading_deg)),
        spectrum_radius_m=_f32(scenario.mission.ground.spectrum_radius_m),
    )


def _survey(scenario: Scenario, area: np.ndarray, roles: Roles) -> AerialTask:
    aerial = scenario.mission.aerial
    spacing = aerial.line_spacing_m or 0.5 * aerial.altitude_m
    homes = np.array([scenario.mission.vehicles[i].position_m for i in roles.uavs])
    lines = lines_needed(area, spacing, math.radians(aerial.sweep_deg))
    limits = [
        spec.control.acceleration_max_m_s2 for i in roles.uavs if isinstance(spec := scenario.vehicles[i], Multirotor)
    ]
    return AerialTask(
        area_m=_f32(area),
        home_m=_f32(homes),
        altitude_m=_f32(aerial.altitude_m),
        line_spacing_m=_f32(spacing),
        sweep_rad=_f32(math.radians(aerial.sweep_deg)),
        obstacle_clearance_m=_f32(aerial.obstacle_clearance_m),
        speed_m_s=_f32(aerial.speed_m_s),
        climb_speed_m_s=_f32(aerial.climb_speed_m_s),
        descent_speed_m_s=_f32(aerial.descent_speed_m_s),
        touchdown_speed_m_s=_f32(aerial.touchdown_speed_m_s),
        acceleration_m_s2=_f32(0.5 * min(limits)),
        lines_max=lines,
        points=points_needed(area, homes, lines, aerial.altitude_m, PATH_SPACING_M),
    )


def _search(scenario: Scenario, site: Site, roles: Roles) -> GroundTask | None:
    if roles.rover is None:
        return None
    spec, ground = scenario.vehicles[roles.rover], scenario.mission.ground
    assert isinstance(spec, SkidSteer)
    block = max(1, round(ROUTE_CELL_M / float(site.cell_m)))
    return GroundTask(
        start_m=_f32(scenario.mission.vehicles[roles.rover].position_m),
        target_m=jnp.zeros(2),
        standoff_m=_f32(ground.standoff_m),
        speed_m_s=_f32(ground.speed_m_s),
        acceleration_m_s2=_f32(0.5 * spec.control.acceleration_max_m_s2),
        rover_radius_m=_f32(0.5 * spec.chassis_size_m[1] + ROVER_MARGIN_M),
        viewpoints=ground.viewpoints,
        laps=ground.laps,
        block=block,
        window=math.ceil(ROUTE_WINDOW_M / (block * float(site.cell_m))),
        points=ROUTE_POINTS,
    )
