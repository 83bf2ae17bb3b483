"""What one flown mission leaves behind, as numpy arrays on the host: the input of all that is written or shown."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.sources import Form

Floats = NDArray[np.floating]
Window = tuple[float, float]
"""Lower and upper end in keV of an energy window."""
Sought = Literal["nothing", "source", "nuclide"]
"""What a mission was to find; nuclide: a source with its nuclide."""


@dataclass(frozen=True)
class Event:
    """Something that happened to a vehicle."""

    time_s: float
    vehicle: str
    kind: (
        str  # one of `swarmsim.world.events.KINDS`, which end its part; finished or time_limit for its part in a phase
    )
    detail: str


@dataclass(frozen=True)
class Shape:
    """What a vehicle looks like, as far as a picture needs it: a box with discs (rotors or wheels). Body frame FLU."""

    hubs_m: Floats  # [k, 3] centres of the rotors or wheels
    radius_m: float  # of a rotor or wheel
    width_m: float  # of a wheel; 0 for a rotor
    box_centre_m: Floats  # [3]
    box_size_m: Floats  # [3] length, width, height


@dataclass(frozen=True)
class VehicleRecord:
    """The track of one vehicle at the logging rate; world ENU, quaternion w x y z body (FLU) to world."""

    name: str
    type: str
    kind: str  # multirotor | skid_steer
    time_s: Floats  # [n]
    position_m: Floats  # [n, 3]
    quaternion: Floats  # [n, 4]
    velocity_m_s: Floats  # [n, 3]
    energy_wh: Floats  # [n] used since the start
    battery_fraction: Floats  # [n] left, 0 to 1
    crashed: bool
    shape: Shape | None = None  # None: drawn as a generic body of its kind

    @property
    def flies(self) -> bool:
        """Whether it leaves the ground."""
        return self.kind == "multirotor"


@dataclass(frozen=True)
class Samples:
    """Detector measurements of all vehicles in time order."""

    vehicle: NDArray[np.int32]  # [n] index into MissionRecord.vehicles
    phase: NDArray[np.str_]  # [n] name of the phase that the vehicle was in
    time_s: Floats  # [n] end of the counting interval
    position_m: Floats  # [n, 3] of the crystal
    counts: Floats  # [n]
    exposure_s: Floats  # [n] real time that the counts stand for, dead time included
    count_rate_cps: Floats  # [n] counts / exposure, not corrected for dead time
    axis: Floats | None = None  # [n, 3] unit vector along the crystal, mean, world; None, as all below: not recorded
    windows: Floats | None = None  # [n, W] counts by `MissionRecord.windows_kev`, nan: not of this detector
    live_s: Floats | None = None  # [n] live time: the exposure less the dead time, by the detector's law
    dose_rate_usv_h: Floats | None = None  # [n] H*(10) by the counts (`DoseOperator`), natural background included
    dose_rate_std_usv_h: Floats | None = None  # [n] its standard deviation by counting statistics
    kerma_rate_ugy_h: Floats | None = None  # [n] air kerma rate by the counts
    saturated: NDArray[np.bool_] | None = None  # [n] the counter was in its dead time (`swarmsim.results.saturation`)

    def rows(self, index: NDArray[Any] | slice) -> "Samples":
        """Those that ``index`` chooses, in its order."""
        columns: dict[str, Any] = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return replace(self, **{name: each[index] for name, each in columns.items() if each is not None})

    def of_phase(self, phase: str) -> "Samples":
        """Those of one phase."""
        return self.rows(self.phase == phase)

    def until(self, time_s: float) -> "Samples":
        """Those that had ended at ``time_s``."""
        return self.rows(slice(int(np.searchsorted(self.time_s, time_s, "right"))))


@dataclass(frozen=True)
class RadiationMap:
    """Interpolated count rate on a grid; row 0 is the south edge, column 0 the west edge."""

    origin_m: Floats  # [2] centre of cell [0, 0]
    cell_m: float
    mean_cps: Floats  # [ny, nx]
    std_cps: Floats  # [ny, nx]
    hotspots_m: Floats  # [h, 2] strongest first


@dataclass(frozen=True)
class Estimate:
    """A source estimate with its uncertainty (one standard deviation of the posterior)."""

    position_m: Floats  # [3]
    covariance_m2: Floats  # [3, 3]
    activity_mbq: float
    activity_std_mbq: float
    background_scale: float  # estimated background over the detector's nominal one
    nuclide: str  # for which it was estimated
    nuclide_confidence: float = 1.0  # of that nuclide among those in question, by the regions of interest
    detection: float = np.inf  # twice the logarithm of the likelihood ratio against the same without it
    effective_samples: float = np.inf  # independent places that the posterior's weighted ones are worth
    converged: bool = True  # those are enough, and two halves of them agree
    errors_known: bool = True  # not where a counter was saturated: standard deviations are then left out of all results
    joined_m: float = 0.0  # so far off another one of its nuclide would explain the counts better; 0: none
    beside_mbq: float = np.inf
    """Activity from which on another one of its nuclide, 3 to 12 m off, would have been noticed with 95 %, at nine of
    ten places (a detection limit, ISO 11929); infinite where none would.
    """


@dataclass(frozen=True)
class Spectrum:
    """The spectrum accumulated near the source, and what was read from it."""

    energy_kev: Floats  # [c] channel centres
    counts: Floats  # [c]
    background: Floats  # [c] expected background counts in the live time
    fit: Floats  # [c] fitted counts of the best nuclide plus background
    live_time_s: float  # real time of its samples, all of which is live: it is drawn without dead time
    nuclide: str  # "none" where the background explains the counts, "unknown" where no nuclide of the library does
    confidence: float  # of that answer
    scores: dict[str, float]  # posterior of every candidate nuclide
    lines_kev: Floats = field(default_factory=lambda: np.zeros(0))  # [l] gamma lines of the named nuclide, for labels
    unknown: float = 0.0  # probability of a source that no nuclides of the library explain
    goodness: float = 1.0  # p-value of the deviance of the fit
    detector: str = ""  # model that took it
    begin_s: float = 0.0  # when its first sample began
    sure: bool = True  # the confidence is what the mission asks for (`identification.confidence_min`)
    alike: str = ""  # the nuclide outside the library that an unknown source most likely is, if likelier than not


@dataclass(frozen=True)
class TrueSource:
    """Ground truth of one source."""

    nuclide: str
    position_m: Floats  # [3] of a line or an area its centre of activity, of a carried one where it was at the start
    activity_mbq: float  # of the whole source, at the start
    form: Form = "point"
    points_m: Floats | None = None  # [p, 3] that a line or an area was computed as
    corners_m: Floats | None = None  # [k, 3] of a line or an area, at its height above the terrain
    carrier: int | None = None  # index into MissionRecord.vehicles of the vehicle that carries it
    offset_m: Floats | None = None  # [3] in the carrier's body frame


def carried_m(position_m: Floats, quaternion: Floats, offset_m: Floats | None) -> Floats:
    """World places [n, 3] of a point ``offset_m`` [3] (body) from vehicles at poses [n, 3] and [n, 4]; host."""
    place = np.asarray(position_m, float)
    if offset_m is None:
        return place
    turn = np.asarray(quaternion, float)
    twice = 2.0 * np.cross(turn[:, 1:], offset_m)
    return place + offset_m + turn[:, :1] * twice + np.cross(turn[:, 1:], twice)


@dataclass(frozen=True)
class Departures:
    """How far the truth of a mission departs from what it presumes (`swarmsim.config.mission.Knowledge`)."""

    thickness_factor: Mapping[str, float]  # true over presumed thickness of what stands there, by material
    sensitivity_factor: Mapping[str, float]  # true over presumed sensitivity, by detector model
    # [3] measured less true place (ENU), by vehicle, with what all have in common; none where nothing is estimated
    pose_error_m: Mapping[str, Floats]


@dataclass(frozen=True)
class GammaConstant:
    """Dose rates 1 m from a source of 1 MBq with nothing around it."""

    ambient_usv_h: float  # ambient dose equivalent H*(10)
    kerma_ugy_h: float  # air kerma


@dataclass(frozen=True)
class Phase:
    """A phase of the mission: who was in it, and its simulated time span."""

    name: str
    policy: str
    vehicles: tuple[int, ...]  # indices into MissionRecord.vehicles
    start_s: float
    end_s: float
    in_time: bool  # it was not cut off by its time limit


@dataclass(frozen=True)
class MissionRecord:
    """One mission, whole. What it did not find, or was not to look for, is None."""

    name: str
    site: str
    seed: int
    phases: tuple[Phase, ...]  # those that began, in the order of the scenario
    vehicles: tuple[VehicleRecord, ...]
    samples: Samples
    sought: Sought
    map: RadiationMap | None  # of the counts until ``surveyed_s``
    survey_estimate: Estimate | None  # from the same counts; the last one that a phase went by
    surveyed_s: float  # when both were made
    estimate: Estimate | None  # from all counts, of the surest source
    spectrum: Spectrum | None
    sources: tuple[TrueSource, ...]
    paths_m: dict[int, Floats]  # last planned path [r, 3] of a vehicle by its index
    events: tuple[Event, ...]
    finding: str  # one sentence: what the mission found
    status: str = "not_sought"  # what that is worth, see `swarmsim.results.status.Status`
    covered: float | None = None  # share of the survey area that was measured; None where nothing was sought
    warnings: tuple[str, ...] = ()  # what makes parts of the result doubtful
    survey_further: tuple[Estimate, ...] = ()  # further sources by the survey's counts
    further: tuple[Estimate, ...] = ()  # further sources by all counts
    noticed_mbq: Mapping[str, float] = field(default_factory=dict)
    """Activity by nuclide in question from which on a source in free view, beside those found, would have been noticed
    with 95 %, at 95 % of the survey area (a detection limit, ISO 11929); infinite where none would.
    """
    examined: int | None = None  # number of the one of ``estimates`` that the spectrum was taken near; None: of none
    drawn: Mapping[str, Any] = field(default_factory=dict)  # what the mission of a family drew, by path
    windows_kev: tuple[Window, ...] = ()  # energy windows of all detectors, lowest first
    at_1_m: Mapping[str, GammaConstant] = field(default_factory=dict)  # by nuclide, of those found and the true ones
    departures: Departures | None = None  # None where no vehicle has a detector

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """All sources found, the surest first."""
        return () if self.estimate is None else (self.estimate, *self.further)

    @property
    def survey_estimates(self) -> tuple[Estimate, ...]:
        """All sources by the survey's counts, the surest first."""
        return () if self.survey_estimate is None else (self.survey_estimate, *self.survey_further)

    def track_of(self, source: TrueSource) -> Floats:
        """Where a carried source was [n, 3], at the times of its carrier's track."""
        assert source.carrier is not None
        carrier = self.vehicles[source.carrier]
        return carried_m(carrier.position_m, carrier.quaternion, source.offset_m)

    def phase(self, name: str) -> Phase | None:
        """The phase of a name; None where it did not begin."""
        return next((phase for phase in self.phases if phase.name == name), None)

    def is_flown(self, phase: Phase) -> bool:
        """Whether a vehicle of the phase flies."""
        return any(self.vehicles[number].flies for number in phase.vehicles)

    @property
    def start_s(self) -> float:
        """When the first phase began."""
        return min((phase.start_s for phase in self.phases), default=0.0)

    @property
    def end_s(self) -> float:
        """When the last phase ended."""
        return max((phase.end_s for phase in self.phases), default=0.0)

    def finite(self) -> "MissionRecord":
        """The mission without rows that are not finite: what a vehicle lost to a numerical failure left behind."""
        vehicles = []
        for vehicle in self.vehicles:
            state = np.concatenate([vehicle.position_m, vehicle.quaternion, vehicle.velocity_m_s], axis=1)
            keep = np.isfinite(state).all(axis=1) & np.isfinite(vehicle.energy_wh)
            columns = ("time_s", "position_m", "quaternion", "velocity_m_s", "energy_wh", "battery_fraction")
            vehicles.append(replace(vehicle, **{name: getattr(vehicle, name)[keep] for name in columns}))
        samples = self.samples
        whole = np.isfinite(samples.position_m).all(axis=1) & np.isfinite(samples.counts)
        return replace(self, vehicles=tuple(vehicles), samples=samples.rows(whole))
