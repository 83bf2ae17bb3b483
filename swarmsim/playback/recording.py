"""The Rerun recording of a mission: everything that happened, on the timeline ``sim_time``.

Time series are sent as columns, a whole track in one call; a call for each step would take seconds.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from swarmsim.missions.record import MissionRecord, Samples, VehicleRecord
from swarmsim.playback import growing_map
from swarmsim.playback.blueprint import BODY_SCALE, TIMELINE, blueprint, path_of
from swarmsim.playback.bodies import Mesh, shaded, vehicle_mesh
from swarmsim.playback.colours import (
    RateScale,
    linear_scale,
    log_scale,
    rgba,
    smoothed_rate,
    vehicle_colours,
)
from swarmsim.playback.scene_marks import send_legend, send_sources
from swarmsim.playback.story import send_log, send_summary
from swarmsim.site.model import SiteModel

POSE_RATE_HZ = 10.0
TRAIL_RATE_HZ = 2.0
MAP_SNAPSHOTS = 30
SPECTRUM_BARS = 256  # as many as a quarter of a screen can show
MAP_ABOVE_GROUND_M = 0.35
MAP_OPACITY = 190  # of 255


def write_recording(record: MissionRecord, site_model: SiteModel, path: Path) -> None:
    """Write the mission as a Rerun recording to ``path`` (``.rrd``), with the blueprint that it opens with.

    Raises whatever Rerun finds wrong: the recording is complete, or there is an error.
    """
    record = record.finite()
    with _strict():
        stream = rr.RecordingStream("swarmsim", recording_id=f"{record.name}-{record.seed}")
        stream.set_log_tick_enabled(False)
        stream.set_log_time_enabled(False)
        stream.save(path, default_blueprint=blueprint(record, site_model))
        stream.send_recording_name(f"{record.name}, seed {record.seed}")
        samples = record.samples
        aerial, ground = samples.of_phase("aerial"), samples.of_phase("ground")
        scales = {
            "aerial": linear_scale(np.r_[smoothed_rate(aerial), record.map.mean_cps.reshape(-1)]),
            "ground": log_scale(smoothed_rate(ground)),
        }
        _send_site(stream, site_model)
        for vehicle, colour in zip(record.vehicles, vehicle_colours(record), strict=True):
            _send_vehicle(stream, vehicle, colour, min(phase.start_s for phase in record.phases))
            _send_vehicle_plots(stream, vehicle, colour, site_model)
        for phase, part in (("aerial", aerial), ("ground", ground)):
            _send_measurements(stream, record, phase, part, scales[phase])
        _send_count_rates(stream, record)
        _send_map(stream, record, site_model, scales["aerial"])
        send_legend(stream, record, site_model, scales)
        send_sources(stream, record, site_model)
        _send_spectrum(stream, record)
        send_log(stream, record)
        send_summary(stream, record)
        stream.flush()
        stream.disconnect()


@contextmanager
def _strict() -> Iterator[None]:
    """Rerun's errors are raised rather than logged, here and only here."""
    before = rr.strict_mode()
    rr.set_strict_mode(True)
    try:
        yield
    finally:
        rr.set_strict_mode(before)


def _times(time_s: NDArray[np.floating]) -> list[rr.TimeColumn]:
    return [rr.TimeColumn(TIMELINE, duration=np.asarray(time_s, float))]


def _mesh(mesh: Mesh) -> rr.Mesh3D:
    return rr.Mesh3D(
        vertex_positions=mesh.vertices_m,
        triangle_indices=mesh.triangles,
        vertex_normals=mesh.normals,
        vertex_colors=mesh.colours,
    )


def _send_site(stream: rr.RecordingStream, site_model: SiteModel) -> None:
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)  # type: ignore[attr-defined]
    mesh = site_model.mesh
    stream.log("world/site", _mesh(shaded(mesh.vertices_m, mesh.triangles, mesh.colours)), static=True)


def _thinned(time_s: NDArray[np.floating], rate_hz: float) -> NDArray[np.intp]:
    """Indices of samples no closer than 1 / ``rate_hz`` in time, the last one included."""
    if len(time_s) < 2:
        return np.arange(len(time_s))
    step = float(np.median(np.diff(time_s)))
    # The small shortfall keeps a log that is already at this rate whole in spite of rounding.
    stride = max(1, int(np.ceil(1.0 / (rate_hz * step) - 1e-3)))
    return np.unique(np.r_[np.arange(0, len(time_s), stride), len(time_s) - 1])


