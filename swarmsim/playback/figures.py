"""The figures of a mission for print: trajectories, measurements of each phase, the map, the spectrum.

A figure that would be empty is left out.
"""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from swarmsim.playback import plan
from swarmsim.playback.colours import (
    RATE_MAP,
    away_from_pads,
    linear_scale,
    log_scale,
    measured_phases,
    smoothed_rate,
    vehicle_colours,
)
from swarmsim.playback.entities import is_large
from swarmsim.playback.spectrum_figure import spectrum_figure
from swarmsim.results.record import Estimate, MissionRecord, Phase, RadiationMap
from swarmsim.site.model import SiteModel

_RATE_LABEL = "Count rate, 1 s mean [1/s]"
MARGIN_M = 3.0  # around what a close-up shows
NEAR_SHARE, MOST_SHARE = 0.18, 0.35  # of the site's smaller side: half sides of close-ups of two things, and of any
NOWHERE = np.zeros((0, 2))
_TRACK_POINTS_MAX = 50_000  # of all vehicles
_TRACK_COLUMNS = 3  # of the legend
_DECIMALS_MOST = 6  # of a contour's label


def write(record: MissionRecord, site_model: SiteModel, folder: Path) -> list[Path]:
    """Write the figures as PNG and as PDF into ``folder`` (made if needed); returns the paths of the PNG files."""
    folder.mkdir(parents=True, exist_ok=True)
    record = record.finite()
    written = []
    with plan.print_style():
        for name, make in figures_of(record).items():
            figure = make(record, site_model)
            path = folder / f"{name}.png"
            figure.savefig(path, dpi=plan.DPI)
            figure.savefig(path.with_suffix(".pdf"), dpi=plan.DPI)
            written.append(path)
    return written


def figures_of(record: MissionRecord) -> dict[str, Callable[[MissionRecord, SiteModel], Figure]]:
    """The figures that a mission has something to show on, by the names of their files."""
    made: dict[str, Callable[[MissionRecord, SiteModel], Figure]] = {"trajectories": trajectories}
    for phase in measured_phases(record):
        make = flown_measurements if record.is_flown(phase) else driven_measurements
        made[f"measurements_{re.sub('[^A-Za-z0-9_.-]', '_', phase.name)}"] = partial(make, phase)
    if record.map is not None:
        made["radiation_map"] = radiation_map
    if record.spectrum is not None:
        made["spectrum"] = spectrum
    return made


