"""What an answer is worth: a status and a sentence, from every diagnostic that the mission computed."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from swarmsim.results.record import RadiationMap, Samples

Floats = NDArray[np.floating]
Status = Literal[
    "located", "ambiguous", "detected", "none", "saturated", "inconsistent", "incomplete_survey", "not_sought"
]
CERTAIN: tuple[Status, ...] = ("located", "none", "not_sought")
"""Statuses that stand for an answer; with the others ``swarmsim run --strict`` ends with 3."""

SATURATED_SHARE = 0.6  # of the highest rate that a counter can show: a quarter of the pulses is lost
PARALYSED_SHARE = 0.1  # of the nominal background: a counter that shows less is paralysed or broken
COVERED_SHARE = 0.8  # of the survey area must have been measured
REACH_HEIGHTS = 1.0  # a measurement covers the ground around it up to its own height, at least `REACH_M`
REACH_M = 8.0
FAR_STD_M = 10.0  # a source known no better is detected, not located
DEVIANCE_SIGMA, DEVIANCE_LEAST = 6.0, 1.15  # a reduced deviance above both contradicts the model
APART_SIGMA = 5.0  # between the estimates from the air and from all counts
MODEL_STD_M, MODEL_STD_LOG = 0.5, 0.1  # errors that the two estimates have not in common, in place and in activity
UNEXPLAINED_M = 25.0  # a hotspot farther from the estimate is not explained by it


@dataclass(frozen=True)
class Diagnostics:
    """What tells how far the fit of a source can be believed."""

    reduced_deviance: float  # about 1 for a model that describes the counts
    windows: int  # that were fitted
    effective_samples: float  # of the posterior
    converged: bool
    detection: float  # likelihood ratio against no source


@dataclass(frozen=True)
class Verdict:
    """Status of a mission's answer, its sentence, and shares that both follow from."""

    status: Status
    reasons: tuple[str, ...]  # sentences
    covered: float  # share of the survey area that was measured


def assess(
    samples: Samples,
    chart: RadiationMap,
    limits_cps: tuple[Floats, Floats],
    ground_m: Floats,
    found: bool,
    diagnostics: Diagnostics,
    aerial: Any,
    final: Any,
) -> Verdict:
    """Judge an answer.

    Args:
        samples: all measurements.
        chart: the radiation map, whose cells are the survey area.
        limits_cps: for each sample [n] the highest rate that its counter can show (inf: any), and its background.
        ground_m: height of the ground below each sample [n].
        found: whether a source was found at all.
        diagnostics: of the final fit.
        aerial: estimate of the survey (`swarmsim.results.record.Estimate`), or None.
        final: the same from all counts, or None.
    """
    covered = coverage(samples, chart, ground_m)
    reasons = []
    status: Status = "located" if found else "none"
    if _saturated(samples, limits_cps):
        status = "saturated"
        reasons.append("a counter was driven into its dead time, so rates and places close to the source are doubtful")
    if covered < COVERED_SHARE:
        status = "incomplete_survey" if status in ("none", "located") else status
        reasons.append(f"only {covered:.0%} of the survey area was measured")
    if found and final is not None:
        doubts = _doubts(chart, diagnostics, aerial, final)
        if doubts and status == "located":
            status = doubts[0][0]
        reasons += [sentence for _, sentence in doubts]
    return Verdict(status, tuple(reasons), covered)


def coverage(samples: Samples, chart: RadiationMap, ground_m: Floats) -> float:
    """Share of the map's cells with a measurement near them: within the measurement's height above ground."""
    ny, nx = chart.mean_cps.shape
    x = chart.origin_m[0] + chart.cell_m * np.arange(nx)
    y = chart.origin_m[1] + chart.cell_m * np.arange(ny)
    cells = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    place = np.asarray(samples.position_m, float)
    if not len(place):
        return 0.0
    reach = np.maximum(REACH_HEIGHTS * (place[:, 2] - ground_m), REACH_M)
    seen = np.zeros(len(cells), bool)
    for low in np.unique(np.floor(reach / 4.0) * 4.0):
        chosen = (reach >= low) & (reach < low + 4.0)
        distance, _ = cKDTree(place[chosen, :2]).query(cells, distance_upper_bound=max(low, REACH_M) + 1e-6)
        seen |= np.isfinite(distance)
    return float(seen.mean())


def _saturated(samples: Samples, limits_cps: tuple[Floats, Floats]) -> bool:
    highest, background = limits_cps
    rate, counts = np.asarray(samples.count_rate_cps, float), np.asarray(samples.exposure_s, float) * background
    if np.any(rate > SATURATED_SHARE * highest):
        return True
    # two seconds of background at least: a single silent sample is chance
    silent = rate < PARALYSED_SHARE * background
    return bool(counts[silent].sum() > 0.02 * counts.sum() + 50.0)


def _doubts(chart: RadiationMap, diagnostics: Diagnostics, aerial: Any, final: Any) -> list[tuple[Status, str]]:
    """Reasons not to call a source located, the gravest first."""
    found: list[tuple[Status, str]] = []
    spread = np.sqrt(2.0 / max(diagnostics.windows, 1))
    if diagnostics.reduced_deviance > max(1.0 + DEVIANCE_SIGMA * spread, DEVIANCE_LEAST):
        found.append((
            "inconsistent",
            f"the counts contradict a single source as modelled (reduced deviance {diagnostics.reduced_deviance:.1f})",
        ))  # fmt: skip
    if aerial is not None:
        found += _disagreement(aerial, final)
    std = np.sqrt(np.maximum(np.diag(np.asarray(final.covariance_m2))[:2].max(), 0.0))
    if not diagnostics.converged:
        few = f"the search for the most likely place did not settle ({diagnostics.effective_samples:.0f} samples count)"
        found.append(("detected", few))
    elif std > FAR_STD_M:
        found.append(("detected", f"its place is known to {std:.0f} m only"))
    away = np.linalg.norm(np.asarray(chart.hotspots_m).reshape(-1, 2) - np.asarray(final.position_m)[:2], axis=1)
    if np.any(away > UNEXPLAINED_M):
        places = ", ".join(f"({x:.0f}, {y:.0f})" for x, y in np.asarray(chart.hotspots_m)[away > UNEXPLAINED_M][:4])
        found.append(("ambiguous", f"hotspots far from it suggest further sources, at {places} m"))
    return found


def _disagreement(aerial: Any, final: Any) -> list[tuple[Status, str]]:
    apart = np.asarray(final.position_m, float)[:2] - np.asarray(aerial.position_m, float)[:2]
    covariance = np.asarray(final.covariance_m2)[:2, :2] + np.asarray(aerial.covariance_m2)[:2, :2]
    covariance = covariance + MODEL_STD_M**2 * np.eye(2)
    if float(apart @ np.linalg.solve(covariance, apart)) > APART_SIGMA**2:
        distance = float(np.linalg.norm(apart))
        return [("inconsistent", f"the estimates from the air and from all counts lie {distance:.0f} m apart")]
    shares = [e.activity_std_mbq / max(e.activity_mbq, 1e-9) for e in (aerial, final)]
    ratio = np.log(max(final.activity_mbq, 1e-9) / max(aerial.activity_mbq, 1e-9))
    if aerial.nuclide == final.nuclide and abs(ratio) > APART_SIGMA * np.hypot(np.hypot(*shares), MODEL_STD_LOG):
        text = f"the activities from the air and from all counts differ {np.exp(abs(ratio)):.3g} times"
        return [("inconsistent", text)]
    return []
