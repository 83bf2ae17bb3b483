"""The vehicles of a team in the recording: bodies that move, names, trails, batteries and heights."""

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from swarmsim.playback.bodies import vehicle_mesh
from swarmsim.playback.colours import rgba, vehicle_colours
from swarmsim.playback.entities import BODY_SCALE, mesh3d, path_of, send_series, times
from swarmsim.playback.growing_map import raster_at
from swarmsim.results.record import MissionRecord, VehicleRecord
from swarmsim.site.model import SiteModel

POSE_RATE_HZ = 10.0
TRAIL_RATE_HZ = 2.0
MOVED_M = 0.05  # a trail has no segments shorter than this


def send_vehicles(stream: rr.RecordingStream, record: MissionRecord, site_model: SiteModel) -> None:
    """Each vehicle in entities of its own."""
    for vehicle, colour in zip(record.vehicles, vehicle_colours(record), strict=True):
        _send_body(stream, vehicle, colour, record.start_s)
        _send_trail(stream, vehicle, colour)
        _send_plots(stream, vehicle, colour, site_model)


def _thinned(time_s: NDArray[np.floating], rate_hz: float) -> NDArray[np.intp]:
    """Indices of samples no closer than 1 / ``rate_hz`` in time, the last one included."""
    if len(time_s) < 2:
        return np.arange(len(time_s))
    step = float(np.median(np.diff(time_s)))
    # The small shortfall keeps a log that is already at this rate whole in spite of rounding.
    stride = max(1, int(np.ceil(1.0 / (rate_hz * step) - 1e-3)))
    return np.unique(np.r_[np.arange(0, len(time_s), stride), len(time_s) - 1])


def _send_body(stream: rr.RecordingStream, vehicle: VehicleRecord, colour: str, start_s: float) -> None:
    """Poses, body and name below ``world/vehicles``.

    A vehicle whose track begins after the mission, at ``start_s``, waits until then where its track begins; without a
    pose it would be drawn at the origin of the site.
    """
    path = path_of("world/vehicles", vehicle.name)
    keep = _thinned(vehicle.time_s, POSE_RATE_HZ)
    time = vehicle.time_s[keep]
    if len(keep) and time[0] > start_s:
        keep, time = np.r_[keep[0], keep], np.r_[start_s, time]
    xyzw = vehicle.quaternion[keep][:, [1, 2, 3, 0]]
    poses = rr.Transform3D.columns(translation=vehicle.position_m[keep], quaternion=xyzw)
    stream.send_columns(path, times(time), poses)
    send_look(stream, vehicle, colour)


def send_look(stream: rr.RecordingStream, vehicle: VehicleRecord, colour: str) -> None:
    """Body and name of a vehicle, below the entity that has its poses."""
    path = path_of("world/vehicles", vehicle.name)
    body = vehicle_mesh(vehicle, colour, BODY_SCALE[vehicle.kind])
    stream.log(f"{path}/body", mesh3d(body), static=True)
    label = rr.Points3D(
        [[0.0, 0.0, float(body.vertices_m[:, 2].max()) + 0.5]],
        radii=rr.Radius.ui_points(1.0),
        colors=[[255, 255, 255, 255]],
        labels=[vehicle.name],
        show_labels=True,
    )
    stream.log(f"{path}/label", label, static=True)


def _send_trail(stream: rr.RecordingStream, vehicle: VehicleRecord, colour: str) -> None:
    """A segment for each step of the track."""
    keep = _thinned(vehicle.time_s, TRAIL_RATE_HZ)
    points = vehicle.position_m[keep]
    moved = np.flatnonzero(np.linalg.norm(np.diff(points, axis=0), axis=1) > MOVED_M)
    if len(moved) == 0:
        return
    path = path_of("world/trails", vehicle.name)
    look = rr.LineStrips3D.from_fields(colors=[rgba(colour)], radii=rr.Radius.ui_points(1.2))
    stream.log(path, look, static=True)
    segments = np.stack([points[moved], points[moved + 1]], axis=1).astype(np.float32)
    ends = vehicle.time_s[keep][moved + 1]
    stream.send_columns(path, times(ends), rr.LineStrips3D.columns(strips=list(segments)))


def _send_plots(stream: rr.RecordingStream, vehicle: VehicleRecord, colour: str, site_model: SiteModel) -> None:
    keep = _thinned(vehicle.time_s, TRAIL_RATE_HZ)
    position = vehicle.position_m[keep]
    terrain = raster_at(np.asarray(site_model.site.terrain_m), site_model.site, position[:, 0], position[:, 1])
    series = {"battery": 100.0 * vehicle.battery_fraction[keep], "height": position[:, 2] - terrain}
    for name, values in series.items():
        send_series(stream, path_of(f"plots/{name}", vehicle.name), vehicle.name, colour, vehicle.time_s[keep], values)
