"""What one mission of a batch answers: sources, spectrum and map, what they are worth, and the sentence on them."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from swarmsim.estimation import Estimated
from swarmsim.missions.plan_build import mapped_areas
from swarmsim.missions.state import MissionState
from swarmsim.radiation.identify import NONE, UNKNOWN
from swarmsim.radiation.rate import rate_showing
from swarmsim.results.finding import NO_SPECTRUM, NO_WAY, NOT_ASKED, finding
from swarmsim.results.record import Estimate, Event, RadiationMap, Samples, Spectrum
from swarmsim.results.saturation import SATURATED_SHARE
from swarmsim.results.sources import gamma_constants
from swarmsim.results.status import Fit, Verdict, assess, source_of_spectrum
from swarmsim.runtime.simulation import Simulation
from swarmsim.site.model import height_at
from swarmsim.world.build import detector_models
from swarmsim.world.events import KINDS

LEAST_STD_M, LEAST_STD_SHARE = 0.01, 0.002
"""Errors that no statistics tell of: of a measured position and of a detector's constants, even ideal ones."""
LIKELY = 0.5  # probability above which the finding says which stranger an unknown source is like
UNNAMED = {NONE: "none", UNKNOWN: "unknown"}
"""What a spectrum is said to show where no nuclide is named."""


@dataclass(frozen=True)
class Answer:
    """The answer of a mission; nothing found, and no verdict, where it sought nothing."""

    finding: str
    verdict: Verdict | None = None
    surveyed: tuple[Estimate, ...] = ()  # sources by the survey's counts, the surest first
    final: tuple[Estimate, ...] = ()  # by all counts
    map: RadiationMap | None = None
    spectrum: Spectrum | None = None
    noticed_mbq: dict[str, float] = field(default_factory=dict)  # see `MissionRecord`
    examined: int | None = None  # likewise


def answer_of(
    simulation: Simulation, conclusion: Any, samples: Samples, end: MissionState, events: list[Event]
) -> Answer:
    """The answer from a mission's ``conclusion``, on the host; None for a mission that sought nothing."""
    one_nuclide, hindrance = _one_nuclide(simulation), _hindrance(simulation, end, events)
    if conclusion is None:
        return Answer(finding=finding(None, (), None, hindrance, one_nuclide))
    nuclides = _nuclides(simulation)
    surveyed = _estimates(conclusion.survey.estimated, nuclides)
    final = _estimates(conclusion.estimated, nuclides)
    noticed = _noticed(simulation, conclusion.estimated)
    spectrum = _spectrum(simulation, conclusion)
    examined = _examined(simulation, spectrum, surveyed, final)
    telling = None if examined is None else spectrum
    chart = _map(simulation, conclusion.survey)
    verdict = _verdict(simulation, samples, chart, conclusion, surveyed, final, telling, examined or 0, end, noticed)
    if verdict.status == "saturated":
        surveyed, final = (tuple(replace(one, errors_known=False) for one in several) for several in (surveyed, final))
        noticed = {}  # a paralysed counter notices nothing
    said = finding(verdict, final, telling, hindrance, one_nuclide, examined or 0, noticed)
    return Answer(said, verdict, surveyed, final, chart, spectrum, noticed, examined)


def _map(simulation: Simulation, survey: Any) -> RadiationMap:
    mapping = simulation.plan.mapping
    assert mapping is not None
    return RadiationMap(
        origin_m=np.asarray(mapping.origin_m),
        cell_m=float(mapping.cell_m),
        mean_cps=survey.map.mean_cps,
        std_cps=survey.map.std_cps,
        hotspots_m=survey.hotspots.position_m[survey.hotspots.valid],
    )


def _nuclides(simulation: Simulation) -> tuple[str, ...]:
    """The library's nuclides, in the order of their indices."""
    return simulation.plan.detectors[0].nuclide_names if simulation.plan.detectors else ()


def _estimates(estimated: Estimated, nuclides: tuple[str, ...]) -> tuple[Estimate, ...]:
    """The sources found, the surest first."""
    fits = estimated.fits
    return tuple(
        Estimate(
            position_m=np.asarray(fits.position_m[k]),
            covariance_m2=np.asarray(fits.covariance_m2[k]) + LEAST_STD_M**2 * np.eye(3),
            activity_mbq=float(fits.activity_bq[k]) * 1e-6,
            activity_std_mbq=float(np.hypot(fits.activity_std_bq[k], LEAST_STD_SHARE * fits.activity_bq[k])) * 1e-6,
            background_scale=float(estimated.background_scale),
            nuclide=nuclides[int(fits.nuclide[k])],
            nuclide_confidence=float(fits.nuclide_confidence[k]),
            detection=float(fits.detection[k]),
            effective_samples=float(fits.effective_samples[k]),
            converged=bool(fits.converged[k]),
            joined_m=float(fits.joined_m[k]),
            beside_mbq=float(fits.beside_bq[k]) * 1e-6,
        )
        for k in np.flatnonzero(np.asarray(fits.present))
    )


def _noticed(simulation: Simulation, estimated: Estimated) -> dict[str, float]:
    """Detection limits of the nuclides in question (`MissionRecord.noticed_mbq`)."""
    presumed = simulation.plan.presumed
    assert presumed is not None
    names = _nuclides(simulation)
    return {names[k]: float(estimated.noticed_bq[k]) * 1e-6 for k in np.flatnonzero(np.asarray(presumed.nuclides))}


