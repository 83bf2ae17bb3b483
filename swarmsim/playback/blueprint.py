"""How the viewer opens a mission: the scene large, the map, the plots, the spectrum and the log around it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from swarmsim.playback.colours import DRIVEN, measured_phases
from swarmsim.playback.entities import TIMELINE, measurements_path, measurers, path_of, trails
from swarmsim.playback.overlay import Overlay, error_view, height_view, side_view, speed_view, top_view
from swarmsim.results.record import MissionRecord
from swarmsim.site.model import SiteModel

_BACKGROUND = [30, 33, 39]
_PLAYBACK_SPEED = 10.0
_PLOTS_ABREAST = 2  # count rates of more phases than these share one place


def site_bounds(site_model: SiteModel) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner [3] of the site's mesh."""
    vertices = site_model.mesh.vertices_m
    return vertices.min(axis=0).astype(float), vertices.max(axis=0).astype(float)


def blueprint(record: MissionRecord, site_model: SiteModel, overlay: Overlay | None = None) -> rrb.Blueprint:
    """The layout that is stored with the recording; with the tracks of a vehicle that was flown outside, if given."""
    low, high = site_bounds(site_model)
    spectrum = [_spectrum(record)] if record.sought == "nuclide" else []
    above: rrb.View | rrb.Container = _map(record, low, high)
    plots = _plots(record)
    if overlay is not None:
        above = rrb.Tabs(top_view(overlay, f"{overlay.vehicle}: planned, simulated, flown", site=True), above)
        plots = rrb.Horizontal(error_view(overlay, f"{overlay.vehicle}: error [m]"), plots, column_shares=[1.0, 2.0])
    right = rrb.Vertical(above, *spectrum, _texts(), row_shares=[1.45, *(1.0 for _ in spectrum), 1.0])
    scene = rrb.Vertical(_scene(record, low, high), plots, row_shares=[2.8, 1.0])
    return _laid_out(rrb.Horizontal(scene, right, column_shares=[2.1, 1.0]))


def track_blueprint(overlay: Overlay, site: bool) -> rrb.Blueprint:
    """The layout of a flight alone: its tracks from the side and from above, its errors and heights."""
    errors = [error_view(overlay)] if overlay.has_errors() else []
    plots = rrb.Horizontal(*errors, speed_view(overlay), height_view(overlay))
    return _laid_out(
        rrb.Horizontal(
            rrb.Vertical(side_view(overlay, site), plots, row_shares=[2.0, 1.0]),
            rrb.Vertical(top_view(overlay, "From above (north up)", site), _log()),
            column_shares=[1.7, 1.0],
        )
    )


def live_blueprint(site_model: SiteModel, names: Sequence[str], vehicle: str) -> rrb.Blueprint:
    """The layout of a mission under way, with ``vehicle`` flown outside."""
    low, high = site_bounds(site_model)
    growing = _so_far([path_of("world/trails", name) for name in names])
    plots = [
        rrb.TimeSeriesView(origin=origin, name=name)
        for origin, name in (
            ("plots/error", f"{vehicle}: distance from the setpoint [m]"),
            ("plots/height", "Height [m]"),
            ("plots/rate", "Count rate [1/s]"),
            ("plots/battery", f"{vehicle}: battery [%]"),
        )
    ]
    return _laid_out(
        rrb.Horizontal(
            rrb.Vertical(_side(low, high, growing), rrb.Horizontal(*plots[:2]), row_shares=[2.4, 1.0]),
            rrb.Vertical(_above("From above (north up)", [], low, high, growing), rrb.Tabs(*plots[2:]), _log()),
            column_shares=[1.7, 1.0],
        ),
        playback_speed=1.0,
    )


