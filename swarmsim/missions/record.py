"""What one flown mission leaves behind, as numpy arrays on the host: the input of all that is written or shown."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class Event:
    """Something that happened to a vehicle: ``kind`` is crash, collision, landed, battery_empty, non_finite …"""

    time_s: float  # inf: by the end of the mission
    vehicle: str
    kind: str
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


@dataclass(frozen=True)
class Samples:
    """Detector measurements of all vehicles in time order."""

    vehicle: NDArray[np.int32]  # [n] index into MissionRecord.vehicles
    phase: NDArray[np.str_]  # [n] "aerial" | "ground"
    time_s: Floats  # [n] end of the counting interval
    position_m: Floats  # [n, 3] of the crystal
    counts: Floats  # [n]
    exposure_s: Floats  # [n] live interval that the counts stand for
    count_rate_cps: Floats  # [n] counts / exposure

    def of_phase(self, phase: str) -> "Samples":
        """Those of one phase."""
        keep = self.phase == phase
        return Samples(*(getattr(self, f)[keep] for f in self.__dataclass_fields__))

    def until(self, time_s: float) -> "Samples":
        """Those that had ended at ``time_s``."""
        return Samples(
            *(getattr(self, f)[: np.searchsorted(self.time_s, time_s, "right")] for f in self.__dataclass_fields__)
        )


@dataclass(frozen=True)
class RadiationMap:
    """Interpolated aerial count rate on a grid; row 0 is the south edge, column 0 the west edge."""

    origin_m: Floats  # [2] centre of cell [0, 0]
    cell_m: float
    mean_cps: Floats  # [ny, nx]
    std_cps: Floats  # [ny, nx]
    hotspots_m: Floats  # [h, 2] strongest first


@dataclass(frozen=True)
class Estimate:
    """A source estimate with its uncertainty (one standard deviation, from the Fisher information)."""

    position_m: Floats  # [3]
    covariance_m2: Floats  # [3, 3]
    activity_mbq: float
    activity_std_mbq: float
    background_scale: float  # estimated background over the detector's nominal one
    nuclide: str  # hypothesis under which it was fitted


@dataclass(frozen=True)
class Spectrum:
    """The rover's accumulated spectrum and what was read from it."""

    energy_kev: Floats  # [c] channel centres
    counts: Floats  # [c]
    background: Floats  # [c] expected background counts in the same live time
    fit: Floats  # [c] fitted counts of the best nuclide plus background
    live_time_s: float
    nuclide: str  # "none" where no nuclide explains the counts
    confidence: float
    scores: dict[str, float]  # posterior of every candidate nuclide
    lines_kev: Floats = field(default_factory=lambda: np.zeros(0))  # [l] gamma lines of the named nuclide, for labels


@dataclass(frozen=True)
class TrueSource:
    """Ground truth of one source."""

    nuclide: str
    position_m: Floats  # [3]
    activity_mbq: float


@dataclass(frozen=True)
class Phase:
    """A phase of the mission and its simulated time span."""

    name: str  # its first word is that of its samples' phase: aerial survey, ground search
    start_s: float
    end_s: float


@dataclass(frozen=True)
class MissionRecord:
    """One mission, whole. ``aerial_estimate``, ``estimate``, ``spectrum`` are None where the mission found nothing."""

    name: str
    site: str
    seed: int
    phases: tuple[Phase, ...]
    vehicles: tuple[VehicleRecord, ...]
    samples: Samples
    map: RadiationMap
    aerial_estimate: Estimate | None
    estimate: Estimate | None
    spectrum: Spectrum | None
    sources: tuple[TrueSource, ...]
    route_m: Floats  # [r, 3] planned route of the rover
    events: tuple[Event, ...]
    finding: str  # one sentence: what the mission found

    def span(self, phase: str) -> tuple[float, float] | None:
        """Start and end (s) of the ``aerial`` or ``ground`` phase; None where the mission had none."""
        return next(((p.start_s, p.end_s) for p in self.phases if p.name.split()[0] == phase), None)

    @property
    def end_s(self) -> float:
        """When the last phase ended."""
        return max(p.end_s for p in self.phases)

    @property
    def survey_end_s(self) -> float:
        """When the aerial phase ended: what was learnt from the air is known from then on; 0 without such a phase."""
        span = self.span("aerial")
        return 0.0 if span is None else span[1]

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
        kept = Samples(*(getattr(samples, f)[whole] for f in samples.__dataclass_fields__))
        return replace(self, vehicles=tuple(vehicles), samples=kept)
