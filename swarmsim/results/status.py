"""What an answer is worth: a status and a sentence, from every diagnostic that the mission computed."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from swarmsim.estimation.pairs import COMPANION_M
from swarmsim.results.doubts import (
    CONFIRMED,
    Status,
    apart_m,
    companions,
    contradicted,
    implausible,
    in_mbq,
    mixed,
    unsure_nuclides,
    unusual_heights,
)
from swarmsim.results.record import Estimate, GammaConstant, RadiationMap, Samples
from swarmsim.site.raster import in_areas

Floats = NDArray[np.floating]
CERTAIN: tuple[Status, ...] = ("located", "none", "not_sought")
"""Statuses that stand for an answer; with the others ``swarmsim run --strict`` ends with 3."""

COVERED_SHARE = 0.8  # of the survey area must have been measured
REACH_HEIGHTS = 1.0  # a measurement covers the ground around it up to its own height, at least `REACH_M`
REACH_M = 8.0
AT_ONCE = 1024  # measurements whose cells are looked up together
FAR_STD_M = 10.0  # a source known no better is detected, not located
MISFIT_SIGMA, MISFIT_LEAST = 6.0, 1.1  # a chi-squared above both contradicts the model
STRAINED = 350.0
"""What rates depart from the sources as modelled by beyond what is usual, in twice a log prior, at most.

Of 300 missions, good answers had up to 200, but for one of 400 in a barn; wrong ones in barns and two sources in the
place of one 400 to 1300.
"""
APART_SIGMA = 5.0  # between the estimates from the air and from all counts
MODEL_STD_M, MODEL_STD_LOG = 0.5, 0.1  # errors that the two estimates have not in common, in place and in activity
EXCLUDED = "the counts show a source of a nuclide that is not in question (knowledge.nuclides)"
MORE = "as many sources are found as are sought (localisation.sources_max), so that there may be more"
SUSPECTED = (
    "a further source is suspected, perhaps of {}: with it the counts are explained better than chance allows, but no "
    "better than errors of the model may (localisation.further_sigma)"
)
UNEXPLAINED_M = 25.0  # a hotspot farther from the estimate is not explained by it
UNEXPLAINED_SIGMA = 3.0  # of the background: a hotspot that exceeds it by less may be of the background


@dataclass(frozen=True)
class Fit:
    """How well the sources found describe the counts."""

    misfit: float  # standard deviations by which chi-squared exceeds its degrees of freedom
    chi_squared: float  # over its degrees of freedom
    strain: float = 0.0  # what rates depart from the model by, beyond what is usual (`Estimated.strain`)
    unsought: float = 0.0  # `Estimated.unsought`
    suspected: float = 0.0  # `Estimated.suspected`
    suspect: str = ""  # what that would be: "K-40 near (10, -3)"
    full: bool = False  # as many sources are found as are sought
    load: float = 0.0  # highest true rate of a counter by them, over that at which it shows `SATURATED_SHARE`


@dataclass(frozen=True)
class Verdict:
    """Status of a mission's answer, its sentence, and shares that both follow from."""

    status: Status
    reasons: tuple[str, ...]  # sentences
    covered: float  # share of the survey area that was measured


