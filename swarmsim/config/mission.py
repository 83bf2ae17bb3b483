"""A mission as a user writes it: the site, the team, the sources and the phases."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from swarmsim.config.autopilot import Autopilot
from swarmsim.config.base import Delay, Duration, Fraction, Gap, Length, Model, Name, Vec2
from swarmsim.config.flight import Failsafes, FlightEffects
from swarmsim.config.radiation import Detector, Material, Nuclide
from swarmsim.config.sensors import Sensor
from swarmsim.config.sources import ACTIVITY_MAX_MBQ, Source
from swarmsim.config.vary import SOURCES_MAX, VARIED_MAX, Distribution, VariedPath
from swarmsim.config.vehicles import Vehicle

TEAM_MAX = 2000  # vehicles of a mission, formations expanded
PHASES_MAX = 64
SEED_END = 2**31


class Timing(Model):
    """Periods of a mission, s; the other periods are whole numbers of ``control_period_s``.

    ``physics_steps`` is the number of time steps in a control period, ``judge_period_s`` is how often events, ground,
    traffic and wind are evaluated, ``log_period_s`` how often the state is recorded, and ``decision_period_s`` how
    often phases may start or end and planners may be asked again.
    """

    control_period_s: float = Field(default=0.01, ge=0.001, le=0.05)
    physics_steps: int = Field(default=2, ge=1, le=20)
    judge_period_s: float = Field(default=0.05, ge=0.001, le=1)
    log_period_s: float = Field(default=0.1, ge=0.001, le=60)
    decision_period_s: float = Field(default=1.0, ge=0.001, le=60)

    @property
    def time_step_s(self) -> float:
        """Time step of the physics, s."""
        return self.control_period_s / self.physics_steps


class Formation(Model):
    """Members in a grid: rows of ``columns`` eastwards from the first member, further rows northwards."""

    count: int = Field(ge=2, le=TEAM_MAX)
    columns: int = Field(ge=1, le=TEAM_MAX)
    spacing_m: float = Field(ge=0.01, le=1000)


class TeamMember(Model):
    """One vehicle of the team: its type and where it starts (ENU, heading counter-clockwise from east).

    With a ``formation`` it stands for ``count`` vehicles named ``name1``, ``name2``, …, the first at ``position_m``.
    """

    name: Name
    type: Name
    position_m: Vec2
    heading_deg: float = Field(default=0.0, ge=-360, le=360)
    formation: Formation | None = None


class Wind(Model):
    """Steady wind at 20 ft and Dryden gusts (MIL-F-8785C, low altitude).

    ``from_deg`` is the bearing that it blows from, clockwise from north as weather stations give it.
    """

    speed_m_s: float = Field(default=0.0, ge=0, le=30)
    from_deg: float = Field(default=0.0, ge=-360, le=360)
    gusts: bool = False


class BackgroundPatches(Model):
    """Smooth random variation of the ground's radiation: relative standard deviation and correlation length."""

    std: float = Field(default=0.0, ge=0, le=1)
    length_m: float = Field(default=25.0, ge=1, le=10_000)


class BackgroundStep(Model):
    """An edge beyond which the ground radiates more: relative rise, bearing to the higher side, a point on the edge."""

    share: float = Field(default=0.0, ge=-0.9, le=10)
    toward_deg: float = Field(default=0.0, ge=-360, le=360)
    through_m: Vec2 = (0.0, 0.0)
    width_m: float = Field(default=2.0, ge=0.01, le=1000)


class BackgroundField(Model):
    """Natural background over the site, relative to the nominal one of each detector.

    ``surfaces`` are factors of materials that surfaces are made of (1 without one). ``ground_share`` of the nominal
    background comes from the ground; that part falls with height and varies with surface, ``patches`` and ``step``.
    """

    scale: float = Field(default=1.0, ge=0, le=1000)
    ground_share: float = Field(default=0.85, ge=0, le=1)
    surfaces: dict[Name, Annotated[float, Field(ge=0, le=100)]] = Field(default_factory=dict, max_length=100)
    patches: BackgroundPatches = BackgroundPatches()
    step: BackgroundStep = BackgroundStep()


class Traffic(Model):
    """Least distances, m, between UAVs in flight, between rovers, and between vehicles' outlines at the start."""

    separation_m: float = Field(default=6.0, ge=0.01, le=1000)
    ground_separation_m: Gap = 2.0
    pad_gap_m: Gap = 0.5


