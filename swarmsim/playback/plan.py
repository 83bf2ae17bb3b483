"""The site plan under every map figure: axes to scale, buildings in grey, north arrow, and print settings."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends import backend_pdf  # noqa: F401 - with its fonts' library, or `savefig` imports it last
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import ScalarFormatter
from numpy.typing import NDArray

from swarmsim.playback.colours import ESTIMATE, TRUTH
from swarmsim.results.record import Estimate, MissionRecord
from swarmsim.site.model import SiteModel, height_at

SINGLE_COLUMN_IN = 3.5  # 89 mm: one column of a two-column journal
DOUBLE_COLUMN_IN = 7.16  # 182 mm: its full text width
DPI = 300
BUILDING_MIN_HEIGHT_M = 0.5  # lower things are kerbs and grass
CHI2_95_2 = 5.991  # 95 % quantile of chi-squared, 2 degrees of freedom (NIST/SEMATECH e-Handbook, table 1.3.6.7.4)

_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 7.5,
    "axes.labelsize": 8.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.fontsize": 7.0,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 0.9,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "0.8",
    "legend.borderpad": 0.35,
    "legend.handlelength": 1.6,
    "pdf.fonttype": 42,  # text stays text
}


@contextmanager
def print_style() -> Iterator[None]:
    """Matplotlib's settings for print, inside the ``with`` alone."""
    with matplotlib.rc_context(_STYLE):
        yield


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure with a canvas of its own: nothing global, no window."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def site_extent(site_model: SiteModel) -> tuple[float, float, float, float]:
    """West, east, south and north edge of the site in m."""
    site = site_model.site
    cell = float(site.cell_m)
    ny, nx = site.terrain_m.shape
    x, y = np.asarray(site.origin_m, float) - 0.5 * cell
    return x, x + nx * cell, y, y + ny * cell


def new_plan(site_model: SiteModel, legend_height_in: float = 0.32, bar: bool = True) -> tuple[Figure, Axes]:
    """A single-column figure whose axes show the whole site to scale, with room for a legend above.

    With ``bar`` there is room for a colour bar beside them.
    """
    west, east, south, north = site_extent(site_model)
    left, right, bottom = 0.53, 0.66 if bar else 0.1, 0.38
    width = SINGLE_COLUMN_IN - left - right
    height = min(width * (north - south) / (east - west), 1.6 * width)
    total = bottom + height + legend_height_in
    figure = new_figure(SINGLE_COLUMN_IN, total)
    axes = figure.add_axes((left / SINGLE_COLUMN_IN, bottom / total, width / SINGLE_COLUMN_IN, height / total))
    draw_site(axes, site_model)
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
    return figure, axes


def new_pair(site_model: SiteModel, centre_m: NDArray[np.floating], half_m: float) -> tuple[Figure, Axes, Axes]:
    """A double-column figure: the whole site on the left, a square close-up around ``centre_m`` [2] on the right."""
    figure = new_figure(DOUBLE_COLUMN_IN, 3.05)
    whole = figure.add_axes((0.08, 0.13, 0.40, 0.73))
    close = figure.add_axes((0.555, 0.13, 0.32, 0.73))
    west, east, south, north = site_extent(site_model)
    for axes in (whole, close):
        draw_site(axes, site_model)
    whole.set_xlim(west, east)
    whole.set_ylim(south, north)
    close.set_xlim(centre_m[0] - half_m, centre_m[0] + half_m)
    close.set_ylim(centre_m[1] - half_m, centre_m[1] + half_m)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half_m + centre_m
    (frame,) = whole.plot(*corners.T, color="black", linewidth=0.7, zorder=6)
    frame.set_path_effects([halo(0.7)])
    name = whole.annotate(
        "close-up", corners[3], xytext=(0, 2), textcoords="offset points", fontsize=7.0, va="bottom", zorder=9
    )
    name.set_path_effects([halo(1.0)])
    return figure, whole, close


