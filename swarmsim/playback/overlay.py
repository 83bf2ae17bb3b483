"""A flown track over the planned paths and the simulated track: what is drawn, in recordings and in figures."""

from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from swarmsim.autopilot.compare import Comparison, Planned, Simulated, Track
from swarmsim.playback.colours import rgba
from swarmsim.playback.entities import TIMELINE, path_of, send_series, times

FLOWN, SIMULATED, PLANNED = "#0072B2", "#E69F00", "#8C8C8C"
"""Colours of the three: blue, orange (Okabe & Ito) and grey."""
ROOT, ERRORS, STATES = "overlay", "plots/overlay_error", "plots/overlay_state"
_RATE_HZ = 10.0
_BACKGROUND = [30, 33, 39]
_ROOM = 1.25  # of a view from above around what it shows
_LINE_POINTS = 20_000
_CLOSE_M = 10.0  # least width of a view


@dataclass(frozen=True)
class Overlay:
    """The three tracks of one vehicle, on the flown one's clock but for the simulated one."""

    vehicle: str
    flown: Track
    judged: Track  # the part of the flown track that is compared
    comparison: Comparison
    planned: tuple[Planned, ...] = ()
    simulated: Simulated | None = None
    marks: tuple[tuple[float, str], ...] = ()  # changes of mode and the like: time, text

    def simulated_track(self) -> Track | None:
        """The simulated track on the flown one's clock; None where there is none, or no common time."""
        shift = self.comparison.shift_s
        if self.simulated is None or shift is None:
            return None
        return Track(self.simulated.track.time_s + shift, self.simulated.track.position_m)

    def has_errors(self) -> bool:
        """Whether there is anything that the flown track could be compared with."""
        made = self.comparison
        return bool(np.isfinite(made.cross_track_m).any() or np.isfinite(made.synchronised_m).any())

    def bounds_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner [3] of what was judged, the paths and the simulated track."""
        parts = [path.points_m for path in self.planned]
        parts += [self.simulated.track.position_m] if self.simulated is not None else []
        parts += [self.judged.position_m]
        every = np.concatenate([part for part in parts if len(part)] or [self.flown.position_m])
        return every.min(axis=0), every.max(axis=0)


def send_overlay(stream: rr.RecordingStream, overlay: Overlay) -> None:
    """The three lines, a dot on two of them that moves, and the errors and heights as series."""
    for path in overlay.planned:
        _line(stream, path_of(f"{ROOT}/planned", path.phase), path.points_m, "#C8C8C8", 1.0)
    _line(stream, f"{ROOT}/flown", overlay.flown.position_m, FLOWN, 1.6)
    _dot(stream, f"{ROOT}/at/flown", overlay.flown, FLOWN, "flown")
    track = overlay.simulated_track()
    if overlay.simulated is not None:
        _line(stream, f"{ROOT}/simulated", overlay.simulated.track.position_m, SIMULATED, 1.2)
    if track is not None:
        _dot(stream, f"{ROOT}/at/simulated", track, SIMULATED, "simulated")
    for when, text in overlay.marks:
        stream.set_time(TIMELINE, duration=when)
        stream.log("log/vehicle", rr.TextLog(text, level=rr.TextLogLevel.INFO))
    stream.reset_time()
    made = overlay.comparison
    for name, colour, label, values in (
        ("cross_track", FLOWN, "from the planned path", made.cross_track_m),
        ("synchronised", SIMULATED, "from the simulated vehicle, at the same time", made.synchronised_m),
        ("above_simulated", "#009E73", "height over the simulated vehicle", made.above_m),
    ):
        _series(stream, f"{ERRORS}/{name}", label, colour, made.time_s, values)
    for name, colour, label, each in (
        ("flown", FLOWN, "flown", overlay.flown),
        ("simulated", SIMULATED, "simulated", track),
    ):
        if each is not None:
            _series(stream, f"{STATES}/height/{name}", label, colour, each.time_s, each.position_m[:, 2])
            speed = each.speed_m_s(each.time_s) if len(each.time_s) else np.zeros(0)
            _series(stream, f"{STATES}/speed/{name}", label, colour, each.time_s, speed)


def error_view(overlay: Overlay, name: str = "Flown: error [m]") -> rrb.TimeSeriesView:
    """The errors over the time that was judged."""
    made = overlay.comparison
    return _plot(ERRORS, name, overlay, made.cross_track_m, made.synchronised_m, made.above_m)


def speed_view(overlay: Overlay) -> rrb.TimeSeriesView:
    """Horizontal speeds of the flown and the simulated vehicle."""
    tracks = [track for track in (overlay.judged, overlay.simulated_track()) if track is not None]
    shown = (track.speed_m_s(track.time_s) for track in tracks if len(track.time_s))
    return _plot(f"{STATES}/speed", "Horizontal speed [m/s]", overlay, *shown)


def height_view(overlay: Overlay) -> rrb.TimeSeriesView:
    """Heights of the flown and the simulated vehicle."""
    tracks = [track for track in (overlay.judged, overlay.simulated_track()) if track is not None]
    return _plot(f"{STATES}/height", "Height [m]", overlay, *(track.position_m[:, 2] for track in tracks))


def top_view(overlay: Overlay, name: str, site: bool) -> rrb.Spatial3DView:
    """The tracks from straight above, north up."""
    low, high = overlay.bounds_m()
    centre, size = 0.5 * (low + high), np.maximum(high - low, _CLOSE_M)
    eye = centre + np.array([0.0, 0.0, _ROOM * max(size[1], 0.75 * size[0]) + high[2] - centre[2]])
    return rrb.Spatial3DView(
        name=name,
        origin="/",
        contents=[f"+ {ROOT}/**", *(["+ world/site"] if site else [])],
        background=rrb.Background(color=_BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=not site),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye, look_target=centre, eye_up=[0.0, 1.0, 0.0]
        ),
    )


def side_view(overlay: Overlay, site: bool) -> rrb.Spatial3DView:
    """The tracks from the south, a little from above."""
    low, high = overlay.bounds_m()
    centre, across = 0.5 * (low + high), max(float(np.linalg.norm(high - low)), _CLOSE_M)
    return rrb.Spatial3DView(
        name=f"{overlay.vehicle}: planned, simulated, flown" if overlay.planned else overlay.vehicle,
        origin="/",
        contents=[f"+ {ROOT}/**", *(["+ world/site"] if site else [])],
        background=rrb.Background(color=_BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=not site),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=centre + across * np.array([-0.2, -0.85, 0.6]),
            look_target=centre,
            eye_up=[0.0, 0.0, 1.0],
        ),
    )


def _plot(origin: str, name: str, overlay: Overlay, *shown: NDArray[np.floating]) -> rrb.TimeSeriesView:
    """A plot over the judged time, with room for all that is ``shown`` and for the legend above it."""
    span = overlay.judged.time_s if len(overlay.judged.time_s) > 1 else overlay.flown.time_s
    start, end = (rrb.TimeRangeBoundary.absolute(seconds=float(span[k])) for k in (0, -1))
    values = np.concatenate([each[np.isfinite(each)] for each in shown] or [np.zeros(0)])
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    room = max(0.1 * (high - low), 0.05)
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end)),
        axis_y=rrb.ScalarAxis(range=(low - room, high + 4.0 * room)),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
    )


def _line(stream: rr.RecordingStream, path: str, points_m: NDArray[np.floating], colour: str, width: float) -> None:
    points = points_m[:: max(1, len(points_m) // _LINE_POINTS)]
    if len(points) > 1:
        strip = rr.LineStrips3D([points], colors=[rgba(colour)], radii=rr.Radius.ui_points(width))
        stream.log(path, strip, static=True)


def _dot(stream: rr.RecordingStream, path: str, track: Track, colour: str, label: str) -> None:
    look = rr.Points3D.from_fields(
        radii=rr.Radius.ui_points(5.0), colors=[rgba(colour)], labels=[label], show_labels=True
    )
    stream.log(path, look, static=True)
    keep = thinned(track.time_s)
    stream.send_columns(path, times(track.time_s[keep]), rr.Points3D.columns(positions=track.position_m[keep]))


def _series(
    stream: rr.RecordingStream, path: str, label: str, colour: str, time_s: NDArray[np.floating],
    values: NDArray[np.floating],
) -> None:  # fmt: skip
    keep = thinned(time_s)
    keep = keep[np.isfinite(values[keep])]
    if len(keep):
        send_series(stream, path, label, colour, time_s[keep], values[keep])


def thinned(time_s: NDArray[np.floating]) -> NDArray[np.intp]:
    """Rows at about 10 Hz."""
    if not len(time_s):
        return np.zeros(0, np.intp)
    bins = np.floor((time_s - time_s[0]) * _RATE_HZ + 1e-6)
    return np.flatnonzero(np.r_[True, np.diff(bins) > 0.0])