def assess(
    samples: Samples,
    chart: RadiationMap,
    ground_m: Floats,
    fit: Fit,
    aerial: Sequence[Estimate],
    final: Sequence[Estimate],
    background_std: float,
    activity: tuple[float, float],
    at_1_m: Mapping[str, GammaConstant] = MappingProxyType({}),
    identified: Mapping[str, float] = MappingProxyType({}),
    suggested: str = "",
    spectrum_of: int = 0,
    noticed_mbq: Mapping[str, float] = MappingProxyType({}),
    areas_m: Sequence[Floats] = (),
    heights: Sequence[float] = (),
) -> Verdict:
    """Judge an answer.

    Args:
        samples: all measurements.
        chart: the radiation map.
        ground_m: height of the ground below each sample [n].
        fit: of all sources to all counts.
        aerial: sources by the survey's counts.
        final: sources by all counts, the surest first.
        background_std: how much a background may differ from place to place, of its logarithm.
        activity: what is presumed of a source's, in MBq, and the standard deviation of its logarithm.
        at_1_m: dose rates of the nuclides that were found, by which the strength of different ones is compared.
        identified: probability of each nuclide in the spectrum.
        suggested: the nuclide that the spectrum is of, or "unknown"; empty where none was taken or it shows none.
        spectrum_of: number of the source near which it was taken (`source_of_spectrum`).
        noticed_mbq: activities from which on nuclides would have been noticed (`MissionRecord.noticed_mbq`).
        heights: of ``final`` above the ground, in standard deviations from what is presumed.
        areas_m: that were to be surveyed, convex polygons with corners [V, 2]; by default all that is mapped.
    """
    covered = coverage(samples, chart, ground_m, areas_m)
    reasons = []
    status: Status = "located" if final else "none"
    if fit.load > 1.0 or (samples.saturated is not None and np.any(samples.saturated)):
        status = "saturated"
        reasons.append("a counter was driven into its dead time, so rates and places close to the source are doubtful")
    if covered < COVERED_SHARE:
        status = "incomplete_survey" if status in ("none", "located") else status
        reasons.append(f"only {covered:.0%} of the survey area was measured")
    if not final and min(noticed_mbq.values(), default=0.0) > activity[0]:
        status = "incomplete_survey" if status == "none" else status
        reasons.append(f"one as presumed, of {in_mbq(activity[0])} (knowledge.activity_mbq), would have gone unnoticed")
    strength = [one.activity_mbq * at_1_m[one.nuclide].kerma_ugy_h if at_1_m else one.activity_mbq for one in final]
    examined = final[spectrum_of] if final else None
    doubts = _doubts(chart, fit, aerial, final, background_std)
    doubts += companions(final, strength, examined, identified) + implausible(final, *activity)
    doubts += mixed(final, examined, identified) + contradicted(final, examined, suggested, identified)
    doubts += unsure_nuclides(final, examined, suggested) + unusual_heights(final, heights)
    if fit.full and (len(final) > 1 or fit.unsought > 1.0):  # who seeks one knows that there is one
        doubts.append(("ambiguous", MORE))
    if final and not fit.full and fit.suspected > 1.0:
        doubts.append(("ambiguous", SUSPECTED.format(fit.suspect)))
    if not final and fit.unsought > 1.0:
        doubts.append(("inconsistent", EXCLUDED))
    if doubts and status in ("located", "none"):
        status = doubts[0][0]
    if status == "saturated":  # no errors of places are stated
        doubts = [doubt for doubt in doubts if doubt[0] != "detected"]
    reasons += [sentence for _, sentence in doubts]
    return Verdict(status, tuple(reasons), covered)