def halo(linewidth: float) -> withStroke:
    """A white rim about a line of this width or a text, so that it is seen on the dark and on the bright end."""
    return withStroke(linewidth=linewidth + 0.9, foreground="white")


def _seen_from_above(site_model: SiteModel) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Corners [k, 4, 2] of the boxes of what stands on the site, the tallest last, and their heights [k] above ground.

    The raster of the surface would show them up to a cell larger on every side.
    """
    site, boxes = site_model.site, site_model.site.obstacles
    centre, half = np.asarray(boxes.centre_m, float), np.asarray(boxes.half_extent_m, float)
    along = np.asarray(boxes.axis, float)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    ground = height_at(site, centre[:, :2])
    above = centre[:, 2] + half[:, 2] - ground
    order = np.argsort(above)
    order = order[(above[order] >= BUILDING_MIN_HEIGHT_M) & np.all(half[order] > 0.0, axis=1)]
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    sides = np.stack([along * half[:, :1], across * half[:, 1:2]], axis=1)  # [k, 2, 2]
    corners = centre[:, None, :2] + signs @ sides
    return corners[order], above[order]


def _within_another(number: int, corners: NDArray[np.floating]) -> bool:
    """Whether rectangle ``number`` of ``corners`` [k, 4, 2] lies within another; of equal ones the first does not."""
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]], axis=1)  # [k, 2, 2]
    lengths = np.sum(sides * sides, axis=2)
    share = np.einsum("kij,klj->kil", corners[number] - corners[:, :1], sides) / lengths[:, None]
    around = np.all((share > -1e-4) & (share < 1.0 + 1e-4), axis=(1, 2))
    area = np.sqrt(np.prod(lengths, axis=1))
    larger = (area > area[number] * (1.0 + 1e-3)) | (np.arange(len(corners)) < number)
    return bool(np.any(around & larger))


def draw_site(axes: Axes, site_model: SiteModel) -> None:
    """Buildings and other tall things in grey, the taller the darker; scale equal, north up."""
    corners, above = _seen_from_above(site_model)
    shapes = PolyCollection(list(corners), cmap="Greys", edgecolors="face", linewidths=0.5, zorder=1)
    shapes.set_array(above)
    shapes.set_clim(-8.0, max(18.0, float(above.max(initial=0.0)) * 1.4))  # so that the lowest is already a clear grey
    axes.add_collection(shapes)
    frame_axes(axes)


def outline_site(axes: Axes, site_model: SiteModel) -> None:
    """Outlines of what `draw_site` fills, over an image; without the boxes that lie within another one."""
    corners, _ = _seen_from_above(site_model)
    outer = [box for number, box in enumerate(corners) if not _within_another(number, corners)]
    shapes = PolyCollection(outer, facecolors="none", edgecolors="black", linewidths=0.5, zorder=3)
    shapes.set_path_effects([halo(0.2)])
    axes.add_collection(shapes)


def frame_axes(axes: Axes) -> None:
    """Scale equal, north up, with an arrow that says so in the corner that the two axes' labels leave free."""
    axes.set_aspect("equal")
    axes.set_xlabel("East [m]")
    axes.set_ylabel("North [m]")
    axes.annotate(
        "N",
        xy=(-17.0, -5.0),
        xytext=(-17.0, -21.0),
        xycoords="axes points",
        ha="center",
        va="center",
        fontsize=7.5,
        arrowprops={"arrowstyle": "-|>", "color": "black", "linewidth": 0.8, "shrinkA": 1, "shrinkB": 0},
        annotation_clip=False,
    )


def building_patch() -> Patch:
    """Legend entry of the grey shapes: buildings, trees, walls."""
    return Patch(facecolor="0.7", edgecolor="none", label="obstacles")


