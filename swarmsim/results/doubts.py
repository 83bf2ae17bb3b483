"""Reasons to doubt single sources of an answer: their nuclides, activities, heights, and what lies beside them."""

import itertools
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import numpy as np

from swarmsim.estimation.pairs import COMPANION_M, ONE_M
from swarmsim.results.record import Estimate

Status = Literal[
    "located", "ambiguous", "detected", "none", "saturated", "inconsistent", "incomplete_survey", "not_sought"
]

COMPANION_SHARE = 0.25  # of the stronger one's activity
FAINT_SHARE, FAINT_M = 0.01, 25.0  # a source so faint beside one so near adds less than what the model may be off by
WEAK_DETECTION = 200.0
"""Twice a logarithm of a likelihood ratio that errors of the model of walls have as well, near a source of the nuclide.

The false ones 10 to 15 m from sources in barns had 76 and 80; 61 is asked of any (`localisation.further_sigma`).
"""
CONFIRMED = 0.9  # probability in the spectrum taken near it, above which a nuclide of several in one place is believed
BESIDE_M = 15.0  # between sources that one spectrum may show
UNUSUAL_SIGMA = 2.5  # between the height of a source and what is presumed of it
IMPLAUSIBLE_SIGMA = 3.0  # between the activity of a source and what is presumed of it


def in_mbq(activity_mbq: float) -> str:
    """An activity in words, with two digits at least: that of a faint source is not zero."""
    if activity_mbq < 10.0:
        return f"{activity_mbq:.2g} MBq"
    for unit, size in (("PBq", 1e9), ("TBq", 1e6), ("GBq", 1e3)):
        if activity_mbq >= 10.0 * size:
            return f"{activity_mbq / size:.0f} {unit}"
    return f"{activity_mbq:.0f} MBq"


def companions(
    final: Sequence[Estimate],
    strength: Sequence[float],
    examined: Estimate | None = None,
    identified: Mapping[str, float] = MappingProxyType({}),
) -> list[tuple[Status, str]]:
    """Faint sources beside a strong one of the same nuclide, or any two at one place: errors of the model of walls.

    ``strength`` is the dose rate of each. Different nuclides that the spectrum shows both are no error.
    """
    found: list[tuple[Status, str]] = []
    for pair in itertools.combinations(zip(final, strength, strict=True), 2):
        (faint, less), (strong, more) = sorted(pair, key=lambda one: one[1])
        apart = apart_m(faint, strong)
        share = less / max(more, 1e-30)
        alike = faint.nuclide == strong.nuclide and (
            apart < (COMPANION_M if share < COMPANION_SHARE else ONE_M)
            or (apart < FAINT_M and faint.detection < WEAK_DETECTION)
        )
        # what the model does not explain about a source is taken up by others near it, of any nuclide
        several = max(strong.joined_m, faint.joined_m) > 0.0 and apart < COMPANION_M
        taken_up = several or (share < FAINT_SHARE and apart < FAINT_M)
        if alike or (taken_up and not _shown((faint, strong), examined, identified)):
            other = "one of a higher dose rate" if share < 1.0 else "another one"
            text = f"the {faint.nuclide} source of {in_mbq(faint.activity_mbq)} {apart:.2g} m beside {other}"
            found.append(("ambiguous", f"{text} may be an error of the model"))
    return found


def mixed(
    final: Sequence[Estimate], examined: Estimate | None, identified: Mapping[str, float]
) -> list[tuple[Status, str]]:
    """Different nuclides in one place: few energy windows tell two of them from a third one, which a spectrum does."""
    found: list[tuple[Status, str]] = []
    for one, other in itertools.combinations(final, 2):
        apart, names = apart_m(one, other), (one.nuclide, other.nuclide)
        if names[0] != names[1] and apart < ONE_M and not _shown((one, other), examined, identified):
            text = f"the {names[0]} and {names[1]} sources {apart:.2g} m apart may be one of another nuclide"
            found.append(("ambiguous", text))
    return found


def _shown(pair: Sequence[Estimate], examined: Estimate | None, identified: Mapping[str, float]) -> bool:
    """Whether the spectrum taken near one of two sources of different nuclides shows both."""
    one, other = pair
    both = all(identified.get(each.nuclide, 0.0) > CONFIRMED for each in pair)
    return one.nuclide != other.nuclide and (one is examined or other is examined) and both


def contradicted(
    final: Sequence[Estimate], examined: Estimate | None, suggested: str, identified: Mapping[str, float]
) -> list[tuple[Status, str]]:
    """A spectrum of another nuclide than that under which the source was sought near which it was taken.

    Unless it shows that one as well, and the other is that of a source beside it.

    None of 222 located missions of `random_recon` had one; before, a weak source beside a strong one 4 standard
    deviations from its place did.
    """
    if examined is None or suggested in ("", examined.nuclide):
        return []
    near = [one for one in final if one.nuclide == suggested and apart_m(one, examined) < BESIDE_M]
    if any(_shown((one, examined), examined, identified) for one in near):
        return []
    other = "none in the library" if suggested == "unknown" else suggested
    return [("ambiguous", f"the spectrum taken near the {examined.nuclide} source is of {other}")]


def unsure_nuclides(final: Sequence[Estimate], examined: Estimate | None, suggested: str) -> list[tuple[Status, str]]:
    """Sources whose nuclide neither the counts nor a spectrum is sure of: the place follows from the nuclide.

    What lies above a source may be other than presumed: of twelve that were buried six were told as of another nuclide.
    """
    return [
        (
            "ambiguous",
            f"the {one.nuclide} source may be of another nuclide ({one.nuclide_confidence:.1%} by the counts)",
        )
        for one in final
        if one.nuclide_confidence < CONFIRMED and not (one is examined and suggested == one.nuclide)
    ]


def unusual_heights(final: Sequence[Estimate], heights: Sequence[float]) -> list[tuple[Status, str]]:
    """Sources at a height that is not expected: of buried ones the place may be metres off."""
    return [
        (
            "ambiguous",
            f"the height of the {one.nuclide} source is {abs(sigmas):.1f} standard deviations from what is presumed "
            "(localisation.presumed_height_m), so that other things than presumed may lie above it",
        )
        for one, sigmas in zip(final, heights, strict=False)
        if abs(sigmas) > UNUSUAL_SIGMA
    ]


def implausible(final: Sequence[Estimate], presumed_mbq: float, std: float) -> list[tuple[Status, str]]:
    """Sources far weaker or stronger than presumed: close to a vehicle a slight error of the model looks like one."""
    found: list[tuple[Status, str]] = []
    for one in final:
        ratio = max(one.activity_mbq, 1e-12) / presumed_mbq
        if abs(np.log(ratio)) > IMPLAUSIBLE_SIGMA * std:
            times = float(f"{max(ratio, 1.0 / ratio):.2g}")
            compared = f"{times:,.6g} times {'stronger' if ratio > 1.0 else 'weaker'}"
            text = f"the {one.nuclide} source of {in_mbq(one.activity_mbq)} is {compared} than presumed"
            found.append(("ambiguous", f"{text} (knowledge.activity_mbq), and may be an error of the model"))
    return found


def apart_m(one: Estimate, other: Estimate) -> float:
    """Horizontal distance of two sources."""
    return float(np.linalg.norm(np.asarray(one.position_m, float)[:2] - np.asarray(other.position_m, float)[:2]))
