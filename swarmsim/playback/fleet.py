"""A large team in the recording: vehicles that look alike share one entity, with an instance for each.

A thousand vehicles with entities of their own would take minutes to write and load. All have poses at the same times,
fewer of them the more vehicles there are.
"""

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from swarmsim.playback.bodies import vehicle_mesh
from swarmsim.playback.colours import rgba, vehicle_colours
from swarmsim.playback.entities import BODY_SCALE, mesh3d, path_of, send_series, times, trails
from swarmsim.playback.growing_map import raster_at
from swarmsim.playback.vehicles import MOVED_M, POSE_RATE_HZ, TRAIL_RATE_HZ
from swarmsim.results.record import MissionRecord, VehicleRecord
from swarmsim.site.model import SiteModel

POSES_MAX, SEGMENTS_MAX = 160_000, 60_000  # of all vehicles: about 3 MB and 1.5 MB
_PERCENTILES = {"greatest": (100.0, "#56B4E9"), "median": (50.0, "#0072B2"), "least": (0.0, "#D55E00")}


def send_fleet(stream: rr.RecordingStream, record: MissionRecord, site_model: SiteModel) -> None:
    """Bodies, trails, and the spread of batteries and heights."""
    colours = vehicle_colours(record)
    poses_s = _instants(record, POSE_RATE_HZ, POSES_MAX)
    trails_s = _instants(record, TRAIL_RATE_HZ, SEGMENTS_MAX)
    rows = [_rows(vehicle, trails_s) for vehicle in record.vehicles]
    for name, numbers in trails(record).items():
        shown = [number for number in numbers if len(record.vehicles[number].time_s)]
        if not shown:
            continue
        vehicles, colour = [record.vehicles[number] for number in shown], colours[shown[0]]
        _send_bodies(stream, path_of("world/vehicles", name), vehicles, colour, poses_s)
        tracks = np.stack([record.vehicles[number].position_m[rows[number]] for number in shown], axis=1)
        _send_trails(stream, path_of("world/trails", name), tracks, colour, trails_s)
    _send_plots(stream, record, rows, site_model, trails_s)


def _instants(record: MissionRecord, rate_hz: float, rows_max: int) -> NDArray[np.floating]:
    """Times at ``rate_hz``, or fewer, so that all vehicles together have no more than ``rows_max`` rows."""
    last = max((float(v.time_s[-1]) for v in record.vehicles if len(v.time_s)), default=record.end_s)
    span = max(last - record.start_s, 0.0)
    count = min(int(span * rate_hz), rows_max // max(1, len(record.vehicles)))
    return np.linspace(record.start_s, record.start_s + span, max(2, count + 1))


def _rows(vehicle: VehicleRecord, time_s: NDArray[np.floating]) -> NDArray[np.intp]:
    """The row of a vehicle's track that holds at each time: the last before it, the first until there is one."""
    return np.maximum(np.searchsorted(vehicle.time_s, time_s, "right") - 1, 0)


def _send_bodies(
    stream: rr.RecordingStream, path: str, vehicles: list[VehicleRecord], colour: str, time_s: NDArray[np.floating]
) -> None:
    """One mesh, with an instance for each vehicle at each time."""
    rows = [_rows(vehicle, time_s) for vehicle in vehicles]
    positions = np.stack([v.position_m[row] for v, row in zip(vehicles, rows, strict=True)], axis=1)
    turns = np.stack([v.quaternion[row][:, [1, 2, 3, 0]] for v, row in zip(vehicles, rows, strict=True)], axis=1)
    stream.log(path, mesh3d(vehicle_mesh(vehicles[0], colour, BODY_SCALE[vehicles[0].kind])), static=True)
    instances = rr.InstancePoses3D.columns(
        translations=positions.reshape(-1, 3).astype(np.float32), quaternions=turns.reshape(-1, 4).astype(np.float32)
    )
    stream.send_columns(path, times(time_s), instances.partition([len(vehicles)] * len(time_s)))


def _send_trails(
    stream: rr.RecordingStream,
    path: str,
    tracks_m: NDArray[np.floating],
    colour: str,
    time_s: NDArray[np.floating],
) -> None:
    """The steps of tracks [T, U, 3], a row of segments for each time."""
    moved = np.linalg.norm(np.diff(tracks_m, axis=0), axis=-1) > MOVED_M  # [T - 1, U]
    lengths, rows = moved.sum(axis=1), np.flatnonzero(moved.any(axis=1))
    if len(rows) == 0:
        return
    segments = np.stack([tracks_m[:-1][moved], tracks_m[1:][moved]], axis=1).astype(np.float32)
    look = rr.LineStrips3D.from_fields(colors=[rgba(colour)], radii=rr.Radius.ui_points(0.8))
    stream.log(path, look, static=True)
    strips = rr.LineStrips3D.columns(strips=list(segments)).partition(lengths[rows])
    stream.send_columns(path, times(time_s[rows + 1]), strips)


def _send_plots(
    stream: rr.RecordingStream,
    record: MissionRecord,
    rows: list[NDArray[np.intp]],
    site_model: SiteModel,
    time_s: NDArray[np.floating],
) -> None:
    """Greatest, median and least battery and height of all vehicles."""
    there = [(v, row) for v, row in zip(record.vehicles, rows, strict=True) if len(v.time_s)]
    if not there:
        return
    position = np.stack([v.position_m[row] for v, row in there], axis=1)
    terrain = raster_at(np.asarray(site_model.site.terrain_m), site_model.site, position[..., 0], position[..., 1])
    battery = np.stack([100.0 * v.battery_fraction[row] for v, row in there], axis=1)
    for name, values in (("battery", battery), ("height", position[..., 2] - terrain)):
        for label, (percent, colour) in _PERCENTILES.items():
            spread = np.percentile(values, percent, axis=1)
            send_series(stream, f"plots/{name}/{label}", label, colour, time_s, spread)