def colour_bar(
    figure: Figure, axes: Axes, mappable: object, label: str, extend: Literal["neither", "max"] = "neither"
) -> Axes:
    """A slim colour bar along the right of ``axes``, as high as they are; with an arrow where values exceed it."""
    axes.apply_aspect()
    box = axes.get_position()
    bar_axes = figure.add_axes((box.x1 + 0.05 / figure.get_figwidth(), box.y0, 0.1 / figure.get_figwidth(), box.height))
    bar = figure.colorbar(mappable, cax=bar_axes, extend=extend)  # type: ignore[arg-type]
    bar.set_label(label)
    if isinstance(bar.formatter, ScalarFormatter):  # ticks of many digits would push the label off the figure
        bar.formatter.set_powerlimits((-3, 4))
        bar.formatter.set_useMathText(True)
    bar.outline.set_linewidth(0.6)  # type: ignore[operator]
    return bar_axes


def legend_above(axes: Axes, columns: int, handles: list | None = None) -> None:
    """A legend over the axes, out of the way of what is drawn."""
    extra = {} if handles is None else {"handles": handles}
    axes.legend(
        loc="lower left", bbox_to_anchor=(-0.02, 1.01), ncols=columns, borderaxespad=0.0, columnspacing=1.0, **extra
    )


def draw_truth(axes: Axes, record: MissionRecord) -> None:
    """Crosses at the true sources: at the centre of a line or an area with its outline, at the start of a track."""
    for k, source in enumerate(record.sources):
        xy: NDArray[np.floating] = np.zeros((0, 2))
        if source.corners_m is not None:
            corners = np.asarray(source.corners_m, float)[:, :2]
            xy = corners if source.form == "line" else np.concatenate([corners, corners[:1]])
        elif source.carrier is not None:
            xy = record.track_of(source)[:, :2]
        if len(xy):
            axes.plot(*xy.T, ":" if source.form == "carried" else "-", color=TRUTH, linewidth=1.0, zorder=7)
        axes.plot(
            *source.position_m[:2],
            linestyle="none",
            marker="x",
            markersize=5.5,
            markeredgewidth=1.4,
            color=TRUTH,
            label="true source" if k == 0 else None,
            zorder=7,
        )


def draw_estimates(axes: Axes, estimates: Sequence[Estimate], label: str) -> None:
    """A dot at each estimate and the ellipse that holds 95 % of its horizontal uncertainty, if that is known.

    The legend has one entry for those with an ellipse, and one for those without.
    """
    for known in (True, False):
        alike = [one for one in estimates if one.errors_known == known]
        if not alike:
            continue
        plural = "s" if len(alike) > 1 else ""
        entry = f"{label}{plural}, 95 % ellipse{plural}" if known else f"{label}{plural} (saturated counter)"
        places = np.array([one.position_m[:2] for one in alike], float)
        axes.plot(*places.T, linestyle="none", marker="o", markersize=3.0, color=ESTIMATE, markeredgecolor="white",
                  markeredgewidth=0.4, label=entry, zorder=8)  # fmt: skip
        for one in alike if known else ():
            axes.add_patch(_ellipse(one))


def _ellipse(estimate: Estimate) -> Ellipse:
    """The outline that holds 95 % of an estimate's horizontal uncertainty."""
    x, y = map(float, estimate.position_m[:2])
    width, height, angle = ellipse_95(estimate.covariance_m2)
    return Ellipse((x, y), width, height, angle=angle, fill=False, edgecolor=ESTIMATE, linewidth=1.0, zorder=8)


def ellipse_95(covariance_m2: NDArray[np.floating]) -> tuple[float, float, float]:
    """Full width and height (m) and turn (deg, counter-clockwise from east) of the horizontal 95 % ellipse."""
    variances, axes = np.linalg.eigh(np.asarray(covariance_m2, float)[:2, :2])
    width, height = 2.0 * np.sqrt(CHI2_95_2 * np.maximum(variances[::-1], 0.0))
    return float(width), float(height), float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
