"""Colours of everything that is drawn: vehicles, count rates, marks of sources; safe for colour-blind readers."""

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from numpy.typing import NDArray

from swarmsim.results.record import MissionRecord, Phase, Samples, VehicleRecord

# Okabe & Ito (2008), "Color universal design", without its black and its yellow (too pale on paper).
_FLYING = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9")
_DRIVING = ("#8A3700", "#F2A36B", "#4D4D4D")  # its vermilion, darker and lighter, and grey
TRUTH = "#D55E00"  # its vermilion, which no vehicle has
ESTIMATE = "#0072B2"
RATE_MAP = "viridis"
FLOWN, DRIVEN = "flown", "driven"
"""Colour scales of count rates, by how the phase moves that they were measured in."""
PAD_M = 3.0  # around where a track begins or ends


def vehicle_colours(record: MissionRecord) -> list[str]:
    """A colour (hex) for each vehicle of a mission."""
    return team_colours(record.vehicles)


def team_colours(vehicles: Sequence[VehicleRecord]) -> list[str]:
    """A colour (hex) for each vehicle: rovers and multirotors each cycle through colours of their own."""
    colours, used = [], {True: 0, False: 0}
    for vehicle in vehicles:
        palette = _FLYING if vehicle.flies else _DRIVING
        colours.append(palette[used[vehicle.flies] % len(palette)])
        used[vehicle.flies] += 1
    return colours


def rgba(colour: str, alpha: int = 255) -> list[int]:
    """``#RRGGBB`` as [r, g, b, alpha] of 0 to 255."""
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)] + [alpha]


@dataclass(frozen=True)
class RateScale:
    """From count rate (1/s) to colour."""

    norm: Normalize

    def __call__(self, rate_cps: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Colours [..., 4] (RGBA, 0 to 255) of ``rate_cps`` [...]."""
        return np.asarray(matplotlib.colormaps[RATE_MAP](self.norm(rate_cps), bytes=True), np.uint8)

    @property
    def limits_cps(self) -> tuple[float, float]:
        """Rates at the two ends of the scale."""
        return float(self.norm.vmin or 0.0), float(self.norm.vmax or 0.0)


def linear_scale(rate_cps: NDArray[np.floating]) -> RateScale:
    """A linear scale over the bulk of ``rate_cps`` [n]: 2nd percentile to the largest."""
    if rate_cps.size == 0:
        return RateScale(Normalize(0.0, 1.0))
    low, high = float(np.percentile(rate_cps, 2.0)), float(rate_cps.max())
    return RateScale(Normalize(low, max(high, low + 1.0), clip=True))


def log_scale(rate_cps: NDArray[np.floating]) -> RateScale:
    """A logarithmic scale over ``rate_cps`` [n]; rates below 1 cps count as 1."""
    if rate_cps.size == 0:
        return RateScale(LogNorm(1.0, 10.0, clip=True))
    low, high = max(float(rate_cps.min()), 1.0), float(rate_cps.max())
    return RateScale(LogNorm(low, max(high, 1.1 * low), clip=True))


def smoothed_rate(samples: Samples, window_s: float = 1.0) -> NDArray[np.floating]:
    """Count rate [n] averaged over ``window_s`` around each sample, each vehicle by itself.

    Single samples of a tenth of a second hold a handful of counts; their colours would show the Poisson noise alone.
    Sum of counts over sum of exposures, so that both kinds of detector average rightly.
    """
    rate = np.zeros(len(samples.time_s))
    for vehicle in np.unique(samples.vehicle):
        mine = np.flatnonzero(samples.vehicle == vehicle)
        time = samples.time_s[mine]
        first = np.searchsorted(time, time - 0.5 * window_s, side="left")
        last = np.searchsorted(time, time + 0.5 * window_s, side="right")
        counts = np.r_[0.0, np.cumsum(samples.counts[mine], dtype=float)]
        exposure = np.r_[0.0, np.cumsum(samples.exposure_s[mine], dtype=float)]
        rate[mine] = (counts[last] - counts[first]) / np.maximum(exposure[last] - exposure[first], 1e-9)
    return rate


def away_from_pads(record: MissionRecord, samples: Samples) -> NDArray[np.bool_]:
    """Which samples [n] were not taken above the place where their vehicle starts or ends; all where none were.

    There a vehicle counts for long and at every height. The ground is near, so that without a strong source the rates
    of starts and landings would set the scale of a survey.
    """
    away = np.ones(len(samples.time_s), bool)
    for number in np.unique(samples.vehicle):
        mine, track = samples.vehicle == number, record.vehicles[number].position_m
        for pad in track[[0, -1], :2] if len(track) else ():
            away[mine] &= np.linalg.norm(samples.position_m[mine, :2] - pad, axis=1) > PAD_M
    return away if away.any() else np.ones_like(away)


def measured_phases(record: MissionRecord) -> list[Phase]:
    """The phases in which something was measured."""
    measured = set(record.samples.phase.tolist())
    return [phase for phase in record.phases if phase.name in measured]


def scale_name(record: MissionRecord, phase: Phase) -> str:
    """Which colour scale the count rates of a phase have: `FLOWN` or `DRIVEN`."""
    return FLOWN if record.is_flown(phase) else DRIVEN


def rate_scales(record: MissionRecord) -> dict[str, RateScale]:
    """The colour scales of a mission: linear for what was measured in flight and for the map, which share theirs.

    What rovers measured has a logarithmic one, since count rates rise steeply near a source. A mission without a map
    that measured nothing has none.
    """
    rates: dict[str, list[NDArray[np.floating]]] = {FLOWN: [], DRIVEN: []}
    if record.map is not None:
        rates[FLOWN].append(record.map.mean_cps.reshape(-1))
    for phase in measured_phases(record):
        samples = record.samples.of_phase(phase.name)
        name = scale_name(record, phase)
        if name == FLOWN:
            samples = samples.rows(away_from_pads(record, samples))
        rates[name].append(smoothed_rate(samples))
    made = {FLOWN: linear_scale, DRIVEN: log_scale}
    return {name: made[name](np.concatenate(values)) for name, values in rates.items() if values}
