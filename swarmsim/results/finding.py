"""The sentence that says what a mission found, and why it is not to be believed where it is not."""

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from swarmsim.estimation.detection_limit import MOST
from swarmsim.estimation.pairs import COMPANION_M, ONE_M
from swarmsim.results.doubts import CONFIRMED, in_mbq
from swarmsim.results.record import Estimate, Spectrum
from swarmsim.results.status import Verdict

NOTHING_SOUGHT = "nothing was sought"
NOTHING_FOUND = "no source above background"
NO_WAY = "no drivable way for the rover to reach it"
NO_SPECTRUM = "no spectrum was taken near it"
NOT_ASKED = "the mission identifies none (identification)"
BAD_FIT = 1e-3
"""p-value below which the finding says that the named nuclide does not fit the spectrum."""


def finding(
    verdict: Verdict | None,
    final: tuple[Estimate, ...],
    spectrum: Spectrum | None,
    hindrance: str | None,
    presumed: bool,
    spectrum_of: int = 0,
    noticed_mbq: Mapping[str, float] = MappingProxyType({}),
) -> str:
    """What was found, and why it is not to be believed where it is not.

    Args:
        verdict: on the answer; None where no source was sought.
        final: sources by all counts, the surest first.
        spectrum: taken near one of them; None where none was.
        hindrance: what kept rovers from it, as far as known.
        presumed: whether one nuclide alone is in question.
        spectrum_of: number of the source near which it was taken.
        noticed_mbq: activities from which on nuclides would have been noticed (`MissionRecord.noticed_mbq`).
    """
    by = "nuclide presumed" if presumed else "nuclide by the counts"
    if verdict is None:
        return NOTHING_SOUGHT
    found = _found(final, spectrum, hindrance, by, spectrum_of) if final else NOTHING_FOUND + _noticed(noticed_mbq)
    if not verdict.reasons:
        return found
    return f"{verdict.status.replace('_', ' ')}: {found}; but {'; '.join(verdict.reasons)}"


def _found(
    final: tuple[Estimate, ...], spectrum: Spectrum | None, hindrance: str | None, by: str, spectrum_of: int
) -> str:
    told = [_placed(one) for one in final]
    examined = _examined(final[spectrum_of], spectrum, hindrance, by) + _besides(final, spectrum)
    told[spectrum_of] = f"{told[spectrum_of]}; {examined}"
    if len(final) == 1:
        return f"a source of {told[0]}"
    return f"{len(final)} sources: of {'; of '.join(told)}"


def _noticed(noticed_mbq: Mapping[str, float]) -> str:
    """How strong a source would have had to be: "none" says little without."""
    if not noticed_mbq:
        return ""
    from_ = noticed_from(noticed_mbq)
    if from_ is None:
        return f" (nor would one of any activity in free view have been noticed, over {MOST:.0%} of the survey area)"
    return f" (in free view, over {MOST:.0%} of the survey area, one would have been noticed from {from_})"


def noticed_from(noticed_mbq: Mapping[str, float | None]) -> str | None:
    """From which activities on nuclides are noticed, of the first and of the last one; None where none is.

    ``noticed_mbq`` has infinity or None for one that never is.
    """
    limits = sorted((value, name) for name, value in noticed_mbq.items() if value is not None and math.isfinite(value))
    if not limits:
        return None
    told = [f"{in_mbq(value)} {name}" for value, name in (limits[0], limits[-1])]
    from_ = told[0] if len(limits) == 1 else f"{told[0]} to {told[1]}"
    never = sorted(set(noticed_mbq) - {name for _, name in limits})
    but = f", but none of {' or '.join(never[:3])}{' and others' if len(never) > 3 else ''}" if never else ""
    return f"{from_} on{but}"


def _placed(estimate: Estimate) -> str:
    x, y = estimate.position_m[:2]
    if not estimate.errors_known:
        return f"about {in_mbq(estimate.activity_mbq)} {estimate.nuclide} near ({x:.0f}, {y:.0f})"
    # one standard deviation, in the direction in which it is largest
    (xx, xy), (_, yy) = np.asarray(estimate.covariance_m2, float)[:2, :2]
    std = math.sqrt(max(0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy), 0.0))
    digits = 1 if std >= 0.095 else 2
    placed = f"{told_activity(estimate)} {estimate.nuclide} at ({x:.{digits}f}, {y:.{digits}f}) ± {std:.2g} m"
    if estimate.joined_m > 0.0:
        return f"{placed} (or several within {math.ceil(estimate.joined_m)} m, or behind other walls than presumed)"
    another = f"another {estimate.nuclide} source {ONE_M:g} to {COMPANION_M:g} m off"
    if not math.isfinite(estimate.beside_mbq):
        return f"{placed} ({another} may go unnoticed whatever its activity)"
    return f"{placed} ({another} would be noticed from {in_mbq(estimate.beside_mbq)} on)"


def told_activity(estimate: Estimate) -> str:
    """The activity and, where it is known, one standard deviation of it, both to the second digit of the latter."""
    value, std = estimate.activity_mbq, estimate.activity_std_mbq
    if not (estimate.errors_known and math.isfinite(std) and std > 0.0):
        return in_mbq(value)
    digits = max(0, 1 - math.floor(math.log10(std)))
    told = f"{value:.{digits}f}"
    return f"{told if float(told) > 0.0 else f'{value:.2g}'} ± {std:.{digits}f} MBq"


def _examined(estimate: Estimate, spectrum: Spectrum | None, hindrance: str | None, by: str) -> str:
    if spectrum is None or hindrance == NO_WAY:
        return f"{by}, {hindrance or NO_SPECTRUM}"
    return _identified(estimate, spectrum, by)


def _besides(final: tuple[Estimate, ...], spectrum: Spectrum | None) -> str:
    """What the spectrum asks for besides the nuclides of the sources.

    A weak one in the same place or farther off may be the reason, or a material on the way that no template is like: of
    52 located missions of `random_recon` four had one that was not there.
    """
    if spectrum is None:
        return ""
    told = {one.nuclide for one in final} | {spectrum.nuclide}
    names = [name for name, score in spectrum.scores.items() if score > CONFIRMED and name not in told]
    if not names:
        return ""
    more = " and ".join(names)
    return f", but the spectrum fits better with {more} as well: a weak source, or walls other than presumed"


def _identified(estimate: Estimate, spectrum: Spectrum, by: str) -> str:
    """What the spectrum says of the nuclide under which the source was estimated."""
    if spectrum.nuclide == "none":
        return f"{by}, the spectrum shows none"
    if spectrum.nuclide == "unknown":
        alike = f", most like {spectrum.alike}" if spectrum.alike else ""
        return f"{by}, the spectrum is of none in the library with {spectrum.confidence:.0%}{alike}"
    said = f"identified with {'more than 99.9%' if spectrum.confidence > 0.999 else f'{spectrum.confidence:.1%}'}"
    if spectrum.nuclide != estimate.nuclide or not spectrum.sure:
        said = f"{by}, the spectrum suggests {spectrum.nuclide} with {spectrum.confidence:.0%}"
    if spectrum.goodness < BAD_FIT:
        said += f", but fits the spectrum badly (p = {spectrum.goodness:.1g})"
    return said
