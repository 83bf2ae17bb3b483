"""The spectrum figure: measured counts, background, fit, labelled lines, and residuals below."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from swarmsim.playback import plan
from swarmsim.playback.colours import ESTIMATE
from swarmsim.results.doubts import CONFIRMED
from swarmsim.results.record import Spectrum

_BINS = 256  # merged channels: narrower than any peak of NaI, wide enough for a readable histogram
_LABELS = 0.36  # share of the axes' height above the curves, for labels of lines
_LABEL = 0.018  # share of the axes' width that an upright label takes
_SHARED = 0.3  # of that: lines that are nearer share a label
_ALIKE = 0.03  # of an energy: by less, energies are told as one


def spectrum_figure(spectrum: Spectrum) -> Figure:
    """Counts on a logarithmic scale with fit and lines, standardised residuals below."""
    figure = plan.new_figure(plan.DOUBLE_COLUMN_IN, 3.0)
    upper = figure.add_axes((0.085, 0.36, 0.895, 0.55))
    lower = figure.add_axes((0.085, 0.13, 0.895, 0.20), sharex=upper)
    merge = max(1, len(spectrum.counts) // _BINS)
    energy = _merged(spectrum.energy_kev, merge) / merge
    counts, fit, background = (_merged(v, merge) for v in (spectrum.counts, spectrum.fit, spectrum.background))
    measured = f"measured, {spectrum.live_time_s:.0f} s live time"
    upper.step(energy, counts, where="mid", color="0.35", linewidth=0.7, label=measured)
    upper.fill_between(energy, background, 0.1, step="mid", color="0.88", label="expected background")
    upper.plot(energy, fit, color=ESTIMATE, linewidth=1.0, label="fit")
    upper.set_yscale("log")
    # A mean of less than half a count in a bin says little.
    low, high = max(0.5, 0.5 * float(fit.min())), max(float(counts.max()), float(fit.max()), 1.0)
    upper.set_ylim(low, low * (1.5 * high / low) ** (1.0 / (1.0 - _LABELS)))
    upper.set_ylabel(f"Counts per {energy[1] - energy[0]:.1f} keV")
    upper.tick_params(labelbottom=False)
    end = float(energy[-1] + 0.5 * (energy[1] - energy[0]))
    _label_lines(upper, spectrum.lines_kev, end, energy, np.maximum(fit, counts))
    upper.set_title(spectrum_title(spectrum), loc="left", fontsize=8.0, pad=4.0)
    upper.legend(
        loc="lower right", bbox_to_anchor=(1.003, 1.0), ncols=3, borderaxespad=0.2, frameon=False, columnspacing=1.2
    )
    residual = (counts - fit) / np.sqrt(np.maximum(fit, 1.0))
    lower.axhline(0.0, color=ESTIMATE, linewidth=0.8)
    lower.plot(energy, residual, ".", color="0.35", markersize=1.6)
    reach = max(4.0, float(np.abs(residual).max()) * 1.1)
    lower.set_ylim(-reach, reach)
    lower.set_ylabel("Residual [σ]")
    lower.set_xlabel("Energy [keV]")
    lower.set_xlim(0.0, end)
    figure.align_ylabels([upper, lower])
    return figure


def spectrum_title(spectrum: Spectrum) -> str:
    """What the spectrum names, with its confidence to three digits, never rounded up to certainty.

    Further nuclides that it is sure of come after it.
    """
    if spectrum.nuclide == "none":
        return "no nuclide named"
    confidence = "> 0.999" if spectrum.confidence > 0.999 else f"{spectrum.confidence:.3f}"
    named = "not in the library" if spectrum.nuclide == "unknown" else spectrum.nuclide
    further = [name for name, score in spectrum.scores.items() if score > CONFIRMED and name != spectrum.nuclide]
    return f"{named}, confidence {confidence}" + (f"; with {' and '.join(further)}" if further else "")


def _merged(values: NDArray[np.floating], merge: int) -> NDArray[np.floating]:
    """Sums of ``merge`` neighbouring channels."""
    kept = len(values) // merge * merge
    return np.asarray(values[:kept], float).reshape(-1, merge).sum(axis=1)


def _label_lines(
    axes: Axes,
    lines_kev: NDArray[np.floating],
    end_kev: float,
    energy: NDArray[np.floating],
    curve: NDArray[np.floating],
) -> None:
    """Upright labels of the named nuclide's lines in a row at the top, each with a leader to its peak."""
    width = _LABEL * end_kev
    shown = np.sort(np.asarray(lines_kev, float)[(lines_kev >= energy[0]) & (lines_kev <= energy[-1])])
    apart = _SHARED * width
    while len(groups := _groups(shown, apart)) * width > end_kev:
        apart *= 2.0
    for group, place in zip(groups, _spread(np.array([g.mean() for g in groups]), width, end_kev), strict=True):
        tops = np.maximum(np.interp(group, energy, curve), axes.get_ylim()[0])
        peak, top = group[np.argmax(tops)], float(tops.max())
        axes.annotate(
            _energies(group),
            xy=(peak, 1.25 * top),
            xytext=(place, 0.98),
            textcoords=axes.get_xaxis_transform(),
            rotation=90,
            ha="center",
            va="top",
            fontsize=7.0,
            arrowprops={"arrowstyle": "-", "color": "0.3", "linewidth": 0.5, "relpos": (0.5, 0.0), "shrinkB": 0.0},
        )


def _energies(group: NDArray[np.floating]) -> str:
    """``662 keV``, or ``32–36 keV`` of lines that share a label and are not next to the same."""
    if group[-1] - group[0] < _ALIKE * group[0]:
        return f"{group.mean():.0f} keV"
    return f"{group[0]:.0f}–{group[-1]:.0f} keV"


def _groups(ordered_kev: NDArray[np.floating], apart_kev: float) -> list[NDArray[np.floating]]:
    """Lines that are less than ``apart_kev`` from the next one, together."""
    return np.split(ordered_kev, np.flatnonzero(np.diff(ordered_kev) >= apart_kev) + 1) if len(ordered_kev) else []


def _spread(wanted: NDArray[np.floating], width: float, end: float) -> NDArray[np.floating]:
    """Places [n] between 0 and ``end``, at least ``width`` apart, as near to the ``wanted`` ones as can be."""
    if not len(wanted):
        return wanted
    steps = width * np.arange(len(wanted))
    shifted = np.clip(isotonic_regression(wanted - steps).x, 0.5 * width, end - 0.5 * width - steps[-1])
    return np.asarray(shifted + steps)
