"""The Rerun recording of a mission: everything that happened, on the timeline ``sim_time``.

Time series are sent as columns, a whole track in one call; a call for each step would take seconds.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from swarmsim.playback import growing_map
from swarmsim.playback.blueprint import blueprint, track_blueprint
from swarmsim.playback.bodies import shaded
from swarmsim.playback.colours import (
    ESTIMATE,
    FLOWN,
    RateScale,
    measured_phases,
    rate_scales,
    rgba,
    scale_name,
    smoothed_rate,
    vehicle_colours,
)
from swarmsim.playback.entities import (
    TIMELINE,
    is_large,
    measurements_path,
    measurers,
    mesh3d,
    path_of,
    send_points,
    send_series,
    times,
)
from swarmsim.playback.fleet import send_fleet
from swarmsim.playback.overlay import Overlay, send_overlay
from swarmsim.playback.scene_marks import send_legend, send_paths, send_sources
from swarmsim.playback.story import send_log, send_summary
from swarmsim.playback.vehicles import send_vehicles
from swarmsim.results.record import MissionRecord, Phase, RadiationMap, Samples
from swarmsim.site.model import SiteModel

SAMPLES_MAX = 80_000  # of all phases: about 3 MB; more are thinned, each vehicle alike
MAP_SNAPSHOTS = 30
_FLUSH_S = 300.0  # that the rest of a recording may take to be written
SPECTRUM_BARS = 256  # as many as a quarter of a screen can show
MAP_ABOVE_GROUND_M = 0.35
MAP_OPACITY = 190  # of 255


def write_recording(record: MissionRecord, site_model: SiteModel, path: Path, overlay: Overlay | None = None) -> None:
    """Write the mission as a Rerun recording to ``path`` (``.rrd``), with the blueprint that it opens with.

    ``overlay``: flown, simulated and planned tracks of a vehicle that was flown outside. Raises whatever Rerun finds
    wrong: the recording is complete, or there is an error.
    """
    record = record.finite()
    with _stream(path, f"{record.name}-{record.seed}", blueprint(record, site_model, overlay)) as stream:
        stream.send_recording_name(f"{record.name}, seed {record.seed}")
        send_site(stream, site_model)
        (send_fleet if is_large(record) else send_vehicles)(stream, record, site_model)
        scales = rate_scales(record)
        for phase in measured_phases(record):
            samples = record.samples.of_phase(phase.name)
            keep = _drawn(samples, len(record.samples.time_s))
            samples, mean = samples.rows(keep), smoothed_rate(samples)[keep]
            _send_measurements(stream, record, phase, samples, scales[scale_name(record, phase)](mean))
            _send_count_rates(stream, record, phase, samples, mean)
        if record.map is not None:
            _send_map(stream, record, record.map, site_model, scales[FLOWN])
        send_legend(stream, record, site_model, scales)
        send_sources(stream, record, site_model)
        send_paths(stream, record)
        _send_spectrum(stream, record)
        send_log(stream, record)
        send_summary(stream, record)
        if overlay is not None:
            send_overlay(stream, overlay)


def write_track_recording(overlay: Overlay, site_model: SiteModel | None, path: Path) -> None:
    """Write a flight as a Rerun recording to ``path``: its tracks, in the site if there is one, and its errors.

    Raises whatever Rerun finds wrong, as `write_recording`.
    """
    with _stream(path, f"flight-{overlay.vehicle}", track_blueprint(overlay, site_model is not None)) as stream:
        stream.send_recording_name(f"flight of {overlay.vehicle}")
        if site_model is not None:
            send_site(stream, site_model)
        send_overlay(stream, overlay)


@contextmanager
def _stream(path: Path, recording_id: str, layout: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """A recording into a file, written when the block ends."""
    with _strict():
        stream = rr.RecordingStream("swarmsim", recording_id=recording_id)
        stream.set_log_tick_enabled(False)
        stream.set_log_time_enabled(False)
        stream.save(path, default_blueprint=layout)
        yield stream
        try:
            stream.flush(timeout_sec=_FLUSH_S)
            stream.disconnect()
        except RuntimeError as error:  # the thread that writes has met a full disk, which it alone knows of
            raise OSError(f"the recording could not be written: {error}") from error


@contextmanager
def _strict() -> Iterator[None]:
    """Rerun's errors are raised rather than logged, here and only here."""
    before = rr.strict_mode()
    rr.set_strict_mode(True)
    try:
        yield
    finally:
        rr.set_strict_mode(before)