class Radio(Model):
    """What team mates hear of each other: range (unlimited without one), share of lost messages, delay.

    ``mates`` is how many team mates, the nearest in range, a policy sees.
    """

    range_m: float | None = Field(default=None, ge=0.1, le=1e6)
    loss: Fraction = 0.0
    delay_s: float = Field(default=0.0, ge=0, le=10)
    mates: int = Field(default=8, ge=1, le=64)


class Mapping(Model):
    """Counts to a map, map to hotspots."""

    cell_m: float = Field(ge=0.05, le=1000)
    length_scale_m: float = Field(ge=0.01, le=10_000)
    hotspots_max: int = Field(ge=1, le=16)
    hotspot_separation_m: Length
    significance_sigma: float = Field(ge=0.1, le=100)


class Localisation(Model):
    """Estimate of the sources' number, places and activities from the likelihood of the counts.

    A source is one where twice the logarithm of the likelihood ratio exceeds the square of ``detection_sigma``; beside
    another one, whose errors of the model look like further sources, that of ``further_sigma``. Sources are looked for
    at points ``grid_m`` apart and in buildings, then within ``search_radius_m`` of the best of them, then in
    ``search_rounds`` rounds, each about half as far as the one before. The posterior of each is that of at most
    ``sample_rounds`` times ``samples`` places. ``rays_per_window`` lead to each window along its way, which walls'
    shadows may cross.
    """

    presumed_height_m: float = Field(ge=-5, le=100)
    height_std_m: float = Field(ge=0, le=100)
    window_s: float = Field(ge=1e-3, le=3600)
    rays_per_window: int = Field(default=3, ge=1, le=32)
    sources_max: int = Field(default=4, ge=1, le=8)
    detection_sigma: float = Field(default=5.5, ge=1, le=100)
    further_sigma: float = Field(default=7.8, ge=1, le=100)
    grid_m: float = Field(default=4.0, ge=0.1, le=1000)
    search_radius_m: float = Field(default=6.0, ge=0.01, le=1000)
    search_rounds: int = Field(default=7, ge=1, le=100)
    sample_rounds: int = Field(default=40, ge=1, le=100)
    samples: int = Field(default=24, ge=16, le=10_000)


class Knowledge(Model):
    """What the mission knows of the world; the rest of the truth is drawn for each mission within these bounds.

    ``site``: ``exact``; ``geometry``, with walls up to ``thickness_share`` thinner or thicker than presumed, alike for
    all of a material; ``terrain``, without anything that stands on it; ``none``, a plane. It limits the estimate alone:
    paths and routes are planned on the true site. Measured places are off by ``pose_std_m`` for each vehicle (RTK), and
    unless the site is exact by ``geometry_std_m`` for all alike, as its geometry was registered; the sensitivity of a
    detector model is off by ``sensitivity_std``. ``nuclides`` are those that the estimate considers; identification
    weighs the whole library.
    The level of the background over its nominal rate is fitted for each detector model, with a flat prior of its
    logarithm. ``background_std`` is how much a background may differ from one window to the next, ``model_std`` what is
    presumed of errors of the model of the rates in a window, and ``spectrum_std`` of each region of its spectrum beside
    that, all as standard deviations of logarithms. Errors of the model are alike in neighbouring windows, so that all
    of them together tell less of a place than if each had its own: in the posterior the logarithm of the likelihood
    counts ``learning_rate`` times. The activity of a source is presumed to be ``activity_mbq``, give or take a factor
    of ``activity_factor`` (one standard deviation of its logarithm), which decides where counts allow for a hundred
    megabecquerels of one nuclide or a terabecquerel of another.
    """

    site: Literal["exact", "geometry", "terrain", "none"] = "geometry"
    thickness_share: float = Field(default=0.5, ge=0, le=0.9)
    geometry_std_m: float = Field(default=0.05, ge=0, le=10)
    pose_std_m: float = Field(default=0.02, ge=0, le=10)
    sensitivity_std: float = Field(default=0.03, ge=0, le=0.5)
    background_std: float = Field(default=0.3, ge=0.01, le=1)
    model_std: float = Field(default=0.05, ge=0.001, le=1)
    spectrum_std: float = Field(default=0.02, ge=0, le=1)
    learning_rate: float = Field(default=0.8, ge=0.01, le=1)
    activity_mbq: float = Field(default=100.0, ge=1e-6, le=ACTIVITY_MAX_MBQ)
    activity_factor: float = Field(default=10.0, ge=1.1, le=1e9)
    nuclides: Literal["unknown"] | Annotated[tuple[Name, ...], Field(min_length=1, max_length=100)] = "unknown"