def _laid_out(views: rrb.Container, playback_speed: float = _PLAYBACK_SPEED) -> rrb.Blueprint:
    return rrb.Blueprint(
        views,
        rrb.TimePanel(
            state="collapsed",
            timeline=TIMELINE,
            playback_speed=playback_speed,
            play_state="following",
            loop_mode="off",
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _growing(record: MissionRecord) -> dict[Any, rrb.VisibleTimeRanges]:
    """Trails and measurements show everything up to the time cursor; all else shows its latest state."""
    paths = [path_of("world/trails", name) for name in trails(record)]
    for phase in measured_phases(record):
        paths += [path_of(measurements_path(phase.name), name) for name in measurers(record, phase)]
    return _so_far(paths)


def _so_far(paths: list[str]) -> dict[Any, rrb.VisibleTimeRanges]:
    span = rrb.VisibleTimeRanges(
        timeline=TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    return dict.fromkeys(paths, span)


def _scene(record: MissionRecord, low: np.ndarray, high: np.ndarray) -> rrb.Spatial3DView:
    return _side(low, high, _growing(record))


def _side(low: np.ndarray, high: np.ndarray, growing: dict[Any, rrb.VisibleTimeRanges]) -> rrb.Spatial3DView:
    """The site from the south, a little from the west, so that its longer side lies across the view."""
    centre = 0.5 * (low + high)
    across = float(np.hypot(*(high - low)[:2]))
    eye = centre + across * np.array([-0.09, -0.61, 0.44])
    return _view("Mission", [], eye, centre + across * np.array([0.0, -0.10, 0.0]), [0.0, 0.0, 1.0], growing)


def _map(record: MissionRecord, low: np.ndarray, high: np.ndarray) -> rrb.Spatial3DView:
    """The scene from straight above, north up, without the points measured in flight, which would hide the map."""
    flown = [phase.name for phase in measured_phases(record) if record.map is not None and record.is_flown(phase)]
    hidden = ["world/labels", f"world/legend/{DRIVEN}", *map(measurements_path, flown)]
    name = "Map (north up)" if record.map is not None else "From above (north up)"
    return _above(name, hidden, low, high, _growing(record))


def _above(
    name: str, hidden: list[str], low: np.ndarray, high: np.ndarray, growing: dict[Any, rrb.VisibleTimeRanges]
) -> rrb.Spatial3DView:
    centre, size = 0.5 * (low + high), high - low
    target = centre - [0.0, 0.04 * size[1], 0.0]  # room for the legend along the south edge
    eye = target + np.array([0.0, 0.0, 1.2 * max(size[1], 0.7 * size[0])])
    return _view(name, hidden, eye, target, [0.0, 1.0, 0.0], growing)


def _view(
    name: str, hidden: list[str], eye: np.ndarray, target: np.ndarray, up: list[float],
    growing: dict[Any, rrb.VisibleTimeRanges],
) -> rrb.Spatial3DView:  # fmt: skip
    return rrb.Spatial3DView(
        name=name,
        origin="world",
        contents=["+ world/**", *(f"- {path}/**" for path in hidden)],
        background=rrb.Background(color=_BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=eye, look_target=target, eye_up=up),
        overrides=growing,
    )


def _plots(record: MissionRecord) -> rrb.Container:
    """Count rates against the time of their phase; batteries and heights against that of the mission."""
    whole = (record.start_s, record.end_s)

    def plot(
        origin: str, name: str, span: tuple[float, float], legend: rrb.Corner2D = rrb.Corner2D.LeftTop
    ) -> rrb.TimeSeriesView:
        start, end = (rrb.TimeRangeBoundary.absolute(seconds=s) for s in (span if span[1] > span[0] else whole))
        return rrb.TimeSeriesView(
            origin=origin,
            name=name,
            axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end)),
            plot_legend=rrb.PlotLegend(corner=legend),
        )

    rates = [
        plot(path_of("plots/rate", phase.name), f"Count rate, {phase.name} [1/s]", (phase.start_s, phase.end_s))
        for phase in measured_phases(record)
    ]
    states = [
        plot("plots/battery", "Battery [%]", whole, rrb.Corner2D.LeftBottom),  # full ones start in the left top
        plot("plots/height", "Height above ground [m]", whole, rrb.Corner2D.RightTop),
    ]
    if not rates:
        return rrb.Horizontal(*states)
    abreast = rates if len(rates) <= _PLOTS_ABREAST else [rrb.Tabs(*rates)]
    return rrb.Horizontal(*abreast, rrb.Tabs(*states))


def _spectrum(record: MissionRecord) -> rrb.View:
    """Bars of the spectrum; a sentence where there is none."""
    if record.spectrum is None:
        return rrb.TextDocumentView(origin="spectrum", name="Spectrum")
    return rrb.BarChartView(
        origin="spectrum",
        name=f"Spectrum (counts against keV), {record.spectrum.live_time_s:.0f} s live time",
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
    )


def _texts() -> rrb.Container:
    return rrb.Tabs(_log("Mission log"), rrb.TextDocumentView(origin="summary", name="Summary"))


def _log(name: str = "Log") -> rrb.TextLogView:
    return rrb.TextLogView(
        origin="log",
        name=name,
        columns=rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["LogLevel", "Body"]),
    )
