"""The figure of a flight: planned, simulated and flown tracks from above, and the errors over time."""

from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from swarmsim.autopilot.compare import Track, statistics
from swarmsim.playback import plan
from swarmsim.playback.overlay import FLOWN, PLANNED, SIMULATED, Overlay
from swarmsim.site.model import SiteModel

NAME = "flown"
_HEIGHT_IN = 3.25
_LEFT, _RIGHT = (0.09, 0.125, 0.38, 0.72), (0.575, 0.405)  # left, bottom, width, height; left, width
_MARGIN = 0.08  # of the larger side around the tracks
_LEAST_M = 10.0
_POINTS = 4000  # of a line


def write_figure(overlay: Overlay, site_model: SiteModel | None, folder: Path) -> Path:
    """Write the figure as PNG and PDF into ``folder`` (made if needed); the path of the PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{NAME}.png"
    with plan.print_style():
        figure = flown_figure(overlay, site_model)
        for each in (path, path.with_suffix(".pdf")):
            figure.savefig(each, dpi=plan.DPI)
    return path


def flown_figure(overlay: Overlay, site_model: SiteModel | None) -> Figure:
    """A double-column figure: the tracks from above, at its side errors (or speeds) and heights over time."""
    figure = plan.new_figure(plan.DOUBLE_COLUMN_IN, _HEIGHT_IN)
    _draw_above(figure.add_axes(_LEFT), overlay, site_model)
    over = figure.add_axes((_RIGHT[0], 0.51, _RIGHT[1], 0.335))
    heights = figure.add_axes((_RIGHT[0], 0.125, _RIGHT[1], 0.335), sharex=over)
    (_draw_errors if overlay.has_errors() else _draw_speeds)(over, overlay)
    over.tick_params(labelbottom=False)
    _draw_heights(heights, overlay)
    return figure


def _draw_above(axes: Axes, overlay: Overlay, site_model: SiteModel | None) -> None:
    handles: list[Artist] = []
    if site_model is None:
        plan.frame_axes(axes)
    else:
        plan.draw_site(axes, site_model)
    for path in overlay.planned:
        x, y = _thin(path.points_m)[:, :2].T
        lines = axes.plot(x, y, "-", color=PLANNED, linewidth=2.6, alpha=0.55, label="planned", zorder=3)
        handles = handles or [*lines]
    if overlay.simulated is not None:
        x, y = _thin(overlay.simulated.track.position_m)[:, :2].T
        handles += axes.plot(x, y, "-", color=SIMULATED, linewidth=1.8, label="simulated", zorder=4)
    x, y = _thin(overlay.judged.position_m)[:, :2].T
    handles += axes.plot(x, y, "-", color=FLOWN, linewidth=0.8, label="flown", zorder=5)
    axes.plot(x[:1], y[:1], "s", color=FLOWN, markersize=3.0, markeredgecolor="black", markeredgewidth=0.4, zorder=6)
    start = {"linestyle": "none", "marker": "s", "color": "0.8", "markeredgecolor": "black", "markersize": 3.0}
    handles.append(Line2D([], [], label="start", **start))  # type: ignore[arg-type]
    if site_model is not None:
        handles.append(plan.building_patch())
    _fit(axes, *(corner[:2] for corner in overlay.bounds_m()))
    plan.legend_above(axes, 3, handles)


def _fit(axes: Axes, low: NDArray[np.floating], high: NDArray[np.floating]) -> None:
    """Limits to scale that fill the axes, with the tracks in their middle."""
    figure = axes.figure
    box = axes.get_position(original=True)
    shape = box.width * figure.get_figwidth() / (box.height * figure.get_figheight())  # type: ignore[union-attr]
    size = np.maximum(high - low, _LEAST_M)
    size = size + 2.0 * _MARGIN * size.max()
    width = max(size[0], size[1] * shape)
    half = 0.5 * np.array([width, width / shape])
    centre = 0.5 * (low + high)
    axes.set_xlim(centre[0] - half[0], centre[0] + half[0])
    axes.set_ylim(centre[1] - half[1], centre[1] + half[1])


def _draw_errors(axes: Axes, overlay: Overlay) -> None:
    made = overlay.comparison
    for values, colour, what in (
        (made.cross_track_m, FLOWN, "from the planned path"),
        (made.synchronised_m, SIMULATED, "from the simulated vehicle"),
    ):
        told = statistics(values)
        if told is not None:
            axes.plot(made.time_s, values, "-", color=colour, linewidth=0.8, label=f"{what}, rms {told['rms_m']:.2f} m")
    axes.set_ylim(0.0, 1.05 * axes.dataLim.y1 if axes.dataLim.y1 > 0.0 else None)  # one that is constant is seen
    axes.set_ylabel("Horizontal error [m]")
    axes.grid(color="0.9", linewidth=0.5)
    axes.set_axisbelow(True)
    plan.legend_above(axes, 1)


def _draw_speeds(axes: Axes, overlay: Overlay) -> None:
    judged = overlay.judged
    if len(judged.time_s):
        axes.plot(judged.time_s, judged.speed_m_s(judged.time_s), "-", color=FLOWN, linewidth=0.8, label="flown")
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("Speed [m/s]")
    axes.grid(color="0.9", linewidth=0.5)
    axes.set_axisbelow(True)
    plan.legend_above(axes, 1)


def _draw_heights(axes: Axes, overlay: Overlay) -> None:
    track, judged = overlay.simulated_track(), overlay.judged
    if track is not None:
        axes.plot(*_height(track), "-", color=SIMULATED, linewidth=1.8)
    axes.plot(*_height(overlay.flown), "-", color=FLOWN, linewidth=0.8)
    if len(judged.time_s) > 1:
        axes.set_xlim(judged.time_s[0], judged.time_s[-1])
        shown = np.concatenate([judged.position_m[:, 2], *([] if track is None else [track.position_m[:, 2]])])
        room = max(0.08 * float(np.ptp(shown)), 0.25)
        axes.set_ylim(float(shown.min()) - room, float(shown.max()) + room)
    axes.set_xlabel("Time [s]")
    axes.set_ylabel("Height [m]")
    axes.grid(color="0.9", linewidth=0.5)
    axes.set_axisbelow(True)


def _height(track: Track) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return track.time_s, track.position_m[:, 2]


def _thin(points_m: NDArray[np.floating]) -> NDArray[np.floating]:
    return points_m[:: max(1, len(points_m) // _POINTS)]


__all__ = ["flown_figure", "write_figure"]