def _drawn(samples: Samples, total: int) -> NDArray[np.intp]:
    """Rows of a phase's samples that are drawn: thinned in proportion where the mission's ``total`` is too large."""
    every = -(-total // SAMPLES_MAX)
    kept = [np.flatnonzero(samples.vehicle == number)[::every] for number in np.unique(samples.vehicle)]
    return np.sort(np.concatenate(kept))


def send_site(stream: rr.RecordingStream, site_model: SiteModel) -> None:
    """The site's mesh, and which way is up."""
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)  # type: ignore[attr-defined]
    mesh = site_model.mesh
    stream.log("world/site", mesh3d(shaded(mesh.vertices_m, mesh.triangles, mesh.colours)), static=True)


def _send_count_rates(
    stream: rr.RecordingStream, record: MissionRecord, phase: Phase, samples: Samples, mean_cps: NDArray[np.floating]
) -> None:
    """1 s mean of the count rate [n] below ``plots/rate``, the rate of each sample as points below ``plots/samples``.

    The means are a line for each vehicle; those of a large team are points together.
    """
    colours, large = vehicle_colours(record), is_large(record)
    rate, raw = path_of("plots/rate", phase.name), path_of("plots/samples", phase.name)
    for name, numbers in measurers(record, phase).items():
        mine = np.isin(samples.vehicle, numbers)
        if not mine.any():
            continue
        colour, time = ESTIMATE if large else colours[numbers[0]], samples.time_s[mine]
        (send_points if large else send_series)(stream, path_of(rate, name), name, colour, time, mean_cps[mine])
        rates = samples.count_rate_cps[mine]
        send_points(stream, path_of(raw, name), f"{name} samples", colour, time, rates)


def _send_measurements(
    stream: rr.RecordingStream, record: MissionRecord, phase: Phase, samples: Samples, colours: NDArray[np.uint8]
) -> None:
    """Every sample as a point where the crystal was, in its colour [n, 4]; a row for each second."""
    radius = 0.45 if record.is_flown(phase) else 0.35
    for name, numbers in measurers(record, phase).items():
        mine = np.flatnonzero(np.isin(samples.vehicle, numbers))
        if not len(mine):
            continue
        time = samples.time_s[mine]
        last = np.flatnonzero(np.r_[np.diff(np.floor(time)) > 0, True])  # last sample of each second
        lengths = np.diff(np.r_[-1, last])
        path = path_of(measurements_path(phase.name), name)
        stream.log(path, rr.Points3D.from_fields(radii=[radius]), static=True)
        points = rr.Points3D.columns(positions=samples.position_m[mine], colors=colours[mine])
        stream.send_columns(path, times(time[last]), points.partition(lengths))


def _send_map(
    stream: rr.RecordingStream, record: MissionRecord, made: RadiationMap, site_model: SiteModel, scale: RateScale
) -> None:
    """The growing map: a mesh over the ground whose colours and triangles are sent anew for each snapshot.

    The points come once, at the time of the first triangles and after them in the file: the viewer reads points that
    have no triangles yet as a triangle for every three of them, and complains.
    """
    grid = growing_map.grid_of(made)
    drawn = [(s, grid.triangles_where(s.seen)) for s in growing_map.snapshots(record, made, MAP_SNAPSHOTS)]
    drawn = [(s, triangles) for s, triangles in drawn if len(triangles)]
    if not drawn:
        return
    points = growing_map.drape(grid, site_model.site, MAP_ABOVE_GROUND_M)
    colours = scale(np.stack([s.rate_cps for s, _ in drawn])).reshape(-1, 4)
    triangles = [t for _, t in drawn]
    time_s = np.array([s.time_s for s, _ in drawn])
    stream.log("world/map", rr.Mesh3D.from_fields(albedo_factor=[255, 255, 255, MAP_OPACITY]), static=True)
    stream.send_columns(
        "world/map",
        times(time_s),
        [
            *rr.Mesh3D.columns(vertex_colors=colours).partition([len(points)] * len(drawn)),
            *rr.Mesh3D.columns(triangle_indices=np.concatenate(triangles)).partition([len(t) for t in triangles]),
        ],
    )
    stream.send_columns(
        "world/map", times(time_s[:1]), rr.Mesh3D.columns(vertex_positions=points).partition([len(points)])
    )


def _send_spectrum(stream: rr.RecordingStream, record: MissionRecord) -> None:
    """Measured spectrum, its fit and the named nuclide's lines, at the end; a sentence where none was taken.

    A bar chart's tensor cannot be sent as a column; these few are logged.
    """
    spectrum = record.spectrum
    if spectrum is None and record.sought != "nuclide":
        return
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
