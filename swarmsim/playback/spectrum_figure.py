"""The spectrum figure: measured counts, background, fit, labelled lines, and residuals below."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from swarmsim.playback import plan
from swarmsim.playback.colours import ESTIMATE, TRUTH
from swarmsim.results.record import Spectrum

_BINS = 256  # merged channels: narrower than any peak of NaI, wide enough for a readable histogram


def spectrum_figure(spectrum: Spectrum) -> Figure:
    """Counts on a logarithmic scale with fit and lines, standardised residuals below."""
    figure = plan.new_figure(plan.DOUBLE_COLUMN_IN, 3.0)
    upper = figure.add_axes((0.085, 0.36, 0.895, 0.56))
    lower = figure.add_axes((0.085, 0.13, 0.895, 0.20), sharex=upper)
    merge = max(1, len(spectrum.counts) // _BINS)
    energy = _merged(spectrum.energy_kev, merge) / merge
    counts, fit, background = (_merged(v, merge) for v in (spectrum.counts, spectrum.fit, spectrum.background))
    measured = f"measured, {spectrum.live_time_s:.0f} s live"
    upper.step(energy, counts, where="mid", color="0.35", linewidth=0.7, label=measured)
    upper.fill_between(energy, background, 0.1, step="mid", color="0.88", label="expected background")
    upper.plot(energy, fit, color=ESTIMATE, linewidth=1.0, label="fit")
    upper.set_yscale("log")
    # Room above for the labels of the lines; a mean of less than half a count in a bin says little.
    upper.set_ylim(max(0.5, 0.5 * float(fit.min())), 60.0 * max(float(counts.max()), float(fit.max()), 1.0))
    upper.set_ylabel(f"Counts per {energy[1] - energy[0]:.1f} keV")
    upper.tick_params(labelbottom=False)
    _label_lines(upper, spectrum, energy, fit)
    upper.legend(loc="upper right", title=spectrum_title(spectrum), title_fontsize=7.5)
    residual = (counts - fit) / np.sqrt(np.maximum(fit, 1.0))
    lower.axhline(0.0, color=ESTIMATE, linewidth=0.8)
    lower.plot(energy, residual, ".", color="0.35", markersize=1.6)
    reach = max(4.0, float(np.abs(residual).max()) * 1.1)
    lower.set_ylim(-reach, reach)
    lower.set_ylabel("Residual [σ]")
    lower.set_xlabel("Energy [keV]")
    lower.set_xlim(0.0, float(energy[-1] + 0.5 * (energy[1] - energy[0])))
    figure.align_ylabels([upper, lower])
    return figure


def spectrum_title(spectrum: Spectrum) -> str:
    """What the spectrum names, with its confidence to three digits, never rounded up to certainty."""
    if spectrum.nuclide == "none":
        return "no nuclide named"
    confidence = "> 0.999" if spectrum.confidence > 0.999 else f"{spectrum.confidence:.3f}"
    named = "not in the library" if spectrum.nuclide == "unknown" else spectrum.nuclide
    return f"{named}, confidence {confidence}"


def _merged(values: NDArray[np.floating], merge: int) -> NDArray[np.floating]:
    """Sums of ``merge`` neighbouring channels."""
    kept = len(values) // merge * merge
    return np.asarray(values[:kept], float).reshape(-1, merge).sum(axis=1)


def _label_lines(axes: Axes, spectrum: Spectrum, energy: NDArray[np.floating], fit: NDArray[np.floating]) -> None:
    """A tick and an upright label over each line of the named nuclide."""
    for line in spectrum.lines_kev:
        if not energy[0] <= line <= energy[-1]:
            continue
        top = float(np.interp(line, energy, fit))
        axes.plot([line, line], [1.25 * top, 1.9 * top], color=TRUTH, linewidth=0.9)
        axes.text(line, 2.1 * top, f"{line:.0f} keV", rotation=90, ha="center", va="bottom", fontsize=7.0, color=TRUTH)