def trajectories(record: MissionRecord, site_model: SiteModel) -> Figure:
    """Paths of all vehicles over the site plan; a large team is named by its types."""
    large = is_large(record)
    entries = 3 + (len({v.type for v in record.vehicles}) if large else len(record.vehicles))
    figure, axes = plan.new_plan(site_model, legend_height_in=0.2 + 0.14 * -(-entries // _TRACK_COLUMNS), bar=False)
    points = max(2, _TRACK_POINTS_MAX // max(1, len(record.vehicles)))
    width = 0.4 if large else 0.9
    for vehicle, colour in zip(record.vehicles, vehicle_colours(record), strict=True):
        x, y, _ = vehicle.position_m[:: max(1, len(vehicle.time_s) // points)].T
        line = "-" if vehicle.flies else "--"
        name = "_" if large else vehicle.name
        axes.plot(x, y, line, color=colour, label=name, linewidth=width, zorder=4)
        axes.plot(
            x[:1], y[:1], "s", color=colour, markersize=3.0 * width, markeredgecolor="black", markeredgewidth=0.4,
            zorder=6,
        )  # fmt: skip
    plan.draw_truth(axes, record)
    handles, _ = axes.get_legend_handles_labels()
    if large:
        counts = Counter(vehicle.type for vehicle in record.vehicles)
        handles += [Line2D([], [], color="0.3", label=f"{count} {kind}") for kind, count in counts.items()]
    start = Line2D(
        [], [], linestyle="none", marker="s", color="0.8", markeredgecolor="black", markersize=3.0, label="start"
    )
    plan.legend_above(axes, _TRACK_COLUMNS, [*handles, start, plan.building_patch()])
    return figure


def flown_measurements(phase: Phase, record: MissionRecord, site_model: SiteModel) -> Figure:
    """Count rates of a phase that was flown, where they were measured; those above the pads do not set the scale."""
    figure, axes = plan.new_plan(site_model)
    samples = record.samples.of_phase(phase.name)
    rate = smoothed_rate(samples)
    scale = linear_scale(smoothed_rate(samples.rows(away_from_pads(record, samples))))
    x, y, _ = samples.position_m.T
    dots = axes.scatter(x, y, c=rate, s=2.2, cmap=RATE_MAP, norm=scale.norm, linewidths=0, zorder=4, rasterized=True)
    plan.draw_truth(axes, record)
    beyond = bool(np.any(rate > scale.limits_cps[1]))
    plan.colour_bar(figure, axes, dots, _RATE_LABEL, extend="max" if beyond else "neither")
    handles, _ = axes.get_legend_handles_labels()
    plan.legend_above(axes, 2, [*handles, plan.building_patch()])
    return figure


def radiation_map(record: MissionRecord, site_model: SiteModel) -> Figure:
    """The interpolated map with contours, hotspots, truth and the estimates of then; what was found close up too."""
    made = record.map
    assert made is not None
    if record.survey_estimate is None and not len(made.hotspots_m):
        figure, whole = plan.new_plan(site_model)
        shown = [whole]
    else:
        figure, *shown = plan.new_pair(site_model, *_close_up(record.survey_estimate, made.hotspots_m, site_model))
        whole = shown[0]
    for axes in shown:
        image = _draw_map(axes, made)
        plan.outline_site(axes, site_model)
        if len(made.hotspots_m):
            axes.plot(*made.hotspots_m.T, linestyle="none", marker="o", markersize=9.0, markerfacecolor="none",
                      markeredgecolor="black", markeredgewidth=1.0, label="hotspot", zorder=6)  # fmt: skip
        plan.draw_truth(axes, record)
        plan.draw_estimates(axes, record.survey_estimates, "survey estimate")
    plan.colour_bar(figure, shown[-1], image, "Count rate, interpolated [1/s]")
    handles, _ = whole.get_legend_handles_labels()
    handles.append(Line2D([], [], color="0.2", linewidth=0.7, label="obstacles"))
    std = f"median standard deviation {np.median(made.std_cps):.2g} 1/s"
    plan.legend_above(whole, 1 + len(shown), [*handles, Line2D([], [], linestyle="none", label=std)])
    return figure


def _draw_map(axes: Axes, made: RadiationMap) -> AxesImage:
    """The map as an image with white contours; the axes keep their limits."""
    limits = axes.get_xlim(), axes.get_ylim()
    ny, nx = made.mean_cps.shape
    x, y = made.origin_m[0] + made.cell_m * np.arange(nx), made.origin_m[1] + made.cell_m * np.arange(ny)
    half = 0.5 * made.cell_m
    extent = (x[0] - half, x[-1] + half, y[0] - half, y[-1] + half)
    low, high = float(made.mean_cps.min()), float(made.mean_cps.max())
    norm = Normalize(low, max(high, low + 1.0))
    image = axes.imshow(
        made.mean_cps, norm=norm, extent=extent, origin="lower", cmap=RATE_MAP, interpolation="bilinear", zorder=2
    )
    if min(nx, ny) > 1 and high - low > 1e-3 * max(abs(high), 1.0):
        # none where the map is cut off
        levels = [
            float(level) for level in MaxNLocator(6).tick_values(low, high) if low + 0.02 * (high - low) < level < high
        ]
        lines = axes.contour(x, y, made.mean_cps, levels=levels, colors="white", linewidths=0.5, zorder=3)
        axes.clabel(lines, levels[:3], fmt=_exact(levels), fontsize=7.0)
    axes.set_xlim(limits[0])
    axes.set_ylim(limits[1])
    return image


def _exact(levels: Sequence[float]) -> str:
    """The format with the fewest decimals that tells levels exactly, all of them with as many."""
    needed = (d for d in range(_DECIMALS_MOST) if np.allclose(np.round(levels, d), levels, rtol=1e-6, atol=0.0))
    return f"%.{next(needed, _DECIMALS_MOST)}f"


def driven_measurements(phase: Phase, record: MissionRecord, site_model: SiteModel) -> Figure:
    """Count rates of a phase that was driven, along the planned paths, with a close-up.

    The close-up shows the greatest count rate and the estimate nearest to it, or the former alone where they lie far
    apart.
    """
    samples = record.samples.of_phase(phase.name)
    rate = smoothed_rate(samples)
    norm = log_scale(rate).norm
    x, y, _ = samples.position_m.T
    strongest = samples.position_m[[np.argmax(rate)], :2]
    off_m = [float(np.linalg.norm(one.position_m[:2] - strongest[0])) for one in record.estimates]
    nearest = record.estimates[int(np.argmin(off_m))] if off_m else None
    centre, half = _close_up(nearest, strongest, site_model, strongest)
    figure, whole, close = plan.new_pair(site_model, centre, half)
    paths = [record.paths_m[number] for number in phase.vehicles if number in record.paths_m]
    for axes, size in ((whole, 5.0), (close, 14.0)):
        for k, path in enumerate(paths):
            label = "_" if k else "planned path"
            axes.plot(*path[:, :2].T, "-", color="0.45", linewidth=0.7, label=label, zorder=3)
        axes.scatter(x, y, c=rate, s=size, cmap=RATE_MAP, norm=norm, linewidths=0, zorder=5, rasterized=True)
        plan.draw_truth(axes, record)
        plan.draw_estimates(axes, record.estimates, "final estimate")
    bar = plan.colour_bar(figure, close, ScalarMappable(norm=norm, cmap=RATE_MAP), _RATE_LABEL)
    _plain_log_ticks(bar, norm)
    handles, _ = whole.get_legend_handles_labels()
    plan.legend_above(whole, 2, [*handles, plan.building_patch()])
    return figure


def _plain_log_ticks(bar: Axes, norm: object) -> None:
    """Ticks at 1, 2, 5 times powers of ten, written as plain numbers."""
    assert isinstance(norm, LogNorm)
    bar.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    bar.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    bar.yaxis.set_minor_formatter(NullFormatter())


def _close_up(
    estimate: Estimate | None,
    otherwise_m: NDArray[np.floating],
    site_model: SiteModel,
    with_m: NDArray[np.floating] = NOWHERE,
) -> tuple[NDArray[np.floating], float]:
    """Centre [2] and half side (m) of a close-up within the site.

    It shows the estimate, else the first of ``otherwise_m`` [n, 2], and of ``with_m`` [n, 2] what lies so near to the
    former that both have room; else these.
    """
    west, east, south, north = plan.site_extent(site_model)
    low, high = np.array([west, south]), np.array([east, north])
    most = MOST_SHARE * float(min(high - low))
    half = min(10.0, 0.25 * float(min(high - low)))
    centre = np.asarray(otherwise_m[0], float) if len(otherwise_m) else 0.5 * (low + high)
    if estimate is not None:
        place = np.asarray(estimate.position_m[:2], float)
        shown = np.concatenate([place[None], with_m])
        needed = 0.5 * float(np.max(np.ptp(shown, axis=0))) + MARGIN_M
        if needed <= NEAR_SHARE * float(min(high - low)):
            centre = 0.5 * (shown.min(axis=0) + shown.max(axis=0))
            half = max(half, needed, 0.75 * plan.ellipse_95(estimate.covariance_m2)[0])
    half = min(half, most)
    return np.clip(centre, low + half, high - half), half


def spectrum(record: MissionRecord, site_model: SiteModel) -> Figure:
    """The spectrum taken near the source, with the fit, its lines and the residuals."""
    del site_model
    assert record.spectrum is not None
    return spectrum_figure(record.spectrum)


__all__ = ["figures_of", "write"]