def _spectrum(simulation: Simulation, conclusion: Any) -> Spectrum | None:
    """The spectrum of the source, where one was taken; none was if nobody measured near it."""
    answer = conclusion.identification
    if answer is None or float(conclusion.spectrum.live_s) <= 0.0:
        return None
    model, names = simulation.plan.spectrometer, _nuclides(simulation)
    detector = simulation.plan.detectors[model]
    live, index = float(conclusion.spectrum.live_s), int(answer.nuclide)
    lines = simulation.scenario.nuclides[names[index]].lines if index >= 0 else ()
    return Spectrum(
        energy_kev=np.asarray(detector.energy_kev),
        counts=conclusion.spectrum.counts,
        background=np.asarray(detector.background_spectrum) * live,
        fit=answer.fit,
        live_time_s=live,
        nuclide=names[index] if index >= 0 else UNNAMED[index],
        confidence=float(answer.confidence),
        sure=float(answer.confidence) >= float(simulation.plan.confidence_min),
        unknown=float(answer.unknown),
        goodness=float(answer.goodness),
        scores=dict(zip(names, map(float, answer.posterior), strict=True)),
        lines_kev=np.array([line.energy_kev for line in lines]),
        detector=detector_models(simulation.scenario)[model],
        begin_s=max(float(conclusion.spectrum.begin_s), 0.0),
        alike=detector.known_names[int(answer.stranger)] if index == UNKNOWN and float(answer.alike) > LIKELY else "",
    )


def _hindrance(simulation: Simulation, end: MissionState, events: list[Event]) -> str | None:
    """Why no spectrum was taken near a source, as far as known.

    No drivable way there, a mission that names no nuclide, or what happened to the first rover that was lost.
    """
    if _no_way(simulation, end):
        return NO_WAY
    scenario = simulation.scenario
    if scenario.mission.identification is None:
        return NOT_ASKED
    sent = {
        scenario.members[number].name
        for phase, members in zip(simulation.plan.phases, scenario.phase_members, strict=True)
        if phase.target == "source"
        for number in members
    }
    lost = [event for event in events if event.kind in KINDS and event.vehicle in sent]
    return f"{NO_SPECTRUM} ({lost[0].vehicle}: {lost[0].detail})" if lost else None


def _no_way(simulation: Simulation, end: MissionState) -> bool:
    """Whether rovers were sent to the source, and none had a drivable way there: their paths have no extent."""
    scenario = simulation.scenario
    drives = [
        bool(np.ptp(points[:, :2], axis=0).max() > 0.0)
        for phase, members, state in zip(simulation.plan.phases, scenario.phase_members, end.phases, strict=True)
        if phase.target == "source" and state.path is not None and np.isfinite(state.began_s)
        for number, points in zip(members, state.path.points_m, strict=True)
        if scenario.vehicles[number].kind == "skid_steer"
    ]
    return bool(drives) and not any(drives)


def _verdict(
    simulation: Simulation,
    samples: Samples,
    chart: RadiationMap,
    conclusion: Any,
    aerial: tuple[Estimate, ...],
    final: tuple[Estimate, ...],
    spectrum: Spectrum | None,
    examined: int,
    end: MissionState,
    noticed: dict[str, float],
) -> Verdict:
    """Status of the mission's answer."""
    estimated, detectors, presumed = conclusion.estimated, simulation.plan.detectors, simulation.plan.presumed
    assert presumed is not None
    assert simulation.plan.localisation is not None
    suggested = ""
    if spectrum is not None and spectrum.nuclide != UNNAMED[NONE] and not _no_way(simulation, end):
        suggested = spectrum.nuclide if spectrum.sure else ""
    doubtful = np.array([rate_showing(detector, SATURATED_SHARE) for detector in detectors])
    fit = Fit(
        misfit=float(estimated.misfit),
        chi_squared=float(estimated.chi_squared),
        strain=float(estimated.strain),
        unsought=float(estimated.unsought),
        suspected=float(estimated.suspected),
        suspect="{} near ({:.0f}, {:.0f})".format(
            _nuclides(simulation)[int(estimated.suspect_nuclide)], *np.asarray(estimated.suspect_m, float)
        ),
        full=len(final) == simulation.plan.localisation.search.sources_max,
        load=float(np.max(np.asarray(estimated.highest_cps) / doubtful, initial=0.0)),
    )
    site = simulation.site_model.site
    ground = height_at(site, np.asarray(samples.position_m, float)[:, :2])
    # the true ground is not known to every mission
    below = height_at(presumed.site, np.array([one.position_m[:2] for one in final]).reshape(-1, 2))
    height_m, height_std_m = float(presumed.height_m), float(presumed.height_std_m) or np.inf  # 0: it is held
    return assess(
        samples,
        chart,
        ground,
        fit,
        aerial,
        final,
        float(presumed.background_std),
        (float(np.exp(presumed.log_activity)) * 1e-6, float(presumed.log_activity_std)),
        gamma_constants(simulation, final),
        {} if spectrum is None else spectrum.scores,
        suggested,
        examined,
        noticed,
        mapped_areas(simulation.scenario, site.survey_area_m),
        [(float(one.position_m[2] - z) - height_m) / height_std_m for one, z in zip(final, below, strict=True)],
    )


def _examined(
    simulation: Simulation, spectrum: Spectrum | None, surveyed: tuple[Estimate, ...], final: tuple[Estimate, ...]
) -> int | None:
    """Number of the source of ``final`` that the spectrum is of; None where there is none."""
    taken_at = None if spectrum is None else next(iter(surveyed), None)
    return source_of_spectrum(taken_at, final, float(simulation.plan.spectrum_radius_m))


def _one_nuclide(simulation: Simulation) -> bool:
    presumed = simulation.plan.presumed
    return presumed is not None and int(np.sum(np.asarray(presumed.nuclides))) == 1