def _send_vehicle(stream: rr.RecordingStream, vehicle: VehicleRecord, colour: str, start_s: float) -> None:
    """Pose, body and label below ``world/vehicles``, and the trail that grows with time.

    A vehicle whose track begins after the mission, at ``start_s``, waits until then where its track begins; without a
    pose it would be drawn at the origin of the site.
    """
    path = path_of("world/vehicles", vehicle.name)
    keep = _thinned(vehicle.time_s, POSE_RATE_HZ)
    time = vehicle.time_s[keep]
    if len(keep) and time[0] > start_s:
        keep, time = np.r_[keep[0], keep], np.r_[start_s, time]
    xyzw = vehicle.quaternion[keep][:, [1, 2, 3, 0]]
    stream.send_columns(
        path,
        _times(time),
        rr.Transform3D.columns(translation=vehicle.position_m[keep], quaternion=xyzw),
    )
    body = vehicle_mesh(vehicle, colour, BODY_SCALE[vehicle.kind])
    stream.log(f"{path}/body", _mesh(body), static=True)
    stream.log(
        f"{path}/label",
        rr.Points3D(
            [[0.0, 0.0, float(body.vertices_m[:, 2].max()) + 0.5]],
            radii=rr.Radius.ui_points(1.0),
            colors=[[255, 255, 255, 255]],
            labels=[vehicle.name],
            show_labels=True,
        ),
        static=True,
    )
    trail = _thinned(vehicle.time_s, TRAIL_RATE_HZ)
    points = vehicle.position_m[trail]
    moved = np.flatnonzero(np.linalg.norm(np.diff(points, axis=0), axis=1) > 0.05)
    if len(moved) == 0:
        return
    trail_path = path_of("world/trails", vehicle.name)
    stream.log(
        trail_path,
        rr.LineStrips3D.from_fields(colors=[rgba(colour)], radii=rr.Radius.ui_points(1.2)),
        static=True,
    )
    segments = np.stack([points[moved], points[moved + 1]], axis=1).astype(np.float32)
    stream.send_columns(
        trail_path,
        _times(vehicle.time_s[trail][moved + 1]),
        rr.LineStrips3D.columns(strips=list(segments)),
    )


def _send_vehicle_plots(stream: rr.RecordingStream, vehicle: VehicleRecord, colour: str, site_model: SiteModel) -> None:
    keep = _thinned(vehicle.time_s, TRAIL_RATE_HZ)
    position = vehicle.position_m[keep]
    terrain = growing_map.raster_at(
        np.asarray(site_model.site.terrain_m), site_model.site, position[:, 0], position[:, 1]
    )
    series = {"battery": 100.0 * vehicle.battery_fraction[keep], "height": position[:, 2] - terrain}
    for name, values in series.items():
        _send_series(stream, path_of(f"plots/{name}", vehicle.name), vehicle.name, colour, vehicle.time_s[keep], values)


def _send_series(
    stream: rr.RecordingStream,
    path: str,
    name: str,
    colour: str,
    time_s: NDArray[np.floating],
    values: NDArray[np.floating],
) -> None:
    stream.log(path, rr.SeriesLines(names=[name], colors=[rgba(colour)], widths=[1.5]), static=True)
    stream.send_columns(path, _times(time_s), rr.Scalars.columns(scalars=np.asarray(values, float)))


def _send_count_rates(stream: rr.RecordingStream, record: MissionRecord) -> None:
    """Raw rate of each sample as faint points below ``plots/<phase>_samples``, its 1 s mean as a line."""
    colours = vehicle_colours(record)
    for phase in ("aerial", "ground"):
        part = record.samples.of_phase(phase)
        mean = smoothed_rate(part)
        for index in np.unique(part.vehicle):
            name, mine = record.vehicles[index].name, part.vehicle == index
            _send_series(
                stream, path_of(f"plots/{phase}_rate", name), name, colours[index], part.time_s[mine], mean[mine]
            )
            path = path_of(f"plots/{phase}_samples", name)
            stream.log(
                path,
                rr.SeriesPoints(names=[f"{name} samples"], colors=[rgba(colours[index])], marker_sizes=[1.5]),
                static=True,
            )
            rates = part.count_rate_cps[mine].astype(float)
            stream.send_columns(path, _times(part.time_s[mine]), rr.Scalars.columns(scalars=rates))


