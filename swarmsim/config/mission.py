"""A mission as a user writes it: the site, the team, the sources and the three phases."""

from typing import Literal

from pydantic import Field

from swarmsim.config.base import ConvexPolygon, Fraction, Model, Name, NonNegative, Positive, Vec2
from swarmsim.config.radiation import Detector, Material, Nuclide
from swarmsim.config.vehicles import Vehicle


class Source(Model):
    """A radioactive point source: truth, known to the simulation and not to the mission."""

    nuclide: Name
    position_m: Vec2
    height_m: float = Field(ge=-5, le=100)
    activity_mbq: NonNegative


class TeamMember(Model):
    """One vehicle of the team: its type and where it starts (ENU, heading counter-clockwise from east)."""

    name: Name
    type: Name
    position_m: Vec2
    heading_deg: float = Field(default=0.0, ge=-360, le=360)


class Wind(Model):
    """Steady wind at 20 ft and Dryden gusts (MIL-F-8785C, low altitude).

    ``from_deg`` is the bearing that it blows from, clockwise from north as weather stations give it.
    """

    speed_m_s: float = Field(default=0.0, ge=0, le=30)
    from_deg: float = Field(default=0.0, ge=-360, le=360)
    gusts: bool = False


class Aerial(Model):
    """Phase 1: the survey flight."""

    policy: Name = "parallel_lines"
    altitude_m: float = Field(gt=1, le=200)
    line_spacing_m: Positive | None = None
    sweep_deg: float = Field(default=0.0, ge=-360, le=360)
    speed_m_s: float = Field(gt=0, le=30)
    climb_speed_m_s: float = Field(gt=0, le=10)
    descent_speed_m_s: float = Field(gt=0, le=5)
    touchdown_speed_m_s: float = Field(gt=0, le=2)
    obstacle_clearance_m: NonNegative
    separation_m: Positive
    area_m: ConvexPolygon | None = None
    time_limit_s: Positive


class Mapping(Model):
    """Phase 2a: counts to a map, map to hotspots."""

    cell_m: Positive
    length_scale_m: Positive
    hotspots_max: int = Field(ge=1, le=16)
    hotspot_separation_m: Positive
    significance_sigma: Positive


class Localisation(Model):
    """Phase 2b and 3b: estimate of position and activity from the likelihood of the counts."""

    presumed_nuclide: Name
    presumed_height_m: float = Field(ge=-5, le=100)
    height_std_m: NonNegative
    window_s: Positive
    rays_per_window: int = Field(default=3, ge=1, le=32)
    starts: int = Field(ge=1, le=64)
    iterations: int = Field(ge=10, le=10_000)
    learning_rate_m: Positive
    search_radius_m: Positive = 6.0
    search_rounds: int = Field(default=3, ge=0, le=1000)
    fisher_steps: int = Field(default=6, ge=1, le=100)
    sample_rounds: int = Field(default=6, ge=1, le=100)
    samples: int = Field(default=64, ge=16, le=10_000)


class Ground(Model):
    """Phase 3: the rover's drive to the hotspot and around it."""

    policy: Name = "approach_and_orbit"
    speed_m_s: float = Field(gt=0, le=5)
    standoff_m: Positive
    viewpoints: int = Field(ge=1, le=64)
    laps: int = Field(default=1, ge=1, le=10)
    time_limit_s: Positive
    spectrum_radius_m: Positive
    confidence_min: Fraction


class Definitions(Model):
    """Vehicles, detectors, nuclides and materials that a scenario brings along; they come before the shipped ones.

    With ``complete`` nothing is taken from the configuration folders, so that a resolved scenario stays what it was.
    """

    complete: bool = False
    vehicles: dict[Name, Vehicle] = Field(default_factory=dict)
    detectors: dict[Name, Detector] = Field(default_factory=dict)
    nuclides: dict[Name, Nuclide] = Field(default_factory=dict)
    materials: dict[Name, Material] = Field(default_factory=dict)


class Mission(Model):
    """A scenario (``configs/missions/<name>.yaml``).

    ``versions`` says what wrote a resolved scenario (package -> version); it changes nothing in the mission.
    """

    name: Name
    description: str = ""
    site: Name
    seed: int = Field(default=0, ge=0, lt=2**31)
    engine: Literal["mjx", "analytic"] = "mjx"
    time_step_s: float = Field(default=0.005, ge=0.0005, le=0.02)
    detection: Literal["physical", "paper_ideal"] = "physical"
    sources: tuple[Source, ...] = Field(max_length=16)
    vehicles: tuple[TeamMember, ...] = Field(min_length=1, max_length=64)
    wind: Wind
    aerial: Aerial
    mapping: Mapping
    localisation: Localisation
    ground: Ground
    definitions: Definitions = Definitions()
    versions: dict[str, str] = Field(default_factory=dict)