def coverage(samples: Samples, chart: RadiationMap, ground_m: Floats, areas_m: Sequence[Floats] = ()) -> float:
    """Share of the map's cells with a measurement near them: within its height above the ground, or `REACH_M`.

    Of the cells in ``areas_m`` where there are any.
    """
    ny, nx = chart.mean_cps.shape
    x = chart.origin_m[0] + chart.cell_m * np.arange(nx)
    y = chart.origin_m[1] + chart.cell_m * np.arange(ny)
    cells = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside = in_areas(cells, areas_m)
    cells = cells[inside] if np.any(inside) else cells
    place = np.asarray(samples.position_m, float)
    if not len(place):
        return 0.0
    reach = np.maximum(REACH_HEIGHTS * (place[:, 2] - ground_m), REACH_M)
    seen = np.zeros(len(cells), bool)
    tree = cKDTree(cells)
    for first in range(0, len(place), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        for near in tree.query_ball_point(place[part, :2], reach[part] + 1e-6):
            seen[near] = True
    return float(seen.mean())


def _doubts(
    chart: RadiationMap,
    fit: Fit,
    aerial: Sequence[Estimate],
    final: Sequence[Estimate],
    background_std: float,
) -> list[tuple[Status, str]]:
    """Reasons not to believe the answer, the gravest first."""
    found: list[tuple[Status, str]] = []
    # one that cannot be computed contradicts too
    if not (fit.misfit <= MISFIT_SIGMA or fit.chi_squared <= MISFIT_LEAST):
        found.append((
            "inconsistent",
            f"the counts contradict the sources as modelled (chi-squared {fit.chi_squared:.2f} per degree of freedom, "
            f"{fit.misfit:.0f} standard deviations too large)",
        ))  # fmt: skip
    if not (fit.strain <= STRAINED or found):
        text = "the rates depart from those of the sources as modelled by more than the model is presumed to be off by"
        found.append(("inconsistent", text))
    # those of a group are compared as one
    found += dict.fromkeys(doubt for one in aerial for doubt in _disagreement(one, aerial, final))
    for one in final:
        if not one.converged:
            few = (
                f"the places that fit the {one.nuclide} source could not be searched well enough to state their spread"
            )
            found.append(("ambiguous", few))
    for one in final:
        std = np.sqrt(np.maximum(np.linalg.eigvalsh(np.asarray(one.covariance_m2)[:2, :2])[-1], 0.0))
        if std > FAR_STD_M:
            found.append(("detected", f"the place of the {one.nuclide} source is known to {std:.0f} m only"))
    found += _unexplained(chart, final, background_std)
    return found


def source_of_spectrum(taken_at: Estimate | None, final: Sequence[Estimate], radius_m: float) -> int | None:
    """Number of the source of ``final`` that a spectrum is of: the nearest to the estimate ``taken_at``, if near.

    Spectra are taken within ``radius_m`` of the source that was the surest then. By all counts another one may be,
    or it may be elsewhere.
    """
    if taken_at is None or not final:
        return None
    apart = [apart_m(one, taken_at) for one in final]
    nearest = int(np.argmin(apart))
    return nearest if apart[nearest] < radius_m else None


def _unexplained(chart: RadiationMap, final: Sequence[Estimate], background_std: float) -> list[tuple[Status, str]]:
    """Hotspots of the map that no source found explains, nor a background that differs from place to place.

    Whether a fainter one is a source is what the estimate decides, by its spectrum.
    """
    hotspots = np.asarray(chart.hotspots_m, float).reshape(-1, 2)
    column, row = np.rint((hotspots - chart.origin_m) / chart.cell_m).astype(int).T
    rates = chart.mean_cps[row, column]
    hotspots = hotspots[rates > np.median(chart.mean_cps) * (1.0 + UNEXPLAINED_SIGMA * background_std)]
    places = np.array([np.asarray(one.position_m, float)[:2] for one in final]).reshape(-1, 2)
    away = np.linalg.norm(hotspots[:, None] - places, axis=2).min(axis=1, initial=np.inf) > UNEXPLAINED_M
    if not np.any(away) or not len(places):
        return []
    text = ", ".join(f"({x:.0f}, {y:.0f})" for x, y in hotspots[away][:4])
    return [("ambiguous", f"hotspots far from what was found suggest further sources, at {text} m")]


def survey_doubts(survey: Sequence[Estimate], sources: Sequence[Estimate]) -> tuple[str, ...]:
    """Sentences on what the survey stated too well: by too little to contradict the answer of all counts.

    Sources beside one another are left out: the survey tells them apart no better than it can.
    """
    told = []
    for before in survey:
        final = _of_all_counts(before, sources)
        if not before.errors_known or final is None or _disagreement(before, survey, sources):
            continue
        if len(_beside(before, survey)) > 1 or len(_beside(final, sources)) > 1:
            continue
        distance, sigmas = _off([before], [final], 0.0)
        if sigmas > APART_SIGMA:
            told.append(
                f"the survey by itself had the {before.nuclide} source {distance:.1f} m from where all counts have it, "
                f"{sigmas:.0f} standard deviations as stated: its place was stated too well"
            )
    return tuple(told)


def _disagreement(
    before: Estimate, survey: Sequence[Estimate], sources: Sequence[Estimate]
) -> list[tuple[Status, str]]:
    """Between a source of the survey and the nearest of the same nuclide by all counts.

    Each by itself or with those beside it: the survey tells sources beside one another apart no better than it can, and
    of two at the limit of what is beside one another either may have them apart.
    """
    final = _of_all_counts(before, sources)
    if final is None:
        return []
    first, last = _beside(before, survey), _beside(final, sources)
    said = [_contradiction(a, b) for a, b in itertools.product(([before], first), ([final], last))]
    return [("inconsistent", said[-1])] if said[-1] and all(said) else []


def _contradiction(first: Sequence[Estimate], last: Sequence[Estimate]) -> str:
    """What sources by the survey and by all counts do not agree in; nothing if they do."""
    distance, sigmas = _off(first, last, MODEL_STD_M)
    if sigmas > APART_SIGMA:
        where = f"the survey alone had the {last[0].nuclide} source {distance:.0f} m from where all counts have it"
        return f"{where} (it may have taken several for one)"
    if first[0].nuclide != last[0].nuclide:
        return ""
    totals = [sum(max(one.activity_mbq, 1e-9) for one in group) for group in (first, last)]
    stds = [max(one.activity_std_mbq for one in group) for group in (first, last)]
    ratio = np.log(totals[1] / totals[0])
    if abs(ratio) > APART_SIGMA * np.hypot(np.hypot(stds[0] / totals[0], stds[1] / totals[1]), MODEL_STD_LOG):
        text = f"the activity of the {last[0].nuclide} source by the survey and by all counts differs "
        return f"{text}{np.exp(abs(ratio)):.3g} times"
    return ""


def _of_all_counts(before: Estimate, sources: Sequence[Estimate]) -> Estimate | None:
    """The nearest of the ``sources`` by all counts that may be of the nuclide of one of the survey; None without any.

    Of any nuclide where the counts do not tell which one it is.
    """
    alike = [
        one
        for one in sources
        if one.nuclide == before.nuclide or min(one.nuclide_confidence, before.nuclide_confidence) < CONFIRMED
    ]
    return min(alike, key=lambda one: apart_m(one, before), default=None)


def _off(first: Sequence[Estimate], last: Sequence[Estimate], model_std_m: float) -> tuple[float, float]:
    """Distance (m) between the centres of two groups, and in standard deviations, with ``model_std_m`` more."""
    (begun, of_first), (ended, of_last) = _centre(first), _centre(last)
    apart, covariance = ended - begun, of_first + of_last + model_std_m**2 * np.eye(2)
    return float(np.linalg.norm(apart)), float(np.sqrt(apart @ np.linalg.solve(covariance, apart)))


def _beside(one: Estimate, found: Sequence[Estimate]) -> list[Estimate]:
    """It, and those of its nuclide that are so near that their rates rise and fall with its own."""
    return [one] + [
        other for other in found
        if other is not one and other.nuclide == one.nuclide and apart_m(other, one) < COMPANION_M
    ]  # fmt: skip


def _centre(group: Sequence[Estimate]) -> tuple[Floats, Floats]:
    """Centre of activity [2] and its covariance [2, 2], the errors of its members taken for one error."""
    activity = np.array([max(one.activity_mbq, 1e-9) for one in group])
    share = activity / np.sum(activity)
    places = np.array([np.asarray(one.position_m, float)[:2] for one in group])
    covariances = np.array([np.asarray(one.covariance_m2, float)[:2, :2] for one in group])
    return share @ places, np.tensordot(share, covariances, axes=1)