def _send_measurements(
    stream: rr.RecordingStream, record: MissionRecord, phase: str, samples: Samples, scale: RateScale
) -> None:
    """Every sample as a point where the crystal was, coloured by the 1 s mean rate; a row for each second."""
    colours = scale(smoothed_rate(samples))
    radius = 0.45 if phase == "aerial" else 0.35
    for index in np.unique(samples.vehicle):
        mine = np.flatnonzero(samples.vehicle == index)
        time = samples.time_s[mine]
        last = np.flatnonzero(np.r_[np.diff(np.floor(time)) > 0, True])  # last sample of each second
        lengths = np.diff(np.r_[-1, last])
        path = path_of(f"world/measurements/{phase}", record.vehicles[index].name)
        stream.log(path, rr.Points3D.from_fields(radii=[radius]), static=True)
        stream.send_columns(
            path,
            _times(time[last]),
            rr.Points3D.columns(positions=samples.position_m[mine], colors=colours[mine]).partition(lengths),
        )


def _send_map(stream: rr.RecordingStream, record: MissionRecord, site_model: SiteModel, scale: RateScale) -> None:
    """The growing map: a mesh over the ground whose colours and triangles are sent anew for each snapshot.

    The points come once, at the time of the first triangles and after them in the file: the viewer reads points that
    have no triangles yet as a triangle for every three of them, and complains.
    """
    grid = growing_map.grid_of(record.map)
    drawn = [(s, grid.triangles_where(s.seen)) for s in growing_map.snapshots(record, MAP_SNAPSHOTS)]
    drawn = [(s, triangles) for s, triangles in drawn if len(triangles)]
    if not drawn:
        return
    points = growing_map.drape(grid, site_model.site, MAP_ABOVE_GROUND_M)
    colours = scale(np.stack([s.rate_cps for s, _ in drawn])).reshape(-1, 4)
    triangles = [t for _, t in drawn]
    times = np.array([s.time_s for s, _ in drawn])
    stream.log("world/map", rr.Mesh3D.from_fields(albedo_factor=[255, 255, 255, MAP_OPACITY]), static=True)
    stream.send_columns(
        "world/map",
        _times(times),
        [
            *rr.Mesh3D.columns(vertex_colors=colours).partition([len(points)] * len(drawn)),
            *rr.Mesh3D.columns(triangle_indices=np.concatenate(triangles)).partition([len(t) for t in triangles]),
        ],
    )
    stream.send_columns(
        "world/map", _times(times[:1]), rr.Mesh3D.columns(vertex_positions=points).partition([len(points)])
    )


def _send_spectrum(stream: rr.RecordingStream, record: MissionRecord) -> None:
    """Measured spectrum, its fit and the named nuclide's lines, at the end of the ground phase.

    A bar chart's tensor cannot be sent as a column; these few are logged.
    """
    spectrum = record.spectrum
    if spectrum is None:
        note = rr.TextDocument("No spectrum: nothing was found to identify.", media_type="text/markdown")
        stream.log("spectrum", note, static=True)
        return
    stream.set_time(TIMELINE, duration=float(record.end_s))
    merge = max(1, len(spectrum.counts) // SPECTRUM_BARS)
    kept = len(spectrum.counts) // merge * merge
    energy, counts, fit = (v[:kept].reshape(-1, merge) for v in (spectrum.energy_kev, spectrum.counts, spectrum.fit))
    middle = energy.mean(axis=1)
    width = float(middle[1] - middle[0])
    for name, values, colour, share in (("measured", counts, "#56B4E9", 0.9), ("fit", fit, "#E69F00", 0.25)):
        bars = rr.BarChart(
            values.sum(axis=1), abscissa=middle, widths=[share * width] * len(middle), color=rgba(colour)
        )
        stream.log(f"spectrum/{name}", bars)
    height = 1.05 * float(counts.sum(axis=1).max())
    for line in spectrum.lines_kev:
        mark = rr.BarChart([height], abscissa=[float(line)], widths=[0.4 * width], color=rgba("#D55E00"))
        stream.log(path_of("spectrum", f"{spectrum.nuclide}_{line:.0f}_keV"), mark)
    stream.reset_time()