class Identification(Model):
    """Nuclide from the spectra taken within ``spectrum_radius_m`` of the estimated source.

    A nuclide is named when its confidence is at least ``confidence_min``.
    """

    spectrum_radius_m: float = Field(ge=0.01, le=10_000)
    confidence_min: Fraction


class Trigger(Model):
    """When a phase starts or ends: at a time, when another phase ends, or when something is found.

    ``delay_s`` is added to any of the three.
    """

    at_s: Delay | None = None
    after: Name | None = None
    when: Literal["hotspot"] | None = None
    delay_s: Delay = 0.0

    @model_validator(mode="after")
    def _one_condition(self) -> "Trigger":
        if sum(condition is not None for condition in (self.at_s, self.after, self.when)) != 1:
            raise ValueError("give exactly one of at_s (a time), after (a phase) and when (hotspot)")
        return self


def _as_tuple(who: Any) -> Any:
    """One name stands for a list of one."""
    return (who,) if isinstance(who, str) else tuple(who) if isinstance(who, list) else who


_Names = Annotated[tuple[Name, ...], Field(min_length=1, max_length=TEAM_MAX)]


class Phase(Model):
    """A part of the mission: who follows which policy, and from when to when.

    ``who`` are names of members, of formations, of vehicle types, of kinds (multirotor, skid_steer), or ``all``.
    ``policy`` is the name of a policy, ``file.py:object``, ``package.module:object``, or an entry point of the group
    ``swarmsim.policies``. ``settings`` are those of the policy. A phase that starts takes over its vehicles from an
    earlier one. It ends when each of its vehicles has done its task, at ``end``, or ``time_limit_s`` after its start.
    """

    name: Name
    who: Annotated[
        _Names,
        BeforeValidator(
            _as_tuple, json_schema_input_type=Name | Annotated[tuple[Name, ...], Field(max_length=TEAM_MAX)]
        ),
    ]
    policy: str = Field(min_length=1)
    settings: dict[str, Any] = Field(default_factory=dict)
    start: Trigger = Trigger(at_s=0.0)
    end: Trigger | None = None
    time_limit_s: Duration


class Definitions(Model):
    """Definitions that a scenario brings along; they come before the shipped ones.

    With ``complete`` nothing is taken from the configuration folders, so that a resolved scenario stays what it was.
    """

    complete: bool = False
    vehicles: dict[Name, Vehicle] = Field(default_factory=dict)
    detectors: dict[Name, Detector] = Field(default_factory=dict)
    sensors: dict[Name, Sensor] = Field(default_factory=dict)
    nuclides: dict[Name, Nuclide] = Field(default_factory=dict)
    materials: dict[Name, Material] = Field(default_factory=dict)


class Mission(Model):
    """A scenario (``configs/missions/<name>.yaml``).

    Without ``mapping`` there is no radiation map, without ``localisation`` no source is estimated, without
    ``identification`` no nuclide is named. ``vary`` makes a family of it: each mission draws the values at these dotted
    paths (``wind.speed_m_s``, ``sources.*.activity_mbq``) from its own seed. ``versions`` says what wrote a resolved
    scenario (package -> version); it changes nothing in the mission.
    """

    name: Name
    description: str = ""
    site: Name
    seed: int = Field(default=0, ge=0, lt=SEED_END)
    engine: Literal["mjx", "analytic"] = "mjx"
    detection: Literal["physical", "paper_ideal"] = "physical"
    timing: Timing = Timing()
    sources: tuple[Source, ...] = Field(max_length=SOURCES_MAX)
    vehicles: tuple[TeamMember, ...] = Field(min_length=1, max_length=TEAM_MAX)
    wind: Wind = Wind()
    background: BackgroundField = BackgroundField()
    effects: FlightEffects = FlightEffects()
    failsafes: Failsafes = Failsafes()
    autopilot: Autopilot = Autopilot()
    traffic: Traffic = Traffic()
    radio: Radio = Radio()
    mapping: Mapping | None = None
    knowledge: Knowledge = Knowledge()
    localisation: Localisation | None = None
    identification: Identification | None = None
    phases: tuple[Phase, ...] = Field(min_length=1, max_length=PHASES_MAX)
    vary: dict[VariedPath, Distribution | None] = Field(default_factory=dict, max_length=VARIED_MAX)
    definitions: Definitions = Definitions()
    versions: dict[str, str] = Field(default_factory=dict)
